"""Tasks of large setups, each in a process of its own, which is ended when it takes too long.

An analysis of a plant of order 200 takes half a minute within one call of a library, which no
thread can end. So what a page asks for such a plant runs in a process: other pages do not wait for
it, and it ends with its time, or as soon as the page asks for something else.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection
from typing import Any

from quell.parallel import one_blas_thread
from quell.studio.messages import Granted
from quell.studio.records import PageRecord
from quell.studio.runs import LONGEST, Maker, StoppedError
from quell.studio.tasks import frames_for

# Setups with longer lists have plants of higher order; up to it an analysis takes half a second.
_LONGEST_LIST = 40
_LONGEST_TEXT = 20_000  # of a setup that is opened [characters]
# Time until the process has started and imported quell [s].
_START = 60.0
_POLL = 0.02  # time between two looks whether somebody still waits [s]
# What the process sends: the first byte of each message.
_READY, _FRAME, _PROGRESS, _ERROR, _DONE = b"r", b"f", b"p", b"e", b"d"


def is_large(message: Mapping[str, Any]) -> bool:
    """Return whether a message asks for something that may take long within one call."""
    waiting = [message.get("setup")]
    while waiting:
        value = waiting.pop()
        if isinstance(value, list):
            if len(value) > _LONGEST_LIST:
                return True
            waiting += value
        elif isinstance(value, dict):
            waiting += value.values()
    text = message.get("text")
    return isinstance(text, str) and len(text) > _LONGEST_TEXT


def frames_apart(
    message: Mapping[str, Any],
    granted: Granted,
    record: PageRecord,
    stale: Callable[[], bool],
    report: Callable[[str, float], None],
) -> Iterator[bytes]:
    """Yield the frames of ``tasks.frames_for``, made by a process.

    Raises
    ------
    ValueError
        for what cannot be, and for what takes longer than ``LONGEST`` seconds in all.
    StoppedError
        if ``stale`` returns that nobody waits any more; the process is ended then.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(
        target=_work, args=(there, dict(message), granted, record), daemon=True
    )
    process.start()
    there.close()
    end = time.monotonic() + _START
    try:
        while True:
            if stale():
                raise StoppedError
            if time.monotonic() > end:
                raise ValueError(
                    f"this took more than {LONGEST:g} s: take a plant of lower order, or use "
                    "quell on the command line, which has no such limit"
                )
            if not here.poll(_POLL):
                continue
            received = here.recv_bytes()
            kind, data = received[:1], received[1:]
            if kind == _READY:
                end = time.monotonic() + LONGEST
            elif kind == _FRAME:
                yield data
            elif kind == _PROGRESS:
                report(*json.loads(data))
            elif kind == _ERROR:
                raise ValueError(data.decode())
            else:
                return
    except EOFError:
        raise ValueError("the process of this task has ended early: it needs less memory") from None
    finally:
        process.kill()
        process.join()
        here.close()


def _work(
    there: Connection, message: Mapping[str, Any], granted: Granted, record: PageRecord
) -> None:
    """Send all frames of a message; the body of the process."""

    def report(part: str, share: float) -> None:
        there.send_bytes(_PROGRESS + json.dumps([part, share]).encode())

    make = Maker(trust=granted.trust)
    there.send_bytes(_READY)
    try:
        with one_blas_thread():
            for data in frames_for(message, make, granted, record, lambda: False, report):
                there.send_bytes(_FRAME + data)
    except ValueError as error:
        there.send_bytes(_ERROR + str(error).encode())
    except Exception as error:  # whatever a library raises: the page shows it
        there.send_bytes(_ERROR + f"{type(error).__name__}: {error}".encode())
    else:
        there.send_bytes(_DONE)
