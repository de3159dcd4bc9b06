"""The error e, and the bound of a correction in units of it; ``kernels.py`` has the equations."""

from __future__ import annotations

from quell.guard.credit import newest_share
from quell.guard.state import CORRECTED, PEAK, GuardDesign, GuardMemory, carried_sum, tiny
from quell.kernels.dispatch import kernel

# These values and those in ``guard.py`` were chosen by hand on tuning seeds of `quell stress`; it
# judges them as a set on other seeds (docs/theory).
# An outlier counts for so many times P.
_OUTLIER = 5.0
# c_L counts so many times for o: less would let motion that learner and loop make together raise o.
_OWN = 1.5
# The bound becomes wider with R, wholly at the first, and where ε is below the second, wholly at
# half of it.
_WIDE, _CLOSE = 0.1, 0.8
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
    peak, size = sample.peak, sample.typical_error
    # After T an outlier counts for 5 P at most: one bad measurement must not open all bounds.
    if sample.samples * guard.forget >= 1.0:
        error = min(error, _OUTLIER * peak)
    more = guard.rise * (error - peak) if error > peak else -guard.decay * peak
    peak = carried_sum(guard, memory, PEAK, peak, more)
    sample.peak = max(peak, tiny(guard))
    more = max(guard.rise * (error - size), 0.0)
    if sample.authority > 0.0:
        more = min(more, guard.growth * size)
    sample.typical_error = max(min(size + more, sample.peak), tiny(guard))
    more = guard.rise * (error - _OWN * sample.own_peak - sample.outside)
    sample.outside = min(sample.outside + max(more, 0.0), sample.peak)


@kernel
def bounds_of(guard: GuardDesign, memory: GuardMemory, removed: float) -> tuple[float, float]:
    """Return the least and the largest e_L; ``removed`` is R."""
    sample = memory.sample[0]
    if sample.authority == 0.0:
        closing = _closing(guard, memory) if sample.taking_back > 0.0 else 0.0
        return closing, closing
    left = newest_share(guard, memory)
    wider = min(max(removed / _WIDE, 0.0), 1.0)
    wider *= min(max(2.0 * (_CLOSE - left) / _CLOSE, 0.0), 1.0)
    factor = guard.usual_bound + wider * (guard.bound - guard.usual_bound)
    most = sample.authority * factor * sample.typical_error
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
