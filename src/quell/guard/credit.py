"""Credit and account of a learner, and its authority; ``kernels.py`` has their equations."""

from __future__ import annotations

from quell.guard.reason import Reason
from quell.guard.state import EXPLAINED, MISSED, GuardDesign, GuardMemory, tiny
from quell.kernels.dispatch import kernel

# These values and those in ``guard.py`` were chosen by hand on tuning seeds of `quell stress`; it
# judges them as a set on other seeds (docs/theory).
# Credit from which the authority is full; between that and 1 a learner may err for a while.
_FULL_CREDIT = 0.5
# Largest energy of p in units of that of q: p of a good learner is at most a little too large.
_LOUDEST = 1.2
# A single sample costs at most this many times what a perfect one earns.
_WORST_SAMPLE = 3.0
# Below this ε a sample earns more, and β̄ follows β more quickly, at ε = 0 so many times: a learner
# that explains all of a disturbance is heard after some lags in which the disturbance is seen.
_MATCHING, _QUICK = 0.35, 8.0
# Factor of (ℓ e_L)² in the account: the plant's gain may be so many times b0.
_OWN_SQUARES = 1.5
# Share by which a learner may make the squared error larger, and least R, as a multiple of it: R
# comes back from there within 200 lags.
_LOAN, _LARGEST_DEBT = 0.01, 2.0
# RMS of q in units of o from which it may be the learner's own doing, and until which authority is
# withheld; the share of the square of the first that such a learner leaves at least.
_OWN_DOING, _GONE, _LEFT = 2.0, 1.3, 0.05
# Of higher order, authority that is withheld, or comes quickly, moves y too much.
HIGHEST_ORDER = 3

_TRUSTED, _UNPROVEN, _TOO_LOUD = int(Reason.TRUSTED), int(Reason.UNPROVEN), int(Reason.TOO_LOUD)
_WITHHELD = int(Reason.WITHHELD)


@kernel
def judge(guard: GuardDesign, memory: GuardMemory, q: float, p: float) -> None:
    """Update averages, credit and account with q and p, of which one is not zero."""
    averages, sample = memory.averages[0], memory.sample[0]
    qq, pp = q * q, p * p
    is_new = sample.samples * guard.forget < 1.0
    averages.square = _mean_square(guard, averages.square, qq, guard.forget, is_new)
    left, rate = (q - p) * (q - p), guard.forget_match
    averages.square_left = _mean_square(guard, averages.square_left, left, guard.forget, is_new)
    averages.loudness += guard.forget * (pp / (qq + pp) - averages.loudness)
    averages.newest_error += rate * (qq - averages.newest_error)
    averages.newest_left += rate * (left - averages.newest_left)
    most = guard.usual_bound * sample.typical_error
    bounded = min(max(p, -most), most)
    earned = _earned(q, bounded, averages.square, tiny(guard))
    if earned > 0.0:
        earned *= quickness(guard, memory)
    sample.credit = min(max(sample.credit + guard.earn * earned, -1.0), 1.0)
    missed = respond(guard, memory, MISSED, q)
    _earn_at_y(guard, memory, missed, respond(guard, memory, EXPLAINED, bounded), is_new)
    if newest_share(guard, memory) > 1.0:
        # The learner adds to q: what y shows late, q shows at once.
        sample.credit_at_y = max(sample.credit_at_y + guard.earn * min(earned, 0.0), -1.0)
    _keep_account(guard, memory, missed, is_new)


@kernel
def _earn_at_y(
    guard: GuardDesign, memory: GuardMemory, missed: float, explained: float, is_new: bool
) -> None:
    """Update the credit C_y with ℓ q and ℓ p̄: as C, but noise of y has little weight in it."""
    averages, sample = memory.averages[0], memory.sample[0]
    averages.seen = _mean_square(guard, averages.seen, missed * missed, guard.forget, is_new)
    earned = _earned(missed, explained, averages.seen, tiny(guard))
    sample.credit_at_y = min(max(sample.credit_at_y + guard.earn * earned, -1.0), 1.0)


@kernel
def _keep_account(guard: GuardDesign, memory: GuardMemory, missed: float, is_new: bool) -> None:
    """Update J and A with ℓ q and with what the learner's corrections did."""
    averages, square = memory.averages[0], missed * missed
    own, rate = memory.sample[0].late_effect, guard.forget_account
    is_burst = not is_new and rate * (square - averages.missed) > guard.rise * averages.missed
    averages.missed = _mean_square(guard, averages.missed, square, rate, is_new)
    gain = (2.0 * missed - _OWN_SQUARES * own) * own
    allowed = _LOAN * max(averages.missed, averages.seen)
    # What a learner did in a burst says nothing, as J does not follow it.
    gain = averages.gained + (0.0 if is_burst else rate * (gain - averages.gained))
    averages.gained = min(max(gain, -_LARGEST_DEBT * allowed), averages.missed)
    if averages.gained < -allowed:
        memory.sample[0].credit = memory.sample[0].credit_at_y = -1.0


@kernel
def respond(guard: GuardDesign, memory: GuardMemory, row: int, value: float) -> float:
    """Return ``ℓ value``, which responds as y does."""
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
    return max((2.0 * q - p) * p / max(q * q, mean_square, least), -_WORST_SAMPLE)


@kernel
def newest_share(guard: GuardDesign, memory: GuardMemory) -> float:
    """Return ε."""
    averages = memory.averages[0]
    return averages.newest_left / max(averages.newest_error, tiny(guard))


@kernel
def quickness(guard: GuardDesign, memory: GuardMemory) -> float:
    """Return how many times as quickly a learner is heard that closely matches q at present."""
    return 1.0 + (_QUICK - 1.0) * max(1.0 - newest_share(guard, memory) / _MATCHING, 0.0)


@kernel
def removed_share(guard: GuardDesign, memory: GuardMemory) -> float:
    """Return R."""
    averages = memory.averages[0]
    # J follows a load that begins only after ten lags: harm is compared with M_y until then.
    past = averages.missed if averages.gained > 0.0 else max(averages.missed, averages.seen)
    return averages.gained / max(past, tiny(guard))


@kernel
def _is_own_doing(guard: GuardDesign, memory: GuardMemory) -> bool:
    """Return whether q is so large beside o that learner and loop may keep it up together."""
    averages, sample = memory.averages[0], memory.sample[0]
    if guard.stages > HIGHEST_ORDER:
        return False
    if sample.authority > 0.0:
        own_doing = (_OWN_DOING * sample.outside) ** 2
        return averages.square > own_doing and averages.square_left > _LEFT * own_doing
    return averages.square > (_GONE * sample.outside) ** 2


@kernel
def authority_of(guard: GuardDesign, memory: GuardMemory, removed: float) -> tuple[float, int]:
    """Return β and the reason for it; ``removed`` is R."""
    loudness, sample = memory.averages[0].loudness, memory.sample[0]
    earned = min(max(sample.credit, sample.credit_at_y) / _FULL_CREDIT, 1.0 + removed / _LOAN)
    if earned <= 0.0:
        sample.outside_then = 0.0
        return 0.0, _UNPROVEN
    if _is_own_doing(guard, memory):
        if sample.outside_then == 0.0:
            sample.outside_then = sample.outside
        return 0.0, _WITHHELD
    then, sample.outside_then = sample.outside_then, 0.0
    averages = memory.averages[0]
    if guard.stages < HIGHEST_ORDER and averages.square < (_GONE * then) ** 2:
        # The motion went with the learner: it was its own doing, whatever it explained of it.
        averages.gained = -_LARGEST_DEBT * _LOAN * max(averages.missed, averages.seen)
        return 0.0, _UNPROVEN
    scaled = _LOUDEST * (1.0 - loudness) / max(loudness, tiny(guard))
    if scaled < min(earned, 1.0):
        return scaled, _TOO_LOUD
    return (earned, _UNPROVEN) if earned < 1.0 else (1.0, _TRUSTED)


@kernel
def withdraw_authority(memory: GuardMemory) -> None:
    """Set the credit of a learner that has yet to prove itself, and the loudness of one like f."""
    memory.sample[0].credit = memory.sample[0].credit_at_y = -1.0
    memory.averages[0].loudness = 0.5
