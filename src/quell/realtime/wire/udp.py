"""Frames over UDP: a datagram each.

Lost, doubled or overtaking datagrams are what ``frames`` is made for. The device listens at ``udp://HOST:PORT``; the loop's own port is any
that is free.
"""

from __future__ import annotations

import socket
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.realtime.system.libc import external
from quell.realtime.wire.frames import LENGTH, Buffer
from quell.realtime.wire.transport import (
    Descriptor,
    connect_to_sender,
    descriptor,
    receive,
    reply,
    send,
    wait_for_frame,
    wait_readable,
)
from quell.realtime.wire.wire import WireDevice

# Room for an address of either family; what comes behind it is its length.
_ADDRESS = 32
# What waits to be read [bytes]: with what the system adds to a datagram, some half a second at 1 kHz.
_QUEUE = 1 << 20

_recvfrom = external("recvfrom", "long", "int", "address", "long", "int", "address", "address")
_sendto = external("sendto", "long", "int", "address", "long", "int", "address", "int")


class UdpTransport(NamedTuple):
    """One end of a UDP wire; make it with ``udp_link``."""

    socket: Descriptor
    other: NDArray[np.int32]
    """Address of the other side and its length; the length is 0 where the socket is connected."""
    sender: NDArray[np.int32]
    """The same of whoever sent what was received last."""
    other_at: int
    sender_at: int


def udp_transport(own: socket.socket) -> UdpTransport:
    """Return the link of a socket that doesn't block."""
    other, sender = (np.zeros(_ADDRESS // 4 + 1, dtype=np.int32) for _ in range(2))
    return UdpTransport(
        descriptor(own.fileno()), other, sender, other.ctypes.data, sender.ctypes.data
    )


@receive.register(UdpTransport)
def _receive(transport: UdpTransport, frame: Buffer) -> int:
    transport.sender[_ADDRESS // 4] = _ADDRESS
    return _recvfrom(
        transport.socket.fd,
        frame.address,
        frame.bytes.size,
        0,
        transport.sender_at,
        transport.sender_at + _ADDRESS,
    )


@send.register(UdpTransport)
def _send(transport: UdpTransport, frame: Buffer) -> int:
    size = transport.other[_ADDRESS // 4]
    sent = _sendto(
        transport.socket.fd, frame.address, LENGTH, 0, transport.other_at if size > 0 else 0, size
    )
    return 0 if sent == LENGTH else 1


@reply.register(UdpTransport)
def _reply(transport: UdpTransport, frame: Buffer) -> int:
    sent = _sendto(
        transport.socket.fd,
        frame.address,
        LENGTH,
        0,
        transport.sender_at,
        transport.sender[_ADDRESS // 4],
    )
    return 0 if sent == LENGTH else 1


@connect_to_sender.register(UdpTransport)
def _connect_to_sender(transport: UdpTransport) -> None:
    for i in range(transport.other.size):
        transport.other[i] = transport.sender[i]


@wait_for_frame.register(UdpTransport)
def _wait_for_frame(transport: UdpTransport, nanoseconds: int) -> None:
    wait_readable(transport.socket, nanoseconds)


class UdpDevice(WireDevice):
    """A device that listens at a UDP port, on this computer or another: ``quell rig``, a microcontroller.

    Parameters
    ----------
    url
        for example ``udp://127.0.0.1:5005``.
    dt
        sample time [s]: that of the device.
    timeout
        how long it may take until the device answers [s].

    Raises
    ------
    ValueError
        for a URL that is not of this form, a host that is not known, and a sample time that is not the device's.
    ConnectionError
        where no device answers, or one that is taken.
    """

    def __init__(self, url: str, dt: float, timeout: float = 3.0) -> None:
        family, address = resolved(url)
        checks.positive("dt", dt, "s")
        if address[1] == 0:
            raise ValueError(f"device = {url!r}: must have a port from 1 to 65535")
        self._socket = _socket(family)
        try:
            self._socket.connect(address)
        except OSError as error:
            self._socket.close()
            raise ConnectionError(f"{url}: can't be reached ({error.strerror})") from None
        super().__init__(
            url,
            udp_transport(self._socket),
            dt,
            timeout,
            f"start one with: quell rig --device {url}",
        )

    def _free(self) -> None:
        self._socket.close()


class UdpListener:
    """The device's end: a port at which it listens. Port 0 is any that is free; ``url`` has the one it got.

    Raises
    ------
    ValueError
        for a URL that is not of this form, and a port that is taken.
    """

    def __init__(self, url: str) -> None:
        family, address = resolved(url)
        self.socket = _socket(family)
        try:
            self.socket.bind(address)
        except OSError as error:
            self.socket.close()
            raise ValueError(
                f"device = {url!r}: can't listen there ({error.strerror}); give another port, or end what has it"
            ) from None
        host, port = self.socket.getsockname()[:2]
        self.url = f"udp://[{host}]:{port}" if ":" in host else f"udp://{host}:{port}"
        self.transport = udp_transport(self.socket)

    def close(self) -> None:
        """Give the port free."""
        self.socket.close()


def resolved(url: str) -> tuple[int, Any]:
    """Return address family and address of ``udp://HOST:PORT``.

    Raises
    ------
    ValueError
        where it is not of this form, or the host is not known.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if (
        host is None
        or port is None
        or parts.scheme != "udp"
        or parts.path
        or parts.query
        or parts.fragment
        or parts.username
    ):
        raise ValueError(
            f"device = {url!r}: must be udp://HOST:PORT with a port up to 65535, for example udp://127.0.0.1:5005"
        )
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise ValueError(
            f"device = {url!r}: the host {host!r} is not known ({getattr(error, 'strerror', 'no such name')})"
        ) from None
    return found[0][0], found[0][4]


def _socket(family: int) -> socket.socket:
    made = socket.socket(family, socket.SOCK_DGRAM)
    made.setblocking(False)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _QUEUE)
    return made
