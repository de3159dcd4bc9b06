"""Plants of which each input may be late, and each output may be read by an encoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.sized import Size
from quell.plants.base import (
    PlantWrapper,
    advance,
    all_signals,
    as_input,
    begin_run,
    check_plant,
    check_run,
    inputs_of,
    measure_all,
    outputs_of,
)
from quell.plants.linear import DelayedPlantModel, EncodedPlantModel, quantized
from quell.types import Vector

# ---- Encoders and delays of single channels ----


class EncodedOutputsModel(NamedTuple):
    """A sampled plant with encoders."""

    inner: Any
    resolution: Vector  # q (p,) [y-unit]; zero for an output without encoder


as_input.register(EncodedOutputsModel)(all_signals)


@measure_all.register(EncodedOutputsModel)
def _measure_encoders(plant: EncodedOutputsModel, x: Vector, y: Vector) -> None:
    measure_all(plant.inner, x, y)
    for i in range(plant.resolution.size):
        if plant.resolution[i] > 0.0:
            y[i] = quantized(y[i], plant.resolution[i])


@advance.register(EncodedOutputsModel)
def _advance_encoders(
    plant: EncodedOutputsModel, x: Vector, scratch: Vector, t: float, u: Vector, w: Vector
) -> None:
    advance(plant.inner, x, scratch, t, as_input(plant.inner, u), w)


begin_run.register(EncodedOutputsModel)(begin_run.implementations[EncodedPlantModel])
check_run.register(EncodedOutputsModel)(check_run.implementations[EncodedPlantModel])


@dataclass(frozen=True, eq=False, repr=False)
class EncodedOutputs(PlantWrapper):
    """A plant whose outputs are read by encoders; make it with ``encoded_outputs``."""

    plant: Any
    resolution: tuple[float, ...]  #: step of each output, zero without encoder [y-unit]

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, encoded"

    def sampled(self, dt: float, interpret: bool = False) -> EncodedOutputsModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        return EncodedOutputsModel(self.plant.sampled(dt, interpret), np.array(self.resolution))


def encoded_outputs(plant: Any, resolution: float | Sequence[float]) -> EncodedOutputs:
    """Return a plant with several outputs, each read by an encoder.

    Parameters
    ----------
    plant
        a plant with several outputs.
    resolution
        step of y that one count is, ``turn/counts`` [y-unit]: one for all outputs, or one for each,
        zero for an output without encoder.

    Raises
    ------
    ValueError
        for a negative step, or another number of them than the plant has outputs.
    """
    check_plant(plant)
    count = outputs_of(plant)
    steps = np.full(count, resolution) if np.ndim(resolution) == 0 else resolution
    values = checks.vector("resolution", steps, count)
    if np.any(values < 0.0):
        raise ValueError(f"resolution = {resolution!r}: must not be negative")
    return EncodedOutputs(plant, tuple(values.tolist()))


class DelayedInputsModel(NamedTuple):
    """A sampled plant whose control signals arrive late by whole samples."""

    inner: Any
    size: Size  # number of states of the plant
    waiting: Any  # samples of each control signal (m,), integers


as_input.register(DelayedInputsModel)(all_signals)


@measure_all.register(DelayedInputsModel)
def _measure_late(plant: DelayedInputsModel, x: Vector, y: Vector) -> None:
    measure_all(plant.inner, x[: plant.size], y)


@advance.register(DelayedInputsModel)
def _advance_late(
    plant: DelayedInputsModel, x: Vector, scratch: Vector, t: float, u: Any, w: Vector
) -> None:
    inputs = plant.waiting.size
    arriving = x[x.size - inputs :]  # room for the u that acts now
    first = plant.size
    for i in range(inputs):
        length = plant.waiting[i]
        arriving[i] = u[i] if length == 0 else x[first + length - 1]
        for j in range(length - 1, 0, -1):
            x[first + j] = x[first + j - 1]
        if length > 0:
            x[first] = u[i]
        first += length
    advance(plant.inner, x[: plant.size], scratch, t, as_input(plant.inner, arriving), w)


begin_run.register(DelayedInputsModel)(begin_run.implementations[DelayedPlantModel])
check_run.register(DelayedInputsModel)(check_run.implementations[DelayedPlantModel])


@dataclass(frozen=True, eq=False, repr=False)
class DelayedInputs(PlantWrapper):
    """A plant that its control signals reach late; make it with ``delayed_inputs``."""

    plant: Any
    samples: tuple[int, ...]
    dt: float

    @property
    def order(self) -> int:
        """Number of states, with the control signals on their way and those that act."""
        return int(self.plant.order) + sum(self.samples) + self.inputs

    @property
    def name(self) -> str:
        """Name for tables and plots."""
        return f"{self.plant.name}, inputs late"

    def sampled(self, dt: float, interpret: bool = False) -> DelayedInputsModel:
        """Return the parameters for the sample time ``dt`` [s] of the delays."""
        if abs(dt - self.dt) > 1e-9 * self.dt:
            raise ValueError(
                f"dt = {dt!r} s: this delayed plant was made for {self.dt!r} s; make another one"
            )
        waiting = np.array(self.samples, dtype=np.int64)
        return DelayedInputsModel(self.plant.sampled(dt, interpret), self.plant.order, waiting)


def delayed_inputs(plant: Any, delay: float | Sequence[float], dt: float) -> DelayedInputs:
    """Return a plant with several inputs, each of which reaches it late.

    Parameters
    ----------
    plant
        a plant with several inputs.
    delay
        whole samples of ``dt`` [s]: one for all inputs, or one for each.
    dt
        sample time of the later runs [s].

    Raises
    ------
    ValueError
        for a delay that is no whole number of samples, or another number of them than the plant has
        inputs.
    """
    check_plant(plant)
    dt, count = checks.positive("dt", dt, "s"), inputs_of(plant)
    given = np.full(count, delay) if np.ndim(delay) == 0 else delay
    values = checks.vector("delay", given, count).tolist()
    samples = tuple(
        checks.samples(f"delay[{i}]", value, dt) if value else 0 for i, value in enumerate(values)
    )
    return DelayedInputs(plant, samples, dt)


class ChannelNames(NamedTuple):
    """Names that a plant's signals have where it comes from, in a file for instance; for errors."""

    u: tuple[str, ...] = ()
    y: tuple[str, ...] = ()
    w: tuple[str, ...] = ()


def named(plant: Any, channel: str) -> str:
    """Return the names of the channel ``u``, ``y`` or ``w`` of a plant, `` (a, b)``, or no text.

    They are found behind delays and encoders, too.
    """
    while isinstance(plant, PlantWrapper):
        plant = plant.plant
    names = getattr(getattr(plant, "channel_names", ChannelNames()), channel)
    return f" ({', '.join(names)})" if names else ""
