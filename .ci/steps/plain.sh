# shows: the README's first command works on a fresh install, and no output is replaced unless asked
# after: wheel
python3 -m venv "$WORK/plain"
"$WORK/plain/bin/pip" install --quiet "$WORK"/dist/*.whl
export PATH="$WORK/plain/bin:$PATH"
cd "$OWN"
quell reproduce two-mass --json result.json --figures figures
python "$ROOT/.ci/checks/two_mass.py" result.json
test "$(ls figures/*.png figures/*.svg | wc -l)" = 8
quell excite twice.csv --duration 20
if quell excite twice.csv --duration 20 2>/dev/null; then echo "an output was replaced"; exit 1; fi
quell excite twice.csv --duration 20 --overwrite
