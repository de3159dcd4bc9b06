"""Controllers on a device: their telemetry, and exported ones in the emulator of a Cortex-M."""

import math
import threading
import types

import numpy as np
import pytest

from quell.realtime import open_device, record_target
from quell.realtime.wire import frames
from quell.realtime.wire.serial_line import SerialListener
from quell.realtime.wire.transport import receive, send, wait_for_frame
from quell.signals import Sinusoid
from quell.types import Status

pytest.importorskip("serial")
DT = 1e-3
CHANNELS = (("r", 1), ("u", 1), ("x_hat", 2), ("status", 1))


class Target(threading.Thread):
    """A device that computes u = 2 r at each command; ``lost`` frames are not sent, ``end`` after the tick ``last``."""

    def __init__(self, lost=(), extra=0, last=10**6, end=frames.GOODBYE):
        super().__init__(daemon=True)
        self.line = SerialListener("serial://pty")
        self.lost, self.extra, self.last, self.end = lost, extra, last, end
        self.own = frames.endpoint(frames.COMMAND, 0, 20)
        self.begin = threading.Event()
        self.start()

    def send(self, kind, number, value, state=0):
        """Send a frame of the session."""
        out, own = frames.buffer(), self.own.numbers
        frames.write_frame(
            out, kind, own[frames.SESSION], number, own[frames.RECEIVED], 0, value, state
        )
        send(self.line.transport, out)

    def tick(self, r):
        """Send y and the telemetry of a tick."""
        self.own.numbers[frames.SENT] += 1
        k = int(self.own.numbers[frames.SENT])
        if k > self.last:
            if self.end is not None:
                self.send(self.end, k, 0.0, frames.WATCHDOG_TRIPPED)
            return
        values = (r, 2.0 * r, 10.0 + k, -1.0, 4.0, *[0.0] * self.extra)
        for channel, value in ((-1, k / 8.0), *enumerate(values)):
            if (k, channel) not in self.lost:
                kind = frames.MEASUREMENT if channel < 0 else frames.TELEMETRY
                self.send(kind, k, value, max(channel, 0))

    def run(self):
        """Answer frames until the session ends."""
        frame = frames.buffer()
        while True:
            wait_for_frame(self.line.transport, 10**8)
            if receive(self.line.transport, frame) < 0:
                continue
            if frame.bytes[3] == frames.HELLO and self.own.numbers[frames.SESSION] == 0:
                frames.start_session(self.own, int(frame.words[1]))
                self.send(frames.WELCOME, 0, DT)
                self.tick(0.0)
            elif frame.bytes[3] == frames.GOODBYE:
                return
            elif frames.accept(frame, self.own):
                self.tick(float(frame.doubles[3]))


def recorded(target, reference, duration, channels=CHANNELS, **options):
    """A record of the target; its line is closed."""
    try:
        with open_device(target.line.url, DT) as device:
            return record_target(device, reference, channels, duration, **options)
    finally:
        target.join(5.0)
        target.line.close()
        assert not target.is_alive()


def test_telemetry_becomes_a_trajectory():
    """From the first tick at which a reference acts; r, u and y are those of the same tick."""
    reference = Sinusoid(amplitude=2.0, omega=300.0)
    run = recorded(Target(), reference, 5 * DT)
    assert np.array_equal(run["r"], reference(np.arange(6) * DT))
    assert np.array_equal(run["u"], 2.0 * run["r"])
    assert np.array_equal(run["y"], np.arange(2, 8) / 8.0)
    assert np.array_equal(run["x_hat"], [[10.0 + k, -1.0] for k in range(2, 8)])
    assert run.status == Status.SATURATED
    assert run.dt == DT


def test_lost_telemetry_is_no_number():
    """A frame that has not come is NaN at its place; the others are at theirs."""
    run = recorded(Target(lost={(4, 1), (5, 4)}), 1.0, 5 * DT)
    gaps = np.argwhere(np.isnan(run.log)).tolist()
    assert gaps == [[2, 2], [3, 5]]
    assert run.status == Status.SATURATED


@pytest.mark.parametrize(
    ("target", "error", "message"),
    [
        ({"extra": 1}, ValueError, "5 numbers are named, and it has sent one with the index 5"),
        ({"last": 3}, ConnectionError, "the device has ended the session"),
        ({"last": 3, "end": None}, ConnectionError, "nothing has come for 0.2 s"),
        ({"last": 3, "end": frames.MEASUREMENT}, ConnectionError, "no reference came in time"),
    ],
)
def test_a_record_that_can_not_be_made_is_an_error(target, error, message):
    """More channels than are named; a device that ends the session, is silent, or has tripped."""
    with pytest.raises(error, match=message):
        recorded(Target(**target), 1.0, 0.1, timeout=0.2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"channels": (("r", 1),)}, "must have r and u"),
        ({"channels": (("r", 1), ("u", 2))}, "must have r and u"),
        ({"channels": (("r", 1), ("u", 1), ("y", 1))}, "each once"),
        ({"duration": 0.0}, "duration = 0.0: must be"),
        ({"timeout": -1.0}, "timeout = -1.0: must be"),
        ({"reference": math.nan}, "reference = nan"),
    ],
)
def test_wrong_arguments_are_named_before_anything_is_sent(options, message):
    """The device is not touched: there is none here."""
    device = types.SimpleNamespace(dt=DT)
    given = {"reference": 1.0, "channels": CHANNELS, "duration": 0.1} | options
    with pytest.raises(ValueError, match=message):
        record_target(device, **given)
