# shows: the wheel is built from the repository
python3 -m venv "$OWN/builder"
"$OWN/builder/bin/pip" install --quiet build
"$OWN/builder/bin/python" -m build --wheel --outdir "$WORK/dist" .
