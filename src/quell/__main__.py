"""``python -m quell``: the command ``quell``."""

from quell.cli import main

main()
