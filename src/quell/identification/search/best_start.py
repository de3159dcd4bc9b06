"""The choice among many starts: each is refined before it is compared.

The output error has local minima: y ≈ 0 is one near every resonance. Least-squares models that are
not refined say little about the minimum they lead to. So every start is first refined by
instrumental variables (``initial_estimate``), which costs little and removes the bias that noise
causes, and the best ones by the output error itself (``output_error``). Starts are least-squares
models for several λ, models of high order that are reduced (``reduced``), and the result for a
smaller model with a pole, or a pole and an equal zero, added (``nested``): the larger model never
fits worse than it. If the first two starts lead to the same model and it leaves nearly nothing
unexplained, the rest is left out; the smaller models, if only white noise is left.

For records that start at rest, and for several records, the poles of the best model of each record
from any start are the starts.

A minimum is *confirmed* if a second start leads to it, or if its error is white: then no model can
be better by much.
"""

from __future__ import annotations

import math
from itertools import chain
from typing import NamedTuple

import numpy as np

from quell.identification.model.correlation import autocorrelation
from quell.identification.model.structure import Structure, output
from quell.identification.search.initial_estimate import filtered_estimates, refined
from quell.identification.search.nested import extended, smaller
from quell.identification.search.output_error import ParameterEstimate, descend
from quell.identification.search.reduced import reduced_models
from quell.types import Matrix, Vector

# Share of the output's power that may stay unexplained if the search is to end early: a fit of
# 99 %, so that no other model can fit better by more than 1 %.
_SMALL = 1e-4
# Relative difference of two mean square errors of the same minimum: chosen by hand.
_SAME = 1e-3
# Relative mean square that counts as zero: rounding in long simulations.
_ROUNDING = 1e-18
# Number of starts that are refined by output error; most steps of each, and of the best two.
# By hand, so that the trial of benchmarks/identification_trial.py passes with a margin.
_KEPT, _FINISHED, _FEW_STEPS, _STEPS = 5, 2, 12, 60
# Lags of the test of whiteness, and its level: a model is rarely searched for longer in vain.
_LAGS, _LEVEL = 50, 1e-3


class Start(NamedTuple):
    """The model of least output error among those that the starts led to."""

    estimate: ParameterEstimate  # without covariance
    confirmed: bool


def best_start(structure: Structure, v: Matrix, y: Vector) -> Start:
    """Return the model of least output error from many starts, for inputs ``v``, output ``y``."""
    if structure.at_rest or structure.samples:
        return _from_parts(structure, v, y)
    filtered = filtered_estimates(structure, v, y)
    found = [
        descend(structure, refined(structure, theta, v, y)[1], v, y, _STEPS)
        for theta in filtered[:2]
    ]
    if _agree(found, y) and _best(found).cost <= _SMALL * float(np.var(y)):
        return Start(_best(found), True)
    others = chain(filtered[2:], reduced_models(structure, v, y))
    starts = sorted((refined(structure, theta, v, y) for theta in others), key=lambda pair: pair[0])
    near = [descend(structure, theta, v, y, _FEW_STEPS) for _, theta in starts[:_KEPT]]
    near.sort(key=lambda one: one.cost)
    found += near[_FINISHED:]
    found += [descend(structure, one.theta, v, y, _STEPS) for one in near[:_FINISHED]]
    found += _from_smaller(structure, found, v, y)
    return Start(_best(found), _white(structure, _best(found), v, y) or _agree(found, y))


def _from_parts(structure: Structure, v: Matrix, y: Vector) -> Start:
    """Return the best model from the poles of each record's model from any start."""
    found, confirmed = [], []
    for place in structure.records(y.size):
        single, inputs = from_any_start(structure, v[place])
        start = best_start(single, inputs, y[place])
        a = single.denominator(start.estimate.theta)
        found.append(descend(structure, with_poles(structure, a), v, y, _STEPS))
        confirmed.append(start.confirmed)
    found += _from_smaller(structure, found, v, y)
    best = _best(found)
    white = _white(structure, best, v, y)
    return Start(best, white or any(confirmed) or (len(found) > 1 and _agree(found, y)))


def from_any_start(structure: Structure, v: Matrix) -> tuple[Structure, Matrix]:
    """Return the structure of one record that starts anywhere, and its inputs, from those at rest.

    Of several records with a constant force each, ``v`` are the inputs of one.
    """
    rubbing = len(structure.friction)
    has_force = structure.at_rest or len(structure.degrees) > 1 + rubbing
    first, last = v[:, :1], v[:, v.shape[1] - rubbing :]
    force = np.ones((v.shape[0], int(has_force)))
    of_friction = structure.degrees[len(structure.degrees) - rubbing :]
    degrees = (structure.degrees[0], *[0] * has_force, *of_friction)
    single = structure._replace(degrees=degrees, at_rest=False, samples=())
    return single, np.hstack([first, force, last])


def with_poles(structure: Structure, a: Vector) -> Vector:
    """Return θ of ``structure`` with the denominator ``a`` (n,); its linear parameters are zero."""
    theta = np.zeros(structure.size)
    theta[: structure.free] = a[structure.integrators :]
    return theta


def _from_smaller(
    structure: Structure, found: list[ParameterEstimate], v: Matrix, y: Vector
) -> list[ParameterEstimate]:
    """Return models from the smaller one; none if the best one leaves white noise."""
    lower = smaller(structure)
    if lower is None or _white(structure, _best(found), v, y):
        return []
    theta = best_start(lower, v, y).estimate.theta
    return [descend(structure, more, v, y, _STEPS) for more in extended(structure, lower, theta)]


def _best(found: list[ParameterEstimate]) -> ParameterEstimate:
    return min(found, key=lambda one: one.cost)


def _agree(found: list[ParameterEstimate], y: Vector) -> bool:
    """Return whether two starts led to the least output error."""
    first, second = sorted(one.cost for one in found)[:2]
    return second <= (1.0 + _SAME) * first + _ROUNDING * float(np.mean(y**2))


def _white(structure: Structure, estimate: ParameterEstimate, v: Matrix, y: Vector) -> bool:
    """Return whether the error of a model passes the test of whiteness of ``residuals``."""
    from scipy.stats import chi2

    if not math.isfinite(estimate.cost):
        return False
    with np.errstate(all="ignore"):
        error = y - output(structure, estimate.theta, v)
    lags = min(_LAGS, y.size // 4)
    correlation = autocorrelation(error, lags)
    return float(y.size * np.sum(correlation[1:] ** 2)) <= float(chi2.isf(_LEVEL, lags))
