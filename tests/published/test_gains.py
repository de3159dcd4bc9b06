"""Gains as published in closed form, in terms of β = exp(−omega_o dt)."""

from __future__ import annotations

import math

import numpy as np

import quell as ql
from quell.controllers.law import law_gains
from tests.cases import cases

OMEGA_O = 20.0


def current(order: int, dt: float) -> list[float]:
    """Miklosovic, Radke & Gao (ACC 2006), current estimator; Herbst (Electronics 2013), the discrete observer of its improved form."""
    beta = math.exp(-OMEGA_O * dt)
    if order == 1:
        return [1.0 - beta**2, (1.0 - beta) ** 2 / dt]
    return [1.0 - beta**3, 1.5 * (1.0 - beta) ** 2 * (1.0 + beta) / dt, (1.0 - beta) ** 3 / dt**2]


def predictor(order: int, dt: float) -> list[float]:
    """Miklosovic, Radke & Gao (ACC 2006), predictive estimator: ``x̂⁺ = Φ x̂ + Γ u + L_p (y − x̂_1)``."""
    beta = math.exp(-OMEGA_O * dt)
    if order == 1:
        return [2.0 * (1.0 - beta), (1.0 - beta) ** 2 / dt]
    return [
        3.0 * (1.0 - beta),
        (1.0 - beta) ** 2 * (5.0 + beta) / (2.0 * dt),
        (1.0 - beta) ** 3 / dt**2,
    ]


@cases("half_gain", [False, True])
@cases("order", [1, 2])
@cases("dt", [1e-3, 5e-3, 5e-2])
def test_observer_gains_are_the_published_ones(order: int, dt: float, half_gain: bool) -> None:
    """Both forms, and half of them (Herbst, Hempel, Göhrt & Streif 2020); the predictor's gain is Φ L in the form used here."""
    share = 0.5 if half_gain else 1.0
    options = {"order": order, "b0": 1.0, "omega_o": OMEGA_O, "dt": dt, "half_gain": half_gain}
    np.testing.assert_allclose(
        ql.ESO.model_free(**options).model.gain, np.multiply(share, current(order, dt)), rtol=1e-12
    )
    model = ql.ESO.model_free(**options, form="predictor").model
    np.testing.assert_allclose(
        model.transition @ model.gain, np.multiply(share, predictor(order, dt)), rtol=1e-12
    )


def test_controller_gains_are_the_published_ones() -> None:
    """Herbst (2013): K_P = ω at first order, K_P = ω² and K_D = 2 ω at second; half gain halves them, and leaves the cancellation of f."""
    np.testing.assert_array_equal(law_gains(1, 4.0), [4.0])
    np.testing.assert_array_equal(law_gains(2, 4.0), [16.0, 8.0])
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=OMEGA_O, dt=1e-3)
    half = ql.ADRC(observer, omega_c=4.0, half_gain=True).parameters
    np.testing.assert_array_equal(half.law, [8.0, 4.0])
    assert half.cancel_f == 1.0


def test_half_of_the_bandwidth_design_solves_a_riccati_equation() -> None:
    """The theorem of Herbst, Hempel, Göhrt & Streif (2020): ``(A + ω/2)ᵀP + P(A + ω/2) − 2 P b bᵀ P = 0`` has ``bᵀP = k/2``."""
    from scipy.linalg import solve_continuous_are

    for order in (1, 2, 3):
        A, b = np.diag(np.ones(order - 1), 1), np.eye(order)[-1:].T
        omega = 3.0
        P = solve_continuous_are(
            A + 0.5 * omega * np.eye(order), b, np.zeros((order, order)), np.array([[0.5]])
        )
        np.testing.assert_allclose((b.T @ P)[0], 0.5 * law_gains(order, omega), rtol=1e-6)
