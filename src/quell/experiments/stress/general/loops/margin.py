"""The modulus margin of a loop with MF-ESO, quickly: for ten thousand loops drawn at random."""

from __future__ import annotations

import numpy as np

from quell.controllers import ADRC
from quell.lti.discretize import zero_order_hold
from quell.plants import LinearPlant
from quell.types import Matrix, Vector

# Frequencies of the grid, from a thousandth of omega_c to half the sampling rate: neighbours are
# 4 % apart, and min |1 + L| of a loop without sharp resonances is then right within 1 %.
_POINTS_PER_DECADE = 60
_LOWEST = 1e-3


def modulus_margin(plant: LinearPlant, controller: ADRC, delay: int = 0) -> float:
    """Return ``min |1 + L|`` on a grid of frequencies; zero for an unstable loop.

    Parameters
    ----------
    plant
        the linear part of the plant.
    controller
        without learner, with a linear observer of the current form: ``p⁺ = (Φ − Γ K) z`` with
        ``z = (I − L C) p + L y`` and ``u = −K z``.
    delay
        of the plant's input in samples.
    """
    design, dt = controller.parameters, controller.dt
    eso = design.eso
    K = np.append(design.law - design.cancel, 1.0) / design.b0
    inner = eso.transition - np.outer(eso.input, K)
    phi, (gamma,) = zero_order_hold(plant.A, [plant.B], dt)
    gamma, C, L_y = gamma[:, 0], plant.C[0], eso.gain
    correct = np.eye(K.size)
    correct[:, 0] -= L_y
    closed = _closed(phi, gamma, C, inner, correct, L_y, K, delay)
    if not np.max(np.abs(np.linalg.eigvals(closed))) < 1.0:
        return 0.0
    low, high = _LOWEST * controller.omega_c, np.pi / dt
    omega = np.geomspace(low, high, int(_POINTS_PER_DECADE * np.log10(high / low)) + 1)
    z = np.exp(1j * omega * dt)
    # From y to −u: K z with z = correct p + L_y y, p⁺ = inner z.
    of_law = _response(inner @ correct, inner @ L_y, K @ correct, z) + K @ L_y
    L = _response(phi, gamma, C, z) * of_law * z**-delay
    return float(np.min(np.abs(1.0 + L)))


def _response(A: Matrix, B: Vector, C: Vector, z: Vector) -> Vector:
    resolvent = z[:, None, None] * np.eye(A.shape[0]) - A
    inputs = np.broadcast_to(B[:, None].astype(complex), (z.size, B.size, 1))
    return np.asarray(np.linalg.solve(resolvent, inputs)[:, :, 0] @ C)


def _closed(
    phi: Matrix,
    gamma: Vector,
    C: Vector,
    inner: Matrix,
    correct: Matrix,
    L_y: Vector,
    K: Vector,
    delay: int,
) -> Matrix:
    """Return the matrix of plant, delay line and observer in closed loop."""
    n, m = phi.shape[0], K.size
    M = np.zeros((n + delay + m, n + delay + m))
    z = np.zeros((m, n + delay + m))  # the observer's state after its correction
    z[:, :n], z[:, n + delay :] = np.outer(L_y, C), correct
    M[:n, :n] = phi
    if delay:
        M[:n, n + delay - 1] = gamma
        M[n] = -K @ z
        for i in range(n + 1, n + delay):
            M[i, i - 1] = 1.0
    else:
        M[:n] += np.outer(gamma, -K @ z)
    M[n + delay :] = inner @ z
    return M
