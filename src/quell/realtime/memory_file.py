"""The file in which a real-time loop keeps what its controller has learned.

The file is a memory image (``controllers/memory.py``), as ``controller.memory()`` returns it and
``NAME_load`` of the exported controller takes it. It is read before anything moves: a file that
does not fit ends the run there, because it would be replaced at the end by what was learned
without it. It is written whole or not at all, while the loop runs on: in the pause between two
steps of the loop, which counts its steps at their beginning and at their end.
"""

from __future__ import annotations

import copy
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.controllers.memory import file_content
from quell.controllers.stateful import StatefulController
from quell.files import check_writable, written_atomically
from quell.realtime.system import load_acquire

# Looks for a pause of the loop, and time between two [s]: a step takes a part of a sample, so that
# the first look finds one nearly always.
_LOOKS, _BETWEEN = 10_000, 1e-4


class MemoryFile:
    """The memory of a controller in a real-time loop: a file that outlives it.

    Hand it to ``run_rig(..., memory=...)``, or the path of the file alone. It is read at the
    start, if it exists, and saved when the run ends, unless a fault has ended it. ``save`` asks for
    it in between, from any thread; so does the signal SIGUSR1 to the process.

    Parameters
    ----------
    path
        the file; it is replaced when it is saved.

    Attributes
    ----------
    saved : int
        how often it was saved.

    Raises
    ------
    ValueError
        when a run begins: for a file that can't be read or written, or does not fit the controller.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        self.saved = 0
        self._asked = threading.Event()
        self._controller: Any = None

    def save(self) -> None:
        """Ask the running loop to save; it does within a twentieth of a second."""
        self._asked.set()

    def start(self, controller: Any) -> tuple[Any, str]:
        """Return the state for a run of a controller, and a note on what it begins with.

        The controller is not changed.
        """
        if not isinstance(controller, StatefulController):
            raise ValueError(
                f"memory = {str(self.path)!r}: {type(controller).__name__} has no memory image; "
                "leave memory out"
            )
        check_writable(self.path, overwrite=True)
        own = copy.copy(controller)
        own.reset()
        own.memory()  # an error for a learner that has none comes before the run
        self._controller = own
        if not self.path.exists():
            return own._state, f"memory: {self.path} does not exist yet: nothing is learned"
        try:
            own.restore(file_content(self.path))
        except ValueError as error:
            raise ValueError(
                f"memory = {str(self.path)!r}: {error} (nothing has moved; another file, or none "
                "there, lets the controller learn anew)"
            ) from None
        return own._state, f"memory: it begins with what is in {self.path}"

    def save_if_asked(self, steps: NDArray[np.int64]) -> str:
        """Save if somebody has asked for it; return a note, or nothing.

        ``steps`` is the count of the loop's steps, odd during a step.
        """
        if not self._asked.is_set():
            return ""
        self._asked.clear()
        return self.write(steps)

    def write(self, steps: NDArray[np.int64]) -> str:
        """Write the file, whole or not at all; return a note on it."""
        image = self._image(steps)
        if not image:
            return f"memory: NOT saved, {self.path} is as before: the loop was never at rest"
        try:
            with written_atomically(self.path, overwrite=True) as part:
                part.write_bytes(image)
        except (OSError, ValueError) as error:
            return f"memory: NOT saved, {self.path} is as before: {error}"
        self.saved += 1
        return f"memory: saved to {self.path}, {len(image)} bytes"

    def _image(self, steps: NDArray[np.int64]) -> bytes:
        """Return an image of the state between two steps; nothing if there never is a pause."""
        for _ in range(_LOOKS):
            before = load_acquire(steps, 0)
            if before % 2 == 0:
                image: bytes = self._controller.memory()
                if load_acquire(steps, 0) == before:
                    return image
            time.sleep(_BETWEEN)
        return b""

    @contextmanager
    def saved_by_signal(self) -> Iterator[None]:
        """Save at SIGUSR1, where there is this signal, if this is the main thread."""
        number = getattr(signal, "SIGUSR1", None)
        if number is None or threading.current_thread() is not threading.main_thread():
            yield
            return

        def handle(number: int, frame: FrameType | None) -> None:
            self.save()

        before = signal.signal(number, handle)
        try:
            yield
        finally:
            signal.signal(number, signal.SIG_DFL if before is None else before)


def memory_file(memory: MemoryFile | str | PathLike[str] | None) -> MemoryFile | None:
    """Return the memory of a run for its argument ``memory``."""
    if memory is None or isinstance(memory, MemoryFile):
        return memory
    if not isinstance(memory, str | PathLike):
        raise ValueError(f"memory = {memory!r}: must be the path of a file")
    return MemoryFile(memory)
