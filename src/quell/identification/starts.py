"""Starts of the search: at rest, least squares, reduced models, closed loops.

The start at rest: whether a record shows it, and its model in the general form.

In a record of one step soon after the start, gain, constant force and initial state are not told
apart: after the step only 1 and the free motions e^(p_i t) are there, n + 1 shapes for n + 2
numbers. A plant that was at rest at u_0 before the record (``structure``) has n unknowns less. This
start is a hypothesis, which the record may contradict, support, or not show.

At rest the derivatives ``w = (y', …, y^(n))`` at the start are zero. If it was not at rest, they
may have any size that they have later in the record, s_i (the largest of the model's response).
The ratio of the evidence of ``w = 0`` and of ``w_i`` normal with deviation s_i is, for the error e
of the model at rest, noise of variance σ², and the responses G to w without what the parameters at
rest explain as well::

    K = √det(I + S Gᵀ G S/σ²) · exp(−½ eᵀ G (σ² S⁻² + Gᵀ G)⁻¹ Gᵀ e/σ²),     S = diag(s)

(Bayes factor of two nested linear Gaussian models; MacKay, *Information Theory, Inference, and
Learning Algorithms*, 2003, eqs. (28.6)–(28.10).) A direction of w that the record does not show has
a factor of one. Three of four records whose u is steady at first are taken to begin at rest, so the
probability of rest is ``3 K/(1 + 3 K)``.

The choice among many starts: each is refined before it is compared.

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

Start of the search: least squares on filtered signals, then refined instrumental variables.

Dividing ``A y = B u + …`` by any stable polynomial Λ of degree n gives an equation that is linear
in θ, with signals that can be computed from samples::

    p^n/Λ y = −Σ a_i p^i/Λ y + Σ b_i p^i/Λ u + … + Σ d_i p^i/Λ δ

This is an ARX model in continuous time (Young, *Automatica* 17, 1981; Garnier & Wang,
*Identification of Continuous-time Models from Sampled Data*, 2008, ch. 1). With ``Λ = (p + λ)^n``
it is solved by least squares; noise biases the poles. The *refined* method (SRIVC; Young & Jakeman,
*Int. J. Control* 31, 1980) takes the A of the last model for Λ, and its noise-free output ŷ in
place of y in the instruments. The instruments are then the gradient of ŷ, and after convergence
noise does not bias θ. Several λ are tried, so that nothing has to be known of the plant's speed.

This does not find a model with more poles than the plant: 1/Λ^n leaves little of u, and any poles
fit the rest. So the model with one pole less, and a fast pole added, is tried too.

Smaller models inside a larger one, as starts of its search.

A model with one pole and one zero less is contained in the larger one, ``B/A = B (p + λ)/(A (p +
λ))`` for any λ. Without a zero to remove it is the limit of ``λ B/(A (p + λ))`` for a fast pole λ.

Starts from models of high order in discrete time, reduced to the order that is wanted.

An ARX model ``y[k] = −Σ α_i y[k−i] + Σ β_i u[k−i] + ε[k]`` with many terms is linear in its
parameters and describes plant and noise of any kind (Wahlberg, *IEEE Trans. Automatic Control* 34,
1989). Its impulse response g from u has little noise left, and the first singular vectors of the
Hankel matrices ``H₀ = [g_{i+j+1}]`` and ``H₁ = [g_{i+j+2}]`` give the n poles that matter (Juang &
Pappa, *J. Guidance, Control, and Dynamics* 8, 1985)::

    H₀ ≈ U S Vᵀ,      z = eig(S^{−1/2} Uᵀ H₁ V S^{−1/2}),      p = ln z

No start in continuous time is needed, and no pole has to be near another one. A slow plant is
sampled too fast for this, so the samples are also averaged over 4, 16, … of them.

Instrumental variables from an external signal in a closed loop.

In a closed loop u reacts to everything that disturbs y, and a fit takes this correlation for the
plant. An external signal r, the reference, is not correlated with the disturbances: the part of u
and y that follows r alone is free of them. The equation of ``initial_estimate``, divided by the
model's own A, ``target = R θ + ε``, is projected onto signals Z made of r alone::

    R̂ = Z (ZᵀZ)⁻¹ Zᵀ R,       θ = (R̂ᵀ R)⁻¹ R̂ᵀ target,
    cov θ = (R̂ᵀR)⁻¹ (Σ_blocks s sᵀ) (R̂ᵀR)⁻ᵀ,   s = Σ R̂ ε

and again with the resulting A, until θ no longer changes. This is two-stage least squares, the
simplest of the refined instrumental variables for closed loops (Gilson, Garnier, Young & Van den
Hof, *Closed-loop identification*, in Garnier & Wang 2008, ch. 5; Ljung 1999, sec. 7.6 and 13.5). Z
are r and its Laguerre filters at two rates, and the same of 1/A r: the better they span the loop's
response, the smaller the variance. The estimate has no bias with any Z.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.identification.frequency_starts import continuous, poles_of_record
from quell.identification.model import (
    Structure,
    autocorrelation,
    chain,
    chains,
    cost,
    lengths,
    linear_columns,
    nonzero_lengths,
    output,
    output_gradient,
    sampled,
    states,
)
from quell.identification.output_error import ParameterEstimate, block_sums, descend, projected
from quell.types import Matrix, Vector

# ---- The start at rest ----

# Relative singular value that counts as zero.
_RANK = 1e-12
SURE = 0.95
"""Probability from which on a start at rest is certain."""

# Odds of a start at rest before the record is looked at: chosen by hand.
_ODDS = 3.0
# Largest logarithm of the evidence ratio: beyond it nothing changes.
_MOST = 500.0


class AtRest(NamedTuple):
    """The assumption of a start at rest, and how likely a record makes it."""

    assumed: bool  # whether the model starts at rest
    given: bool  # whether this was given
    probability: float  # of a start at rest, from the record alone; NaN if it was not looked at


def structure_at_rest(structure: Structure) -> Structure:
    """Return the structure without friction of records at rest, which have no constant force."""
    return structure._replace(degrees=structure.degrees[:1], at_rest=True)


def from_rest(structure: Structure, u: Vector) -> Vector:
    """Return u less its first value in each record."""
    found = u.copy()
    for place in structure.records(u.size):
        found[place] -= u[place.start]
    return found


def probability(
    structure: Structure, estimate: ParameterEstimate, v: Matrix, y: Vector, rounding: float
) -> float:
    """Return the probability of a start at rest of the first record.

    ``structure`` is at rest, ``v`` are its inputs; ``rounding`` is the step that y is rounded to.
    """
    place = structure.records(y.size)[0]
    single, theta = (
        structure.single(),
        np.append(estimate.theta[: structure.common], estimate.theta[structure.common]),
    )
    v, y = v[place], y[place]
    with np.errstate(all="ignore"):
        predicted, psi = output_gradient(single, theta, v)
        G, sizes = _motions(single, theta, v)
    if not (np.all(np.isfinite(psi)) and np.all(np.isfinite(G)) and np.all(np.isfinite(sizes))):
        return 0.5
    error = y - predicted
    variance = max(float(error @ error) / max(y.size - theta.size, 1), rounding**2 / 12.0)
    if variance <= 0.0:
        variance = 1e-24 * max(float(np.var(y)), 1e-300)
    G = G * sizes
    scaled = psi / nonzero_lengths(psi)
    basis, weights, _ = np.linalg.svd(scaled, full_matrices=False)
    basis = basis[:, weights > _RANK * weights[0]]
    G = (G - basis @ (basis.T @ G)) / np.sqrt(variance)
    left = error - basis @ (basis.T @ error)
    gram = np.eye(G.shape[1]) + G.T @ G
    of_error = G.T @ left / np.sqrt(variance)
    fits = float(of_error @ np.linalg.solve(gram, of_error))
    ratio = 0.5 * float(np.linalg.slogdet(gram)[1]) - 0.5 * fits
    ratio = min(max(ratio, -_MOST), _MOST)
    return float(1.0 / (1.0 + np.exp(-ratio) / _ODDS))


def _motions(structure: Structure, theta: Vector, v: Matrix) -> tuple[Matrix, Vector]:
    """Return the responses (N, n) to y', …, y^(n) at the start, and the sizes of these later.

    The free motion from ``y^(i) = 1`` is ``Σ_j a_{i+1+j} p^j/A δ``; y^(n) at the start is that of a
    constant force.
    """
    n, a = structure.order, structure.denominator(theta)
    bank = chains(a, np.ones((v.shape[0], 1)))
    free, force = bank[:, :, -1], bank[:, 0, 0]
    above = np.append(a, 1.0)
    columns = [
        sum((above[i + 1 + j] * free[:, j] for j in range(n - i)), np.zeros(v.shape[0]))
        for i in range(1, n)
    ]
    # The model's own derivatives: y^(i) of B/A (u − u_0).
    of_u = chains(a, v[:, :1])[:, :, 0]
    b = structure.numerators(theta)[0]
    y = sum((value * of_u[:, j] for j, value in enumerate(b) if value), np.zeros(v.shape[0]))
    sizes = []
    for _ in range(n):
        y = np.diff(y, append=y[-1:])
        sizes.append(float(np.max(np.abs(y))))
    return np.column_stack([*columns, force]), np.array(sizes)


def general(
    structure: Structure, estimate: ParameterEstimate, u: Vector
) -> tuple[Structure, ParameterEstimate]:
    """Return a model at rest as one with constant forces and initial states, from ``u``.

    ``A y_0 = B u_0 + c`` at rest gives the force c of each record, and ``D = (y_0 (A − a_0) − u_0
    (B − b_0))/p`` keeps y at y_0. The covariance of A and B is the same; that of c and D is not
    used.
    """
    theta, forces = estimate.theta, max(len(structure.samples), 1)
    degrees = (*structure.degrees, *[0] * forces)
    free = structure._replace(degrees=degrees, at_rest=False)
    a, b = structure.denominator(theta), structure.numerators(theta)[0]
    levels = theta[structure.common :]
    starts = np.array([u[place.start] for place in structure.records(u.size)])
    inner = levels - structure.feedthrough(theta) * starts
    at = structure.free + structure.degrees[0] + 1
    above, above_b = np.append(a[1:], 1.0), np.append(b[1:], 0.0)
    held = zip(inner.tolist(), starts.tolist(), strict=True)
    found = np.concatenate(
        [
            theta[:at],
            a[0] * inner - b[0] * starts,
            theta[at : structure.common],
            *[level * above - first * above_b for level, first in held],
        ]
    )
    covariance = np.zeros((found.size, found.size))
    old = np.arange(structure.common)
    new = np.where(old < at, old, old + forces)
    covariance[np.ix_(new, new)] = estimate.covariance[: old.size, : old.size]
    return free, estimate._replace(theta=found, covariance=covariance)


# ---- Start of the search ----

# Number of λ, log-spaced from 10 per length of the record (at most 0.01 per sample) to 0.5 per
# sample: chosen by hand.
_RATES = 7
# Most rounds of refined instrumental variables, and the relative change of A that ends them: chosen
# by hand; not tuned further.
_ROUNDS, _SAME = 8, 1e-3
# For slow λ, samples are averaged: over this share of the filter's time constant at most, with this
# number of averages for each parameter at least. Chosen by hand; the result is only a start.
_SHARE, _AVERAGES = 0.1, 100


def filtered_estimates(structure: Structure, v: Matrix, y: Vector) -> list[Vector]:
    """Return a θ by least squares for each λ, the one of least output error first."""
    rates = np.geomspace(min(10.0 / y.size, 1e-2), 0.5, _RATES).tolist()
    tried = [_filtered(structure, v, y, rate) for rate in rates]
    return sorted(tried, key=lambda theta: cost(structure, theta, v, y))


def refined(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> tuple[float, Vector]:
    """Return the least output error and its θ among ``theta`` and rounds of refined instruments."""
    best, theta = projected(structure, theta, v, y)
    found = theta
    for _ in range(_ROUNDS):
        theta, before = stable(structure, _refined(structure, theta, v, y)), theta
        value = cost(structure, theta, v, y)
        if value < best:
            best, found = value, theta
        change = np.abs(theta - before)[: structure.free]
        if not np.all(np.isfinite(theta)) or np.all(
            change <= _SAME * np.abs(before[: change.size])
        ):
            break
    return best, found


def stable(structure: Structure, theta: Vector) -> Vector:
    """Return θ with the unstable poles of A mirrored into the left half plane."""
    free = theta[: structure.free]
    if structure.free == 0 or not np.all(np.isfinite(free)):
        return theta
    with np.errstate(all="ignore"):
        roots = np.roots(np.append(1.0, free[::-1]))
    if np.all(roots.real <= 0.0):
        return theta
    found = theta.copy()
    found[: structure.free] = np.poly(np.where(roots.real > 0.0, -roots.conj(), roots)).real[:0:-1]
    return found


def _filtered(structure: Structure, v: Matrix, y: Vector, rate: float) -> Vector:
    """Return θ by least squares with ``Λ = (p + rate)^n``, from averages if the rate is slow."""
    n = structure.order
    every = max(1, min(int(_SHARE / rate), y.size // (_AVERAGES * structure.size)))
    whole = y.size // every * every
    coarse, mean = y[:whole:every], v[:whole].reshape(-1, every, v.shape[1]).mean(axis=1)
    prefilter = np.array([math.comb(n, i) * (every * rate) ** (n - i) for i in range(n)])
    known = linear_columns(structure, prefilter, mean)
    target, regressors = equation(structure, prefilter, known, coarse)
    theta = _proper(structure, prefilter, _solve(regressors, target))
    return stable(structure, theta / structure.powers(float(every)))


def equation(
    structure: Structure, prefilter: Vector, known: Matrix, y: Vector
) -> tuple[Vector, Matrix]:
    """Return both sides of the equation divided by Λ; y is taken as linear between samples."""
    filtered = chain(prefilter, y)
    return y - filtered @ prefilter, np.hstack([-filtered[:, structure.integrators :], known])


def _refined(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> Vector:
    """Return θ after a round of refined instrumental variables."""
    with np.errstate(all="ignore"):
        _, instruments = output_gradient(structure, theta, v)
        known = instruments[:, structure.free :]
        prefilter = structure.denominator(theta)
        target, regressors = equation(structure, prefilter, known, y)
        return _proper(structure, prefilter, _solve(regressors, target, instruments))


def _proper(structure: Structure, prefilter: Vector, theta: Vector) -> Vector:
    """Return θ from the solution of the equation, where b contains ``D_u (A − Λ)`` too."""
    if structure.direct:
        theta = theta.copy()
        of_u = slice(structure.free, structure.free + structure.order)
        theta[of_u] += structure.feedthrough(theta) * (prefilter - structure.denominator(theta))
    return theta


def _solve(regressors: Matrix, target: Vector, instruments: Matrix | None = None) -> Vector:
    """Solve ``Zᵀ R θ = Zᵀ target``, Z = R by default; θ that are not excited become zero."""
    Z = regressors if instruments is None else instruments
    with np.errstate(all="ignore"):
        left, right = Z.T @ regressors, Z.T @ target
        known = (left, right, lengths(Z), lengths(regressors))
    if not all(np.all(np.isfinite(part)) for part in known):
        return np.full(regressors.shape[1], np.nan)
    rows, columns = nonzero_lengths(Z), nonzero_lengths(regressors)
    return np.linalg.lstsq(left / np.outer(rows, columns), right / rows, rcond=1e-14)[0] / columns


# ---- Smaller models inside a larger one, as starts of its search ----

# Fast poles that are added to a model of lower order: beyond the π per sample that samples show.
# The faster one changes the output less, the other one is easier to move.
_FAST_POLES = (10.0, 50.0)
# Range of the other one, the mean of the poles that there are [1/sample]: what samples show.
_RANGE = (1e-3, 3.0)


def smaller(structure: Structure) -> Structure | None:
    """Return the structure with a pole, and if it has one a zero, less; None for the smallest."""
    order = structure.order - 1
    if order < max(structure.integrators, 1):
        return None
    others = (max(min(degree, order - 2), 0) for degree in structure.degrees[1:])
    return structure._replace(order=order, degrees=(max(structure.degrees[0] - 1, 0), *others))


def extended(structure: Structure, lower: Structure, theta: Vector) -> Iterator[Vector]:
    """Yield θ of ``structure`` with the output of ``theta`` of ``lower``, or nearly so.

    Numerators are cut to the terms of ``structure``: what is left out is small for a fast pole.
    """
    rates = [*_FAST_POLES]
    if structure.degrees[0] > lower.degrees[0]:
        poles = np.abs(np.roots(np.append(1.0, lower.denominator(theta)[::-1])))
        rates.append(float(np.exp(np.mean(np.log(np.clip(poles, *_RANGE))))))
    direct = [lower.feedthrough(theta)] if structure.direct else []
    for rate in rates:
        a = _times(np.append(lower.denominator(theta), 1.0), rate)
        rows = zip(lower.numerators(theta), structure.degrees, strict=True)
        numerators = [_times(row, rate)[: degree + 1] for row, degree in rows]
        start = theta[lower.common :]
        if not structure.at_rest:
            start = np.concatenate([_times(one, rate) for one in start.reshape(-1, lower.order)])
        yield np.concatenate([a[structure.integrators : -1], *numerators, direct, start])


def _times(polynomial: Vector, rate: float) -> Vector:
    """Return ``(p + rate)`` times a polynomial in ascending powers."""
    return np.append(0.0, polynomial) + rate * np.append(polynomial, 0.0)


# ---- Starts from models of high order in discrete time, reduced to the order that is wanted ----

# Lags of the ARX model: at least, for each pole, and as a share of the samples at most. Chosen by
# hand: enough for a model of the noise, few enough that the coefficients are certain.
_LAGS, _LAGS_PER_POLE, _SHARE_REDUCED = 20, 4, 0.05
# Averages over 1, 4, 16, … samples, as long as this many averages for each pole remain (by hand).
_FACTOR, _AVERAGES_REDUCED = 4, 50
# Rows of the Hankel matrices for each lag: the impulse response lasts longer than the lags.
_LONGER = 3
# Poles that are taken besides those of the model, for what noise adds; the slow ones are kept.
_EXTRA = 2
# Relative singular value of the equations that counts as zero.
_RANK_REDUCED = 1e-10


def reduced_models(structure: Structure, v: Matrix, y: Vector) -> Iterator[Vector]:
    """Yield θ with the poles of reduced models; its linear parameters are zero."""
    every = 1
    while every == 1 or y.size // every >= _AVERAGES_REDUCED * max(structure.order, _FACTOR):
        whole = y.size // every * every
        inputs = v[:whole].reshape(-1, every, v.shape[1]).mean(axis=1)
        response = _impulse_response(structure.order, inputs, y[:whole:every])
        for order in (structure.order, structure.order + _EXTRA):
            poles = _poles(response, order)
            if poles.size:
                yield _with_poles(structure, continuous(poles, every))
        every *= _FACTOR


def _impulse_response(order: int, v: Matrix, y: Vector) -> Vector:
    """Return the impulse response from the first input of an ARX model with many lags."""
    from scipy.signal import lfilter

    lags = int(min(max(_LAGS, _LAGS_PER_POLE * order), max(_SHARE_REDUCED * y.size, 2 * order)))
    past = np.arange(lags, y.size)[:, None] - np.arange(1, lags + 1)
    regressors = np.hstack([y[past], v[past, 0], v[lags:, 1:]])
    size = nonzero_lengths(regressors)
    regressors /= size
    gram, right = regressors.T @ regressors, regressors.T @ y[lags:]
    found = np.linalg.lstsq(gram, right, rcond=_RANK_REDUCED)[0] / size
    impulse = np.zeros(2 * _LONGER * lags + 1)
    impulse[0] = 1.0
    # The model of a record with little noise may be unstable.
    with np.errstate(all="ignore"):
        g = lfilter(np.append(0.0, found[lags : 2 * lags]), np.append(1.0, -found[:lags]), impulse)
    return np.asarray(g[1:])


def _poles(g: Vector, order: int) -> NDArray[np.complex128]:
    """Return the poles z of the impulse response ``g``; none if it has fewer than ``order``."""
    half = g.size // 2
    if not np.all(np.isfinite(g)) or order > half:
        return np.zeros(0, dtype=complex)
    entries = np.arange(half)[:, None] + np.arange(half)
    U, S, V = np.linalg.svd(g[entries])
    if not S[order - 1] > 0.0:
        return np.zeros(0, dtype=complex)
    root = np.sqrt(S[:order])
    A = (U[:, :order] / root).T @ g[entries + 1] @ (V[:order].T / root)
    return np.asarray(np.linalg.eigvals(A), dtype=complex)


def _with_poles(structure: Structure, poles: NDArray[np.complex128]) -> Vector:
    """Return θ with these poles; slow ones stand for the integrators, the fastest are left out."""
    theta = np.zeros(structure.size)
    slow_first = poles[np.argsort(np.abs(poles))]
    kept = slow_first[structure.integrators : structure.order]
    if kept.size:
        theta[: structure.free] = np.poly(kept).real[:0:-1]
    return theta


# ---- The choice among many starts ----

# Share of the output's power that may stay unexplained if the search is to end early: a fit of
# 99 %, so that no other model can fit better by more than 1 %.
_SMALL = 1e-4
# Relative difference of two mean square errors of the same minimum: chosen by hand.
_SAME_BEST_START = 1e-3
# Relative mean square that counts as zero: rounding in long simulations.
_ROUNDING = 1e-18
# Number of starts that are refined by output error; most steps of each, and of the best two.
# By hand, so that the trial of benchmarks/identification_trial.py passes with a margin.
_KEPT, _FINISHED, _FEW_STEPS, _STEPS = 5, 2, 12, 60
# Lags of the test of whiteness, and its level: a model is rarely searched for longer in vain.
_LAGS_BEST_START, _LEVEL = 50, 1e-3


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
    # A pair of poles alone is found from the other starts.
    wanted = structure.order > 2
    shown = poles_of_record(v[:, 0], y, structure.order) if wanted else []
    of_record = (_with_poles(structure, poles) for poles in shown)
    others = itertools.chain(filtered[2:], reduced_models(structure, v, y), of_record)
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
    return second <= (1.0 + _SAME_BEST_START) * first + _ROUNDING * float(np.mean(y**2))


def _white(structure: Structure, estimate: ParameterEstimate, v: Matrix, y: Vector) -> bool:
    """Return whether the error of a model passes the test of whiteness of ``residuals``."""
    from scipy.stats import chi2

    if not math.isfinite(estimate.cost):
        return False
    with np.errstate(all="ignore"):
        error = y - output(structure, estimate.theta, v)
    lags = min(_LAGS_BEST_START, y.size // 4)
    correlation = autocorrelation(error, lags)
    return float(y.size * np.sum(correlation[1:] ** 2)) <= float(chi2.isf(_LEVEL, lags))


# ---- Instrumental variables from an external signal in a closed loop ----

# Most rounds, and the relative change of θ that ends them: chosen by hand; not tuned further.
_ROUNDS_CLOSED_LOOP, _CONVERGED = 30, 1e-4
# Laguerre filters at each rate, rates relative to the fastest pole: by hand; none causes a bias.
_LAGUERRE, _LAGUERRE_RATES = 8, (1.0, 0.2)
# Least number of blocks for the covariance, as in ``output_error``.
_BLOCKS = 60
# Relative singular value that counts as zero: above rounding, for nearly dependent signals.


def instrumental_variables(
    structure: Structure, theta: Vector, v: Matrix, y: Vector, r: Vector
) -> ParameterEstimate:
    """Return the parameters by instrumental variables from ``r`` (N,), starting at ``theta``."""
    converged = False
    for _ in range(_ROUNDS_CLOSED_LOOP):
        # A filter has to be stable; the plant in its loop need not be.
        a = structure.denominator(stable(structure, theta))
        known = linear_columns(structure, a, v)
        target, regressors = equation(structure, a, known, y)
        # Regressors that depend on neither u nor y are their own instruments.
        of_u = slice(structure.free, structure.free + structure.degrees[0] + 1)
        own = np.delete(regressors, np.r_[: structure.free, of_u], axis=1)
        Z = np.column_stack([_instruments(a, r), own])
        Z = Z / nonzero_lengths(Z)
        size = lengths(regressors)
        scaled = regressors / nonzero_lengths(regressors)
        projected = Z @ np.linalg.lstsq(Z.T @ Z, Z.T @ scaled, rcond=_RANK)[0]
        left = projected.T @ scaled
        after = np.linalg.lstsq(left, projected.T @ target, rcond=_RANK)[0] / size
        if not np.all(np.isfinite(after)):
            break
        change = np.max(np.abs((after - theta) * size)) / np.max(np.abs(theta * size))
        theta = after
        if change < _CONVERGED:
            converged = True
            break
    scores = block_sums(projected, target - regressors @ theta, max(_BLOCKS, 4 * theta.size))
    U, S, Vt = np.linalg.svd(left)
    # What the reference does not show has a large deviation, not none.
    half = Vt.T / np.maximum(S, _RANK * S[0]) @ U.T @ scores.T
    covariance = half @ half.T / np.outer(size, size)
    return ParameterEstimate(theta, covariance, cost(structure, theta, v, y), converged)


def _instruments(a: Vector, r: Vector) -> Matrix:
    """Return signals made of ``r`` alone that span the possible responses of a loop around 1/A."""
    poles = np.abs(np.roots(np.append(1.0, a[::-1])))
    fast = float(np.clip(np.max(poles), 1e-4, 1.0))
    bank = chain(a, r)
    cases = product((factor * fast for factor in _LAGUERRE_RATES), (r, bank[:, -1]))
    laguerre = [_laguerre(rate, signal) for rate, signal in cases]
    return np.column_stack([r, bank, *laguerre])


def _laguerre(rate: float, signal: Vector) -> Matrix:
    """Return ``√(2 λ) (p − λ)^(k−1)/(p + λ)^k`` times the signal, k = 1 … K (N, K)."""
    A = -rate * np.eye(_LAGUERRE) - 2.0 * rate * np.tril(np.ones((_LAGUERRE, _LAGUERRE)), -1)
    B = np.full((_LAGUERRE, 1), np.sqrt(2.0 * rate))
    return states(sampled(A, B, straight=True), signal[:, None])
