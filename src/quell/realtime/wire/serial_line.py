"""Frames over a serial line: 40 bytes, framed by ``cobs`` with a final zero, so 42 bytes per frame.

A byte takes 10 bits on the line (8N1: no parity, one stop bit), a frame 420: 0.46 ms at 921600
baud. The measurement arrives later by this time, and so does the command. A frame must fit into a
sample, dt ≥ 420 / baud; a frame each way should, dt ≥ 840 / baud.

If bytes are lost, inserted or changed, the CRC and the rules of ``frames`` reject their frame, and
the next one too if the zero between them is lost.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlsplit

import numpy as np
from numpy.typing import NDArray

from quell.optional import import_extra
from quell.realtime.system.libc import external
from quell.realtime.wire import cobs
from quell.realtime.wire.descriptor import Descriptor, descriptor, is_gone, pause, wait_readable
from quell.realtime.wire.device import WireDevice
from quell.realtime.wire.frames import LENGTH, Buffer
from quell.realtime.wire.transport import receive, send, wait_for_frame
from quell.warn import warn

BAUD = 921600
# The bits of a framed frame on the line: 42 bytes with start and stop bit.
FRAME_BITS = 10 * (LENGTH + 2)
# Size of ``frames.Buffer.bytes``: a longer packet is not a frame.
_LONGEST = 48
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

    port: Descriptor
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
        np.zeros(size, dtype=np.uint8) for size in (_READ_SIZE, _LONGEST, LENGTH + 3)
    )
    coded, state = out[1:], np.array([0, 0, 0, 1])
    return SerialTransport(
        descriptor(fd), raw, packet, coded, state, raw.ctypes.data, coded.ctypes.data
    )


@receive.register(SerialTransport)
def _receive(serial: SerialTransport, frame: Buffer) -> int:
    state = serial.state
    for _ in range(_MOST_READS):
        while state[_NEXT] < state[_END]:
            byte = serial.raw[state[_NEXT]]
            state[_NEXT] += 1
            if byte != 0:
                if state[_SIZE] < _LONGEST:
                    serial.packet[state[_SIZE]] = byte
                state[_SIZE] += 1
            elif state[_SIZE] > 0:
                size = state[_SIZE]
                state[_SIZE] = 0
                if size > _LONGEST:
                    return 0
                return max(cobs.decode(serial.packet, size, frame.bytes), 0)
        state[_NEXT] = 0
        state[_END] = max(_read(serial.port.fd, serial.raw_at, _READ_SIZE), 0)
        if state[_END] == 0:
            break
    return -1


@send.register(SerialTransport)
def _send(serial: SerialTransport, frame: Buffer) -> int:
    """Send a frame; a zero precedes the first one, and one that follows a partial packet."""
    lead = int(serial.state[_PARTIAL])
    size = cobs.encode(frame.bytes, LENGTH, serial.coded) + lead
    sent = _write(serial.port.fd, serial.coded_at - lead, size)
    serial.state[_PARTIAL] = 0 if sent == size else 1
    return int(serial.state[_PARTIAL])


@wait_for_frame.register(SerialTransport)
def _wait_for_frame(serial: SerialTransport, nanoseconds: int) -> None:
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
        _check_rate(baud, self.dt)
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


def _check_rate(baud: int, dt: float) -> None:
    frame = FRAME_BITS / baud
    needs = f"dt = {dt!r} s: a frame takes {frame * 1e3:.3g} ms at {baud} baud"
    if frame > dt:
        raise ValueError(
            f"{needs}, which is longer than a sample; give at least {FRAME_BITS / dt:.0f} baud, "
            f"or dt from {frame:.3g} s on"
        )
    if 2.0 * frame > dt:
        warn(
            f"{needs}, each way; that is longer than a sample: u acts a sample later "
            f"than it could; it does not from {2.0 * FRAME_BITS / dt:.0f} baud on"
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
