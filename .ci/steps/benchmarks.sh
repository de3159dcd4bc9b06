# shows: a quarter of the benchmarks starts, and their figures are numbers; those of the pages have a source
# after: environment tools
# minutes: 20
python docs/check_figures.py
python docs/check_figures.py --rerun 1 --seed "$SEED"
python .ci/checks/benchmarks.py --jobs 1 --part "$((TURN % 4 + 1))/4"
