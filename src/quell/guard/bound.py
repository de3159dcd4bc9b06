"""The error e, and the bound of a correction in units of it; ``kernels.py`` has the equations."""

from __future__ import annotations

from quell.guard.credit import newest_share
from quell.guard.state import CORRECTED, PEAK, GuardDesign, GuardMemory, carried_sum, tiny
from quell.kernels.dispatch import kernel

# These values and those in ``guard.py`` were chosen by hand on tuning seeds of `quell stress`; it
# judges them as a set on other seeds (docs/theory).
# Credit that e costs when it grows by a factor of 2.7 while the learner acts. In the five lags that
# this takes at least, a learner that explains a sinusoidal load earns a quarter, and up to two if
# it explains all of it.
_GROWTH_COST = 0.35
# An outlier counts for so many times P.
_OUTLIER = 5.0
# e is at most so many times o.
_OWN_GROWTH = 2.5
# c_L counts so many times for o; the second holds while |q| is more than so many times P. With 1.1
# and below, motion that learner and loop make together raises o as if there were no limit.
_MOST_OWN, _SUDDEN_OWN, _SUDDEN = 5.0, 1.5, 1.25
# R from which the bound is κ_0 e, and share of it that a learner with R ≤ 0 has: ρ.
_PROVEN, _UNPROVEN_BOUND = 0.3, 0.7
# The bound becomes wider from the first R on, wholly at the second, and where ε is below the third,
# wholly at half of it.
_WIDER_FROM, _WIDE, _CLOSE = 0.05, 0.15, 0.8
# Widest bound in units of V, and of o. With 3 o, repeated moves leave half as much again; without,
# learners that keep a loop with friction moving do more harm.
_SHOWN, _MOST_OUTSIDE = 1.2, 4.0
# The bound becomes narrower from this ε on, down to this share.
_WRONG, _NARROWEST = 1.5, 0.3
# What was done to y is taken back with poles that ask for so many times the bound at most, and that
# are slower by this factor, several times, where they would ask for more. In steps of 0.7 a
# turncoat did five times the harm.
_MOST_ASKED, _SLOWER, _TRIES = 4.0, 0.85, 16


@kernel
def update_bound(guard: GuardDesign, memory: GuardMemory, error: float) -> None:
    """Update P, o and e with |q|."""
    sample = memory.sample[0]
    peak, size, own = sample.peak, sample.typical_error, sample.own_peak
    # After T an outlier counts for 5 P at most: one bad measurement must not open all bounds.
    if sample.samples * guard.forget >= 1.0:
        error = min(error, _OUTLIER * peak)
    most_own = (_SUDDEN_OWN if error > _SUDDEN * peak else _MOST_OWN) * own
    more = guard.rise * (error - peak) if error > peak else -guard.decay * peak
    peak = carried_sum(guard, memory, PEAK, peak, more)
    sample.peak = max(peak, tiny(guard))
    learner_acts = sample.authority > 0.0
    more = max(guard.rise * (error - guard.own * own - size), 0.0)
    grown = size + (min(more, guard.growth * size) if learner_acts else more)
    more = guard.rise * (error - most_own - sample.outside)
    sample.outside = min(sample.outside + max(more, 0.0), sample.peak)
    grown = min(grown, sample.peak, _OWN_GROWTH * sample.outside)
    if learner_acts and grown > size:
        cost = _GROWTH_COST * (grown - size) / size
        sample.credit -= cost
        sample.credit_at_y -= cost
    sample.typical_error = max(grown, tiny(guard))


@kernel
def bounds_of(guard: GuardDesign, memory: GuardMemory, removed: float) -> tuple[float, float]:
    """Return the least and the largest e_L; ``removed`` is R."""
    sample = memory.sample[0]
    if sample.authority == 0.0:
        closing = _closing(guard, memory) if sample.taking_back > 0.0 else 0.0
        return closing, closing
    left = newest_share(guard, memory)
    proven = min(max(removed / _PROVEN, 0.0), 1.0)
    share = _UNPROVEN_BOUND + (1.0 - _UNPROVEN_BOUND) * proven
    most = share * guard.usual_bound * sample.typical_error
    wider = min(max((removed - _WIDER_FROM) / (_WIDE - _WIDER_FROM), 0.0), 1.0)
    wider *= min(max(2.0 * (_CLOSE - left) / _CLOSE, 0.0), 1.0)
    widest = min(_SHOWN * sample.largest_output, _MOST_OUTSIDE * sample.outside)
    widest = min(widest, guard.bound * sample.typical_error)
    most = sample.authority * (most + wider * max(widest - most, 0.0))
    narrow = most * min(max(2.0 - left / _WRONG, _NARROWEST), 1.0)
    # What has been pushed too far upwards may be taken back at once, and the other way round.
    if memory.effects[CORRECTED, guard.stages - 1] > 0.0:
        return -most, narrow
    return -narrow, most


@kernel
def _closing(guard: GuardDesign, memory: GuardMemory) -> float:
    """Return the e_L that brings ℓ e_L to zero after a learner has lost its authority."""
    faster = max(guard.closing / guard.respond - 1.0, 0.0)
    most = guard.usual_bound * memory.sample[0].typical_error
    closing = _placing(guard, memory, faster)
    for _ in range(_TRIES):
        if abs(closing) > _MOST_ASKED * most:
            faster *= _SLOWER
            closing = _placing(guard, memory, faster)
    return min(max(closing, -most), most)


@kernel
def _placing(guard: GuardDesign, memory: GuardMemory, faster: float) -> float:
    """Return the e_L with which the poles of ℓ e_L are ``1 + faster`` times as fast."""
    weight, placing, place, above = 1.0, 0.0, 0.0, 0.0
    # Numbers of stages as floats: a quotient of integers would be in double precision.
    for _ in range(guard.stages):
        above += 1.0
    for i in range(guard.stages):
        place += 1.0
        weight *= faster * above / place
        above -= 1.0
        placing -= weight * memory.effects[CORRECTED, i]
    return placing
