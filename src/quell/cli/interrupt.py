"""Ctrl-C, and what else ends a program, while code is compiled or loaded."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from quell.realtime.system.interrupts import termination_handler


@contextmanager
def ended_at_once(close: Callable[[], Any]) -> Iterator[None]:
    """Let a signal ``close`` what is open and end the process; the exit code is 128 and the signal's number.

    An exception might be lost instead: compiling and loading run through callbacks that swallow them.
    """

    def end(number: int, frame: Any) -> None:
        close()
        print("quell: interrupted", file=sys.stderr, flush=True)
        os._exit(128 + number)

    with termination_handler(end):
        yield
