# shows: the blocks of code and the setups of a fifth of the pages run
# after: environment
cd "$OWN"
python "$ROOT/.ci/checks/pages.py" --part "$((TURN % 5 + 1))/5"
