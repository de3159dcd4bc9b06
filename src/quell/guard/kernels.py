"""The guard: bounds what a learner changes in the estimate of f by what its past was worth.

**Known exactly.** ``f_plain = Δf̂ + f_L^F = f^F`` is the estimate of an ESO without learner from the
same y and u (``learners/lag.py``). All that a learner changes in the total estimate is

    e_L = f_L − f_L^F = (1 − F) f_L,        f̂ = f_plain + e_L

so the guard decides about e_L, and a constant part of the learner's output g has no effect. One lag
of the observer later it is known what the plain ESO has missed, and what g would have supplied:

    q = F (f − f^F) = f_plain − f_plain^F,        p = F v,        v = g − g^F

**The bound e.** P, the peak of |q|, rises within 0.7 lags and decays over 200. The learner's own
share of q is at most Γ times its largest recent correction, so e counts only what exceeds γ times
that; and while the learner acts, e grows by a factor of 2.7 in five lags at most (METHOD 8), which
costs a fifth of a unit of credit:

    c_L ← max(|e_L|, λ c_L),        e → |q| − γ c_L  where that is larger,        e ≤ min(P, 2.5 o)
    C ← C − 0.2 Δe/e

o ≤ P, the error that is certainly not the learner's, rises to |q| − 5 c_L as P rises to |q|, and to
|q| − c_L while |q| rises so quickly that it is 1.15 P: what learner and loop build up together
grows more slowly. So a learner that causes what it then explains does not raise e again and again.
And credit that was earned with small errors does not suffice for large ones: a learner that
explains them as well earns more than the growth of e costs.

**Credit.** Each sample in which the learner, bounded, would have reduced the error earns credit,
each in which it would have increased it costs credit; M is the mean of q² over T, which bursts
raise slowly:

    p̄ = clip(p, ±κe),        C ← clip( C + dt/T_C (2 q p̄ − p̄²) / max(q², 4 M), −1, 1 )
    β = min( clip(2 C, 0, 1),  clip(1 + 2 C_y, 0, 1),  clip(1 + 100 R, 0, 1),  1.2 (1 − S)/S )

C starts at −1. S, the mean share of p² in p² + q² over T, scales down an output that is larger than
what it explains. C_y is a veto: y is q through n integrations, so a learner that explains quick
changes of f and adds to slow ones earns credit C and harms y. C_y follows the rule of C with ℓ q
and ℓ p̄ in place of q and p̄, over ``T + 5 n/ω_c``, from 0 on. With m = max(n − 2, 1) stages,
``ℓ = (ω_c/(s + ω_c))^m`` shows slow changes as y does, and earlier than y.

**Account.** Credit is soon forgotten: a learner can earn it in twenty lags and spend it in ten,
again and again. So an account over 300 lags compares what its corrections did with what was missed:

    J ← J + ((ℓ q)² − J) dt/300 lags,
    A ← clip( A + (2 ℓq ℓe_L − 1.5 (ℓe_L)² − A) dt/300 lags,  −0.02 J, J )

J follows a burst no more quickly than M does, and A does not follow it; J is at most 10⁴ times the
mean of (ℓ q)² over ``T + 5 n/ω_c``, so that an absurd measurement is forgotten.

Without the factor 1.5, R = A/J would be the share of the squared error that the learner has
removed; the factor is for plants on which a correction acts more strongly than on the observer's
model. While R < −0.01 the credit is −1: whoever has added one percent to the squared error begins
anew. The bound is κe for a learner with R ≥ 0.3, and less for one that has removed less:

    κ_R = κ (ρ + (1 − ρ) clip(R/0.3, 0, 1)),        ρ = 0.7

**Output.** The target changes by ``β̄ Δg``, so that a change of β over a constant g does nothing,
and what the bound took is made up for while the target is still near:

    target ← target + β̄ (g − g_before),        e_L = clip( target − f_L^F, ±β κ_R e ),
    f_L = f_L^F + e_L,        target ← target + dt/(7 lags) (f_L − target)

β̄ is β, smoothed over 30 lags: a β that moves with g would rectify it, and the plant integrates
what is constant in e_L.

For observers with which that recursion is unstable (``correction.is_invertible``), F is here the
filter of a chain of integrators with the same omega_o; for them nothing is certified.

An output that is not finite, or a hundred times larger than f, is cut off within the sample.

docs/theory, "The guard", gives theorem, proof and measurements.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

from quell.guard.base import (
    assess,
    confine,
    limit,
    record_output,
    reset_filters,
    start_again,
    write_channels,
)
from quell.guard.reason import Reason
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import is_single, sqrt
from quell.kernels.scalars import Scalars, clear
from quell.kernels.sized import Flag, Size
from quell.learners.lag import lag_push, reset_lag
from quell.types import Matrix, Vector

# These values and those in ``guard.py`` were chosen by hand on tuning seeds of `quell stress`; it
# judges them as a set on other seeds (docs/theory).
# Credit from which the authority is full; between that and 1 a learner may err for a while.
_FULL_CREDIT = 0.5
# Largest energy of p in units of that of q: p of a good learner is at most a little too large.
_LOUDEST = 1.2
# A single sample costs at most this many times what a perfect one earns.
_WORST_SAMPLE = 3.0
# M counts so many times: a sinusoid then earns half of what the best sample earns.
_MEAN_SQUARES = 4.0
# Samples below this share of P count less for S, because q at rest is noise.
_NOISE = 0.4
# Credit that e costs when it grows by a factor of 2.7 while the learner acts. In the five lags that
# this takes at least, a learner that explains a sinusoidal load earns a quarter.
_GROWTH_COST = 0.2
# Factor of (ℓ e_L)² in the account: the plant's gain may be so many times b0.
_OWN_SQUARES = 1.5
# Share by which a learner may make the squared error larger, and least R, as a multiple of it: R
# comes back from there within 200 lags.
_LOAN, _LARGEST_DEBT = 0.01, 2.0
# Largest J in units of the mean of (ℓ q)² over T + 5 n/ω_c: an absurd past counts for little.
_MOST_PAST = 1e4
# R from which the bound is κe, and share of it that a learner with R ≤ 0 has: ρ.
_PROVEN, _UNPROVEN_BOUND = 0.3, 0.7
# An outlier counts for so many times P.
_OUTLIER = 5.0
# e is at most so many times o; c_L counts so many times for o, and once while |q| is so many times
# P. With 1.2 instead of 1.15 the two worst runs are better still, but honest learners lose much
# where a load begins slowly; with 1.1 and below the worst runs are as bad as without o.
_OWN_GROWTH, _MOST_OWN, _SUDDEN = 2.5, 5.0, 1.15
# An output that is so many times larger than f is cut off.
_CUT_OFF = 100.0
# Avoids division by zero; squares of f are larger in any unit, also those of single precision.
_TINY, _TINY_SINGLE = 1e-200, 1e-30

_TRUSTED, _UNPROVEN, _TOO_LOUD = int(Reason.TRUSTED), int(Reason.UNPROVEN), int(Reason.TOO_LOUD)
_OUT_OF_BOUNDS, _EXPLODED = int(Reason.OUT_OF_BOUNDS), int(Reason.EXPLODED)
_NOT_FINITE = int(Reason.NOT_FINITE)


class GuardDesign(NamedTuple):
    """Parameters of the guard."""

    lag: Any  # lag filter of the observer
    forget: float  # dt/T
    earn: float  # dt/T_C
    stages: Size  # m: order of ℓ
    respond: float  # share by which each of its stages follows in a sample
    forget_effect: float  # dt/(T + 5 n/ω_c)
    forget_account: float  # dt/(300 lags)
    rise: float  # share by which P and e follow a larger |q| in a sample
    decay: float  # share by which P decays in a sample
    growth: float  # largest share by which e grows in a sample while the learner acts
    bound: float  # κ
    own: float  # γ
    own_decay: float  # λ
    smooth: float  # share by which β̄ follows β in a sample
    leak: float  # share of its distance to f_L that the target loses in a sample
    home: float  # share of its distance to β̄g that the target loses in a sample, at most that of e
    settling: float  # samples in which q is wrong after the filters were emptied
    invertible: Flag  # whether f_L = f_L^F + e_L is stable with the filter of the observer
    fed_lag: Any  # lag filter of f_L where it is not
    least_slope: float  # least ∂f_L/∂u that is used; beyond it the output counts as a constant
    largest_slope: float  # largest ∂f_L/∂u that is used


class GuardAverages(Scalars):
    """Averages over past samples."""

    loudness: float  # S
    square: float  # M, mean of q² that grows by a factor of 2.7 in 0.7 lags at most
    effect_square: float  # the same of ℓ q, over T + 5 n/ω_c
    missed: float  # J
    gained: float  # A
    error_plain: float  # mean square of q [(y-unit/s^n)²]
    error_learned: float  # mean square of q − p [(y-unit/s^n)²]


class GuardSample(Scalars):
    """Values of the newest sample."""

    credit: float  # C
    effect_credit: float  # C_y
    authority: float  # β
    share: float  # β̄: β, smoothed
    peak: float  # P [y-unit/s^n]
    typical_error: float  # e [y-unit/s^n]
    outside: float  # o [y-unit/s^n]
    own_peak: float  # c_L [y-unit/s^n]
    output: float  # g [y-unit/s^n]
    begun: float  # 1 if there is an output of a sample before, else 0
    target: float  # target of f_L [y-unit/s^n]
    limit: float  # β κ_R e: bound of |e_L| [y-unit/s^n]
    reason: float  # a Reason
    samples: float  # number of samples so far
    unsettled: float  # samples until q is right again


class GuardMemory(NamedTuple):
    """State of the guard."""

    chain: Matrix  # lag filters of f_plain, g and v (3, …)
    fed: Matrix  # lag filter of f_L (1, …), if it is not that of the observer, else (0, …)
    # Their outputs f_plain^F, g^F, p and f_L^F (4,); in single precision carries, too (7,).
    shown: Vector
    effects: Matrix  # ℓ q, ℓ p̄ and ℓ e_L, stage by stage (3, m) [y-unit/s^n]
    averages: NDArray[GuardAverages]  # (1,)
    sample: NDArray[GuardSample]  # (1,)


# Rows of GuardMemory.chain and, with the last, entries of GuardMemory.shown.
_F_PLAIN, _G, _V, _F_L = range(4)
# Rows of GuardMemory.effects.
_MISSED, _BOUNDED, _CORRECTED = range(3)
# Carries of sums in single precision, the last entries of GuardMemory.shown there.
_TARGET, _SHARE, _PEAK = 4, 5, 6
CARRIES = 3


@kernel
def _sum(
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
def _clear_carry(memory: GuardMemory, place: int) -> None:
    if place < memory.shown.size:
        memory.shown[place] = 0.0


@kernel
def _tiny(guard: GuardDesign) -> float:
    return _TINY_SINGLE if is_single(guard.forget) else _TINY


@assess.register(GuardDesign)
def _assess(guard: GuardDesign, memory: GuardMemory, f_plain: float) -> None:
    shown, averages, sample = memory.shown, memory.averages[0], memory.sample[0]
    q, p = f_plain - shown[_F_PLAIN], shown[_V]
    qq, pp = q * q, p * p
    if not is_finite(qq + pp):
        # For example after a measurement near the largest float: its filters hold nothing useful.
        target = sample.target
        reset_filters(guard, memory)
        sample.target, sample.unsettled = target, guard.settling
        return
    shown[_F_PLAIN] = lag_push(guard.lag, memory.chain, _F_PLAIN, f_plain)
    sample.samples += 1.0
    if sample.unsettled > 0.0:
        sample.unsettled -= 1.0
        return
    _update_bound(guard, memory, abs(q))
    energy = qq + pp
    if energy < _tiny(guard):
        return
    is_new = sample.samples * guard.forget < 1.0
    averages.square = _mean_square(guard, averages.square, qq, guard.forget, is_new)
    averages.error_plain += guard.forget * (qq - averages.error_plain)
    averages.error_learned += guard.forget * ((q - p) * (q - p) - averages.error_learned)
    averages.loudness += (
        guard.forget
        * min(energy / (_NOISE * sample.peak) ** 2, 1.0)
        * (pp / energy - averages.loudness)
    )
    most = guard.bound * sample.typical_error
    bounded = min(max(p, -most), most)
    earned = _earned(q, bounded, averages.square, _tiny(guard))
    sample.credit = min(max(sample.credit + guard.earn * earned, -1.0), 1.0)
    _judge_effect(guard, memory, q, bounded, is_new)


@kernel
def _judge_effect(
    guard: GuardDesign, memory: GuardMemory, q: float, bounded: float, is_new: bool
) -> None:
    """Update C_y with what the learner, bounded, would have done to y, and the account."""
    averages, sample = memory.averages[0], memory.sample[0]
    q = _respond(guard, memory, _MISSED, q)
    bounded = _respond(guard, memory, _BOUNDED, bounded)
    rate, square = guard.forget_effect, q * q
    averages.effect_square = _mean_square(guard, averages.effect_square, square, rate, is_new)
    earned = _earned(q, bounded, averages.effect_square, _tiny(guard))
    sample.effect_credit = min(max(sample.effect_credit + rate * earned, -1.0), 1.0)
    own, rate = memory.effects[_CORRECTED, guard.stages - 1], guard.forget_account
    is_burst = not is_new and rate * (square - averages.missed) > guard.rise * averages.missed
    averages.missed = _mean_square(guard, averages.missed, square, rate, is_new)
    averages.missed = min(averages.missed, _MOST_PAST * averages.effect_square)
    gain = (2.0 * q - _OWN_SQUARES * own) * own
    allowed = _LOAN * averages.missed
    # What a learner did in a burst says nothing, as J does not follow it.
    gain = averages.gained + (0.0 if is_burst else rate * (gain - averages.gained))
    averages.gained = min(max(gain, -_LARGEST_DEBT * allowed), averages.missed)
    if averages.gained < -allowed:
        sample.credit = -1.0


@kernel
def _respond(guard: GuardDesign, memory: GuardMemory, row: int, value: float) -> float:
    """Return ``ℓ value``, which is as slow as y."""
    for i in range(guard.stages):
        memory.effects[row, i] += guard.respond * (value - memory.effects[row, i])
        value = memory.effects[row, i]
    return value


@kernel
def _mean_square(
    guard: GuardDesign, mean: float, square: float, forget: float, is_new: bool
) -> float:
    """Return the mean with a new square; a burst does not let everything else count for nothing."""
    more = forget * (square - mean)
    return mean + (more if is_new else min(more, guard.rise * mean))


@kernel
def _earned(q: float, p: float, mean_square: float, tiny: float) -> float:
    """Return what a sample earns in which q − p is left of q."""
    earned = (2.0 * q - p) * p / max(q * q, _MEAN_SQUARES * mean_square, tiny)
    return max(earned, -_WORST_SAMPLE)


@kernel
def _update_bound(guard: GuardDesign, memory: GuardMemory, error: float) -> None:
    """Update P, o and e with |q|."""
    sample = memory.sample[0]
    peak, size, own = sample.peak, sample.typical_error, sample.own_peak
    # After T an outlier counts for 5 P at most: one bad measurement must not open all bounds.
    if sample.samples * guard.forget >= 1.0:
        error = min(error, _OUTLIER * peak)
    most_own = own if error > _SUDDEN * peak else _MOST_OWN * own
    more = guard.rise * (error - peak) if error > peak else -guard.decay * peak
    peak = _sum(guard, memory, _PEAK, peak, more)
    sample.peak = max(peak, _tiny(guard))
    learner_acts = sample.authority > 0.0
    more = max(guard.rise * (error - guard.own * own - size), 0.0)
    grown = size + (min(more, guard.growth * size) if learner_acts else more)
    more = guard.rise * (error - most_own - sample.outside)
    sample.outside = min(sample.outside + max(more, 0.0), sample.peak)
    grown = min(grown, sample.peak, _OWN_GROWTH * sample.outside)
    if learner_acts and grown > size:
        sample.credit -= _GROWTH_COST * (grown - size) / size
    sample.typical_error = max(grown, _tiny(guard))


@limit.register(GuardDesign)
def _limit(
    guard: GuardDesign,
    memory: GuardMemory,
    f_plain: float,
    f_shown: float,
    constant: float,
    slope: float,
    u_before: float,
) -> tuple[float, float, bool]:
    sample = memory.sample[0]
    output = constant + slope * u_before
    most = _CUT_OFF * max(abs(f_plain), sample.peak)
    if guard.invertible:
        memory.shown[_F_L] = f_shown
    f_shown = memory.shown[_F_L]
    if not (abs(output) <= most and is_finite(slope)):
        finite = is_finite(output) and is_finite(slope)
        sample.output = min(max(output, -most), most) if finite else 0.0
        sample.reason = _EXPLODED if finite else _NOT_FINITE
        sample.authority = sample.limit = sample.begun = 0.0
        sample.target = f_shown
        _clear_carry(memory, _TARGET)
        withdraw_authority(memory)
        return f_shown, 0.0, not finite
    before = sample.output if sample.begun != 0.0 else output
    sample.output, sample.begun = output, 1.0
    removed = memory.averages[0].gained / max(memory.averages[0].missed, _tiny(guard))
    authority, sample.reason = _authority(guard, memory, removed)
    sample.authority = authority
    proven = min(max(removed / _PROVEN, 0.0), 1.0)
    proven = _UNPROVEN_BOUND + (1.0 - _UNPROVEN_BOUND) * proven
    sample.limit = authority * proven * guard.bound * sample.typical_error
    more = guard.smooth * (authority - sample.share)
    sample.share = _sum(guard, memory, _SHARE, sample.share, more)
    if is_single(guard.forget):
        step = sample.share * (output - before)
        sample.target = _sum(guard, memory, _TARGET, sample.target, step)
        base = sample.target - sample.share * output
    else:
        base = sample.target - sample.share * before
        sample.target = base + sample.share * output
    if abs(sample.target - f_shown) > sample.limit:
        sample.reason = _OUT_OF_BOUNDS if authority > 0.0 else sample.reason
    elif guard.least_slope <= sample.share * slope <= guard.largest_slope:
        return base + sample.share * constant, sample.share * slope, False
    return confine(guard, memory, sample.target), 0.0, False


@confine.register(GuardDesign)
def _confine(guard: GuardDesign, memory: GuardMemory, f_learned: float) -> float:
    shown, most = memory.shown[_F_L], memory.sample[0].limit
    return min(max(f_learned, shown - most), shown + most)


@kernel
def _authority(guard: GuardDesign, memory: GuardMemory, removed: float) -> tuple[float, int]:
    """Return β and the reason for it; ``removed`` is R."""
    loudness, sample = memory.averages[0].loudness, memory.sample[0]
    earned = min(sample.credit, _FULL_CREDIT + sample.effect_credit) / _FULL_CREDIT
    earned = min(earned, 1.0 + removed / _LOAN)
    if earned <= 0.0:
        return 0.0, _UNPROVEN
    scaled = _LOUDEST * (1.0 - loudness) / max(loudness, _tiny(guard))
    if scaled < min(earned, 1.0):
        return scaled, _TOO_LOUD
    return (earned, _UNPROVEN) if earned < 1.0 else (1.0, _TRUSTED)


@kernel
def withdraw_authority(memory: GuardMemory) -> None:
    """Set the credit of a learner that has yet to prove itself, and the loudness of one like f."""
    memory.sample[0].credit, memory.sample[0].effect_credit = -1.0, 0.0
    memory.averages[0].loudness = 0.5


@record_output.register(GuardDesign)
def _record_output(guard: GuardDesign, memory: GuardMemory, f_learned: float) -> None:
    shown, sample = memory.shown, memory.sample[0]
    v = sample.output - shown[_G]
    shown[_G] = lag_push(guard.lag, memory.chain, _G, sample.output)
    shown[_V] = lag_push(guard.lag, memory.chain, _V, v)
    correction = f_learned - shown[_F_L]
    if not guard.invertible:
        shown[_F_L] = lag_push(guard.fed_lag, memory.fed, 0, f_learned)
    _respond(guard, memory, _CORRECTED, correction)
    sample.own_peak = max(abs(correction), guard.own_decay * sample.own_peak)
    if sample.limit > 0.0:
        more = guard.leak * (f_learned - sample.target)
        sample.target = _sum(guard, memory, _TARGET, sample.target, more)
        step = guard.home * sample.typical_error
        distance = sample.share * sample.output - sample.target
        more = min(max(guard.home * distance, -step), step)
        sample.target = _sum(guard, memory, _TARGET, sample.target, more)
    else:
        sample.target = f_learned
        _clear_carry(memory, _TARGET)


@write_channels.register(GuardDesign)
def _write_channels(guard: GuardDesign, memory: GuardMemory, row: Vector) -> int:
    row[0] = memory.sample[0].authority
    row[1] = sqrt(memory.averages[0].error_plain)
    row[2] = sqrt(memory.averages[0].error_learned)
    row[3] = memory.sample[0].reason
    return 4


@reset_filters.register(GuardDesign)
def _reset_filters(guard: GuardDesign, memory: GuardMemory) -> None:
    sample = memory.sample[0]
    reset_lag(memory.chain)
    reset_lag(memory.fed)
    reset_lag(memory.effects)
    for i in range(memory.shown.size):
        memory.shown[i] = 0.0
    sample.output = sample.begun = sample.target = 0.0
    sample.limit = sample.own_peak = sample.unsettled = 0.0


@start_again.register(GuardDesign)
def _start_again(guard: GuardDesign, memory: GuardMemory) -> None:
    reset_filters(guard, memory)
    clear(memory.averages)
    clear(memory.sample)
    withdraw_authority(memory)
    memory.sample[0].unsettled = guard.settling
