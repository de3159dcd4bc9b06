"""``python -m quell``: the command ``quell``."""

from quell.cli import main

if __name__ == "__main__":  # not in a process that ``multiprocessing`` starts
    main()
