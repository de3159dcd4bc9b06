"""Han's tracking differentiator: a reference that a plant can follow, and its derivative.

Han, *IEEE Trans. Industrial Electronics* 56, 2009, eqs. (10) and (11)::

    v_1⁺ = v_1 + h v_2,      v_2⁺ = v_2 + h fhan(v_1 − r, v_2, r_0, h_0)

``fhan`` drives the sampled double integrator to the origin in the least time that ``|fhan| ≤ r_0``
allows, and for ``h_0 = h`` without overshoot. A larger ``h_0`` gives a smoother transition and
filters noise in r. The paper prints ``d = h_0 r_0²``, which has the wrong unit: d is compared with
a position, so it must be ``r_0 h_0²``.

Within its acceleration v_1 may need a long time to return from where an absurd reference took it,
and a loop at its limits does not follow it there. So it starts again, from rest at y, when y has
been 100 times nearer to r than v_1 for 1000 samples in a row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.prefilters.prefilter import (
    prefilter,
    restart_if_astray,
    settle,
    write_derivatives,
)
from quell.kernels.dispatch import kernel
from quell.kernels.functions import copysign, sqrt
from quell.kernels.scalars import Scalars
from quell.types import Vector

# A y that follows v_1 is behind it by a small part of the way, and is nearer to r than v_1 for a
# moment only, when r returns to y. Both chosen by hand; after a restart v_1 is where y is.
_FAR = 100.0
_SAMPLES_FAR = 1000.0


class TrackingDesign(NamedTuple):
    """Parameters."""

    acceleration: float  # r_0 [y-unit/s²]
    horizon: float  # h_0 [s]
    dt: float  # h [s]


class TrackingLoop(Scalars):
    """Scalars kept from one sample to the next."""

    far: float  # samples in a row in which y was far nearer to r than v_1


class TrackingMemory(NamedTuple):
    """State."""

    v: Vector  # v_1 [y-unit] and v_2 [y-unit/s] (2,)
    loop: NDArray[TrackingLoop]  # (1,)


@kernel
def fhan(x1: float, x2: float, r0: float, h0: float) -> float:
    """Return the acceleration within ±r0 that takes position x1 and speed x2 to zero fastest."""
    d = r0 * h0 * h0
    a0 = h0 * x2
    y = x1 + a0
    a = a0 + (y if abs(y) <= d else copysign(0.5 * (sqrt(d * (d + 8.0 * abs(y))) - d), y))
    return -r0 * a / d if abs(a) <= d else -copysign(r0, a)


@prefilter.register(TrackingDesign)
def _prefilter(design: TrackingDesign, memory: TrackingMemory, r: float) -> float:
    v = memory.v
    acceleration = fhan(v[0] - r, v[1], design.acceleration, design.horizon)
    v[0] += design.dt * v[1]
    v[1] += design.dt * acceleration
    return float(v[0])


@write_derivatives.register(TrackingDesign)
def _write_derivatives(design: TrackingDesign, memory: TrackingMemory, derivatives: Vector) -> None:
    derivatives[0] = memory.v[1]


@settle.register(TrackingDesign)
def _settle(design: TrackingDesign, memory: TrackingMemory, value: float) -> None:
    memory.v[0], memory.v[1] = value, 0.0
    memory.loop[0].far = 0.0


@restart_if_astray.register(TrackingDesign)
def _restart_if_astray(design: TrackingDesign, memory: TrackingMemory, r: float, y: float) -> None:
    loop, resolved = memory.loop[0], design.acceleration * design.horizon * design.horizon
    if not abs(memory.v[0] - r) > _FAR * max(abs(y - r), resolved):
        loop.far = 0.0
        return
    loop.far += 1.0
    if loop.far >= _SAMPLES_FAR:
        memory.v[0], memory.v[1] = y, 0.0
        loop.far = 0.0


@dataclass(frozen=True)
class TrackingDifferentiator:
    """A prefilter whose output has a bounded second derivative; for use in ``Prefiltered``.

    Parameters
    ----------
    acceleration
        largest second derivative, r_0 [y-unit/s²].
    horizon
        h_0 [s]: by default the sample time, for the shortest transition; larger is smoother.

    Raises
    ------
    ValueError
        for a parameter that is not positive, and in ``design`` for a horizon shorter than a sample.

    Examples
    --------
    >>> profile = TrackingDifferentiator(acceleration=2.0)
    >>> design = profile.design(dt=0.01)
    >>> memory = profile.memory(design)
    >>> [round(prefilter(design, memory, 1.0), 4) for _ in range(3)]
    [0.0, 0.0002, 0.0006]
    """

    acceleration: float
    horizon: float | None = None

    def __post_init__(self) -> None:
        checks.positive("acceleration", self.acceleration, "y-unit/s^2")
        if self.horizon is not None:
            checks.positive("horizon", self.horizon, "s")

    @property
    def derivatives(self) -> int:
        """Number of derivatives of its output: one."""
        return 1

    def design(self, dt: float) -> TrackingDesign:
        """Return the parameters for a sample time [s]."""
        dt = checks.positive("dt", dt, "s")
        horizon = dt if self.horizon is None else float(self.horizon)
        if horizon < dt:
            rule = "must be at least a sample, or the profile would oscillate"
            raise ValueError(f"horizon = {horizon!r} s with dt = {dt!r} s: {rule}")
        return TrackingDesign(float(self.acceleration), horizon, dt)

    def memory(self, design: TrackingDesign) -> TrackingMemory:
        """Return the state at rest at zero."""
        return TrackingMemory(np.zeros(2), TrackingLoop.zeros())
