"""A linear law in delta form with compensated sums, for single precision.

An integrator adds a small share of the error to its state. In single precision that share loses
its last digits in the sum, and all of them where it is below a unit of the state's last digit: the
controller then leaves a steady error. So only the increment is calculated, and what rounding takes
from the sum is carried over to the next sample, as in ``observers/delta.py``::

    d  = (A − I) x + B_r r + B_y y + B_u u + c
    x⁺ = x + d,      c⁺ = d − (x⁺ − x)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.controllers.linear.law import LinearLaw, advance_law
from quell.types import Matrix, Vector


class DeltaLaw(NamedTuple):
    """A ``LinearLaw`` with m states and m carries."""

    difference: Matrix  # A − I (m, m)
    B_r: Vector  # (m,)
    B_y: Vector  # (m,)
    B_u: Vector  # (m,)
    C: Vector  # (m,)
    D_r: float  # [u-unit/y-unit]
    D_y: float  # [u-unit/y-unit]


@advance_law.register(DeltaLaw)
def _advance(law: DeltaLaw, x: Vector, work: Vector, r: float, y: float, u: float) -> None:
    for i in range(x.size):
        total = law.B_r[i] * r + law.B_y[i] * y + law.B_u[i] * u + work[i]
        for j in range(x.size):
            total += law.difference[i, j] * x[j]
        work[i] = total
    for i in range(x.size):
        before, increment = x[i], work[i]
        x[i] = before + increment
        work[i] = increment - (x[i] - before)


def delta_law(law: LinearLaw) -> DeltaLaw:
    """Return a law in delta form."""
    return DeltaLaw(law.A - np.eye(law.C.size), *law[1:])
