"""Input shaping: the reference is split into delayed parts whose vibrations of a mode cancel.

For a mode ``s² + 2ζω s + ω²`` with ``ω_d = ω √(1 − ζ²)`` and ``K = exp(−ζπ/√(1 − ζ²))`` (Singer &
Seering, *ASME J. Dynamic Systems, Measurement, and Control* 112, 1990, eqs. (11) and (13))::

    ZV    amplitudes (1, K) / (1 + K)            at the times (0, π/ω_d)
    ZVD   amplitudes (1, 2K, K²) / (1 + K)²      at the times (0, π/ω_d, 2π/ω_d)

ZV leaves no vibration of exactly this mode, ZVD none to first order in an error of ω. Relative to
that after a single impulse, the vibration of a mode after the last of impulses a_i at t_i is::

    V = e^(−ζω t_N) √( (Σ a_i e^(ζω t_i) cos ω_d t_i)² + (Σ a_i e^(ζω t_i) sin ω_d t_i)² )

An impulse between two samples is split over both, linearly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.prefilters.prefilter import prefilter, settle
from quell.kernels.sized import Buffer
from quell.types import Vector

# Limit on memory: 80 MB. Chosen by hand.
_MOST_SAMPLES = 10_000_000


class ShaperDesign(NamedTuple):
    """Impulses on samples; the buffer is one sample longer than the longest delay."""

    delays: NDArray[np.int64]  # in samples
    weights: Vector
    length: int


class ShaperMemory(NamedTuple):
    """The references of the last samples, as a ring."""

    past: Buffer
    at: Vector  # (1,): index of the newest


@prefilter.register(ShaperDesign)
def _prefilter(design: ShaperDesign, memory: ShaperMemory, r: float) -> float:
    at = int(memory.at[0])
    at = at + 1 if at < memory.past.size - 1 else 0
    memory.at[0] = at
    memory.past[at] = r
    total = 0.0
    for i in range(design.delays.size):
        place = at - design.delays[i]
        if place < 0:
            place += design.length
        total += design.weights[i] * memory.past[place]
    return total


@settle.register(ShaperDesign)
def _settle(design: ShaperDesign, memory: ShaperMemory, value: float) -> None:
    for i in range(memory.past.size):
        memory.past[i] = value


@dataclass(frozen=True)
class Shaper:
    """A sequence of impulses that is convolved with the reference; see also ``ZV`` and ``ZVD``.

    Parameters
    ----------
    times
        times of the impulses [s], from 0 on, increasing.
    amplitudes
        their amplitudes, with the sum 1.

    Raises
    ------
    ValueError
        for different numbers of both, times that do not increase from 0, and another sum than 1.
    """

    times: tuple[float, ...]
    amplitudes: tuple[float, ...]

    def __post_init__(self) -> None:
        times = checks.vector("times", self.times)
        amplitudes = checks.vector("amplitudes", self.amplitudes, times.size)
        if times.size == 0 or times[0] != 0.0 or np.any(np.diff(times) <= 0.0):
            raise ValueError(f"times = {self.times!r}: must begin at 0.0 and increase")
        if not math.isclose(float(np.sum(amplitudes)), 1.0, rel_tol=1e-9):
            raise ValueError(f"amplitudes = {self.amplitudes!r}: must add up to 1")
        object.__setattr__(self, "times", tuple(times.tolist()))
        object.__setattr__(self, "amplitudes", tuple(amplitudes.tolist()))

    def residual(self, omega: float, zeta: float = 0.0) -> float:
        """Return the vibration V of a mode after the last impulse; see this file's equation."""
        omega, zeta = _mode(omega, zeta)
        damped = omega * math.sqrt(1.0 - zeta**2)
        vibration = sum(
            a * np.exp(zeta * omega * (t - self.times[-1]) + 1j * damped * t)
            for a, t in zip(self.amplitudes, self.times, strict=True)
        )
        return float(abs(vibration))

    def design(self, dt: float) -> ShaperDesign:
        """Return the impulses on samples of ``dt`` [s].

        Raises ``ValueError`` for a dt that is not positive, or a shaper of more than ten million
        samples.
        """
        if self.times[-1] / checks.positive("dt", dt, "s") > _MOST_SAMPLES:
            rule = f"the shaper's {self.times[-1]:.3g} s must be at most {_MOST_SAMPLES} samples"
            raise ValueError(f"dt = {dt!r} s: {rule}")
        weights: dict[int, float] = {}
        for time, amplitude in zip(self.times, self.amplitudes, strict=True):
            before = math.floor(time / dt + 1e-9)
            share = max(time / dt - before, 0.0)
            parts = (before, (1.0 - share) * amplitude), (before + 1, share * amplitude)
            for place, weight in parts:
                if abs(weight) > 1e-12:  # the rest of a rounded time
                    weights[place] = weights.get(place, 0.0) + weight
        delays = np.array(list(weights), dtype=np.int64)
        return ShaperDesign(delays, np.array(list(weights.values())), max(weights) + 1)

    def memory(self, design: ShaperDesign) -> ShaperMemory:
        """Return a buffer at rest."""
        return ShaperMemory(np.zeros(design.length), np.zeros(1))


def ZV(omega: float, zeta: float = 0.0) -> Shaper:  # noqa: N802 - the field's name
    """Return the zero-vibration shaper of a mode: two impulses, half a period apart.

    Parameters
    ----------
    omega
        undamped frequency of the mode [rad/s].
    zeta
        its damping ratio, 0 to below 1.

    Raises
    ------
    ValueError
        for a frequency or damping out of range.
    """
    half, K = _half_period(omega, zeta)
    return Shaper((0.0, half), (1.0 / (1.0 + K), K / (1.0 + K)))


def ZVD(omega: float, zeta: float = 0.0) -> Shaper:  # noqa: N802
    """Return the ZVD shaper: three impulses, twice as long as ``ZV`` and more robust.

    Parameters and errors as for ``ZV``.
    """
    half, K = _half_period(omega, zeta)
    amplitudes = (1.0 / (1.0 + K) ** 2, 2.0 * K / (1.0 + K) ** 2, (K / (1.0 + K)) ** 2)
    return Shaper((0.0, half, 2.0 * half), amplitudes)


def _mode(omega: float, zeta: float) -> tuple[float, float]:
    omega, zeta = checks.positive("omega", omega, "rad/s"), checks.non_negative("zeta", zeta)
    if zeta >= 1.0:
        raise ValueError(f"zeta = {zeta!r}: must be below 1, or the mode does not vibrate")
    return omega, zeta


def _half_period(omega: float, zeta: float) -> tuple[float, float]:
    omega, zeta = _mode(omega, zeta)
    root = math.sqrt(1.0 - zeta**2)
    return math.pi / (omega * root), math.exp(-zeta * math.pi / root)
