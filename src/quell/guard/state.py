"""Parameters and state of the guard; ``kernels.py`` has the equations."""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.kernels.scalars import Scalars
from quell.kernels.sized import Flag, Size
from quell.types import Matrix, Vector

# Avoids division by zero; squares of f are larger in any unit, also those of single precision.
_TINY, _TINY_SINGLE = 1e-200, 1e-30


class GuardDesign(NamedTuple):
    """Parameters of the guard."""

    lag: Any  # lag filter of the observer
    forget: float  # dt/T
    earn: float  # dt/T_C
    stages: Size  # r: order of ℓ, the relative degree
    respond: float  # share by which each of its stages follows in a sample
    closing: float  # the same of ℓ e_L, stage by stage, while corrections are taken back
    taking_back: float  # samples without authority in which they are; 0 where ℓ is not the loop's
    forget_account: float  # dt/(300 lags)
    forget_match: float  # 10 dt/T
    rise: float  # share by which P and e follow a larger |q| in a sample
    decay: float  # share by which P decays in a sample
    growth: float  # largest share by which e grows in a sample while the learner acts
    bound: float  # κ
    usual_bound: float  # κ_0: κ of a learner that leaves a good part of the error
    own_decay: float  # λ
    within_lag: float  # share by which d follows ℓ e_L in a sample, with one lag as time constant
    smooth: float  # share by which β̄ follows β in a sample
    leak: float  # share of its distance to f_L that the target loses in a sample
    home: float  # share of e by which a target that is far from β̄g approaches it in a sample
    settling: float  # samples in which q is wrong after the filters were emptied
    invertible: Flag  # whether f_L = f_L^F + e_L is stable with the filter of the observer
    fed_lag: Any  # lag filter of f_L where it is not
    least_slope: float  # least ∂f_L/∂u that is used; beyond it the output counts as a constant
    largest_slope: float  # largest ∂f_L/∂u that is used


class GuardAverages(Scalars):
    """Averages over past samples."""

    loudness: float  # S
    square: float  # M, mean of q² that grows by a factor of 2.7 in 0.7 lags at most
    square_left: float  # the same of (q − p)²
    missed: float  # J
    gained: float  # A
    newest_error: float  # mean of q² over T/10 [(y-unit/s^n)²]
    newest_left: float  # the same of (q − p)²
    seen: float  # mean of (ℓ q)² over T, as M


class GuardSample(Scalars):
    """Values of the newest sample."""

    credit: float  # C
    credit_at_y: float  # C_y
    authority: float  # β
    share: float  # β̄: β, smoothed; negative if there is no output of a sample before
    peak: float  # P [y-unit/s^n]
    typical_error: float  # e [y-unit/s^n]
    outside: float  # o [y-unit/s^n]
    outside_then: float  # o when authority was withheld, 0 while it is not [y-unit/s^n]
    own_peak: float  # c_L [y-unit/s^n]
    late_effect: float  # d: ℓ e_L, as late as q [y-unit/s^n]
    output: float  # g [y-unit/s^n]
    target: float  # target of f_L [y-unit/s^n]
    reason: float  # a Reason
    samples: float  # number of samples so far
    unsettled: float  # samples until q is right again
    taking_back: float  # samples in which corrections are still taken back


class GuardMemory(NamedTuple):
    """State of the guard."""

    chain: Matrix  # lag filters of f_plain, g and v (3, …)
    fed: Matrix  # lag filter of f_L (1, …), if it is not that of the observer, else (0, …)
    # Their outputs f_plain^F, g^F, p and f_L^F (4,); in single precision carries, too (7,).
    shown: Vector
    effects: Matrix  # ℓ q, ℓ e_L and ℓ p̄, stage by stage (3, r) [y-unit/s^n]
    averages: NDArray[GuardAverages]  # (1,)
    sample: NDArray[GuardSample]  # (1,)


# Rows of GuardMemory.chain and, with the last, entries of GuardMemory.shown.
F_PLAIN, G, V, F_L = range(4)
# Rows of GuardMemory.effects.
MISSED, CORRECTED, EXPLAINED = range(3)
# Carries of sums in single precision, the last entries of GuardMemory.shown there.
TARGET, SHARE, PEAK = 4, 5, 6
CARRIES = 3


@kernel
def carried_sum(
    guard: GuardDesign, memory: GuardMemory, place: int, value: float, increment: float
) -> float:
    """Return ``value + increment``; in single precision what rounding takes is carried over.

    Share, target and P move by so little in a sample that rounding would stop them, or change their
    speed.
    """
    if is_single(guard.forget):
        increment += memory.shown[place]
        total = value + increment
        memory.shown[place] = increment - (total - value)
        return total
    return value + increment


@kernel
def clear_carry(memory: GuardMemory, place: int) -> None:
    """Forget what rounding took from a sum, where that is kept."""
    if place < memory.shown.size:
        memory.shown[place] = 0.0


@kernel
def tiny(guard: GuardDesign) -> float:
    """Return what a divisor is at least."""
    return _TINY_SINGLE if is_single(guard.forget) else _TINY
