"""What a learner has earned: credit, veto and account; ``kernels.py`` has their equations."""

from __future__ import annotations

from quell.guard.reason import Reason
from quell.guard.state import BOUNDED, CORRECTED, MISSED, GuardDesign, GuardMemory, tiny
from quell.kernels.dispatch import kernel

# These values and those in ``guard.py`` were chosen by hand on tuning seeds of `quell stress`; it
# judges them as a set on other seeds (docs/theory).
# Credit from which the authority is full; between that and 1 a learner may err for a while.
_FULL_CREDIT = 0.5
# Largest energy of p in units of that of q: p of a good learner is at most a little too large.
_LOUDEST = 1.2
# A single sample costs at most this many times what a perfect one earns.
_WORST_SAMPLE = 3.0
# Below this ε a sample earns more, at ε = 0 so many times as much: a learner that explains all of a
# disturbance has authority after some lags in which the disturbance is seen.
_MATCHING, _QUICK = 0.35, 8.0
# M counts so many times: a sinusoid then earns half of what the best sample earns.
_MEAN_SQUARES = 4.0
# Samples below this share of P count less for S, because q at rest is noise.
_NOISE = 0.4
# Factor of (ℓ e_L)² in the account: the plant's gain may be so many times b0.
_OWN_SQUARES = 1.5
# Share by which a learner may make the squared error larger, and least R, as a multiple of it: R
# comes back from there within 200 lags.
_LOAN, _LARGEST_DEBT = 0.01, 2.0
# Largest J in units of the mean of (ℓ q)² over T + 5 n/ω_c: an absurd past counts for little.
_MOST_PAST = 1e4

_TRUSTED, _UNPROVEN, _TOO_LOUD = int(Reason.TRUSTED), int(Reason.UNPROVEN), int(Reason.TOO_LOUD)


@kernel
def judge(guard: GuardDesign, memory: GuardMemory, q: float, p: float) -> None:
    """Update averages, credit, veto and account with q and p, of which one is not zero."""
    averages, sample = memory.averages[0], memory.sample[0]
    qq, pp = q * q, p * p
    energy = qq + pp
    is_new = sample.samples * guard.forget < 1.0
    averages.square = _mean_square(guard, averages.square, qq, guard.forget, is_new)
    left, rate = (q - p) * (q - p), guard.forget_match
    averages.square_left = _mean_square(guard, averages.square_left, left, guard.forget, is_new)
    averages.loudness += (
        guard.forget
        * min(energy / (_NOISE * sample.peak) ** 2, 1.0)
        * (pp / energy - averages.loudness)
    )
    averages.newest_error += rate * (qq - averages.newest_error)
    averages.newest_left += rate * (left - averages.newest_left)
    most = guard.usual_bound * sample.typical_error
    bounded = min(max(p, -most), most)
    earned = _earned(q, bounded, averages.square, tiny(guard))
    if earned > 0.0:
        matching = max(1.0 - newest_share(guard, memory) / _MATCHING, 0.0)
        earned *= 1.0 + (_QUICK - 1.0) * matching
    sample.credit = min(max(sample.credit + guard.earn * earned, -1.0), 1.0)
    _judge_effect(guard, memory, q, bounded, is_new)


@kernel
def _judge_effect(
    guard: GuardDesign, memory: GuardMemory, q: float, bounded: float, is_new: bool
) -> None:
    """Update C_y with what the learner, bounded, would have done to y; then the account."""
    averages, sample = memory.averages[0], memory.sample[0]
    q = respond(guard, memory, MISSED, q)
    bounded = respond(guard, memory, BOUNDED, bounded)
    rate, square = guard.forget_effect, q * q
    averages.effect_square = _mean_square(guard, averages.effect_square, square, rate, is_new)
    earned = _earned(q, bounded, averages.effect_square, tiny(guard))
    sample.effect_credit = min(max(sample.effect_credit + rate * earned, -1.0), 1.0)
    _keep_account(guard, memory, q, is_new)


@kernel
def _keep_account(guard: GuardDesign, memory: GuardMemory, q: float, is_new: bool) -> None:
    """Update J and A with ℓ q and with what the learner's corrections did."""
    averages, square = memory.averages[0], q * q
    own, rate = memory.effects[CORRECTED, guard.stages - 1], guard.forget_account
    is_burst = not is_new and rate * (square - averages.missed) > guard.rise * averages.missed
    averages.missed = _mean_square(guard, averages.missed, square, rate, is_new)
    averages.missed = min(averages.missed, _MOST_PAST * averages.effect_square)
    gain = (2.0 * q - _OWN_SQUARES * own) * own
    allowed = _LOAN * averages.missed
    # What a learner did in a burst says nothing, as J does not follow it.
    gain = averages.gained + (0.0 if is_burst else rate * (gain - averages.gained))
    averages.gained = min(max(gain, -_LARGEST_DEBT * allowed), averages.missed)
    if averages.gained < -allowed:
        memory.sample[0].credit = -1.0


@kernel
def respond(guard: GuardDesign, memory: GuardMemory, row: int, value: float) -> float:
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
def _earned(q: float, p: float, mean_square: float, least: float) -> float:
    """Return what a sample earns in which q − p is left of q."""
    earned = (2.0 * q - p) * p / max(q * q, _MEAN_SQUARES * mean_square, least)
    return max(earned, -_WORST_SAMPLE)


@kernel
def newest_share(guard: GuardDesign, memory: GuardMemory) -> float:
    """Return ε."""
    averages = memory.averages[0]
    return averages.newest_left / max(averages.newest_error, tiny(guard))


@kernel
def removed_share(guard: GuardDesign, memory: GuardMemory) -> float:
    """Return R."""
    averages = memory.averages[0]
    return averages.gained / max(averages.missed, tiny(guard))


@kernel
def authority_of(guard: GuardDesign, memory: GuardMemory, removed: float) -> tuple[float, int]:
    """Return β and the reason for it; ``removed`` is R."""
    loudness, sample = memory.averages[0].loudness, memory.sample[0]
    earned = min(sample.credit, _FULL_CREDIT + sample.effect_credit) / _FULL_CREDIT
    earned = min(earned, 1.0 + removed / _LOAN)
    if earned <= 0.0:
        return 0.0, _UNPROVEN
    scaled = _LOUDEST * (1.0 - loudness) / max(loudness, tiny(guard))
    if scaled < min(earned, 1.0):
        return scaled, _TOO_LOUD
    return (earned, _UNPROVEN) if earned < 1.0 else (1.0, _TRUSTED)


@kernel
def withdraw_authority(memory: GuardMemory) -> None:
    """Set the credit of a learner that has yet to prove itself, and the loudness of one like f."""
    memory.sample[0].credit, memory.sample[0].effect_credit = -1.0, 0.0
    memory.averages[0].loudness = 0.5
