"""The guard: bounds what a learner changes in the estimate of f by what its past was worth.

**Known exactly.** ``f_plain = Δf̂ + f_L^F = f^F`` is the estimate of an ESO without learner from the
same y and u (``learners/lag.py``). All that a learner changes in the total estimate is

    e_L = f_L − f_L^F = (1 − F) f_L,        f̂ = f_plain + e_L

so the guard decides about e_L, and a constant part of the learner's output g has no effect. One lag
of the observer later it is known what the plain ESO has missed, and what g would have supplied:

    q = F (f − f^F) = f_plain − f_plain^F,        p = F v,        v = g − g^F

**The bound e.** P, the peak of |q|, rises within 0.7 lags and decays over 200. ``e ≤ P`` rises to
|q| as P does; while the learner acts it grows by a factor of 2.7 in five lags at most. So a learner
that causes what it then explains does not raise e at once.

**Withheld.** Friction lets learner and loop keep each other moving: the learner explains much of a
motion that would not be there without it. o ≤ P, the error that is certainly not the learner's,
rises to |q| − 1.5 c_L as P rises to |q|, with the largest recent correction ``c_L ← max(|e_L|,
λ c_L)``. Authority is withheld where q is large beside o, to see whether the motion goes on: with
M, the mean of q² (below), and M_left, that of (q − p)²,

    β = 0  from  M > (2 o)² and M_left > 0.05 (2 o)²  on, until  M < (1.3 o)²

λ is that of ten lags, without authority that of one, so that o soon follows |q| if the error was
not the learner's; if it was, M decays. Only for r ≤ 3: of higher order, what a gap in e_L does to y
is worse. How it ends is the verdict, for r ≤ 2: if M is below (1.3 o)² with the o from which
authority was withheld, the motion went with the learner, and the account (below) is set to its
largest debt, whatever it says that the learner explained.

**Credit.** Each sample in which the learner, bounded, would have reduced the error earns credit,
each in which it would have increased it costs credit; M is the mean of q² over T, which bursts
raise slowly:

    p̄ = clip(p, ±κ_0 e),      C ← clip( C + dt/T_C (2 q p̄ − p̄²) / max(q², M), −1, 1 )
    β = min( clip(2 max(C, C_y), 0, 1),  clip(1 + 100 R, 0, 1),  1.2 (1 − S)/S )

q is an n-th derivative of y, and mostly noise where y has some. C_y is such a credit at y, of ℓ q
and ℓ p̄ in place of q and p̄ (ℓ: account, below), without the eight times: ℓ q changes so slowly
that a close match over 1.5 lags is no evidence. y shows late what q shows at once, so C_y pays what
C pays while ε > 1, that is, while the learner adds to q. Both are −1 while R < −0.01.

C and C_y start at −1. For C, a learner that explains q nearly completely earns up to eight times as
much: 1 + 7 clip(1 − ε/0.35, 0, 1) times, where ε is what it left of q in the last 1.5 lags (below);
a jump of f is seen in q for two lags only. S, the mean share of p² in p² + q² over T, scales down
an output that is larger than what it explains.

**Account.** Credit is soon forgotten: a learner can earn it in twenty lags and spend it in ten,
again and again. And y is q through n integrations: a learner that explains quick changes of f and
adds to slow ones earns credit and harms y. So an account over 300 lags compares what its
corrections did to y with what was missed there, with ``ℓ = (ω_c/(s + ω_c))^r``, as y responds to f.
r is the relative degree of the plant, n where it has no zeros, and ω_c^r the first gain of the law:

    J ← J + ((ℓ q)² − J) dt/300 lags,
    A ← clip( A + (2 ℓq d − 1.5 d² − A) dt/300 lags,  −0.02 J, J )

q is a lag of the observer late, so d is ``ℓ e_L`` through a first-order lag of that time: with
``ℓ e_L`` of now, right corrections of disturbances with a period below some nine lags would count
as harm.

J follows a burst no more quickly than M does, and A does not follow it.

Without the factor 1.5, R = A/J would be the share of the squared error that the learner has
removed; the factor is for plants on which a correction acts more strongly than on the observer's
model. While R < −0.01 the credit is −1: whoever has added one percent to the squared error begins
anew. J follows a load that begins only after some ten lags, so a negative A is compared with M_y,
the mean of (ℓ q)² over T, where that is larger.

**Width.** The bound b is κ_0 e; κ_0 = 1.2, or κ if that is less. After a jump of f, (1 − F) f is
twice what q shows of it, and b clips what would be right. So b is wider, up to κe, for a learner
with R > 0 whose p is close to q:

    ε = mean (q − p)² / mean q²  over T/10, 1.5 lags
    w = clip(R/0.1, 0, 1) clip(2 − 2.5 ε, 0, 1)
    b = (κ_0 + w (κ − κ_0)) e

A learner with ε > 1 adds to the error. From ε = 1.5 on it has less of b on the side to which its
corrections have moved y, the sign of ℓe_L; on the other side it has b, to take them back:

    b_ε = b clip(2 − ε/1.5, 0.3, 1)

**Output.** The target changes by ``β̄ Δg``, so that a change of β over a constant g does nothing,
and what the bound took is made up for while the target is still near:

    target ← target + β̄ (g − g_before),        e_L = clip( target − f_L^F, ±β b )  or b_ε
    f_L = f_L^F + e_L,        target ← target + dt/(7 lags) (f_L − target)

β̄ is β, smoothed over 30 lags: a β that moves with g would rectify it, and the plant integrates
what is constant in e_L. For r ≤ 3 it follows as many times as quickly as a sample earns more, up to
eight: a learner that explains nearly all of q is not what moves its β. At β = 1 it comes nearer by
0.05/30 lags at least, so that it reaches 1.
The constant part of f_L is free. A target that is more than 1000 e from β̄g approaches it by e in
1000 lags, so that rounding errors stay small.

**Without authority** what earlier corrections have done to y is taken back, for ten lags at most;
from then on e_L = 0. With the stages x_i of ℓ e_L, x_1 the first,

    e_L = clip( −Σ_i C(n, i) (a − 1)^i x_i, ±κ_0 e ),        a ω_c = 1.5/lag

places the n poles of ℓ e_L, which are at −ω_c, at −a ω_c, so that it decays within some lags. Where
that asks for more than 4 κ_0 e, a is smaller: a chain of four lags that is pushed to and fro with
all of κ_0 e swings for a hundred lags. A plant with zeros responds to e_L otherwise, in ways that ℓ
does not have: nothing is taken back there. A learner that never had authority has e_L = 0.

For observers with which that recursion is unstable (``correction.is_invertible``), F is here the
filter of a chain of integrators with the same omega_o; for them nothing is certified.

An output that is not finite, or a hundred times larger than f, is cut off within the sample.

docs/theory, "The guard", gives theorem, proof and measurements.
"""

from __future__ import annotations

from quell.guard.base import (
    assess,
    confine,
    limit,
    record_output,
    reset_filters,
    start_again,
    write_channels,
)
from quell.guard.bound import bounds_of, update_bound
from quell.guard.credit import (
    HIGHEST_ORDER,
    authority_of,
    judge,
    quickness,
    removed_share,
    respond,
    withdraw_authority,
)
from quell.guard.reason import Reason
from quell.guard.state import (
    CORRECTED,
    F_L,
    F_PLAIN,
    SHARE,
    TARGET,
    G,
    GuardDesign,
    GuardMemory,
    V,
    carried_sum,
    clear_carry,
    tiny,
)
from quell.kernels.dispatch import is_finite
from quell.kernels.functions import copysign, is_single, sqrt
from quell.kernels.scalars import clear
from quell.learners.lag import lag_push, reset_lag
from quell.types import Vector

# An output that is so many times larger than f is cut off.
_CUT_OFF = 100.0
# With full authority β̄ comes nearer to 1 as if at least so much were missing, and so reaches it.
_LAST_SHARE = 0.05
# The target approaches β̄g only from a distance of so many e on: where it is does not matter, but
# rounding must not.
_FAR = 1000.0

_OUT_OF_BOUNDS, _EXPLODED = int(Reason.OUT_OF_BOUNDS), int(Reason.EXPLODED)
_NOT_FINITE = int(Reason.NOT_FINITE)


@assess.register(GuardDesign)
def _assess(guard: GuardDesign, memory: GuardMemory, f_plain: float) -> None:
    shown, sample = memory.shown, memory.sample[0]
    q, p = f_plain - shown[F_PLAIN], shown[V]
    if not is_finite(q * q + p * p):
        # For example after a measurement near the largest float: its filters hold nothing useful.
        target = sample.target
        reset_filters(guard, memory)
        sample.target, sample.unsettled = target, guard.settling
        return
    shown[F_PLAIN] = lag_push(guard.lag, memory.chain, F_PLAIN, f_plain)
    if q * q + p * p < tiny(guard):
        # At rest nothing is judged: averages that began with zeros would take all that follows for
        # a burst.
        return
    sample.samples += 1.0
    if sample.unsettled > 0.0:
        sample.unsettled -= 1.0
        return
    update_bound(guard, memory, abs(q))
    judge(guard, memory, q, p)


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
        memory.shown[F_L] = f_shown
    f_shown = memory.shown[F_L]
    if not (abs(output) <= most and is_finite(slope)):
        finite = is_finite(output) and is_finite(slope)
        sample.output = min(max(output, -most), most) if finite else 0.0
        sample.reason = _EXPLODED if finite else _NOT_FINITE
        sample.authority = 0.0
        sample.target = f_shown
        clear_carry(memory, TARGET)
        withdraw_authority(memory)
        return confine(guard, memory, f_shown), 0.0, not finite
    before, sample.output = sample.output, output
    if sample.share < 0.0:
        before, sample.share = output, -sample.share
    removed = removed_share(guard, memory)
    authority, sample.reason = authority_of(guard, memory, removed)
    sample.authority = authority
    quick = quickness(guard, memory) if guard.stages <= HIGHEST_ORDER else 1.0
    missing = authority - sample.share
    more = quick * guard.smooth * missing
    if authority >= 1.0:
        more = min(max(more, guard.smooth * _LAST_SHARE), missing)
    sample.share = carried_sum(guard, memory, SHARE, sample.share, more)
    if is_single(guard.forget):
        step = sample.share * (output - before)
        sample.target = carried_sum(guard, memory, TARGET, sample.target, step)
        base = sample.target - sample.share * output
    else:
        base = sample.target - sample.share * before
        sample.target = base + sample.share * output
    least, largest = bounds_of(guard, memory, removed)
    if not least <= sample.target - f_shown <= largest:
        sample.reason = _OUT_OF_BOUNDS if authority > 0.0 else sample.reason
    elif guard.least_slope <= sample.share * slope <= guard.largest_slope:
        return base + sample.share * constant, sample.share * slope, False
    return confine(guard, memory, sample.target), 0.0, False


@confine.register(GuardDesign)
def _confine(guard: GuardDesign, memory: GuardMemory, f_learned: float) -> float:
    least, largest = bounds_of(guard, memory, removed_share(guard, memory))
    shown = memory.shown[F_L]
    return min(max(f_learned, shown + least), shown + largest)


@record_output.register(GuardDesign)
def _record_output(guard: GuardDesign, memory: GuardMemory, f_learned: float) -> None:
    shown, sample = memory.shown, memory.sample[0]
    v = sample.output - shown[G]
    shown[G] = lag_push(guard.lag, memory.chain, G, sample.output)
    shown[V] = lag_push(guard.lag, memory.chain, V, v)
    correction = f_learned - shown[F_L]
    if not guard.invertible:
        shown[F_L] = lag_push(guard.fed_lag, memory.fed, 0, f_learned)
    effect = respond(guard, memory, CORRECTED, correction)
    sample.late_effect += guard.within_lag * (effect - sample.late_effect)
    decay = guard.own_decay if sample.authority > 0.0 else 1.0 - guard.within_lag
    sample.own_peak = max(abs(correction), decay * sample.own_peak)
    if sample.authority > 0.0:
        sample.taking_back = guard.taking_back
        more = guard.leak * (f_learned - sample.target)
        sample.target = carried_sum(guard, memory, TARGET, sample.target, more)
        distance = sample.share * sample.output - sample.target
        if abs(distance) > _FAR * sample.typical_error:
            step = copysign(guard.home * sample.typical_error, distance)
            sample.target = carried_sum(guard, memory, TARGET, sample.target, step)
    else:
        sample.taking_back = max(sample.taking_back - 1.0, 0.0)
        sample.target = f_learned
        clear_carry(memory, TARGET)


@write_channels.register(GuardDesign)
def _write_channels(guard: GuardDesign, memory: GuardMemory, row: Vector) -> int:
    row[0] = memory.sample[0].authority
    row[1] = sqrt(memory.averages[0].square)
    row[2] = sqrt(memory.averages[0].square_left)
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
    sample.output = sample.target = sample.unsettled = 0.0
    sample.own_peak = sample.late_effect = sample.taking_back = 0.0
    # The next output has none before it: it is a constant.
    sample.share = -abs(sample.share)


@start_again.register(GuardDesign)
def _start_again(guard: GuardDesign, memory: GuardMemory) -> None:
    reset_filters(guard, memory)
    clear(memory.averages)
    clear(memory.sample)
    withdraw_authority(memory)
    memory.sample[0].unsettled = guard.settling
