"""The canonical form of linear plants, the ESO built on it, and loops around plants with zeros."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

import quell as ql
from quell.learners.base import lag_of
from quell.lti.canonical import canonical
from quell.observers.design import place_poles, scaled_response
from quell.observers.eso import ESO, noise_gains
from quell.observers.forms import begin, observe

from .cases import cases


def hidden(num: Any, den: Any, seed: int = 1) -> ql.plants.LinearPlant:
    """Return the transfer function ``num/den`` as a plant in badly scaled, rotated coordinates."""
    A, B, C, _ = scipy.signal.tf2ss(num, den)
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=A.shape))[0] @ np.diag(
        10.0 ** np.linspace(-1.0, 2.0, len(A))
    )
    back = np.linalg.inv(turn)
    return ql.plants.LinearPlant(turn @ A @ back, turn @ B, C @ back)


NUM, DEN = 3.0 * np.poly([-0.8, -2.0]), np.poly([0.3, -0.4 + 1.0j, -0.4 - 1.0j, -3.0])


@cases(
    "plant",
    [
        hidden(NUM, DEN),
        (hidden(NUM, DEN).A, hidden(NUM, DEN).B, hidden(NUM, DEN).C),
        (
            hidden(NUM, DEN).A,
            hidden(NUM, DEN).B,
            7.0 * hidden(NUM, DEN).B[:, 0],
            hidden(NUM, DEN).C[0],
        ),
        (NUM, DEN),
        ([0.0, *(2.0 * NUM)], 2.0 * DEN),
        control.tf(NUM, DEN),
        control.ss(control.tf(NUM, DEN)),
        scipy.signal.TransferFunction(NUM, DEN),
        scipy.signal.StateSpace(*scipy.signal.tf2ss(NUM, DEN)),
        (np.concatenate([[1e-15], NUM]), DEN),
    ],
)
def test_a_plant_is_the_same_however_it_is_given(plant: Any) -> None:
    """Matrices, systems of python-control and scipy, coefficients, also with rounding errors."""
    found = canonical(plant)
    np.testing.assert_allclose(found.a, DEN[:0:-1], rtol=1e-8)
    assert found.b == pytest.approx(3.0)
    assert (found.degree, found.f_degree) == (2, 2)
    np.testing.assert_allclose(found.zeros, [-2.0, -0.8], rtol=1e-7)
    markov = [3.0, 3.0 * 2.8 - 3.0 * DEN[1]]  # long division by hand
    np.testing.assert_allclose(
        found.B, [0.0, *markov, 3.0 * 1.6 - DEN[1] * markov[1] - DEN[2] * 3.0], rtol=1e-7
    )
    np.testing.assert_allclose(found.E, found.B / 3.0, rtol=1e-7)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 6))
def test_the_zeros_are_those_of_the_numerator(seed: int, n: int) -> None:
    """Zeros are found in any coordinates; Ā, B̄, C̄ are the plant transformed by S."""
    rng = np.random.default_rng(seed)
    zeros, poles = rng.uniform(-3.0, 3.0, rng.integers(0, n)), rng.uniform(-2.0, 0.5, n)
    plant = hidden(np.atleast_1d(np.poly(zeros)), np.poly(poles), seed)
    found = canonical(plant)
    assert found.degree == n - zeros.size
    # A polynomial, because zeros that happen to be near each other are badly conditioned.
    np.testing.assert_allclose(np.poly(found.zeros), np.poly(zeros), atol=1e-5)
    companion = np.diag(np.ones(n - 1), 1)
    companion[-1] = -found.a
    np.testing.assert_allclose(
        found.S @ plant.A, companion @ found.S, atol=1e-5 * np.max(np.abs(found.S))
    )
    np.testing.assert_allclose(
        found.S @ plant.B[:, 0], found.B, atol=1e-7 * np.max(np.abs(found.B))
    )


def error_polynomial(observer: ESO) -> np.ndarray:
    """Return the characteristic polynomial of (I − L C) Φ in ``(z − 1)/(1 − β)``."""
    model = observer.model
    scale = observer.omega_o ** np.append(np.arange(observer.order), observer.f_degree)
    transition, gain = model.transition * scale[None, :] / scale[:, None], model.gain / scale
    rise = -math.expm1(-observer.omega_o * observer.dt)
    return np.poly((transition - np.outer(gain, transition[0]) - np.eye(scale.size)) / rise)


@given(
    n=st.integers(2, 8),
    count=st.integers(1, 3),
    seed=st.integers(0, 10_000),
    dt=st.sampled_from([1e-4, 1e-3, 1e-2]),
    omega_o=st.sampled_from([5.0, 50.0]),
)
def test_zeros_move_no_pole_of_the_observer(
    n: int, count: int, seed: int, dt: float, omega_o: float
) -> None:
    """With one to three zeros, up to eight states, down to 0.1 ms: the polynomial is (z − β)^N."""
    rng = np.random.default_rng(seed)
    zeros, poles = -rng.uniform(0.3, 5.0, min(count, n - 1)), -rng.uniform(0.0, 3.0, n)
    observer = ESO.model_based((np.poly(zeros), np.poly(poles)), omega_o=omega_o, dt=dt)
    wanted = [math.comb(n + 1, i) for i in range(n + 2)]
    np.testing.assert_allclose(error_polynomial(observer), wanted, rtol=1e-5)


def test_poles_may_differ_and_be_complex(rng: np.random.Generator) -> None:
    """The placement takes any poles, not only equal ones."""
    difference = np.triu(0.05 * rng.uniform(0.5, 1.0, (4, 4)), 0)
    rises = np.array([0.1, 0.03, 0.05 + 0.02j, 0.05 - 0.02j])
    gain = place_poles(difference, rises)
    phi = np.eye(4) + difference
    error = phi - np.outer(gain, phi[0])
    np.testing.assert_allclose(np.poly(np.eye(4) - error), np.poly(rises).real, atol=1e-12)


def estimates(
    observer: ESO, plant: ql.plants.LinearPlant, f: float, samples: int = 4000
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the true and the estimated state after a chirp under a constant disturbance."""
    model = plant.sampled(observer.dt)
    u = np.sin(np.cumsum(np.linspace(0.0, 3.0, samples)) * observer.dt)
    x = np.linspace(0.5, -0.4, plant.order)
    z, seen = np.zeros(observer.states), np.zeros(observer.order + 1)
    begin(observer.model, z, seen, float(model.output @ x))
    for k in range(samples):
        x = model.transition @ x + model.input * u[k] + model.disturbance[:, 0] * f
        observe(observer.model, z, seen, float(model.output @ x), u[k], 0.0)
    return x, observer.states_of(seen[:-1]), seen[-1]


STABLE = np.poly([-0.5, -0.4 + 1.0j, -0.4 - 1.0j, -3.0])


def test_estimates_are_found_in_the_states_of_the_user() -> None:
    """In badly scaled coordinates, with an unknown f that enters where u does: both get exact."""
    plant = hidden(NUM, STABLE)
    observer = ESO.model_based(plant, omega_o=20.0, dt=2e-3)
    x, x_hat, f = estimates(observer, plant, 0.7)
    np.testing.assert_allclose(x_hat, x, rtol=1e-5, atol=1e-6 * np.max(np.abs(x)))
    assert f / observer.plant.f_gain == pytest.approx(0.7, rel=1e-6)


def test_a_disturbance_with_a_channel_of_its_own_is_found_there() -> None:
    """S E = e_n while u enters earlier: z excludes the feedthrough of u; no derivative is used."""
    free = hidden(NUM, STABLE)
    S = canonical(free).S
    E = np.linalg.solve(S, [0.0, 0.0, 0.0, -2.0])
    plant = ql.plants.LinearPlant(free.A, free.B, free.C, np.column_stack([E, free.B]))
    by_index, by_column = (ESO.model_based(plant, 20.0, 2e-3, E=channel) for channel in (0, E))
    np.testing.assert_allclose(by_index.model.gain, by_column.model.gain)
    assert (by_index.degree, by_index.f_degree, by_index.cancel_f) == (2, 4, 0.0)
    assert by_index.plant.f_gain == pytest.approx(-2.0)
    only = ql.plants.LinearPlant(free.A, free.B, free.C, E[:, None])
    x, x_hat, f = estimates(by_index, only, 0.7)
    np.testing.assert_allclose(x_hat, x, rtol=1e-5, atol=1e-6 * np.max(np.abs(x)))
    assert f == pytest.approx(-1.4, rel=1e-6)


def test_a_record_is_mapped_like_a_sample() -> None:
    """(samples, n) as well as (n,); and a wrong shape is named."""
    observer = ESO.model_based(hidden(NUM, DEN), omega_o=20.0, dt=1e-3)
    record = np.random.default_rng(3).normal(size=(7, 4))
    np.testing.assert_allclose(
        observer.states_of(record)[3], observer.states_of(record[3]), rtol=1e-12
    )
    np.testing.assert_allclose(
        observer.plant.S @ observer.states_of(record[3]),
        record[3],
        atol=1e-9 * np.max(np.abs(record)),
    )
    for wrong, shape in ((np.ones(3), r"\(3,\)"), (np.ones((4, 8)), r"\(4, 8\)"), (1.0, r"\(\)")):
        with pytest.raises(
            ValueError, match=f"x_hat has shape {shape}: the last axis must have the 4 states"
        ):
            observer.states_of(wrong)


@pytest.mark.trial
@pytest.mark.parametrize(
    ("num", "den"),
    [
        (NUM, DEN),  # two zeros, unstable
        (2.0 * np.poly([-0.1]), np.poly([-1.0, -0.3, 0.5])),  # a slow zero
        ([1.0, 0.4, 4.0], [1.0, 0.1, 9.0, 0.0]),  # a pair at 2 rad/s, damped by a tenth
    ],
)
def test_the_loop_of_a_plant_with_zeros_steps_as_if_it_had_none(num: Any, den: Any) -> None:
    """Y follows ``(omega_c/(s + omega_c))^r``, r the relative degree, and rejects a load."""
    plant, omega_c, dt = hidden(num, den), 2.0, 2.5e-3
    controller = ql.ADRC(ESO.model_based(plant, omega_o=20.0, dt=dt), omega_c=omega_c)
    run = ql.simulate(plant, controller, ql.Scenario(1.0, 16.0, (ql.signals.Step(at=8.0),)))
    y, t = run["y"].ravel(), run.t
    rest = sum(
        (omega_c * t) ** k / math.factorial(k) for k in range(controller.observer.degree)
    ) * np.exp(-omega_c * t)
    before = t < 8.0
    assert np.max(np.abs(y - 1.0 + rest)[before]) < 2e-3
    assert 0.003 < np.max(np.abs(y[~before] - 1.0)) < 0.2
    assert y[-1] == pytest.approx(1.0, abs=1e-4)


def test_a_disturbance_of_its_own_is_rejected_by_its_effect_on_the_state() -> None:
    """If f does not enter as u does (r < n), u_0 − z_{r+1} alone brings y to rest."""
    free = hidden(NUM, STABLE)
    E = np.linalg.solve(canonical(free).S, [0.0, 0.0, 0.0, 1.0])
    plant = ql.plants.LinearPlant(free.A, free.B, free.C, E[:, None])
    controller = ql.ADRC(ESO.model_based(plant, 20.0, 5e-3, E=0), omega_c=2.0)
    run = ql.simulate(plant, controller, ql.Scenario(0.0, 12.0, (ql.signals.Step(at=1.0),)))
    y = run["y"].ravel()
    assert np.max(np.abs(y)) > 1e-4
    assert y[-1] == pytest.approx(0.0, abs=1e-6)


def test_noise_in_f_is_as_much_as_its_gain_says(rng: np.random.Generator) -> None:
    """White noise through an observer of a plant with a zero, against the sum of its response."""
    observer = ESO.model_based(([1.0, 2.0], [1.0, 0.6, 1.0, 0.3]), omega_o=20.0, dt=5e-3)
    y = rng.normal(size=15_000)
    z, seen = np.zeros(4), np.zeros(4)
    told = np.empty((y.size, 4))
    for k, value in enumerate(y.tolist()):
        observe(observer.model, z, seen, value, 0.0, 0.0)
        told[k] = seen
    np.testing.assert_allclose(np.var(told[400:], axis=0), noise_gains(observer), rtol=0.1)


@pytest.mark.trial
def test_a_learner_learns_on_a_plant_with_zeros() -> None:
    """f̂ is what lag compensation computes, with and without zeros: a wrong coefficient is found."""
    observer = ESO.model_based(([1.0, 4.0], [1.0, 0.5, 2.0, 1.0]), omega_o=20.0, dt=5e-3)
    # The real plant has f = −1.5 y on top, entering as u does.
    plant = hidden([1.0, 4.0], np.polyadd([1.0, 0.5, 2.0, 1.0], 1.5 * np.array([1.0, 4.0])))
    controller = ql.ADRC(observer, omega_c=1.5, learner=ql.learners.Kalman())
    swing = ql.signals.Sinusoid(omega=1.0) + ql.signals.Sinusoid(amplitude=0.5, omega=2.3)
    run = ql.simulate(plant, controller, ql.Scenario(swing, 12.0))
    np.testing.assert_allclose(run["theta"][-1], [-1.5, 0.0, 0.0, 0.0], atol=0.05)


TWO_MASS = ql.plants.two_mass_spring()
BESIDE = ql.plants.two_mass_spring(c1=1.0, c2=0.0)


@cases(
    ("plant", "E", "message"),
    [
        (
            (np.diag([-1.0, -2.0]), [1.0, 1.0], [1.0, 0.0]),
            None,
            "not observable from y: .* has rank 1, not 2 .*smallest over largest",
        ),
        (
            TWO_MASS,
            1,
            r"invariant zeros to y \(assumption 3\), ±1j rad/s, its relative degree is 2 and "
            "not 4; leave E out",
        ),
        ((np.diag([-1.0, -2.0]), [1.0, 1.0], [0.0, 0.0], [1.0, 1.0]), None, "E is zero"),
        ((np.eye(2), [1.0, 0.0], [0.0, 1.0], [1.0, 0.0]), None, "not observable"),
        (([[0.0, 1.0], [0.0, 0.0]], [0.0, 0.0], [1.0, 0.0]), None, "b = 0: u does not reach y"),
        (
            ([1.0, 0.0, 1.0], [1.0, 1.0]),
            None,
            "improper: its numerator has degree 2, its denominator 1",
        ),
        (
            control.tf([1.0, 0.5], [1.0, 1.0]),
            None,
            "biproper: numerator and denominator have degree 1",
        ),
        (([0.0], [1.0, 1.0]), None, "numerator is zero"),
        (([1.0], [2.0]), None, "denominator has degree 0"),
        ((["one"], [1.0, 1.0]), None, "numerator: must be an array of numbers"),
        (([1.0], [1.0, math.nan]), None, "denominator: entry"),
        (
            control.tf([[[1.0], [1.0]]], [[[1.0, 1.0], [1.0, 2.0]]]),
            None,
            r"\(1, 2\) outputs and inputs",
        ),
        (([1.0], [1.0, 1.0]), [1.0], "E: only a plant with states"),
        ((np.zeros((1, 1)), [1.0], [1.0], [1.0]), [1.0], "E is given twice"),
        (
            control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]),
            0,
            "E = 0: this plant has no disturbance inputs of its own",
        ),
        (TWO_MASS, 2, "E = 2: must be a whole number from 0 to 1"),
        (TWO_MASS, [1.0, 0.0], r"E has shape \(2, 1\): must be a matrix of shape \(4, 1\)"),
        ((1.0, 2.0, 3.0, 4.0, 5.0), None, "must be a linear plant"),
    ],
)
def test_what_is_wrong_with_a_plant_is_said(plant: Any, E: Any, message: str) -> None:
    """Each assumption that fails has its own error, with the numbers."""
    with pytest.raises(ValueError, match=message):
        canonical(plant, E)


def test_a_zero_at_the_origin_hides_a_constant_disturbance() -> None:
    """It leaves no trace in y, so no ESO can find it."""
    with pytest.raises(
        ValueError, match=r"zero at s = 0 \(zeros from u: 0 rad/s\): a constant f does not show"
    ):
        ESO.model_based(([1.0, 0.0], [1.0, 1.0, 1.0]), omega_o=10.0, dt=1e-3)


@pytest.mark.parametrize(
    ("plant", "zeros"), [(([-1.0, 2.0], [1.0, 1.0, 1.0]), "2"), (BESIDE, "±1j")]
)
def test_zeros_that_must_not_be_cancelled_are_refused_by_the_law_not_by_the_observer(
    plant: Any, zeros: str
) -> None:
    """An estimate is there to be had; a controller that inverts the plant is not."""
    observer = ESO.model_based(plant, omega_o=10.0, dt=1e-3)
    with pytest.raises(
        ValueError, match=f"zeros from u at {zeros} rad/s, not in the left half plane"
    ):
        ql.ADRC(observer, omega_c=1.0)


def test_the_condition_says_how_near_a_plant_is_to_unobservable() -> None:
    """Two states that are seen with almost the same dynamics."""
    near, far = (
        canonical((np.diag([-1.0, -1.0 - gap]), [1.0, 2.0], [1.0, 1.0])).condition
        for gap in (1e-6, 1.0)
    )
    assert far < 10.0 < 1e5 < near


@cases("zeros", [[-0.1], [-0.5 + 1.0j, -0.5 - 1.0j], [-0.3, -4.0], [-300.0, -1.0]])
def test_with_its_poles_at_the_zeros_the_observer_shows_f_as_if_there_were_none(
    zeros: list[complex],
) -> None:
    """f̂ has one lag for each pole at β, with a total gain of 1; faster zeros are not kept."""
    plant = (np.poly(zeros).real, np.poly([-1.0, -0.3, 0.5, 0.0]))
    observer = ESO.model_based(plant, omega_o=20.0, dt=2e-3, keep_zeros=True)
    kept = sum(zero.real > -20.0 for zero in np.array(zeros))
    taps = lag_of(observer).taps
    np.testing.assert_allclose(taps[5 - kept :], 0.0, atol=1e-8)
    assert np.sum(taps) == pytest.approx(1.0, abs=1e-8)
    if kept == len(zeros):
        assert np.all(taps[: 5 - kept] > 0.0)


@pytest.mark.parametrize(
    ("zeros", "kept"), [([-300.0, -1.0], [-1.0]), ([-0.5, 0.4], [-0.5]), ([-25.0, -21.0], [])]
)
def test_a_zero_keeps_a_pole_only_if_it_is_stable_and_slower_than_omega_o(
    zeros: list[float], kept: list[float]
) -> None:
    """All other poles of the observer lie at ``exp(−omega_o dt)``."""
    plant = (np.poly(zeros), np.poly([-1.0, -0.3, 0.5, 0.0]))
    observer = ESO.model_based(plant, omega_o=20.0, dt=2e-3, keep_zeros=True)
    found = scaled_response(observer.model, observer.units, observer.order).transition
    rates = [-20.0] * (5 - len(kept)) + kept
    # About z = 1, in the time unit 1/omega_o: a multiple pole is not found by eigenvalues.
    wanted = np.poly(np.expm1(2e-3 * np.array(rates)) / 0.04)
    np.testing.assert_allclose(np.poly((found - np.eye(5)) / 0.04), wanted, rtol=1e-5, atol=1e-9)


def test_a_zero_at_rest_hides_f_only_where_f_enters_through_it() -> None:
    """Through a channel of its own a constant f is found although y rests for any constant u."""
    A, B, E, C = [[0.0, 1.0], [-2.0, -0.5]], [1.0, -0.5], [0.0, 1.0], [1.0, 0.0]
    with pytest.raises(ValueError, match="zero at s = 0"):
        ESO.model_based((A, B, C), 20.0, 0.01)
    observer = ESO.model_based((A, B, E, C), 20.0, 0.01)
    assert observer.plant.zeros == pytest.approx([0.0], abs=1e-12)
    z, seen = np.zeros(3), np.zeros(3)
    for _ in range(400):  # at rest under f = 3: y = 1.5
        observe(observer.model, z, seen, 1.5, 0.0, 0.0)
    np.testing.assert_allclose(seen, [1.5, 0.0, 3.0], atol=1e-6)


@pytest.mark.trial
def test_poles_at_slow_zeros_spare_noise_and_learn_where_the_other_observer_cannot() -> None:
    """A zero at −0.1 rad/s, omega_o = 20: f̂ has a hundredth of the noise, and a learner helps."""
    plant = hidden(3.0 * np.poly([-0.1]), np.poly([-1.0, -0.3, 0.5]))
    scenario = ql.Scenario(0.0, 16.0, (ql.signals.Sinusoid(omega=1.3),))
    errors, noise = {}, {}
    for keep in (False, True):
        observer = ESO.model_based(plant, omega_o=20.0, dt=1e-2, keep_zeros=keep)
        noise[keep] = noise_gains(observer)[-1] ** 0.5
        for learner in (None, ql.learners.Kalman()):
            run = ql.simulate(plant, ql.ADRC(observer, omega_c=2.0, learner=learner), scenario)
            errors[keep, learner is None] = run.metrics(8.0)["rms"]
    assert noise[False] > 100.0 * noise[True]
    assert errors[False, False] > 3.0 * errors[False, True]
    assert errors[True, False] < 0.4 * errors[True, True]


def test_a_gain_of_ones_own_scales_the_whole_input() -> None:
    """b0 replaces the model's b, zeros and all."""
    given, own = (ESO.model_based((NUM, DEN), 20.0, 1e-3, b0=b0) for b0 in (6.0, None))
    np.testing.assert_allclose(given.model.input, 2.0 * own.model.input, rtol=1e-12)
    np.testing.assert_array_equal(given.model.feed, own.model.feed)
