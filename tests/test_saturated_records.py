"""A y or u that stands at an extreme: a saturated sensor is named and bounded, rest and levels are not."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import quell as ql
from quell.identification.given_records import resolution_of
from quell.identification.saturation import standing

from .test_record_faults import DT, answer, noise, random_steps


def stairs(count: int = 1500, of: int = 30) -> Any:
    """Return u of random steps."""
    return np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, count // of + 1), of)[:count]


@pytest.mark.trial
@pytest.mark.parametrize("quantum", [0.0, 0.01])
def test_samples_at_a_limit_are_named_and_bounded(quantum: float) -> None:
    """A third of them: gain and poles are those of the plant, within three half widths."""
    u = stairs()
    y = answer([9.0], [1.0, 1.2, 9.0], u) + noise(u.size, 2e-3)
    y = np.clip(quantum * np.round(y / quantum) if quantum else y, -0.6, 0.6)
    found = ql.identify(u, y, DT, order=2, delay=0.0)
    assert 0.2 < found.at_limits / y.size < 0.5
    low, high = found.gain_interval
    assert abs(found.gain - 1.0) < 1.5 * (high - low) < 0.02
    assert found.den[1:] == pytest.approx([1.2, 9.0], rel=5e-3)
    assert f"y stands at a limit in {found.at_limits} samples" in str(found)
    assert found.shortcomings == ()


@pytest.mark.parametrize(
    "y",
    [
        answer([2.0], [1.0, 2.0], random_steps(3000, of=300)),
        0.02 * np.round(answer([2.0], [1.0, 2.0], random_steps(3000, of=300)) / 0.02),
        0.1 * np.round(np.sin(0.02 * np.arange(3000.0)) / 0.1),
        np.repeat([0.0, 1.0, 0.4], 500),
        random_steps(1500),
        np.maximum(np.arange(2000.0) - 500.0, 0.0) ** 2,
    ],
)
def test_what_settles_rests_or_has_levels_stands_at_no_limit(y: Any) -> None:
    """Steps that end, a rounded sine, levels, and a start from rest."""
    assert standing(y, resolution_of(y)).samples == 0


def test_a_u_at_the_limits_of_its_actuator_is_named_without_not() -> None:
    """Of a controller that asks for more; the model of what acts is right."""
    rng, a = np.random.default_rng(3), np.exp(-2.0 * DT)
    x, u, y = 0.0, np.zeros(2000), np.zeros(2000)
    for k in range(u.size):
        y[k] = x + 0.01 * rng.standard_normal()
        u[k] = np.clip(4.0 * (np.sign(np.sin(0.02 * k)) - y[k]), -3.0, 3.0)
        x = a * x + (1.0 - a) * u[k]
    found = ql.identify(u, y, DT, order=1)
    assert "u stands at a limit in" in str(found)
    assert found.shortcomings == ()
    assert found.gain == pytest.approx(1.0, rel=0.02)


def test_a_position_that_is_constant_while_it_has_noise_elsewhere_is_at_its_limit() -> None:
    """A quarter of a record of steps; a position without noise may rest there."""
    rng = np.random.default_rng(1)
    u = np.repeat([-0.5, -0.6, -0.5, -0.6, 0.1, -0.3, -0.1, 0.4, -0.2, 0.0], 300)
    clean = answer([600.0], [1.0, 3.0, 0.0], u)
    y = np.minimum(clean + 1e-3 * rng.standard_normal(u.size), clean[700])
    assert 600 < standing(y, 0.0, u).samples < 800
    assert standing(np.minimum(clean, clean[700]), 0.0, u).samples == 0
    found = ql.identify(u, y, DT, order=2, integrators=1, delay=0.0)
    assert found.gain == pytest.approx(200.0, rel=0.01)
    assert found.shortcomings == ()


@pytest.mark.parametrize("quantum", [0.0, pytest.param(0.004, marks=pytest.mark.trial)])
def test_a_record_that_begins_at_a_limit_is_taken_from_its_first_free_sample(
    quantum: float,
) -> None:
    """What y was before follows from a start that is not shown; u acts with a delay after it."""
    rng, dt = np.random.default_rng(3), 0.01
    u = np.repeat(np.sign(rng.standard_normal(150)), 4)
    late = np.append(np.full(3, u[0]), u)[: u.size]
    y = lfilter([0.0, 0.04], [1.0, -0.98], late) + 6.0 * 0.98 ** np.arange(u.size)
    y = np.minimum(y + 1e-3 * rng.standard_normal(u.size), 3.0)
    y = quantum * np.round(y / quantum) if quantum else y
    found = ql.identify(u, y, dt, 1, delay=None, held_out=0.0)
    begins = int(np.argmax(y < np.max(y)))
    assert begins > 20
    assert begins <= found.left_out <= begins + 8
    assert f"the first {found.left_out} samples are left out" in str(found)
    assert found.delay == pytest.approx(0.03, abs=1e-3)
    assert found.den[1] == pytest.approx(-math.log(0.98) / dt, rel=5e-3)
    assert found.shortcomings == ()


def test_a_y_that_is_at_its_limit_most_of_the_time_stands_there() -> None:
    """Two samples in three, without rounding, so that its median step is zero; a y that is held for three samples stands nowhere."""
    y = np.cumsum(np.random.default_rng(1).standard_normal(1500)) * 0.01 + np.sin(
        0.03 * np.arange(1500.0)
    )
    at = standing(np.minimum(y, np.quantile(y, 0.35)), 0.0)
    assert at.samples == pytest.approx(0.65 * y.size, abs=2)
    assert at.is_usable
    assert standing(np.repeat(y[::3], 3), 0.0).samples == 0


@pytest.mark.trial
def test_three_samples_in_four_at_a_limit_leave_poles_with_deviations_that_hold() -> None:
    """Of the samples that are free alone: rounds that fit bounds like y go slowly, and count them as known."""
    u, miss = stairs(2400, of=24), []
    clean = answer([90.0], [1.0, 1.2, 90.0], u)
    for seed in range(3):
        y = np.minimum(clean + noise(u.size, 2e-3, seed), float(np.quantile(clean, 0.25)))
        found = ql.identify(u, y, DT, order=2, delay=0.0)
        assert found.at_limits > 0.6 * y.size
        assert found.shortcomings == ()
        spread = np.sqrt(np.diag(found.covariance))[:2]
        assert np.all(spread < 0.01 * np.array([90.0, 1.2]) * np.array([1.0, 5.0]))
        miss += [*((found.den[:0:-1] - [90.0, 1.2]) / spread)]
    assert max(abs(each) for each in miss) < 3.5
