"""The serial line: frames on a stream of bytes, and the ports."""

import errno
import itertools
import os
import socket

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import quell as ql
from quell.realtime import wire as frames
from quell.realtime.transports import SerialDevice, SerialListener, serial_transport
from quell.realtime.wire import receive, send

from .test_cobs import encoded

pytest.importorskip("serial")
DT = 1e-3


class Stream:
    """A stream of bytes: what is written into ``fd`` comes out of ``there`` at once."""

    def __init__(self):
        self.sockets = socket.socketpair()
        self.fd = self.sockets[0].fileno()
        self.here, self.there = (serial_transport(end.fileno()) for end in self.sockets)
        self.frame = frames.buffer()

    def accepted(self, endpoint):
        """Return the values of all frames that have come and are accepted."""
        values = []
        while (size := receive(self.there, self.frame)) >= 0:
            if not frames.is_well_formed(self.frame, size, endpoint.counters):
                continue
            if frames.accept(self.frame, endpoint):
                values.append(float(self.frame.doubles[3]))
        return values


@pytest.fixture(scope="module")
def wire():
    """One for all tests here."""
    wire = Stream()
    yield wire
    for end in wire.sockets:
        end.close()


def packet_of(number, session=7):
    """A command with its own number as its value, as it goes over the line."""
    out = frames.buffer()
    frames.write_frame(out, frames.COMMAND, session, number, 0, 123456789, float(number), 0)
    return encoded(out.bytes[: frames.LENGTH].tobytes())


def test_frames_come_out_as_they_went_in(wire):
    """And back."""
    endpoint, out = frames.endpoint(frames.COMMAND, 7, 50), frames.buffer()
    own = frames.endpoint(frames.MEASUREMENT, 7, 50)
    for k in range(1, 6):
        frames.write_next_numbers(out, own, frames.COMMAND, 0, np.array([float(k)]), 0)
        assert send(wire.here, out) == 0
        assert wire.accepted(endpoint) == [float(k)]
    assert endpoint.counters[frames.ACCEPTED] == endpoint.counters.sum() == 5


@given(st.lists(st.integers(1, 120), min_size=1, max_size=20))
@settings(max_examples=60)
def test_a_stream_in_any_pieces_is_the_same_stream(wire, counts):
    """However few bytes come at a time, frames come out whole, in order."""
    endpoint = frames.endpoint(frames.COMMAND, 7, 50)
    stream = b"\0" + b"".join(packet_of(k) for k in range(1, 5))
    values = []
    for count in itertools.cycle(counts):
        os.write(wire.fd, stream[:count])
        stream = stream[count:]
        values += wire.accepted(endpoint)
        if not stream:
            break
    assert values == [1.0, 2.0, 3.0, 4.0]


@given(st.lists(st.binary(max_size=120), min_size=4, max_size=4))
@settings(max_examples=100)
def test_garbage_between_frames_costs_at_most_the_frame_behind_it(wire, garbage):
    """What is accepted was sent; if a zero ends the garbage, nothing is lost."""
    endpoint = frames.endpoint(frames.COMMAND, 7, 50)
    for k, noise in enumerate(garbage, start=1):
        os.write(wire.fd, noise + packet_of(2 * k - 1) + packet_of(2 * k))
    values = wire.accepted(endpoint)
    assert set(values) >= {2.0, 4.0, 6.0, 8.0}
    assert values == sorted(set(values))
    assert set(values) <= {float(k) for k in range(1, 9)}
    endpoint = frames.endpoint(frames.COMMAND, 7, 50)
    for k, noise in enumerate(garbage, start=1):
        os.write(wire.fd, noise + b"\0" + packet_of(k))
    assert wire.accepted(endpoint) == [1.0, 2.0, 3.0, 4.0]


FAULTS = st.tuples(
    st.integers(0, 41), st.sampled_from(["lost", "inserted", "changed"]), st.integers(0, 255)
)


@given(st.lists(FAULTS, min_size=1, max_size=4))
@settings(max_examples=100)
def test_no_fault_of_bytes_makes_a_wrong_frame(wire, faults):
    """A frame with bytes lost, inserted or changed is counted; the next but one comes through."""
    broken = bytearray(packet_of(2))
    for at, fault, byte in faults:
        at = min(at, len(broken))
        if fault == "inserted":
            broken.insert(at, byte)
        elif at < len(broken):
            if fault == "lost":
                del broken[at]
            else:
                broken[at] = byte
    endpoint = frames.endpoint(frames.COMMAND, 7, 50)
    os.write(wire.fd, b"\0" + packet_of(1) + bytes(broken) + packet_of(3) + packet_of(4))
    values = wire.accepted(endpoint)
    assert values[0] == 1.0
    assert values[-1] == 4.0
    assert set(values) <= {1.0, 2.0, 3.0, 4.0}
    lost = 4 - len(values)
    assert endpoint.counters[frames.MALFORMED] >= (lost > 0)
    assert endpoint.counters[frames.SKIPPED] == lost


def test_a_packet_that_is_too_long_is_counted_once_and_forgotten(wire):
    """Ten thousand bytes without a zero: no more is kept than a frame is long."""
    endpoint = frames.endpoint(frames.COMMAND, 7, 50)
    for _ in range(100):
        os.write(wire.fd, b"\x55" * 100)
        assert wire.accepted(endpoint) == []
    os.write(wire.fd, b"\0" + packet_of(1))
    assert wire.accepted(endpoint) == [1.0]
    assert endpoint.counters[frames.MALFORMED] == 1


def test_a_frame_that_did_not_fit_does_not_spoil_the_next(wire):
    """When nobody reads, the line fills up; what was cut short there is ended by a zero."""
    endpoint, own, out = (
        frames.endpoint(frames.COMMAND, 7, 50),
        frames.endpoint(frames.MEASUREMENT, 7, 50),
        frames.buffer(),
    )
    sent, failed = 0, False
    while not failed:
        frames.write_next_numbers(out, own, frames.COMMAND, 0, np.array([sent + 1.0]), 0)
        failed = send(wire.here, out) != 0
        sent += not failed
    values = wire.accepted(endpoint)
    frames.write_next_numbers(out, own, frames.COMMAND, 0, np.array([-1.0]), 0)
    assert send(wire.here, out) == 0
    assert values + wire.accepted(endpoint) == [float(k + 1) for k in range(sent)] + [-1.0]


def test_nobody_at_the_other_end_is_said_so():
    """With what to look at."""
    listener = SerialListener("serial://pty")
    with pytest.raises(ConnectionError, match="no device answers; look at the cable"):
        SerialDevice(listener.url, DT, timeout=0.1)
    listener.close()


def test_a_frame_must_fit_into_a_sample():
    """At 115200 baud it takes 3.6 ms: too long for 1 ms, and for 5 ms if it must also return."""
    with pytest.raises(
        ValueError,
        match="a frame takes 3.65 ms at 115200 baud, .*; give at least 420000 baud",
    ):
        SerialDevice("serial:///dev/null?baud=115200", DT)
    with (
        pytest.warns(
            ql.DesignWarning,
            match="u acts a sample later than it could; it does not from 168000 baud on",
        ),
        pytest.raises(ValueError),
    ):
        SerialDevice("serial:///dev/null?baud=115200", 5e-3)


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("serial:///dev/ttyUSB0?baud=fast", "must be serial://PORT"),
        ("serial:///dev/ttyNone9", "no such port; there are: "),
        ("serial:///dev/null", "can't be opened"),
    ],
)
def test_ports_that_are_none_are_refused(url, says):
    """In one line, at both ends."""
    for end in (lambda: SerialDevice(url, DT), lambda: SerialListener(url)):
        with pytest.raises(ValueError, match=says) as caught:
            end()
        assert "\n" not in str(caught.value)


def test_a_port_that_is_not_ours_is_said_so(monkeypatch):
    """With the group that helps."""

    def refuse(*_, **__):
        raise OSError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("serial.Serial", refuse)
    with pytest.raises(ValueError, match="no permission: join the group dialout"):
        SerialDevice("serial:///dev/ttyS0", DT)


def test_other_systems_are_told_what_to_do(monkeypatch):
    """The line is read through functions that only Linux has."""
    monkeypatch.setattr("sys.platform", "win32")
    with pytest.raises(
        ValueError, match="serial lines need Linux; elsewhere give run_rig a device of your own"
    ):
        SerialDevice("serial://COM3", DT)


def test_without_pyserial_one_line_says_which_extra(monkeypatch):
    """The extra is called serial."""
    monkeypatch.setitem(__import__("sys").modules, "serial", None)
    with pytest.raises(ImportError, match=r"pip install 'quell-control\[serial\]'"):
        SerialDevice("serial:///dev/ttyS0", DT)
