# shows: all that tests, pages and checks need can be installed beside the wheel
# after: wheel
python3 -m venv "$WORK/venv"
wheel=$(ls "$WORK"/dist/*.whl)
"$WORK/venv/bin/pip" install --quiet "$wheel[dev]"
"$WORK/venv/bin/python" - <<'PY'
import quell, sys

assert quell.__file__.startswith(sys.prefix), quell.__file__
PY
