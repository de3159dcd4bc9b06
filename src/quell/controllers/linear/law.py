"""The sampled linear law of two degrees of freedom, its checks and its state of rest."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import generic
from quell.types import Matrix, Vector

# Singular values below this share of the largest one count as zero: they belong to integrators.
# Chosen by hand, above rounding errors.
_RANK = 1e-10


class LinearLaw(NamedTuple):
    """A sampled linear law of m states that receives the applied u.

    ::

        u_wished = C x + D_r r + D_y y          u = limited(u_wished)
        x⁺       = A x + B_r r + B_y y + B_u u

    Without limits, u is u_wished and the law is linear with A + B_u C etc. B_u prevents windup.
    """

    A: Matrix  # (m, m)
    B_r: Vector  # (m,)
    B_y: Vector  # (m,)
    B_u: Vector  # (m,)
    C: Vector  # (m,)
    D_r: float  # [u-unit/y-unit]
    D_y: float  # [u-unit/y-unit]


@generic
def advance_law(law: Any, x: Vector, work: Vector, r: float, y: float, u: float) -> None:
    """Advance the state ``x`` (m,) by a sample; ``work`` (m,) is zero before the first one."""
    raise TypeError


@advance_law.register(LinearLaw)
def _advance(law: LinearLaw, x: Vector, work: Vector, r: float, y: float, u: float) -> None:
    for i in range(x.size):
        total = law.B_r[i] * r + law.B_y[i] * y + law.B_u[i] * u
        for j in range(x.size):
            total += law.A[i, j] * x[j]
        work[i] = total
    for i in range(x.size):
        x[i] = work[i]


def checked_law(law: Any) -> LinearLaw:
    """Return the law with checked, contiguous arrays that can't be written to."""
    if not isinstance(law, LinearLaw):
        raise ValueError(f"law = {law!r}: must be a quell.controllers.LinearLaw")
    A = checks.matrix("law.A", law.A)
    m = A.shape[0]
    checks.matrix("law.A", A, m, m)
    names = ("B_r", "B_y", "B_u", "C")
    B_r, B_y, B_u, C = (checks.vector(f"law.{name}", getattr(law, name), m) for name in names)
    for array in (A, B_r, B_y, B_u, C):
        array.flags.writeable = False
    D_r, D_y = checks.finite("law.D_r", law.D_r), checks.finite("law.D_y", law.D_y)
    return LinearLaw(A, B_r, B_y, B_u, C, D_r, D_y)


def rest_state(law: LinearLaw, y: float = 1.0, u: float = 0.0) -> Vector:
    """Return the state (m,) of a law at rest at r = y, with ``u`` or as close as possible.

    Of all states with ``x = (A + B_u C) x + (B_r + B_y + B_u (D_r + D_y)) y`` it is the one whose
    control signal is closest to u: an integrator balances the rest of the law. Without such a
    state, it is the least-squares solution.
    """
    if law.C.size == 0:
        return np.zeros(0)
    D = law.D_r + law.D_y
    difference = np.eye(law.C.size) - law.A - np.outer(law.B_u, law.C)
    x = np.linalg.pinv(difference, rcond=_RANK) @ ((law.B_r + law.B_y + law.B_u * D) * y)
    _, singular, rows = np.linalg.svd(difference)
    free = rows[singular <= _RANK * np.max(singular)]
    output = free @ law.C
    if output @ output > 0.0:
        x = x - free.T @ output * ((law.C @ x + D * y - u) / (output @ output))
    return np.ascontiguousarray(x)
