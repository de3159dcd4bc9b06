"""The lag filter against the observer it is made for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import quell as ql
from quell.learners.base import group_delay, lag_memory, lag_of, lag_push
from quell.observers.design import FORMS
from quell.observers.eso import ESO
from quell.observers.forms import begin, observe

from .cases import cases
from .contracts.examples import EXTENDED

LINEAR = {
    "current": ESO.model_free(3, 2.0, 15.0, 2e-3),
    "predictor": ESO.model_free(3, 2.0, 15.0, 2e-3, form="predictor"),
    "model-based": ESO.model_based(([3.0, -1.0, 0.5], 2.0), 15.0, 2e-3),
    "zeros": ESO.model_based(([1.5, 6.0], [1.0, 0.5, 2.0, 1.0]), 15.0, 2e-3),
    "zeros kept": ESO.model_based(([1.5, 6.0], [1.0, 0.5, 2.0, 1.0]), 15.0, 2e-3, keep_zeros=True),
    "reduced": ESO.model_free(3, 2.0, 15.0, 2e-3, form="reduced"),
    "half gain": ESO.model_free(3, 2.0, 15.0, 2e-3, half_gain=True),
    "half gain, predictor": ESO.model_free(3, 2.0, 15.0, 2e-3, half_gain=True, form="predictor"),
    "Kalman": ESO.kalman(3, 2.0, 2e-3, noise_variance=1e-6, drift=10.0),
    "Kalman, predictor": ESO.kalman(
        3, 2.0, 2e-3, noise_variance=1e-6, drift=10.0, form="predictor"
    ),
    "cascade": ESO.cascade(3, 2.0, 15.0, 2e-3, levels=3, ratio=1.5),
    "delay": ESO.model_free(3, 2.0, 15.0, 2e-3, delay=0.01),
    "cascade with delay": ESO.cascade(3, 2.0, 15.0, 2e-3, delay=0.01),
}


@settings(max_examples=20)
@given(
    order=st.integers(1, 8),
    dt=st.sampled_from([1e-3, 1e-2]),
    form=st.sampled_from(["current", "predictor"]),
    model=st.booleans(),
    m=st.integers(1, 3),
    seed=st.integers(0, 100),
)
def test_the_lag_filter_is_the_observers_own_shadow(
    order: int, dt: float, form: str, model: bool, m: int, seed: int
) -> None:
    """Against the definition: the full observer, fed y = 0 and the input through Γ_f, for five hundred samples."""
    rng = np.random.default_rng(seed)
    order = min(order, 9 - m)
    observer = (
        ESO.model_based((rng.normal(size=order), 1.0), 10.0, dt, form=form, disturbance_order=m)
        if model
        else ESO.model_free(order, 1.0, 10.0, dt, form=form, disturbance_order=m)
    )
    lag, size = lag_of(observer), order + m
    inputs = rng.normal(size=500)
    z, seen, chain = np.zeros(size), np.zeros(size), np.zeros((1, size))
    shadow, quick = np.zeros(500), np.zeros(500)
    for k in range(1, 500):
        observe(observer.model, z, seen, 0.0, 0.0, inputs[k - 1])
        shadow[k] = -seen[order]
        quick[k] = lag_push(lag, chain, 0, inputs[k - 1])
    np.testing.assert_allclose(quick, shadow, atol=1e-7 * max(np.max(np.abs(shadow)), 1e-3))


@pytest.mark.parametrize("name", [name for name in EXTENDED if "nonlinear" not in name])
def test_the_lag_filter_of_an_observer_with_more_extended_states_is_its_shadow(
    name: str, rng: np.random.Generator
) -> None:
    """Of every form: what f̂ lacks when f_L is fed forward, from the same y and u."""
    observer = EXTENDED[name]
    lag, n = lag_of(observer), observer.order
    memory = lag_memory(lag, 1)
    y, u, f_learned = (np.cumsum(rng.normal(size=600)) * 1e-2 for _ in range(3))
    z, plain = np.zeros((2, observer.states))
    seen, alone = np.zeros((2, observer.estimates))
    missed, shown = np.zeros((2, y.size))
    for k in range(1, y.size):
        observe(observer.model, z, seen, y[k], u[k], f_learned[k])
        observe(observer.model, plain, alone, y[k], u[k], 0.0)
        shown[k] = lag_push(lag, memory, 0, f_learned[k])
        missed[k] = alone[n] - seen[n]
    np.testing.assert_allclose(shown, missed, atol=1e-8 * np.max(np.abs(missed)))


@cases("order", range(1, 9))
def test_a_constant_passes_the_lag_filter_unchanged(order: int) -> None:
    """Its gain at rest is one: the observer finds a constant disturbance."""
    lag = lag_of(ESO.model_free(order=order, b0=1.0, omega_o=10.0, dt=1e-3))
    assert np.sum(lag.taps) == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize("name", LINEAR)
def test_what_a_plain_eso_would_have_estimated_is_known_exactly(
    name: str, rng: np.random.Generator
) -> None:
    """``Δf̂ + f_L^F`` is the plain ESO's estimate from the same y and u, whatever was fed forward; for every linear form."""
    observer = LINEAR[name]
    lag = lag_of(observer)
    chain = lag_memory(lag, 1)
    y, u, f_learned = (np.cumsum(rng.normal(size=600)) * 1e-2 for _ in range(3))
    z, plain = np.zeros(observer.states), np.zeros(observer.states)
    seen, plainly = np.zeros(4), np.zeros(4)
    found, expected = [], []
    begin(observer.model, z, seen, y[0])
    begin(observer.model, plain, plainly, y[0])
    for k in range(1, y.size):
        observe(observer.model, z, seen, y[k], u[k - 1], f_learned[k - 1])
        observe(observer.model, plain, plainly, y[k], u[k - 1], 0.0)
        found.append(seen[-1] + lag_push(lag, chain, 0, f_learned[k - 1]))
        expected.append(plainly[-1])
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-6)


@cases(
    "observer",
    [
        *(ql.ESO.model_free(order=3, b0=1.0, omega_o=20.0, dt=2e-3, form=form) for form in FORMS),
        ql.ESO.model_free(order=3, b0=1.0, omega_o=20.0, dt=2e-3, half_gain=True),
        ql.ESO.cascade(order=3, b0=1.0, omega_o=20.0, dt=2e-3),
    ],
)
def test_the_group_delay_is_that_of_the_filter(observer: ql.ESO) -> None:
    """A ramp comes through the lag filter so many samples late."""
    lag = lag_of(observer)
    chain = lag_memory(lag, 1)
    shown = [lag_push(lag, chain, 0, float(k)) for k in range(4000)]
    assert 3999.0 - shown[-1] == pytest.approx(group_delay(observer), abs=1e-6)
