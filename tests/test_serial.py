"""The serial line: packets on a stream of bytes, and the loop's and the device's end of it over a pseudoterminal."""

import errno
import fcntl
import itertools
import math
import os
import socket
import termios
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import quell as ql
from quell.plants.base import advance, measure
from quell.realtime.devices.base import read_measurement
from quell.realtime.rig.server import Rig
from quell.realtime.system.clock import system_clock
from quell.realtime.wire import cobs, frames
from quell.realtime.wire.serial_line import (
    FRAME_BITS,
    SerialDevice,
    SerialListener,
    serial_transport,
)
from quell.realtime.wire.transport import receive, send, wait_for_frame

pytest.importorskip("serial")
DT = 1e-3


def encoded(data):
    """What ``cobs`` makes of bytes."""
    out = np.zeros(len(data) + len(data) // 254 + 2, dtype=np.uint8)
    return out[: cobs.encode(np.frombuffer(data, dtype=np.uint8), len(data), out)].tobytes()


def decoded(packet):
    """What it makes of a packet without its zero; None where that is none."""
    out = np.zeros(len(packet) + 1, dtype=np.uint8)
    size = cobs.decode(np.frombuffer(packet, dtype=np.uint8), len(packet), out)
    return None if size == cobs.INVALID else out[:size].tobytes()


def plainly_decoded(packet):
    """The same, written as the paper explains it."""
    data = b""
    while packet:
        code, packet = packet[0], packet[1:]
        block, packet = packet[: code - 1], packet[code - 1 :]
        data += block + (b"\0" if code < 255 and packet else b"")
    return data


@pytest.mark.parametrize(
    ("data", "packet"),
    [
        # The head of an IP packet, as in figure 3 of Cheshire and Baker.
        ("45 00 00 2c 4c 79 00 00 40 06 4f 37", "02 45 01 04 2c 4c 79 01 05 40 06 4f 37"),
        ("", "01"),
        ("00", "01 01"),
        ("00 00", "01 01 01"),
        ("11 22 00 33", "03 11 22 02 33"),
        ("11 22 33 44", "05 11 22 33 44"),
        ("11 00 00 00", "02 11 01 01 01"),
    ],
)
def test_packets_are_those_of_cheshire_and_baker(data, packet):
    """Code by code, with the zero that ends them."""
    assert encoded(bytes.fromhex(data)) == bytes.fromhex(packet) + b"\0"


def test_a_run_of_254_bytes_has_a_code_of_its_own():
    """255 stands for 254 bytes without a zero behind them, whatever follows."""
    run = bytes(range(1, 255))
    assert encoded(run) == b"\xff" + run + b"\0"
    assert encoded(run + b"\0") == b"\xff" + run + b"\1\1\0"
    assert encoded(b"\0" + run) == b"\1\xff" + run + b"\0"
    assert encoded(run + b"\xff") == b"\xff" + run + b"\2\xff\0"


@given(
    st.one_of(
        st.binary(max_size=600), st.lists(st.sampled_from([0, 1, 255]), max_size=600).map(bytes)
    )
)
def test_what_is_encoded_is_decoded(data):
    """For any bytes: none inside is zero, no more than one in 254 is added, and a plain decoder finds the same."""
    packet = encoded(data)
    assert packet[-1] == 0
    assert 0 not in packet[:-1]
    assert len(packet) <= len(data) + 1 + max(math.ceil(len(data) / 254), 1)
    assert decoded(packet[:-1]) == data == plainly_decoded(packet[:-1])


@given(st.binary(max_size=60))
def test_any_bytes_decode_to_no_more_than_there_are_or_are_refused(packet):
    """Nothing is read or written outside: a block that reaches beyond the end is no packet."""
    found = decoded(packet)
    assert found is None or len(found) <= max(len(packet) - 1, 0)
    if found is not None:
        assert 0 not in packet


def test_a_frame_takes_42_bytes_whatever_is_in_it():
    """The figure by which rates are checked."""
    for fill in (0, 1, 255):
        assert len(encoded(bytes([fill]) * frames.LENGTH)) * 10 == FRAME_BITS


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
        frames.write_next_frame(out, own, frames.COMMAND, 0, float(k), 0)
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
    """Any bytes at all: what is accepted was sent; and where a zero ends the garbage, nothing is lost."""
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
@settings(max_examples=200)
def test_no_fault_of_bytes_makes_a_wrong_frame(wire, faults):
    """Bytes lost, inserted and changed in a frame: it is dropped, and counted; the next but one comes through as it was sent."""
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
        frames.write_next_frame(out, own, frames.COMMAND, 0, float(sent + 1), 0)
        failed = send(wire.here, out) != 0
        sent += not failed
    values = wire.accepted(endpoint)
    frames.write_next_frame(out, own, frames.COMMAND, 0, -1.0, 0)
    assert send(wire.here, out) == 0
    assert values + wire.accepted(endpoint) == [float(k + 1) for k in range(sent)] + [-1.0]


@pytest.fixture
def rig():
    """The two-mass-spring benchmark at the other end of a line without a cable."""
    with Rig(ql.plants.two_mass_spring(), DT, SerialListener("serial://pty"), watchdog=5) as rig:
        yield rig


def opened(rig, dt=DT):
    """A device for the loop, while the rig ticks."""
    done = threading.Event()

    def turn():
        while not done.is_set():
            rig.tick()
            time.sleep(1e-3)

    thread = threading.Thread(target=turn)
    rig.prepare()
    thread.start()
    try:
        return SerialDevice(rig.listener.url, dt, timeout=30.0)
    finally:
        done.set()
        thread.join()


def await_command(rig):
    """Wait until a command is there: a pseudoterminal hands on bytes when the system finds the time."""
    waiting = np.zeros(1, dtype=np.int32)
    while waiting[0] < FRAME_BITS // 10:
        wait_for_frame(rig.listener.transport, 100_000_000)
        fcntl.ioctl(rig.listener.transport.port.fd, termios.FIONREAD, waiting)


def test_a_loop_over_the_line_is_the_loop_on_the_delayed_plant(rig):
    """What the wires cost is one sample: u acts from the tick after the one whose y it answers."""
    plant = ql.plants.delayed(ql.plants.two_mass_spring(), DT, DT)
    model, x, scratch, still = (
        plant.sampled(DT, True),
        np.zeros(plant.order),
        np.zeros(plant.order),
        np.zeros(plant.disturbances),
    )
    with opened(rig) as device:
        while (
            device.handle.endpoint.numbers[frames.RECEIVED]
            < rig.model.endpoint.numbers[frames.SENT]
        ):
            device.read()
        for k in range(500):
            rig.tick()
            y = device.read()
            assert y == pytest.approx(measure(model, x), rel=1e-9, abs=1e-15)
            u = 5.0 * math.sin(0.1 * k) - y
            device.write(u)
            advance(model, x, scratch, k * DT, u, still)
            await_command(rig)
        assert abs(y) > 1e-9
        assert device.counters["malformed"] == 0
    await_command(rig)
    rig.tick()
    assert rig.state == "idle", "the goodbye must have come"


def test_the_rig_s_watchdog_trips_when_commands_stop(rig):
    """And the loop is told with the next measurement."""
    with opened(rig) as device:
        rig.tick()
        device.read()
        device.write(3.0)
        await_command(rig)
        rig.tick(6)
        assert rig.state == "tripped"
        device.read()
        with pytest.raises(ConnectionError, match="watchdog has set u to zero"):
            device.write(1.0)
        assert device.lost


def test_a_line_that_is_cut_is_told_at_once(rig):
    """Nothing can be sent; nothing comes, and waiting for it takes no longer than it may."""
    device = opened(rig)
    rig.listener.close()
    with pytest.raises(ConnectionError, match="could not be sent"):
        device.write(1.0)
    handle, clock = device.handle, system_clock()
    for _ in range(3):
        y, _ = read_measurement(handle, clock, time.monotonic_ns() + 1_000_000)
    assert math.isnan(y)
    device.close()


def test_a_board_with_another_sample_time_is_refused(rig):
    """In words that name both."""
    with pytest.raises(ValueError, match="dt = 0.002 s: the device at .* ticks every 0.001 s"):
        opened(rig, dt=2e-3)


def test_nobody_at_the_other_end_is_said_so():
    """With what to look at."""
    listener = SerialListener("serial://pty")
    with pytest.raises(ConnectionError, match="no device answers; look at the cable"):
        SerialDevice(listener.url, DT, timeout=0.1)
    listener.close()


def test_a_frame_must_fit_into_a_sample():
    """420 bits at 115200 baud are 3.6 ms: too long for 1 ms; for 5 ms it fits, but not there and back."""
    with pytest.raises(
        ValueError,
        match="a frame takes 3.65 ms at 115200 baud, which is longer than a sample; give at least 420000 baud",
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
        ("serial://", "must be serial://PORT"),
        ("serial:///dev/ttyUSB0?baud=fast", "must be serial://PORT"),
        ("serial:///dev/ttyUSB0?baud=0", "must be serial://PORT"),
        ("serial:///dev/ttyUSB0?parity=odd", "must be serial://PORT"),
        ("udp:///dev/ttyUSB0", "must be serial://PORT"),
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


def test_a_port_has_one_user(rig):
    """The second is told that there is a first."""
    with opened(rig) as device, pytest.raises(ValueError, match="another program uses it"):
        SerialDevice(device.url, DT)


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
    with pytest.raises(ImportError, match=r"pip install 'quell\[serial\]'"):
        SerialDevice("serial:///dev/ttyS0", DT)
