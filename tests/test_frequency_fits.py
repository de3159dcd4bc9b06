"""A transfer function from a table of frequencies: its sections, its start, its choice, its report."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy import optimize, signal
from scipy.ndimage import median_filter

from quell.identification import identify_frequencies
from quell.identification.frequency_model import FrequencyModel, _faults, hold_of
from quell.identification.from_frequencies import (
    _closed,
    _coefficients,
    _cost,
    _covariance,
    _Data,
    _delays,
    _Fit,
    _holds,
    _nothing,
    _roots,
    _scatter,
    _sections,
    _Shape,
    _slow,
    _smallest,
    _surpasses,
    _terms,
    _vector_fit,
)
from quell.identification.model import WITHIN_95, Root
from quell.identification.vector_fitting import _basis, _cleaned, _solved, _state

from .cases import cases

OMEGA = np.geomspace(0.5, 50.0, 40)
MIDDLE = 5.0
S = 1j * OMEGA / MIDDLE
# K/s, a real pole in the left and one in the right half plane, a pair; a real zero, a pair; a delay.
SHAPE = _Shape(1, (1.0, -1.0), 1, (1.0,), 1, True, -1.0)
THETA = np.array(
    [math.log(2.0), *np.log([0.5, 3.0, 1.2]), 0.3, *np.log([0.7, 2.0]), 0.15, 0.05]
)  # fmt: skip


def model(theta: np.ndarray, s: Any) -> Any:
    """Return G of that shape by its formula."""
    K, p, q, w, z, v = np.exp(theta[0]), *np.exp(theta[1:4]), theta[4], np.exp(theta[5])
    u, x, late = np.exp(theta[6]), theta[7], theta[8]
    num = (1.0 + s / v) * (1.0 + 2.0 * x * s / u + s**2 / u**2) * np.exp(-late * s)
    return -K / s * num / ((1.0 + s / p) * (1.0 - s / q) * (1.0 + 2.0 * z * s / w + s**2 / w**2))


def data_of(G: Any, std: float = 1e-3, fixed: float | None = None) -> _Data:
    """Return a table of G."""
    return _Data(S, np.log(G), np.full(S.size, std), fixed)


def fit_of(shape: _Shape, theta: Any, cost: float = 1.0, residual: Any = None, **more: Any) -> _Fit:
    """Return a fit."""
    residual = np.zeros(2 * S.size) if residual is None else residual
    jacobian = more.get("jacobian", np.vstack([np.eye(len(theta))] * 2))
    return _Fit(shape, np.array(theta, dtype=float), cost, 0.01, jacobian, residual, True)


# ---- the sections


def test_sections_are_their_formula_and_slopes_are_differences() -> None:
    """Real ones of either half plane, pairs, an integrator and a delay."""
    found, slopes = _terms(SHAPE, THETA, S)
    np.testing.assert_allclose(-np.exp(found), model(THETA, S), rtol=1e-12)
    for k in range(THETA.size):
        step = 1e-6 * np.eye(THETA.size)[k]
        near = [_terms(SHAPE, THETA + sign * step, S)[0] for sign in (1.0, -1.0)]
        np.testing.assert_allclose(slopes[:, k], (near[0] - near[1]) / 2e-6, atol=1e-8)
    assert (SHAPE.order, SHAPE.zero_count, SHAPE.size) == (5, 3, 9)
    assert SHAPE._replace(delayed=False, integrators=2).size == 8


def test_coefficients_are_those_of_the_sections_in_seconds() -> None:
    """The ratio of polynomials times the delay is G at any frequency."""
    values = _coefficients(SHAPE, THETA, MIDDLE)
    assert values.size == 4 + 4 + 1
    a, b, late = values[:4], values[4:8], values[8]
    s = 1j * np.array([0.3, 4.0, 60.0])
    G = np.polyval(b[::-1], s) / np.polyval([1.0, *a[::-1], 0.0], s) * np.exp(-late * s)
    np.testing.assert_allclose(G, model(THETA, s / MIDDLE), rtol=1e-11)
    assert late == pytest.approx(0.05 / MIDDLE)
    without = _Shape(0, (1.0,), 0, (), 0, False, 1.0)
    lag = _coefficients(without, np.array([math.log(4.0), math.log(0.5)]), MIDDLE)
    assert lag.tolist() == pytest.approx([2.5, 10.0, 0.0])


def test_roots_are_those_of_the_coefficients_and_their_slopes_are_differences() -> None:
    """Poles and zeros per unit of the middle frequency."""
    poles, zeros, of_poles, of_zeros = _roots(fit_of(SHAPE, THETA))
    values = _coefficients(SHAPE, THETA, 1.0)
    key = lambda root: (root.real, root.imag)  # noqa: E731
    expected = sorted(np.roots([1.0, *values[3::-1]]), key=key)
    np.testing.assert_allclose(sorted(poles, key=key), expected, rtol=1e-10)
    expected = sorted(np.roots(values[7:3:-1]), key=key)
    np.testing.assert_allclose(sorted(zeros, key=key), expected, rtol=1e-10)
    for k in range(THETA.size):
        step = 1e-6 * np.eye(THETA.size)[k]
        near = [_roots(fit_of(SHAPE, THETA + sign * step)) for sign in (1.0, -1.0)]
        for which, slopes in ((0, of_poles), (1, of_zeros)):
            by_hand = (np.array(near[0][which]) - np.array(near[1][which])) / 2e-6
            np.testing.assert_allclose([each[k] for each in slopes], by_hand, atol=1e-8)


# ---- the start


def test_partial_fractions_have_a_state_space_form() -> None:
    """Columns of the basis are (s − A)⁻¹ b, for pairs and for real poles; zeros by its feedback."""
    poles = np.array([-0.3 + 2.0j, -0.3 - 2.0j, -1.5])
    columns = _basis(S, poles)
    A, b = _state(poles)
    for i in (0, 17, 39):
        np.testing.assert_allclose(columns[i], np.linalg.solve(S[i] * np.eye(3) - A, b), rtol=1e-10)
    r = np.array([0.7, -0.4, 2.0])
    np.testing.assert_allclose(sorted(np.linalg.eigvals(A), key=abs), sorted(poles, key=abs))
    zeros = np.linalg.eigvals(A - np.outer(b, r) / 0.5)
    at = zeros[0]
    value = _basis(np.array([at]), poles) @ r + 0.5
    assert abs(value[0]) < 1e-9


@cases(("order", "late"), [(1, 0.0), (2, 0.1), (3, 0.0), (4, 0.05)])
def test_vector_fitting_finds_a_rational_response_exactly(order: int, late: float) -> None:
    """Poles and zeros of a pair, a lag and another pair, with direct feedthrough."""
    pairs = [-0.05 + 0.8j, -0.05 - 0.8j, -0.2 + 3.0j, -0.2 - 3.0j]
    poles = np.array({1: [-0.6], 2: pairs[:2], 3: [*pairs[:2], -2.0], 4: pairs}[order])
    zeros = poles * 1.7
    G = 0.4 * np.prod(S[:, None] - zeros, axis=1) / np.prod(S[:, None] - poles, axis=1)
    found = _vector_fit(data_of(G * np.exp(-late * S)), order, late)
    for each, truth in zip(found, (poles, zeros), strict=True):
        np.testing.assert_allclose(np.sort_complex(each), np.sort_complex(truth), rtol=1e-6)


def test_a_real_least_squares_solution_of_a_complex_equation() -> None:
    """Of columns of any size; a column of zeros has none."""
    left = np.column_stack([S, 1e6 / (1.0 + S), 0.0 * S])
    assert _solved(left, left @ [2.0, -3e-6, 0.0]) == pytest.approx([2.0, -3e-6, 0.0], rel=1e-9)


def test_roots_are_cleaned_into_pairs_and_real_ones_that_are_not_zero() -> None:
    """Pairs first, the upper one before its conjugate."""
    found = _cleaned(np.array([-2.0, -1.0 - 3.0j, -1.0 + 3.0j, 1e-12, -4.0 + 1e-12j]))
    assert found.tolist() == [-1.0 + 3.0j, -1.0 - 3.0j, -2.0, -1e-9, -4.0]
    signs, logs, pairs = _sections(np.array([-2.0, 0.5, -1.2 + 1.6j, -1.2 - 1.6j]))
    assert signs == (1.0, -1.0)
    assert logs == pytest.approx(np.log([2.0, 0.5]).tolist())
    assert pairs == pytest.approx([math.log(2.0), 0.6])
    assert _closed(np.array([1j, -1j, 2.0]))
    assert not _closed(np.array([1j, 2.0]))


def test_the_smallest_zeros_are_kept_pairs_whole() -> None:
    """A pair that does not fit gives one real zero; where there are too few, far ones are added."""
    roots = np.array([-5.0, -1.0 + 1.0j, -1.0 - 1.0j, -0.5, 7.0])
    assert _smallest(roots, 0).tolist() == []
    assert _smallest(roots, 1).tolist() == [-0.5]
    assert _smallest(roots, 2).tolist() == [-0.5, pytest.approx(-math.sqrt(2.0))]
    assert _smallest(roots, 3).tolist() == [-0.5, -1.0 + 1.0j, -1.0 - 1.0j]
    assert _smallest(roots, 5).tolist() == [-0.5, -1.0 + 1.0j, -1.0 - 1.0j, -5.0, 7.0]
    assert _smallest(np.array([-4.0]), 3).tolist() == [-4.0, -40.0, -400.0]
    assert _smallest(np.array([-0.1]), 2).tolist() == [-0.1, -10.0]


def test_delays_to_start_at_are_near_the_one_that_there_is() -> None:
    """Of a lag late by 0.4; a delay that is given is the only one, and none where phase rises."""
    G = 1.0 / (1.0 + S / 0.5)
    found = _delays(data_of(G * np.exp(-0.4 * S)), 1)
    assert 1 <= len(found) <= 2
    assert found[0] == pytest.approx(0.4, abs=0.03)
    assert _delays(data_of(G, fixed=0.7), 1) == [0.7]
    assert _delays(data_of(1.0 + S / 0.5), 1) == [0.0]


def test_a_pole_is_slow_up_to_twice_the_lowest_frequency() -> None:
    """In units of the middle one."""
    assert _slow(data_of(1.0 / S)) == pytest.approx(2.0 * 0.1)


# ---- deviations


def test_points_scatter_by_what_they_are_off_a_cubic_of_four_neighbours() -> None:
    """Smoothed by a median; a cubic in ln ω has none but the digits'."""
    x = np.log(OMEGA)
    smooth = 0.1 * x**3 - 0.2j * x**2 + 3.0j
    assert _scatter(OMEGA, smooth) == pytest.approx(np.full(40, 1e-5))
    rng = np.random.default_rng(4)
    log = smooth + 0.01 * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
    off = np.zeros(40)
    for k in range(40):
        first = min(max(k - 2, 0), 35)
        near = [i for i in range(first, first + 5) if i != k]
        V = np.vander(x[near] - x[k], 4)
        weights = np.linalg.inv(V)[-1]
        off[k] = abs(weights @ log[near] - log[k]) / math.sqrt(1.0 + weights @ weights)
    local = median_filter(off, size=11, mode="nearest")
    expected = np.maximum(local, 0.3 * np.median(local))
    np.testing.assert_allclose(_scatter(OMEGA, log), expected, rtol=1e-9)
    # A turn of the phase is no scatter.
    turned = log.copy()
    turned[20:] += 2.0j * math.pi
    np.testing.assert_allclose(_scatter(OMEGA, turned), expected, rtol=1e-9)


def test_neighbours_that_err_alike_are_fewer_points() -> None:
    """Correlation 0 to 0.95; the covariance is that of least squares times (1 + ρ)/(1 − ρ)."""
    e = np.repeat([1.0, -1.0], 5)
    alike = np.tile(e, 8)
    fit = fit_of(_Shape(0, (1.0,), 0, (), 0, False, 1.0), [0.0, 0.0], residual=alike)
    rho = (80 - 2 - 2 * 2 * 7) / 80.0
    assert fit.correlation == pytest.approx(rho)
    J = np.random.default_rng(1).standard_normal((80, 2)) * [1.0, 1e4]
    fit = fit._replace(jacobian=J)
    factor = 80.0 / 78.0 * (1.0 + rho) / (1.0 - rho)
    np.testing.assert_allclose(_covariance(fit), factor * np.linalg.inv(J.T @ J), rtol=1e-9)
    assert fit._replace(residual=np.ones(80)).correlation == 0.95
    assert fit._replace(residual=np.tile([1.0, -1.0], 40)).correlation == 0.0
    none = fit._replace(residual=np.zeros(80))
    assert none.correlation == 0.0
    np.testing.assert_allclose(_covariance(none), 1e-10 * np.linalg.inv(J.T @ J), rtol=1e-9)


# ---- the choice


def test_a_larger_model_has_to_lower_the_error_by_more_than_chance() -> None:
    """2 N ln of the costs against (more + 2) ln 2 N; a smaller one may be worse by that of its size."""
    data = data_of(1.0 / S)
    small = fit_of(_Shape(0, (1.0,), 0, (), 0, False, 1.0), [0.0] * 2)
    large = fit_of(_Shape(0, (1.0, 1.0), 0, (), 0, False, 1.0), [0.0] * 3)
    n, step = 80.0, math.log(80.0)
    limit = math.exp(-3.0 * step / n)
    assert _surpasses(large._replace(cost=0.999 * limit), small, data)
    assert not _surpasses(large._replace(cost=1.001 * limit), small, data)
    less = math.exp(step / n)
    assert _surpasses(small._replace(cost=0.999 * less), large, data)
    assert not _surpasses(small._replace(cost=1.001 * less), large, data)
    assert not _surpasses(small, small, data)
    assert _surpasses(small._replace(cost=0.99), small, data)
    # Errors that are alike are fewer points.
    e = np.tile(np.repeat([1.0, -1.0], 4), 10)
    alike = [fit._replace(residual=e) for fit in (large, small)]
    rho = alike[0].correlation
    limit = math.exp(-3.0 * step / n * (1.0 + rho) / (1.0 - rho))
    assert _surpasses(alike[0]._replace(cost=0.999 * limit), alike[1], data)
    assert not _surpasses(alike[0]._replace(cost=1.001 * limit), alike[1], data)
    assert _cost(small._replace(cost=0.0)) == 1e-12
    assert _nothing().cost == math.inf


def lag(*, poles: Any = (1.0,), zeros: Any = (), signs: Any = None, size: float = 1e-3) -> _Fit:
    """Return a fit with real roots whose logarithms have this deviation."""
    signs = (1.0,) * len(poles) if signs is None else signs
    shape = _Shape(0, signs, 0, (1.0,) * len(zeros), 0, False, 1.0)
    theta = [0.0, *np.log(poles), *np.log(zeros)]
    J = np.vstack([np.eye(len(theta)) / size] * 2)
    # A power of one for each degree of freedom: deviations are size/√2.
    residual = np.tile([1.0, -1.0], len(theta)) * math.sqrt(0.5)
    return fit_of(shape, theta, residual=residual, jacobian=J)


@cases(
    ("fit", "holds"),
    [
        (lag(), True),
        (lag(signs=(-1.0,)), False),
        (lag(poles=(29.9,)), True),
        (lag(poles=(30.1,)), False),
        (lag(poles=(0.0334,)), True),
        (lag(poles=(0.0333,)), False),
        (lag(zeros=(29.9,)), True),
        (lag(zeros=(30.1,)), False),
        (lag(zeros=(1.0 + 2.0 * 3.0 * 1.02e-3 / math.sqrt(2.0),)), True),
        (lag(zeros=(1.0 + 2.0 * 3.0 * 0.98e-3 / math.sqrt(2.0),)), False),
    ],
)
def test_a_model_holds_within_three_times_the_table_and_without_equal_roots(
    fit: _Fit, holds: bool
) -> None:
    """Poles are stable; a pole and a zero are three deviations of both apart."""
    assert _holds(fit, data_of(1.0 / S)) == holds


# ---- the whole


def noisy(size: float = 5e-3) -> Any:
    """Return 12/(s + 3) exp(−0.05 s) with relative errors."""
    rng = np.random.default_rng(7)
    s = 1j * OMEGA
    e = size * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
    return 12.0 / (s + 3.0) * np.exp(-0.05 * s + e)


@cache
def found() -> FrequencyModel:
    """Return its model."""
    return identify_frequencies(OMEGA, noisy(), 1, 0, integrators=0, deviation=np.full(40, 5e-3))


def test_a_lag_with_delay_has_the_values_and_deviations_of_least_squares() -> None:
    """b, a, delay, their covariance, intervals and the error, by SciPy with differences."""
    s, G = 1j * OMEGA, noisy()

    def error(theta: np.ndarray) -> np.ndarray:
        b, a, late = theta
        e = np.log(b / (s + a)) - s * late - np.log(np.abs(G)) - 1j * np.unwrap(np.angle(G))
        return np.concatenate([e.real, e.imag]) / 5e-3

    best = optimize.least_squares(error, [12.0, 3.0, 0.05], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    it = found()
    b, a, late = best.x
    assert (it.num[0], it.den[1], it.delay) == pytest.approx((b, a, late), rel=1e-6)
    assert it.den[0] == 1.0
    assert (it.gain, it.integrators, it.dt, it.known, it.converged) == (
        pytest.approx(b / a),
        0,
        None,
        True,
        True,
    )
    e = best.fun.reshape(2, -1)
    rho = max(float(np.sum(e[:, 1:] * e[:, :-1]) / np.sum(e**2)), 0.0)
    factor = float(np.sum(e**2)) / 77.0 * (1.0 + rho) / (1.0 - rho)
    covariance = factor * np.linalg.inv(best.jac.T @ best.jac)
    order = [1, 0, 2]
    expected = covariance[np.ix_(order, order)]
    np.testing.assert_allclose(it.covariance, expected[:2, :2], rtol=1e-4)
    np.testing.assert_allclose(it.delay_covariance, expected[2], rtol=1e-4)
    half = WITHIN_95 * math.sqrt(covariance[2, 2])
    assert it.delay_interval == pytest.approx((late - half, late + half), rel=1e-5)
    slope = np.array([1.0 / a, -b / a**2])
    spread = WITHIN_95 * math.sqrt(slope @ covariance[:2, :2] @ slope)
    assert it.gain_interval == pytest.approx((b / a - spread, b / a + spread), rel=1e-4)
    (pole,) = it.poles
    assert pole.value == pytest.approx(-a)
    assert pole.real_std == pytest.approx(math.sqrt(covariance[1, 1]), rel=1e-4)
    assert it.error == pytest.approx(math.sqrt(2.0 * np.mean((5e-3 * e) ** 2)), rel=1e-6)
    assert it.zeros == ()
    assert it.shortcomings == ()
    np.testing.assert_allclose(it.response_at(OMEGA), b / (s + a) * np.exp(-s * late), rtol=1e-6)


def test_a_negative_gain_has_the_same_model_with_the_other_sign() -> None:
    """Its phase begins at half a turn; the delay is the same, given or found."""
    for delay in (None, found().delay):
        how: dict[str, Any] = {"integrators": 0, "deviation": np.full(40, 5e-3), "delay": delay}
        one, other = (identify_frequencies(OMEGA, G, 1, 0, **how) for G in (noisy(), -noisy()))
        assert other.num[0] == pytest.approx(-one.num[0], rel=1e-6)
        assert other.den[1] == pytest.approx(one.den[1], rel=1e-6)
        assert other.delay == pytest.approx(one.delay, rel=1e-6)
        assert other.gain_interval == pytest.approx(
            (-one.gain_interval[1], -one.gain_interval[0]), rel=1e-5
        )


def test_the_report_of_a_table_has_all_numbers() -> None:
    """Lines in order; JSON."""
    it = found()
    low, high = it.gain_interval
    early, late = it.delay_interval
    lines = str(it).splitlines()
    assert lines[0].endswith(f" · exp(−{it.delay:g} s)")
    assert lines[1:4] == [
        "least error of ln G",
        "",
        "pole [rad/s]                  ± real      ± imag     |p|       damping",
    ]
    assert lines[5:] == [
        "",
        f"gain {it.gain:.5g}, 95 %: {low:.5g} to {high:.5g}",
        f"delay {it.delay:.4g} s, 95 %: {early:.4g} to {late:.4g} s",
        f"error of G: {100.0 * it.error:.3g} % (RMS)",
    ]
    value = it.to_json()
    assert (value["num"], value["den"]) == (it.num.tolist(), it.den.tolist())
    assert value["poles"] == [
        {
            "real": it.poles[0].value.real,
            "imag": 0.0,
            "real_std": it.poles[0].real_std,
            "imag_std": it.poles[0].imag_std,
            "omega": it.poles[0].omega,
            "damping": it.poles[0].damping,
        }
    ]
    for name in ("delay", "gain", "error", "integrators", "converged"):
        assert value[name] == getattr(it, name), name
    assert (value["frequencies"], value["held_for"], value["zeros"]) == (40, None, [])
    assert list(value["gain_interval"]) == [low, high]
    assert list(value["delay_interval"]) == [early, late]
    ended = replace(it, converged=False, delay=0.0, error=0.31)
    lines = str(ended).splitlines()
    assert "exp" not in lines[0]
    assert lines[1] == "least error of ln G; the search did NOT converge"
    assert lines[-1] == (
        "NOT: the model is off by 31 % (RMS): no order up to 8 explains the table; leave out "
        "frequencies with little coherence, or give a band with fewer modes"
    )
    assert not any(line.startswith("delay") for line in lines)
    assert not replace(it, error=0.3).is_poor


def test_what_a_table_does_not_decide_is_said() -> None:
    """Too few frequencies for the numbers, and a gain without an end where the fit is poor."""
    it = replace(found(), known=False)
    assert it.undecided == (
        "the table has 40 frequencies for 3 numbers: their deviations are not known; measure more "
        "frequencies",
    )
    assert replace(it, delay=0.0).undecided[0].startswith("the table has 40 frequencies for 2 ")
    open_ = replace(found(), gain_interval=(1.0, math.inf))
    assert open_.undecided == ()
    assert replace(open_, error=0.4).undecided == (
        "the table does not decide the gain; begin it lower",
    )
    few = identify_frequencies(OMEGA[::5], noisy()[::5], 4, 3, integrators=0, delay=0.05)
    assert few.known == (2 * 8 >= 2.0 * 8 + 2)


def test_poles_that_are_unstable_fast_or_cancelled_are_faults() -> None:
    """Of a pair once; each with what to do; limits from both sides."""
    top = np.array([1.0, 10.0])

    def root(value: complex, std: float = 0.01) -> Root:
        return Root(value, std, 0.0)

    (text,) = _faults((root(2.0 + 1.0j), root(2.0 - 1.0j)), (), top)
    assert text.endswith(
        "rad/s is unstable; if the plant is stable, give a lower order, or leave out frequencies "
        "with little coherence"
    )
    assert text.startswith("the pole at 2+1j rad/s")
    assert _faults((root(0.0), root(-29.9)), (), top) == []
    (text,) = _faults((root(-30.1),), (), top)
    assert text.endswith("rad/s is faster than the table shows, 10 rad/s; give a lower order")
    apart = 3.0 * (root(-1.0).deviation + root(-1.0).deviation)
    assert _faults((root(-1.0),), (root(-1.0 - 1.01 * apart),), top) == []
    near = (root(-1.0 - 0.99 * apart), root(-1.0))
    (text,) = _faults((root(-1.0),), near, top)
    assert text.endswith("rad/s nearly equals a zero; give one pole and one zero less")


def test_a_hold_is_late_by_half_a_sample_and_lower_at_high_frequencies() -> None:
    """(1 − exp(−s dt))/(s dt); 1 without one."""
    s = 1j * OMEGA
    np.testing.assert_allclose(hold_of(s, 0.02), (1.0 - np.exp(-0.02 * s)) / (0.02 * s), rtol=1e-9)
    assert hold_of(s, None) == 1.0


@cases(
    ("omega", "G", "more", "message"),
    [
        (OMEGA[:7], OMEGA[:7], {}, "omega has 7 frequencies: must have at least 8; measure more"),
        (OMEGA, OMEGA[:7], {}, "response: must be 40 finite numbers, one for each omega"),
        (OMEGA, OMEGA * np.nan, {}, "response: must be 40 finite numbers, one for each omega"),
        (OMEGA - 0.5, OMEGA, {}, "omega: must rise from above zero on"),
        (OMEGA[::-1], OMEGA, {}, "omega: must rise from above zero on"),
        (OMEGA, OMEGA - OMEGA[3], {}, f"response is zero at {OMEGA[3]:g} rad/s: has no logarithm"),
        (OMEGA, OMEGA, {"order": 9}, "order = 9: must be a whole number from 1 to 8"),
        (OMEGA, OMEGA, {"order": 2, "zeros": 3}, "zeros = 3: must be a whole number from 0 to 2"),
        (OMEGA, OMEGA, {"order": 2, "integrators": 3}, "integrators = 3: must be a whole number"),
        (OMEGA, OMEGA, {"delay": -1.0}, "delay = -1"),
        (OMEGA, OMEGA, {"dt": 0.0}, "dt = 0"),
        (OMEGA, OMEGA, {"deviation": OMEGA[:3]}, "deviation"),
    ],
)
def test_tables_that_are_none_are_refused(omega: Any, G: Any, more: Any, message: str) -> None:
    """With the rule."""
    with pytest.raises(ValueError, match=message):
        identify_frequencies(omega, G, **more)


def test_images_of_the_samples_of_a_held_u_add_no_pole() -> None:
    """The response of the samples themselves, up to half the sampling rate, with hardly any noise."""
    dt, num, den = 0.01, [40.0], [1.0, 4.0, 40.0]
    b, a, _ = signal.cont2discrete((num, den), dt)
    omega = np.linspace(1.0, 310.0, 70)
    z = np.exp(1j * omega * dt)
    G = np.polyval(b.ravel(), z) / np.polyval(a, z) / z
    known = {"zeros": 0, "integrators": 0, "deviation": np.full(omega.size, 1e-4)}
    found = identify_frequencies(omega, G, dt=dt, **known)  # type: ignore[arg-type]
    assert found.shortcomings == ()
    assert found.den[1:] == pytest.approx(den[1:], rel=2e-3)
    assert found.delay == pytest.approx(dt, rel=0.01)
    assert found.omega[-1] < 0.7 * omega[-1]
