"""One end of a wire: frames go in and come out. Devices and the rig are written once, over what is declared here.

A transport is a NamedTuple; for its type ``receive``, ``send``, ``reply``, ``connect_to_sender`` and ``wait_for_frame`` are registered: see ``udp.py`` for a
complete example. None of them allocates, and only ``wait_for_frame`` waits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import generic, kernel
from quell.realtime.system.libc import external
from quell.realtime.wire.frames import Buffer

_SECOND = 1_000_000_000
_POLLIN = 1

_ppoll = external("ppoll", "int", "address", "long", "address", "address")


@generic
def receive(transport: Any, frame: Buffer) -> int:
    """Write what came next into ``frame`` and return how many bytes it has; -1 where nothing is waiting."""
    raise TypeError


@generic
def send(transport: Any, frame: Buffer) -> int:
    """Send a frame to the other side; return 0, or another number where it can't be reached."""
    raise TypeError


@generic
def reply(transport: Any, frame: Buffer) -> int:
    """Send a frame to whoever sent what was received last; return as ``send``."""
    raise TypeError


@generic
def connect_to_sender(transport: Any) -> None:
    """Make whoever sent what was received last the other side."""
    raise TypeError


@generic
def wait_for_frame(transport: Any, nanoseconds: int) -> None:
    """Wait until something may have come, at most so long [ns]."""
    raise TypeError


class Descriptor(NamedTuple):
    """A file descriptor that can be waited for; make it with ``descriptor``."""

    fd: int
    words: NDArray[np.int64]
    """Room for a pollfd, seconds and nanoseconds (3,)."""
    address: int
    """Of ``words``."""


def descriptor(fd: int) -> Descriptor:
    """Return what ``wait_readable`` needs to know of a file descriptor."""
    words = np.zeros(3, dtype=np.int64)
    words[:1].view(np.int32)[0] = fd
    words[:1].view(np.int16)[2] = _POLLIN
    return Descriptor(fd, words, words.ctypes.data)


@kernel
def wait_readable(descriptor: Descriptor, nanoseconds: int) -> None:
    """Wait until there is something to read, at most so long [ns]."""
    descriptor.words[1] = nanoseconds // _SECOND
    descriptor.words[2] = nanoseconds % _SECOND
    _ppoll(descriptor.address, 1, descriptor.address + 8, 0)
