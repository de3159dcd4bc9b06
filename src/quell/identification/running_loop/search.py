"""The search for a plant behind a lag and a delay: starts, and the forms of the model.

Each form, with or without lag, delay and drifting load, is fitted from several starts: the
denominators of ``initial_estimate`` and that of a chain of integrators, a grid of delays or lags,
and of a few bandwidths of the predictor. Forms with a drifting load are left out if the output
error alone is white. Those with a load that forgets start at the ones whose load does not. In a
loop the plant may be unstable, so unstable denominators are among the starts.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from quell.identification.model.correlation import autocorrelation
from quell.identification.model.structure import Structure, linear_columns, nonzero_lengths
from quell.identification.running_loop.average import gain
from quell.identification.running_loop.fit import LoopFit, fit, is_exact, power
from quell.identification.running_loop.model import Form, is_unstable, placed
from quell.identification.search.delay import delayed
from quell.identification.search.initial_estimate import equation, filtered_estimates
from quell.types import Vector

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


def fits(order: int, most: float, u: Vector, y: Vector) -> list[LoopFit]:
    """Return the fits of all forms, for delays and lags of up to ``most`` samples at the start.

    u may begin before y; see ``model``.
    """
    a = _denominators(order, most, u, y)
    found = _family(order, [], [*a], most, u, y)
    best = min(found, key=lambda one: one.aic)
    if not (is_exact(best, y) or _white(best, y)):
        a = [best.phi[:order], *a]
        placed_ones = [placed(one, rate) for one, rate in product(a, _RATES)]
        drifting = _family(order, found, placed_ones, most, u, y)
        found += drifting + [_forgetting(one, u, y) for one in drifting]
    return found + _divided(found, u, y)


def _divided(found: list[LoopFit], u: Vector, y: Vector) -> list[LoopFit]:
    """Return fits with given shares of the lag in the sum of lag and delay, if data leave it open.

    How the sum is divided moves b. Where a lag alone or a delay alone fits nearly as well, neither
    its own deviation nor that of the fit of both, to first order, holds b's: the mean over shares
    that are spread evenly does.
    """
    form = min(found, key=lambda one: one.aic).form
    alike = [one for one in found if one.form[3:5] == form[3:5]]
    both = next(one for one in alike if one.form.lag and one.form.delay)
    ends = [one for one in alike if one.form.lag != one.form.delay]
    near = [gain(one) for one in (both, *ends) if one.aic <= both.aic + _OPEN]
    values = [value for value, _ in near]
    if max(values) - min(values) <= _SAME * min(deviation for _, deviation in near):
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


def _denominators(order: int, most: float, u: Vector, y: Vector) -> list[Vector]:
    structure = Structure(order, 0, (0, 0))
    late = delayed(u, round(0.25 * most))[u.size - y.size :]
    v = np.column_stack([late, np.ones(y.size)])
    estimates = filtered_estimates(structure, v, y)[:_DENOMINATORS]
    found = [structure.denominator(theta) for theta in estimates if np.all(np.isfinite(theta))]
    return [np.zeros(order), *found, *_unstable(structure, most, u, y)]


def _unstable(structure: Structure, most: float, u: Vector, y: Vector) -> list[Vector]:
    """Return the best unstable denominators by least squares on filtered signals.

    ``filtered_estimates`` mirrors unstable poles into the left half plane: in an open loop the
    noise is their reason. In a loop the plant may have them.
    """
    form, n = Form(structure.order, False, True, False), structure.order
    found = []
    for rate in np.geomspace(*_FILTERS):
        prefilter: Vector = np.poly(np.full(n, -rate)).real[:0:-1].astype(np.float64)
        for delay in (0, round(0.25 * most)):
            late = delayed(u, delay)[u.size - y.size :]
            v = np.column_stack([late, np.ones(y.size)])
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
    order: int, steady: list[LoopFit], starts: list[Vector], most: float, u: Vector, y: Vector
) -> list[LoopFit]:
    """Return the fits with neither, one and both of lag and delay.

    They have a load that drifts if the fits without loads, ``steady``, are given; each form then
    starts at its own of these, too.
    """
    drift = bool(steady)

    def best(lag: bool, delay: bool, tried: list[Vector]) -> LoopFit:
        form = Form(order, lag, delay, drift)
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


def _forgetting(one: LoopFit, u: Vector, y: Vector) -> LoopFit:
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
