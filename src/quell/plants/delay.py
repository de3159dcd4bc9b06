"""A plant with an input delay.

``x' = f(x, u(t − τ), w)`` with ``τ = d dt``. The state is that of the plant, followed by the last d
values of u, newest first. The record shows this state, and a start from rest sets it to zero.
"""

from __future__ import annotations

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
from quell.types import Vector


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


@dataclass(frozen=True, eq=False, repr=False)
class DelayedPlant(PlantWrapper):
    """A plant whose control signal arrives ``samples`` samples of ``dt`` [s] late.

    Make it with ``delayed``.
    """

    plant: Plant
    samples: int
    dt: float

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, {self.samples * self.dt:g} s late"

    @property
    def order(self) -> int:
        """Number of states, including the delayed values of u."""
        return self.plant.order + self.samples

    def sampled(self, dt: float, interpret: bool = False) -> DelayedPlantModel:
        """Return the parameters for the sample time ``dt`` [s] of the delay."""
        if abs(dt - self.dt) > 1e-9 * self.dt:
            raise ValueError(
                f"dt = {dt!r} s: this delayed plant was made for {self.dt!r} s; make another one"
            )
        return DelayedPlantModel(self.plant.sampled(dt, interpret), self.plant.order)


def delayed(plant: Plant, delay: float, dt: float) -> DelayedPlant:
    """Return a plant that u reaches ``delay`` seconds late.

    Parameters
    ----------
    plant
        any plant.
    delay
        [s], at least one sample and a whole number of samples.
    dt
        sample time of the later runs [s]; it decides how many values of u are stored.

    Raises
    ------
    ValueError
        if the delay is shorter than a sample or no whole number of samples, or ``plant`` is not a
        plant.

    Examples
    --------
    >>> import quell as ql
    >>> late = ql.plants.delayed(ql.plants.two_mass_spring(), delay=0.02, dt=0.01)
    >>> late.order
    6
    """
    check_plant(plant)
    checks.positive("delay", delay, "s")
    samples = checks.samples("delay", delay, checks.positive("dt", dt, "s"))
    return DelayedPlant(plant, samples, float(dt))
