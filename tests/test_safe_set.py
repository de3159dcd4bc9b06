"""A safe set: y and its rate stay in their bands, whatever asks for u."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.law import law_gains
from quell.types import Status

from .cases import cases

DT = 1e-3


class Hostile:
    """A plant of order n whose f moves at its bound, integrated exactly with f' held in a sample."""

    def __init__(self, order: int, b0: float, f_rate: float) -> None:
        self.x, self.f, self.order, self.b0, self.rate = np.zeros(order), 0.0, order, b0, f_rate

    def advance(self, u: float, direction: float) -> None:
        """Take a sample."""
        n, change = self.order, direction * self.rate
        for _ in range(4):
            h = 0.25 * DT
            powers = [h**k / math.factorial(k) for k in range(n + 2)]
            moved = np.zeros(n)
            for i in range(n):
                moved[i] = sum(powers[j - i] * self.x[j] for j in range(i, n))
                moved[i] += powers[n - i] * (self.b0 * u + self.f) + powers[n - i + 1] * change
            self.x, self.f = moved, self.f + h * change


def farthest(controller: Any, order: int, f_rate: float, seed: int, b0: float = 2.0) -> float:
    """Return the largest |y| of a run with a hostile u_0 and f."""
    random, plant, most = np.random.default_rng(seed), Hostile(order, b0, f_rate), 0.0
    half = 200 + int(300 * random.random())
    for k in range(6000):
        towards = math.copysign(1.0, plant.x[0])
        wish = 1e4 * (towards if seed % 2 else math.copysign(1.0, math.sin(0.003 * k)))
        u = controller.step(wish, plant.x[0])
        plant.advance(u, towards if (k // half) % 2 else -towards)
        if k > 1500:
            most = max(most, abs(plant.x[0]))
    return most


@pytest.mark.trial
@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_hostile_u_0_and_disturbance_do_not_leave_the_band(order: int) -> None:
    """With full force towards the border and f at its largest rate; and the band is used to within a few per cent."""
    observer = ql.ESO.model_free(order, 2.0, omega_o=150.0, dt=DT)
    alpha, f_rate = 12.0, 0.05 * 12.0 ** (order + 1)
    safe = ql.SafeSet(-1.0, 1.0, alpha=alpha, f_rate=f_rate)
    for seed in range(2):
        most = farthest(ql.Compensator(observer, safe_set=safe), order, f_rate, seed)
        assert 0.85 < most <= 1.0


@pytest.mark.trial
def test_without_the_margin_it_would_leave_it() -> None:
    """F' that the set was not told of takes y outside, and the set says so."""
    observer = ql.ESO.model_free(2, 2.0, omega_o=150.0, dt=DT)
    controller = ql.Compensator(observer, safe_set=ql.SafeSet(-1.0, 1.0, alpha=12.0))
    assert farthest(controller, 2, 400.0, seed=1) > 1.0
    assert controller.estimate.status & Status.UNSAFE
    assert "NOT safe" in controller.estimate.status.message


def test_its_bound_is_the_law_of_adrc_with_the_border_for_reference() -> None:
    """For small α dt: u_max = (k (y_max − x̂_1) − k_2 x̂_2 − f̂)/b0 with the gains of omega_c = α."""
    observer = ql.ESO.model_free(2, 2.0, omega_o=80.0, dt=1e-4)
    safe = ql.SafeSet(y_max=1.0, alpha=5.0)
    controller = ql.Compensator(observer, safe_set=safe)
    for k in range(3000):
        controller.step(0.3 * math.sin(0.002 * k), 0.5 + 1e-4 * k)
    x, f = controller.estimate.x, controller.estimate.f
    k1, k2 = law_gains(2, 5.0)
    bound = (k1 * (1.0 - x[0]) - k2 * x[1] - f) / 2.0
    assert controller._state.safe_set.loop[0].high == pytest.approx(bound, rel=2e-3)


@pytest.mark.trial
def test_a_learner_cannot_break_it() -> None:
    """One that feeds forward a thousand times the disturbance changes nothing in what the set knows."""
    observer = ql.ESO.model_free(2, 2.0, omega_o=150.0, dt=DT)
    safe = ql.SafeSet(-1.0, 1.0, alpha=12.0, f_rate=80.0)
    reached = []
    for bands in (safe, None):
        wild = ql.learners.BatchGradient(rate=1e-3, batch=1)
        controller = ql.ADRC(observer, omega_c=20.0, learner=wild, safe_set=bands)
        plant, most = Hostile(2, 2.0, 80.0), 0.0
        for k in range(6000):
            u = controller.step(0.8 * math.sin(0.004 * k), plant.x[0])
            plant.advance(u, math.copysign(1.0, math.sin(0.005 * k)))
            most = max(most, abs(plant.x[0])) if k > 1500 else most
        reached.append(most)
    assert reached[0] <= 1.0 < reached[1]


def test_it_returns_from_outside() -> None:
    """A loop that starts beyond the border is brought back, though u_0 pushes outwards."""
    observer = ql.ESO.model_free(2, 2.0, omega_o=150.0, dt=DT)
    controller = ql.Compensator(observer, safe_set=ql.SafeSet(-1.0, 1.0, alpha=12.0))
    plant = Hostile(2, 2.0, 0.0)
    plant.x[0] = 1.5
    for _ in range(2000):
        plant.advance(controller.step(50.0, plant.x[0]), 0.0)
    assert plant.x[0] == pytest.approx(1.0, abs=2e-3)
    assert plant.x[0] <= 1.0 + 1e-6


@pytest.mark.trial
def test_limits_that_make_it_impossible_are_reported() -> None:
    """U at its limit cannot stop a plant that is too fast: the nearest u, and UNSAFE."""
    observer = ql.ESO.model_free(2, 2.0, omega_o=150.0, dt=DT)
    safe = ql.SafeSet(-1.0, 1.0, alpha=12.0)
    controller = ql.Compensator(observer, u_min=-1.0, u_max=1.0, safe_set=safe)
    plant, flags = Hostile(2, 2.0, 0.0), Status.OK
    for _ in range(3000):
        u = controller.step(1.0, plant.x[0])
        flags |= controller.estimate.status
        plant.advance(u, 0.0)
    assert flags & Status.UNSAFE


@pytest.mark.trial
def test_a_rate_band_holds_beside_that_of_y() -> None:
    """Y' stays below its border in every sample, and where both are at odds y wins."""
    observer = ql.ESO.model_free(2, 2.0, omega_o=150.0, dt=DT)
    safe = ql.SafeSet(-1.0, 1.0, -0.5, 0.5, alpha=12.0, f_rate=10.0)
    controller = ql.Compensator(observer, safe_set=safe)
    plant, fastest, most = Hostile(2, 2.0, 10.0), 0.0, 0.0
    for k in range(20_000):
        u = controller.step(1e3 * math.copysign(1.0, math.sin(0.0012 * k)), plant.x[0])
        plant.advance(u, math.copysign(1.0, math.sin(0.01 * k)))
        if k > 1500:
            fastest, most = max(fastest, abs(plant.x[1])), max(most, abs(plant.x[0]))
    assert 0.4 < fastest <= 0.5
    assert most <= 1.0


@cases(
    ("make", "message"),
    [
        (lambda: ql.SafeSet(), "no border is finite"),
        (lambda: ql.SafeSet(1.0, -1.0), "y_min"),
        (lambda: ql.SafeSet(y_max=1.0, alpha=0.0), "alpha"),
        (lambda: ql.SafeSet(y_max=1.0, gain_error=1.0), "must be below 1"),
        (
            lambda: ql.Compensator(
                ql.ESO.model_free(2, 2.0, 150.0, DT),
                safe_set=ql.SafeSet(-1e-3, 1e-3, alpha=2.0, f_rate=100.0),
            ),
            "y_max − y_min = 0.002: must be above",
        ),
        (
            lambda: ql.Compensator(
                ql.ESO.model_free(2, 2.0, 150.0, DT), safe_set=ql.SafeSet(y_max=1.0, gain_error=0.1)
            ),
            "give u_min and u_max",
        ),
        (
            lambda: ql.Compensator(
                ql.ESO.model_free(2, 2.0, 150.0, DT, delay=DT), safe_set=ql.SafeSet(y_max=1.0)
            ),
            "without a delay of u",
        ),
        (
            lambda: ql.ADRC(
                ql.ESO.model_based(([1.0, 5.0], [1.0, 2.0, 3.0]), 50.0, DT),
                5.0,
                safe_set=ql.SafeSet(y_max=1.0),
            ),
            "the plant has zeros",
        ),
        (
            lambda: ql.ADRC(
                ql.ESO.model_free(2, 2.0, 20.0, 0.02),
                5.0,
                safe_set=ql.SafeSet(y_max=1.0, alpha=30.0),
            ),
            "alpha \\* dt must be at most 0.5",
        ),
    ],
)
def test_what_it_cannot_promise_is_refused(make: Any, message: str) -> None:
    """With the number that is needed, where there is one."""
    with pytest.raises(ValueError, match=message):
        make()


def test_in_single_precision_it_starts_retunes_and_keeps_the_band() -> None:
    """From given estimates, with another omega_o in mid-run, as in double precision."""
    observer = ql.ESO.model_free(2, 2.0, omega_o=150.0, dt=DT)
    adrc = ql.ADRC(observer, omega_c=15.0, safe_set=ql.SafeSet(-1.0, 1.0, alpha=12.0))
    for controller in (adrc, ql.controllers.in_single_precision(adrc)):
        controller.start_at([0.9, 0.0], f=-0.5, u=0.25)
        plant, most = Hostile(2, 2.0, 0.0), 0.0
        plant.x[0], plant.f = 0.9, -0.5
        for k in range(600):
            if k == 300:
                controller.retune(observer=ql.ESO.model_free(2, 2.0, omega_o=120.0, dt=DT))
            plant.advance(controller.step(3.0, plant.x[0]), 0.0)
            most = max(most, plant.x[0])
        assert 0.99 < most <= 1.0 + 1e-6
