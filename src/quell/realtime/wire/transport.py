"""Functions that carry frames: each kind of wire implements them for its transport.

A transport is a NamedTuple; ``receive``, ``send`` and ``wait_for_frame`` are registered for its
type, and ``reply``, ``connect_to_sender`` and ``is_from_other_side`` if anyone can send to it. See
``udp.py`` for a complete example. None of these functions allocates memory, and only
``wait_for_frame`` waits.
"""

from __future__ import annotations

from typing import Any

from quell.kernels.dispatch import generic, generic_with_default
from quell.realtime.wire.frames import Buffer

MOST_AT_ONCE = 1024
"""Packets read at once: a sender that floods the wire can't keep the other side from its cycle.
Chosen by hand; not tuned further."""


@generic
def receive(transport: Any, frame: Buffer) -> int:
    """Write the next packet to ``frame``; return its length in bytes, or -1 if none is waiting."""
    raise TypeError


@generic
def send(transport: Any, frame: Buffer) -> int:
    """Send a frame to the other side; return 0, or another number if it could not be sent."""
    raise TypeError


@generic
def wait_for_frame(transport: Any, nanoseconds: int) -> None:
    """Wait until a packet may have come, at most ``nanoseconds`` [ns]."""
    raise TypeError


@generic_with_default
def reply(transport: Any, frame: Buffer) -> int:
    """Send a frame to the sender of the packet received last; return the same as ``send``."""
    return send(transport, frame)


@generic_with_default
def connect_to_sender(transport: Any) -> None:
    """Make the sender of the packet received last the other side; nothing if there is only one."""


@generic_with_default
def is_from_other_side(transport: Any) -> bool:
    """Return whether the packet received last came from the other side; True if only it can send.

    The other side is the sender for which ``connect_to_sender`` was called last.
    """
    return True
