"""How long this process has compiled, without what it loaded from the disk cache."""

from __future__ import annotations

import threading
import time
from typing import Any

from numba.core import event

_EVENT = "numba:compile"  # https://numba.readthedocs.io/en/stable/developer/event_api.html


class CompileTime(event.Listener):
    """The time [s] that compilation took.

    Numba's events nest: what an entry point calls is compiled within it, in the same thread.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.running = 0  # threads that compile now
        self._own = threading.local()

    def on_start(self, event: Any) -> None:
        """Note when the outermost compilation of a thread starts."""
        self._own.depth = getattr(self._own, "depth", 0) + 1
        if self._own.depth == 1:
            self._own.began = time.perf_counter()
            self.running += 1

    def on_end(self, event: Any) -> None:
        """Add the time of the outermost compilation of a thread."""
        self._own.depth -= 1
        if self._own.depth == 0:
            # Numba compiles in one thread at a time, so the sum is safe.
            self.seconds += time.perf_counter() - self._own.began
            self.running -= 1


compile_time = CompileTime()
event.register(_EVENT, compile_time)
