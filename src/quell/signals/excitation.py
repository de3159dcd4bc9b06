"""Band-limited noise.

Signals that excite a whole band: a pseudo-random binary sequence, a sum of sinusoids.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from quell import checks
from quell.signals.shapes import EDGE_TOLERANCE, Constant, Signal
from quell.types import Vector

# Each block of draws has its own generator, so any interval of time can be evaluated alone. The
# size decides which draws a seed gives, so it must not change.
_BLOCK = 4096
# In a range of more blocks than this, those that are used are evaluated one by one. Chosen by hand;
# results do not depend on it.
_BLOCKS_AT_ONCE = 64


@dataclass(frozen=True)
class BandLimitedNoise(Signal):
    """White noise whose draws are held, as in Simulink's block "Band-Limited White Noise".

    Parameters
    ----------
    power
        the height of the power spectral density [unit²/Hz]; the variance of a draw is
        ``power / sample_time``.
    sample_time
        time for which each draw is held [s]; the spectrum is flat well below π / sample_time rad/s.
    seed
        of the draws; the same seed gives the same bits for the same time.
    """

    power: float = 1e-12
    sample_time: float = 0.01
    seed: int = field(default=0)

    def __post_init__(self) -> None:
        checks.non_negative("power", self.power)
        checks.positive("sample_time", self.sample_time, "s")
        checks.whole("seed", self.seed, 0)

    def evaluate(self, t: Vector) -> Vector:
        """Return the draws that are held at ``t``; zero for negative times."""
        if not t.size:
            return np.zeros(t.shape)
        count = t * (1.0 / self.sample_time)
        count += 1.0 + 1e-6
        low, high = float(count.min()), float(count.max())
        if not max(-low, high) < 2.0**52:
            most = float(np.max(np.abs(t)))
            raise ValueError(f"sample_time = {self.sample_time!r}: too short to count {most:g} s")
        index = count.astype(np.int64)  # floor, for times from 0 on
        first, last = (int(low) - 1) // _BLOCK, (int(high) - 1) // _BLOCK
        if last - first > _BLOCKS_AT_ONCE:
            which = (index - 1) // _BLOCK
            values = np.empty(t.shape)
            for block in np.unique(which):
                values[which == block] = self.evaluate(t[which == block])
            return values
        blocks = [_draws(self.seed, block) for block in range(first, last + 1)]
        draws = blocks[0] if first == last else np.concatenate(blocks)
        index -= 1 + first * _BLOCK
        return (math.sqrt(self.power / self.sample_time) * draws)[index]

    def seeded(self, seed: int) -> Signal:
        """Return the same noise from another seed."""
        return replace(self, seed=seed)


@lru_cache(maxsize=16)
def _draws(seed: int, block: int) -> Vector:
    """Return a block of draws; zeros for negative times."""
    if block < 0:
        return np.zeros(_BLOCK)
    draws = np.random.default_rng([seed, block]).standard_normal(_BLOCK)
    draws.flags.writeable = False
    return draws


# By the number of bits, the stages whose sum is fed back for the longest period (Golomb, *Shift
# Register Sequences*, 1967).
_TAPS = {
    2: (2, 1), 3: (3, 2), 4: (4, 3), 5: (5, 3), 6: (6, 5), 7: (7, 6), 8: (8, 6, 5, 4), 9: (9, 5),
    10: (10, 7), 11: (11, 9), 12: (12, 11, 10, 4), 13: (13, 12, 11, 8), 14: (14, 13, 12, 2),
    15: (15, 14), 16: (16, 15, 13, 4), 17: (17, 14), 18: (18, 11), 19: (19, 18, 17, 14),
    20: (20, 17),
}  # fmt: skip


@dataclass(frozen=True)
class PRBS(Signal):
    """A pseudo-random binary sequence of ``±amplitude`` from a shift register.

    It repeats after ``(2^bits − 1) step`` seconds. Over a period its autocorrelation is 1 at lag 0
    and ``−1/(2^bits − 1)`` at all others (Golomb 1967): all its lines up to about ``2.8/step``
    rad/s have the same power within 3 dB, and no signal has more power for its peak.

    Parameters
    ----------
    amplitude
        half of the difference of its two values.
    bits
        length of the register, 2 to 20.
    step
        time for which each value is held [s].
    start
        time of its start [s]; it is zero before.
    seed
        index of its first value in the sequence; the seed of a scenario does not change it.
    """

    amplitude: float = 1.0
    bits: int = 10
    step: float = 0.05
    start: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        checks.finite("amplitude", self.amplitude)
        checks.whole("bits", self.bits, min(_TAPS), max(_TAPS))
        checks.positive("step", self.step, "s")
        checks.finite("start", self.start)
        checks.whole("seed", self.seed, 0)

    @property
    def period(self) -> float:
        """Time after which it repeats [s]."""
        return (2**self.bits - 1) * self.step

    def evaluate(self, t: Vector) -> Vector:
        """Return the sequence."""
        since = (t - self.start + EDGE_TOLERANCE) / self.step
        which = np.floor(since).astype(np.int64) + self.seed
        values = _sequence(self.bits)[which % (2**self.bits - 1)]
        return np.where(since >= 0.0, self.amplitude * values, 0.0)

    def derivative(self) -> Signal:
        """Return zero."""
        return Constant(0.0)


@lru_cache(maxsize=4)
def _sequence(bits: int) -> Vector:
    """Return a period of the sequence, ±1.

    A value is the sum of those ``tap`` places before it, and then, as polynomials over two elements
    are squared term by term, also the sum of those ``2 tap``, ``4 tap``, … places before it. So the
    values are made in blocks that double.
    """
    taps, stride, done = _TAPS[bits], 1, bits
    values = np.ones(2**bits - 1, dtype=np.uint8)
    while done < values.size:
        if done >= 2 * bits * stride:
            stride *= 2
        end = min(done + min(taps) * stride, values.size)
        values[done:end] = 0
        for tap in taps:
            values[done:end] ^= values[done - tap * stride : end - tap * stride]
        done = end
    sequence: Vector = 2.0 * values - 1.0
    sequence.flags.writeable = False
    return sequence


@dataclass(frozen=True, eq=False)
class Multisine(Signal):
    """A sum of sinusoids ``Σ amplitudes_k sin(omegas_k (t − start) + phases_k)``.

    Parameters
    ----------
    omegas
        frequencies [rad/s] (lines,).
    amplitudes
        of each (lines,); 1 by default.
    phases
        of each [rad] (lines,); by default Schroeder's, which keep the peak low
        (``schroeder_phases``).
    start
        time of its start [s]; it is zero before.
    """

    omegas: Any = (1.0, 2.0, 3.0)
    amplitudes: Any = None
    phases: Any = None
    start: float = 0.0

    def __post_init__(self) -> None:
        omegas = checks.positive_vector("omegas", self.omegas)
        if not omegas.size:
            raise ValueError("omegas is empty: must have at least one frequency [rad/s]")
        amplitudes, phases = np.ones(omegas.size), self.phases
        if self.amplitudes is not None:
            amplitudes = checks.vector("amplitudes", self.amplitudes, omegas.size)
        if phases is None:
            phases = schroeder_phases(amplitudes)
        phases = checks.vector("phases", phases, omegas.size)
        for name, value in (("omegas", omegas), ("amplitudes", amplitudes), ("phases", phases)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        checks.finite("start", self.start)

    def evaluate(self, t: Vector) -> Vector:
        """Return the sum."""
        since, total = t - self.start, np.zeros(t.shape)
        lines = np.transpose([self.omegas, self.amplitudes, self.phases]).tolist()
        for omega, amplitude, phase in lines:
            total += amplitude * np.sin(omega * since + phase)
        return np.where(since >= -EDGE_TOLERANCE, total, 0.0)

    def derivative(self) -> Signal:
        """Return the sum of the derivatives."""
        amplitudes, phases = self.amplitudes * self.omegas, self.phases + 0.5 * math.pi
        return Multisine(self.omegas, amplitudes, phases, self.start)


def schroeder_phases(amplitudes: Vector) -> Vector:
    """Return phases (lines,) [rad] that keep the peak of a sum of sines low.

    ``φ_k = π/2 − 2π Σ_{j<k} (k − j) p_j`` with the lines' shares p of the power (Schroeder, *IEEE
    Trans. Information Theory* 16, 1970, eq. (11)): the group delay of each line is its share of the
    period, as in a sweep. Cosines, hence the π/2, have a crest factor of 1.7, sines of 1.9.
    """
    share = amplitudes**2 / max(float(np.sum(amplitudes**2)), np.finfo(float).tiny)
    delay = np.concatenate([[0.0], np.cumsum(share)[:-1]])
    return np.mod(0.5 * math.pi - 2.0 * math.pi * np.cumsum(delay), 2.0 * math.pi)
