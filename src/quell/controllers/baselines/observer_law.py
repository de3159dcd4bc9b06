"""State feedback of an observer with a disturbance state, as one linear law.

The sampled plant with a disturbance that is a random walk, z = (x, d)::

    z⁺ = F z + G u,    F = [[Φ, Γ_d], [0, 1]],    G = [Γ; 0],    y = H z = C x

A Kalman filter in its current form, as the observers of this package, driven by the applied u, and
state feedback::

    z  = z⁻ + L (y − H z⁻),     L = P H' (H P H' + V)⁻¹
    u  = N r − K z,             z⁻⁺ = F z + G u

with P from the Riccati equation of (F', H', W, V). At rest the innovation is zero, and therefore
``y − r`` is zero for any plant and any constant disturbance: d̂ acts as integral action. Because
the filter receives the applied u, it does not wind up.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.controllers.linear.law import LinearLaw
from quell.lti.discretize import zero_order_hold
from quell.types import Matrix, Vector

# Relative size below which singular values and distances to the imaginary axis count as zero.
# Chosen by hand, above rounding errors.
_TINY = 1e-9
# The rounding of a zero eigenvalue, relative to the matrix; scalings of rows and columns, which
# converge quickly. Chosen by hand.
_ROUNDING, _SCALINGS = 1e-12, 10
_HINT = "check the noise densities, dt and the plant's units"


class SampledModel(NamedTuple):
    """``z⁺ = F z + G u``, ``y = H z``, of N = n + 1 states, the last of them the disturbance."""

    F: Matrix
    G: Vector
    H: Vector


def with_disturbance(A: Matrix, B: Matrix, C: Matrix, E: Matrix, dt: float) -> SampledModel:
    """Sample the plant with a constant disturbance that enters through ``E`` (n, 1)."""
    n = A.shape[0]
    phi, (gamma, gamma_d) = zero_order_hold(A, [B, E], dt)
    F = np.block([[phi, gamma_d], [np.zeros((1, n)), np.ones((1, 1))]])
    return SampledModel(F, np.append(gamma[:, 0], 0.0), np.append(C[0], 0.0))


def check_reachable(A: Matrix, B: Matrix, what: str) -> None:
    """Check the rank of (A − λ, B) for each pole λ that does not decay (Popov, Belevitch, Hautus).

    The error, for a mode that B does not reach, begins with ``what``.
    """
    from scipy.linalg import matrix_balance

    A, (scale, _) = matrix_balance(A, permute=False, separate=True)
    B = B / scale[:, None]
    for pole in np.linalg.eigvals(A):
        if pole.real >= -_TINY * np.linalg.norm(A):
            own = np.diag(A) - pole
            own[np.abs(own) <= _ROUNDING * np.linalg.norm(A)] = 0.0  # of eigenvalues
            inner = A - np.diag(np.diag(A)) + np.diag(own)
            if is_singular(np.hstack([inner, B])):
                raise ValueError(f"{what}: its mode at s = {pole:.4g} rad/s does not decay")


def is_singular(matrix: Any) -> bool:
    """Return whether the rows of a matrix depend on each other, but for rounding.

    Rows and columns are scaled before, by the geometric mean of their largest and least entries,
    which does not change the rank: in given units a quick undamped mode can look as if it had no
    effect on y.
    """
    for _ in range(_SCALINGS):
        for axis in (1, 0):
            entries = np.ma.masked_equal(np.abs(matrix), 0.0)
            ends = [np.ma.filled(of(entries, axis=axis), 1.0) for of in (np.ma.min, np.ma.max)]
            matrix = matrix / np.expand_dims(np.sqrt(ends[0] * ends[1]), axis)
    singular = np.linalg.svd(matrix, compute_uv=False)
    return bool(singular[-1] <= _TINY * singular[0])


def stationary_gain(model: SampledModel, W: Matrix, V: float) -> Vector:
    """Return the gain L (N,) of the stationary Kalman filter.

    The process noise per sample is W (N, N) [state-unit²], the measurement variance V [y-unit²];
    only their ratio counts. Raises ``ValueError`` if the Riccati equation has no solution with a
    stable filter.
    """
    from scipy.linalg import solve_discrete_are

    F, _, H = model
    try:
        P = solve_discrete_are(F.T, H[:, None], W, np.array([[V]]))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(f"no stationary Kalman filter: {error}; {_HINT}") from None
    gain: Vector = P @ H / (H @ P @ H + V)
    if not np.max(np.abs(np.linalg.eigvals(F - np.outer(F @ gain, H)))) < 1.0:
        raise ValueError(f"no stable stationary Kalman filter: {_HINT}")
    return gain


def feedback_law(model: SampledModel, L: Vector, K: Vector, N: float) -> LinearLaw:
    """Return ``u = N r − K z`` with the filter of gain L as a law whose state is z⁻."""
    F, G, H = model
    corrected = np.eye(G.size) - np.outer(L, H)
    B_r, D_y = np.zeros(G.size), -float(K @ L)
    return LinearLaw(F @ corrected, B_r, F @ L, G.copy(), -K @ corrected, N, D_y)
