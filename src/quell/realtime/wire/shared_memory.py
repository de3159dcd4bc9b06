"""Frames through shared memory, between processes of one computer.

A mailbox is a file in memory with two slots, each a count and a frame: one for hello, welcome and goodbye, one for measurements or
commands, of which the newest replaces the last. It has one writer, and whoever reads it looks at the counts. Two of them are a wire:
``quell-NAME-measurements`` and ``quell-NAME-commands``. Each is locked by the process that writes it for as long as that lives: so a rig
that was killed leaves nothing that its successor can't take over, and two loops can't write one mailbox.

*How it is written* (a sequence lock, see Boehm, "Can seqlocks get along with programming language memory models?", MSPC 2012): the count
is made odd, then the five words of the frame are stored, then the count is made even; each store is a release. The reader loads the count,
the words and the count again, each an acquire; where the count was odd or has changed it tries again.

======  ====  ===============================================
offset  size  what
======  ====  ===============================================
0       8     count, twice the hellos, welcomes and goodbyes
8       40    the newest of them
48      8     count, twice the measurements or commands
56      40    the newest of them
======  ====  ===============================================
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

from quell import checks
from quell.kernels.dispatch import kernel
from quell.realtime.system.atomics import load_acquire, store_release
from quell.realtime.system.clock import SystemClock, now, system_clock, wait_until
from quell.realtime.wire.frames import HELLO, LENGTH, Buffer
from quell.realtime.wire.transport import connect_to_sender, receive, reply, send, wait_for_frame
from quell.realtime.wire.wire import WireDevice

_SLOT = 1 + LENGTH // 8
_WORDS = 2 * _SLOT
_FOLDER = Path("/dev/shm")
# How often it looks for news while it waits [ns].
_LOOK_EVERY = 20_000
# Whoever is writing is done after so many looks, or is gone.
_TRIES = 1000


class SharedMemoryTransport(NamedTuple):
    """One end of a wire through shared memory."""

    own: NDArray[np.int64]
    """The mailbox that is written here (12,)."""
    others: NDArray[np.int64]
    """The one that is read (12,)."""
    seen: NDArray[np.int64]
    """Counts of the newest frames that were read (2,)."""
    clock: SystemClock


@receive.register(SharedMemoryTransport)
def _receive(transport: SharedMemoryTransport, frame: Buffer) -> int:
    for slot in range(2):
        if _look(transport, slot, frame):
            return LENGTH
    return -1


@kernel
def _look(transport: SharedMemoryTransport, slot: int, frame: Buffer) -> bool:
    """Take what is new in a slot; tell whether something is."""
    first = slot * _SLOT
    for _ in range(_TRIES):
        count = load_acquire(transport.others, first)
        if count == transport.seen[slot]:
            return False
        if count % 2 == 0:
            for i in range(LENGTH // 8):
                frame.longs[i] = load_acquire(transport.others, first + 1 + i)
            if load_acquire(transport.others, first) == count:
                transport.seen[slot] = count
                return True
    return False


@send.register(SharedMemoryTransport)
def _send(transport: SharedMemoryTransport, frame: Buffer) -> int:
    first = 0 if frame.bytes[3] >= HELLO else _SLOT
    writing = (
        load_acquire(transport.own, first) | 1
    )  # odd already where the last writer was killed at it
    store_release(transport.own, first, writing)
    for i in range(LENGTH // 8):
        store_release(transport.own, first + 1 + i, frame.longs[i])
    store_release(transport.own, first, writing + 1)
    return 0


@reply.register(SharedMemoryTransport)
def _reply(transport: SharedMemoryTransport, frame: Buffer) -> int:
    return send(transport, frame)


@connect_to_sender.register(SharedMemoryTransport)
def _connect_to_sender(transport: SharedMemoryTransport) -> None:
    pass


@wait_for_frame.register(SharedMemoryTransport)
def _wait_for_frame(transport: SharedMemoryTransport, nanoseconds: int) -> None:
    time_now = now(transport.clock)
    end = time_now + nanoseconds
    while (
        time_now < end
        and load_acquire(transport.others, 0) == transport.seen[0]
        and load_acquire(transport.others, _SLOT) == transport.seen[1]
    ):
        time_now = wait_until(transport.clock, min(time_now + _LOOK_EVERY, end))


class SharedMemoryDevice(WireDevice):
    """A device in another process of this computer, through shared memory.

    Parameters
    ----------
    url
        ``shm://NAME``, as the rig was given it.
    dt
        sample time [s]: that of the device.
    timeout
        how long it may take until the device answers [s].

    Raises
    ------
    ValueError
        for a URL that is not of this form, and a sample time that is not the device's.
    ConnectionError
        where no device answers, or one that is taken.
    """

    def __init__(self, url: str, dt: float, timeout: float = 3.0) -> None:
        measurements, commands = _paths(url)
        checks.positive("dt", dt, "s")
        hint = f"start one with: quell rig --device {url}"
        with ExitStack() as stack:
            try:
                theirs = _Mailbox(measurements)
                stack.callback(theirs.close)
                own = _Mailbox(commands)
            except FileNotFoundError:
                raise ConnectionError(f"{url}: no device answers; {hint}") from None
            except PermissionError as error:
                raise ConnectionError(
                    f"{url}: {error.filename} belongs to another user, who has to run the loop as well"
                ) from None
            stack.pop_all()
        self._boxes = own, theirs
        if not own.lock():
            self._free()
            raise ConnectionError(f"{url}: another session is alive there; end it first")
        super().__init__(url, _transport(own, theirs), dt, timeout, hint)

    def _free(self) -> None:
        if hasattr(
            self, "handle"
        ):  # there was a goodbye: the device is to see it before the next loop's hello takes its place
            time.sleep(min(2.0 * self.dt, 0.1))
        for box in self._boxes:
            box.close()


class SharedMemoryListener:
    """The device's end of a wire through shared memory; what a rig that was killed has left is taken over.

    Raises
    ------
    ValueError
        for a URL that is not ``shm://NAME``, and a name that another rig has.
    """

    def __init__(self, url: str) -> None:
        paths = _paths(url)
        self.url = url
        try:
            own = _Mailbox(paths[0], make=True)
            if not own.lock():
                own.close()
                raise ValueError(
                    f"device = {url!r}: another rig has this name; give another one, or end that rig"
                )
            theirs = _Mailbox(paths[1], make=True)
        except PermissionError as error:
            raise ValueError(
                f"device = {url!r}: {error.filename} belongs to another user; give another name"
            ) from None
        self._boxes = own, theirs
        self._paths: tuple[Path, ...] = paths
        self.transport = _transport(own, theirs)

    def close(self) -> None:
        """Remove the mailboxes; a loop that still has them hears nothing more."""
        for path in self._paths:
            path.unlink(missing_ok=True)
        for box in self._boxes:
            box.close()
        self._paths = ()


class _Mailbox:
    """A file in memory, as words."""

    def __init__(self, path: Path, make: bool = False) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if make else 0), 0o600)
        try:
            if make:
                os.ftruncate(self._file, 8 * _WORDS)
            self._memory = mmap.mmap(self._file, 8 * _WORDS)
        except (OSError, ValueError):  # one that is just being made has no size yet
            os.close(self._file)
            raise FileNotFoundError(path) from None
        self.words = np.frombuffer(self._memory, dtype=np.int64)

    def lock(self) -> bool:
        """Become its writer; False where another process, or another part of this one, is."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Give it, and its lock, free; its memory goes when the last array on it does."""
        if self._file >= 0:
            fcntl.flock(
                self._file, fcntl.LOCK_UN
            )  # the memory has a copy of the descriptor, which would hold it
            os.close(self._file)
            self._file = -1


def _transport(own: _Mailbox, theirs: _Mailbox) -> SharedMemoryTransport:
    return SharedMemoryTransport(
        own.words, theirs.words, theirs.words[::_SLOT].copy(), system_clock()
    )


def _paths(url: str) -> tuple[Path, Path]:
    """Return where the mailboxes of ``shm://NAME`` are."""
    found = re.fullmatch(r"shm://([A-Za-z0-9_.-]{1,100})", url)
    if found is None:
        raise ValueError(
            f"device = {url!r}: must be shm://NAME, of letters, digits, and any of . _ -"
        )
    if not _FOLDER.is_dir():
        raise ValueError(f"device = {url!r}: this system has no {_FOLDER}; give udp://HOST:PORT")
    return _FOLDER / f"quell-{found[1]}-measurements", _FOLDER / f"quell-{found[1]}-commands"
