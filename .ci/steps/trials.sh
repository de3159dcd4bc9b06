# shows: trials, an eighth of them at each landing
# after: environment tools
# cores: 2
# minutes: 40
pytest -p no:cacheprovider -m trial --ignore=tests/golden --part "$((TURN % 8 + 1))/8"
