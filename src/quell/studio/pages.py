"""The connection of one page: messages in, frames out."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any

from quell.kernels.compile_time import compile_time
from quell.studio import messages
from quell.studio.frames import frame
from quell.studio.lanes import Lane
from quell.studio.records import PageRecord
from quell.studio.runs import Maker, StoppedError
from quell.studio.separate import frames_apart, is_large
from quell.studio.tasks import LONG, frames_for

_LOG = logging.getLogger(__name__)

# A page hears that code is compiled, or that others are served first, after this time [s]; a person
# notices a pause from about 0.4 s on.
_NOTICED = 0.4
# Shortest time between two reports of progress [s]: ten a second are smooth.
_REPORTS = 0.1
# Processes for large setups at once.
_APART = 2


class Workers:
    """The threads of all pages: one for runs, one for long tasks, some that wait for processes."""

    def __init__(self) -> None:
        self.runs = ThreadPoolExecutor(1, thread_name_prefix="quell-studio-run")
        self.long = ThreadPoolExecutor(1, thread_name_prefix="quell-studio-long")
        self.apart = ThreadPoolExecutor(_APART, thread_name_prefix="quell-studio-apart")

    def close(self) -> None:
        """Let the threads end; what waits is dropped."""
        for pool in (self.runs, self.long, self.apart):
            pool.shutdown(wait=False, cancel_futures=True)


class Page:
    """A page, from its connection until it leaves.

    Parameters
    ----------
    websocket
        an accepted connection of Starlette.
    workers
        the threads.
    granted
        the files that it may name.
    """

    def __init__(self, websocket: Any, workers: Workers, granted: messages.Granted) -> None:
        self._websocket, self._workers = websocket, workers
        self._lanes = {"short": Lane(), "long": Lane()}
        self._granted, self._record = granted, PageRecord()
        self._makers = {name: Maker(trust=granted.trust) for name in self._lanes}
        self._sending = asyncio.Lock()

    async def serve(self) -> None:
        """Answer messages until the page leaves."""
        working = [asyncio.create_task(self._work(name)) for name in self._lanes]
        try:
            while True:
                received = await self._websocket.receive()
                if received["type"] != "websocket.receive":
                    return
                await self._take(received.get("text") or received.get("bytes") or "")
        finally:
            for lane in self._lanes.values():
                lane.close()
            for task in working:
                task.cancel()
            await asyncio.gather(*working, return_exceptions=True)

    async def _take(self, text: str | bytes) -> None:
        """Put a message where a thread takes it; answer a malformed one with its error."""
        try:
            message = messages.parsed(text)
            if message["do"] == "part":
                self._record.take_part(message)
                return
            if message["do"] == "record":
                message["content"] = self._record.content(message.get("size"))
        except ValueError as error:
            await self._send(_problem(error, messages.identity(text)))
            return
        if message["do"] == "cancel":
            self._lanes["long"].stop()
            return
        self._lanes["long" if message["do"] in LONG else "short"].put(message)

    async def _work(self, name: str) -> None:
        """Answer the messages of a lane, one after the other."""
        lane = self._lanes[name]
        while True:
            message = await lane.next()
            report = self._reporter(message["id"])
            make = self._makers[name]
            about = self._granted, self._record, lane.stale, report
            try:
                if is_large(message):
                    found, pool = frames_apart(message, *about), self._workers.apart
                else:
                    found = frames_for(message, make, *about)
                    pool = self._workers.long if name == "long" else self._workers.runs
                await self._send_all(found, pool, name, message["id"])
            except StoppedError:
                await self._send(frame({"kind": "stopped", "id": message["id"]}))
            except (ValueError, ArithmeticError, ImportError, OSError, MemoryError) as error:
                await self._send(_problem(error, message["id"]))
            except Exception as error:
                # A message must not end the page, whatever it makes a library do.
                _LOG.exception("studio: a message failed")
                await self._send(_problem(error, message["id"]))

    async def _send_all(
        self, frames: Iterator[bytes], pool: ThreadPoolExecutor, name: str, number: int
    ) -> None:
        """Send frames as a thread makes them."""
        loop = asyncio.get_running_loop()
        while True:
            making = loop.run_in_executor(pool, partial(next, frames, None))
            done, _ = await asyncio.wait([making], timeout=_NOTICED)
            if not done and name == "short":
                await self._send(frame({"kind": "wait", "id": number, "compiles": _compiles()}))
            made = await making
            if made is None:
                return
            await self._send(made)

    async def _send(self, data: bytes) -> None:
        async with self._sending:
            with suppress(RuntimeError):  # the page has left
                await self._websocket.send_bytes(data)

    def _reporter(self, number: int) -> Any:
        """Return a function that sends progress from a thread."""
        loop, last = asyncio.get_running_loop(), [0.0]

        def report(part: str, share: float) -> None:
            if time.monotonic() - last[0] >= _REPORTS:
                last[0] = time.monotonic()
                header = {"kind": "progress", "id": number, "part": part, "share": share}
                asyncio.run_coroutine_threadsafe(self._send(frame(header)), loop)

        return report


def _compiles() -> bool:
    """Return whether a thread compiles now."""
    return compile_time.running > 0


def _problem(error: BaseException, number: int | None) -> bytes:
    """Return a frame with the message of an error."""
    text = str(error) or type(error).__name__
    if not isinstance(error, ValueError):
        text = f"{type(error).__name__}: {text}"
    lines = [" ".join(line.split())[:1000] for line in text.splitlines() if line.strip()]
    return frame({"kind": "error", "id": number, "text": lines[:20]})
