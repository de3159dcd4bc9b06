# shows: the paper's study, unknown frequencies, the ACC plants, the torsional testbed, and the guard's trial
# after: environment
cd "$OWN"
quell stress --runs 30 --honest 60 --seed 3 --json stress.json --figures figures
python "$ROOT/.ci/checks/stress.py" stress.json
python "$ROOT/.ci/checks/no_guard.py"
python "$ROOT/.ci/checks/unknown_frequencies.py"
quell reproduce acc --count 300 --json acc.json --figures figures
python "$ROOT/.ci/checks/acc.py" acc.json "$ROOT/../shared/benchmarks/acc/theta_small.csv"
for seed in 0 1; do
    quell reproduce torsional --seed $seed --json torsional-$seed.json --figures torsional-$seed | tee torsional-$seed.log
    if grep -iqw "nan" torsional-$seed.log || grep -q "…" torsional-$seed.log; then echo "a value is no number, or a column is cut"; exit 1; fi
    test "$(ls torsional-$seed | sort | xargs)" = "$(echo torsional-{control,learning,position}.{pdf,png,svg})"
done
python "$ROOT/.ci/checks/torsional.py" torsional-[01].json
cogging="$ROOT/../shared/data/cogging_a.csv"
if [ ! -f "$cogging" ]; then echo "no measured map at $cogging"; else python "$ROOT/.ci/checks/measured_cogging.py" "$cogging"; fi
