"""A reference model: a lag between the reference and the loop, with derivatives of its output.

    r_f = ω^m / (s + ω)^m · r,    r_f^(m) = ω^m (r − r_f) − Σ_{i=1}^{m−1} C(m, i) ω^(m−i) r_f^(i)

If as many derivatives are fed forward as the plant has integrators, the ideal loop responds to r as
the model does, for any ``omega_c``: two degrees of freedom, one for the reference and one for
disturbances (Horowitz, *Synthesis of Feedback Systems*, 1963). It is sampled with zero-order hold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.controllers.prefilters.prefilter import prefilter, settle, write_derivatives
from quell.lti.discretize import zero_order_hold
from quell.types import Matrix, Vector


class ReferenceModelDesign(NamedTuple):
    """Parameters, of order m; the coordinates are ``r_f^(i) dt^i``."""

    transition: Matrix  # (m, m)
    input: Vector  # (m,)
    rates: Vector  # coefficients of the state and of r in r_f^(m) (m + 1,)
    dt: float


class ReferenceModelMemory(NamedTuple):
    """State."""

    x: Vector  # (2 m,): the state, and scratch for the next one
    r: Vector  # (1,): the reference of the last sample


@prefilter.register(ReferenceModelDesign)
def _prefilter(design: ReferenceModelDesign, memory: ReferenceModelMemory, r: float) -> float:
    x, m = memory.x, design.input.size
    for i in range(m):
        total = design.input[i] * r
        for j in range(m):
            total += design.transition[i, j] * x[j]
        x[m + i] = total
    for i in range(m):
        x[i] = x[m + i]
    memory.r[0] = r
    return x[0]


@write_derivatives.register(ReferenceModelDesign)
def _write_derivatives(
    design: ReferenceModelDesign, memory: ReferenceModelMemory, derivatives: Vector
) -> None:
    m, unit = design.input.size, 1.0
    highest = design.rates[m] * memory.r[0]
    for i in range(m):
        if i > 0:
            derivatives[i - 1] = memory.x[i] / unit
        highest += design.rates[i] * memory.x[i]
        unit *= design.dt
    derivatives[m - 1] = highest / unit


@settle.register(ReferenceModelDesign)
def _settle(design: ReferenceModelDesign, memory: ReferenceModelMemory, value: float) -> None:
    for i in range(memory.x.size):
        memory.x[i] = 0.0
    memory.x[0] = memory.r[0] = value


@dataclass(frozen=True)
class ReferenceModel:
    """A lag of order m at ``omega`` before a controller, for use in ``Prefiltered``.

    Parameters
    ----------
    omega
        bandwidth [rad/s], at most 1/dt.
    order
        order m, 1 to 8: with feedforward in the controller, the plant's order (relative degree).

    Raises
    ------
    ValueError
        for a bandwidth that is not positive, or in ``design`` too high for the sample time.
    """

    omega: float
    order: int = 2

    def __post_init__(self) -> None:
        checks.positive("omega", self.omega, "rad/s")
        checks.whole("order", self.order, 1, 8)

    @property
    def derivatives(self) -> int:
        """Number of derivatives of its output: m."""
        return self.order

    def design(self, dt: float) -> ReferenceModelDesign:
        """Return the parameters for a sample time [s]."""
        m, rate = self.order, self.omega * checks.positive("dt", dt, "s")
        if rate > 1.0:
            rule = f"omega * dt = {rate:.3g} must be at most 1; lower omega or dt"
            raise ValueError(f"omega = {self.omega!r} rad/s with dt = {dt!r} s: {rule}")
        rates = np.array([-math.comb(m, i) * rate ** (m - i) for i in range(m)])
        A = np.diag(np.ones(m - 1), 1)
        A[-1] = rates
        B = np.zeros((m, 1))
        B[-1] = rate**m
        transition, (gamma,) = zero_order_hold(A, [B], 1.0)
        return ReferenceModelDesign(transition, gamma[:, 0].copy(), np.append(rates, rate**m), dt)

    def memory(self, design: ReferenceModelDesign) -> ReferenceModelMemory:
        """Return the state at rest at zero."""
        return ReferenceModelMemory(np.zeros(2 * design.input.size), np.zeros(1))
