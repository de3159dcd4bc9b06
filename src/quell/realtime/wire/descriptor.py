"""Wait for a file descriptor, from compiled code and from Python."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.realtime.system.libc import external

_SECOND = 1_000_000_000
# From poll.h: data can be read; error, hang-up or an invalid descriptor.
_POLLIN = 0x1
_GONE = 0x38
# Where the 16 bits of ``revents`` start in a pollfd that is read as one little-endian word.
_REVENTS = 48

_ppoll = external("ppoll", "int", "address", "long", "address", "address")


class Descriptor(NamedTuple):
    """A file descriptor to wait for; make it with ``descriptor``."""

    fd: int
    words: NDArray[np.int64]  # A pollfd, seconds and nanoseconds (3,)
    address: int  # address of ``words``


def descriptor(fd: int) -> Descriptor:
    """Return a ``Descriptor`` for the file descriptor ``fd``."""
    words = np.zeros(3, dtype=np.int64)
    words[:1].view(np.int32)[0] = fd
    words[:1].view(np.int16)[2] = _POLLIN
    return Descriptor(fd, words, words.ctypes.data)


@kernel
def wait_readable(descriptor: Descriptor, nanoseconds: int) -> None:
    """Wait until there is something to read, at most ``nanoseconds`` [ns]."""
    descriptor.words[1] = nanoseconds // _SECOND
    descriptor.words[2] = nanoseconds % _SECOND
    _ppoll(descriptor.address, 1, descriptor.address + 8, 0)


@kernel
def is_gone(descriptor: Descriptor) -> bool:
    """Return whether the last wait found that the descriptor can't be used any more."""
    return (descriptor.words[0] >> _REVENTS & _GONE) != 0


@kernel
def pause(descriptor: Descriptor, nanoseconds: int) -> None:
    """Sleep for less than a second [ns], whatever the descriptor does."""
    descriptor.words[1] = 0
    descriptor.words[2] = nanoseconds
    _ppoll(0, 0, descriptor.address + 8, 0)
