"""Limits of the control signal: both directions, their edges, and changes while a loop runs."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

import quell as ql
from quell.controllers.base import Limits, apply_limits, checked_limits
from quell.types import Status

from .cases import cases

OK, SATURATED, RATE_LIMITED = 0, int(Status.SATURATED), int(Status.RATE_LIMITED)
OBSERVER = ql.ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=0.01)


@cases(
    ("wished", "before", "u", "status"),
    [
        (0.3, 0.0, 0.3, OK),
        # Values at an edge are possible, and not reported.
        (2.0, 1.8, 2.0, OK),
        (-1.0, -0.9, -1.0, OK),
        (0.5, 0.0, 0.5, OK),
        (-0.25, 0.0, -0.25, OK),
        # Beyond, by the last bit.
        (math.nextafter(2.0, 3.0), 1.8, 2.0, SATURATED),
        (math.nextafter(-1.0, -3.0), -0.9, -1.0, SATURATED),
        (math.nextafter(0.5, 3.0), 0.0, 0.5, RATE_LIMITED),
        (math.nextafter(-0.25, -3.0), 0.0, -0.25, RATE_LIMITED),
        # Both: the rate first, then the magnitude.
        (9.0, 1.9, 2.0, RATE_LIMITED | SATURATED),
        (-9.0, -0.9, -1.0, RATE_LIMITED | SATURATED),
        # A range that excludes the last u is entered at once.
        (9.0, 5.0, 2.0, SATURATED | RATE_LIMITED),
        (-9.0, -5.0, -1.0, SATURATED | RATE_LIMITED),
    ],
)
def test_limits_hold_at_their_edges_and_together(
    wished: float, before: float, u: float, status: int
) -> None:
    """From −1 to 2, up by 0.5 and down by 0.25 in a sample."""
    limits = Limits(-1.0, 2.0, 0.5, -0.25)
    assert apply_limits(limits, wished, before) == (u, status)


def test_a_rate_may_differ_by_direction() -> None:
    """One number is the limit of both; infinity and zero are allowed on one side."""
    assert checked_limits(-1.0, 1.0, 5.0, 0.1) == (-1.0, 1.0, 0.5, -0.5)
    assert checked_limits(-1.0, 1.0, (-2.0, 5.0), 0.1) == (-1.0, 1.0, 0.5, -0.2)
    assert checked_limits(-1.0, 1.0, (0.0, math.inf), 0.1) == (-1.0, 1.0, math.inf, 0.0)
    for wrong in ((1.0, 2.0), (-1.0, -0.5), (0.0, 0.0), (-1.0,), (-1.0, math.nan), ("a", 1.0)):
        with pytest.raises(ValueError, match=r"rate_limit = .*lowest <= 0 <= highest, not both"):
            checked_limits(-1.0, 1.0, wrong, 0.1)


@pytest.mark.trial
@pytest.mark.compiled
def test_limits_change_while_the_loop_runs_and_nothing_is_compiled_again() -> None:
    """From then on every u is that of a controller made with the new limits and the same state; a copy and a retuned one keep them."""
    rng = np.random.default_rng(3)
    changed = ql.ADRC(OBSERVER, omega_c=4.0, u_min=-9.0, u_max=9.0)
    made = ql.ADRC(OBSERVER, omega_c=4.0, u_min=-0.5, u_max=9.0, rate_limit=(-8.0, 3.0))
    for y in rng.normal(size=50):
        changed.step(1.0, y)
    step = changed._step
    changed.set_limits(u_min=-0.5, rate_limit=(-8.0, 3.0))
    assert changed.limits == made.limits
    made.state = changed.state
    twin = copy.deepcopy(changed)
    for y in rng.normal(size=200):
        u = changed.step(1.0, y)
        assert u == made.step(1.0, y) == twin.step(1.0, y)
        assert -0.5 <= u <= 9.0
    assert changed._step is step
    changed.set_limits(u_max=1.0)
    assert changed.limits == made.limits._replace(high=1.0)
    changed.retune(omega_c=5.0)
    assert changed.limits == changed.parameters.limits == made.limits._replace(high=1.0)
    with pytest.raises(ValueError, match=r"u_min = 3\.0, u_max = 1\.0: u_min must be less"):
        changed.set_limits(u_min=3.0)
    assert changed.limits.low == -0.5


def test_a_prefiltered_controller_and_a_pid_change_their_limits_too() -> None:
    """Before and after the first step."""
    pid = ql.baselines.PID(4.0, 1.0, dt=0.01, rate_limit=(-5.0, 100.0))
    shaped = ql.controllers.Prefiltered(pid, ql.baselines.ZV(omega=5.0))
    for _ in range(2):
        shaped.set_limits(u_max=0.25)
        assert shaped.step(10.0, 0.0) <= 0.25
    shaped.set_limits(u_max=0.5)
    assert max(shaped.step(10.0, 0.0) for _ in range(99)) == 0.5
    assert shaped.limits.least_change == pytest.approx(-0.05)
    assert pid.limits.high == math.inf  # the given controller is copied
