"""Frames over UDP and over serial lines.

Frames over UDP: one datagram each.

``wire.accept`` handles datagrams that are lost, duplicated or overtaken. The device listens at
``udp://HOST:PORT``; the loop uses any free port.

Frames over a serial line: 40 bytes, in COBS with a final zero, so 42 bytes per frame;
8 more for each further signal.

A byte takes 10 bits on the line (8N1: no parity, one stop bit), a frame 420: 0.46 ms at 921600
baud. The measurement arrives later by this time, and so does the command. A frame must fit into a
sample, dt ≥ 420 / baud; a frame each way should, dt ≥ 840 / baud.

If bytes are lost, inserted or changed, the CRC and the rules of ``wire`` reject their frame, and
the next one too if the zero between them is lost.

Frames on a stream of bytes: consistent overhead byte stuffing (COBS).

A zero byte ends each packet, and no byte inside a packet is zero. A receiver that joins late, or
has lost or gained bytes, is synchronised again at the next zero. A packet is a sequence of blocks:
a code n, 1 … 255, followed by n − 1 non-zero bytes. The block stands for these bytes followed by a
zero; there is no zero after the last block and after blocks with n = 255. Up to 254 bytes become
one byte more, two with the final zero.

Source: S. Cheshire, M. Baker: Consistent Overhead Byte Stuffing. IEEE/ACM Transactions on
Networking 7 (1999) 159-172, section III.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import sys
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlsplit

import numpy as np
from numpy.typing import NDArray

from quell.checks import import_extra
from quell.kernels.dispatch import kernel
from quell.realtime import wire
from quell.realtime.authenticated import authenticated, read_key
from quell.realtime.system import external
from quell.realtime.wire import Buffer, is_gone, pause, wait_readable
from quell.realtime.wire_device import WireDevice
from quell.types import warn

# ---- Frames over UDP ----

# Room for a sockaddr_in (16 bytes) or a sockaddr_in6 (28 bytes); its length is stored behind it.
_ADDRESS = 32
# Size of the receive buffer [bytes]: at 1 kHz about half a second of datagrams with the system's
# overhead, computed and not measured.
_RECEIVE_BUFFER = 1 << 20

_recvfrom = external("recvfrom", "long", "int", "address", "long", "int", "address", "address")
_sendto = external("sendto", "long", "int", "address", "long", "int", "address", "int")


class UdpTransport(NamedTuple):
    """One end of a UDP wire; make it with ``udp_transport``."""

    socket: wire.Descriptor
    other: NDArray[np.int32]
    """Address of the other side and its length; the length is 0 if the socket is connected."""
    sender: NDArray[np.int32]  # address and length of the sender of the last datagram
    other_at: int
    sender_at: int


def udp_transport(own: socket.socket) -> UdpTransport:
    """Return the transport of a non-blocking socket."""
    other, sender = (np.zeros(_ADDRESS // 4 + 1, dtype=np.int32) for _ in range(2))
    return UdpTransport(
        wire.descriptor(own.fileno()), other, sender, other.ctypes.data, sender.ctypes.data
    )


@wire.receive.register(UdpTransport)
def _receive(udp: UdpTransport, frame: Buffer) -> int:
    udp.sender[_ADDRESS // 4] = _ADDRESS
    size, length_at = frame.bytes.size, udp.sender_at + _ADDRESS
    return _recvfrom(udp.socket.fd, frame.address, size, 0, udp.sender_at, length_at)


@wire.send.register(UdpTransport)
def _send(udp: UdpTransport, frame: Buffer) -> int:
    size = udp.other[_ADDRESS // 4]
    length = frame.length[0]
    sent = _sendto(udp.socket.fd, frame.address, length, 0, udp.other_at if size > 0 else 0, size)
    return 0 if sent == length else 1


@wire.reply.register(UdpTransport)
def _reply(udp: UdpTransport, frame: Buffer) -> int:
    size = udp.sender[_ADDRESS // 4]
    length = frame.length[0]
    sent = _sendto(udp.socket.fd, frame.address, length, 0, udp.sender_at, size)
    return 0 if sent == length else 1


@wire.connect_to_sender.register(UdpTransport)
def _connect_to_sender(udp: UdpTransport) -> None:
    for i in range(udp.other.size):
        udp.other[i] = udp.sender[i]


@wire.is_from_other_side.register(UdpTransport)
def _is_from_other_side(udp: UdpTransport) -> bool:
    """Compare host and port; the kernel sets the unused bytes of an address to zero."""
    length = udp.sender[_ADDRESS // 4]
    differences = int(udp.other[_ADDRESS // 4] != length)
    for i in range(length // 4):
        differences += int(udp.other[i] != udp.sender[i])
    return differences == 0


@wire.wait_for_frame.register(UdpTransport)
def _wait_for_frame(udp: UdpTransport, nanoseconds: int) -> None:
    wait_readable(udp.socket, nanoseconds)


class UdpDevice(WireDevice):
    """A device that listens at a UDP port, for example ``udp://127.0.0.1:5005``.

    It may be ``quell rig`` or a microcontroller, on this computer or another. Parameters and errors
    are those of ``WireDevice``. With ``?key=FILE`` both sides need the key in that file
    (``realtime/authenticated.py``).
    """

    def _connect(self) -> Any:
        url, key = key_of(self.url)
        family, address = resolved(url)
        if address[1] == 0:
            raise ValueError(f"device = {self.url!r}: must have a port from 1 to 65535")
        self._socket = _socket(family)
        try:
            self._socket.connect(address)
        except OSError as error:
            self._socket.close()
            raise ConnectionError(f"{self.url}: can't be reached ({error.strerror})") from None
        ask_for_key(self.url)
        plain = udp_transport(self._socket)
        return plain if key is None else authenticated(plain, key, is_device=False)

    def _release(self) -> None:
        self._socket.close()


class UdpListener:
    """The device's end: a port at which it listens. Port 0 takes a free one, see ``url``.

    With ``?key=FILE`` it takes frames with the key in that file alone.
    """

    def __init__(self, url: str) -> None:
        plain, key = key_of(url)
        family, address = resolved(plain)
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
        ask_for_key(url)
        self.transport: Any = udp_transport(self.socket)
        if key is not None:
            self.transport = authenticated(self.transport, key, is_device=True)
            self.url += f"?{urlsplit(url).query}"

    def close(self) -> None:
        """Release the port."""
        self.socket.close()


def key_of(url: str) -> tuple[str, NDArray[np.uint64] | None]:
    """Return a URL of UDP without its key, and the key in the file that ``?key=FILE`` names."""
    parts = urlsplit(url)
    given = dict(parse_qsl(parts.query, keep_blank_values=True))
    file = given.pop("key", None)
    if given:
        raise ValueError(f"device = {url!r}: has {', '.join(given)}; udp://HOST:PORT takes key")
    plain = url.split("?")[0]
    return plain, None if file in (None, "none") else read_key(file)


def ask_for_key(url: str) -> None:
    """Warn of a port that other computers reach, without a key and without ``?key=none``."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    if not parts.query and host != "localhost" and not host.startswith("127.") and host != "::1":
        warn(
            f"device = {url!r}: who can send to this port can drive the machine; give both sides "
            "a key, ?key=FILE, or ?key=none where nobody else is on this network"
        )


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


# ---- Frames on a stream of bytes ----

INVALID = -1  # returned by ``decode`` for bytes that are not a packet
# The largest code; its block has no zero after it (section III of the source).
_LONGEST = 255


@kernel
def encode(data: NDArray[np.uint8], size: int, out: NDArray[np.uint8]) -> int:
    """Write the packet of ``size`` bytes with its final zero to ``out``; return its length.

    ``out`` needs room for size + size // 254 + 2 bytes.
    """
    code_at, length = 0, 1
    for i in range(size):
        if data[i] != 0:
            out[length] = data[i]
            length += 1
        if data[i] == 0 or (length - code_at == _LONGEST and i < size - 1):
            out[code_at] = length - code_at
            code_at = length
            length += 1
    out[code_at] = length - code_at
    out[length] = 0
    return length + 1


@kernel
def decode(packet: NDArray[np.uint8], size: int, out: NDArray[np.uint8]) -> int:
    """Decode a packet of ``size`` bytes, without its final zero, to ``out``; return the length.

    Return ``INVALID`` if a block reaches beyond the end or a byte is zero.
    """
    i, length = 0, 0
    while i < size:
        code = int(packet[i])
        if code == 0 or i + code > size:
            return INVALID
        for j in range(i + 1, i + code):
            if packet[j] == 0:
                return INVALID
            out[length] = packet[j]
            length += 1
        i += code
        if code < _LONGEST and i < size:
            out[length] = 0
            length += 1
    return length


# ---- Frames over a serial line ----

BAUD = 921600
# The bits of a framed frame on the line: 42 bytes with start and stop bit.
FRAME_BITS = 10 * (wire.LENGTH + 2)
# A longer packet is not a frame: the longest one, with a byte of COBS, and one more.
_LONGEST_FRAME = wire.LENGTH + 8 * wire.MOST_SIGNALS
# Bytes per read from the system, and reads at once: a sender that floods the line can't keep the
# loop from its cycle. Chosen by hand; not tuned further.
_READ_SIZE = 256
_MOST_READS = 16
# Wait after the line is gone [ns], because poll returns at once then. Chosen by hand.
_PAUSE = 100_000

_read = external("read", "long", "int", "address", "long")
_write = external("write", "long", "int", "address", "long")


class SerialTransport(NamedTuple):
    """One end of a serial line; make it with ``serial_transport``."""

    port: wire.Descriptor
    raw: NDArray[np.uint8]  # bytes read from the system
    packet: NDArray[np.uint8]  # bytes since the last zero
    coded: NDArray[np.uint8]  # the packet to send; the byte before it in memory is a zero
    state: NDArray[np.int64]
    """Next byte of ``raw`` and their end, bytes since the last zero, whether the other side may
    have received a part of a packet (4,)."""
    raw_at: int
    coded_at: int


_NEXT, _END, _SIZE, _PARTIAL = range(4)


def serial_transport(fd: int) -> SerialTransport:
    """Return the transport of the file descriptor of a serial line in raw mode."""
    os.set_blocking(fd, False)
    raw, packet, out = (
        np.zeros(size, dtype=np.uint8) for size in (_READ_SIZE, _LONGEST_FRAME, _LONGEST_FRAME + 3)
    )
    coded, state = out[1:], np.array([0, 0, 0, 1])
    return SerialTransport(
        wire.descriptor(fd), raw, packet, coded, state, raw.ctypes.data, coded.ctypes.data
    )


@wire.receive.register(SerialTransport)
def _receive_serial_line(serial: SerialTransport, frame: Buffer) -> int:
    state = serial.state
    for _ in range(_MOST_READS):
        while state[_NEXT] < state[_END]:
            byte = serial.raw[state[_NEXT]]
            state[_NEXT] += 1
            if byte != 0:
                if state[_SIZE] < _LONGEST_FRAME:
                    serial.packet[state[_SIZE]] = byte
                state[_SIZE] += 1
            elif state[_SIZE] > 0:
                size = state[_SIZE]
                state[_SIZE] = 0
                if size > frame.bytes.size:
                    return 0
                return max(decode(serial.packet, size, frame.bytes), 0)
        state[_NEXT] = 0
        state[_END] = max(_read(serial.port.fd, serial.raw_at, _READ_SIZE), 0)
        if state[_END] == 0:
            break
    return -1


@wire.send.register(SerialTransport)
def _send_serial_line(serial: SerialTransport, frame: Buffer) -> int:
    """Send a frame; a zero precedes the first one, and one that follows a partial packet."""
    lead = int(serial.state[_PARTIAL])
    size = encode(frame.bytes, frame.length[0], serial.coded) + lead
    sent = _write(serial.port.fd, serial.coded_at - lead, size)
    serial.state[_PARTIAL] = 0 if sent == size else 1
    return int(serial.state[_PARTIAL])


@wire.wait_for_frame.register(SerialTransport)
def _wait_for_frame_serial_line(serial: SerialTransport, nanoseconds: int) -> None:
    if serial.state[_NEXT] < serial.state[_END]:
        return
    wait_readable(serial.port, nanoseconds)
    if is_gone(serial.port):
        pause(serial.port, min(nanoseconds, _PAUSE))


class SerialDevice(WireDevice):
    """A device at a serial port: a microcontroller, or ``quell rig`` at the other end of a cable.

    The URL is for example ``serial:///dev/ttyUSB0?baud=921600``, which is the default rate. Some
    boards restart when their port is opened; ``timeout`` must include this. Parameters and errors
    are those of ``WireDevice``, and ``ImportError`` without pyserial.
    """

    _hint = (
        "look at the cable (TX to RX, ground to ground) and at the baud rate of both; "
        "or start one with: quell rig"
    )

    def _connect(self) -> SerialTransport:
        path, baud = _parsed(self.url)
        outputs, inputs = self.signal_counts or (1, 1)
        _check_rate(baud, self.dt, max(outputs, inputs))
        self._port = _opened(self.url, path, baud)
        return serial_transport(self._port.fileno())

    def _release(self) -> None:
        self._port.close()


class SerialListener:
    """The device's end of a serial line; with ``serial://pty``, ``url`` names the other end."""

    def __init__(self, url: str) -> None:
        path, baud = _parsed(url)
        self._port: Any = _Pseudoterminal() if path == "pty" else _opened(url, path, baud)
        self.url = f"serial://{self._port.path}" if path == "pty" else url
        self.transport = serial_transport(self._port.fileno())

    def close(self) -> None:
        """Release the port."""
        self._port.close()


class _Pseudoterminal:
    """A serial line without a cable: its other end can be opened as ``path``."""

    def __init__(self) -> None:
        import pty
        import tty

        # Keep the other end open here too, or the line hangs up whenever no one else has it open.
        self._ends: tuple[int, ...] = pty.openpty()
        tty.setraw(self._ends[1])
        self.path = os.ttyname(self._ends[1])

    def fileno(self) -> int:
        return self._ends[0]

    def close(self) -> None:
        ends, self._ends = self._ends, ()
        for end in ends:
            os.close(end)


def _parsed(url: str) -> tuple[str, int]:
    """Return path and baud rate."""
    parts = urlsplit(url)
    path, given = parts.netloc + parts.path, dict(parse_qsl(parts.query, keep_blank_values=True))
    rate = given.pop("baud", str(BAUD))
    is_rate = rate.isdecimal() and int(rate) > 0
    if parts.scheme != "serial" or not path or given or parts.fragment or not is_rate:
        raise ValueError(
            f"device = {url!r}: must be serial://PORT?baud=RATE, "
            "for example serial:///dev/ttyUSB0?baud=921600"
        )
    return path, int(rate)


def _check_rate(baud: int, dt: float, signals: int) -> None:
    bits = FRAME_BITS + 80 * (signals - 1)
    frame = bits / baud
    needs = f"dt = {dt!r} s: a frame takes {frame * 1e3:.3g} ms at {baud} baud"
    if frame > dt:
        raise ValueError(
            f"{needs}, which is longer than a sample; give at least {bits / dt:.0f} baud, "
            f"or dt from {frame:.3g} s on"
        )
    if 2.0 * frame > dt:
        warn(
            f"{needs}, each way; that is longer than a sample: u acts a sample later "
            f"than it could; it does not from {2.0 * bits / dt:.0f} baud on"
        )


def _opened(url: str, path: str, baud: int) -> Any:
    """Return the open port: raw, 8N1, exclusive, in low-latency mode if its driver has one."""
    if sys.platform != "linux":
        raise ValueError(
            f"device = {url!r}: serial lines need Linux; elsewhere give run_rig a device of your "
            "own that uses pyserial"
        )
    serial = import_extra("serial", "serial", "a serial line")
    try:
        port = serial.Serial(path, baud, timeout=0.0, write_timeout=0.0, exclusive=True)
    except (OSError, ValueError) as error:  # ValueError for a rate that the port does not have
        raise ValueError(f"device = {url!r}: can't be opened ({_reason(error)})") from None
    # Without it USB adapters may keep received bytes for up to 16 ms.
    with contextlib.suppress(ValueError, NotImplementedError, OSError):
        port.set_low_latency_mode(True)
    return port


def _reason(error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.ENOENT:
        from serial.tools.list_ports import comports

        ports = ", ".join(sorted(port.device for port in comports())) or "none"
        return f"no such port; there are: {ports}"
    if code == errno.EACCES:
        return "no permission: join the group dialout, or the group that owns the port"
    if code in (errno.EAGAIN, errno.EBUSY):
        return "another program uses it"
    return str(error)
