"""Modes of a y that rings while u rests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.identification import free_swing

from .commands import Shown

DT = 2e-3
T = np.arange(1200) * DT


def swing(*modes: tuple[float, float, float], noise: float = 0.0) -> Any:
    """Return y about 2 for modes (frequency in Hz, damping, amplitude)."""
    y = 2.0 + noise * np.random.default_rng(0).standard_normal(T.size)
    for i, (hertz, zeta, size) in enumerate(modes):
        w = 2.0 * np.pi * hertz
        y += size * np.exp(-zeta * w * T) * np.cos(w * np.sqrt(1.0 - zeta**2) * T + i)
    return y


MODES = [(12.0, 0.03, 0.5), (31.0, 0.01, 0.2), (4.0, 0.15, 0.4)]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_as_many_modes_as_there_are_come_back(count: int) -> None:
    """Without noise exactly, with noise within three half widths; the offset, too."""
    exact = free_swing(swing(*MODES[:count]), DT)
    noisy = free_swing(swing(*MODES[:count], noise=2e-3), DT)
    assert len(exact.modes) == len(noisy.modes) == count
    assert exact.at_rest == pytest.approx(2.0, abs=1e-6)
    for hertz, zeta, size in MODES[:count]:
        mode = min(exact.modes, key=lambda one: abs(one.frequency - hertz))
        assert (mode.frequency, mode.damping) == pytest.approx((hertz, zeta), rel=1e-6)
        assert mode.amplitude == pytest.approx(size, rel=1e-5)
        near = min(noisy.modes, key=lambda one: abs(one.frequency - hertz))
        for value, (low, high), truth in (
            (near.omega, near.omega_interval, 2.0 * np.pi * hertz),
            (near.damping, near.damping_interval, zeta),
        ):
            assert low < value < high
            assert abs(value - truth) < 1.5 * (high - low)
            assert high - low < 0.05 * truth
    assert [mode.amplitude for mode in exact.modes] == sorted(
        (mode.amplitude for mode in exact.modes), reverse=True
    )


def test_a_number_of_modes_that_is_given_is_taken() -> None:
    """One of two: the larger one is in it, and the fit tells that something is left."""
    found = free_swing(swing(*MODES[:2]), DT, modes=1)
    assert len(found.modes) == 1
    assert found.fit < 90.0 < free_swing(swing(*MODES[:2]), DT, modes=2).fit


@pytest.mark.parametrize(
    ("y", "options", "message"),
    [
        (np.exp(-T), {"modes": 1}, "y does not ring"),
        (np.random.default_rng(0).standard_normal(500), {}, "does not ring, nor does it decay: no"),
        (np.full(400, 3.0), {}, "y is 3 all through: must ring or decay"),
        (swing(MODES[0])[:11], {}, "y has 11 samples: must have at least 20 for each mode"),
        (swing(MODES[0])[:15], {"modes": 1}, "has 15 samples: must have at least 20 for each mode"),
        (swing(MODES[0]), {"modes": 6}, "modes = 6: must be a whole number from 0 to 5"),
        (np.append(swing(MODES[0]), np.nan), {}, r"y: entry \(1200,\) is nan"),
    ],
)
def test_what_is_no_free_swing_is_refused(y: Any, options: dict[str, Any], message: str) -> None:
    """With the reason and what to record."""
    with pytest.raises(ValueError, match=message):
        free_swing(y, DT, **options)


def test_a_shaper_for_the_mode_leaves_no_vibration() -> None:
    """Frequency and damping are those that shapers take: of the true mode less than 0.1 % is left."""
    (mode,) = free_swing(swing((5.0, 0.02, 1.0), noise=1e-3), DT).modes
    shaper = ql.baselines.ZV(mode.omega, mode.damping)
    assert shaper.residual(2.0 * np.pi * 5.0, 0.02) < 1e-3


def test_the_command_finds_the_modes_of_a_record_in_which_u_rests(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Text, JSON and figure; options of a u that moves are refused."""
    rows = np.column_stack([T, np.full(T.size, 1.5), swing(*MODES[:2], noise=1e-3)])
    np.savetxt(tmp_path / "swing.csv", rows, delimiter=",", header="t [s],u,y", comments="")
    shown = quell("identify", "swing.csv", "--json", "modes.json", "--figures", "seen")
    assert shown.code == 0, shown.err
    assert "mode at 12" in shown.out
    assert "mode at 3" in shown.out
    assert (tmp_path / "modes.json").is_file()
    assert (tmp_path / "seen" / "identified.png").is_file()
    refused = quell("identify", "swing.csv", "--order", "2", "--no-figures")
    assert refused.code == 2
    assert "--order: is for a u that moves" in refused.err


@pytest.mark.parametrize(("begin", "end"), [(20.0, 150.0), (90.0, 0.0)])
def test_a_decay_of_twenty_samples_has_its_time_constant_and_its_end(
    begin: float, end: float
) -> None:
    """A heat-up and a coast-down; it is no swing, however much a damped mode could fit."""
    t = 5.0 * np.arange(20)
    y = end + (begin - end) * np.exp(-t / 40.0) + np.random.default_rng(1).standard_normal(20)
    found = free_swing(y, 5.0)
    assert found.modes == ()
    assert found.decay is not None
    for value, (low, high), truth in (
        (found.decay.time_constant, found.decay.interval, 40.0),
        (found.at_rest, found.at_rest_interval, end),
    ):
        assert low < value < high
        assert abs(value - truth) < 1.5 * (high - low)
    assert found.decay.interval[1] - found.decay.interval[0] < 10.0
    assert free_swing(y, 5.0, 0).decay == found.decay
    with pytest.raises(ValueError, match="does not ring"):
        free_swing(y, 5.0, 1)


def test_a_straight_line_has_no_time_constant_and_noise_does_not_decay() -> None:
    """Both are refused; a decay that the record hardly shows is said with NOT."""
    noise = 0.5 * np.random.default_rng(0).standard_normal(40)
    with pytest.raises(ValueError, match="as a straight line or faster"):
        free_swing(np.arange(40.0) ** 1.2 + noise, 1.0, 0)
    hardly = free_swing(100.0 * (1.0 - np.exp(-np.arange(40.0) / 150.0)) + 2.0 * noise, 1.0, 0)
    assert "NOT: the record does not decide the time constant" in str(hardly)
    with pytest.raises(ValueError, match="y does not decay"):
        free_swing(np.random.default_rng(0).standard_normal(40), 1.0, 0)
    with pytest.raises(ValueError, match="y has 5 samples: must have at least 12"):
        free_swing(np.arange(5.0), 1.0, 0)


def test_the_command_finds_the_time_constant_of_a_heat_up(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """With the gain for a start at rest without u."""
    t = 5.0 * np.arange(20)
    rows = np.column_stack([t, np.full(20, 50.0), 150.0 - 130.0 * np.exp(-t / 40.0)])
    np.savetxt(tmp_path / "heat.csv", rows, delimiter=",", header="t [s],u,y", comments="")
    shown = quell("identify", "heat.csv", "--json", "decay.json", "--no-figures")
    assert shown.code == 0, shown.err
    assert "time constant of 40 s" in shown.out
    assert "the gain is 2.6" in shown.out
    assert (tmp_path / "decay.json").is_file()
