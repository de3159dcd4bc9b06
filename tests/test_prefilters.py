"""Prefilters that know the derivatives of what they make of the reference."""

from __future__ import annotations

import math

import numpy as np
import pytest

import quell as ql
from quell.controllers.prefilters import prefilter, settle, write_derivatives

DT = 0.01


def followed(model: object, r: np.ndarray) -> np.ndarray:
    """The shaped reference and its derivatives (samples, 1 + m)."""
    design = model.design(DT)
    memory, known = model.memory(design), np.zeros(model.derivatives)
    settle(design, memory, 0.0)
    rows = []
    for value in r:
        rows.append([prefilter(design, memory, value)])
        write_derivatives(design, memory, known)
        rows[-1].extend(known)
    return np.array(rows)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_a_reference_model_answers_a_step_in_closed_form(order: int) -> None:
    """``1 − e^(−ωt) Σ (ωt)^k/k!``, and its first derivative ``ω (ωt)^(m−1) e^(−ωt)/(m−1)!``, to rounding."""
    omega = 3.0
    found = followed(ql.controllers.ReferenceModel(omega, order), np.ones(400))
    x = omega * DT * np.arange(1, 401)
    np.testing.assert_allclose(
        found[:, 0],
        1.0 - np.exp(-x) * sum(x**k / math.factorial(k) for k in range(order)),
        atol=1e-12,
    )
    np.testing.assert_allclose(
        found[:, 1], omega * x ** (order - 1) * np.exp(-x) / math.factorial(order - 1), atol=1e-10
    )


def test_each_derivative_is_the_slope_of_the_one_before() -> None:
    """All m of them, also the highest, which no state holds."""
    found = followed(ql.controllers.ReferenceModel(3.0, 4), np.ones(400))
    for i in range(4):
        slope = (found[2:, i] - found[:-2, i]) / (2 * DT)
        np.testing.assert_allclose(
            slope, found[1:-1, i + 1], atol=5e-3 * np.max(np.abs(found[:, i + 1]))
        )


@pytest.mark.trial
def test_a_loop_that_feeds_forward_answers_as_its_reference_model() -> None:
    """Whatever omega_c is: two degrees of freedom. Without derivatives the loop's own lag is added."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [-1.0, -0.6]], [0.0, 2.0], [1.0, 0.0])
    observer = ql.ESO.model_based(plant, omega_o=40.0, dt=2e-3)
    model, scenario = (
        ql.controllers.ReferenceModel(3.0, 2),
        ql.Scenario(reference=1.0, duration=3.0),
    )
    wanted, errors = None, {}
    for omega_c in (2.0, 8.0):
        for feedforward in (False, True):
            law = ql.controllers.Prefiltered(
                ql.ADRC(observer, omega_c, feedforward=feedforward), model
            )
            run = ql.simulate(plant, law, scenario)
            wanted = 1.0 - np.exp(-3.0 * run.t) * (1.0 + 3.0 * run.t)
            errors[omega_c, feedforward] = np.max(np.abs(run["y"] - wanted))
    assert errors[2.0, True] < 5e-3
    assert errors[8.0, True] < 5e-3
    assert errors[2.0, False] > 0.3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: ql.controllers.ReferenceModel(0.0),
            "omega = 0.0: must be finite and greater than zero",
        ),
        (
            lambda: ql.controllers.ReferenceModel(1.0, 9),
            "order = 9: must be a whole number from 1 to 8",
        ),
        (
            lambda: ql.controllers.ReferenceModel(200.0).design(0.01),
            "omega [*] dt = 2 must be at most 1",
        ),
    ],
)
def test_a_mistake_is_named(make: object, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


def test_a_profile_leaves_the_external_signal_of_a_schedule_alone() -> None:
    """Its third derivative is not fed forward: u is that of the controller held at the signal."""
    observer = ql.ESO.model_free(order=2, b0=1000.0, omega_o=100.0, dt=DT)
    table = ql.Schedule((0.0, 1.0), "external", b0=(2000.0, 500.0))
    controller = ql.ADRC(observer, 30.0, schedule=table, feedforward=True)
    move = ql.controllers.ProfileGenerator(5.0, 200.0, 20000.0)
    both = [ql.controllers.Prefiltered(each, move) for each in (controller, controller.at(0.7))]
    both[0].set_signals(0.7)
    u = np.array([[each.step(0.1, 1e-4 * k) for each in both] for k in range(30)])
    np.testing.assert_allclose(u[:, 0], u[:, 1], rtol=1e-9)


@pytest.mark.parametrize("order", [1, 3])
def test_a_reference_model_with_a_bounded_rate_follows_a_ramp(order: int) -> None:
    """A step of 2 at 0.5/s is the answer to a ramp that ends after 4 s: no rate is above 0.5; a smaller rate of r changes nothing."""
    model = ql.controllers.ReferenceModel(3.0, order, rate_limit=0.5)
    free = ql.controllers.ReferenceModel(3.0, order)
    ramp = np.minimum(0.5 * DT * np.arange(1, 801), 2.0)
    found = followed(model, np.full(800, 2.0))
    np.testing.assert_allclose(found, followed(free, ramp), atol=1e-12)
    assert np.max(found[:, 1]) <= 0.5 * (1.0 + 1e-9)
    slow = 0.4 * np.sin(DT * np.arange(800))
    np.testing.assert_array_equal(followed(model, slow), followed(free, slow))
    with pytest.raises(ValueError, match="rate_limit"):
        ql.controllers.ReferenceModel(3.0, rate_limit=0.0)
