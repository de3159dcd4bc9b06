"""Frames through shared memory, between processes of one computer.

A wire has two mailboxes, files in memory: ``quell-NAME-measurements`` and ``quell-NAME-commands``.
A mailbox has two slots, the first for hello, welcome and goodbye, the second for measurements or
commands. A slot is a counter (8 bytes), twice the number of frames written, and the newest frame
(40 bytes). A mailbox has one writer, whose process locks it as long as it lives. So two loops can't
write to one mailbox, and a new rig can take over the mailboxes of a rig that was killed.

*Writing* (a sequence lock, see Boehm, "Can seqlocks get along with programming language memory
models?", MSPC 2012): make the counter odd, store the five words of the frame, make the counter
even; each store is a release. *Reading:* load the counter, the words and the counter again, each
load an acquire; try again if the counter was odd or has changed.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import re
import time
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.realtime.system.atomics import load_acquire, store_release
from quell.realtime.system.clock import SystemClock, now, system_clock, wait_until
from quell.realtime.wire.device import WireDevice
from quell.realtime.wire.frames import HELLO, LENGTH, Buffer
from quell.realtime.wire.transport import receive, send, wait_for_frame

_SLOT = 1 + LENGTH // 8
_WORDS = 2 * _SLOT
_FOLDER = Path("/dev/shm")
# Time between two looks for a frame while waiting [ns]. Chosen by hand; not tuned further.
_POLL_EVERY = 20_000
# Attempts to read a frame during a write; after these its writer has died. Chosen by hand.
_ATTEMPTS = 1000


class SharedMemoryTransport(NamedTuple):
    """One end of a wire through shared memory."""

    own: NDArray[np.int64]  # the mailbox to write to (12,)
    others: NDArray[np.int64]  # the mailbox to read from (12,)
    seen: NDArray[np.int64]  # counters of the frames read last (2,)
    clock: SystemClock


@receive.register(SharedMemoryTransport)
def _receive(shared: SharedMemoryTransport, frame: Buffer) -> int:
    for slot in range(2):
        if _read_slot(shared, slot, frame):
            return LENGTH
    return -1


@kernel
def _read_slot(shared: SharedMemoryTransport, slot: int, frame: Buffer) -> bool:
    """Read the frame of a slot if it is new; return whether it is."""
    first = slot * _SLOT
    for _ in range(_ATTEMPTS):
        count = load_acquire(shared.others, first)
        if count == shared.seen[slot]:
            return False
        if count % 2 == 0:
            for i in range(LENGTH // 8):
                frame.longs[i] = load_acquire(shared.others, first + 1 + i)
            if load_acquire(shared.others, first) == count:
                shared.seen[slot] = count
                return True
    return False


@send.register(SharedMemoryTransport)
def _send(shared: SharedMemoryTransport, frame: Buffer) -> int:
    first = 0 if frame.bytes[3] >= HELLO else _SLOT
    # The counter is odd already if the last writer was killed while it wrote.
    writing = load_acquire(shared.own, first) | 1
    store_release(shared.own, first, writing)
    for i in range(LENGTH // 8):
        store_release(shared.own, first + 1 + i, frame.longs[i])
    store_release(shared.own, first, writing + 1)
    return 0


@wait_for_frame.register(SharedMemoryTransport)
def _wait_for_frame(shared: SharedMemoryTransport, nanoseconds: int) -> None:
    time_now = now(shared.clock)
    end = time_now + nanoseconds
    while (
        time_now < end
        and load_acquire(shared.others, 0) == shared.seen[0]
        and load_acquire(shared.others, _SLOT) == shared.seen[1]
    ):
        time_now = wait_until(shared.clock, min(time_now + _POLL_EVERY, end))


class SharedMemoryDevice(WireDevice):
    """A device in another process of this computer, through shared memory: ``shm://NAME``.

    Parameters and errors are those of ``WireDevice``.
    """

    def _connect(self) -> SharedMemoryTransport:
        url, paths = self.url, _paths(self.url)
        with ExitStack() as on_failure:
            try:
                theirs = _Mailbox(paths[0])
                on_failure.callback(theirs.close)
                own = _Mailbox(paths[1])
                on_failure.callback(own.close)
            except FileNotFoundError:
                hint = self._hint.format(url=url)
                raise ConnectionError(f"{url}: no device answers; {hint}") from None
            except PermissionError as error:
                raise ConnectionError(
                    f"{url}: {error.filename} belongs to another user, who must run the loop too"
                ) from None
            if not own.lock():
                raise ConnectionError(f"{url}: another session is active there; end it first")
            on_failure.pop_all()
        self._boxes = own, theirs
        return _transport(own, theirs)

    def _release(self) -> None:
        # The device reads the goodbye within a tick, and must do so before the next loop's hello
        # replaces it. Closing takes at most 0.1 s (chosen by hand), even if ticks are longer.
        time.sleep(min(2.0 * self.dt, 0.1))
        for box in self._boxes:
            box.close()


class SharedMemoryListener:
    """The device's end of the wire; it takes over the files of a rig that was killed."""

    def __init__(self, url: str) -> None:
        self._paths = _paths(url)
        self.url = url
        try:
            own = _Mailbox(self._paths[0], create=True)
            if not own.lock():
                own.close()
                raise ValueError(
                    f"device = {url!r}: another rig has this name; give another, or end that rig"
                )
            theirs = _Mailbox(self._paths[1], create=True)
        except PermissionError as error:
            raise ValueError(
                f"device = {url!r}: {error.filename} belongs to another user; give another name"
            ) from None
        self._boxes = own, theirs
        self.transport = _transport(own, theirs)

    def close(self) -> None:
        """Remove the mailboxes; a loop that still has them open receives nothing more."""
        for path in self._paths:
            path.unlink(missing_ok=True)
        for box in self._boxes:
            box.close()
        self._paths = ()


class _Mailbox:
    """A file in memory, as words."""

    def __init__(self, path: Path, create: bool = False) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if create else 0), 0o600)
        try:
            if create:
                os.ftruncate(self._file, 8 * _WORDS)
            self._memory = mmap.mmap(self._file, 8 * _WORDS)
        except (OSError, ValueError):  # a file that was created just now has no size yet
            os.close(self._file)
            raise FileNotFoundError(path) from None
        self.words = np.frombuffer(self._memory, dtype=np.int64)

    def lock(self) -> bool:
        """Become its writer; return False if another process, or another object here, is."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Release the file and its lock; the memory stays until its last array is gone."""
        if self._file >= 0:
            # The memory map has a copy of the descriptor, which would keep the lock.
            fcntl.flock(self._file, fcntl.LOCK_UN)
            os.close(self._file)
            self._file = -1


def _transport(own: _Mailbox, theirs: _Mailbox) -> SharedMemoryTransport:
    seen = theirs.words[::_SLOT].copy()
    return SharedMemoryTransport(own.words, theirs.words, seen, system_clock())


def _paths(url: str) -> tuple[Path, ...]:
    """Return the paths of the two mailboxes of ``shm://NAME``: measurements, commands."""
    found = re.fullmatch(r"shm://([A-Za-z0-9_.-]{1,100})", url)
    if found is None:
        raise ValueError(
            f"device = {url!r}: must be shm://NAME; the name may have letters, digits, and . _ -"
        )
    if not _FOLDER.is_dir():
        raise ValueError(f"device = {url!r}: this system has no {_FOLDER}; give udp://HOST:PORT")
    return tuple(_FOLDER / f"quell-{found[1]}-{kind}" for kind in ("measurements", "commands"))
