"""A plant that is held: a brake, an end stop or the ground, against which u does not act.

While y can not move, the observer takes what holds it for a disturbance: f̂ runs to −b0 u, and the
law adds to u what that asks for, up to the limits. At the release f is at once what it was before,
and f̂ is wrong by all of it for some lags of the observer.

**A signal.** Where the machine knows that it is held, it says so (``set_held``). Then the observer
rests at y with the f̂ of before, the law works with that, a learner and a guard wait, and there is
nothing to unlearn.

**Detection.** For the signals a brake is a load of exactly −b0 u. A load that changes and is
compensated looks the same as long as nothing moves, and so does an axis that sticks, which only a
growing u sets free. So nothing is changed while nothing moves. f̂ of before is kept, and what
happens at the first motion decides:

* *held*: over a window y shows nothing beyond its sensor's noise: its range A is a count, or that
  of white noise of its changes from sample to sample. The observer's model, free from the begin of
  the window on under u and the f̂ of before, would have moved by more than 20 A. And f̂ has changed
  since then by more than a tenth of the largest b0 u so far. Windows of 0.5, 2 and 10 lags of the
  observer run side by side, two of each that overlap by half; f̂ of before is that at the begin of
  the window before;
* *released*: y has left the band of A around its centre and moves as the model does, free since
  then under u and the f̂ of before. Motions are compared from where the model has moved by 4 A: one
  without acceleration is ahead of the model's at first only. At 16 A at least 0.6 of it are asked
  for, from 64 A on 0.35, which a gain of half of b0 still makes. Then the estimates become those of
  an observer that was at rest with the f̂ of before until y left the band;
* *not held*: y moves by less, or as much for another reason. It was a load, or it stuck: nothing is
  changed.

The flag ``HELD`` is set from the detection to that decision. It says what the signals show, not
that there is a brake. So learner and guard go on meanwhile: on the twin of EMPS, which sticks
(``benchmarks/stiction.py``), a ``Kalman`` that waited in all of these moments erred 2.4 times as
much along a slow sinusoid.

What can not be detected: a stop that gives by more than a count, noise that is not white and not
known (``HeldPlant(noise=…)``), and what a u at its limit has done before y left the band.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.kernels.dispatch import generic_with_default, kernel
from quell.kernels.sized import Scalars, clear
from quell.learners.base import resolution
from quell.observers.eso import ESO
from quell.observers.forms import begin_with, observe, without_delay
from quell.types import Matrix, Status, Vector

_HELD = int(Status.HELD)

# The constants below were chosen on 512 releases and 400 free runs (seed 1) and judged on others.
# Windows in lags of the observer: a short hold, most of a change of f̂, and noise.
_WINDOWS = (0.5, 2.0, 10.0)
# Ranges of y by which a free plant should have moved.
_VISIBLE = 20.0
# Range of white noise in mean changes from sample to sample: 7.7 deviations in 10⁴ samples, and
# such a change is 1.13 of them. Of a motion it is the number of samples.
_WHITE = 7.0
_LEAST_SAMPLES = 14
# Least change of f̂ relative to the largest |b0 u| so far.
_CHANGE = 0.1
# Bands by which a free plant should have moved: from the first point on its motion is compared with
# the predicted one, at the second it may be called free, at the third it has to be said.
_NEAR, _FAR, _FARTHER = 4.0, 16.0, 64.0
# Least share of the predicted motion there. A gain of half of b0 makes a half of it; what sticks,
# reverses and breaks loose less than a third, unless it sticks with twice the force of its motion.
_LEAST, _LEAST_FARTHER = 0.6, 0.35
# Largest share. What began before y left the band is ahead of what is predicted from then on, by
# less from sample to sample.
_MOST = 4.0

# Columns of the windows; those from ``_CHANGED`` on are an f.
_SAMPLES, _LOW, _HIGH, _Y, _STEPS, _MOVED, _CHANGED, _FIRST, _BEFORE = range(9)
_COLUMNS = 9

# Phases.
_FREE, _STILL, _LEAVING = 0.0, 1.0, 2.0


class NoHeldPlant(NamedTuple):
    """The absence of a detection."""


class NoHeldMemory(NamedTuple):
    """State without a detection."""

    nothing: Vector  # (0,)


class HeldDesign(NamedTuple):
    """Parameters of the detection, for a plant of order n."""

    transition: Matrix  # Φ (n, n) of the observer's model
    input: Vector  # Γ_u (n,)
    feed: Vector  # Γ_f (n,)
    lengths: Vector  # samples of each window (w,)
    resolution: float  # least band [y-unit]


class HeldLoop(Scalars):
    """Scalars of the detection, kept from one sample to the next."""

    phase: float  # 0 free, 1 held, 2 the band is left
    started: float  # 1 when the windows have begun
    y: float  # last measurement
    change: float  # of y in the last sample
    count: float  # least change of y, or of its change, so far: what the sensor resolves [y-unit]
    peak: float  # largest |b0 u| so far
    centre: float  # of the band in which y rests
    band: float  # A
    f: float  # f̂ of before, less the learner's share that follows u
    samples: float  # since the band was left
    predicted: float  # distance from the centre that a free plant should have by now
    away_near: float  # distance from the centre at the point from which motions are compared
    predicted_near: float  # the predicted one there


class HeldMemory(NamedTuple):
    """State of the detection."""

    windows: Matrix  # (w, 9)
    responses: Matrix  # motion that the change of u should have caused (w, n)
    predicted: Vector  # state of a plant that is free since the band was left (n,)
    moved: Vector  # work space (n,)
    z: Vector  # state of an observer that rests with the f̂ of before until then
    estimates: Vector  # of the observer
    loop: NDArray[HeldLoop]  # (1,)


@generic_with_default
def is_released(
    design: Any, memory: Any, y: float, u: float, f: float, slope: float, b0: float
) -> bool:
    """Look at a sample: whether the plant is held; return true in the sample of its release.

    ``u`` is what acted over the sample that ends with y, ``f`` the estimate of f less ``slope u``.
    """
    return False


@generic_with_default
def follow(
    design: Any, memory: Any, eso: Any, z: Vector, y: float, u: float, fed: float, residual: float
) -> None:
    """Keep the observer of a free plant ready: call it in each sample before ``is_released``.

    ``u`` and ``fed`` are what the loop's observer, of state ``z``, received; ``residual`` is the
    Δf̂ of before.
    """


@generic_with_default
def f_before(design: Any, memory: Any) -> float:
    """Return the f̂ of before a hold, less what follows u."""
    return 0.0


@generic_with_default
def take_motion(design: Any, memory: Any, z: Vector, estimates: Vector) -> None:
    """Set the loop's observer to the estimates of a plant that was released."""


@generic_with_default
def held_flag(design: Any, memory: Any) -> int:
    """Return the status flag."""
    return 0


@generic_with_default
def miss(design: Any, memory: Any) -> None:
    """Go on without a measurement: a free plant is looked at anew, a held one stays held."""


@generic_with_default
def look_anew(design: Any, memory: Any) -> None:
    """Forget the motion so far; what the sensor resolves is kept."""


@generic_with_default
def scale_loads(design: Any, memory: Any, ratio: float) -> None:
    """Multiply all that is known of f: the loads stay, and the inertia has changed."""


@kernel
def _advance(design: HeldDesign, x: Vector, moved: Vector, u: float, f: float) -> None:
    """Take a state of the model through a sample."""
    for i in range(x.size):
        total = design.input[i] * u + design.feed[i] * f
        for j in range(x.size):
            total += design.transition[i, j] * x[j]
        moved[i] = total
    for i in range(x.size):
        x[i] = moved[i]


@kernel
def _begin_window(memory: HeldMemory, i: int, y: float, f: float, before: float) -> None:
    window = memory.windows[i]
    window[_SAMPLES] = window[_STEPS] = window[_MOVED] = window[_CHANGED] = 0.0
    window[_LOW] = window[_HIGH] = window[_Y] = y
    window[_FIRST], window[_BEFORE] = f, before
    for j in range(memory.moved.size):
        memory.responses[i, j] = 0.0
    memory.responses[i, 0] = y


@kernel
def _begin_windows(
    design: HeldDesign, memory: HeldMemory, y: float, f: float, before: float
) -> None:
    """Begin all windows, every second one by half its length earlier."""
    for i in range(design.lengths.size):
        _begin_window(memory, i, y, f, before)
        if i % 2 == 1:
            memory.windows[i, _SAMPLES] = 0.5 * design.lengths[i]
    memory.loop[0].phase = _FREE


@kernel
def _update_count(loop: HeldLoop, change: float, y: float) -> None:
    """Take a change of y, or of its change: both are whole counts."""
    if change > 2.0 * resolution(y) * abs(y) and (loop.count == 0.0 or change < loop.count):
        loop.count = change


@kernel
def _least_band(design: HeldDesign, loop: HeldLoop, y: float) -> float:
    """Return the range of y that its sensor can not tell from rest."""
    return max(max(design.resolution, 1.5 * loop.count), resolution(y) * abs(y))


@kernel
def _update_window(
    design: HeldDesign,
    memory: HeldMemory,
    i: int,
    y: float,
    change: float,
    u: float,
    f: float,
    slope: float,
) -> bool:
    """Update a window; return whether it ends with a plant that is held."""
    window, loop = memory.windows[i], memory.loop[0]
    response = memory.responses[i]
    _advance(design, response, memory.moved, u, window[_BEFORE] + slope * u)
    window[_SAMPLES] += 1.0
    window[_LOW], window[_HIGH] = min(window[_LOW], y), max(window[_HIGH], y)
    window[_STEPS] += change
    window[_MOVED] = max(window[_MOVED], abs(response[0] - window[_Y]))
    window[_CHANGED] = max(window[_CHANGED], abs(f - window[_BEFORE]))
    if window[_SAMPLES] < design.lengths[i]:
        return False
    covered = window[_HIGH] - window[_LOW]
    least = _least_band(design, loop, y)
    rests = covered <= least or covered * window[_SAMPLES] < _WHITE * window[_STEPS]
    band = max(covered, least)
    if rests and window[_MOVED] > _VISIBLE * band and window[_CHANGED] > _CHANGE * loop.peak:
        loop.centre, loop.band = 0.5 * (window[_LOW] + window[_HIGH]), band
        loop.f = window[_BEFORE]
        return True
    _begin_window(memory, i, y, f, window[_FIRST])
    return False


@is_released.register(HeldDesign)
def _is_released(
    design: HeldDesign, memory: HeldMemory, y: float, u: float, f: float, slope: float, b0: float
) -> bool:
    loop = memory.loop[0]
    if loop.phase == _FREE:
        change = y - loop.y
        if loop.started == 0.0:
            _begin_windows(design, memory, y, f, f)
            loop.started, change = 1.0, 0.0
        else:
            _update_count(loop, abs(change), y)
            _update_count(loop, abs(change - loop.change), y)
        loop.y, loop.change, change = y, change, abs(change)
        loop.peak = max(loop.peak, abs(b0 * u))
        for i in range(design.lengths.size):
            if loop.phase == _FREE and _update_window(design, memory, i, y, change, u, f, slope):
                loop.phase = _STILL
                _rest(memory)
        return False
    away = y - loop.centre
    if abs(away) <= loop.band:
        loop.phase = _STILL
        _rest(memory)
        return False
    if loop.phase == _STILL:
        loop.phase = _LEAVING
        loop.samples = loop.predicted = loop.away_near = loop.predicted_near = 0.0
    loop.samples += 1.0
    _advance(design, memory.predicted, memory.moved, u, loop.f + slope * u)
    predicted, before = memory.predicted[0] - loop.centre, loop.predicted
    loop.predicted = predicted
    if predicted < 0.0:
        predicted, before, away = -predicted, -before, -away
    if predicted < _NEAR * loop.band:
        loop.away_near, loop.predicted_near = away, predicted
    # From the near point on: a steady motion is ahead of what is predicted at first only.
    away -= loop.away_near
    further = predicted - loop.predicted_near
    least = _LEAST_FARTHER if predicted >= _FARTHER * loop.band else _LEAST
    released = predicted >= _FAR * loop.band and least * further <= away <= _MOST * further
    # The release may have been at the end of the sample in which y left the band.
    further = before - loop.predicted_near
    refuted = before >= _FAR * loop.band and away < _LEAST_FARTHER * further
    # After a long window it was another force.
    late = loop.samples > design.lengths[design.lengths.size - 1]
    if released or refuted or late:
        loop.y = y
        _begin_windows(design, memory, y, loop.f if released else f, loop.f)
    return released


@kernel
def _rest(memory: HeldMemory) -> None:
    """Let the free plant rest in the middle of the band."""
    for i in range(memory.predicted.size):
        memory.predicted[i] = 0.0
    memory.predicted[0] = memory.loop[0].centre


@follow.register(HeldDesign)
def _follow(
    design: HeldDesign,
    memory: HeldMemory,
    eso: Any,
    z: Vector,
    y: float,
    u: float,
    fed: float,
    residual: float,
) -> None:
    loop = memory.loop[0]
    if loop.phase == _FREE:
        return
    if abs(y - loop.centre) <= loop.band:
        for i in range(z.size):
            memory.z[i] = z[i]
        begin_with(eso, memory.z, memory.estimates, loop.centre, design.input.size, residual)
    else:
        observe(eso, memory.z, memory.estimates, y, u, fed)


@f_before.register(HeldDesign)
def _f_before(design: HeldDesign, memory: HeldMemory) -> float:
    return memory.loop[0].f


@take_motion.register(HeldDesign)
def _take_motion(design: HeldDesign, memory: HeldMemory, z: Vector, estimates: Vector) -> None:
    for i in range(z.size):
        z[i] = memory.z[i]
    for i in range(estimates.size):
        estimates[i] = memory.estimates[i]


@scale_loads.register(HeldDesign)
def _scale_loads(design: HeldDesign, memory: HeldMemory, ratio: float) -> None:
    memory.loop[0].f *= ratio
    memory.loop[0].peak *= ratio
    for i in range(design.lengths.size):
        for j in range(_CHANGED, _COLUMNS):
            memory.windows[i, j] *= ratio
    for i in range(design.input.size, memory.estimates.size):
        change = (ratio - 1.0) * memory.estimates[i]
        memory.estimates[i] += change
        memory.z[i] += change


@held_flag.register(HeldDesign)
def _held_flag(design: HeldDesign, memory: HeldMemory) -> int:
    return 0 if memory.loop[0].phase == _FREE else _HELD


@miss.register(HeldDesign)
def _miss(design: HeldDesign, memory: HeldMemory) -> None:
    if memory.loop[0].phase == _FREE:
        memory.loop[0].started = 0.0


@look_anew.register(HeldDesign)
def _look_anew(design: HeldDesign, memory: HeldMemory) -> None:
    count, peak = memory.loop[0].count, memory.loop[0].peak
    clear(memory.loop)
    memory.loop[0].count, memory.loop[0].peak = count, peak


@dataclass(frozen=True)
class HeldPlant:
    """Detection of a held plant, for ``ADRC(…, held=…)`` and ``Compensator(…, held=…)``.

    A brake, an end stop or the ground keeps y where it is whatever u does. Without detection the
    estimate of f winds up, and the release makes an overshoot; the module's docstring has the
    method. Where the machine knows that it is held, ``set_held`` of the controller is better: u
    does not wind up at all.

    Parameters
    ----------
    noise
        largest error of the measurement [y-unit], half a step of an encoder for instance. By
        default it follows from the measurement: from its range while it rests and from its least
        change.

    Raises
    ------
    ValueError
        for a negative noise; in ``design`` for an observer of a plant with zeros, whose states are
        not derivatives of y.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=100.0, dt=0.001)
    >>> controller = ql.ADRC(observer, omega_c=20.0, u_min=-9.0, u_max=9.0, held=HeldPlant())
    >>> held = [controller.step(r=1.0, y=0.0) for _ in range(200)]
    >>> controller.estimate.status
    <Status.SATURATED|HELD: 8196>
    """

    noise: float = 0.0

    def __post_init__(self) -> None:
        checks.non_negative("noise", self.noise)

    def design(self, observer: ESO) -> HeldDesign:
        """Return the parameters for an observer."""
        check_rest(observer, "held")
        model, n = without_delay(observer.model), observer.order
        lag = observer.lag_time / observer.dt
        lengths = [
            2.0 * max(round(0.5 * lags * lag), _LEAST_SAMPLES // 2)
            for lags in _WINDOWS
            for _ in range(2)
        ]
        transition = np.ascontiguousarray(model.transition[:n, :n])
        enters, feed = model.input[:n].copy(), model.feed[:n].copy()
        return HeldDesign(transition, enters, feed, np.array(lengths), 2.0 * self.noise)

    def memory(self, design: HeldDesign, observer: ESO) -> HeldMemory:
        """Return the state before the first sample."""
        n, windows = design.input.size, design.lengths.size
        return HeldMemory(
            windows=np.zeros((windows, _COLUMNS)),
            responses=np.zeros((windows, n)),
            predicted=np.zeros(n),
            moved=np.zeros(n),
            z=np.zeros(observer.states),
            estimates=np.zeros(observer.estimates),
            loop=HeldLoop.zeros(),
        )


def rests_at_y(observer: ESO) -> bool:
    """Return whether a plant at rest has the states ``(y, 0, …)``."""
    return not observer.plant.zeros.size and observer.degree == observer.order


def check_rest(observer: ESO, name: str) -> None:
    """Raise a ``ValueError`` if a plant at rest has other states than ``(y, 0, …)``."""
    if not rests_at_y(observer):
        raise ValueError(
            f"{name}: the plant has zeros, so its states at rest are not y and zeros; take a "
            "model-free observer of the relative degree, or call track while the plant is held"
        )


__all__ = ["HeldPlant"]
