"""Linear controllers of two degrees of freedom in discrete time: one kernel for every linear law there is."""

from __future__ import annotations

from typing import NamedTuple

from quell.types import Matrix, Vector


class LinearLaw(NamedTuple):
    """A sampled linear law of m states that is told what was really applied.

    ::

        u_wished = C x + D_r r + D_y y          u = limited(u_wished)
        x⁺       = A x + B_r r + B_y y + B_u u

    Without limits, u is u_wished and the law is the linear system with A + B_u C and so on. B_u is what keeps it from winding up.
    """

    A: Matrix
    """(m, m)."""
    B_r: Vector
    """(m,)."""
    B_y: Vector
    """(m,)."""
    B_u: Vector
    """(m,)."""
    C: Vector
    """(m,)."""
    D_r: float
    D_y: float
