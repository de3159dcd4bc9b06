"""State feedback of an observer with a disturbance at the plant's input or elsewhere, as one linear law.

The sampled plant with a disturbance that is a random walk, z = (x, d)::

    z⁺ = F z + G u,    F = [[Φ, Γ_d], [0, 1]],    G = [Γ; 0],    y = H z = C x

Kalman filter in its current form, as the observers of this package, told the u that was applied, and state feedback::

    z  = z⁻ + L (y − H z⁻),     L = P H' (H P H' + V)⁻¹,     P from the Riccati equation of (F', H', W, V)
    u  = N r − K z,             z⁻⁺ = F z + G u

Where the innovation is zero at rest, so is ``y − r``, whatever the plant and the disturbance are: d̂ acts as integral action. As it is
told the applied u, it does not wind up.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.linear import LinearLaw
from quell.observers.discretize import zero_order_hold
from quell.types import Matrix, Vector

# Relative to their size: below this, singular values and distances to the unit circle count as zero.
_TINY = 1e-9


class SampledModel(NamedTuple):
    """``z⁺ = F z + G u``, ``y = H z``, of N = n + 1 states, the last of them the disturbance."""

    F: Matrix
    G: Vector
    H: Vector


def plant_matrices(plant: Any) -> tuple[Matrix, Matrix, Matrix]:
    """Return A (n, n), B (n, 1), C (1, n) of a linear plant or a continuous-time ``control.StateSpace``.

    Raises
    ------
    ValueError
        for what has no such matrices, a sample time, or a D that is not zero.
    """
    if not all(hasattr(plant, name) for name in "ABC"):
        raise ValueError(f"plant = {plant!r}: must be a linear plant, with A, B and C, for example quell.plants.two_mass_spring()")
    if getattr(plant, "dt", None):
        raise ValueError(f"plant has a sample time, dt = {plant.dt!r}: must be a continuous-time model; it is sampled here")
    if np.any(np.asarray(getattr(plant, "D", 0.0)) != 0.0):
        raise ValueError(f"D = {np.asarray(plant.D).tolist()}: must be zero, the output may not follow the input at once")
    A = checks.matrix("A", plant.A)
    n = A.shape[0]
    return checks.matrix("A", A, n, n), checks.matrix("B", plant.B, n, 1), checks.matrix("C", plant.C, 1, n)


def with_disturbance(A: Matrix, B: Matrix, C: Matrix, E: Matrix, dt: float) -> SampledModel:
    """Sample the plant with a constant disturbance that enters through ``E`` (n, 1), u and d held over a sample."""
    n = A.shape[0]
    phi, (gamma, gamma_d) = zero_order_hold(A, [B, E], dt)
    F = np.block([[phi, gamma_d], [np.zeros((1, n)), np.ones((1, 1))]])
    return SampledModel(F, np.append(gamma[:, 0], 0.0), np.append(C[0], 0.0))


def check_reachable(A: Matrix, B: Matrix, what: str) -> None:
    """Check by the rank of (A − λ, B), for each pole λ that does not fade (Popov, Belevitch, Hautus); ``what`` is the error's beginning.

    Raises
    ------
    ValueError
        naming the mode that B does not reach.
    """
    n = A.shape[0]
    for pole in np.linalg.eigvals(A):
        if pole.real >= -_TINY * np.linalg.norm(A):
            singular = np.linalg.svd(np.hstack([A - pole * np.eye(n), B]), compute_uv=False)
            if singular[-1] <= _TINY * singular[0]:
                raise ValueError(f"{what}: its mode at s = {pole:.4g} rad/s does not fade by itself")


def leading_gain(A: Matrix, B: Matrix, C: Matrix) -> tuple[float, int]:
    """Return ``b = C A^(ν−1) B``, the first Markov parameter that is not zero, and ν."""
    row, bound = C[0], float(np.linalg.norm(C) * np.linalg.norm(B))
    for degree in range(1, A.shape[0] + 1):
        gain = float(row @ B[:, 0])
        if abs(gain) > 1e-9 * bound:
            return gain, degree
        row, bound = row @ A, bound * float(np.linalg.norm(A, 2))
    raise ValueError("u does not reach y: B or C is zero, or they have no mode in common")


def sampled_noise(A: Matrix, density: Matrix, dt: float) -> Matrix:
    """Return the covariance a sample of white noise on x' (Van Loan 1978)."""
    from scipy.linalg import expm

    n = A.shape[0]
    block = expm(np.block([[-A, density], [np.zeros((n, n)), A.T]]) * dt)
    return np.asarray(block[n:, n:].T @ block[:n, n:])


def kalman_gain(model: SampledModel, W: Matrix, V: float) -> Vector:
    """Return the gain L (N,) of the stationary Kalman filter, for process noise W (N, N) a sample and measurement variance V.

    Raises
    ------
    ValueError
        where the Riccati equation has no solution that makes the filter stable.
    """
    from scipy.linalg import solve_discrete_are

    F, _, H = model
    try:
        P = solve_discrete_are(F.T, H[:, None], W, np.array([[V]]))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(f"no stationary Kalman filter: {error}; look at the noise densities, dt and the plant's units") from None
    gain: Vector = P @ H / (H @ P @ H + V)
    if not np.max(np.abs(np.linalg.eigvals(F - np.outer(F @ gain, H)))) < 1.0:
        raise ValueError("no stable stationary Kalman filter: look at the noise densities, dt and the plant's units")
    return gain


def feedback_law(model: SampledModel, L: Vector, K: Vector, N: float) -> LinearLaw:
    """Return ``u = N r − K z`` with the filter of gain L as a law whose state is z⁻."""
    F, G, H = model
    corrected = np.eye(G.size) - np.outer(L, H)
    return LinearLaw(F @ corrected, np.zeros(G.size), F @ L, G.copy(), -K @ corrected, N, -float(K @ L))
