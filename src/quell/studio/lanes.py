"""Messages of one page that wait for a thread: of those of one kind the newest wins."""

from __future__ import annotations

import asyncio
import time
from typing import Any

# A run that a newer message replaces is finished all the same if it takes no longer than this [s]:
# otherwise nothing would be drawn while a slider moves. Chosen by hand.
_PATIENCE = 0.3


class Lane:
    """The newest message of each kind, and the one that is worked on."""

    def __init__(self) -> None:
        self._waiting: dict[str, dict[str, Any]] = {}
        self._some = asyncio.Event()
        self._began = 0.0
        self._closed = self._stopped = False

    def put(self, message: dict[str, Any]) -> None:
        """Take a message in place of an older one of its kind."""
        self._waiting.pop(message["do"], None)
        self._waiting[message["do"]] = message
        self._some.set()

    async def next(self) -> dict[str, Any]:
        """Return the message that waits longest."""
        while not self._waiting:
            self._some.clear()
            await self._some.wait()
        self._began, self._stopped = time.monotonic(), False
        return self._waiting.pop(next(iter(self._waiting)))

    def stop(self) -> None:
        """End what is worked on, and forget what waits."""
        self._waiting.clear()
        self._stopped = True

    def close(self) -> None:
        """End for good: the page is gone."""
        self._closed = True
        self.stop()

    def stale(self) -> bool:
        """Return whether what is worked on should end; called from its thread."""
        if self._closed or self._stopped:
            return True
        return bool(self._waiting) and time.monotonic() - self._began > _PATIENCE
