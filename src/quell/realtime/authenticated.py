"""Frames with a tag, which only those who know a key can make: a transport around another one.

Whoever can send to a port can drive the machine: a CRC protects from noise, not from people. With a
key each packet is a frame and 8 bytes more, its tag::

    tag = SipHash-2-4(key, frame ‖ nonce)

(J.-P. Aumasson & D. J. Bernstein, *SipHash: a fast short-input PRF*, Indocrypt 2012). A packet
without the right tag is dropped, so a tag that is guessed passes with a chance of 2⁻⁶⁴.

*Packets of former sessions* are not taken either. The device draws a nonce for each session that a
hello asks for, and sends it in a challenge; all other frames of the session need it, so those that
somebody has recorded have another one. Within a session ``wire.accept`` takes no number twice, and
none that is older. ::

    loop    hello(session), nonce 0   →
                                      ←   challenge(session, nonce), nonce 0     device
            hello(session), nonce     →
                                      ←   welcome, measurements …, nonce

The device remembers the nonces of the last eight sessions that were asked for, and never replaces
that of the one whose frames it takes.

What is not in it: nothing is secret, y and u can be read. Who can drop packets can stop the loop,
and the watchdog sets u to zero.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.realtime.system import external
from quell.realtime.wire import (
    HELLO,
    LENGTH,
    Buffer,
    buffer,
    connect_to_sender,
    is_from_other_side,
    receive,
    reply,
    send,
    wait_for_frame,
    write_frame,
)

CHALLENGE = 7
"""Kind of the frame in which the device gives the nonce of a session, as its value."""
TAG = 8
"""Bytes of a tag."""

_KEY = re.compile(r"[0-9a-fA-F]{32}")
_KNOWN = 8
# Packets that are answered or dropped before a call returns. Chosen by hand.
_MOST = 16
_CURRENT, _NEXT, _REFUSED = range(3)
_U, _LAST = np.uint64, 2**64 - 1

_getrandom = external("getrandom", "long", "address", "long", "int")


def read_key(path: str | os.PathLike[str]) -> NDArray[np.uint64]:
    """Return the key in a file: 32 hexadecimal digits.

    Raises
    ------
    ValueError
        for a file that can't be read, that others may read or write, or with anything else in it.
    """
    file = Path(path)
    try:
        mode, text = file.stat().st_mode, file.read_text("ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text"
        raise ValueError(f"key = {str(path)!r}: can't be read ({why})") from None
    if stat.S_IMODE(mode) & 0o077:
        raise ValueError(
            f"key = {str(path)!r}: others may use the file (mode {stat.S_IMODE(mode):o}); it must "
            f"be yours alone: chmod 600 {path}"
        )
    if not _KEY.fullmatch(text):
        raise ValueError(
            f"key = {str(path)!r}: must have 32 hexadecimal digits, as from "
            f"(umask 077; openssl rand -hex 16 > {path})"
        )
    return np.frombuffer(bytes.fromhex(text), dtype="<u8").astype(np.uint64)


class AuthenticTransport(NamedTuple):
    """One end of a wire whose packets have tags; make it with ``authenticated``."""

    inner: Any
    key: NDArray[np.uint64]  # (2,)
    is_device: bool
    sessions: NDArray[np.int64]  # that have a nonce, or 0 (8,)
    nonces: NDArray[np.uint64]  # (8,)
    counts: NDArray[np.int64]  # place of the session in use, next place, packets refused (3,)
    words: NDArray[np.uint64]  # the state of SipHash (4,)
    drawn: NDArray[np.uint64]  # (1,)
    drawn_at: int
    answer: Buffer  # a challenge


def authenticated(inner: Any, key: NDArray[np.uint64], *, is_device: bool) -> AuthenticTransport:
    """Return a transport that sends and takes frames with a tag through another one."""
    drawn = np.zeros(1, dtype=np.uint64)
    return AuthenticTransport(
        inner=inner,
        key=key,
        is_device=is_device,
        sessions=np.zeros(_KNOWN, dtype=np.int64),
        nonces=np.zeros(_KNOWN, dtype=np.uint64),
        counts=np.array([-1, 0, 0]),
        words=np.zeros(4, dtype=np.uint64),
        drawn=drawn,
        drawn_at=drawn.ctypes.data,
        answer=buffer(),
    )


def wrapping_sum(one: Any, other: Any) -> Any:
    """Return a sum modulo 2⁶⁴: NumPy warns of what is meant here."""
    return _U((int(one) + int(other)) & _LAST)


@overload(wrapping_sum, strict=False)
def _wrapping_sum(one: Any, other: Any) -> Any:
    return lambda one, other: one + other


@kernel
def _turned(x: Any, bits: int) -> Any:
    return (x << _U(bits)) | (x >> _U(64 - bits))


@kernel
def _rounds(v: NDArray[np.uint64], count: int) -> None:
    for _ in range(count):
        v[0] = wrapping_sum(v[0], v[1])
        v[1] = _turned(v[1], 13) ^ v[0]
        v[0] = _turned(v[0], 32)
        v[2] = wrapping_sum(v[2], v[3])
        v[3] = _turned(v[3], 16) ^ v[2]
        v[0] = wrapping_sum(v[0], v[3])
        v[3] = _turned(v[3], 21) ^ v[0]
        v[2] = wrapping_sum(v[2], v[1])
        v[1] = _turned(v[1], 17) ^ v[2]
        v[2] = _turned(v[2], 32)


@kernel
def siphash(
    key: NDArray[np.uint64], words: NDArray[np.uint32], size: int, v: NDArray[np.uint64]
) -> Any:
    """Return SipHash-2-4 of the first ``size`` bytes of ``words``, a multiple of eight.

    ``v`` is room for its state (4,).
    """
    v[0] = key[0] ^ _U(0x736F6D6570736575)
    v[1] = key[1] ^ _U(0x646F72616E646F6D)
    v[2] = key[0] ^ _U(0x6C7967656E657261)
    v[3] = key[1] ^ _U(0x7465646279746573)
    for i in range(size // 8):
        word = _U(words[2 * i]) | (_U(words[2 * i + 1]) << _U(32))
        v[3] = v[3] ^ word
        _rounds(v, 2)
        v[0] = v[0] ^ word
    last = _U(size % 256) << _U(56)
    v[3] = v[3] ^ last
    _rounds(v, 2)
    v[0] = v[0] ^ last
    v[2] = v[2] ^ _U(0xFF)
    _rounds(v, 4)
    return v[0] ^ v[1] ^ v[2] ^ v[3]


@kernel
def _tag(wire: AuthenticTransport, frame: Buffer, size: int, nonce: Any) -> Any:
    """Return the tag of a frame; the nonce stands behind the frame then."""
    _put(frame, size, nonce)
    return siphash(wire.key, frame.words, size + TAG, wire.words)


@kernel
def _put(frame: Buffer, size: int, value: Any) -> None:
    """Write 64 bits behind a frame of ``size`` bytes."""
    frame.words[size // 4] = value & _U(0xFFFFFFFF)
    frame.words[size // 4 + 1] = value >> _U(32)


@kernel
def _behind(frame: Buffer, size: int) -> Any:
    """Return the 64 bits behind a frame of ``size`` bytes."""
    return _U(frame.words[size // 4]) | (_U(frame.words[size // 4 + 1]) << _U(32))


@kernel
def _place_of(wire: AuthenticTransport, session: int) -> int:
    """Return where the nonce of a session is; −1 without one."""
    found = -1
    for i in range(wire.sessions.size):
        if session != 0 and wire.sessions[i] == session:
            found = i
    return found


@kernel
def _remember(wire: AuthenticTransport, session: int, nonce: Any) -> None:
    """Keep the nonce of a session in the place of the oldest one that is not in use."""
    if wire.counts[_NEXT] == wire.counts[_CURRENT]:
        wire.counts[_NEXT] = (wire.counts[_NEXT] + 1) % wire.sessions.size
    place = wire.counts[_NEXT]
    wire.sessions[place], wire.nonces[place] = session, nonce
    wire.counts[_NEXT] = (place + 1) % wire.sessions.size


@kernel
def _with_tag(wire: AuthenticTransport, frame: Buffer) -> int:
    """Write the tag behind a frame to send; return the length of the frame without it."""
    size = frame.length[0]
    place = _place_of(wire, int(frame.words[1]))
    nonce = wire.nonces[place] if place >= 0 else _U(0)
    _put(frame, size, _tag(wire, frame, size, nonce))
    frame.length[0] = size + TAG
    return size


@kernel
def _take(wire: AuthenticTransport, frame: Buffer, packet: int) -> int:
    """Return the length of the frame in a packet; 0 for one to refuse, −1 for a challenge."""
    size = packet - TAG
    if size < LENGTH or size % 8 != 0 or packet > frame.bytes.size:
        return 0
    given, session = _behind(frame, size), int(frame.words[1])
    place = _place_of(wire, session)
    nonce = wire.nonces[place] if place >= 0 else _U(0)
    if nonce != _U(0) and given == _tag(wire, frame, size, nonce):
        if frame.bytes[3] != HELLO:
            wire.counts[_CURRENT] = place
        return size
    if given != _tag(wire, frame, size, _U(0)):
        return 0
    if wire.is_device and frame.bytes[3] == HELLO:
        if place < 0:
            if _getrandom(wire.drawn_at, 8, 0) != 8:
                return 0
            nonce = wire.drawn[0]
            _remember(wire, session, nonce)
        _challenge(wire, session, nonce)
        return -1
    if not wire.is_device and frame.bytes[3] == CHALLENGE and size == LENGTH:
        # Of a session that this side has asked for: it has a place without a nonce.
        if place >= 0 and nonce == _U(0):
            wire.nonces[place] = _U(frame.words[6]) | (_U(frame.words[7]) << _U(32))
        return -1
    return 0


@kernel
def _challenge(wire: AuthenticTransport, session: int, nonce: Any) -> None:
    """Answer a hello with the nonce of its session."""
    out = wire.answer
    write_frame(out, CHALLENGE, session, 0, 0, 0, 0.0, 0)
    out.words[6] = nonce & _U(0xFFFFFFFF)
    out.words[7] = nonce >> _U(32)
    _put(out, LENGTH, _tag(wire, out, LENGTH, _U(0)))
    out.length[0] = LENGTH + TAG
    reply(wire.inner, out)


@receive.register(AuthenticTransport)
def _receive(wire: AuthenticTransport, frame: Buffer) -> int:
    for _ in range(_MOST):
        packet = receive(wire.inner, frame)
        if packet < 0:
            return packet
        size = _take(wire, frame, packet)
        if size == 0:
            wire.counts[_REFUSED] += 1
        if size >= 0:
            return size
    return -1


@send.register(AuthenticTransport)
def _send(wire: AuthenticTransport, frame: Buffer) -> int:
    session = int(frame.words[1])
    if not wire.is_device and frame.bytes[3] == HELLO and _place_of(wire, session) < 0:
        _remember(wire, session, _U(0))
    size = _with_tag(wire, frame)
    failed = send(wire.inner, frame)
    frame.length[0] = size
    return failed


@reply.register(AuthenticTransport)
def _reply(wire: AuthenticTransport, frame: Buffer) -> int:
    size = _with_tag(wire, frame)
    failed = reply(wire.inner, frame)
    frame.length[0] = size
    return failed


@connect_to_sender.register(AuthenticTransport)
def _connect_to_sender(wire: AuthenticTransport) -> None:
    connect_to_sender(wire.inner)


@is_from_other_side.register(AuthenticTransport)
def _is_from_other_side(wire: AuthenticTransport) -> bool:
    return is_from_other_side(wire.inner)


@wait_for_frame.register(AuthenticTransport)
def _wait_for_frame(wire: AuthenticTransport, nanoseconds: int) -> None:
    wait_for_frame(wire.inner, nanoseconds)
