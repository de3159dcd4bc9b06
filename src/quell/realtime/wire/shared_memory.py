"""Frames through shared memory, between processes of one computer.

A wire has two mailboxes, files in memory: ``quell-NAME-measurements`` and ``quell-NAME-commands``.
``mailbox`` opens them and refuses those of other users. A mailbox consists of slots of 48 bytes: a
counter, twice the number of frames written, and a frame (40 bytes). Slot 0 has the newest hello,
welcome or goodbye, slot 1 the newest measurement or command, and the others the last ``HISTORY``
measurements or commands: the frame that has the counter 2n in slot 1 is also in the slot
2 + n mod ``HISTORY``. So a reader that is late misses none. A mailbox has one writer, whose process
locks it as long as it lives. So two loops can't write to one mailbox, and a new rig can take over
the mailboxes of a rig that was killed.

*Writing* (a sequence lock, see Boehm, "Can seqlocks get along with programming language memory
models?", MSPC 2012): write the slot of the history; make the counter odd, write the five words of
the frame, make the counter even. *Reading:* read the counter, the words and the counter again; try
again if the counter was odd or has changed. A slot of the history is valid if it has the expected
counter, and if the newest counter, read after it, shows that its writer has not come round to it.

The files are read and written with ``pread`` and ``pwrite``, not through mapped memory: access to
a mapped file that another program has truncated ends the process (SIGBUS), while ``pread`` returns
less than it should, which counts as no frame. On tmpfs a call takes 0.2 to 0.3 µs. Each call is a
barrier for the order of memory accesses, because the kernel locks the file's page.
"""

from __future__ import annotations

import re
import time
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.realtime.system.clock import SystemClock, now, system_clock, wait_until
from quell.realtime.system.libc import external
from quell.realtime.wire.device import WireDevice
from quell.realtime.wire.frames import HELLO, LENGTH, Buffer
from quell.realtime.wire.mailbox import Mailbox, RefusedMailboxError
from quell.realtime.wire.transport import receive, send, wait_for_frame

HISTORY = 64
"""Measurements or commands that a mailbox keeps: more than the 50 behind which a frame is stale."""
SLOT = 8 + LENGTH
"""Bytes of a slot."""
SIZE = (2 + HISTORY) * SLOT
"""Bytes of a mailbox."""
_FOLDER = Path("/dev/shm")
# Time between two looks for a frame while waiting [ns]. Chosen by hand; not tuned further.
_POLL_EVERY = 20_000
# Attempts to read a frame during a write, of 0.7 µs each; after these its writer has been
# interrupted or has died. Chosen by hand.
_ATTEMPTS = 20

_pread = external("pread", "long", "int", "address", "long", "long")
_pwrite = external("pwrite", "long", "int", "address", "long", "long")


class SharedMemoryTransport(NamedTuple):
    """One end of a wire through shared memory."""

    own: int  # file descriptor of the mailbox to write to
    others: int  # file descriptor of the mailbox to read from
    counts: NDArray[np.int64]
    """Counters of the frames read last and of those written last, in slot 0 and in slot 1, and
    whether the files are open (5,)."""
    words: NDArray[np.int64]  # a slot as read, and as written (2, 6)
    read_at: int  # addresses of both
    written_at: int
    clock: SystemClock


_SEEN, _WRITTEN, _OPEN = 0, 2, 4


@receive.register(SharedMemoryTransport)
def _receive(shared: SharedMemoryTransport, frame: Buffer) -> int:
    if shared.counts[_OPEN] != 0:
        for slot in range(2):
            if _read_next(shared, slot, frame):
                return LENGTH
    return -1


@kernel
def _read_next(shared: SharedMemoryTransport, slot: int, frame: Buffer) -> bool:
    """Read the next frame of slot 0 or 1 that was not read yet; return whether there is one."""
    for _ in range(_ATTEMPTS):
        count, seen = _newest(shared, slot), shared.counts[_SEEN + slot]
        if count <= 0 or count == seen:
            return False
        if count % 2 != 0:
            continue
        shared.counts[_SEEN + slot] = count
        if slot == 1 and 2 < count - seen < 2 * HISTORY and _read_history(shared, seen + 2, frame):
            shared.counts[_SEEN + slot] = seen + 2
            return True
        if (
            _pread(shared.others, frame.address, LENGTH, slot * SLOT + 8) == LENGTH
            and _newest(shared, slot) == count
        ):
            return True
        shared.counts[_SEEN + slot] = seen
    return False


@kernel
def _read_history(shared: SharedMemoryTransport, count: int, frame: Buffer) -> bool:
    """Read the frame that had this counter; return whether it is still there."""
    offset = (2 + count // 2 % HISTORY) * SLOT
    if _pread(shared.others, shared.read_at, SLOT, offset) != SLOT:
        return False
    # The writer changes the slot of the frame n + HISTORY before the newest counter shows it.
    if shared.words[0, 0] != count or not 0 <= _newest(shared, 1) - count < 2 * (HISTORY - 1):
        return False
    for i in range(LENGTH // 8):
        frame.longs[i] = shared.words[0, 1 + i]
    return True


@kernel
def _newest(shared: SharedMemoryTransport, slot: int) -> int:
    """Return the counter of slot 0 or 1; zero before the first frame, −1 if the file is short."""
    if _pread(shared.others, shared.read_at, 8, slot * SLOT) != 8:
        return -1
    return shared.words[0, 0]


@send.register(SharedMemoryTransport)
def _send(shared: SharedMemoryTransport, frame: Buffer) -> int:
    if shared.counts[_OPEN] == 0:
        return 1
    slot = 0 if frame.bytes[3] >= HELLO else 1
    # The counter is odd already if the last writer was killed while it wrote.
    writing = shared.counts[_WRITTEN + slot] | 1
    count = writing + 1
    words = shared.words[1]
    for i in range(LENGTH // 8):
        words[1 + i] = frame.longs[i]
    written = 0
    if slot == 1:
        words[0] = count
        offset = (2 + count // 2 % HISTORY) * SLOT
        written += _pwrite(shared.own, shared.written_at, SLOT, offset) - SLOT
    words[0] = writing
    written += _pwrite(shared.own, shared.written_at, 8, slot * SLOT) - 8
    written += _pwrite(shared.own, shared.written_at + 8, LENGTH, slot * SLOT + 8) - LENGTH
    words[0] = count
    written += _pwrite(shared.own, shared.written_at, 8, slot * SLOT) - 8
    shared.counts[_WRITTEN + slot] = count
    return 0 if written == 0 else 1


@wait_for_frame.register(SharedMemoryTransport)
def _wait_for_frame(shared: SharedMemoryTransport, nanoseconds: int) -> None:
    time_now = now(shared.clock)
    end = time_now + nanoseconds
    while time_now < end and not (_has_news(shared, 0) or _has_news(shared, 1)):
        time_now = wait_until(shared.clock, min(time_now + _POLL_EVERY, end))


@kernel
def _has_news(shared: SharedMemoryTransport, slot: int) -> bool:
    """Return whether a complete frame in slot 0 or 1 was not read yet."""
    count = _newest(shared, slot)
    return count > 0 and count % 2 == 0 and count != shared.counts[_SEEN + slot]


class SharedMemoryDevice(WireDevice):
    """A device in another process of this computer, through shared memory: ``shm://NAME``.

    Parameters and errors are those of ``WireDevice``.
    """

    def _connect(self) -> SharedMemoryTransport:
        url, paths = self.url, _paths(self.url)
        with ExitStack() as on_failure:
            try:
                theirs = Mailbox(paths[0], SIZE)
                on_failure.callback(theirs.close)
                own = Mailbox(paths[1], SIZE)
                on_failure.callback(own.close)
            except FileNotFoundError:
                hint = self._hint.format(url=url)
                raise ConnectionError(f"{url}: no device answers; {hint}") from None
            except RefusedMailboxError as error:
                raise ConnectionError(
                    f"{url}: {error}; run the rig and the loop as one user"
                ) from None
            if not own.lock():
                raise ConnectionError(f"{url}: another session is active there; end it first")
            on_failure.pop_all()
        self._boxes = own, theirs
        self._transport = _transport(own, theirs)
        return self._transport

    def _release(self) -> None:
        # The device reads the goodbye within a tick, and must do so before the next loop's hello
        # replaces it. Closing takes at most 0.1 s (chosen by hand), even if ticks are longer.
        time.sleep(min(2.0 * self.dt, 0.1))
        _close(self._transport, self._boxes)


class SharedMemoryListener:
    """The device's end of the wire; it takes over the files of a rig that was killed."""

    def __init__(self, url: str) -> None:
        self._paths = _paths(url)
        self.url = url
        with ExitStack() as on_failure:
            try:
                own = Mailbox(self._paths[0], SIZE, create=True)
                on_failure.callback(own.close)
                if not own.lock():
                    raise ValueError(
                        f"device = {url!r}: another rig has this name; "
                        "give another, or end that rig"
                    )
                own.enlarge()
                theirs = Mailbox(self._paths[1], SIZE, create=True)
                on_failure.callback(theirs.close)
                theirs.enlarge()
            except (RefusedMailboxError, OSError) as error:
                raise ValueError(
                    f"device = {url!r}: {error}; give another name, or remove that file"
                ) from None
            on_failure.pop_all()
        self._boxes = own, theirs
        self.transport = _transport(own, theirs)

    def close(self) -> None:
        """Remove the mailboxes; a loop that still has them open receives nothing more."""
        for path in self._paths:
            path.unlink(missing_ok=True)
        _close(self.transport, self._boxes)
        self._paths = ()


def _transport(own: Mailbox, theirs: Mailbox) -> SharedMemoryTransport:
    """Return the transport; frames that are in the mailbox already count as read."""
    counts = [box.word(slot * SLOT) for box in (theirs, own) for slot in range(2)]
    words = np.zeros((2, SLOT // 8), dtype=np.int64)
    read_at = words.ctypes.data
    return SharedMemoryTransport(
        *(own.file, theirs.file, np.array([*counts, 1]), words),
        *(read_at, read_at + SLOT, system_clock()),
    )


def _close(transport: SharedMemoryTransport, boxes: tuple[Mailbox, ...]) -> None:
    """Close the files; the transport must not use their descriptors, which may be given away."""
    transport.counts[_OPEN] = 0
    for box in boxes:
        box.close()


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
