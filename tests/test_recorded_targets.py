"""The record of a controller on a device, frame by frame; kernels of constants in C."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import quell as ql
from quell.realtime import target, wire
from quell.realtime.target import record_target
from quell.types import Status

from .cases import cases
from .in_c import needs_gcc
from .test_translate import NUMBERS, Design, State, compiled, new_design, new_state

CHANNELS = (("r", 1), ("u", 1), ("status", 1))


class Device:
    """A device that answers each reference with the frames of the next tick."""

    dt = 0.1
    url = "serial:none"

    def __init__(self, lost: Any = (), acting: int = 3) -> None:
        self.written: list[float] = []
        self.tick, self.lost, self.acting = 0, lost, acting
        endpoint = SimpleNamespace(numbers=np.zeros(20, dtype=np.int64))
        self.handle = SimpleNamespace(endpoint=endpoint, transport=None)

    def write(self, r: float) -> None:
        """Take a reference."""
        self.written.append(r)

    def frames(self, *_: Any) -> np.ndarray:
        """Return y = tick and what the program has used, from the tick on at which r acts."""
        self.tick += 1
        acts = float(self.tick >= self.acting)
        used = self.written[-1] if self.written else 0.0
        rows = [[self.tick, -1, 10.0 + self.tick, acts]]
        rows += [[self.tick, k, value, acts] for k, value in enumerate((used, -used, 4.0))]
        return np.array([row for row in rows if (row[0], row[1]) not in self.lost], dtype=float)


def record(
    device: Device, reference: Any = 2.0, duration: float = 0.4, channels: Any = CHANNELS
) -> Any:
    """Return the record of a device."""
    with patch.object(target, "_received", device.frames):
        return record_target(device, reference, channels, duration)  # type: ignore[arg-type]


def test_a_record_begins_where_the_first_reference_acts() -> None:
    """Each measurement is answered with the reference of the next tick; y is the measurement."""
    device = Device()
    run = record(device, ql.signals.Ramp(10.0))
    assert run["y"].tolist() == [13.0, 14.0, 15.0, 16.0, 17.0]
    np.testing.assert_allclose(device.written[:7], [0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    np.testing.assert_allclose(run["r"], [0.0, 1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(run["u"], -run["r"])
    assert run.status == Status(4)
    assert run.plant == "serial:none"
    assert (len(run), run.ended) == (5, pytest.approx(0.4))


def test_a_frame_that_is_lost_is_no_number() -> None:
    """Of a channel, and of a measurement, which is then not answered."""
    run = record(Device(lost={(4, 1), (5, 2)}))
    assert np.isnan(run["u"]).tolist() == [False, True, False, False, False]
    assert np.isnan(run["status"]).tolist() == [False, False, True, False, False]
    assert not np.isnan(run["y"]).any()
    silent = Device(lost={(5, -1)})
    run = record(silent)
    assert np.isnan(run["y"]).tolist() == [False, False, True, False, False]
    whole = Device()
    record(whole)
    assert len(silent.written) == len(whole.written) - 1


@cases(
    ("channels", "message"),
    [
        (
            (("u", 1),),
            "channels = ['u']: must have r and u, of width 1, and other names, each once; y is",
        ),
        ((("r", 2), ("u", 1)), "channels = ['r', 'u']: must have r and u, of width 1"),
        ((("r", 1), ("u", 1), ("u", 1)), "channels = ['r', 'u', 'u']: must have r and u"),
        ((("r", 1), ("u", 1), ("y", 1)), "channels = ['r', 'u', 'y']: must have r and u"),
    ],
)
def test_channels_have_r_and_u_and_each_name_once(channels: Any, message: str) -> None:
    """And y is theirs."""
    with pytest.raises(ValueError) as caught:
        record(Device(), channels=channels)
    assert str(caught.value).startswith(message)


def test_a_program_that_sends_more_or_a_reference_that_is_none_is_refused() -> None:
    """With how many numbers are named; and a duration, a wait or a reference out of range."""
    message = "channels: must be all that the program sends; 2 numbers are named, and it has sent one with the index 2"
    with pytest.raises(ValueError, match=message):
        record(Device(), channels=CHANNELS[:2])
    with (
        patch.object(target, "as_signal", lambda *_: lambda t: np.where(t > 0.3, np.nan, 1.0)),
        pytest.raises(ValueError, match="reference: must be finite over the whole duration"),
    ):
        record(Device())
    with pytest.raises(ValueError, match="duration"):
        record(Device(), duration=0.0)
    with pytest.raises(ValueError, match="timeout"):
        record_target(Device(), 1.0, CHANNELS, 0.4, timeout=0.0)  # type: ignore[arg-type]


def test_a_device_that_is_gone_or_not_followed_ends_the_record() -> None:
    """And one from which nothing comes for the time that is given."""
    device: Any = Device()
    target._check_state(device)
    numbers = device.handle.endpoint.numbers
    numbers[wire.STATE] = wire.GONE
    with pytest.raises(ConnectionError, match="^serial:none: the device has ended the session$"):
        target._check_state(device)
    numbers[wire.STATE] = wire.WATCHDOG_TRIPPED
    with pytest.raises(
        ConnectionError, match="no reference came in time, and the device no longer"
    ):
        target._check_state(device)
    numbers[wire.STATE] = 0
    waits: list[int] = []
    with (
        patch.object(target, "specialised", lambda take, *_: lambda handle, values: 0),
        patch.object(target, "wait_for_frame", lambda transport, left: waits.append(left)),
        pytest.raises(ConnectionError, match="^serial:none: nothing has come for 0.01 s$"),
    ):
        target._received(device, 0.01)
    assert 0 < waits[0] <= 10_000_000

    def take(handle: Any, values: np.ndarray) -> int:
        values[:2] = 5.0
        return 2

    with (
        patch.object(target, "specialised", lambda *_: take),
        patch.object(target, "wait_for_frame", lambda *_: None),
    ):
        assert target._received(device, 1.0).tolist() == [[5.0] * 4] * 2


# ---- constants in kernels

_TABLE = (1.5, -2.0, 4.0)
_MATRIX = np.array([[1.0, 2.0], [3.0, -4.0]])
_SCALE = np.float64(0.25)
_ON, _OFF = True, False
_COUNT = 3
_FAR = math.inf


def constants(design: Design, state: State, a: float, b: float) -> float:
    """Use numbers, tuples and arrays of the module, and functions of constants."""
    found = (
        _TABLE[0] + _MATRIX[1, 1] * _SCALE + len(_TABLE) + abs(-_COUNT) + int(2.75) + float(_COUNT)
    )
    found += max(_COUNT, 1, 7) - min(2.0, _SCALE) + 7 // 2 + (-7) // 2 + 7 % 3 + 2.0**3
    found += math.sqrt(16.0) + math.floor(2.5) + (1.0 if _ON else 0.0)
    found += (8.0 if a > 0.0 and _ON else 0.0) + (16.0 if _ON and a > b else 0.0)
    found += (32.0 if a > 1.0 and _OFF else 0.0) + (64.0 if a > 1.0 or _OFF else 0.0)
    found += (128.0 if _OFF or b > 0.0 else 0.0) + (256.0 if b > 0.0 or _ON else 0.0)
    if a == _FAR:
        found += 100.0
    n = 2
    for i in range(2):
        part = design.gain[i : i + n]
        found += part[0] * 0.5 + part[1]
    return found + (b if b == b else 0.0)


def integers(design: Design, state: State, a: float, b: float) -> float:
    """Use whole numbers: absolute values, extremes, quotients and remainders, flags."""
    bounded = min(max(a, -9.0), 9.0) if a == a else 0.0
    whole = int(bounded)
    flag = bool(whole)
    low, high = min(whole, 3), max(whole, -2)
    result = abs(whole) + 10 * low + 100 * high + (whole // 4) * 1000 + (whole % 4) * 0.5
    result += 0.25 if flag else 0.125
    return (
        result + math.floor(bounded * 0.5) + math.ceil(bounded * 0.25) - (0.0 if not flag else 1.0)
    )


@needs_gcc
@cases("function", [constants, integers])
def test_kernels_of_constants_and_whole_numbers_are_the_same_in_c(
    function: Any, tmp_path: Path
) -> None:
    """For all pairs of numbers."""
    design = new_design()
    in_c, state = compiled(tmp_path, function, design), new_state()
    with np.errstate(all="ignore"):
        for a, b in itertools.product((*NUMBERS, 3.0, -3.7, 8.0), NUMBERS):
            expected = float(function(design, state, np.float64(a), np.float64(b)))
            found = in_c(a, b)
            assert found == expected or (found != found and expected != expected), (a, b)
