# shows: the golden corpus: logs, exported C, results, memory images and setup files are what they were; a third of the tunings and compiled loops
# after: environment tools
pytest -p no:cacheprovider -m "" -n 1 tests/golden -k "not tunings and not compiled_loops or [$((TURN % 3))]"
