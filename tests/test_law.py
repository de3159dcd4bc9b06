"""The control law, one interpreted sample at a time: what it does with what is held, cut or reset."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.base import (
    Limits,
    apply_limits,
    control,
    largest_wish,
    reset_loop,
    set_reference_derivatives,
    write_row,
)
from quell.controllers.law import _finish_sample, unlimited_control
from quell.controllers.stateful import named_arrays
from quell.guard import nearest_permitted
from quell.learners.base import commit, restart
from quell.types import Status

from .cases import cases

DT = 0.01
OBSERVER = ql.ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=DT)
LEARNING = ql.ADRC(OBSERVER, 3.0, learner=ql.learners.Kalman(), guard=ql.Guard())


def step(law: ql.ADRC, r: float, y: float, *derivatives: float) -> float:
    """Take a sample, interpreted."""
    set_reference_derivatives(law.parameters, law._state, np.array(derivatives))
    with np.errstate(over="ignore", invalid="ignore"):
        return control(law.parameters, law._state, r, y)


def used(law: ql.ADRC, samples: int = 150) -> ql.ADRC:
    """Return a copy that has seen a motion."""
    law = copy.deepcopy(law)
    for k in range(samples):
        step(law, math.sin(0.03 * k), math.sin(0.03 * k - 0.4) + 0.2 * math.sin(0.11 * k))
    return law


def test_a_learner_does_not_learn_from_a_measurement_that_is_held() -> None:
    """It only goes on with its filters, as after any sample: the expected y is no news."""
    law = used(LEARNING)
    expected = copy.deepcopy(law._state.learner)
    # What the sample does before y comes: the last u has acted.
    loop = law._state.loop[0]
    commit(law.parameters.learner, expected, law._state.estimates, loop.u, loop.f_learned)
    step(law, 0.3, math.nan)
    found = named_arrays(law._state.learner)
    for name, array in named_arrays(expected).items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)
    step(law, 0.3, 0.3)
    assert law._state.learner.averages[0].time > expected.averages[0].time


@pytest.mark.parametrize("own_channel", [False, True])
def test_f_is_cancelled_where_it_enters_as_u_does(
    own_channel: bool, rng: np.random.Generator
) -> None:
    """``u = (k (r − x̂) − f_L − Δf̂ + a·x̂) / (b0 + s)``; else neither f nor the slope s counts."""
    A, C, E = [[0.0, 1.0], [-2.0, -0.6]], [1.0, 0.0], [0.0, 1.0]
    plant = (A, [1.5, 4.5], E, C) if own_channel else (A, [0.0, 1.5], C)
    observer = ql.ESO.model_based(plant, 20.0, DT)
    law = ql.ADRC(observer, 3.0, learner=ql.learners.Kalman(u=True))
    state = law._state
    state.loop[0].r = r = 0.7
    state.estimates[:] = seen = rng.normal(size=3)
    constant, slope = 0.9, 0.4
    if own_channel:  # of degree 1: y' = x̂_2 + b0 u
        wish = (3.0 * (r - seen[0]) - seen[1]) / 1.5
    else:
        u_0 = 9.0 * (r - seen[0]) - 6.0 * seen[1] + 2.0 * seen[0] + 0.6 * seen[1]
        wish = (u_0 - seen[2] - constant) / (1.5 + slope)
    found = unlimited_control(law.parameters, state, constant, slope)
    assert found == pytest.approx(wish, rel=1e-12)


def test_a_reference_derivative_that_is_no_number_counts_as_zero() -> None:
    """Also one that is missing, or beyond any quantity; the others keep their places."""
    law = used(ql.ADRC(OBSERVER, 3.0, feedforward=True), 20)
    for bad in (math.nan, math.inf, -math.inf, 1e300):
        assert step(copy.deepcopy(law), 1.0, 0.9, bad, 0.4) == step(
            copy.deepcopy(law), 1.0, 0.9, 0.0, 0.4
        )
        assert step(copy.deepcopy(law), 1.0, 0.9, 0.4, bad) == step(
            copy.deepcopy(law), 1.0, 0.9, 0.4
        )
    assert step(copy.deepcopy(law), 1.0, 0.9, 0.4) != step(copy.deepcopy(law), 1.0, 0.9, 0.0, 0.4)


@pytest.mark.parametrize("bad", [1.1e60, -1e300])
def test_a_measurement_beyond_any_quantity_is_held(bad: float) -> None:
    """As one that is not finite; one of 1e60 is taken."""
    one, other = used(ql.ADRC(OBSERVER, 3.0), 20), used(ql.ADRC(OBSERVER, 3.0), 20)
    assert step(one, 1.0, bad) == step(other, 1.0, math.nan)
    assert step(one, bad, 0.5) == step(other, math.nan, 0.5)
    assert one.estimate.status == Status.REFERENCE_HELD
    step(one, 1.0, 1e60)
    assert not one.estimate.status & Status.MEASUREMENT_HELD


@pytest.mark.parametrize("linear", [False, True])
def test_without_limits_u_stays_within_what_can_be_measured(linear: bool) -> None:
    """A larger u would drive y to where no measurement counts; the last u holds instead."""
    pid = ql.baselines.PID(8.0, 6.0, 3.0, tf=0.05, dt=DT)
    law: Any = used(pid if linear else ql.ADRC(OBSERVER, 3.0), 20)
    before = float(law._state.loop[0].u)
    assert step(law, 1.0, 9e59) == before != 0.0
    assert int(law._state.loop[0].status) & Status.OVERFLOWED
    assert abs(step(law, 1.0, 0.5)) < 1e60


def test_an_overflow_starts_everything_again_but_u() -> None:
    """U holds; estimate, learner's filters, lag filters and the offset of a hand-over begin anew."""
    law = used(LEARNING)
    before = law.estimate.u
    state = law._state
    state.loop[0].offset = 5.0
    state.z[:] = 1.7e308
    assert step(law, 1.0, 0.25) == before
    assert law.estimate.status & Status.OVERFLOWED
    np.testing.assert_array_equal(state.z, [0.25, 0.0, 0.0])
    loop = state.loop[0]
    assert (loop.offset, loop.constant, loop.slope, loop.f_learned) == (0.0, 0.0, 0.0, 0.0)
    assert not np.any(state.lag_state)
    assert not np.any(state.guard.chain)
    assert not np.any(state.learner.chain)
    assert np.isfinite(step(law, 1.0, 0.25))


def test_a_start_from_rest_resets_all_filters() -> None:
    """Of f_L, the guard and the learner, the guard's last output too; what was learned stays."""
    law = used(LEARNING, 400)
    state, design = law._state, law.parameters
    state.loop[0].offset = 1.0
    guard = state.guard.sample[0]
    assert guard.output != 0.0
    guard.target = guard.late_effect = 0.5
    theta, authority, share = state.learner.theta.copy(), guard.authority, guard.share
    reset_loop(design, state)
    assert not np.any(state.loop.view(float))
    filters = (state.guard.chain, state.guard.filtered, state.guard.effects, state.learner.chain)
    for each in (state.lag_state, *filters):
        assert not np.any(each)
    assert (guard.output, guard.target, guard.late_effect) == (0.0,) * 3
    assert guard.share == -share
    assert guard.authority == authority
    np.testing.assert_array_equal(state.learner.theta, theta)
    assert np.any(theta)
    restart(design.learner, state.learner)
    assert state.learner.averages[0].time == 0.0


def test_an_offset_fades_with_the_bandwidth_of_the_controller() -> None:
    """Added to u, it falls as ``exp(−omega_c t)``; too small to matter, it is gone."""
    law, plain = used(ql.ADRC(OBSERVER, 3.0), 20), used(ql.ADRC(OBSERVER, 3.0), 20)
    law._state.loop[0].offset = 2.0
    for k in range(1, 4):
        u, wished = step(law, 0.5, 0.2), unlimited_control(law.parameters, law._state, 0.0, 0.0)
        assert u - wished == pytest.approx(2.0 * math.exp(-3.0 * DT * (k - 1)), rel=1e-9)
        assert law._state.loop[0].offset == pytest.approx(2.0 * math.exp(-3.0 * DT * k), rel=1e-12)
    law._state.loop[0].offset = 9e-201
    step(law, 0.5, 0.2)
    assert law._state.loop[0].offset == 0.0
    step(plain, 0.5, 0.2)
    assert plain._state.loop[0].offset == 0.0


@pytest.mark.parametrize(
    ("limits", "offset", "kept"),
    [
        ({"u_min": -2.0, "u_max": 1.0}, 1e30, False),
        ({"u_min": -2.0, "u_max": 1.0}, -200.0, True),
        ({}, 1e30, True),
    ],
)
def test_an_offset_beyond_all_limits_of_u_is_dropped(
    limits: dict[str, float], offset: float, kept: bool
) -> None:
    """It comes from absurd estimates; at 100 times the limit, or without limits, it fades."""
    law = used(ql.ADRC(OBSERVER, 3.0, **limits), 20)
    law._state.loop[0].offset = offset
    step(law, 0.5, 0.2)
    left = offset * math.exp(-3.0 * DT) if kept else 0.0
    assert law._state.loop[0].offset == pytest.approx(left, rel=1e-12)


def test_only_limits_of_the_law_count_as_limits_for_the_watch() -> None:
    """Neither a u within them nor one of manual operation; see ``learners/base.py``."""
    law = ql.ADRC(OBSERVER, 3.0, learner=ql.learners.Kalman(), u_min=-1.0, u_max=1.0)
    watch = law._state.watch[0]
    step(law, 0.0, 0.0)
    assert (watch.samples, watch.limited) == (1.0, 0.0)
    step(law, 100.0, 0.0)
    assert (watch.samples, watch.limited) == (2.0, 1.0)
    law._state.loop[0].manual = 1.0
    step(law, 100.0, 0.0)
    assert (watch.samples, watch.limited) == (3.0, 1.0)


def test_a_row_has_estimates_status_guard_and_coefficients_in_order() -> None:
    """As ``channels`` names them."""
    law = used(LEARNING, 400)
    row = np.full(sum(width for _, width in law.channels), math.nan)
    write_row(law.parameters, law._state, row)
    estimate, guard = law.estimate, law._state.guard
    expected = [
        *(*estimate.x, estimate.f_residual, estimate.f_learned, int(estimate.status)),
        guard.sample[0].authority,
        math.sqrt(guard.averages[0].square),
        math.sqrt(guard.averages[0].square_left),
        guard.sample[0].reason,
        *estimate.theta.values(),
    ]
    np.testing.assert_array_equal(row, expected)
    assert estimate.theta["x1"] != 0.0


@pytest.mark.parametrize("slope", [0.3, -0.3])
def test_the_guard_bounds_the_output_for_the_u_that_was_applied_too(slope: float) -> None:
    """Which may differ from the u that the law gave; an output without slope was bounded before."""
    law = ql.ADRC(OBSERVER, 3.0, learner=ql.learners.Kalman(u=True), guard=ql.Guard())
    for k in range(30):
        step(law, 1.0, 0.1 * math.sin(0.3 * k))
    loop = law._state.loop[0]
    for used, bounded in ((slope, True), (0.0, False)):
        loop.constant, loop.slope = 2.0, used
        expected = 2.0 + used * 1e3
        permitted = nearest_permitted(law.parameters.guard, law._state.guard, expected)
        assert permitted != expected
        _finish_sample(law.parameters, law._state, 1e3)
        assert loop.f_learned == (permitted if bounded else expected)


def test_reference_derivatives_are_forgotten_at_a_start_from_rest() -> None:
    """They belong to the sample they came with."""
    law = ql.ADRC(OBSERVER, 3.0, feedforward=True)
    step(law, 0.0, 0.0, 3.0, 4.0)
    reset_loop(law.parameters, law._state)
    np.testing.assert_array_equal(law._state.reference, [0.0, 0.0])


LIMITS = Limits(-1.0, 2.0, 0.5, -0.25)
BOTH = int(Status.SATURATED | Status.RATE_LIMITED)


@cases(
    ("wish", "before", "expected"),
    [
        (0.25, 0.0, (0.25, 0)),
        (0.5, 0.0, (0.5, 0)),
        (-0.25, 0.0, (-0.25, 0)),
        (0.75, 0.0, (0.5, int(Status.RATE_LIMITED))),
        (-0.375, 0.0, (-0.25, int(Status.RATE_LIMITED))),
        (2.0, 1.75, (2.0, 0)),
        (-1.0, -0.75, (-1.0, 0)),
        (2.125, 1.75, (2.0, int(Status.SATURATED))),
        (-1.125, -0.875, (-1.0, int(Status.SATURATED))),
        (9.0, 1.75, (2.0, BOTH)),
        (-9.0, -0.875, (-1.0, BOTH)),
        (9.0, -9.0, (-1.0, BOTH)),
        (-9.0, 9.0, (2.0, BOTH)),
    ],
)
def test_limits_cut_to_their_edges_and_say_which(wish: float, before: float, expected: Any) -> None:
    """A wish at the very edge is not cut; after a foreign u the magnitude wins over the rate."""
    assert apply_limits(LIMITS, wish, before) == expected


def test_the_observer_waits_at_the_limit_nearest_to_zero() -> None:
    """Before the first measurement, on either side of zero."""
    for low, high, u in ((1.0, 2.0, 1.0), (-2.0, -1.0, -1.0), (-1.0, 1.0, 0.0)):
        law = ql.ADRC(OBSERVER, 3.0, u_min=low, u_max=high)
        assert step(law, 1.0, math.nan) == u
        assert law.estimate.u == u


def test_without_a_reference_the_loop_stays_where_y_is() -> None:
    """Until the first one comes; then it is held when it is missing."""
    law = ql.ADRC(OBSERVER, 3.0)
    assert step(law, math.nan, 5.0) == 0.0
    assert law._state.loop[0].r == 5.0
    step(law, math.nan, 5.5)
    assert law._state.loop[0].r == 5.5
    step(law, 7.0, 5.5)
    step(law, math.nan, 6.0)
    assert law._state.loop[0].r == 7.0


def test_a_law_without_limits_has_no_largest_wish() -> None:
    """Else it is 2⁴⁰ times the larger limit."""
    assert largest_wish(LIMITS) == 2.0**41
    assert largest_wish(Limits(-3.0, 2.0, 0.5, -0.5)) == 3.0 * 2.0**40
    assert largest_wish(Limits(-1.0, math.inf, 0.5, -0.5)) == math.inf


def test_an_integrator_returns_at_once_from_an_absurd_measurement() -> None:
    """The law starts again from rest at the next good one, and says so; a high gain alone is none."""
    pid = ql.baselines.PID(8.0, 6.0, 3.0, tf=0.05, dt=DT, u_min=-2.0, u_max=3.0)
    fresh = copy.deepcopy(pid)
    for y in (0.5, 0.4, 1e50):
        control(pid.parameters, pid._state, 0.5, y)
    for y in (0.4, 0.45):
        u = control(pid.parameters, pid._state, 0.5, y)
        assert u == pytest.approx(control(fresh.parameters, fresh._state, 0.5, y), rel=1e-9)
    assert np.max(np.abs(pid._state.x)) < 100.0
    relay = ql.baselines.PID(1e15, dt=DT, u_min=-2.0, u_max=3.0)
    assert control(relay.parameters, relay._state, 1.0, 0.5) == 3.0
    assert control(relay.parameters, relay._state, 0.0, 0.5) == -2.0
