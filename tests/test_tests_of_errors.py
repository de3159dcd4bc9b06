"""The tests of the error of a fit against the equations of their texts, with both sides of their limits."""

from __future__ import annotations

import math
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from scipy import signal, stats

from quell.identification import search, validation
from quell.identification.model import Structure, chains, output
from quell.identification.output_error import ParameterEstimate, noise_model
from quell.identification.search import Fit, Wanted
from quell.identification.starts import AtRest
from quell.identification.validation import Linearised

from .cases import cases

pytestmark = pytest.mark.compiled

N = 140


@cache
def binary(count: int = N, seed: int = 1) -> np.ndarray:
    """Return a u of ±1 that holds each value for three samples, with sizes that vary."""
    rng = np.random.default_rng(seed)
    u = np.sign(rng.standard_normal(count)).repeat(3)[:count]
    return u * (1.0 + 0.5 * np.sin(0.2 * np.arange(count)))


def noise(size: float, count: int = N, seed: int = 6) -> np.ndarray:
    """Return white noise."""
    return size * np.random.default_rng(seed).standard_normal(count)


def through(num: Any, den: Any, u: np.ndarray) -> np.ndarray:
    """Return the response to a held u from rest, by SciPy."""
    b, a, _ = signal.cont2discrete((num, den), 1.0)
    return np.asarray(signal.lfilter(np.ravel(b), a, u))


def fitted(
    u: np.ndarray, y: np.ndarray, order: int = 1, delay: float = 0.0, zeros: int = 0
) -> Linearised:
    """Return a fit, linearised."""
    wanted = Wanted(order=order, zeros=zeros, integrators=0, delays=(delay, delay), grows=False,
                    bias=True, friction=False, rest=False, resolution=0.0, known=None, report=lambda: None)  # fmt: skip
    return Linearised.of(search.fit(u, y, (), wanted), u, y)


def late(near: Linearised) -> np.ndarray:
    """Return u as it acts: later, with its first value before."""
    d = int(near.fit.delay)
    return np.concatenate([np.full(d, near.u[0]), near.u[: near.u.size - d]])


def slopes(near: Linearised) -> np.ndarray:
    """Return the derivatives of the output by θ, by differences."""
    fit = near.fit
    v, theta = np.column_stack([late(near), np.ones(near.u.size)]), fit.estimate.theta
    columns = []
    for k in range(theta.size):
        step = 1e-6 * max(abs(theta[k]), 0.1) * np.eye(theta.size)[k]
        two = [output(fit.structure, theta + sign * step, v) for sign in (1.0, -1.0)]
        columns.append((two[0] - two[1]) / (2.0 * step[k]))
    return np.column_stack(columns)


def explained(near: Linearised, extra: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return χ² of further columns, the coefficients of all, and their covariance."""
    psi = slopes(near)
    white = signal.lfilter(near.c, [1.0], np.column_stack([psi, extra, near.error]), axis=0)
    target, all_of_it = white[:, -1], white[:, :-1]
    left = []
    for part in (all_of_it[:, : psi.shape[1]], all_of_it):
        theta = np.linalg.lstsq(part, target, rcond=None)[0]
        left.append(float(np.sum((target - part @ theta) ** 2)))
    power = left[1] / (target.size - all_of_it.shape[1])
    return (left[0] - left[1]) / power, theta, power * np.linalg.inv(all_of_it.T @ all_of_it)


def of(near: Linearised) -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator, descending powers."""
    structure, theta = near.fit.structure, near.fit.estimate.theta
    b = structure.numerators(theta)[0, : structure.degrees[0] + 1]
    return b[::-1], np.append(1.0, structure.denominator(theta)[::-1])


@cache
def lacking() -> Linearised:
    """Return a lag fitted to two."""
    u = binary()
    return fitted(u, through([0.5], np.polymul([1.0, 0.2], [1.0, 1.0]), u) + noise(0.003))


@cache
def plain(delay: float = 0.0) -> Linearised:
    """Return a lag fitted to a lag."""
    u = binary()
    held = np.concatenate([np.full(int(delay), u[0]), u[: N - int(delay)]])
    return fitted(u, through([1.0], [1.0, 0.5], held) + 0.3 + noise(0.01), delay=delay)


def test_a_fit_near_its_parameters_has_error_slopes_and_noise() -> None:
    """As SciPy and differences have them."""
    near = plain()
    assert of(near)[1][1] == pytest.approx(0.5, rel=0.03)
    np.testing.assert_allclose(near.psi, slopes(near), rtol=1e-4, atol=1e-6)
    v = np.column_stack([near.u, np.ones(N)])
    y = through([1.0], [1.0, 0.5], near.u) + 0.3 + noise(0.01)
    np.testing.assert_allclose(
        near.error, y - output(near.fit.structure, near.fit.estimate.theta, v)
    )
    c, variance = noise_model(near.error)
    np.testing.assert_array_equal(near.c, c)
    assert near.variance == variance


@cases("which", ["lacking", "plain"])
def test_one_more_pole_is_a_multiplier_test_of_four_poles(which: str) -> None:
    """λ from a third of the slowest pole to three times the fastest; p/(p + λ) of the response."""
    near = {"lacking": lacking, "plain": plain}[which]()
    found = validation.one_more_pole(near)
    b, a = of(near)
    pole = abs(np.roots(a)[0])
    rates = np.geomspace(pole / 3.0, min(3.0 * pole, 2.0), 4)
    extra = np.column_stack(
        [
            through(np.append(b, 0.0), np.polymul(a, [1.0, rate]), near.u - near.u[0])
            for rate in rates
        ]
    )
    statistic, theta, covariance = explained(near, extra)
    assert found.statistic == pytest.approx(statistic, rel=2e-3)
    assert found.limit == pytest.approx(stats.chi2.isf(1e-3, 4))
    if which == "plain":
        assert (found.statistic <= found.limit, found.misfit) == (True, 0.0)
        assert math.isnan(found.omega)
        return
    omega = np.geomspace(2.0 * np.pi / N, 0.6, 80)
    s = 1j * omega[:, None]

    def response(at: np.ndarray) -> np.ndarray:
        structure = near.fit.structure
        numerator = structure.numerators(at)[0, 0]
        return numerator / (s[:, 0] + structure.denominator(at)[0])

    at = near.fit.estimate.theta
    by_theta = []
    for k in range(at.size):
        step = 1e-6 * np.eye(at.size)[k]
        by_theta.append((response(at + step) - response(at - step)) / 2e-6 / response(at))
    row = np.column_stack([*by_theta, *(s / (s + rates)).T])
    phase = np.unwrap(np.angle(response(at))) - 0.5 * omega
    assert np.all(phase - phase[0] > -math.radians(200.0))
    spread = np.sqrt(np.einsum("ij,jk,ik->i", row.conj(), covariance, row).real)
    size = np.abs(row @ theta) + 2.0 * spread
    assert found.misfit == pytest.approx(float(np.max(size)), rel=5e-3)
    assert found.omega == pytest.approx(omega[int(np.argmax(size))])


def test_a_misfit_is_looked_at_up_to_where_a_lead_could_cross_over() -> None:
    """The phase with delay and half a sample of hold has fallen by 200°; integrators count apart."""
    G = Structure(1, 1, (0, 0))
    theta = np.array([0.4, 0.0, 0.0])
    found = validation._Explained(
        50.0, np.array([0.0, 0.0, 0.0, 1.0]), np.ones(1), 0.0, np.eye(9, 4), np.ones(4)
    )
    for delay in (6.0, 2.0):
        fit = Fit(G, ParameterEstimate(theta, np.eye(3), 1.0, True), delay, (delay, delay),
                  (delay, delay), np.zeros(3), True, AtRest(False, False, math.nan))  # fmt: skip
        size, at = validation._misfit(fit, found, np.array([1e9]), None, 100)
        omega = np.geomspace(2.0 * np.pi / 100, 0.6, 80)
        # The phase falls by the delay alone from the first frequency on, less 90°.
        fall = (omega - omega[0]) * (delay + 0.5)
        inside = fall + 0.5 * np.pi <= math.radians(200.0)
        assert at == pytest.approx(omega[inside][-1])
        assert size == pytest.approx(omega[inside][-1] / 1e9, rel=1e-6)
    assert not inside[-1] or delay == 2.0


def moved(u: np.ndarray, early: int) -> tuple[np.ndarray, np.ndarray]:
    """Return u and a y that is early."""
    y = through([1.0], [1.0, 0.5], u) + noise(0.01, u.size)
    return u[: u.size - early], y[early:]


@pytest.mark.trial
def test_a_y_that_is_early_by_two_samples_is_told() -> None:
    """By u of the same sample and of the next one, which explain a fifth or more of what is left."""
    assert validation.early_samples(fitted(*moved(binary(66), 2))) == 2


def test_u_of_the_same_sample_explains_a_share_of_the_error_or_none() -> None:
    """The share is χ²/(χ² + N); from 0.2 on y is early, with the sign of the plant only."""
    near = plain()
    same = near.u - near.u[0]
    for size in (0.004, 0.009):
        for sign in (1.0, -1.0):
            bent = near._replace(error=near.error + sign * size * same)
            statistic = explained(bent, same[:, None])[0]
            share = statistic / (statistic + N)
            assert abs(share - 0.2) > 0.02
            expected = int(share > 0.2 and sign > 0.0 and statistic > stats.chi2.isf(1e-3, 1))
            assert validation.early_samples(bent) == expected
    shares = [0.004, 0.009]
    assert shares[0] < shares[1]
    direct = near.fit._replace(structure=near.fit.structure._replace(direct=True))
    assert validation.early_samples(bent._replace(fit=direct)) == 0
    delayed = near.fit._replace(delay=1.0)
    assert validation.early_samples(bent._replace(fit=delayed)) == 0


@cases(("size", "expected"), [(0.0, False), (-3.0, True)])
def test_another_u_before_the_record_acts_during_the_delay(size: float, expected: bool) -> None:
    """χ² of the response to a pulse of that length, at one in a thousand."""
    near = plain(3.0)
    b, a = of(near)
    pulse = (np.arange(N) < 3) * 1.0
    extra = through(b, a, pulse)[:, None]
    bent = near._replace(error=near.error + 0.01 * size * extra[:, 0])
    statistic = explained(bent, extra)[0]
    assert validation.before_the_record(bent) == (statistic > stats.chi2.isf(1e-3, 1)) == expected
    assert not validation.before_the_record(bent._replace(fit=near.fit._replace(delay=0.0)))


def test_what_explains_an_error_has_coefficients_and_a_covariance() -> None:
    """Those of least squares of whitened columns; none without an error."""
    near = lacking()
    extra = np.column_stack([np.sin(0.3 * np.arange(N)), 1e3 * np.cos(0.5 * np.arange(N))])
    found = validation._explained_by(near, extra)
    assert found is not None
    statistic, theta, covariance = explained(near, extra)
    assert found.statistic == pytest.approx(statistic, rel=1e-3)
    np.testing.assert_allclose(found.coefficients, theta, rtol=1e-3)
    np.testing.assert_array_equal(found.extra, found.coefficients[-2:])
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(covariance), rtol=1e-3)
    assert validation._explained_by(near._replace(variance=0.0), extra) is None
    assert validation._explained_by(near, extra * np.nan) is None


def test_a_gain_that_depends_on_u_explains_a_share_of_the_error() -> None:
    """That of the responses to (u − mean)² and |u| in the power of the error."""
    u = binary()
    bend = through([1.0], [1.0, 0.5], (u - np.mean(u)) ** 2)
    near = fitted(u, through([1.0], [1.0, 0.5], u) + 0.02 * bend + noise(0.01))
    b, a = of(near)
    columns = [(u - np.mean(u)) ** 2, np.abs(u)]
    extra = np.column_stack([through(b, a, each - each[0]) for each in columns])
    psi = slopes(near)
    left = []
    for part in (psi, np.column_stack([psi, extra])):
        e = near.error - part @ np.linalg.lstsq(part, near.error, rcond=None)[0]
        left.append(float(e @ e))
    found = validation.curvature(near)
    assert found == pytest.approx(1.0 - left[1] / left[0], abs=2e-4)
    assert 0.05 < found < 0.9
    assert validation.curvature(plain()) == 0.0
    assert explained(near, extra)[0] > stats.chi2.isf(1e-3, 2)


def test_a_u_of_one_sign_has_no_second_gain() -> None:
    """Only the square is tried: the share is that of it alone."""
    u = binary() + 2.0
    near = fitted(u, through([1.0], [1.0, 0.5], u + 0.02 * (u - 2.0) ** 2) + noise(0.01))
    b, a = of(near)
    square = (u - np.mean(u)) ** 2
    extra = through(b, a, square - square[0])[:, None]
    psi, left = slopes(near), []
    for part in (psi, np.column_stack([psi, extra])):
        e = near.error - part @ np.linalg.lstsq(part, near.error, rcond=None)[0]
        left.append(float(e @ e))
    assert validation.curvature(near) == pytest.approx(1.0 - left[1] / left[0], abs=2e-4)


def test_a_response_starts_at_rest_in_each_record() -> None:
    """B/A, and one more pole with the next derivative."""
    near = plain()
    b, a = of(near)
    expected = through(b, a, near.u)
    ascending = a[:0:-1]
    np.testing.assert_allclose(
        validation._response(near.fit, ascending, near.u), expected, atol=1e-9
    )
    wider = np.polymul(a, [1.0, 0.7])[:0:-1]
    more = through(np.append(b, 0.0), np.polymul(a, [1.0, 0.7]), near.u)
    np.testing.assert_allclose(validation._response(near.fit, wider, near.u), more, atol=1e-9)
    two = near.fit._replace(
        structure=near.fit.structure._replace(degrees=(0, 0, 0), samples=(60, 80))
    )
    theta = np.insert(near.fit.estimate.theta, [2, 3], [0.0, 0.0])
    two = two._replace(estimate=two.estimate._replace(theta=theta))
    parts = [through(b, a, near.u[:60]), through(b, a, near.u[60:])]
    got = validation._response(two, ascending, near.u)
    np.testing.assert_allclose(got, np.concatenate(parts), atol=1e-9)


def test_a_start_is_fitted_to_a_fresh_record() -> None:
    """The n numbers of the state at its start by least squares, all else as it is."""
    near = plain()
    fresh = binary(60, 4)
    v = np.column_stack([fresh, np.ones(60)])
    y = through([1.0], [1.0, 0.5], fresh) + 2.0 * 0.8 ** np.arange(60)
    theta = near.fit.estimate.theta.copy()
    theta[-1] = 0.0
    rest = output(near.fit.structure, theta, v)
    free = chains(near.fit.structure.denominator(theta), np.zeros((60, 0)))[:, 0, 0]
    start = float(free @ (y - rest) / (free @ free))
    np.testing.assert_allclose(
        validation.simulate_fit(near.fit, v, y), rest + start * free, atol=1e-9
    )
    own = output(near.fit.structure, near.fit.estimate.theta, v)
    np.testing.assert_allclose(validation.simulate_fit(near.fit, v), own, atol=1e-12)
    with (
        patch.object(validation, "free_run", lambda *_, **__: (np.full(60, np.inf), v)),
        pytest.raises(ValueError, match="order: the fitted model is unstable; lower the order"),
    ):
        validation.simulate_fit(near.fit, v)


def test_correlations_with_u_have_a_limit_for_all_lags_together() -> None:
    """1 % for the largest of M + 1, with the variance Σ R_ε R_u; only past u counts."""
    e, u, lags = noise(1.0, 300), binary(300), 12
    found = validation.residuals(e, u, lags)
    e0, u0 = e - np.mean(e), u - np.mean(u)

    def correlation(a: np.ndarray, b: np.ndarray, lag: int) -> float:
        if lag < 0:
            return correlation(b, a, -lag)
        return float(a[lag:] @ b[: a.size - lag]) / a.size

    both = range(-lags, lags + 1)
    re, ru, cross = (
        np.array([correlation(*pair, lag) for lag in both])
        for pair in ((e0, e0), (u0, u0), (e0, u0))
    )
    scale = math.sqrt(re[lags] * ru[lags])
    np.testing.assert_allclose(found.cross_correlation, cross / scale, atol=1e-12)
    variance = float(np.sum(re * ru)) / scale**2
    limit = stats.norm.isf(0.005 / 13.0) * math.sqrt(variance / 300.0)
    assert found.cross_limit == pytest.approx(limit)
    assert found.lags == lags
    future = found._replace(cross_correlation=np.where(np.arange(25) < 12, 9.0, 0.0))
    assert future.independent
    at_limit = np.where(np.arange(25) == 12, found.cross_limit, 0.0)
    assert found._replace(cross_correlation=at_limit).independent
    assert not found._replace(cross_correlation=1.001 * at_limit).independent
    assert found._replace(whiteness=found.whiteness_limit).white
    assert not found._replace(whiteness=1.001 * found.whiteness_limit).white
    none = validation.residuals(np.zeros(50), np.zeros(50), 5)
    assert (none.rms, none.whiteness, none.cross_limit) == (0.0, 0.0, 0.0)
    assert none.white
    assert none.independent
