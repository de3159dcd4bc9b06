"""ESO design and update: closed forms, limit cases, the paper's erratum."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import quell as ql
from quell.lti.canonical import canonical
from quell.observers import continuous_gain
from quell.observers.eso import ESO
from quell.observers.forms import begin, observe

from .cases import cases


def error_polynomial(observer: ESO) -> np.ndarray:
    """Return the characteristic polynomial of (I − L C) Φ about z = 1, in scaled coordinates.

    A pole of multiplicity N moves by ε^(1/N), so polynomials are compared, not eigenvalues; about
    z = 1, close to all poles.
    """
    model, size = observer.model, observer.order + 1
    scale = observer.dt ** np.arange(size)
    correct = np.eye(size)
    correct[:, 0] -= model.gain
    error = (correct @ model.transition) * scale[:, None] / scale[None, :]
    return np.poly(error - np.eye(size))


@given(
    order=st.integers(1, 8), dt=st.sampled_from([1e-4, 1e-3, 1e-2]), omega_o=st.floats(1.0, 100.0)
)
def test_all_poles_lie_at_exp_minus_omega_o_dt(order: int, dt: float, omega_o: float) -> None:
    """For every order, sample time and bandwidth: the polynomial is (z − β)^N."""
    observer = ESO.model_free(order=order, b0=1.0, omega_o=omega_o, dt=dt)
    rise = -math.expm1(-omega_o * dt)
    wanted = np.array([math.comb(order + 1, i) * rise**i for i in range(order + 2)])
    np.testing.assert_allclose(
        error_polynomial(observer), wanted, rtol=1e-7, atol=1e-13 * wanted.max()
    )


@given(
    a=st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=5),
    dt=st.sampled_from([1e-3, 5e-3]),
    omega_o=st.floats(5.0, 50.0),
)
def test_a_model_moves_no_pole(a: list[float], dt: float, omega_o: float) -> None:
    """The model-based observer has the requested poles for any coefficients of the plant."""
    observer = ESO.model_based((a, 2.0), omega_o=omega_o, dt=dt)
    rise = -math.expm1(-omega_o * dt)
    wanted = np.array([math.comb(len(a) + 1, i) * rise**i for i in range(len(a) + 2)])
    np.testing.assert_allclose(error_polynomial(observer), wanted, rtol=1e-6, atol=1e-12)


def test_the_sampled_gain_tends_to_the_continuous_one() -> None:
    """L/dt approaches, with an error of order dt, the gain with the poles of A − lC at −omega_o."""
    a, omega_o = np.array([3.0, -1.0, 2.0, 0.5]), 10.0
    errors = []
    for dt in (1e-3, 1e-4):
        gain = ESO.model_based((a, 1.0), omega_o=omega_o, dt=dt).model.gain / dt
        errors.append(np.max(np.abs(gain / continuous_gain(a, omega_o) - 1.0)))
    assert errors[0] < 0.05
    assert errors[0] / errors[1] == pytest.approx(10.0, rel=0.1)


def test_the_fifth_gain_of_the_papers_table_is_wrong() -> None:
    """Erratum to Table I: with ``omega_o^5`` in place of ``L_MB,5`` the poles are at −omega_o.

    For a = −2 and omega_o = 10 the printed gain puts the slowest pole at −2.8.
    """
    a, w = -2.0, 10.0
    printed = np.array(
        [
            5 * w,
            a + 10 * w**2,
            5 * a * w + 10 * w**3,
            a**2 + 10 * a * w**2 + 5 * w**4,
            5 * a**2 * w + 10 * a * w**3 + w**5,
        ]
    )
    right = np.array([*printed[:4], w**5])
    A = np.diag(np.ones(4), 1)
    A[3, 2] = a

    def polynomial(gain: np.ndarray) -> np.ndarray:
        return np.poly(A - np.outer(gain, np.eye(5)[0]))

    binomial = [math.comb(5, i) * w**i for i in range(6)]
    np.testing.assert_allclose(polynomial(right), binomial, rtol=1e-9)
    np.testing.assert_allclose(polynomial(printed)[:5], binomial[:5], rtol=1e-9)
    assert polynomial(printed)[5] == pytest.approx(80_200.0)
    assert np.max(np.roots(polynomial(printed)).real) == pytest.approx(-2.8, abs=0.05)
    np.testing.assert_allclose(continuous_gain(np.array([0.0, 0.0, -a, 0.0]), w), right, rtol=1e-12)


def test_a_model_without_coefficients_is_model_free() -> None:
    """The limit case a = 0: the same numbers."""
    free = ESO.model_free(order=4, b0=2.0, omega_o=10.0, dt=1e-3).model
    based = ESO.model_based((np.zeros(4), 2.0), omega_o=10.0, dt=1e-3).model
    for one, other in zip(free, based, strict=True):
        np.testing.assert_array_equal(one, other)


def run_observer(observer: ESO, y: np.ndarray, u: np.ndarray, f_learned: np.ndarray) -> np.ndarray:
    """Feed records through an observer; return what it hands out, (samples, N)."""
    z, seen = np.zeros(observer.order + 1), np.zeros(observer.order + 1)
    begin(observer.model, z, seen, y[0])
    out = [seen.copy()]
    for k in range(1, y.size):
        observe(observer.model, z, seen, y[k], u[k - 1], f_learned[k - 1])
        out.append(seen.copy())
    return np.array(out)


def test_a_constant_disturbance_is_estimated_without_error() -> None:
    """Once the transient has gone, state and f are exact."""
    dt = 0.01
    observer = ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=dt)
    t = np.arange(400) * dt
    u, f = np.sin(t), 3.0
    plant = ql.plants.LinearPlant(
        [[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0], [1.0, 0.0], [[0.0], [1.0]]
    ).sampled(dt)
    x = np.zeros((t.size, 2))
    for k in range(t.size - 1):
        x[k + 1] = plant.transition @ x[k] + plant.input * u[k] + plant.disturbance[:, 0] * f
    seen = run_observer(observer, x[:, 0], u, np.zeros(t.size))
    np.testing.assert_allclose(seen[-1], [*x[-1], f], rtol=1e-9)


def test_what_is_learned_is_not_estimated_again() -> None:
    """Superposition: feeding the true f forward leaves a residual of zero."""
    dt, f = 0.01, 3.0
    observer = ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=dt)
    y = 0.5 * f * (np.arange(300) * dt) ** 2
    seen = run_observer(observer, y, np.zeros(300), np.full(300, f))
    assert np.max(np.abs(seen[:, 2])) < 1e-9


def test_the_predictor_form_is_the_current_form_a_sample_late(rng: np.random.Generator) -> None:
    """Its state is Φ times that of the current form, plus the inputs: the same poles, later y."""
    y, u = rng.normal(size=50), rng.normal(size=50)
    current, predictor = (
        ESO.model_free(order=3, b0=1.5, omega_o=8.0, dt=0.01, form=form)
        for form in ("current", "predictor")
    )
    now, before = (
        run_observer(current, y, u, np.zeros(50)),
        run_observer(predictor, y, u, np.zeros(50)),
    )
    model = current.model
    np.testing.assert_allclose(
        before[1:], now[:-1] @ model.transition.T + np.outer(u[:-1], model.input), atol=1e-12
    )


def test_the_observer_starts_at_the_first_measurement() -> None:
    """At rest there: no transient where nothing moves."""
    observer = ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-3)
    seen = run_observer(observer, np.full(200, 7.0), np.zeros(200), np.zeros(200))
    np.testing.assert_allclose(seen, np.tile([7.0, 0.0, 0.0, 0.0, 0.0], (200, 1)), atol=1e-7)


def test_a_state_space_model_and_a_transfer_function_give_the_same_coefficients() -> None:
    """Own plants, python-control's systems and plain coefficients lead to one canonical form."""
    m1, m2, k = 0.7, 1.3, 2.0
    plant = ql.plants.two_mass_spring(m1, m2, k)
    wanted = canonical(([0.0, 0.0, k * (m1 + m2) / (m1 * m2), 0.0], k / (m1 * m2)))
    system = control.ss(plant.A, plant.B, plant.C, 0.0)
    for model in (plant, system, control.tf([wanted.b], [1.0, 0.0, wanted.a[2], 0.0, 0.0])):
        found = canonical(model)
        np.testing.assert_allclose(found.a, wanted.a, atol=1e-9)
        assert found.b == pytest.approx(wanted.b)


@given(a=st.lists(st.floats(-5.0, 5.0), min_size=2, max_size=6), seed=st.integers(0, 1000))
def test_the_canonical_form_does_not_depend_on_the_coordinates(a: list[float], seed: int) -> None:
    """A companion form hidden by a change of coordinates is found again, and S maps the states."""
    n = len(a)
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -np.array(a)
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0]
    hidden = ql.plants.LinearPlant(
        turn @ A @ turn.T, turn @ np.eye(n)[-1] * 3.0, np.eye(n)[0] @ turn.T
    )
    found = canonical(hidden)
    np.testing.assert_allclose(found.a, a, atol=1e-6)
    assert found.b == pytest.approx(3.0)
    np.testing.assert_allclose(found.S @ turn, np.eye(n), atol=1e-7)


UNOBSERVABLE = ql.plants.LinearPlant(np.diag([-1.0, -2.0]), [1.0, 1.0], [1.0, 0.0])


@cases(
    ("change", "message"),
    [
        ({"order": 0}, "order = 0: must be a whole number from 1 to 8"),
        ({"order": 9}, "order = 9: must be a whole number from 1 to 8"),
        ({"order": 2.0}, "order = 2.0: must be a whole number from 1 to 8"),
        ({"omega_o": -1.0}, "omega_o = -1.0: must be finite and greater than zero"),
        ({"omega_o": math.nan}, "omega_o = nan: must be finite and greater than zero"),
        ({"dt": 0.0}, "dt = 0.0: must be finite and greater than zero"),
        ({"b0": 0.0}, "b0 = 0.0: must not be zero"),
        ({"b0": math.inf}, "b0 = inf: must be a finite number"),
        ({"form": "euler"}, "form = 'euler': must be one of current, predictor"),
    ],
)
def test_a_mistake_in_a_model_free_design_is_named(change: dict[str, object], message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        ESO.model_free(**({"order": 4, "b0": 1.0, "omega_o": 10.0, "dt": 1e-3} | change))


@cases(
    ("plant", "message"),
    [
        (
            UNOBSERVABLE,
            "plant is not observable from y: its observability matrix has rank 1, not 2",
        ),
        (control.tf([1.0], [1.0, 2.0], 0.1), "plant has a sample time, dt = 0.1"),
        (control.ss([[-1.0]], [[1.0]], [[1.0]], [[1.0]]), "D = .*: must be zero"),
        (
            control.ss(np.eye(2), np.eye(2), np.eye(2), 0.0),
            r"B has shape \(2, 2\), C \(2, 2\): 2 inputs and 2 outputs, here there is one of each",
        ),
        (([1.0], 0.0), "b = 0.0: must not be zero"),
        (([-1e12], 1.0), "dt = 0.001 s: too long .* for the plant's fastest pole of 1e[+]12 rad/s"),
        (([(math.pi / 1e-3) ** 2, 0.0], 1.0), "the sampled model cannot be observed"),
        ("two-mass", "plant = 'two-mass': must be a linear plant"),
        ((np.zeros(9), 1.0), "order of the plant = 9: must be a whole number from 1 to 8"),
    ],
)
def test_a_mistake_in_a_model_is_named(plant: object, message: str) -> None:
    """Assumptions that fail are said, with by how much."""
    with pytest.raises(ValueError, match=message):
        ESO.model_based(plant, omega_o=10.0, dt=1e-3)


def test_an_omega_o_whose_powers_overflow_is_refused() -> None:
    """By its name; not by an error of a library."""
    with pytest.raises(ValueError, match=r"omega_o = 1e\+100 rad/s with dt = 0.01 s: powers of"):
        ql.ESO.model_free(order=4, b0=1.0, omega_o=1e100, dt=0.01)
