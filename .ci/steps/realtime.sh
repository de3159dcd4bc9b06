# shows: a loop in real time over UDP; drawn messages, setups, frames and files leave no traceback
# after: environment
cd "$OWN"
quell rig --device udp://127.0.0.1:0 --seconds 600 >rig.log &
rig=$!
until grep -q " at udp" rig.log; do sleep 0.2; done
url=$(sed -n 's/.* at \(udp:[^ ]*\): .*/\1/p' rig.log)
code=0
quell run-rig --device "$url" --seconds 3 --mcap run.mcap --csv run.csv --json rig.json --figures figures || code=$?
test "$code" = 0 -o "$code" = 3  # a busy machine may end it early, but safely
kill "$rig" || true  # it may have ended by itself on a busy machine
wait "$rig"
cat rig.log
python - <<'PY'
from quell.realtime import load

one, other = load("run.mcap"), load("run.csv")
assert len(one) == len(other) > 100 and one["u"][-1] == 0.0
print(len(one), "cycles recorded, u ends at zero")
PY
python "$ROOT/benchmarks/mutated_files.py" --seconds 20 --seed "$SEED"
python "$ROOT/benchmarks/hostile_wire.py" --seconds 15 --seed "$SEED"
cd "$ROOT"
QUELL_FUZZ=200 pytest -q -n 0 --no-budget -m "" -p no:cacheprovider tests/test_fuzzed.py tests/test_frames.py tests/test_cobs.py
