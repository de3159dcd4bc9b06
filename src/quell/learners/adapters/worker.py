"""A thread of its own for a model that may take longer than a loop can wait."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any


class Worker:
    """Runs one job at a time. The thread starts with the first job."""

    def __init__(self) -> None:
        self.busy = False
        """Whether there is a job whose answer was not taken."""
        self._jobs: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._done = threading.Event()
        self._box: list[Any] = []
        self._thread: threading.Thread | None = None

    def start(self, job: Callable[[], Any]) -> None:
        """Start a job, which must not raise."""
        if self._thread is None:
            # What the thread holds on to must not be the worker, or neither would ever end.
            self._thread = threading.Thread(
                target=_run,
                args=(self._jobs, self._done, self._box),
                name="quell learner",
                daemon=True,
            )
            self._thread.start()
        self._done.clear()
        self.busy = True
        self._jobs.put(job)

    def answer(self, patience: float) -> Any:
        """Return what the job has returned, within ``patience`` [s]; else None."""
        if not self.busy or not self._done.wait(patience):
            return None
        self.busy = False
        return self._box.pop()

    def rest(self) -> None:
        """Wait until no job is running."""
        if self.busy:
            self._done.wait()

    def end(self) -> None:
        """Let the thread end, after the job it is at."""
        self._jobs.put(None)


def _run(
    jobs: queue.SimpleQueue[Callable[[], Any] | None], done: threading.Event, box: list[Any]
) -> None:
    while True:
        job = jobs.get()
        if job is None:
            return
        box.append(job())
        del job
        done.set()
