"""Time for which this process has compiled, without what it loaded from the disk cache.

A compilation of more than a second is announced on the standard error, with what is compiled, and
how long it took. ``announcements(False)`` turns that off, and so does ``QUELL_QUIET=1``.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event, types

_EVENT = "numba:compile"  # https://numba.readthedocs.io/en/stable/developer/event_api.html
# Shorter compilations are not worth a line [s].
_LONG = 1.0
# Ends of names of kernels' parameters, which say nothing about what they are.
_ENDS = ("Parameters", "Model", "Design")
# Names that end so belong to a part that is named anyway.
_BESIDE = ("State", "Memory", "Scalars")
# Most names of parts in a line. Chosen by hand.
_MOST_PARTS = 8


class CompileTime(event.Listener):
    """The time [s] that compilation took.

    Numba's events nest: what an entry point calls is compiled within it, in the same thread.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.running = 0  # threads that compile now
        self.told = 0.0  # share of it that was announced
        self.announced = not os.environ.get("QUELL_QUIET")
        self._own = threading.local()

    def on_start(self, event: Any) -> None:
        """Note when the outermost compilation of a thread starts."""
        self._own.depth = getattr(self._own, "depth", 0) + 1
        if self._own.depth == 1:
            self._own.began = time.perf_counter()
            self.running += 1
            # Of several processes only the first speaks.
            if self.announced and multiprocessing.parent_process() is None:
                self._own.timer = threading.Timer(_LONG, _announce, (event.data,))
                self._own.timer.daemon = True
                self._own.timer.start()

    def on_end(self, event: Any) -> None:
        """Add the time of the outermost compilation of a thread."""
        self._own.depth -= 1
        if self._own.depth == 0:
            # Numba compiles in one thread at a time, so the sum is safe.
            took = time.perf_counter() - self._own.began
            self.seconds += took
            self.running -= 1
            timer, self._own.timer = getattr(self._own, "timer", None), None
            if timer is not None:
                timer.cancel()
                if took >= _LONG:
                    self.told += took
                    _print(f"compiled in {took:.1f} s; later runs load it from the disk")


@contextmanager
def announcements(on: bool) -> Iterator[None]:
    """Turn announcements of long compilations on or off for a while."""
    before, compile_time.announced = compile_time.announced, on
    try:
        yield
    finally:
        compile_time.announced = before


def _announce(data: Any) -> None:
    """Print what is being compiled."""
    function = getattr(data.get("dispatcher"), "py_func", None)
    name = getattr(function, "__name__", "code").strip("_").replace("_", " ")
    parts = list(dict.fromkeys(_parts(data.get("args", ()))))
    about = f" for {', '.join(parts[:_MOST_PARTS])}" if parts else ""
    _print(f"compiling {name}{about}: takes up to a minute, once")


def _parts(kinds: Any) -> Iterator[str]:
    """Yield the names of the NamedTuples among some types, those inside after those outside."""
    inside = []
    for kind in kinds:
        if isinstance(kind, types.BaseNamedTuple):
            name = kind.instance_class.__name__
            for end in _ENDS:
                name = name.removesuffix(end)
            if name and not name.endswith(_BESIDE):
                yield name
            inside += list(getattr(kind, "types", ()))
    if inside:
        yield from _parts(inside)


def _print(text: str) -> None:
    stream = sys.stderr
    if stream is not None:
        print(f"quell: {text}", file=stream, flush=True)


compile_time = CompileTime()
event.register(_EVENT, compile_time)
