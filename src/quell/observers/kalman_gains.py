"""The steady-state Kalman gain of the extended state observer, from variances.

White noise is assumed to drive the extended model: ``f^(m) = w`` with the density ``drift`` and m
extended states, ``x_n' = … + f + v`` with the density ``jitter``. y is measured with noise of the
variance ``noise`` in each sample. Sampled exactly (Van Loan, *IEEE Trans. Automatic Control* 23,
1978)::

    Q  = ∫_0^dt exp(A s) G exp(Aᵀ s) ds
    P⁻ = Φ (P⁻ − P⁻ Cᵀ (C P⁻ Cᵀ + R)⁻¹ C P⁻) Φᵀ + Q,      L = P⁻ Cᵀ / (C P⁻ Cᵀ + R)

With drift alone and fast sampling, the poles lie in a Butterworth pattern of the radius
``(drift/(noise dt))^(1/2N)`` (symmetric root locus of a chain of N integrators; Anderson & Moore,
*Optimal Control*, 1990).
"""

from __future__ import annotations

import numpy as np

from quell.lti.discretize import gramian, zero_order_hold
from quell.types import Matrix, Vector


def kalman_gain(
    A: Matrix, order: int, dt: float, noise: float, drift: float, jitter: float
) -> tuple[Vector, float]:
    """Return L (N,) and the geometric mean of ``|ln z_i|/dt`` over the poles [rad/s].

    L is in the coordinates of ``A`` (N, N), whose states from n + 1 on, with n the ``order``, are f
    and its derivatives. The equation is solved in the time unit of the Butterworth pattern, where
    the entries of Φ, Q and P have similar sizes.
    """
    from scipy.linalg import solve_discrete_are

    size = A.shape[0]
    # With drift alone q/(r dt) is the bandwidth to the power 2N, with jitter alone to the power
    # 2n, n being the order. Take the faster one.
    density = noise * dt
    with np.errstate(all="ignore"):
        by_drift, by_jitter = np.float64(drift) / density, np.float64(jitter) / density
        omega = float(max(by_drift ** (0.5 / size), by_jitter ** (0.5 / order)))
    refusal = ValueError(
        f"noise_variance = {noise!r}, drift = {drift!r}, jitter = {jitter!r} with "
        f"dt = {dt!r} s: no steady-state gain is found; they ask for about {omega:.3g} rad/s, "
        "which should be between 1e-3/dt and 1/dt"
    )
    if not 0.0 < omega < np.inf:
        raise refusal
    scale = omega ** -np.arange(size, dtype=np.float64)
    scaled = A * scale[:, None] / scale[None, :] / omega
    drive = np.zeros((size, size))
    drive[-1, -1] = drift / density * (scale[-1] / omega) ** 2
    drive[order - 1, order - 1] = jitter / density * (scale[order - 1] / omega) ** 2
    step = omega * dt
    phi, _ = zero_order_hold(scaled, [], step)
    phi[:order, order + 1 :] = 0.0  # f is held within a sample, as in ``design.py``
    C, R = np.eye(1, size), np.array([[1.0 / step]])
    try:
        with np.errstate(invalid="ignore"):  # what overflows is found below
            P = solve_discrete_are(phi.T, C.T, gramian(scaled, drive, step), R)
    except (np.linalg.LinAlgError, ValueError):
        P = np.full((size, size), np.nan)
    gain = P[:, 0] / (P[0, 0] + R[0, 0])
    poles = np.array([np.inf])
    if np.all(np.isfinite(gain)):
        poles = np.linalg.eigvals((np.eye(size) - np.outer(gain, C)) @ phi)
    with np.errstate(divide="ignore"):
        rate = float(np.exp(np.mean(np.log(np.abs(np.log(poles.astype(complex)))))))
    if not (np.max(np.abs(poles)) < 1.0 and rate < np.pi):
        raise refusal
    return np.asarray(gain / scale), rate / dt
