"""Frames over UDP: one datagram each.

``frames`` handles datagrams that are lost, duplicated or overtaken. The device listens at
``udp://HOST:PORT``; the loop uses any free port.
"""

from __future__ import annotations

import socket
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from quell.realtime.system.libc import external
from quell.realtime.wire.descriptor import Descriptor, descriptor, wait_readable
from quell.realtime.wire.device import WireDevice
from quell.realtime.wire.frames import LENGTH, Buffer
from quell.realtime.wire.transport import (
    connect_to_sender,
    is_from_other_side,
    receive,
    reply,
    send,
    wait_for_frame,
)

# Room for a sockaddr_in (16 bytes) or a sockaddr_in6 (28 bytes); its length is stored behind it.
_ADDRESS = 32
# Size of the receive buffer [bytes]: at 1 kHz about half a second of datagrams with the system's
# overhead, computed and not measured.
_RECEIVE_BUFFER = 1 << 20

_recvfrom = external("recvfrom", "long", "int", "address", "long", "int", "address", "address")
_sendto = external("sendto", "long", "int", "address", "long", "int", "address", "int")


class UdpTransport(NamedTuple):
    """One end of a UDP wire; make it with ``udp_transport``."""

    socket: Descriptor
    other: NDArray[np.int32]
    """Address of the other side and its length; the length is 0 if the socket is connected."""
    sender: NDArray[np.int32]  # address and length of the sender of the last datagram
    other_at: int
    sender_at: int


def udp_transport(own: socket.socket) -> UdpTransport:
    """Return the transport of a non-blocking socket."""
    other, sender = (np.zeros(_ADDRESS // 4 + 1, dtype=np.int32) for _ in range(2))
    return UdpTransport(
        descriptor(own.fileno()), other, sender, other.ctypes.data, sender.ctypes.data
    )


@receive.register(UdpTransport)
def _receive(udp: UdpTransport, frame: Buffer) -> int:
    udp.sender[_ADDRESS // 4] = _ADDRESS
    size, length_at = frame.bytes.size, udp.sender_at + _ADDRESS
    return _recvfrom(udp.socket.fd, frame.address, size, 0, udp.sender_at, length_at)


@send.register(UdpTransport)
def _send(udp: UdpTransport, frame: Buffer) -> int:
    size = udp.other[_ADDRESS // 4]
    sent = _sendto(udp.socket.fd, frame.address, LENGTH, 0, udp.other_at if size > 0 else 0, size)
    return 0 if sent == LENGTH else 1


@reply.register(UdpTransport)
def _reply(udp: UdpTransport, frame: Buffer) -> int:
    size = udp.sender[_ADDRESS // 4]
    sent = _sendto(udp.socket.fd, frame.address, LENGTH, 0, udp.sender_at, size)
    return 0 if sent == LENGTH else 1


@connect_to_sender.register(UdpTransport)
def _connect_to_sender(udp: UdpTransport) -> None:
    for i in range(udp.other.size):
        udp.other[i] = udp.sender[i]


@is_from_other_side.register(UdpTransport)
def _is_from_other_side(udp: UdpTransport) -> bool:
    """Compare host and port; the kernel sets the unused bytes of an address to zero."""
    length = udp.sender[_ADDRESS // 4]
    differences = int(udp.other[_ADDRESS // 4] != length)
    for i in range(length // 4):
        differences += int(udp.other[i] != udp.sender[i])
    return differences == 0


@wait_for_frame.register(UdpTransport)
def _wait_for_frame(udp: UdpTransport, nanoseconds: int) -> None:
    wait_readable(udp.socket, nanoseconds)


class UdpDevice(WireDevice):
    """A device that listens at a UDP port, for example ``udp://127.0.0.1:5005``.

    It may be ``quell rig`` or a microcontroller, on this computer or another. Parameters and errors
    are those of ``WireDevice``.
    """

    def _connect(self) -> UdpTransport:
        family, address = resolved(self.url)
        if address[1] == 0:
            raise ValueError(f"device = {self.url!r}: must have a port from 1 to 65535")
        self._socket = _socket(family)
        try:
            self._socket.connect(address)
        except OSError as error:
            self._socket.close()
            raise ConnectionError(f"{self.url}: can't be reached ({error.strerror})") from None
        return udp_transport(self._socket)

    def _release(self) -> None:
        self._socket.close()


class UdpListener:
    """The device's end: a port at which it listens. Port 0 takes a free one, see ``url``."""

    def __init__(self, url: str) -> None:
        family, address = resolved(url)
        self.socket = _socket(family)
        try:
            self.socket.bind(address)
        except OSError as error:
            self.socket.close()
            raise ValueError(
                f"device = {url!r}: can't listen there ({error.strerror}); "
                "give another port, or end the program that uses it"
            ) from None
        host, port = self.socket.getsockname()[:2]
        self.url = f"udp://[{host}]:{port}" if ":" in host else f"udp://{host}:{port}"
        self.transport = udp_transport(self.socket)

    def close(self) -> None:
        """Release the port."""
        self.socket.close()


def resolved(url: str) -> tuple[int, tuple[Any, ...]]:
    """Return family and address of ``udp://HOST:PORT``; raise a ``ValueError`` for others."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    extra = host is None or parts.path or parts.query or parts.fragment or parts.username
    if extra or port is None or parts.scheme != "udp":
        raise ValueError(
            f"device = {url!r}: must be udp://HOST:PORT with a port up to 65535, "
            "for example udp://127.0.0.1:5005"
        )
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", "no such name")
        raise ValueError(f"device = {url!r}: the host {host!r} is unknown ({why})") from None
    return found[0][0], found[0][4]


def _socket(family: int) -> socket.socket:
    made = socket.socket(family, socket.SOCK_DGRAM)
    made.setblocking(False)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    return made
