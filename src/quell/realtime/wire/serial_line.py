"""Frames over a serial line: 40 bytes, framed by ``cobs`` with a zero at the end, so 42 bytes each way at every sample.

A byte takes 10 bits on the line (8N1: no parity, one stop bit), a frame 420. At 921600 baud that is 0.46 ms: by so much the measurement is
older when it arrives, and by so much later the command acts. A frame must fit into a sample, dt ≥ 420 / baud; there and back should,
dt ≥ 840 / baud.

Lost, inserted and changed bytes cost the frame they are in, and the one behind it where a zero is lost: the CRC and the rules of ``frames``
see to it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import warnings
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlsplit

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.optional import import_extra
from quell.realtime.system.libc import external
from quell.realtime.wire import cobs
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
from quell.types import DesignWarning

BAUD = 921600
# What a frame takes on the line, framed.
FRAME_BITS = 10 * (LENGTH + 2)
# A packet that is longer than this is none of ours: as much as fits into a buffer for frames.
_LONGEST = 48
# Bytes taken from the system at a time, and how often in one go: whoever floods the line can't keep the loop from its cycle.
_AT_ONCE = 256
_MOST_READS = 16
# What ppoll says of a line that is no more: POLLERR, POLLHUP, POLLNVAL.
_GONE = 0x38
_REVENTS = 48
# [ns].
_PAUSE = 100_000

_read = external("read", "long", "int", "address", "long")
_ppoll = external("ppoll", "int", "address", "long", "address", "address")
_write = external("write", "long", "int", "address", "long")


class SerialTransport(NamedTuple):
    """One end of a serial line; make it with ``serial_link``."""

    port: Descriptor
    raw: NDArray[np.uint8]
    """Bytes as they came, not looked at yet."""
    packet: NDArray[np.uint8]
    """What has come since the last zero."""
    coded: NDArray[np.uint8]
    """What goes out; in front of it in memory lies a zero."""
    state: NDArray[np.int64]
    """Next byte to look at, end of what came, bytes since the last zero, whether the other side may be within a packet (4,)."""
    raw_at: int
    coded_at: int


_NEXT, _END, _SIZE, _WITHIN = range(4)


def serial_transport(fd: int) -> SerialTransport:
    """Return the link of a file descriptor of a serial line in raw mode."""
    os.set_blocking(fd, False)
    raw, packet, out = (np.zeros(size, dtype=np.uint8) for size in (_AT_ONCE, _LONGEST, LENGTH + 3))
    coded = out[1:]
    return SerialTransport(
        descriptor(fd),
        raw,
        packet,
        coded,
        np.array([0, 0, 0, 1]),
        raw.ctypes.data,
        coded.ctypes.data,
    )


@receive.register(SerialTransport)
def _receive(transport: SerialTransport, frame: Buffer) -> int:
    state = transport.state
    for _ in range(_MOST_READS):
        while state[_NEXT] < state[_END]:
            byte = transport.raw[state[_NEXT]]
            state[_NEXT] += 1
            if byte != 0:
                if state[_SIZE] < _LONGEST:
                    transport.packet[state[_SIZE]] = byte
                state[_SIZE] += 1
            elif state[_SIZE] > 0:
                size = state[_SIZE]
                state[_SIZE] = 0
                return (
                    0
                    if size > _LONGEST
                    else max(cobs.decode(transport.packet, size, frame.bytes), 0)
                )
        state[_NEXT] = 0
        state[_END] = max(_read(transport.port.fd, transport.raw_at, _AT_ONCE), 0)
        if state[_END] == 0:
            break
    return -1


@send.register(SerialTransport)
def _send(transport: SerialTransport, frame: Buffer) -> int:
    """Send a frame; after one that was cut short, and before the first, a zero ends whatever the other side is within."""
    size = cobs.encode(frame.bytes, LENGTH, transport.coded)
    lead = int(transport.state[_WITHIN])
    transport.state[_WITHIN] = (
        0 if _write(transport.port.fd, transport.coded_at - lead, size + lead) == size + lead else 1
    )
    return int(transport.state[_WITHIN])


@reply.register(SerialTransport)
def _reply(transport: SerialTransport, frame: Buffer) -> int:
    return send(transport, frame)


@connect_to_sender.register(SerialTransport)
def _connect_to_sender(transport: SerialTransport) -> None:
    """Do nothing: there is but one other side."""


@wait_for_frame.register(SerialTransport)
def _wait_for_frame(transport: SerialTransport, nanoseconds: int) -> None:
    if transport.state[_NEXT] < transport.state[_END]:
        return
    wait_readable(transport.port, nanoseconds)
    if transport.port.words[0] >> _REVENTS & _GONE:
        # A line that is gone is always ready to say so: wait a little for nothing, rather than ask without end.
        transport.port.words[1] = 0
        transport.port.words[2] = min(nanoseconds, _PAUSE)
        _ppoll(0, 0, transport.port.address + 8, 0)


class SerialDevice(WireDevice):
    """A device at a serial port: a microcontroller, or ``quell rig`` at the other end of a cable.

    Parameters
    ----------
    url
        for example ``serial:///dev/ttyUSB0?baud=921600``; without ``baud`` it is 921600.
    dt
        sample time [s]: that of the device.
    timeout
        how long it may take until the device answers [s]. A board that restarts when its port is opened needs its time.

    Raises
    ------
    ValueError
        for a URL that is not of this form, a port that can't be opened, a sample time that is not the device's, or one that is
        too short for a frame at this baud rate.
    ConnectionError
        where no device answers.
    ImportError
        without pyserial.
    """

    def __init__(self, url: str, dt: float, timeout: float = 3.0) -> None:
        path, baud = _parsed(url)
        _check_rate(baud, checks.positive("dt", dt, "s"))
        self._port = _opened(url, path, baud)
        super().__init__(
            url,
            serial_transport(self._port.fileno()),
            dt,
            timeout,
            "look at the cable (TX to RX, ground to ground) and at the baud rate of both; or start one with: quell rig",
        )

    def _free(self) -> None:
        self._port.close()


class SerialListener:
    """The device's end of a serial line. ``serial://pty`` makes a line without a cable; ``url`` then says where its other end is.

    Raises
    ------
    ValueError
        for a URL that is not of this form, and a port that can't be opened.
    """

    def __init__(self, url: str) -> None:
        path, baud = _parsed(url)
        self._port: Any = _Pseudoterminal() if path == "pty" else _opened(url, path, baud)
        self.url = f"serial://{self._port.path}" if path == "pty" else url
        self.transport = serial_transport(self._port.fileno())

    def close(self) -> None:
        """Give the port free."""
        self._port.close()


class _Pseudoterminal:
    """A serial line without a cable: its other end can be opened as ``path``."""

    def __init__(self) -> None:
        import pty
        import tty

        # The other end stays open here, too: else the line would hang up whenever nobody has it.
        self._ends = pty.openpty()
        tty.setraw(self._ends[1])
        self.path = os.ttyname(self._ends[1])

    def fileno(self) -> int:
        return self._ends[0]

    def close(self) -> None:
        ends, self._ends = self._ends, ()  # type: ignore[assignment]
        for end in ends:
            os.close(end)


def _parsed(url: str) -> tuple[str, int]:
    """Return path and baud rate."""
    parts = urlsplit(url)
    path, given = parts.netloc + parts.path, dict(parse_qsl(parts.query, keep_blank_values=True))
    rate = given.pop("baud", str(BAUD))
    if (
        parts.scheme != "serial"
        or not path
        or given
        or parts.fragment
        or not rate.isdecimal()
        or int(rate) == 0
    ):
        raise ValueError(
            f"device = {url!r}: must be serial://PORT?baud=RATE, for example serial:///dev/ttyUSB0?baud=921600"
        )
    return path, int(rate)


def _check_rate(baud: int, dt: float) -> None:
    frame = FRAME_BITS / baud
    needs = f"a frame takes {frame * 1e3:.3g} ms at {baud} baud"
    if frame > dt:
        raise ValueError(
            f"dt = {dt!r} s: {needs}: too long for a sample; take at least {FRAME_BITS / dt:.0f} baud, or dt from {frame:.3g} s on"
        )
    if 2.0 * frame > dt:
        warnings.warn(
            f"dt = {dt!r} s: {needs}, there and back is more than a sample: u acts a sample later than it might; "
            f"from {2.0 * FRAME_BITS / dt:.0f} baud on it does not",
            DesignWarning,
            stacklevel=3,
        )


def _opened(url: str, path: str, baud: int) -> Any:
    """Return the open port: raw, 8N1, ours alone, without delay where its driver can do without."""
    if sys.platform != "linux":
        raise ValueError(
            f"device = {url!r}: serial lines are for Linux; elsewhere give run_rig a device of your own around pyserial"
        )
    serial = import_extra("serial", "serial", "a serial line")
    try:
        port = serial.Serial(path, baud, timeout=0.0, write_timeout=0.0, exclusive=True)
    except (
        OSError,
        ValueError,
    ) as error:  # pyserial says ValueError to a rate that the port does not have
        raise ValueError(f"device = {url!r}: can't be opened ({_why(error)})") from None
    # Adapters for USB otherwise keep what came for up to 16 ms.
    with contextlib.suppress(ValueError, NotImplementedError, OSError):
        port.set_low_latency_mode(True)
    return port


def _why(error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.ENOENT:
        from serial.tools.list_ports import comports

        return f"no such port; there are: {', '.join(sorted(port.device for port in comports())) or 'none'}"
    if code == errno.EACCES:
        return "no permission: join the group dialout, or whichever has the port"
    if code in (errno.EAGAIN, errno.EBUSY):
        return "another program has it"
    return str(error)
