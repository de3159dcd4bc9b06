"""A small loop in which a learner takes part: the same in Python and in the C test.

The plant is a chain of integrators with the controller's own b0, poles at its omega_c, and a
disturbance of the learner's kind, ``x^(n) = b0 u − k·x``, integrated by Euler's method. All numbers
have the precision of the controller, and the order of operations is that of the C program.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.adrc.adrc import ADRC
from quell.controllers.prefilters.prefilter import without_prefilters
from quell.export.c_files import CSource
from quell.export.library.templates import fill

BLOCK = 50
"""Samples of a row: u is compared after the last."""
# Learners wait for two lag times. The kernels are interpreted: some 0.2 ms a sample.
_LAGS, _LEAST, _MOST = 6.0, 600, 2000
_MULTIPLIER, _INCREMENT = 1103515245, 12345  # of C's own example of rand()


class Plant(NamedTuple):
    """The plant and its signals."""

    b0: Any
    gains: tuple[Any, ...]
    dt: Any
    amplitude: Any  # of the reference
    noise: Any  # factor of the random integers
    samples: int


def plant_for(controller: Any, amplitude: float, real: Callable[[Any], Any]) -> Plant | None:
    """Return the plant for a controller; None for one that does not learn."""
    inner = without_prefilters(controller)
    if not isinstance(inner, ADRC) or not inner.parameters.learns:
        return None
    observer = inner.observer
    law = inner.parameters.law
    count = round(_LAGS * observer.lag_time / observer.dt / BLOCK) * BLOCK
    return Plant(
        real(observer.b0),
        tuple(real(gain) for gain in law),
        real(observer.dt),
        real(amplitude),
        real(amplitude / 2.0**27),  # uniform within 2.4e-4 of the amplitude
        min(max(count, _LEAST), _MOST),
    )


class Loop:
    """The plant while it moves."""

    def __init__(self, plant: Plant, real: Callable[[Any], Any]) -> None:
        self.plant, self.real = plant, real
        self.x = [real(0.0)] * len(plant.gains)
        self.seed, self.sample = 1, 0

    def measure(self) -> tuple[Any, Any]:
        """Return r and y of the next sample."""
        plant, real, half = self.plant, self.real, self.plant.samples // 4
        self.seed = (self.seed * _MULTIPLIER + _INCREMENT) & 0x7FFFFFFF
        position = self.sample % (2 * half)
        position = position if position < half else 2 * half - position
        r = plant.amplitude * real(position) / real(half)
        self.sample += 1
        return r, self.x[0] + plant.noise * real((self.seed >> 15) - 32768)

    def advance(self, u: Any) -> None:
        """Move the plant by a sample."""
        plant, x = self.plant, self.x
        with np.errstate(all="ignore"):
            slope = plant.b0 * u
            for gain, value in zip(plant.gains, x, strict=True):
                slope = slope - gain * value
            for i in range(len(x) - 1):
                x[i] = x[i] + plant.dt * x[i + 1]
            x[-1] = x[-1] + plant.dt * slope


def c_code(plant: Plant, write: Callable[[Any], str], real: str, source: CSource) -> str:
    """Return the same loop in C, as a function that plays a block of samples."""
    gains = ", ".join(write(gain) for gain in plant.gains)
    return fill(_CODE, {
        "REAL": real, "NAME": source.name, "ORDER": len(plant.gains), "GAINS": gains,
        "B0": write(plant.b0), "DT": write(plant.dt), "AMPLITUDE": write(plant.amplitude),
        "NOISE": write(plant.noise), "HALF": plant.samples // 4, "BLOCK": BLOCK,
        "DERIVATIVES": f", {write(0.5)} * r" * source.derivatives,
        "MULTIPLIER": _MULTIPLIER, "INCREMENT": _INCREMENT, "ZERO": write(0.0),
    })  # fmt: skip


_CODE = """
/* A loop with a small plant, in which the learner takes part: a block of samples. */
static @REAL@ play_loop(@NAME@_state *state)
{
    static const real gains[@ORDER@] = {@GAINS@};
    static real x[@ORDER@];
    static unsigned long seed = 1;
    static int k;
    real u = @ZERO@;

    for (int n = 0; n < @BLOCK@; n++) {
        int position = k % (2 * @HALF@);
        real r, y, slope;

        seed = (seed * @MULTIPLIER@UL + @INCREMENT@UL) & 0x7fffffffUL;
        position = position < @HALF@ ? position : 2 * @HALF@ - position;
        r = @AMPLITUDE@ * (real)position / (real)@HALF@;
        y = x[0] + @NOISE@ * (real)((int)(seed >> 15) - 32768);
        k++;
        u = @NAME@_step(state, r, y@DERIVATIVES@);
        slope = @B0@ * u;
        for (int i = 0; i < @ORDER@; i++)
            slope -= gains[i] * x[i];
        for (int i = 0; i < @ORDER@ - 1; i++)
            x[i] += @DT@ * x[i + 1];
        x[@ORDER@ - 1] += @DT@ * slope;
    }
    return u;
}
"""
