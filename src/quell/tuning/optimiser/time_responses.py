"""Responses of linear loops over time, for objectives and limits of u that are about them.

The closed loop of a sampled plant and a law is linear, so every response is the convolution of a
pulse response with the input. The pulse response ``D, C B, C A B, …`` is computed in blocks: with
``R = (C; C A; …; C A^(b−1))`` and ``A^b``, b terms are one product.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quell.analysis.subsystems import closed_loop
from quell.controllers.linear.law import LinearLaw
from quell.lti.system import System
from quell.plants.sampled import SampledPlant
from quell.tuning.optimiser.laws import law_of
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.structures.base import Structure
from quell.types import DesignWarning, Vector

# Controllers whose responses are kept: those of one difference quotient, and some more.
_KEPT = 64
# Responses last so many radians of the plant's phase crossover, and at most so many samples.
_LASTS, _MOST_SAMPLES = 150.0, 50_000
# Beyond, a response is that of an unstable loop: it would overflow.
_DIVERGED = 1e100


class Inputs(NamedTuple):
    """Inputs of a loop: the reference and the load at the plant's input, sample by sample.

    With the feedforward of a model the loop is that of the errors ``y − r`` and ``u − u_ff``
    (``controllers/adrc/feedforward.py``): the law sees ``y − r`` with a reference of zero, and the
    plant has u_ff besides what the law gives.
    """

    r: Vector  # (k,) [y-unit]
    d: Vector  # (k,) [u-unit]
    u_ff: Vector | None = None  # (k,) [u-unit]

    def of_loop(self) -> tuple[tuple[str, Vector], ...]:
        """Return the inputs of the linear loop by their names in ``closed_loop``."""
        if self.u_ff is None:
            return ("r", self.r), ("d", self.d)
        return ("n", -self.r), ("d", self.d + self.u_ff)


def load_step(plants: PlantSet, size: float = 1.0, duration: float | None = None) -> Inputs:
    """Return a step of the load, by default for 150 radians of the plants' crossover."""
    last = _LASTS / plants.crossover if duration is None else duration
    count = max(min(round(last / plants.dt), _MOST_SAMPLES), 10)
    return Inputs(np.zeros(count), np.full(count, size))


class SetResponses:
    """The responses of plants of a set, kept for the last controllers that were asked for.

    ``members`` are the numbers of these plants, all by default.
    """

    def __init__(
        self, plants: PlantSet, inputs: Inputs, members: Sequence[int] | None = None
    ) -> None:
        self.plants, self.inputs = plants, inputs
        scaled = plants.scaled()
        self._scaled = scaled if members is None else [scaled[i] for i in members]
        self._known: dict[tuple[int, bytes, str], list[Vector]] = {}

    def of(self, structure: Structure, values: Vector, target: str = "y") -> list[Vector]:
        """Return y or u with the controller of values (p,), one array (k,) for each plant."""
        key = id(structure), values.tobytes(), target
        if key not in self._known:
            if len(self._known) >= _KEPT:
                self._known.clear()
            with warnings.catch_warnings():
                # Of controllers on the way of a search; the result's own is made with warnings.
                warnings.simplefilter("ignore", DesignWarning)
                law = law_of(structure.controller(values))
            self._known[key] = [response(p, law, self.inputs, target) for p in self._scaled]
        return self._known[key]


def response(plant: SampledPlant, law: LinearLaw, inputs: Inputs, target: str = "y") -> Vector:
    """Return y or u (k,) of a loop from rest; infinite for an unstable one that overflows."""
    size = inputs.r.size
    total = np.zeros(size)
    if target == "u" and inputs.u_ff is not None:
        total += inputs.u_ff
    for source, given in inputs.of_loop():
        if np.any(given):
            pulse = _pulse(closed_loop(plant, law, source, target), size)
            if not np.max(np.abs(pulse)) < _DIVERGED:
                return np.full(size, np.inf)
            total += _convolved(pulse, given)
    return total


def _convolved(one: Vector, other: Vector) -> Vector:
    """Return the first terms of the convolution of two vectors of the same length."""
    found: Vector
    if np.ptp(other) == 0.0:
        found = other[0] * np.cumsum(one)
        return found
    length = 1 << (2 * one.size - 1).bit_length()
    product = np.fft.rfft(one, length) * np.fft.rfft(other, length)
    found = np.fft.irfft(product, length)[: one.size]
    return found


def _pulse(system: System, size: int) -> Vector:
    """Return ``D, C B, C A B, …`` (size,)."""
    N, B, C, D = System.balanced(*system)
    n = N.shape[0]
    block = max(math.isqrt(size), 1)
    rows, x = np.empty((block, n)), B.copy()
    rows[0] = C
    for i in range(1, block):
        rows[i] = rows[i - 1] + rows[i - 1] @ N
    jump = np.linalg.matrix_power(N + np.eye(n), block)
    count = -(-(size - 1) // block)
    parts = np.empty((count, block))
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(count):
            parts[i] = rows @ x
            x = jump @ x
    return np.append(D, parts.ravel()[: size - 1])
