"""Kernels of repetitive learning: f over the phase of a cycle, corrected from cycle to cycle.

The output is a table g with one number for each sample of the cycle. What it leaves is known one
lag of the observer late, and smoothed (``learners/lag.py``):

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

from typing import Any, NamedTuple

from numpy.typing import NDArray

from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import is_single
from quell.kernels.scalars import Scalars, clear
from quell.kernels.sized import Buffer
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    forget,
    no_coefficients,
    predict,
    restart,
)
from quell.learners.lag import lag_push, reset_lag
from quell.types import Matrix, Vector

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
    seen: Vector,
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
    learner: RepetitiveDesign, memory: RepetitiveMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    loop = memory.loop[0]
    return memory.table[_place(memory)] - loop.level, 0.0


@commit.register(RepetitiveDesign)
def _commit(
    learner: RepetitiveDesign, memory: RepetitiveMemory, seen: Vector, u: float, f_learned: float
) -> None:
    loop, size = memory.loop[0], memory.past.size
    half = size + learner.settling
    # After a start from rest, f_plain of a whole cycle comes first.
    if loop.samples - loop.phase >= size and loop.has_begun != 0.0:
        for _ in range(learner.speed):
            if loop.row < half:
                _pass_forwards(learner, memory, int(loop.row) - learner.settling)
            elif loop.row < 2 * half:
                _pass_backwards(learner, memory, 2 * half - 1 - int(loop.row))
            loop.row += 1.0
    loop.samples += 1.0
    loop.phase += 1.0
    if loop.phase == size:
        loop.phase = loop.row = loop.crossed = 0.0
        reset_lag(memory.filters)


@kernel
def _place(memory: RepetitiveMemory) -> int:
    """Return the phase as a place in the tables; it is one of theirs whatever the state has."""
    return min(int(memory.loop[0].phase), memory.past.size - 1)


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
