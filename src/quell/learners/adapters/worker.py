"""A separate thread for a model that may take longer than the loop can wait."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any


class Worker:
    """A thread that runs one job at a time. It starts with the first job."""

    def __init__(self) -> None:
        self.busy = False  # true while there is a job whose result was not taken
        self._jobs: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._done = threading.Event()
        self._results: list[Any] = []
        self._thread: threading.Thread | None = None

    def start(self, job: Callable[[], Any]) -> None:
        """Start a job, which must not raise."""
        if self._thread is None:
            # The thread must not refer to the worker: then neither would ever be deleted.
            self._thread = threading.Thread(
                target=_run,
                args=(self._jobs, self._done, self._results),
                name="quell learner",
                daemon=True,
            )
            self._thread.start()
        self._done.clear()
        self.busy = True
        self._jobs.put(job)

    def result(self, timeout: float) -> Any:
        """Return the job's result, or None if there is none within ``timeout`` [s]."""
        if not self.busy or not self._done.wait(timeout):
            return None
        self.busy = False
        return self._results.pop()

    def wait(self) -> None:
        """Wait until no job is running."""
        if self.busy:
            self._done.wait()

    def stop(self) -> None:
        """End the thread after its current job."""
        self._jobs.put(None)


def _run(
    jobs: queue.SimpleQueue[Callable[[], Any] | None], done: threading.Event, results: list[Any]
) -> None:
    while True:
        job = jobs.get()
        if job is None:
            return
        results.append(job())
        del job
        done.set()
