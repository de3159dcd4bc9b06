"""The published controllers, which are in continuous time: their loops, computed exactly.

Plant and ``u = −C(s) y`` together are one linear system without inputs, ``x' = A x``, and ``x(t +
h) = exp(A h) x(t)`` has no error; the force of the cubic spring acts between the samples, as in
``plants.machines.cubic_spring``. None of this is shared with the simulation or a controller of
this package.
"""

from __future__ import annotations

import numpy as np

from quell.experiments.acc.controllers import TransferFunction
from quell.experiments.acc.criteria import DURATION, SETTLED_AT, Judged
from quell.parallel import one_blas_thread
from quell.types import Matrix, Vector

STEP = 0.01
"""Time between the samples that are judged [s]: the sample time of the other controllers."""


def judge_published(
    design: TransferFunction, samples: Matrix, cubic: bool, duration: float = DURATION
) -> Judged:
    """Judge a continuous-time controller on samples (count, 6)."""
    with one_blas_thread():
        return _judged(design, samples, cubic, duration)


def _judged(design: TransferFunction, samples: Matrix, cubic: bool, duration: float) -> Judged:
    from scipy.linalg import expm

    loops, output = _closed_loops(design, samples)
    transition = expm(loops * STEP)
    m1, m2, k_cubic = samples[:, 0], samples[:, 1], 0.5 * STEP * cubic * samples[:, 3]
    push1, push2 = -k_cubic / m1, k_cubic / m2
    x = np.zeros((*loops.shape[:2], 1))
    x[:, 3, 0] = 1.0 / m2
    late_peak, most_u = np.zeros(m1.size), np.zeros(m1.size)
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(round(duration / STEP) + 1):
            most_u = np.maximum(most_u, np.abs(x[:, 5:, 0] @ output))
            if i * STEP >= SETTLED_AT - 1e-9:
                late_peak = np.maximum(late_peak, np.abs(x[:, 1, 0]))
            if cubic:
                _push(x, push1, push2)
            x = transition @ x
            if cubic:
                _push(x, push1, push2)
    unstable = np.max(np.linalg.eigvals(loops).real, axis=1) >= 0.0
    late_peak = np.where(unstable | np.isnan(late_peak), np.inf, late_peak)
    return Judged(late_peak, np.nan_to_num(most_u, nan=np.inf))


def _push(x: Matrix, push1: Vector, push2: Vector) -> None:
    cube = (x[:, 0, 0] - x[:, 1, 0]) ** 3
    x[:, 2, 0] += push1 * cube
    x[:, 3, 0] += push2 * cube


def _closed_loops(design: TransferFunction, samples: Matrix) -> tuple[Matrix, Vector]:
    """Return A (count, 5 + n, 5 + n), the plant's states first, and the controller's C (n,)."""
    m1, m2, k, _, effectiveness, lag = samples.T
    den = np.array(design.den) / design.den[0]
    output = -np.array(design.num)[::-1] / design.den[0]
    n = den.size - 1
    A = np.zeros((m1.size, 5 + n, 5 + n))
    A[:, 0, 2] = A[:, 1, 3] = 1.0
    A[:, 2, 0], A[:, 2, 1], A[:, 2, 4] = -k / m1, k / m1, effectiveness / m1
    A[:, 3, 0], A[:, 3, 1] = k / m2, -k / m2
    A[:, 4, 4] = -1.0 / lag
    A[:, 4, 5:] = output / lag[:, None]
    A[:, 5:-1, 6:] = np.eye(n - 1)
    A[:, -1, 5:] = -den[:0:-1]
    A[:, -1, 1] = 1.0
    return A, output
