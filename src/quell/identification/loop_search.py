"""The search for a plant behind a lag and a delay, and averages over the fits of its forms.

Each form, with or without lag, delay and drifting load, is fitted from several starts: the
denominators of ``initial_estimate`` and that of a chain of integrators, a grid of delays or lags,
and of a few bandwidths of the predictor. Forms with a drifting load are left out if the output
error alone is white. Those with a load that forgets start at the ones whose load does not. In a
loop the plant may be unstable, so unstable denominators are among the starts.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from quell.identification.delays import delayed
from quell.identification.model import Structure, autocorrelation, linear_columns, nonzero_lengths
from quell.identification.running_loop import (
    Form,
    Inputs,
    LoopFit,
    fit,
    is_exact,
    is_unstable,
    placed,
    power,
    responses,
)
from quell.identification.starts import equation, filtered_estimates
from quell.types import Matrix, Vector

# ---- The search for a plant behind a lag and a delay ----

# Bandwidths of the predictor [1/sample], number of delays and lags, number of denominators, and the
# shares of a lag in the sum of lag and delay, of the starts. Chosen by hand, so that the trial of
# benchmarks/running_loop.py finds the same minimum as a start at the true plant.
_RATES, _GRID, _DENOMINATORS, _SHARES = (0.01, 0.05, 0.2), 6, 3, (0.2, 0.5, 0.8)
# Difference in AIC up to which a division of lag and delay is open, as in the mean of models; the
# difference in b, in its deviations, from which on it matters; the shares of the lag that count.
_OPEN, _SAME, _DIVISIONS = 20.0, 0.5, (0.2, 0.4, 0.6, 0.8)
# Rates at which loads forget, of the starts [1/sample].
_FORGETTING = (0.001, 0.01, 0.1)
# Poles of the filters that give unstable denominators [1/sample] and their number, and the number
# of these denominators that are tried.
_FILTERS, _UNSTABLE = (0.003, 0.5, 6), 2
# Lags of the test of whiteness, and its level: as in ``best_start``.
_LAGS, _LEVEL = 50, 1e-3


def fits(order: int, most: float, u: Inputs, y: Vector) -> list[LoopFit]:
    """Return the fits of all forms, for delays and lags of up to ``most`` samples at the start.

    u may begin before y; see ``running_loop``.
    """
    plant = Form(order, False, False, False, actuators=u.u.shape[1], couplings=couplings(order, u))
    a = _denominators(plant, most, u, y)
    found = _family(plant, [], [*a], most, u, y)
    best = min(found, key=lambda one: one.aic)
    if not (is_exact(best, y) or _white(best, y)):
        a = [best.phi[:order], *a]
        placed_ones = [placed(one, rate) for one, rate in product(a, _RATES)]
        drifting = _family(plant, found, placed_ones, most, u, y)
        found += drifting + [_forgetting(one, u, y) for one in drifting]
    return found + _divided(found, u, y)


def _divided(found: list[LoopFit], u: Inputs, y: Vector) -> list[LoopFit]:
    """Return fits with given shares of the lag in the sum of lag and delay, if data leave it open.

    How the sum is divided moves b. Where a lag alone or a delay alone fits nearly as well, neither
    its own deviation nor that of the fit of both, to first order, holds b's: the mean over shares
    that are spread evenly does.
    """
    form = min(found, key=lambda one: one.aic).form
    alike = [one for one in found if one.form[3:5] == form[3:5]]
    both = next(one for one in alike if one.form.lag and one.form.delay)
    ends = [one for one in alike if one.form.lag != one.form.delay]
    near = [gains(one) for one in (both, *ends) if one.aic <= both.aic + _OPEN]
    values = np.array([value for value, _ in near])
    deviations = np.sqrt(np.maximum([np.diag(covariance) for _, covariance in near], 0.0))
    if np.all(np.ptp(values, axis=0) <= _SAME * np.min(deviations, axis=0)):
        return []  # also if only the fit of both is near
    # A gain of u_l of one fit may have no stable predictor with the lag of another.
    of_lag = both.form.gains.stop - 1
    tried = []
    for one in (both, *ends):
        total = float(np.sum(one.phi[one.form.times]))
        phi = np.append(one.phi[: one.form.times.start], total)
        if both.form.drift and not one.form.lag:
            phi = np.insert(phi, of_lag, 0.0)
        tried.append(phi)
        if both.form.drift and one.form.lag:
            tried.append(np.where(np.arange(phi.size) == of_lag, 0.0, phi))

    def at(share: float) -> LoopFit:
        form = both.form._replace(share=share)
        return fit(form, min(tried, key=lambda phi: power(form, phi, u, y)), u, y)

    return [at(share) for share in _DIVISIONS]


def couplings(order: int, u: Inputs) -> tuple[tuple[int, int], ...]:
    """Return number and derivative of the y of other axes, those below the order."""
    return tuple(product(range(u.others.shape[1]), range(order)))


def _late(u: Inputs, y: Vector, delay: int) -> Matrix:
    """Return u later by some samples, y of the other axes, and a constant (N, all)."""
    late = [delayed(each, delay)[each.size - y.size :] for each in u.u.T]
    return np.column_stack([*late, u.others, np.ones(y.size)])


def _denominators(plant: Form, most: float, u: Inputs, y: Vector) -> list[Vector]:
    order = plant.order
    degrees = (0,) * plant.actuators + (order - 1,) * u.others.shape[1] + (0,)
    structure = Structure(order, 0, degrees)
    v = _late(u, y, round(0.25 * most))
    estimates = filtered_estimates(structure, v, y)[:_DENOMINATORS]
    found = [structure.denominator(theta) for theta in estimates if np.all(np.isfinite(theta))]
    return [np.zeros(order), *found, *_unstable(structure, most, u, y)]


def _unstable(structure: Structure, most: float, u: Inputs, y: Vector) -> list[Vector]:
    """Return the best unstable denominators by least squares on filtered signals.

    ``filtered_estimates`` mirrors unstable poles into the left half plane: in an open loop the
    noise is their reason. In a loop the plant may have them.
    """
    n, many = structure.order, u.u.shape[1]
    form = Form(n, False, True, False, actuators=many, couplings=couplings(n, u))
    found = []
    for rate in np.geomspace(*_FILTERS):
        prefilter: Vector = np.poly(np.full(n, -rate)).real[:0:-1].astype(np.float64)
        for delay in (0, round(0.25 * most)):
            v = _late(u, y, delay)
            target, regressors = equation(
                structure, prefilter, linear_columns(structure, prefilter, v), y
            )
            size = nonzero_lengths(regressors)
            theta = np.linalg.lstsq(regressors / size, target, rcond=1e-14)[0] / size
            phi = np.append(structure.denominator(theta), float(delay))
            if is_unstable(form, phi, y.size):
                found.append((power(form, phi, u, y), phi[:-1]))
    return [a for _, a in sorted(found, key=lambda one: one[0])[:_UNSTABLE]]


def _family(
    plant: Form, steady: list[LoopFit], starts: list[Vector], most: float, u: Inputs, y: Vector
) -> list[LoopFit]:
    """Return the fits with neither, one and both of lag and delay.

    They have a load that drifts if the fits without loads, ``steady``, are given; each form then
    starts at its own of these, too.
    """
    drift, order = bool(steady), plant.order

    def best(lag: bool, delay: bool, tried: list[Vector]) -> LoopFit:
        form = plant._replace(lag=lag, delay=delay, drift=drift)
        for one in steady:
            if one.form[1:3] == form[1:3]:
                gains = [placed(one.phi[:order], rate)[order:] for rate in _RATES]
                zero = np.zeros(int(lag))
                times = one.phi[one.form.times]
                tried = tried + [np.hstack([one.phi[:order], each, zero, times]) for each in gains]
        return fit(form, min(tried, key=lambda phi: power(form, phi, u, y)), u, y)

    times = np.geomspace(0.5, max(most, 1.0), _GRID)
    late = best(False, True, [np.append(phi, T) for phi in starts for T in (0.0, *times)])
    shared = late.phi[:-1]
    # A lag has a gain of its own where loads drift.
    behind = np.append(shared, np.zeros(int(drift)))
    slow = best(True, False, [np.append(behind, tau) for tau in (*times, max(late.phi[-1], 0.1))])
    plain = best(False, False, [shared, *starts])
    found = ((behind, late.phi[-1]), (slow.phi[:-1], slow.phi[-1]))
    parts = [(*one, share) for one in found for share in _SHARES]
    both = [np.append(phi, [share * T + 0.1, (1.0 - share) * T]) for phi, T, share in parts]
    return [plain, late, slow, best(True, True, both)]


def _forgetting(one: LoopFit, u: Inputs, y: Vector) -> LoopFit:
    """Return the fit of the same form with a load that forgets."""
    form, place = one.form._replace(forgets=True), one.form.gains.stop
    tried = [np.insert(one.phi, place, rate) for rate in _FORGETTING]
    return fit(form, min(tried, key=lambda phi: power(form, phi, u, y)), u, y)


def _white(found: LoopFit, y: Vector) -> bool:
    """Return whether the error passes the test of whiteness of ``residuals``."""
    from scipy.stats import chi2

    lags = min(_LAGS, y.size // 4)
    correlation = autocorrelation(found.error, lags)
    return float(y.size * np.sum(correlation[1:] ** 2)) <= float(chi2.isf(_LEVEL, lags))


# ---- Averages over the fits of several forms ----

# Least ratio of the power that u causes in y to that of noise, by frequency, that shows the plant.
_VISIBLE = 1.0
# Parts of the record over which spectra are averaged: chosen by hand.
_SEGMENTS = 16
# Share of the largest difference of AIC whose model still has a weight: exp(−20/2) = 5e-5.
_MOST_DIFFERENCE = 20.0


def _places(one: LoopFit) -> list[int]:
    """Return the places of a, b, τ and T in the covariance of a fit; −1 for what it has not.

    Of several b it is the first.
    """
    form = one.form
    first = form.times.start
    lag, delay = first if form.lag else -1, form.size - 1 if form.delay else -1
    return [*range(form.order), form.size, lag, delay]


def physical(one: LoopFit, unit: float, dt: float) -> tuple[Vector, Matrix]:
    """Return the units of a (ascending), b, τ, T, and their covariance with a descending."""
    n = one.form.order
    scale = np.concatenate([dt ** (np.arange(float(n)) - n), [unit, dt, dt]])
    places = _places(one)
    known = np.array([place >= 0 for place in places])
    covariance = one.covariance[np.ix_(places, places)] * np.outer(known, known)
    order = np.r_[np.arange(n)[::-1], n : n + 3]
    return scale, (covariance * np.outer(scale, scale))[np.ix_(order, order)]


def gain(one: LoopFit) -> tuple[float, float]:
    """Return b and its deviation, in units of a sample."""
    place = one.form.size
    return float(one.beta[0]), math.sqrt(max(float(one.covariance[place, place]), 0.0))


def gains(one: LoopFit) -> tuple[Vector, Matrix]:
    """Return all b (m,) and their covariance, in units of a sample."""
    places = one.form.gains_of_u
    return one.beta[: one.form.actuators], one.covariance[places, places]


def total_delay(one: LoopFit) -> tuple[float, float]:
    """Return τ + T and its deviation [samples]."""
    if one.form.share is not None:
        place = one.form.times.start
        return float(one.phi[place]), math.sqrt(max(float(one.covariance[place, place]), 0.0))
    places = [place for place in _places(one)[-2:] if place >= 0]
    variance = float(np.sum(one.covariance[np.ix_(places, places)]))
    total = one.form.lag_of(one.phi) + one.form.delay_of(one.phi)
    return total, math.sqrt(max(variance, 0.0))


def mixture(estimates: list[tuple[float, float]], weights: Vector) -> tuple[float, float]:
    """Return mean and deviation of the mixture of values with deviations."""
    values, spreads = np.array(estimates).T
    mean = float(weights @ values)
    return mean, math.sqrt(float(weights @ (spreads**2 + (values - mean) ** 2)))


def visible_up_to(best: LoopFit, u: Matrix, dt: float) -> float:
    """Return the frequency up to which u moves y by more than the noise does [rad/s].

    It compares the spectrum of u behind the plant with that of the error behind the noise's model,
    whose gains hold for an unstable plant, too.
    """
    from scipy.signal import welch

    length = min(max(64, u.shape[0] // _SEGMENTS), best.error.size)
    frequency, moving = welch(u @ best.beta[: best.form.actuators], nperseg=length)
    _, disturbing = welch(best.error, nperseg=length)
    omega = 2.0 * math.pi * frequency[1:]
    of_u, of_error = responses(best.form, best.phi, best.error.size, omega)
    with np.errstate(all="ignore"):
        moved = of_u**2 * moving[1:]
        seen = np.flatnonzero(moved > _VISIBLE * of_error**2 * disturbing[1:])
    return float(omega[seen[-1]]) / dt if seen.size else 0.0


def is_usable(one: LoopFit) -> bool:
    """Return whether a fit has a model."""
    return bool(np.isfinite(one.aic) and np.all(np.isfinite(one.covariance)))


def weighted(found: list[LoopFit]) -> tuple[LoopFit, list[LoopFit], Vector]:
    """Return the best fit, those that count beside it, and their weights in the mean."""
    # What there is besides b0 is that of a model with free times.
    best = min((one for one in found if one.form.share is None), key=lambda one: one.aic)
    near = [one for one in found if one.aic - best.aic <= _MOST_DIFFERENCE]
    scores = np.array([one.aic - 2.0 * one.form.of_times for one in near])
    weights = np.exp(-0.5 * (scores - np.min(scores)))
    return best, near, weights / np.sum(weights)
