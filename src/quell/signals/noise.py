"""Noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from quell import checks
from quell.signals.base import Signal
from quell.types import Vector

# Draws come in blocks, each with a generator of its own, so that any stretch of time can be asked for.
_BLOCK = 4096
_BLOCKS_AT_ONCE = 64


@dataclass(frozen=True)
class BandLimitedNoise(Signal):
    """White noise limited in band by holding each draw, as Simulink's block "Band-Limited White Noise".

    Parameters
    ----------
    power
        the height of the power spectral density [unit²/Hz]; the variance of a draw is ``power / sample_time``.
    sample_time
        how long each draw is held [s]; the spectrum is flat well below π / sample_time rad/s.
    seed
        which noise; the same seed gives the same bits whatever times are asked for.
    """

    power: float = 1e-12
    sample_time: float = 0.01
    seed: int = field(default=0)

    def __post_init__(self) -> None:
        checks.non_negative("power", self.power)
        checks.positive("sample_time", self.sample_time, "s")
        checks.whole("seed", self.seed, 0)

    def evaluate(self, t: Vector) -> Vector:
        """Return the draws that hold at ``t``; none are drawn for negative times, which give zero."""
        count = t * (1.0 / self.sample_time) + (1.0 + 1e-6)
        if t.size and not float(np.max(np.abs(count))) < 2.0**52:
            raise ValueError(
                f"sample_time = {self.sample_time!r}: too short to be counted in times of {float(np.max(np.abs(t))):g} s"
            )
        index = count.astype(np.int64) - 1  # floor, for times from 0 on
        first, last = (
            (int(index.min()) // _BLOCK, int(index.max()) // _BLOCK) if t.size else (0, -1)
        )
        blocks = (
            np.arange(first, last + 1)
            if last - first < _BLOCKS_AT_ONCE
            else np.unique(index // _BLOCK)
        )
        values = np.zeros(t.shape)
        sigma = math.sqrt(self.power / self.sample_time)
        for block in blocks[blocks >= 0].tolist():
            place = index - block * _BLOCK
            if blocks.size == 1:
                return sigma * _draws(self.seed, block)[place]
            mine = (place >= 0) & (place < _BLOCK)
            values[mine] = sigma * _draws(self.seed, block)[place[mine]]
        return values

    def seeded(self, seed: int) -> Signal:
        """Return the same noise from another seed."""
        return replace(self, seed=seed)


@lru_cache(maxsize=16)
def _draws(seed: int, block: int) -> Vector:
    draws = np.random.default_rng([seed, block]).standard_normal(_BLOCK)
    draws.flags.writeable = False
    return draws
