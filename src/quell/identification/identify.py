"""``identify``: checks of its arguments, the search, and the judged result."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any, Literal, NamedTuple

import numpy as np

from quell import checks
from quell.hints import explained
from quell.identification.delays import delayed
from quell.identification.frequency_starts import resonant_poles
from quell.identification.given_records import (
    IF_NEEDED,
    MOST_DELAY,
    ROUNDED,
    Records,
    delay_range,
    first_held_out,
    given_records,
    other_record,
    resolution_of,
)
from quell.identification.model import (
    Root,
    Structure,
    chains,
    free_run,
    gain_interval,
    nonzero_lengths,
    poles_of,
    zeros_of,
)
from quell.identification.output_error import ALL, Samples, likelihood_ratio
from quell.identification.result import Identified
from quell.identification.saturation import Standing, standing
from quell.identification.search import Fit, Known, Wanted, fit, without_fast_poles
from quell.identification.starts import instrumental_variables
from quell.identification.validation import (
    Linearised,
    before_the_record,
    curvature,
    early_samples,
    fit_predictor,
    nrmse,
    one_more_pole,
    prediction_fit,
    residuals,
    simulate_fit,
)
from quell.parallel import one_blas_thread, part_of
from quell.quantities import UNKNOWN, Signals
from quell.types import Matrix, Vector

_METHODS = (
    "output error, started by refined instrumental variables",
    "instrumental variables from the reference, started by output error",
)
# Number of lags in the tests of the error, fewer for short records: chosen by hand.
_LAGS = 50
ZEROS, LEAST_WITH_ZEROS = 2, 4
"""Zeros of a flexible axis that is measured where u acts, and least order in which they are."""
# How often first samples are left out: with u of before in them, the delay is not found at once.
_CUTS = 3
# Most rounds in which samples at a limit are bounded, and the change of y, as a share of its range,
# that ends them: chosen by hand.
_ROUNDS, _SETTLED = 20, 5e-5
# Weight of a sample at a limit where what is beyond it begins: by hand, so that it moves what other
# samples show by less than their noise.
_AT_LIMIT = 1e-5
# Parts of a search after which half of the work counts as done: those of a search for the delay.
_HALF = 30.0
# Least number of samples for each parameter: chosen by hand; real records have many more.
_SAMPLES_PER_PARAMETER = 10


@explained("quell.identify(u, y, dt=1e-3)")
def identify(
    u: Any,
    y: Any,
    dt: float,
    order: int = 4,
    zeros: int | None = None,
    *,
    integrators: int | None = None,
    delay: float | tuple[float, float] | Literal["if needed"] | None = "if needed",
    bias: bool = True,
    friction: bool = False,
    rest: bool | None = None,
    held_out: float | None = None,
    horizon: int = 10,
    reference: Any = None,
    validation: tuple[Any, Any] | None = None,
    signals: Signals = UNKNOWN,
    progress: Callable[[float], None] | None = None,
) -> Identified:
    """Fit a continuous transfer function to recorded input and output.

    The result is the model of least output error, ``min Σ (y − ŷ)²``, with ŷ simulated from u alone
    and exact at the samples for a u that is held between them. The search starts at ARX
    models in continuous time, found by least squares on filtered signals and freed of bias by
    refined instrumental variables, at reduced models of high order, and at smaller models; the best
    are refined by Levenberg and Marquardt's method (``quell.identification``: ``best_start``,
    ``initial_estimate``, ``reduced``, ``output_error`` and ``structure`` have equations and
    sources). ``converged`` is true if no step reduces the error further and the model is confirmed:
    a second start led to it, or its error is white.

    Parameters
    ----------
    u
        input of the plant (N,) [u-unit]; held between samples. Or a list of such arrays, one for
        each of several records: they have one model, each its own initial state and constant force.
    y
        measured output (N,) [y-unit], each at the time when its u began to act; or a list.
    dt
        sample time [s].
    order, zeros
        number of poles n, 1 to 8, and of zeros, at most n. With n zeros u also acts on y at once
        (direct feedthrough, as for an acceleration behind a force). Such a model describes and
        simulates the record, but is no plant for an observer or a simulated loop. By default there
        are none, or two, from order 4 on, where the model without them has ``shortcomings`` and the
        frequency response shows a resonance, as of a motor with its encoder before a flexible
        coupling, if they explain more than chance.
    integrators
        number of poles at s = 0. By default a pole is set there if it can't be distinguished from s
        = 0: if it is within three of its standard deviations, or slower than ten times the record;
        and two poles, if this holds for both at once.
    delay
        delay of u [s]; or the least and the largest, to find the best between them, with a part of
        a sample where the record shows it; or None, to find it from 0 to 20 samples, and beyond
        that as long as the longest one is the best. By default, ``"if needed"``, it is searched so
        where the model without it has ``shortcomings``, and taken if it explains more than chance.
    bias
        whether a constant force acts besides u, as an offset of u does.
    friction
        whether Coulomb friction acts. The sign of the model's own speed is then a second input,
        with a numerator of its own of degree n − 2. In order 1 y is the speed.
    rest
        whether the plant was at rest under the first u before the record began. By default this is
        assumed where u moves through its range ten times at most, as in the record of a step, the
        record alone does not tell the gain within ±10 %, and it is more likely than not
        (``quell.identification.starts``); never with friction;
        ``rest_probability`` and ``shortcomings`` of the result say how much the record supports it.
    held_out
        share of the record, its end, that is not used for the fit but for its validation; 0 to 0.9.
        By default 0.3, or none of several records, and none if u does not move there, as in the
        record of a step.
    horizon
        number of samples that predictions look ahead.
    reference
        external signal of a closed loop (N,), if it is known: the model is then fitted to the part
        of u and y that follows it (see Notes).
    validation
        u and y of another record with the same sample time, on which the model is judged, too; then
        the tests of the error are those of this record.
    signals
        names and units of u and y, as a run has them (``run.signals``): for the plot and the plant.
    progress
        called between parts of the search with a share of the work that is done. How much work
        there is is not known before: the share rises and stays below 1. An exception in it ends
        the search.

    Raises
    ------
    ValueError
        also for records that are too short for the number of parameters, or constant.

    Notes
    -----
    *Closed loop.* There u reacts to the noise in y. The output-error fit stays free of bias if the
    measurement error is white, as an encoder's rounding nearly is (Ljung 1999, th. 8.3 and sec.
    13.4), but not with forces on the plant or friction that is not in the model. With ``reference``
    the estimate uses only the external signal.

    Examples
    --------
    >>> import numpy as np
    >>> import quell as ql
    >>> t = np.arange(4000) * 0.01
    >>> u = np.sign(np.sin(0.2 * t**1.5))
    >>> y = np.zeros(t.size)
    >>> for k in range(t.size - 1):
    ...     y[k + 1] = np.exp(-0.02) * y[k] + 1.5 * (1.0 - np.exp(-0.02)) * u[k]
    >>> found = ql.identify(u, y, dt=0.01, order=1)
    >>> found.num.round(6).tolist(), found.den.round(6).tolist()
    ([3.0], [1.0, 2.0])
    """
    wants_delay, wants_zeros = delay == IF_NEEDED, zeros is None
    none = 0.0 if wants_delay else delay
    count = 0 if zeros is None else zeros
    options = Options(order, count, integrators, none, bias, friction, rest, held_out, horizon)
    records = given_records(u, y)
    given = reference, validation, signals
    found = identified(records, dt, options, *given, progress=part_of(progress, 0.0, 0.3, 1.0))
    wants_zeros = wants_zeros and order >= LEAST_WITH_ZEROS and not (friction or records.samples)
    good = not found.shortcomings
    # What is free of a limit may be at one side of u alone, where a form that is wrong looks bent.
    bends = found.bends and not found.at_limits
    if bends or (good and not (wants_zeros and not found.residuals.white)):
        return found
    # With a delay, and with zeros and poles that the frequency response shows, in turn.
    tried: list[tuple[Options, Known | None]] = []
    late = options._replace(delay=None) if wants_delay else options
    if wants_zeros:
        most = int(delay_range(late.delay, dt, records.u.size)[1])
        part = standing(records.y, resolution_of(records.y), records.u).longest_free
        with one_blas_thread():
            poles = resonant_poles(records.u[part], records.y[part], order, min(most, MOST_DELAY))
        if poles is not None:
            known = Known(poles, delay_range(late.delay, dt, records.u.size))
            tried.append((late._replace(zeros=ZEROS), known))
    if wants_delay and not good:
        tried.append((late, None))
    for i, (other, start) in enumerate(tried):
        share = part_of(progress, 0.3 + 0.7 * i / len(tried), 0.3 + 0.7 * (i + 1) / len(tried), 1.0)
        with contextlib.suppress(ValueError):  # too short a record for it
            model = identified(records, dt, other, *given, start, share)
            if (model.delay > 0.0 or other.zeros > count) and _explains_more(found, model):
                found = model
        if not found.shortcomings:
            break
    return found


def _explains_more(found: Identified, late: Identified) -> bool:
    """Return whether a model with a delay leaves less, beyond chance, and has no more faults."""
    ratio, count = ratio_of_models(found, late, ROUNDED**2)
    return ratio > 3.0 * math.log(count) and len(late.faults) <= len(found.faults)


def ratio_of_models(less: Identified, larger: Identified, exact: float) -> tuple[float, int]:
    """Return ``likelihood_ratio`` of two models of a record, and how many samples it is of.

    These are the samples of both fits; ``exact`` is the share of y's power that counts as no error.
    """
    both = less, larger
    first = max(one.left_out for one in both)
    last = min(one.left_out + one.held_from for one in both)
    errors = [(one.y - one.simulated)[first - one.left_out : last - one.left_out] for one in both]
    least = exact * float(np.sum((larger.y - np.mean(larger.y)) ** 2))
    return likelihood_ratio((errors[0], errors[1]), least), last - first


class Options(NamedTuple):
    """Arguments of ``identify``."""

    order: int
    zeros: int
    integrators: int | None
    delay: Any
    bias: bool
    friction: bool
    rest: bool | None
    held_out: float | None
    horizon: int


def identified(
    records: Records,
    dt: float,
    options: Options,
    reference: Any,
    validation: tuple[Any, Any] | None,
    signals: Signals,
    known: Known | None = None,
    progress: Callable[[float], None] | None = None,
) -> Identified:
    """Return the result of ``identify``; the search begins at a model that is ``known``, if any.

    Where u was another one before the record, the samples in which that acts are left out; those of
    a y that stands at a limit are bounded by it.
    """
    given = dt, options, reference, validation, signals, known, progress
    at_limits = None
    if not records.samples and reference is None:
        at_limits = standing(records.y, resolution_of(records.y), records.u)
    if at_limits is not None and at_limits.is_usable:
        return _from_first_free(records, at_limits, given)
    found = whole = _identified(records, *given)
    known_before = bool(options.rest) or bool(records.samples) or reference is not None
    if known_before or found.faults or not found.converged:
        return found
    first = 0
    for _ in range(_CUTS):
        if not found.before:
            break
        # What u was before the record is not in it, but what it was before a later sample is.
        first += math.ceil(found.delay_interval[1] / found.dt - ROUNDED)
        try:
            found = _identified(Records(records.u[first:], records.y[first:], ()), *given)
        except ValueError:  # too short, or u does not move there
            return whole
    return whole if found.before else replace(found, left_out=first)


def _from_first_free(records: Records, at_limits: Standing, given: tuple[Any, ...]) -> Identified:
    """Return the result from the first sample on that is at no limit.

    Those before it say nothing: what they would be follows from a start that they do not show. What
    u was before that sample acts after it for the time of the delay, which is left out, too.
    """
    first = int(np.argmax(at_limits.free))
    for _ in range(_CUTS):
        rest = Standing(at_limits.upper[first:], at_limits.lower[first:])
        part = Records(records.u[first:], records.y[first:], ())
        found = _bounded(part, rest, given) if rest.samples else _identified(part, *given)
        found = replace(found, left_out=first)
        if not (first and found.before) or found.faults:
            break
        first += math.ceil(found.delay_interval[1] / found.dt - ROUNDED)
    return found


def _bounded(records: Records, at_limits: Standing, given: tuple[Any, ...]) -> Identified:
    """Return the result where y stands at a limit, which is bounded there and not fitted."""
    y, found = _over_limits(records, at_limits, given), None
    for _ in range(_ROUNDS):
        # Where the model is inside a limit, y counts.
        found = _identified(records._replace(y=y), *given, fitted=y == records.y)
        before, y = y, at_limits.bounded(records.y, found.simulated)
        settled = float(np.max(np.abs(y - before))) <= _SETTLED * float(np.ptp(y))
        if settled or not found.converged:
            break
        # The search goes on from there, as each round is near the last one.
        given = (*given[:5], known_of(found), given[6])
    assert found is not None
    return replace(found, at_limits=at_limits.samples)


def _over_limits(records: Records, at_limits: Standing, given: tuple[Any, ...]) -> Vector:
    """Return y with a model beyond its limits, that of the longest part that is at none.

    From y as it is the search may lead to a model of the limits.
    """
    u, y, part, options = records.u, records.y, at_limits.longest_free, given[1]
    try:
        options = options._replace(held_out=0.0)
        model = _identified(Records(u[part], y[part], ()), given[0], options, *given[2:])
    except ValueError:  # too short
        return y
    late, known = delayed(u, model.delay / model.dt), known_of(model).a
    n = known.size
    b = model.num[::-1] * model.dt ** (n - np.arange(float(model.num.size)))
    direct = float(b[n]) if b.size > n else 0.0
    b = b[:n] - direct * known[: b[:n].size]
    bank = chains(known, np.column_stack([late, np.ones(u.size)]))
    # The force, and the start of the free motion, are what another part has of its own. A motion
    # that has died out before the first sample that is fitted is not known: it ends near the limit.
    of_u = bank[:, : b.size, 0] @ b + direct * late
    columns = np.column_stack([bank[:, 0, 1], bank[:, :, 2]])
    columns /= nonzero_lengths(columns)
    if not (np.all(np.isfinite(columns)) and np.all(np.isfinite(of_u))):
        return y
    weight = np.where(at_limits.free, 1.0, _AT_LIMIT)
    theta = np.linalg.lstsq(columns * weight[:, None], (y - of_u) * weight, rcond=1e-12)[0]
    return at_limits.bounded(y, of_u + columns @ theta)


def known_of(found: Identified) -> Known:
    """Return a model from which the search for another one of the same record begins."""
    powers = found.dt ** np.arange(found.den.size - 1.0, 0.0, -1.0)
    low, high = (round(end / found.dt) for end in found.delays_searched)
    return Known(found.den[:0:-1] * powers, (low, high))


def _identified(
    records: Records,
    dt: float,
    options: Options,
    reference: Any,
    validation: tuple[Any, Any] | None,
    signals: Signals,
    known: Known | None,
    progress: Callable[[float], None] | None,
    *,
    fitted: Samples = ALL,
) -> Identified:
    """Return the result for all samples; fit and tests are of those that are to be ``fitted``."""
    u, y = records.u, records.y
    order, zeros, integrators, delay, bias, friction, rest, held_out, horizon = options
    if reference is not None:
        reference = checks.vector("reference", reference, u.size)
        if np.ptp(reference) == 0.0:
            raise ValueError(
                f"reference is {reference[0]:g} all through: must move; without one leave it out"
            )
        if records.samples:
            raise ValueError("reference: goes with one record, not with several")
    dt = checks.positive("dt", dt, "s")
    order = checks.whole("order", order, 1, 8)
    zeros = checks.whole("zeros", zeros, 0, order)
    if zeros == order and reference is not None:
        raise ValueError(
            f"zeros = {zeros}: with reference must be less than order = {order}: instrumental "
            "variables do not find direct feedthrough"
        )
    if integrators is not None:
        integrators = checks.whole("integrators", integrators, 0, order)
    bias, friction = checks.flag("bias", bias), checks.flag("friction", friction)
    if rest is not None and checks.flag("rest", rest) and not bias:
        raise ValueError("rest = True: goes with bias = True: y at rest is not known")
    if rest and friction:
        raise ValueError(
            "rest = True: goes without friction, which may hold a plant anywhere at standstill"
        )
    horizon = checks.whole("horizon", horizon, 1)
    least_held = 3 * horizon * (order + 1)
    least = max(_SAMPLES_PER_PARAMETER * (3 * order + zeros + 2), least_held)
    shortest = min(records.samples or (u.size,))
    delays = delay_range(delay, dt, shortest)
    if delays[1] >= shortest:
        raise ValueError(
            f"delay = {delay!r} s: the longest delay to search (--max-delay) is longer than the "
            f"record, which has {shortest * dt:.4g} s; give a quarter of it at most"
        )
    least = max(least, 4 * math.ceil(delays[1]))
    held_from = first_held_out(records, order, held_out, least, least_held)
    other = None if validation is None else other_record(*validation, least_held)
    wanted = Wanted(
        order=order,
        zeros=zeros,
        integrators=integrators,
        delays=delays,
        grows=delay is None,
        bias=bias,
        friction=friction,
        rest=rest,
        resolution=resolution_of(y),
        known=known,
        report=_counted(progress),
        fitted=fitted if isinstance(fitted, slice) else fitted[:held_from],
    )
    # An unstable trial of the search may overflow; its cost is then infinite.
    with one_blas_thread(), np.errstate(all="ignore"):
        found_fit = fit(u[:held_from], y[:held_from], records.samples, wanted)
        if reference is not None:
            part = u[:held_from], y[:held_from]
            found_fit = _with_instruments(found_fit, *part, reference[:held_from])
        rounding = wanted.resolution
        how = horizon, other, rounding, fitted
        found = _validated(found_fit, u, y, reference, dt, held_from, *how)
        # A gain that falls with u looks like an integrator.
        if not friction and integrators is None and found.integrators and found.undecided:
            part = u[:held_from], y[:held_from]
            lag = wanted._replace(order=1, zeros=0, integrators=0, known=None)
            plain = fit(*part, records.samples, lag)
            found = replace(found, curvature=curvature(Linearised.of(plain, *part)))
    return replace(found, signals=Signals(signals.y, signals.u))


def _with_instruments(fitted: Fit, u: Vector, y: Vector, r: Vector) -> Fit:
    """Return the fit with the parameters by instrumental variables from the reference."""
    structure, theta = fitted.structure, fitted.estimate.theta
    v = free_run(structure, theta, fitted.inputs(u), own_friction=True)[1]
    return fitted._replace(estimate=instrumental_variables(structure, theta, v, y, r))


def _validated(
    fitted: Fit,
    u: Vector,
    y: Vector,
    r: Vector | None,
    dt: float,
    held_from: int,
    horizon: int,
    other: tuple[Vector, Vector] | None,
    resolution: float,
    counts: Samples,
) -> Identified:
    """Return the result in seconds, with fits and tests."""
    structure, v = fitted.structure, fitted.inputs(u)
    first, last = slice(0, held_from), slice(held_from, y.size)
    model = simulate_fit(fitted, v[first])
    error, tested_u, tested = y[first] - model, u[first], fitted.fitted
    weights = fit_predictor(error, horizon, structure.order + 1)
    fits = {
        "estimation": nrmse(y[first], model),
        "estimation, predicted": prediction_fit(y[first], error, horizon, weights),
    }
    if held_from < y.size:
        fresh = simulate_fit(fitted, v[last], y[last])
        model, error, tested_u = np.append(model, fresh), y[last] - fresh, u[last]
        tested = counts if isinstance(counts, slice) else counts[last]
        fits |= {
            "held out": nrmse(y[last], fresh),
            "held out, predicted": prediction_fit(y[last], error, horizon, weights),
        }
    if other is not None:
        tested_u = other[0]
        fresh = simulate_fit(fitted, fitted.inputs(tested_u), other[1])
        error, tested = other[1] - fresh, ALL
        fits |= {
            "validation": nrmse(other[1], fresh),
            "validation, predicted": prediction_fit(other[1], error, horizon, weights),
        }
    # What is bounded by a limit has no error.
    error, tested_u = error[tested], tested_u[tested]
    seconds = 1.0 / structure.powers(dt)
    theta = fitted.estimate.theta * seconds
    covariance = fitted.estimate.covariance * np.outer(seconds, seconds)
    a, numerators = structure.denominator(theta), structure.numerators(theta)
    free = structure.free
    b, covariance = _numerator(structure, theta, covariance)
    of_b = slice(free, free + b.size)
    gain = b[0] if b[0] != 0.0 else np.nan
    friction, friction_std = _friction(structure, theta, fitted.estimate.covariance, seconds, gain)
    near = Linearised.of(fitted, u[first], y[first])
    test = one_more_pole(near)
    q = structure.integrators
    low, high = gain_interval(a[q:], float(b[0]), covariance[: free + 1, : free + 1])
    poles = poles_of(a, covariance, q)
    shown = without_fast_poles(fitted, u[first], y[first])
    if shown is not fitted:
        own = float(b[0] / a[q])
        low, high = (end * dt**-q for end in shown.gain_interval())
        low, high = min(low, own), max(high, own)
        poles = _with_deviations(poles, shown, dt)
    return Identified(
        num=b[::-1].copy(),
        den=np.append(1.0, a[::-1]),
        covariance=covariance,
        poles=poles,
        zeros=zeros_of(b, covariance[of_b, of_b]),
        integrators=structure.integrators,
        delay=fitted.delay * dt,
        bias=float(numerators[1, 0] / gain) if fitted.bias else 0.0,
        friction=friction,
        friction_std=friction_std,
        gain_interval=(low, high),
        delay_interval=_delay_interval(fitted, dt),
        delay_covariance=_delay_covariance(fitted, seconds, dt),
        delays_searched=(fitted.searched[0] * dt, fitted.searched[1] * dt),
        rest=fitted.rest.assumed,
        rest_given=fitted.rest.given,
        rest_probability=fitted.rest.probability,
        samples=structure.samples,
        dt=dt,
        horizon=horizon,
        fits=fits,
        one_more_pole=test.statistic,
        one_more_pole_limit=test.limit,
        misfit=test.misfit,
        misfit_omega=test.omega / dt,
        early=early_samples(near),
        before=before_the_record(near),
        curvature=0.0 if structure.friction else curvature(near),
        residuals=residuals(error, tested_u, min(_LAGS, error.size // 4)),
        resolution=resolution,
        held_from=held_from,
        u=u,
        y=y,
        simulated=model,
        reference=r,
        converged=fitted.estimate.converged,
        method=_METHODS[r is not None],
    )


def _with_deviations(poles: tuple[Root, ...], shown: Fit, dt: float) -> tuple[Root, ...]:
    """Return the poles with the deviations of those of another model that are nearest to them.

    Poles that samples do not show keep their own.
    """
    structure, seconds = shown.structure, 1.0 / shown.structure.powers(dt)
    covariance = shown.estimate.covariance * np.outer(seconds, seconds)
    a = structure.denominator(shown.estimate.theta * seconds)
    known = poles_of(a, covariance, structure.integrators)
    return tuple(
        min(known, key=lambda one: abs(one.value - pole.value))._replace(value=pole.value)
        if pole.omega * dt <= math.pi
        else pole
        for pole in poles
    )


def _delay_covariance(fitted: Fit, seconds: Vector, dt: float) -> Vector:
    """Return the covariance of the delay with a and b, and its variance, in seconds."""
    found = fitted.delay_covariance
    return found * np.append(seconds[: found.size - 1], dt) * dt


def _delay_interval(fitted: Fit, dt: float) -> tuple[float, float]:
    """Return the 95 % interval of the delay [s]."""
    low, high = fitted.delays
    return max(low, 0.0) * dt, high * dt


def _friction(
    structure: Structure, theta: Vector, covariance: Matrix, seconds: Vector, gain: float
) -> tuple[float | None, float]:
    """Return Coulomb friction [u-unit], positive if it acts against motion, and its deviation.

    ``theta`` is in seconds, ``covariance`` in samples, ``seconds`` the factors between them. The
    force on y^(n) is F, so F/|b| acts like u whichever sign b has.
    """
    if not structure.friction:
        return None, math.nan
    slope, places = np.zeros(theta.size), structure.places
    rubbing = places[len(places) - len(structure.friction) :]
    force = float(np.sum(theta[rubbing]))
    slope[rubbing] = 1.0 / abs(gain)
    slope[places[0]] = -force / (gain * abs(gain))
    slope *= seconds
    return force / abs(gain), math.sqrt(max(float(slope @ covariance @ slope), 0.0))


def _numerator(structure: Structure, theta: Vector, covariance: Matrix) -> tuple[Vector, Matrix]:
    """Return b in ascending powers, and the covariance of a and b."""
    free, a = structure.free, structure.denominator(theta)
    count = structure.degrees[0] + 1
    b, size = structure.numerators(theta)[0, :count], free + count
    if not structure.direct:
        return b, covariance[:size, :size]
    # B + D_u A, with the derivatives by a, B and D_u
    at, direct = structure.common - 1, structure.feedthrough(theta)
    slope = np.zeros((size + 1, structure.size))
    slope[:size, :size] = np.eye(size)
    slope[free + structure.integrators : size, :free] = direct * np.eye(free)
    slope[free:size, at], slope[size, at] = a, 1.0
    return np.append(b + direct * a, direct), slope @ covariance @ slope.T


def _counted(progress: Callable[[float], None] | None) -> Callable[[], None]:
    """Return a function that calls ``progress`` with a share that rises at each call."""
    numbers = count()

    def report() -> None:
        if progress is not None:
            done = next(numbers)
            progress(done / (done + _HALF))

    return report
