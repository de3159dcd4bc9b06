"""``Repetitive``: f over the phase of a cycle, corrected from cycle to cycle.

Kernels of repetitive learning: f over the phase of a cycle, corrected from cycle to cycle.

The output is a table g with one number for each sample of the cycle. What it leaves is known one
lag of the observer late, and smoothed (``learners/base.py``):

    e = f_plain − g^F = (f − g)^F,        e_(i+1) = Σ_j h_j (f − g)_(i−j)

In a cycle that is known this can be undone without delay: an entry is corrected by the errors
*after* it, weighted with the same impulse response h, that is, by F backwards in time:

    g_i ← g_i + γ Σ_j h_j (W e)_(i+1+j)

With W = 1 this is the step of steepest descent of Σ e² (adjoint iterative learning: Owens, Hätönen
& Daley, *Robust monotone gradient-based discrete-time iterative learning control*, Int. J. Robust
and Nonlinear Control 19 (2009)). At each frequency the rest is multiplied from cycle to
cycle by ``1 − γ W |F|²``, whatever the lag. It also decreases if the loop changes the effect of g
by a factor 1 + Δ, for example because b0 is wrong, as long as ``|1 − γ W |F|² (1 + Δ)| < 1``.
W = (1 + ω²/ω_e²)^m, symmetric in time, makes up for a part of ``|F|²`` near the bandwidth of the
observer. Above it the product goes to zero: there nothing is learned, so F itself is the robustness
filter.

In each cycle g^F is calculated forwards from the table as it is, compared with f_plain of the last
cycle, and then the sum backwards, several entries in a sample; so it does not matter how much of g
a guard has let through. Entries that are corrected before they are used act in the same cycle. A
constant of the table is subtracted from the output, so that it does not jump where corrected
entries follow others: a constant is the observer's part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.checks import Described
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import is_single
from quell.kernels.sized import Buffer, Scalars, clear
from quell.learners.base import (
    adapt,
    check_lag,
    coefficients,
    commit,
    forget,
    lag_memory,
    lag_of,
    lag_push,
    meaning,
    no_coefficients,
    predict,
    reset_lag,
    restart,
    startup_samples,
)
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# ---- Kernels of repetitive learning ----

# A larger f_plain follows from absurd measurements: its sums could overflow, also in single
# precision.
_ABSURD, _ABSURD_SINGLE = 1e100, 1e30


class RepetitiveDesign(NamedTuple):
    """Parameters."""

    lag: Any
    weights: Vector  # of e_(k−m) … e_(k+m), symmetric, with γ (2m + 1,)
    startup: int  # samples after a start from rest in which nothing is learned
    settling: int  # samples in which F forgets
    speed: int  # entries that are passed in a sample
    samples: int  # K


class RepetitiveLoop(Scalars):
    """Scalars that are kept from one sample to the next."""

    phase: float  # number of the sample in the cycle
    samples: float  # since the start from rest
    has_begun: float  # 1 after the first sample that was learned from, else 0
    row: float  # row of the two passes over the table
    level: float  # constant that is subtracted from the table
    crossed: float  # 1 if the entry that is used next was corrected in this cycle, else 0


class RepetitiveMemory(NamedTuple):
    """State for a cycle of K samples."""

    table: Buffer  # g (K,)
    past: Buffer  # f_plain of the last K samples, by phase (K,)
    errors: Buffer  # e of the table as it is (K,)
    filters: Matrix  # lag filters forwards and backwards (2, …)
    loop: NDArray[RepetitiveLoop]  # (1,)


@adapt.register(RepetitiveDesign)
def _adapt(
    learner: RepetitiveDesign,
    memory: RepetitiveMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    loop = memory.loop[0]
    absurd = _ABSURD_SINGLE if is_single(loop.level) else _ABSURD
    if loop.samples <= learner.startup or not abs(f_plain) < absurd:
        return
    now = _place(memory)
    memory.past[now] = f_plain
    if loop.has_begun == 0.0:
        # What Δf̂ did not show at the start is taken to be like what it shows first.
        loop.has_begun = 1.0
        for k in range(now):
            memory.past[k] = f_plain


@predict.register(RepetitiveDesign)
def _predict(
    learner: RepetitiveDesign, memory: RepetitiveMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    loop = memory.loop[0]
    return memory.table[_place(memory)] - loop.level, 0.0


@commit.register(RepetitiveDesign)
def _commit(
    learner: RepetitiveDesign,
    memory: RepetitiveMemory,
    estimates: Vector,
    u: float,
    f_learned: float,
) -> None:
    loop, size = memory.loop[0], memory.past.size
    half = size + learner.settling
    # After a start from rest, f_plain of a whole cycle comes first.
    if loop.samples - loop.phase >= size and loop.has_begun != 0.0:
        for _ in range(learner.speed):
            row = min(max(int(loop.row), 0), 2 * half)
            if row < half:
                _pass_forwards(learner, memory, row - learner.settling)
            elif row < 2 * half:
                _pass_backwards(learner, memory, 2 * half - 1 - row)
            loop.row += 1.0
    loop.samples += 1.0
    loop.phase += 1.0
    if loop.phase == size:
        loop.phase = loop.row = loop.crossed = 0.0
        reset_lag(memory.filters)


@kernel
def _place(memory: RepetitiveMemory) -> int:
    """Return the phase as a place in the tables; it is one of theirs whatever the state has."""
    return min(max(int(memory.loop[0].phase), 0), memory.past.size - 1)


@kernel
def _pass_forwards(learner: RepetitiveDesign, memory: RepetitiveMemory, k: int) -> None:
    """Let entry k of the table act on the errors; it is negative before the cycle."""
    size = memory.past.size
    shown = lag_push(learner.lag, memory.filters, 0, memory.table[k % size])
    after = (k + 1) % size
    memory.errors[after] = memory.past[after] - shown


@kernel
def _pass_backwards(learner: RepetitiveDesign, memory: RepetitiveMemory, k: int) -> None:
    """Let error k and those after it correct the entry before k; k ≥ K is after the cycle."""
    loop = memory.loop[0]
    size, reach = memory.past.size, learner.weights.size // 2
    error = 0.0
    for i in range(learner.weights.size):
        error += learner.weights[i] * memory.errors[(k + size + i - reach) % size]
    correction = lag_push(learner.lag, memory.filters, 1, error)
    if 0 < k <= size:
        memory.table[k - 1] += correction
        if loop.crossed == 0.0 and k - 1 <= loop.phase + 1.0:
            loop.crossed = 1.0
            loop.level += correction


@restart.register(RepetitiveDesign)
def _restart(learner: RepetitiveDesign, memory: RepetitiveMemory) -> None:
    clear(memory.loop)
    reset_lag(memory.filters)
    finite = True
    for i in range(memory.table.size):
        finite = finite and is_finite(memory.table[i])
    if not finite:
        _clear_tables(memory)
    memory.loop[0].level = memory.table[0]


@forget.register(RepetitiveDesign)
def _forget(learner: RepetitiveDesign, memory: RepetitiveMemory) -> None:
    _clear_tables(memory)
    restart(learner, memory)


@kernel
def _clear_tables(memory: RepetitiveMemory) -> None:
    for i in range(memory.past.size):
        memory.table[i] = memory.past[i] = memory.errors[i] = 0.0


coefficients.register(RepetitiveDesign)(no_coefficients)


@meaning.register(RepetitiveDesign)
def _meaning(learner: RepetitiveDesign) -> Any:
    return learner.samples


# ---- The learner of what repeats with a known period ----

# Most samples of a cycle: 16 MB, and a restart takes a millisecond.
_MOST_SAMPLES = 10**6

# F has forgotten all but 1e-7 after so many lags.
_SETTLING_LAGS = 8.0
# Share of a cycle in which the table of the next one is calculated. Chosen by hand.
_SHARE = 0.25


@dataclass(frozen=True, repr=False)
class Repetitive(Described):
    """A table of f over the phase of a cycle, learned from repetition to repetition.

    It suits moves that are repeated (``signals.Repeated``), and loads of any shape that repeat with
    a known period: no model of the plant or of the load is needed, but all has to repeat. The first
    cycle is controlled without it. The docstring of this module has the equations.

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
        check_lag(observer, "Repetitive")
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
    return weights / np.max(sharpened * np.abs(np.fft.rfft(pulse)) ** 2)
