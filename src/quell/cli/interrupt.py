"""Ctrl-C and other signals that end a program, while code is compiled or loaded."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def exit_on_signal(close: Callable[[], Any]) -> Iterator[None]:
    """Make signals that end a program call ``close`` and exit with 128 plus the signal's number.

    An exception could be lost: compiling and loading run through callbacks that ignore exceptions.
    """
    from quell.realtime.system.interrupts import termination_handler

    def end(number: int, frame: Any) -> None:
        close()
        print("quell: interrupted", file=sys.stderr, flush=True)
        os._exit(128 + number)

    with termination_handler(end):
        yield
