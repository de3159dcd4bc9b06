"""The search as a whole: start, refinement, what rubs, how late u is, whether a pole lies at s = 0."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.identification.friction import free_run, measured_sign, resonance
from quell.identification.initial_estimate import started
from quell.identification.output_error import Refined, promised, refined
from quell.identification.structure import Structure
from quell.types import Matrix, Vector

# The slope of the measured output is taken over so many samples either way until there is a model.
_HALF_WIDTH = 10
_PASSES = 12
# So few signs, as a share, may still change.
_AT_REST = 5e-4
# Of the resonance's square, where the driven side's own frequency is looked for: it is its inertia's share of both.
_SHARES, _TRIALS = (0.1, 1.0), 10
# Steps of the search on the way, and at the end.
_BRIEFLY, _THOROUGHLY = 2, 30
# A pole within so many of its standard deviations of s = 0, or this much slower than the record is long, is taken for an integrator.
_DEVIATIONS = 3.0
_SLOWER = 10.0
# The same for two poles at a time: as rare of χ² with two degrees of freedom as three deviations are of one.
_PAIR = 11.8
# That is to first order. So the mean square of the error may become so much larger by one integrator, by two, and without noise be so
# much of the output's: signs of friction that are not settled yet make it larger too.
_AS_GOOD = (30.0, 1.05)
_ROUNDING = 1e-18


class Fit(NamedTuple):
    """What was fitted to the samples used for it."""

    structure: Structure
    found: Refined
    late: int
    """By how many samples u is late."""
    bias: bool

    def inputs(self, u: Vector) -> Matrix:
        """Return the inputs (N, inputs) for ``u``; those of friction are zero, ``free_run`` fills them in."""
        columns = [
            delayed(u, self.late),
            *([np.ones(u.size)] if self.bias else []),
            *[np.zeros(u.size)] * len(self.structure.rubbing),
        ]
        return np.column_stack(columns)


def delayed(u: Vector, late: int) -> Vector:
    """Return ``u`` so many samples later; before the record it was what it is at its start."""
    return u if late == 0 else np.concatenate([np.full(late, u[0]), u[:-late]])


def fit(
    u: Vector,
    y: Vector,
    order: int,
    zeros: int,
    integrators: int | None,
    late: tuple[int, int],
    bias: bool,
    friction: bool,
) -> Fit:
    """Return the model of least output error; ``late`` is the range of delays [samples] that is looked through."""
    degrees = (zeros, *([0] if bias else []), *([max(order - 2, 0)] if friction else []))
    structure = Structure(order, integrators or 0, degrees, (0.0,) if friction else ())
    v = np.column_stack(
        [
            delayed(u, late[0]),
            *([np.ones(u.size)] if bias else []),
            *([measured_sign(y, _HALF_WIDTH)] if friction else []),
        ]
    )
    starts = started(structure, v, y)
    steps = _BRIEFLY if len(starts) == 1 else _THOROUGHLY
    found = min(
        (refined(structure, theta, v, y, steps) for theta in starts), key=lambda one: one.cost
    )
    if not np.isfinite(found.cost):
        raise ValueError(
            f"order = {order}, zeros = {zeros}: no model was found whose output is finite; lower the order, or scale u and y"
        )
    samples, found, v = _latest(structure, found, u, v, y, late, late[0])
    if integrators is None:
        structure, found = _with_integrator(structure, found, v, y)
    if friction and order > 3:
        structure, found, v = _driven(structure, found, v, y)
        if integrators is None:
            structure, found = _with_integrator(structure, found, v, y)
    found, v = _settled(structure, found, v, y)
    if friction and late[0] < late[1]:
        # Beside a wrong sign of the speed another delay may have looked best.
        again, found, v = _latest(structure, found, u, v, y, late, samples)
        if again != samples:
            samples = again
            found, v = _settled(structure, found, v, y)
    return Fit(structure, found, samples, bias)


def _settled(structure: Structure, found: Refined, v: Matrix, y: Vector) -> tuple[Refined, Matrix]:
    """Return the parameters, with friction those for the signs of the speeds that they themselves give, and the inputs."""
    best = (np.inf, found, v)
    for _ in range(_PASSES if structure.rubbing else 0):
        predicted, own = free_run(structure, found.theta, v, own_friction=True)
        best = min(best, (float(np.mean((y - predicted) ** 2)), found, own), key=lambda one: one[0])
        if np.mean(np.any(own != v, axis=1)) <= _AT_REST:
            break
        v = own
        found = refined(structure, found.theta, v, y, _BRIEFLY)
    # On the way it may have been better than where it came to.
    _, found, v = best
    return refined(structure, found.theta, v, y, _THOROUGHLY), v


def _driven(
    structure: Structure, found: Refined, v: Matrix, y: Vector
) -> tuple[Structure, Refined, Matrix]:
    """Return the structure with friction on what is driven too, where there is a resonance to tell the two apart; parameters and inputs."""
    from scipy.optimize import minimize_scalar

    v = free_run(structure, found.theta, v, own_friction=True)[1]
    found = refined(structure, found.theta, v, y, _BRIEFLY)
    omega = resonance(structure.denominator(found.theta))
    if omega == 0.0:
        return structure, found, v
    # A coefficient more, before those of friction on what is measured; what that had becomes the driven side's.
    at = structure.free + sum(structure.degrees[:-1]) + len(structure.degrees) - 1
    theta = np.insert(found.theta, at, found.theta[at])
    theta[at + 1 : at + 2 + structure.degrees[-1]] = 0.0
    wider = structure._replace(degrees=(*structure.degrees[:-1], 0, structure.degrees[-1]))
    v = np.column_stack([v, v[:, -1]])
    tried: list[tuple[float, Structure, Vector]] = []

    def error(share: float) -> float:
        candidate = wider._replace(rubbing=(1.0 / (share * omega**2), 0.0))
        value, after = min(tried, key=lambda one: one[0])[2] if tried else theta, 0.0
        for _ in range(2):
            after, value = promised(
                candidate, value, free_run(candidate, value, v, own_friction=True)[1], y
            )
        tried.append((after, candidate, value))
        return after

    minimize_scalar(
        error, bounds=_SHARES, method="bounded", options={"xatol": 1e-2, "maxiter": _TRIALS}
    )
    _, wider, theta = min(tried, key=lambda one: one[0])
    v = free_run(wider, theta, v, own_friction=True)[1]
    return wider, refined(wider, theta, v, y, _BRIEFLY), v


def _latest(
    structure: Structure,
    found: Refined,
    u: Vector,
    v: Matrix,
    y: Vector,
    late: tuple[int, int],
    now: int,
) -> tuple[int, Refined, Matrix]:
    """Return the delay of least output error, found going down from ``now`` in steps of 8, 4, 2, 1; the parameters and inputs with it."""

    def moved(samples: int) -> Matrix:
        return np.column_stack([delayed(u, samples), v[:, 1:]])

    known = {now: found}
    step = min(8, late[1] - late[0])
    while step:
        for samples in (now + step, now - step):
            if late[0] <= samples <= late[1] and samples not in known:
                known[samples] = refined(structure, known[now].theta, moved(samples), y, _BRIEFLY)
        best = min(known, key=lambda one: known[one].cost)
        now, step = (best, step) if best != now else (now, step // 2)
    return now, known[now], moved(now)


def _with_integrator(
    structure: Structure, found: Refined, v: Matrix, y: Vector
) -> tuple[Structure, Refined]:
    """Return the structure with one or two poles at s = 0, and its parameters, where the slowest can't be told from that."""
    if structure.integrators:
        return structure, found
    a, free, covariance = structure.denominator(found.theta), structure.free, found.covariance
    # An integrator whose zero can't be told from s = 0 either is none: the two cancel.
    if structure.degrees[0] and abs(found.theta[free]) < _DEVIATIONS * np.sqrt(
        covariance[free, free]
    ):
        return structure, found
    poles = np.roots(np.append(1.0, a[::-1]))
    slow = poles[np.argsort(np.abs(poles))][:2]
    for count, limit in ((2, _PAIR), (1, _DEVIATIONS**2)):
        if count > slow.size or (count == 1 and abs(slow[0].imag) > 0.0):
            continue
        if (
            abs(slow[count - 1]) * _SLOWER * y.size < 1.0
            or _squares(a, covariance[: a.size, : a.size], slow[:count]) < limit
        ):
            fewer = structure._replace(integrators=count)
            without = refined(fewer, found.theta[count:], v, y, _BRIEFLY)
            if without.cost <= _AS_GOOD[
                count - 1
            ] * found.cost or without.cost <= _ROUNDING * float(np.mean(y**2)):
                return fewer, without
    return structure, found


def _squares(a: Vector, covariance: Matrix, roots: Any) -> float:
    """Return how far from zero the coefficients of the polynomial of one root, or two, are, as the sum of squares in deviations."""
    slopes = np.array([_slope(a, root) for root in roots])
    if roots.size == 1:
        coefficients, slopes = -roots, -slopes
    else:
        coefficients = np.array([roots[0] * roots[1], -roots[0] - roots[1]])
        slopes = np.array([roots[1] * slopes[0] + roots[0] * slopes[1], -slopes[0] - slopes[1]])
    part = slopes.real @ covariance @ slopes.real.T
    size = np.sqrt(np.maximum(np.diag(part), 1e-300))
    away = coefficients.real / size
    return float(away @ np.linalg.pinv(part / np.outer(size, size), hermitian=True) @ away)


def _slope(a: Vector, root: complex) -> Vector:
    """Return the derivatives of a root of ``p^n + a_{n−1} p^(n−1) + …`` by its ``a``."""
    found: Vector = -(root ** np.arange(a.size)) / np.polyval(
        np.polyder(np.append(1.0, a[::-1])), root
    )
    return found


def root_covariance(a: Vector, covariance: Matrix, root: complex) -> tuple[float, float]:
    """Return the variances of real and imaginary part of a root of ``p^n + a_{n−1} p^(n−1) + …``, from the covariance of its ``a``.

    To first order ``δp = −Σ p^i δa_i / A'(p)``.
    """
    slope = _slope(a, root)
    return float(slope.real @ covariance @ slope.real), float(slope.imag @ covariance @ slope.imag)
