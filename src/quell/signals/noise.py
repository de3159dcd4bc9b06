"""Band-limited noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from quell import checks
from quell.signals.base import Signal
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
