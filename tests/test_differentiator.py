"""Han's tracking differentiator against what it is for: the shortest way within a limit, without overshoot."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quell.controllers import Prefiltered
from quell.controllers.baselines import PID
from quell.controllers.prefilters import (
    TrackingDesign,
    TrackingDifferentiator,
    TrackingMemory,
    fhan,
    prefilter,
)
from quell.kernels.dispatch import compiled, interpreted
from quell.types import Matrix, Vector


@compiled
def follow(design: TrackingDesign, memory: TrackingMemory, r: Vector, v: Matrix) -> None:
    """Run through a reference; write v_1 and v_2 (k, 2)."""
    for k in range(r.size):
        v[k, 0] = prefilter(design, memory, r[k])
        v[k, 1] = memory.v[1]


def profile(
    acceleration: float, dt: float, r: np.ndarray, horizon: float | None = None
) -> np.ndarray:
    """Return v_1 and v_2 for a reference, from rest at zero."""
    differentiator, v = TrackingDifferentiator(acceleration, horizon), np.empty((r.size, 2))
    design = differentiator.design(dt)
    follow(design, differentiator.memory(design), r, v)
    return v


@given(
    size=st.floats(0.01, 100.0),
    acceleration=st.floats(0.1, 100.0),
    dt=st.sampled_from([1e-3, 1e-2]),
)
def test_a_step_is_followed_in_the_least_time_without_overshoot(
    size: float, acceleration: float, dt: float
) -> None:
    """Half the way at +r_0, half at −r_0: ``2 √(size/r_0)``, and four samples more at the most; beyond r it goes by r_0 h² at the most."""
    shortest = 2.0 * np.sqrt(size / acceleration)
    v = profile(acceleration, dt, np.full(round(1.5 * shortest / dt) + 40, size))
    assert np.max(v[:, 0]) <= size + acceleration * dt**2
    arrived = int(np.argmax(v[:, 0] >= size * (1.0 - 1e-6)))
    assert shortest / dt - 1.0 - 2e-3 * shortest / dt <= arrived <= shortest / dt + 4.0
    assert np.max(np.abs(np.diff(v[:, 1]))) <= acceleration * dt * (1.0 + 1e-9)


def test_the_second_output_is_the_derivative_of_the_first() -> None:
    """By Euler's rule exactly; of a sine that it can follow nearly so."""
    dt = 1e-3
    t = dt * np.arange(5000)
    v = profile(50.0, dt, np.sin(2.0 * t))
    np.testing.assert_allclose(np.diff(v[:, 0]), dt * v[:-1, 1], atol=1e-12)
    np.testing.assert_allclose(v[2000:, 1], 2.0 * np.cos(2.0 * t[2000:]), atol=0.1)


def test_a_longer_horizon_filters_noise() -> None:
    """The derivative of a noisy reference: ten samples of horizon let a third of it through, or less."""
    noisy = 1e-3 * np.random.default_rng(2).normal(size=5000)
    rough, smooth = (
        float(np.std(profile(20.0, 1e-3, noisy, horizon)[:, 1])) for horizon in (None, 1e-2)
    )
    assert smooth < 0.33 * rough


def test_it_is_a_kernel_and_the_same_interpreted() -> None:
    """One function, compiled and not."""
    differentiator, v = TrackingDifferentiator(3.0), np.empty((200, 2))
    design = differentiator.design(0.01)
    interpreted(follow)(design, differentiator.memory(design), np.ones(200), v)
    np.testing.assert_allclose(profile(3.0, 0.01, np.ones(200)), v, atol=1e-12)
    assert fhan(0.0, 0.0, 1.0, 0.1) == 0.0


def test_it_starts_again_at_y_when_an_absurd_reference_took_it_far_from_where_the_loop_is() -> None:
    """After 1000 samples in which y is 100 times nearer to r; at once, it would be 50 000 samples."""
    shaped = Prefiltered(PID(kp=1.0, dt=0.01, u_min=-1.0, u_max=1.0), TrackingDifferentiator(20.0))
    shaped.step(0.0, 0.0)
    memory = shaped._state.prefilter
    memory.v[:] = 1e6, 1e4
    for k in range(999):
        shaped.step(0.0, 1.0 if k % 3 else math.nan)
    assert memory.v[0] > 1e6
    for _ in range(333):
        shaped.step(0.0, 1.0)
    assert memory.v[0] > 1e6
    shaped.step(0.0, 1.0)
    assert 1.0 >= memory.v[0] > 0.9
    assert memory.loop[0].far == 0.0


def test_a_loop_that_follows_it_never_makes_it_start_again() -> None:
    """Also when r returns to y in motion, and when both are at rest at r exactly."""
    shaped = Prefiltered(PID(kp=1.0, dt=0.01), TrackingDifferentiator(2.0))
    y, alone = 0.0, TrackingDifferentiator(2.0)
    design = alone.design(0.01)
    memory = alone.memory(design)
    for k in range(4000):
        r = 100.0 if k < 500 else 20.0
        shaped.step(r, y)
        v = shaped._state.prefilter.v
        assert v[0] == prefilter(design, memory, r)
        y += 0.05 * (v[0] - y)
    assert abs(y - 20.0) < 1e-3


@pytest.mark.parametrize(
    ("acceleration", "horizon", "dt", "message"),
    [
        (0.0, None, 0.01, "acceleration = 0.0"),
        (1.0, -1.0, 0.01, "horizon = -1.0"),
        (1.0, 0.005, 0.01, "at least a sample"),
    ],
)
def test_bad_input_is_named(
    acceleration: float, horizon: float | None, dt: float, message: str
) -> None:
    """Argument, value and rule."""
    with pytest.raises(ValueError, match=message):
        TrackingDifferentiator(acceleration, horizon).design(dt)
