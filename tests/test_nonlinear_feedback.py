"""Han's nonlinear feedback law, against his formula, the linear law and setup files."""

from __future__ import annotations

import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.controllers import NonlinearFeedback
from quell.controllers.base import control
from quell.setup import made

from .cases import cases

OBSERVER = ql.ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=0.01)
OMEGA_C = 4.0


def hans_law(beta: np.ndarray, alpha: np.ndarray, delta: np.ndarray, e: np.ndarray) -> float:
    """Return ``Σ β_i fal(e_i, α_i, δ_i)`` as in Han's paper, written in another way."""
    size = np.abs(e)
    near = e * delta ** (alpha - 1.0)
    return float(np.sum(beta * np.where(size <= delta, near, np.sign(e) * size**alpha)))


@pytest.mark.parametrize("feedforward", [False, True])
def test_the_law_is_hans(feedforward: bool) -> None:
    """With his gains β; errors of all sizes, with and without derivatives of the reference. Interpreted."""
    alpha, delta = np.array([0.5, 1.25]), np.array([0.02, 0.3])
    controller = ql.ADRC(
        OBSERVER,
        OMEGA_C,
        feedback=NonlinearFeedback(tuple(alpha), tuple(delta)),
        feedforward=feedforward,
    )
    state, rng = controller.initial_state(), np.random.default_rng(2)
    beta = np.array([OMEGA_C**2, 2.0 * OMEGA_C]) * delta ** (1.0 - alpha)
    for k in range(60):
        r, wished = rng.normal(), rng.normal(size=2) if feedforward else np.zeros(2)
        state.reference[:] = wished[: state.reference.size]
        u = control(controller.parameters, state, r, 10.0 ** rng.uniform(-4.0, 0.0) * (-1) ** k)
        known = controller.read(state)
        error = np.array([r, wished[0]]) - known.x
        assert 2.0 * u == pytest.approx(
            hans_law(beta, alpha, delta, error) + wished[1] - known.f, rel=1e-9, abs=1e-9
        )


def test_within_its_range_and_with_powers_of_one_it_is_the_linear_law() -> None:
    """To the last bit within ±δ; and the analysis, which is of small motions, sees the linear law."""
    linear = ql.ADRC(OBSERVER, OMEGA_C)
    near = ql.ADRC(OBSERVER, OMEGA_C, feedback=NonlinearFeedback((0.5, 1.5), 1e3))
    ones = ql.ADRC(OBSERVER, OMEGA_C, feedback=NonlinearFeedback((1.0, 1.0), 1e-3))
    states = [controller.initial_state() for controller in (linear, near, ones)]
    for y in np.random.default_rng(1).normal(size=60):
        u, same, close = (
            control(controller.parameters, state, 0.5, y)
            for controller, state in zip((linear, near, ones), states, strict=True)
        )
        assert u == same
        assert u == pytest.approx(close, rel=1e-12)
    plant = ([2.0], [1.0, 0.4, 0.0])
    assert analysis.analyse(plant, near).margins == analysis.analyse(plant, linear).margins


def test_the_range_of_the_derivatives_scales_with_the_bandwidth() -> None:
    """``δ omega_c^(i−1)``, also after retuning; a controller of its own, compiled, goes on without a bump."""
    controller = ql.ADRC(OBSERVER, OMEGA_C, feedback=NonlinearFeedback((0.75, 1.25), 0.1))
    assert controller.parameters.feedback.delta.tolist() == [0.1, 0.4]
    y = 0.0
    for _ in range(100):
        y += 0.01 * (1.0 - y)
        u = controller.step(1.0, y)
    controller.retune(omega_c=8.0)
    assert controller.parameters.feedback.delta.tolist() == [0.1, 0.8]
    assert abs(controller.step(1.0, y + 0.01 * (1.0 - y)) - u) < 0.2


def test_a_small_error_gets_more_and_a_large_one_less() -> None:
    """With α_1 = 1/2 and the same u for an error of 1, an error of 0.04 gets five times as much."""
    assert hans_law(*(np.array([v]) for v in (1.0, 0.5, 1e-3, 0.04))) == pytest.approx(0.2)


def test_a_setup_file_can_have_it() -> None:
    """As a table in the controller's, with its mistakes named."""
    tables = {
        "dt": 0.01,
        "observer": {"kind": "model-free", "order": 2, "b0": 2.0, "omega_o": 20.0},
        "controller": {"omega_c": 4.0, "feedback": {"alpha": [0.75, 1.25], "delta": 0.1}},
    }
    tables["controller"]["rate_limit"] = [-2.0, 5.0]
    found = made("han.toml", tables).controller
    assert found.feedback == NonlinearFeedback((0.75, 1.25), 0.1)
    assert found.limits.least_change == pytest.approx(-0.02)
    tables["controller"]["feedback"] = {"alpha": [0.75, 3.0], "delta": 0.1}
    with pytest.raises(ValueError, match=r"controller\.feedback.*alpha = .* at most 2"):
        made("han.toml", tables)


@cases(
    ("feedback", "message"),
    [
        (lambda: NonlinearFeedback((0.0, 1.0), 0.1), "alpha = .*must be positive"),
        (lambda: NonlinearFeedback((0.5, 1.0), 0.0), "delta = .*must be positive"),
        (lambda: NonlinearFeedback((0.5,), 0.1), r"feedback\.alpha has shape \(1,\)"),
        (lambda: NonlinearFeedback((0.5, 1.0), (0.1,)), r"feedback\.delta has shape \(1,\)"),
        (lambda: 0.5, r"feedback = 0\.5: must be .*NonlinearFeedback"),
    ],
)
def test_a_mistake_is_named(feedback: object, message: str) -> None:
    """By argument, value and rule."""
    with pytest.raises(ValueError, match=message):
        ql.ADRC(OBSERVER, OMEGA_C, feedback=feedback())  # type: ignore[operator]
