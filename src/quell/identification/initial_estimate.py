"""Where the search starts: least squares on filtered signals, then refined instrumental variables.

Dividing ``A y = B u + …`` by any stable polynomial Λ of degree n gives what can be calculated from samples and is linear in θ::

    p^n/Λ y = −Σ a_i p^i/Λ y + Σ b_i p^i/Λ u + … + Σ d_i p^i/Λ δ

an ARX model in continuous time (Young, *Automatica* 17, 1981; Garnier & Wang, *Identification of Continuous-time Models from Sampled
Data*, 2008, ch. 1). With ``Λ = (p + λ)^n`` it is least squares, whose poles noise drags along. *Refined* it takes the last model's
own A for Λ, and its noise-free output ŷ in place of y among the instruments (SRIVC; Young & Jakeman, *Int. J. Control* 31, 1980): then
the instruments are the gradient of ŷ, and where it comes to rest θ is free of bias by noise. Starting it at several λ makes it find the
plant whatever its speed.

A model of more poles than the plant has is not found that way: 1/Λ^n leaves little of u, and any poles fit what is left. So the model of
one pole less, and a fast pole beside it, is tried too.
"""

from __future__ import annotations

import math

import numpy as np

from quell.identification.sampling import chain
from quell.identification.structure import Structure, gradient, lengths, linear_columns, output
from quell.types import Matrix, Vector

_RATES = 7
# Where more of the output's power than this is not explained, a lower order may lead to something better.
_POOR = 1e-3
# The further pole that a model of lower order is given [1/sample].
_FURTHER = 10.0
_ROUNDS = 8
# Averages are over so much of the filter's time constant at most, and so many to a parameter at least.
_FINE = 0.1
_FEWEST = 100


def started(structure: Structure, v: Matrix, y: Vector) -> tuple[Vector, ...]:
    """Return parameters near those of least output error, for the inputs ``v`` (N, inputs) and the output ``y`` (N,).

    Those that leave much unexplained are followed by those of a lower order, with fast poles.
    """
    tried = [
        _filtered(structure, v, y, rate)
        for rate in np.geomspace(min(10.0 / y.size, 1e-2), 0.5, _RATES).tolist()
    ]
    best, theta = min(
        ((cost(structure, theta, v, y), theta) for theta in tried), key=lambda pair: pair[0]
    )
    for _ in range(_ROUNDS):
        refined = stable(structure, _refined(structure, theta, v, y))
        value = cost(structure, refined, v, y)
        if not value < best * (1.0 - 1e-3):
            break
        best, theta = value, refined
    if best > _POOR * float(np.var(y)) and structure.order > max(
        structure.degrees[0] + 1, structure.integrators
    ):
        lower = structure._replace(
            order=structure.order - 1,
            degrees=(
                structure.degrees[0],
                *(max(min(d, structure.order - 3), 0) for d in structure.degrees[1:]),
            ),
        )
        return theta, *(_faster(structure, lower, simpler) for simpler in started(lower, v, y))
    return (theta,)


def _faster(structure: Structure, lower: Structure, theta: Vector) -> Vector:
    """Return the parameters of the model of one pole less with a fast pole beside it; zeros that it would need and has not are left out."""

    def times(polynomial: Vector) -> Vector:
        return np.append(0.0, polynomial) + _FURTHER * np.append(polynomial, 0.0)

    a = times(np.append(lower.denominator(theta), 1.0))
    numerators = [
        times(row)[: degree + 1]
        for row, degree in zip(lower.numerators(theta), structure.degrees, strict=True)
    ]
    return np.concatenate([a[structure.integrators : -1], *numerators, times(lower.start(theta))])


def cost(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> float:
    """Return the mean square of the output error, infinite where it is no number."""
    with np.errstate(all="ignore"):
        value = (
            float(np.mean((y - output(structure, theta, v)) ** 2))
            if np.all(np.isfinite(theta))
            else math.inf
        )
    return value if math.isfinite(value) else math.inf


def stable(structure: Structure, theta: Vector) -> Vector:
    """Return θ with the unstable poles of A mirrored into the left half plane: a model that runs away can't be judged by its output."""
    free = theta[: structure.free]
    if structure.free == 0 or not np.all(np.isfinite(free)):
        return theta
    roots = np.roots(np.append(1.0, free[::-1]))
    if np.all(roots.real <= 0.0):
        return theta
    found = theta.copy()
    found[: structure.free] = np.poly(np.where(roots.real > 0.0, -roots.conj(), roots)).real[:0:-1]
    return found


def _filtered(structure: Structure, v: Matrix, y: Vector, rate: float) -> Vector:
    """Return θ by least squares with ``Λ = (p + rate)^n``; what is slow is found in averages over several samples, which are fewer."""
    n = structure.order
    every = max(1, min(int(_FINE / rate), y.size // (_FEWEST * structure.size)))
    whole = y.size // every * every
    coarse, mean = y[:whole:every], v[:whole].reshape(-1, every, v.shape[1]).mean(axis=1)
    prefilter = np.array([math.comb(n, i) * (every * rate) ** (n - i) for i in range(n)])
    target, regressors = equation(
        structure, prefilter, linear_columns(structure, prefilter, mean), coarse
    )
    return stable(structure, _solve(regressors, target) / structure.powers(float(every)))


def equation(
    structure: Structure, prefilter: Vector, known: Matrix, y: Vector
) -> tuple[Vector, Matrix]:
    """Return left and right side of the equation divided by Λ; y is taken as straight between samples."""
    filtered = chain(prefilter, y)
    return y - filtered @ prefilter, np.hstack([-filtered[:, structure.integrators :], known])


def _refined(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> Vector:
    """Return θ after a round of refined instrumental variables."""
    with np.errstate(all="ignore"):
        _, instruments = gradient(structure, theta, v)
        target, regressors = equation(
            structure, structure.denominator(theta), instruments[:, structure.free :], y
        )
        return _solve(regressors, target, instruments)


def _solve(regressors: Matrix, target: Vector, instruments: Matrix | None = None) -> Vector:
    """Solve ``Zᵀ R θ = Zᵀ target``, Z being R itself without instruments; what is not excited is left at zero."""
    Z = regressors if instruments is None else instruments
    with np.errstate(all="ignore"):
        left, right = Z.T @ regressors, Z.T @ target
        rows, columns = lengths(Z), lengths(regressors)
    if not (
        np.all(np.isfinite(left))
        and np.all(np.isfinite(right))
        and np.all(np.isfinite(rows))
        and np.all(np.isfinite(columns))
    ):
        return np.full(columns.size, np.nan)
    rows, columns = np.where(rows > 0.0, rows, 1.0), np.where(columns > 0.0, columns, 1.0)
    return np.linalg.lstsq(left / np.outer(rows, columns), right / rows, rcond=1e-14)[0] / columns
