"""Smaller models inside a larger one, as starts of its search.

A model with one pole and one zero less is contained in the larger one, ``B/A = B (p + λ)/(A (p +
λ))`` for any λ. Without a zero to remove it is the limit of ``λ B/(A (p + λ))`` for a fast pole λ.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quell.identification.model.structure import Structure
from quell.types import Vector

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
