"""Handling of the signals that end programs."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType


@contextmanager
def termination_handler(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Call ``handler`` on Ctrl-C, SIGTERM, and SIGHUP unless that is ignored (nohup).

    Use it in the main thread only. At the end the previous handlers are restored.
    """
    numbers = [signal.SIGINT, signal.SIGTERM]
    hang_up = getattr(signal, "SIGHUP", None)
    if hang_up is not None and signal.getsignal(hang_up) is not signal.SIG_IGN:
        numbers.append(hang_up)
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in previous.items():
            with suppress(TypeError):  # a handler that Python did not install is None here
                signal.signal(number, old)
