"""The start at rest: whether a record shows it, and its model in the general form.

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
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.identification.model.sampling import chains
from quell.identification.model.structure import Structure, gradient, nonzero_lengths
from quell.identification.search.output_error import ParameterEstimate
from quell.types import Matrix, Vector

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
        predicted, psi = gradient(single, theta, v)
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

    ``A y_0 = B u_0 + c`` at rest gives the force c of each record; ``D = y_0 (A − a_0)/p`` keeps
    y at y_0. The covariance of A and B is the same; that of c and D is not used.
    """
    theta, forces = estimate.theta, max(len(structure.samples), 1)
    degrees = (*structure.degrees, *[0] * forces)
    free = structure._replace(degrees=degrees, at_rest=False)
    a, b = structure.denominator(theta), structure.numerators(theta)[0]
    levels = theta[structure.common :]
    starts = np.array([u[place.start] for place in structure.records(u.size)])
    inner = levels - structure.feedthrough(theta) * starts
    at = structure.free + structure.degrees[0] + 1
    above = np.append(a[1:], 1.0)
    found = np.concatenate(
        [
            theta[:at],
            a[0] * inner - b[0] * starts,
            theta[at : structure.common],
            *[level * above for level in inner],
        ]
    )
    covariance = np.zeros((found.size, found.size))
    old = np.arange(structure.common)
    new = np.where(old < at, old, old + forces)
    covariance[np.ix_(new, new)] = estimate.covariance[: old.size, : old.size]
    return free, estimate._replace(theta=found, covariance=covariance)
