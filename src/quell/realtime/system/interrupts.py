"""The signals that end programs, handled for a while."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any


def termination_signals() -> list[signal.Signals]:
    """Return the signals that end a program that does not mind them: Ctrl-C, SIGTERM, and SIGHUP, unless that is ignored (nohup)."""
    hang_up = getattr(signal, "SIGHUP", None)
    more = [] if hang_up is None or signal.getsignal(hang_up) is signal.SIG_IGN else [hang_up]
    return [signal.SIGINT, signal.SIGTERM, *more]


@contextmanager
def termination_handler(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Let ``handler`` hear these signals instead of whoever did; in the main thread only."""
    before = {number: signal.signal(number, handler) for number in termination_signals()}
    try:
        yield
    finally:
        for number, old in before.items():
            with suppress(TypeError):  # one that Python did not install
                signal.signal(number, old)
