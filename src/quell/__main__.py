"""The command ``quell`` as a process; ``python -m quell`` is the same."""

from __future__ import annotations

import atexit
import os
import sys


def run() -> None:
    """Run the command line, and end this process as soon as all is written and closed.

    Python would clear its memory first. With compiled code in it that takes up to a second, in
    which a user waits for nothing; the operating system takes the memory back at once.
    """
    code = 1  # of an error with a traceback

    def end() -> None:
        try:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:
                    stream.flush()
        except (OSError, ValueError):
            return  # Python tries it again, and reports it
        os._exit(code)

    # Handlers run in the reverse order: this one after those of all modules that are imported now.
    atexit.register(end)
    try:
        try:
            from quell.cli import main
        except ImportError as error:  # of what quell needs for any command
            print(f"quell: {error}; pip check says what is missing", file=sys.stderr)
            sys.exit(2)
        main()
        code = 0
    except SystemExit as ending:
        code = ending.code if isinstance(ending.code, int) else int(ending.code is not None)
        raise


if __name__ == "__main__":  # not in a process that ``multiprocessing`` starts
    run()
