"""A plant with an input delay.

``x' = f(x, u(t − τ), w)`` with ``τ = d dt + l``, ``0 ≤ l < dt``. The state is that of the plant,
followed by the last d values of u, d + 1 with a part l of a sample, newest first. The record shows
this state, and a start from rest sets it to zero.

With a part of a sample the plant sees ``u_(k−d−1)`` for the first l of each sample and ``u_(k−d)``
for the rest: two exact steps of a linear plant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from quell import checks
from quell.kernels.sized import Size
from quell.plants.base import (
    Plant,
    PlantWrapper,
    advance,
    begin_run,
    check_plant,
    check_run,
    measure,
)
from quell.plants.linear import LinearPlant
from quell.types import Vector

# Part of a sample that is rounding. Chosen by hand, as in ``checks.samples``.
_ROUNDING = 1e-6


class DelayedPlantModel(NamedTuple):
    """A sampled plant with a delay of at least one sample."""

    inner: Any  # parameters of the plant without delay
    size: Size  # number of its states


@measure.register(DelayedPlantModel)
def _measure(plant: DelayedPlantModel, x: Vector) -> float:
    return measure(plant.inner, x[: plant.size])


@advance.register(DelayedPlantModel)
def _advance(
    plant: DelayedPlantModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    last = x.size - 1
    arriving = x[last]
    for i in range(last, plant.size, -1):
        x[i] = x[i - 1]
    x[plant.size] = u
    advance(plant.inner, x[: plant.size], scratch, t, arriving, w)


@begin_run.register(DelayedPlantModel)
def _begin_run(plant: DelayedPlantModel, x: Vector, scratch: Vector) -> None:
    begin_run(plant.inner, x[: plant.size], scratch)


@check_run.register(DelayedPlantModel)
def _check_run(plant: DelayedPlantModel, scratch: Vector) -> None:
    check_run(plant.inner, scratch)


class PartlyDelayedModel(NamedTuple):
    """A sampled plant with a delay that has a part of a sample."""

    first: Any  # parameters for the part of a sample in which the older u still acts
    rest: Any  # for the rest of it
    late: float  # length of that part [s]
    size: Size  # number of states of the plant without delay


@measure.register(PartlyDelayedModel)
def _measure_partly(plant: PartlyDelayedModel, x: Vector) -> float:
    return measure(plant.first, x[: plant.size])


@advance.register(PartlyDelayedModel)
def _advance_partly(
    plant: PartlyDelayedModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    last = x.size - 1
    older, newer = x[last], u
    if last > plant.size:
        newer = x[last - 1]
    for i in range(last, plant.size, -1):
        x[i] = x[i - 1]
    x[plant.size] = u
    advance(plant.first, x[: plant.size], scratch, t, older, w)
    advance(plant.rest, x[: plant.size], scratch, t + plant.late, newer, w)


@dataclass(frozen=True, eq=False, repr=False)
class DelayedPlant(PlantWrapper):
    """A plant that u reaches ``samples`` samples of ``dt`` [s] and ``late`` [s] late.

    Make it with ``delayed``.
    """

    plant: Plant
    samples: int
    dt: float
    late: float = 0.0

    @property
    def delay(self) -> float:
        """The whole delay [s]."""
        return self.samples * self.dt + self.late

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, {self.delay:g} s late"

    @property
    def order(self) -> int:
        """Number of states, including the delayed values of u."""
        return self.plant.order + self.samples + (self.late > 0.0)

    def sampled(self, dt: float, interpret: bool = False) -> DelayedPlantModel | PartlyDelayedModel:
        """Return the parameters for the sample time ``dt`` [s] of the delay."""
        if abs(dt - self.dt) > 1e-9 * self.dt:
            raise ValueError(
                f"dt = {dt!r} s: this delayed plant was made for {self.dt!r} s; make another one"
            )
        if self.late > 0.0:
            first, rest = (
                self.plant.sampled(part, interpret) for part in (self.late, dt - self.late)
            )
            return PartlyDelayedModel(first, rest, self.late, self.plant.order)
        return DelayedPlantModel(self.plant.sampled(dt, interpret), self.plant.order)


def delayed(plant: Plant, delay: float, dt: float) -> DelayedPlant:
    """Return a plant that u reaches ``delay`` seconds late.

    Parameters
    ----------
    plant
        any plant.
    delay
        [s]. That of a linear plant may have a part of a sample, which is exact for a u that is held
        for a sample; other plants are solved in whole samples and take whole numbers of them.
    dt
        sample time of the later runs [s]; it decides how many values of u are stored.

    Raises
    ------
    ValueError
        if the delay is not positive, or for a plant that is not linear no whole number of samples;
        or if ``plant`` is not a plant.

    Examples
    --------
    >>> import quell as ql
    >>> late = ql.plants.delayed(ql.plants.two_mass_spring(), delay=0.02, dt=0.01)
    >>> late.order
    6
    """
    check_plant(plant)
    delay, dt = checks.positive("delay", delay, "s"), checks.positive("dt", dt, "s")
    if type(plant) is not LinearPlant:
        rule = ", for a plant that is not linear; or take a smaller dt"
        return DelayedPlant(plant, checks.samples("delay", delay, dt, rule), dt)
    samples = round(delay / dt)
    if abs(delay / dt - samples) <= _ROUNDING:
        return DelayedPlant(plant, samples, dt) if samples else DelayedPlant(plant, 0, dt, delay)
    samples = math.floor(delay / dt)
    return DelayedPlant(plant, samples, dt, delay - samples * dt)
