"""Detection of a learner that has lost its numbers, for all learners alike.

Samples that are absurd, but finite, can take a learner to where it does not return from: scales and
mean squares are then so large that it no longer sees what comes, or its output is so large that
u stays at its limits. Four comparisons find this, in any unit, all but the third over windows
of ``WINDOW_LAGS`` lags of the observer:

* *range*: while y moves, the largest ``|f_plain|`` of a window is below 2⁻⁴⁰ of the largest ever.
  No real loop works over such a range: sensors resolve ``RESOLUTION`` of theirs. Where y moves by
  less than that, and where ``|f_plain|`` still decays, nothing is concluded, so a loop that comes
  to rest, also without any noise, forgets nothing. If u is at its limits in most samples of the
  window, 2⁻¹⁰ suffices: features that are so small correct nothing within the memory of a learner,
  and what it learned at the larger scale may be what keeps u at its limits;
* *output*: in most samples of a window the law asks for more than 2¹⁰ times the u that is applied,
  and the learner's output is more than 2¹⁰ times the largest ``|f_plain|``. Without limits this can
  not happen;
* *escape*: the learner's output is more than 2⁴⁰ times the largest ``|f_plain|`` of all windows
  before, and the law asks for more than 2¹⁰ times the u that is applied. Then estimates and output
  drive each other, for example with a cube of x̂, while y is still good; f_plain contains them, so
  that no later comparison with it would be of use;
* *harm*: in most samples of ten windows ``|Δf̂|`` is more than 4 times ``|f_plain|``: the output
  adds to the disturbance. A learner that can correct this has done so by then. One with a fixed
  rate can not if θ comes from motions that were 100 times larger. This is asked without a guard,
  which judges the output itself, of learners that have something to forget.

The controller then calls ``forget`` (``learners/base.py``).
"""

from __future__ import annotations

from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.kernels.scalars import Scalars
from quell.learners.noise_gate import AVERAGING_LAGS, resolution
from quell.observers.eso import ESO

# The time over which learners average: what has decayed in it is gone from them as well.
WINDOW_LAGS = AVERAGING_LAGS
# 2⁻⁴⁰ = 9e-13: three decades below what noise of RESOLUTION leaves of f at omega_o dt = 0.01,
# and with 12 of the 52 bits left to a learner whose scale is so much too large.
_LEAST_SHARE = 2.0**-40
# An output so many times larger than f is no prediction; ten times what a guard cuts off.
_TOO_LARGE = 2.0**10
# With features of this size a regression learns 2⁻²⁰ of what it learns at its scale from a sample.
_LEAST_SHARE_AT_LIMITS = 2.0**-10
# In single precision a y that rests may still change by its last digit, 2⁻²³ of it at most.
_STEP_OF_SINGLE = 2.0**-22
# A window counts only if |f_plain| has not decayed to less than this share of the last one. At
# rest without noise a loop with omega_c = omega_o/10 decays faster.
_STEADY = 0.5

# In the recoveries of benchmarks/hostile_steps.py the ratio was larger in 1 to 8 % of the samples
# with new learners, and in 84 to 95 % with those that did not recover.
_HARM = 4.0
_HARM_WINDOWS = 10.0


class LearnerWatch(Scalars):
    """Extremes and counts of a window, and the extremes before it."""

    peak: float  # largest |f_plain| since the learner began
    most: float  # largest |f_plain| in this window
    most_before: float  # largest |f_plain| in the last window
    y_low: float  # least y in this window
    y_high: float  # largest y in this window
    excessive: float  # samples in this window with an output that is too large
    limited: float  # samples in this window in which u was at its limits
    samples: float  # samples in this window
    harmful: float  # samples in which the output did harm
    compared: float  # samples in which that was asked


def window_samples(observer: ESO) -> int:
    """Return the length of a window in samples."""
    return max(round(WINDOW_LAGS * observer.lag_time / observer.dt), 1)


@kernel
def is_in_proportion(watch: LearnerWatch, output: float) -> bool:
    """Return whether ``output`` could be a prediction of the f of the last window."""
    return abs(output) <= _TOO_LARGE * watch.most_before


@kernel
def is_excessive(unlimited: float, u: float, smallest: float) -> bool:
    """Return whether the law asks for far more than the u that is applied, or ``smallest``."""
    return abs(unlimited) > _TOO_LARGE * max(abs(u), smallest)


@kernel
def has_escaped(watch: LearnerWatch, output: float, excessive: bool) -> bool:
    """Return whether ``output`` grows without bound; the window then begins anew.

    The arguments are those of ``has_lost_range``.
    """
    if not (excessive and watch.peak > 0.0):
        return False
    if abs(output) * _LEAST_SHARE <= watch.peak:
        return False
    # The window before may have seen the beginning, but not the peak.
    watch.most_before = min(watch.most_before, watch.peak)
    watch.most = watch.excessive = watch.limited = watch.samples = 0.0
    return True


@kernel
def has_lost_range(
    watch: LearnerWatch,
    window: int,
    y: float,
    f_plain: float,
    output: float,
    excessive: bool,
    limited: bool,
) -> bool:
    """Return whether the learner has to start again; call it once for each good sample.

    ``output`` is the learner's own, before a guard; ``excessive`` tells whether the law asks for
    far more than the u that is applied, ``limited`` whether limits have changed it.
    """
    size = abs(f_plain)
    if watch.samples == 0.0:
        watch.y_low = watch.y_high = y
    watch.samples += 1.0
    if size > watch.most:  # false for a NaN
        watch.most = size
    watch.y_low, watch.y_high = min(watch.y_low, y), max(watch.y_high, y)
    if excessive and abs(output) > _TOO_LARGE * max(watch.most, watch.most_before):
        watch.excessive += 1.0
    if limited:
        watch.limited += 1.0
    if watch.samples < window:
        return False
    watch.peak = max(watch.peak, watch.most)
    largest = max(abs(watch.y_low), abs(watch.y_high))
    still = _STEP_OF_SINGLE if is_single(watch.peak) else resolution(watch.peak)
    moves = watch.y_high - watch.y_low > still * largest
    steady = watch.most >= _STEADY * watch.most_before
    least = _LEAST_SHARE_AT_LIMITS if 2.0 * watch.limited > watch.samples else _LEAST_SHARE
    out_of_range = moves and steady and watch.most < least * watch.peak
    lost = out_of_range or 2.0 * watch.excessive > watch.samples
    if lost:
        watch.peak = watch.most
    watch.most_before = watch.most
    watch.most = watch.excessive = watch.limited = watch.samples = 0.0
    return bool(lost)


@kernel
def does_harm(watch: LearnerWatch, window: int, residual: float, f_plain: float) -> bool:
    """Return whether the output adds to the disturbance; call it once for each good sample.

    ``residual`` is the Δf̂ that the output leaves of ``f_plain``.
    """
    watch.compared += 1.0
    if abs(residual) > _HARM * abs(f_plain):
        watch.harmful += 1.0
    if watch.compared < _HARM_WINDOWS * window:
        return False
    harm = 2.0 * watch.harmful > watch.compared
    watch.compared = watch.harmful = 0.0
    return bool(harm)
