"""A plant whose output is quantized by an encoder with a finite number of counts a turn.

``y = q floor(y_plant/q + 1/2)`` with ``q = turn/counts``. The counter is zeroed half-way between
two edges, so its error is at most q/2 in both directions. Only the output is quantized, not the
state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import kernel
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


class EncodedPlantModel(NamedTuple):
    """A sampled plant with an encoder."""

    inner: Any  # parameters of the plant without encoder
    resolution: float  # q [y-unit]


@kernel
def quantized(value: float, resolution: float) -> float:
    """Return the multiple of ``resolution`` nearest to ``value``."""
    return resolution * np.floor(value / resolution + 0.5)


@measure.register(EncodedPlantModel)
def _measure(plant: EncodedPlantModel, x: Vector) -> float:
    return quantized(measure(plant.inner, x), plant.resolution)


@advance.register(EncodedPlantModel)
def _advance(
    plant: EncodedPlantModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    advance(plant.inner, x, scratch, t, u, w)


@begin_run.register(EncodedPlantModel)
def _begin_run(plant: EncodedPlantModel, x: Vector, scratch: Vector) -> None:
    begin_run(plant.inner, x, scratch)


@check_run.register(EncodedPlantModel)
def _check_run(plant: EncodedPlantModel, scratch: Vector) -> None:
    check_run(plant.inner, scratch)


@dataclass(frozen=True, eq=False, repr=False)
class EncodedPlant(PlantWrapper):
    """A plant whose output is read by an encoder of ``counts`` a turn.

    Make it with ``encoded``.
    """

    plant: Plant
    counts: int
    turn: float = math.tau  #: y of one turn [y-unit]

    @property
    def resolution(self) -> float:
        """Step of y that one count is [y-unit]."""
        return self.turn / self.counts

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, {self.counts} counts a turn"

    def sampled(self, dt: float, interpret: bool = False) -> EncodedPlantModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        return EncodedPlantModel(self.plant.sampled(dt, interpret), self.resolution)


def encoded(plant: Plant, counts: int, turn: float = math.tau) -> EncodedPlant:
    """Return a plant whose output y, an angle or a position, is read by an encoder.

    Parameters
    ----------
    plant
        any plant.
    counts
        counts of the encoder a turn, with all four edges of its two channels.
    turn
        y of one turn [y-unit]: 2π rad by default, 360 for degrees, the pitch of a screw [mm].

    Raises
    ------
    ValueError
        if ``counts`` is no whole number above zero, ``turn`` is not positive, or ``plant`` is not a
        plant.

    Examples
    --------
    >>> import quell as ql
    >>> seen = ql.plants.encoded(ql.plants.torsional_identified(), counts=16_000)
    >>> round(seen.resolution, 7)
    0.0003927
    """
    check_plant(plant)
    counts = checks.whole("counts", counts, 1)
    return EncodedPlant(plant, counts, checks.positive("turn", turn, "y-unit"))
