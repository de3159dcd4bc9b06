"""Loads of the trial, each a table of one value for each sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from quell.signals import Signal
from quell.types import Vector

Rng = np.random.Generator

# From rest to a constant level in so many lags of the observer. The level is there before the load
# varies, and slow enough not to decide the RMS error of the run. Chosen by hand.
_LEVEL_LAGS = 30.0


@dataclass(frozen=True, eq=False)
class Table(Signal):
    """A value for each sample of ``dt`` [s]; the last one holds."""

    values: Vector
    dt: float

    def evaluate(self, t: Vector) -> Vector:
        """Return the values of the samples at ``t``."""
        at = np.rint(t / self.dt).astype(np.int64)
        return np.asarray(self.values[np.clip(at, 0, self.values.size - 1)])


def _sine(t: Vector, rng: Rng, omega: float) -> Vector:
    return np.sin(omega * t)


def _constant(t: Vector, rng: Rng, omega: float) -> Vector:
    return np.ones_like(t)


def _ramp(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return ramps up and, after a hold, down again."""
    end = t[-1] if t.size else 1.0
    corners = np.sort(rng.uniform(0.0, end, 4))
    return np.interp(t, [0.0, *corners, end], [0.0, 0.0, 3.0, 3.0, -1.0, -1.0])


def _steps(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return steps at random times to random heights, about one in two periods."""
    end = t[-1] if t.size else 1.0
    count = max(int(end * omega / (4.0 * np.pi)), 1)
    at = np.sort(rng.uniform(0.0, end, count))
    heights = np.append(1.0, rng.uniform(-1.0, 1.0, count))
    return heights[np.searchsorted(at, t, side="right")]


def _coloured(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return white noise through a lag of bandwidth ω; its standard deviation is 1/√2."""
    from scipy.signal import lfilter

    pole = np.exp(-omega * (t[1] - t[0]))
    drive = np.sqrt(0.5 * (1.0 - pole**2)) * rng.standard_normal(t.size)
    return np.asarray(lfilter([1.0], [1.0, -pole], drive))


def _triangle(t: Vector, rng: Rng, omega: float) -> Vector:
    return 2.0 / np.pi * np.arcsin(np.sin(omega * t))


def _square(t: Vector, rng: Rng, omega: float) -> Vector:
    return np.where(np.sin(omega * t) >= 0.0, 1.0, -1.0)


def _modulated(t: Vector, rng: Rng, omega: float) -> Vector:
    slow = omega * rng.uniform(0.03, 0.3)
    return 0.5 * (1.0 + np.sin(slow * t)) * np.sin(omega * t)


def _chirp(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return a sinusoid that moves by two octaves, up or down, over the whole time."""
    share = t / t[-1]
    exponent = rng.choice([-1.0, 1.0]) * (2.0 * share - 1.0)
    step = t[1] - t[0]
    return np.sin(np.cumsum(omega * 2.0**exponent) * step)


def _jumps(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return a sinusoid with jumps in frequency; its phase has none."""
    count = int(rng.integers(1, 5))
    at = np.sort(rng.uniform(0.0, t[-1], count))
    omegas = omega * 2.0 ** rng.uniform(-1.0, 1.0, count + 1)
    step = t[1] - t[0]
    return np.sin(np.cumsum(omegas[np.searchsorted(at, t)]) * step)


LOADS: dict[str, Callable[[Vector, Rng, float], Vector]] = {
    "constant": _constant,
    "ramp": _ramp,
    "steps": _steps,
    "coloured": _coloured,
    "sine": _sine,
    "triangle": _triangle,
    "square": _square,
    "amplitude-modulated": _modulated,
    "chirp": _chirp,
    "frequency jumps": _jumps,
}
"""A load of amplitude 1 by its kind: functions of the time since its start, and of a frequency."""


def load_table(
    kind: str,
    t: Vector,
    rng: Rng,
    *,
    omega: float,
    amplitude: float,
    level: float,
    start: float,
    lag: float,
) -> Vector:
    """Return a load at the times ``t``: a level that is there first, and what varies from start.

    ``lag`` is that of the observer [s].
    """
    rise = np.clip(t / (_LEVEL_LAGS * lag), 0.0, 1.0)
    table = level * 0.5 * (1.0 - np.cos(np.pi * rise))
    later = t >= start
    table[later] += amplitude * LOADS[kind](t[later] - start, rng, omega)
    return table
