# shows: the README's test command passes against the installed wheel
# after: environment tools
# cores: 2
# minutes: 25
pytest -p no:cacheprovider
