"""The search for a model: start, refinement, signs of friction, delay of u, and poles at s = 0."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from quell.identification.delays import (
    ROUNDING,
    from_poles,
    longest,
    nearest_delay,
    start_with_delay,
    with_delay,
    with_part_of_sample,
)
from quell.identification.friction_search import (
    add_driven_friction,
    least_simulated,
    measured_sign,
    simulated_delay,
)
from quell.identification.model import (
    WITHIN_95,
    Structure,
    gain_interval,
    nonzero_lengths,
    output,
    output_gradient,
    squared_distance_from_zero,
)
from quell.identification.output_error import (
    ALL,
    ParameterEstimate,
    Samples,
    covariance,
    covariance_of,
    descend,
    likelihood_ratio,
    noise_model,
    refine,
)
from quell.identification.starts import (
    SURE,
    AtRest,
    Start,
    best_start,
    from_rest,
    general,
    probability,
    smaller,
    structure_at_rest,
    with_poles,
)
from quell.types import Matrix, Vector

# Steps of the refinement on the way, and most of them at the end: chosen by hand, not tuned.
_FEW_STEPS, _STEPS = 2, 60
# Most rounds of the delay with friction: chosen by hand.
_ROUNDS = 4
# A pole is set to s = 0 within three standard deviations of it (99.7 %), or if its time constant is
# more than ten times the record (chosen by hand). For two poles, χ² with two degrees of freedom
# exceeds 11.8 as rarely.
_DEVIATIONS = 3.0
_PAIR = 11.8
_SLOWER = 10.0
# These tests are of first order, which fails for poles that are nearly equal. So one and two
# integrators may increase the mean square error by these factors at most, and take this share of
# the fit; or increase it to this share of the output's mean square. With friction the signs that
# are not settled decide the fit, and only the factors hold. Chosen by hand.
_MOST_COST, _FIT_SHARE = {1: 30.0, 2: 1.05}, 0.005
# A gain whose interval is within ±2 % needs no assumption on the start, one within ±10 % only
# if it is sure: chosen by hand. A start at rest is likely from this probability on.
_CERTAIN, _USEFUL, _LIKELY = 0.02, 0.1, 0.5
# With more movements of u through its range than these the start matters little: chosen by hand.
_MOST_SWINGS = 10.0
# Probability with which a start at rest is refused by chance.
_SELDOM = 1e-3
# Delays on each side of the best that are looked at, steps of the refinement at each, and χ² of one
# degree of freedom at 95 %.
_MOST_DELAYS, _DELAY_STEPS, _WITHIN_95 = 10, 12, 3.84
# Variance of a delay whose nearest whole number of samples is known.
_WHOLE = 1.0 / 12.0
# Step of the derivative by the delay [samples].
_STEP_OF_DELAY = 0.05


class Fit(NamedTuple):
    """A model fitted to the samples for the fit."""

    structure: Structure
    estimate: ParameterEstimate
    delay: float  # delay of u [samples]
    delays: tuple[float, float]  # its 95 % interval, if it was searched [samples]
    searched: tuple[float, float]  # range of delays in which it was searched [samples]
    delay_covariance: Vector  # of the delay with a and b, and its variance
    bias: bool
    rest: AtRest
    fitted: Samples = ALL  # those in which y stands at no limit

    def inputs(self, u: Vector) -> Matrix:
        """Return the inputs (N, inputs) for ``u``; ``free_run`` fills in friction inputs.

        Another number of samples than that of the fit is one record, with the first one's force.
        """
        structure = self.structure
        if structure.samples and sum(structure.samples) != u.size:
            structure = structure.single()
        return _inputs(structure, u, self.delay, self.bias)

    def gain_interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the gain [y-unit/u-unit/sample^q]."""
        free, theta = self.structure.free, self.estimate.theta
        part = self.estimate.covariance[: free + 1, : free + 1]
        return gain_interval(theta[:free], float(theta[free]), part)


def _inputs(structure: Structure, u: Vector, delay: float, bias: bool) -> Matrix:
    """Return the inputs (N, inputs) for ``u``: late, constant forces, and zeros for friction."""
    v = np.zeros((u.size, len(structure.degrees)))
    v[:, 0] = with_delay(structure, v, u, delay)[:, 0]
    if bias:
        for i, place in enumerate(structure.records(u.size)):
            v[place, 1 + i] = 1.0
    return v


class Known(NamedTuple):
    """A model from which a search begins."""

    a: Vector  # coefficients of its denominator (n,), per sample
    searched: tuple[float, float]  # range of delays in which it was searched [samples]


class Wanted(NamedTuple):
    """The structure that is wanted of a model, and where its search begins."""

    order: int
    zeros: int
    integrators: int | None  # None: as many as the record shows
    delays: tuple[float, float]  # [samples]; a range is of whole ones
    grows: bool  # whether the range of delays is extended
    bias: bool
    friction: bool
    rest: bool | None  # None: if the record needs it, and does not contradict
    resolution: float  # step that y is rounded to, 0.0 if it is not rounded
    known: Known | None  # a larger model, from which the search begins
    report: Callable[[], None]  # called between parts of the search; may end it by an exception
    fitted: Samples = ALL  # those in which y stands at no limit


def fit(u: Vector, y: Vector, samples: tuple[int, ...], wanted: Wanted) -> Fit:
    """Return the model of least output error; ``samples`` are those of each record, if several."""
    forces = max(len(samples), 1) if wanted.bias else 0
    direct = wanted.zeros == wanted.order
    rubbing = [max(wanted.order - 2, 0)] if wanted.friction else []
    degrees = (wanted.zeros - direct, *[0] * forces, *rubbing)
    signs = (0.0,) if wanted.friction else ()
    q = wanted.integrators or 0
    structure = Structure(wanted.order, q, degrees, signs, direct, samples=samples)
    if wanted.rest and wanted.bias:
        return _fit_at_rest(structure, u, y, wanted)
    found = _fitted(structure, u, y, wanted, wanted.known)
    excluded = wanted.rest is False or not wanted.bias or wanted.friction
    if excluded or _swings(structure, u) > _MOST_SWINGS or _relative_width(found) <= _CERTAIN:
        return found
    # Without need, only what is certain is assumed.
    needed = _relative_width(found) > _USEFUL
    least = _LIKELY if needed else SURE
    # Where the model from any start is far off, its poles may lead nowhere.
    for from_any in (found, None)[: 1 + needed]:
        at_rest = _fit_at_rest(structure, u, y, wanted, from_any)
        if at_rest.rest.probability >= least and not _contradicts(found, at_rest, u, y):
            return at_rest
    return found


def _swings(structure: Structure, u: Vector) -> float:
    """Return how often u moves through its whole range, the most of all records."""
    parts = [u[place] for place in structure.records(u.size)]
    return max(float(np.sum(np.abs(np.diff(part))) / (np.ptp(part) or 1.0)) for part in parts)


def _contradicts(found: Fit, at_rest: Fit, u: Vector, y: Vector) -> bool:
    """Return whether the model at rest fits worse than chance explains, by the likelihood ratio."""
    from scipy.stats import chi2

    at_rest_error, error = (
        y - output(one.structure, one.estimate.theta, one.inputs(u)) for one in (at_rest, found)
    )
    ratio = likelihood_ratio((at_rest_error, error), ROUNDING * float(y @ y))
    return bool(not ratio <= chi2.isf(_SELDOM, found.structure.order))


def _fit_at_rest(
    structure: Structure, u: Vector, y: Vector, wanted: Wanted, from_any: Fit | None = None
) -> Fit:
    """Return the model of a start at rest, in the general form.

    The search begins at the poles of ``from_any``, a model from any start, if there is one.
    """
    known = wanted.known
    if from_any is not None:
        a = from_any.structure.denominator(from_any.estimate.theta)
        known = Known(a, from_any.searched)
    resting = structure_at_rest(structure)
    found = _fitted(resting, from_rest(structure, u), y, wanted, known)
    v = found.inputs(from_rest(structure, u))
    chance = probability(found.structure, found.estimate, v, y, wanted.resolution)
    free, estimate = general(found.structure, found.estimate, u)
    rest = AtRest(True, bool(wanted.rest), chance)
    return found._replace(structure=free, estimate=estimate, bias=True, rest=rest)


def _relative_width(found: Fit) -> float:
    """Return half the width of the gain's 95 % interval, relative to its middle."""
    low, high = found.gain_interval()
    return abs((high - low) / (high + low)) if np.isfinite(high - low) and high + low else np.inf


def _fitted(structure: Structure, u: Vector, y: Vector, wanted: Wanted, known: Known | None) -> Fit:
    """Return the model of one structure; at rest, ``u`` is without its first value."""
    friction, delays, bias = wanted.friction, wanted.delays, wanted.bias and not structure.at_rest
    v = _inputs(structure, u, delays[0], bias)
    if friction:
        v[:, -1] = measured_sign(structure, y)
    if known is None:
        searched, delay, start = start_with_delay(
            structure, u, v, y, delays, wanted.grows, wanted.report
        )
    else:
        searched, delay, start = _from_known(structure, known, u, v, y, wanted)
    if not np.isfinite(start.estimate.cost):
        none = "no model was found whose output is finite; lower the order, or scale u and y"
        raise ValueError(f"order = {wanted.order}, zeros = {wanted.zeros}: {none}")
    wanted.report()
    whole = with_delay(structure, v, u, delay)
    estimate = descend(structure, start.estimate.theta, whole, y, _STEPS)
    if searched[0] < searched[1] and not structure.direct:
        wanted.report()
        delay, estimate = with_part_of_sample(structure, estimate, u, v, y, delay, searched)
    v = with_delay(structure, v, u, delay)
    estimate = refine(structure, estimate.theta, v, y, _STEPS)
    if wanted.integrators is None:
        structure, estimate = _set_integrators(structure, estimate, v, y)
    if friction and wanted.order > 3:
        structure, estimate, v = add_driven_friction(structure, estimate, v, y)
        if wanted.integrators is None:
            structure, estimate = _set_integrators(structure, estimate, v, y)
    if friction:
        estimate, v = least_simulated(structure, estimate, v, y)
    else:
        estimate = refine(structure, estimate.theta, v, y, _STEPS)
    if friction and searched[0] < searched[1]:
        # With wrong signs of the speed another delay may have been the best.
        for _ in range(_ROUNDS):
            again = simulated_delay(structure, estimate.theta, u, v, y, searched, delay)
            if again == delay:
                break
            inputs = with_delay(structure, v, u, again)
            moved, inputs = least_simulated(structure, estimate, inputs, y)
            if moved.cost >= estimate.cost:
                break
            delay, estimate, v = again, moved, inputs
    if wanted.fitted is not ALL:
        estimate = descend(structure, estimate.theta, v, y, _STEPS, wanted.fitted)
        delay, estimate = nearest_delay(
            structure, estimate, u, v, y, searched, delay, fitted=wanted.fitted
        )
        v = with_delay(structure, v, u, delay)
        estimate = descend(structure, estimate.theta, v, y, _STEPS, wanted.fitted)
    estimate = estimate._replace(converged=estimate.converged and start.confirmed)
    estimate, certain, of_delay = _over_delays(
        structure, estimate, u, v, y, delay, searched, wanted.fitted
    )
    rest = AtRest(False, False, np.nan)
    return Fit(structure, estimate, delay, certain, searched, of_delay, bias, rest, wanted.fitted)


def _from_known(
    structure: Structure, known: Known, u: Vector, v: Matrix, y: Vector, wanted: Wanted
) -> tuple[tuple[float, float], float, Start]:
    """Return the range of delays, the best delay and the model at it, from a known model.

    Its poles, or those without each one of them, are the starts at all delays of its range; at the
    best delay all starts are tried.
    """
    searched = known.searched
    if not wanted.grows:
        searched = wanted.delays
    poles = [known.a] if known.a.size == structure.order else _without_one(known.a)
    delay, estimate = from_poles(structure, poles, u, v, y, searched, wanted.report)
    if wanted.grows and delay == searched[1] < longest(structure, y, True):
        return start_with_delay(structure, u, v, y, searched, True, wanted.report)
    if known.a.size == structure.order:
        return searched, delay, Start(estimate, math.isfinite(estimate.cost))
    start = best_start(structure, with_delay(structure, v, u, delay), y)
    again = nearest_delay(structure, start.estimate, u, v, y, searched, delay)
    delay, estimate = min((delay, estimate), again, key=lambda one: one[1].cost)
    return searched, delay, start._replace(estimate=estimate)


def _without_one(a: Vector) -> list[Vector]:
    """Return the coefficients without each real pole, or with a real one in place of each pair."""
    poles = np.roots(np.append(1.0, a[::-1]))
    found = []
    for i, pole in enumerate(poles):
        if pole.imag > 0.0:
            pair = (poles == pole) | (poles == pole.conjugate())
            rest = np.append(poles[~pair], -abs(pole))
        elif pole.imag == 0.0:
            rest = np.delete(poles, i)
        else:
            continue
        found.append(np.asarray(np.poly(rest).real[:0:-1], dtype=np.float64))
    return found


def _over_delays(
    structure: Structure,
    estimate: ParameterEstimate,
    u: Vector,
    v: Matrix,
    y: Vector,
    delay: float,
    searched: tuple[float, float],
    fitted: Samples = ALL,
) -> tuple[ParameterEstimate, tuple[float, float], Vector]:
    """Return the estimate with a covariance that has the delays in it, and their 95 % range.

    The last value is the covariance of the delay with a and b, and its variance, with 1/12 for a
    delay that is no whole number; both are zero if the delay was given. With the errors whitened
    by one model of the noise, ``ΔL = N log(Σ e²/Σ e_0²)`` is χ² with one degree of freedom; the
    models have the weights ``exp(−ΔL/2)`` of a mixture.
    """
    from scipy.signal import lfilter

    size = structure.free + structure.degrees[0] + 1
    if fitted is not ALL:
        of_fitted = covariance(structure, estimate.theta, v, y, fitted)
        estimate = estimate._replace(covariance=of_fitted)
    if searched[0] == searched[1]:
        return estimate, (delay, delay), np.zeros(size + 1)
    if not float(delay).is_integer():
        return _with_part(structure, estimate, u, v, y, delay, size, fitted)
    error = (y - output(structure, estimate.theta, v))[fitted]
    c, power = noise_model(error)
    least = max(power, ROUNDING * float(np.mean(y**2))) * error.size
    low = high = delay
    found = [(1.0, 0.0, estimate)]
    for step in (-1, 1):
        near, other = estimate, delay + step
        for _ in range(_MOST_DELAYS):
            if not searched[0] <= other <= searched[1]:
                break
            inputs = with_delay(structure, v, u, other)
            near = descend(structure, near.theta, inputs, y, _DELAY_STEPS)
            if not np.isfinite(near.cost):
                break
            white = lfilter(c, [1.0], (y - output(structure, near.theta, inputs))[fitted])
            change = error.size * float(np.log(max(white @ white, least) / least))
            if change > _WITHIN_95:
                break
            low, high = min(low, other), max(high, other)
            near = near._replace(covariance=covariance(structure, near.theta, inputs, y, fitted))
            found.append((float(np.exp(-0.5 * max(change, 0.0))), other - delay, near))
            other += step
    total = sum(weight for weight, _, _ in found)
    cov, of_delay = np.zeros_like(estimate.covariance), np.zeros(size + 1)
    of_delay[-1] = _WHOLE
    for weight, late, one in found:
        moved = one.theta - estimate.theta
        cov += weight / total * (one.covariance + np.outer(moved, moved))
        of_delay += weight / total * late * np.append(moved[:size], late)
    return estimate._replace(covariance=cov), (low - 0.5, high + 0.5), of_delay


def _with_part(
    structure: Structure,
    estimate: ParameterEstimate,
    u: Vector,
    v: Matrix,
    y: Vector,
    delay: float,
    size: int,
    fitted: Samples = ALL,
) -> tuple[ParameterEstimate, tuple[float, float], Vector]:
    """Return what ``_over_delays`` does, for a delay with a part of a sample.

    The delay is a parameter like any other; its derivative is a difference.
    """
    low, high = max(delay - _STEP_OF_DELAY, 0.0), delay + _STEP_OF_DELAY
    ends = [
        output(structure, estimate.theta, with_delay(structure, v, u, end)) for end in (low, high)
    ]
    predicted, psi = output_gradient(structure, estimate.theta, v)
    columns = np.column_stack([psi, (ends[1] - ends[0]) / (high - low)])[fitted]
    length, error = nonzero_lengths(columns), (y - predicted)[fitted]
    cov = covariance_of(structure, columns / length, error) / np.outer(length, length)
    half = WITHIN_95 * math.sqrt(max(float(cov[-1, -1]), 0.0))
    of_delay = np.append(cov[-1, :size], cov[-1, -1])
    found = estimate._replace(covariance=cov[:-1, :-1])
    return found, (delay - half, delay + half), of_delay


# Steps of a refinement without fast poles, and how much larger its error may be: by hand.
_WITHOUT_FAST, _HARDLY = 12, 1.01


def without_fast_poles(found: Fit, u: Vector, y: Vector) -> Fit:
    """Return a model without the poles that samples do not show, or the model itself.

    Such a pole and the numerator are uncertain by the same factor, up to rounding, so what is
    certain, as the gain, is to be taken from the model without it. It is the model itself with
    friction or direct feedthrough, and where the error would be larger.
    """
    structure, a = found.structure, found.structure.denominator(found.estimate.theta)
    poles = np.roots(np.append(1.0, a[::-1]))
    slow = poles[np.abs(poles) <= math.pi]
    lower: Structure | None = structure
    for _ in range(poles.size - slow.size):
        lower = None if lower is None else smaller(lower)
    if lower is None or lower is structure or structure.friction or structure.direct:
        return found
    v = found.inputs(u)
    start = with_poles(lower, np.asarray(np.poly(slow).real[:0:-1], dtype=np.float64))
    near = refine(lower, start, v, y, _WITHOUT_FAST)
    if not near.cost <= _HARDLY * found.estimate.cost + ROUNDING * float(np.mean(y**2)):
        return found
    over = _over_delays(lower, near, u, v, y, found.delay, found.searched, found.fitted)
    return found._replace(structure=lower, estimate=over[0], delays=over[1])


def _set_integrators(
    structure: Structure, estimate: ParameterEstimate, v: Matrix, y: Vector
) -> tuple[Structure, ParameterEstimate]:
    """Set one or two poles to s = 0 if they can't be distinguished from it; return the model."""
    if structure.integrators:
        return structure, estimate
    a, free, covariance = structure.denominator(estimate.theta), structure.free, estimate.covariance
    # An integrator and a zero that can't be distinguished from s = 0 would cancel.
    zero_std = np.sqrt(covariance[free, free])
    if structure.degrees[0] and abs(estimate.theta[free]) < _DEVIATIONS * zero_std:
        return structure, estimate
    poles = np.roots(np.append(1.0, a[::-1]))
    slow = poles[np.argsort(np.abs(poles))][:2].astype(complex)
    for count, limit in ((2, _PAIR), (1, _DEVIATIONS**2)):
        if count > slow.size or (count == 1 and abs(slow[0].imag) > 0.0):
            continue
        slower_than_record = abs(slow[count - 1]) * _SLOWER * y.size < 1.0
        part = covariance[: a.size, : a.size]
        if slower_than_record or squared_distance_from_zero(a, part, slow[:count]) < limit:
            fewer = structure._replace(integrators=count)
            steps = _FEW_STEPS if structure.friction else _STEPS
            without = refine(fewer, estimate.theta[count:], v, y, steps)
            if without.cost <= _most_cost(structure, count, estimate.cost, y):
                return fewer, without
    return structure, estimate


def _most_cost(structure: Structure, count: int, cost: float, y: Vector) -> float:
    """Return the mean square error that a model with ``count`` integrators may have."""
    most = _MOST_COST[count] * cost
    if not structure.friction:
        error, spread = float(np.sqrt(cost)), float(np.std(y))
        most = min(most, (error + _FIT_SHARE * max(spread - error, 0.0)) ** 2)
    return max(most, ROUNDING * float(np.mean(y**2)))
