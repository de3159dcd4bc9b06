"""A plant whose output is counted: an encoder has a finite number of counts a turn.

``y = q floor(y_plant/q + 1/2)`` with ``q = 2π/counts``. The counter is set to zero half-way between two edges, so that it errs by at most
q/2 to either side. Between two edges the plant moves unseen; its state is as fine as ever.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import kernel
from quell.plants.base import Plant, PlantWrapper, advance, check_plant, measure
from quell.types import Vector


class EncodedPlantModel(NamedTuple):
    """A sampled plant behind an encoder."""

    inner: Any
    """The plant's own parameters."""
    resolution: float
    """q [y-unit]."""


@kernel
def quantized(value: float, resolution: float) -> float:
    """Return the multiple of ``resolution`` next to ``value``: what a counter, or a converter, makes of it."""
    return resolution * np.floor(value / resolution + 0.5)


@measure.register(EncodedPlantModel)
def _measure(plant: EncodedPlantModel, x: Vector) -> float:
    return quantized(measure(plant.inner, x), plant.resolution)


@advance.register(EncodedPlantModel)
def _advance(
    plant: EncodedPlantModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    advance(plant.inner, x, scratch, t, u, w)


@dataclass(frozen=True, eq=False)
class EncodedPlant(PlantWrapper):
    """A plant whose output [rad] an encoder of ``counts`` a turn measures; make it with ``encoded``."""

    plant: Any
    counts: int

    @property
    def resolution(self) -> float:
        """What one count is [rad]."""
        return math.tau / self.counts

    @property
    def name(self) -> str:
        """What tables and plots call it."""
        return f"{self.plant.name}, {self.counts} counts a turn"

    def sampled(self, dt: float, interpret: bool = False) -> EncodedPlantModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        return EncodedPlantModel(self.plant.sampled(dt, interpret), self.resolution)


def encoded(plant: Plant, counts: int) -> EncodedPlant:
    """Return a plant whose y, an angle [rad], is read off an encoder.

    Parameters
    ----------
    plant
        any plant.
    counts
        how many the encoder gives a turn, all four edges of its two channels counted.

    Raises
    ------
    ValueError
        for counts that are no whole number above zero, and for something that is no plant.

    Examples
    --------
    >>> import quell as ql
    >>> seen = ql.plants.encoded(ql.plants.torsional_identified(), counts=16_000)
    >>> round(seen.resolution, 7)
    0.0003927
    """
    check_plant(plant)
    return EncodedPlant(plant, checks.whole("counts", counts, 1))
