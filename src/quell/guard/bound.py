"""The bound e of a correction; ``kernels.py`` has its equations."""

from __future__ import annotations

from quell.guard.state import PEAK, GuardDesign, GuardMemory, carried_sum, tiny
from quell.kernels.dispatch import kernel

# These values and those in ``guard.py`` were chosen by hand on tuning seeds of `quell stress`; it
# judges them as a set on other seeds (docs/theory).
# Credit that e costs when it grows by a factor of 2.7 while the learner acts. In the five lags that
# this takes at least, a learner that explains a sinusoidal load earns a quarter.
_GROWTH_COST = 0.2
# An outlier counts for so many times P.
_OUTLIER = 5.0
# e is at most so many times o; c_L counts so many times for o, and once while |q| is so many times
# P. With 1.2 instead of 1.15 the two worst runs are better still, but honest learners lose much
# where a load begins slowly; with 1.1 and below the worst runs are as bad as without o.
_OWN_GROWTH, _MOST_OWN, _SUDDEN = 2.5, 5.0, 1.15


@kernel
def update_bound(guard: GuardDesign, memory: GuardMemory, error: float) -> None:
    """Update P, o and e with |q|."""
    sample = memory.sample[0]
    peak, size, own = sample.peak, sample.typical_error, sample.own_peak
    # After T an outlier counts for 5 P at most: one bad measurement must not open all bounds.
    if sample.samples * guard.forget >= 1.0:
        error = min(error, _OUTLIER * peak)
    most_own = own if error > _SUDDEN * peak else _MOST_OWN * own
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
        sample.credit -= _GROWTH_COST * (grown - size) / size
    sample.typical_error = max(grown, tiny(guard))
