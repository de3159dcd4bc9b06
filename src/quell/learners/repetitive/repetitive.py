"""The learner of what repeats with a known period."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from quell import checks
from quell.learners.lag import lag_memory, lag_of, lag_push, startup_samples
from quell.learners.repetitive.kernels import RepetitiveDesign, RepetitiveLoop, RepetitiveMemory
from quell.observers.eso import ESO
from quell.types import Vector

# Most samples of a cycle: 16 MB, and a restart takes a millisecond.
_MOST_SAMPLES = 10**6

# F has forgotten all but 1e-7 after so many lags.
_SETTLING_LAGS = 8.0
# Share of a cycle in which the table of the next one is calculated. Chosen by hand.
_SHARE = 0.25


@dataclass(frozen=True)
class Repetitive:
    """A table of f over the phase of a cycle, learned from repetition to repetition.

    It suits moves that are repeated (``signals.Repeated``), and loads of any shape that repeat with
    a known period: no model of the plant or of the load is needed, but all has to repeat. The first
    cycle is controlled without it. ``kernels.py`` has the equations.

    Parameters
    ----------
    period
        time after which everything repeats [s], a multiple of the observer's dt and at least 10 dt.
        A cycle begins at a start from rest.
    gain
        γ, the share of the error of a cycle that is corrected, in (0, 1). A smaller one averages
        noise over more cycles, and is stable with a plant's gain further above b0.

    Raises
    ------
    ValueError
        for a parameter out of range; ``design`` for a period that is no multiple of dt.

    References
    ----------
    Bristow, Tharayil & Alleyne, *A survey of iterative learning control*, IEEE Control Systems
    Magazine 26 (2006).
    """

    period: float = 1.0
    gain: float = 0.6

    def __post_init__(self) -> None:
        checks.positive("period", self.period, "s")
        checks.positive("gain", self.gain)
        if self.gain >= 1.0:
            raise ValueError(f"gain = {self.gain!r}: must be below 1, for example 0.6")

    def samples(self, dt: float) -> int:
        """Return the number of samples of a cycle.

        Raises
        ------
        ValueError
            if the period is no multiple of dt, shorter than 10 dt or longer than 10⁶ dt.
        """
        count = round(self.period / dt)
        if not 10 <= count <= _MOST_SAMPLES:
            rule = f"must be 10 to {_MOST_SAMPLES} times dt = {dt:g} s"
            raise ValueError(f"period = {self.period!r} s: {rule}")
        # After a million samples the phase is then wrong by less than one.
        if abs(count * dt - self.period) > 1e-6 * dt * count:
            rule = f"must be a multiple of dt = {dt:g} s, for example {count * dt:.12g}"
            raise ValueError(f"period = {self.period!r} s: {rule}")
        return count

    def design(self, observer: ESO, omega_c: float) -> RepetitiveDesign:
        """Return the parameters for an observer; the controller's bandwidth is not used."""
        samples = self.samples(observer.dt)
        lag = lag_of(observer)
        weights = self.gain * correction_weights(observer, lag)
        settling = round(_SETTLING_LAGS * observer.lag_time / observer.dt)
        return RepetitiveDesign(
            lag=lag,
            weights=weights,
            startup=startup_samples(observer),
            settling=settling,
            speed=math.ceil(2.0 * (samples + settling) / (_SHARE * samples)),
            samples=samples,
        )

    def memory(self, parameters: RepetitiveDesign) -> RepetitiveMemory:
        """Return a table of zeros."""
        return RepetitiveMemory(
            table=np.zeros(parameters.samples),
            past=np.zeros(parameters.samples),
            errors=np.zeros(parameters.samples),
            filters=lag_memory(parameters.lag, 2),
            loop=RepetitiveLoop.zeros(),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names: the table is no vector of coefficients."""
        return ()


def correction_weights(observer: ESO, lag: Any) -> Vector:
    """Return the weights of ``(1 + ω²/ω_e²)^k`` (2k + 1,) with k = n//2, ω_e = N/lag.

    They are scaled so that ``|F|²`` times their response is one at most.
    """
    power = observer.order // 2
    share = (observer.estimates / observer.lag_time * observer.dt) ** -2
    weights = np.ones(1)
    for _ in range(power):
        weights = np.convolve(weights, (-share, 1.0 + 2.0 * share, -share))
    # The response of F has decayed after ten lags, that of twice as many samples shows its peak.
    count = 2 ** math.ceil(math.log2(20.0 * observer.lag_time / observer.dt + 16.0))
    memory, pulse = lag_memory(lag, 1), np.zeros(count)
    for i in range(count // 2):
        pulse[i] = lag_push(lag, memory, 0, 1.0 if i == 0 else 0.0)
    angle = np.linspace(0.0, math.pi, count // 2 + 1)
    sharpened = (1.0 + share * (2.0 - 2.0 * np.cos(angle))) ** power
    found: Vector = weights / np.max(sharpened * np.abs(np.fft.rfft(pulse)) ** 2)
    return found
