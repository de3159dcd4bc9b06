"""Start of the search: least squares on filtered signals, then refined instrumental variables.

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
"""

from __future__ import annotations

import math

import numpy as np

from quell.identification.model.sampling import chain
from quell.identification.model.structure import (
    Structure,
    cost,
    gradient,
    lengths,
    linear_columns,
    nonzero_lengths,
)
from quell.identification.search.output_error import projected
from quell.types import Matrix, Vector

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
        _, instruments = gradient(structure, theta, v)
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
