"""A prefilter that moves the reference to r within limits of speed, acceleration and jerk.

r is the target. When it changes, the quickest move from the present position, speed and
acceleration is planned (``signals/profile.py``). So the reference that the controller gets, and its
first three derivatives, are those of a jerk-limited move at any moment, and it comes to rest at r
exactly.

Within a part of constant jerk the motion is computed from the beginning of the part, so that
rounding does not add up, and in the last one from its end: the way there has no overshoot, not even
of rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.prefilters.prefilter import (
    prefilter,
    settle,
    stopping_point,
    write_derivatives,
)
from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.kernels.scalars import Scalars
from quell.signals.profile import PARTS, moved, plan, stopping_way
from quell.types import Vector

# Rounding of r − p, and of the way of a stop, in units of the last digit of r and p.
_ROUNDING, _ROUNDING_SINGLE = 2e-15, 1e-6
# A part that ends on a sample has ended there, if rounding makes it end later by this share of dt.
_EDGE = 1e-9
# Samples after which the beginning of a part is moved: counts in single precision end at 2^24.
_MOST_SAMPLES = 1e6


class ProfileDesign(NamedTuple):
    """Parameters."""

    v_max: float  # [y-unit/s]
    a_max: float  # [y-unit/s²]
    j_max: float  # [y-unit/s³]
    dt: float  # [s]


class ProfileLoop(Scalars):
    """Scalars kept from one sample to the next."""

    target: float  # of the move
    v_max: float  # the limits with which it was planned
    a_max: float
    j_max: float
    part: float  # index of the part that runs; PARTS at rest
    last: float  # index of the last part with a duration
    samples: float  # since `offset`
    offset: float  # time in the part, when samples were counted from [s]
    p_begin: float  # position, speed and acceleration at the beginning of the part
    v_begin: float
    a_begin: float
    p: float  # reference of this sample, and its derivatives
    v: float
    a: float
    jerk: float


class ProfileMemory(NamedTuple):
    """State."""

    times: Vector  # durations of the parts (PARTS,) [s]
    jerks: Vector  # their jerks (PARTS,) [y-unit/s³]
    loop: NDArray[ProfileLoop]  # (1,)


@prefilter.register(ProfileDesign)
def _prefilter(design: ProfileDesign, memory: ProfileMemory, r: float) -> float:
    loop = memory.loop[0]
    if loop.part < PARTS:
        loop.samples += 1.0
        _advance(design, memory)
    changed = loop.v_max != design.v_max or loop.a_max != design.a_max
    if r != loop.target or changed or loop.j_max != design.j_max:
        _begin(design, memory, r)
    return loop.p


@kernel
def _begin(design: ProfileDesign, memory: ProfileMemory, r: float) -> None:
    """Plan the move from here to r."""
    loop, times = memory.loop[0], memory.times
    rounding = (_ROUNDING_SINGLE if is_single(loop.p) else _ROUNDING) * (abs(r) + abs(loop.p))
    distance = r - loop.p
    loop.v_max, loop.a_max, loop.j_max = design.v_max, design.a_max, design.j_max
    plan(
        times, memory.jerks, loop.v, loop.a, distance, rounding,
        design.v_max, design.a_max, design.j_max,
    )  # fmt: skip
    loop.target = r
    loop.p_begin, loop.v_begin, loop.a_begin = loop.p, loop.v, loop.a
    loop.samples = loop.offset = loop.part = loop.last = 0.0
    for i in range(PARTS):
        if times[i] > _EDGE * design.dt:
            loop.last = i
    _advance(design, memory)


@kernel
def _advance(design: ProfileDesign, memory: ProfileMemory) -> None:
    """Set the reference and its derivatives to those of this sample."""
    loop = memory.loop[0]
    part, t, p, v, a = _part_of(design, memory, loop.samples)
    if part > loop.part:
        loop.part, loop.offset, loop.samples = part, t, 0.0
        loop.p_begin, loop.v_begin, loop.a_begin = p, v, a
    if part > loop.last:
        loop.part = PARTS
    loop.p, loop.v, loop.a, loop.jerk = _motion(memory, part, t, p, v, a)
    if loop.samples >= _MOST_SAMPLES:
        loop.p_begin, loop.v_begin, loop.a_begin = loop.p, loop.v, loop.a
        memory.times[min(int(part), memory.times.size - 1)] -= t
        loop.offset = loop.samples = 0.0


@kernel
def _part_of(
    design: ProfileDesign, memory: ProfileMemory, samples: float
) -> tuple[float, float, float, float, float]:
    """Return the part after some samples, the time in it, and the motion at its beginning."""
    loop, times = memory.loop[0], memory.times
    part, t = loop.part, loop.offset + samples * design.dt
    p, v, a = loop.p_begin, loop.v_begin, loop.a_begin
    for i in range(PARTS):
        if part == i and t >= times[i] - _EDGE * design.dt:
            way, v, a = moved(v, a, memory.jerks[i], times[i])
            p += way
            t -= times[i]
            part += 1.0
    return part, t, p, v, a


@kernel
def _motion(
    memory: ProfileMemory, part: float, t: float, p: float, v: float, a: float
) -> tuple[float, float, float, float]:
    """Return position, speed, acceleration, jerk at a time t in a part that begins with p, v, a."""
    loop = memory.loop[0]
    if part > loop.last:
        return loop.target, 0.0, 0.0, 0.0
    jerk = memory.jerks[int(part)]
    if part == loop.last:
        left = memory.times[int(part)] - t
        way = jerk * left * left * left / 6.0
        return loop.target - way, 0.5 * jerk * left * left, -jerk * left, jerk
    way, v, a = moved(v, a, jerk, t)
    return p + way, v, a, jerk


@write_derivatives.register(ProfileDesign)
def _write_derivatives(design: ProfileDesign, memory: ProfileMemory, derivatives: Vector) -> None:
    loop = memory.loop[0]
    derivatives[0], derivatives[1], derivatives[2] = loop.v, loop.a, loop.jerk


@stopping_point.register(ProfileDesign)
def _stopping_point(design: ProfileDesign, memory: ProfileMemory) -> float:
    # A stop begins in the next sample.
    loop = memory.loop[0]
    if loop.part >= PARTS:
        return loop.target
    part, t, p, v, a = _part_of(design, memory, loop.samples + 1.0)
    p, v, a, _ = _motion(memory, part, t, p, v, a)
    return p + stopping_way(v, a, design.a_max, design.j_max)


@settle.register(ProfileDesign)
def _settle(design: ProfileDesign, memory: ProfileMemory, value: float) -> None:
    loop = memory.loop[0]
    loop.p = loop.target = value
    loop.v = loop.a = loop.jerk = 0.0
    loop.v_max, loop.a_max, loop.j_max = design.v_max, design.a_max, design.j_max
    loop.part = PARTS


@dataclass(frozen=True)
class ProfileGenerator:
    """A prefilter that moves to r within limits of speed, acceleration and jerk, on line.

    For use in ``Prefiltered``: r of each step is the target, which may change in any sample, also
    while the axis moves. The reference then follows the quickest move from its present position,
    speed and acceleration, and comes to rest at the target exactly. Its speed, acceleration and
    jerk are derivatives for a controller with feedforward; higher ones are zero.

    To stop as soon as the limits allow, give ``Prefiltered.stopping_point`` as r.

    Parameters
    ----------
    v_max, a_max, j_max
        limits of speed [y-unit/s], acceleration [y-unit/s²] and jerk [y-unit/s³] of the reference.

    Raises
    ------
    ValueError
        for a limit that is not positive.

    Notes
    -----
    Limits that become lower while the axis moves (``NAME_retune`` of exported code) act at once: a
    speed above its limit is reduced first; an acceleration above its limit is not raised.

    It is for targets that stand still for some samples. One that moves in each sample is followed,
    too, within the limits, but with a jerk that alternates, which feedforward passes on to u: take
    a ``ReferenceModel`` for it, or the derivatives of its formula.

    Examples
    --------
    >>> profile = ProfileGenerator(v_max=2.0, a_max=10.0, j_max=100.0)
    >>> design = profile.design(dt=0.01)
    >>> memory = profile.memory(design)
    >>> [round(prefilter(design, memory, 1.0), 6) for _ in range(4)]
    [0.0, 1.7e-05, 0.000133, 0.00045]
    """

    v_max: float
    a_max: float
    j_max: float

    def __post_init__(self) -> None:
        checks.positive("v_max", self.v_max, "y-unit/s")
        checks.positive("a_max", self.a_max, "y-unit/s²")
        checks.positive("j_max", self.j_max, "y-unit/s³")

    @property
    def derivatives(self) -> int:
        """Number of derivatives of its output: three."""
        return 3

    def design(self, dt: float) -> ProfileDesign:
        """Return the parameters for a sample time [s]."""
        dt = checks.positive("dt", dt, "s")
        return ProfileDesign(float(self.v_max), float(self.a_max), float(self.j_max), dt)

    def memory(self, design: ProfileDesign) -> ProfileMemory:
        """Return the state at rest at zero."""
        memory = ProfileMemory(np.zeros(PARTS), np.zeros(PARTS), ProfileLoop.zeros())
        settle(design, memory, 0.0)
        return memory
