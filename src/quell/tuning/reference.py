"""The prefilter of the reference of a tuned file: within the limits of u, a step overshoots little.

An axis, whose position needs no u at rest, gets a ``ProfileGenerator``. With the rigid part
``u = c_1 y' + c_2 y''`` of the plant's inverse and the room for u that loads leave while r steps,

    |c_1| v_max + |c_2| a_max ≤ share · room,        j_max = a_max / t_j

and of the v_max those are taken with which the largest step of the scenario takes the least time.
``share`` and the ramp t_j of the acceleration are tried in simulations of the file: the quickest
move that keeps u within its limits and overshoots by 5 % at most. Friction takes u while an axis
speeds up and gives it while it brakes, but a generator has one a_max for both. So where friction
counts, moves are tried, too, in which speed and acceleration need the share each and more together:
u is at its limit while the axis speeds up, and y is back on the move before it comes to rest. A
step has to overshoot little with 15 % less of u, too.

Of an axis with a resonance a controller has the feedforward of the flat output, with which a move
leaves no mode swinging (``controllers/feedforward.py``). It needs four derivatives, so the move is
smoothed, and the ramp of the acceleration is a part of a period of the lowest mode. Beside them
ramps of whole periods are tried, for a controller with the inertia alone: the ends of a ramp then
cancel each other in the mode (Singer & Seering, *J. Dyn. Syst. Meas. Control* 112, 1990). A small
step behind a generator is quicker than the mode: what it needs beyond the inertia may reach a limit
of u, and feedforward of the whole inertia moves the motor alone. So smaller steps have to overshoot
little, too.

An axis for which no generator is quicker gets a ``ReferenceModel``, with which u keeps within its
limits, too. A reference model is as slow for a small step as for a large one.

A plant that needs u at rest, a process, has one only where a step overshoots without: heaters and
valves may stand at their limits until y is near r. It is the one with which the step settles first.
Its rate may be bounded, near the largest one of the step of the scenario, for a larger step. Nearly
the largest step that u can hold is simulated, too: of the faster models with such rates that one is
taken with which both overshoot by 5 % at most, and the step of the scenario settles first.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.base import Controller
from quell.controllers.feedforward import Feedforward
from quell.controllers.prefilters import Prefiltered, ReferenceModel
from quell.controllers.shaping import ProfileGenerator
from quell.plants.linear import LinearPlant
from quell.signals import LimitedMove
from quell.tuning.optimiser import loops
from quell.tuning.optimiser.loops import PlantSet, law_of, response
from quell.tuning.tables import held_load, held_step
from quell.tuning.written import MOST_OVERSHOOT, StepFigures, Written
from quell.types import Vector

# A step that needs less than this share of the u that the loop's own gain makes of it needs none.
_NO_U = 1e-6
# Shares of the room for u that a move uses, what a load may take of it at most, and the ramps of
# the acceleration: in samples and in time constants of the loop. Chosen by hand; each is simulated.
SHARES, MOST_RESERVED = (0.95, 0.8, 0.65), 0.5
SAMPLES, _CONSTANTS = (4.0,), (1.0, 3.0)
# What speed and acceleration need together where friction brakes, in units of the share: where it
# takes this share of the room at the top speed. How much less of u has to do.
BEYOND, _FRICTION, _LESS_OF_U = (1.7, 1.3), 0.2, 0.15
# Beside a resonance: ramps and smoothing in periods of it.
_PERIODS = (
    (0.3, 0.1), (0.15, 0.3), (0.3, 0.3), (0.6, 0.3), (1.0, 0.3), (1.0, 0.0), (1.5, 0.0), (2.0, 0.0)
)  # fmt: skip
# The shares of the step that are looked at there, too, for so many periods behind so many samples.
_SMALLER, _RINGING, _BEFORE = (0.3, 0.1, 0.03), 60.0, 10
# Steps of v_max between nothing and what the room allows. Without viscous friction u bounds no
# speed: then v_max is this multiple of the one that the largest step reaches.
_SPEEDS, _FASTER = 40, 10.0
# A move that settles within this multiple of its own duration is quick, and no other is looked for.
_QUICK = 1.1
# A slower move: factors of the acceleration, and how many are tried.
SLOWER, TRIES = 0.5, 8
# Share of the move in which u may be at a limit, and samples that are always allowed.
_LIMITED, _FEW = 0.02, 2
# The move is looked at for this multiple of the duration, and so many time constants of the loop.
_LOOKED, _AFTER = 4.0, 60.0
# Order of a reference model, steps of the bisection for its bandwidth, and its range in 1/dt.
_ORDER, _BISECTIONS, _SLOWEST = 2, 30, 1e-6
_LARGEST_ORDER = 8
ORDER_OF_AXIS = 4
"""Order of the reference model of an axis: with the same largest acceleration a step settles in
2.9, 1.8 and 1.6 times the quickest time for the orders 2, 3 and 4."""
# At limits it is made slower by this factor, so often at most; then so many between the quickest
# one that keeps within them and the next faster one.
_BANDWIDTHS, _MOST_LAGS, _BETWEEN = 0.85, 32, 3
# Slower ones are looked at until the step takes this multiple of the quickest one.
_SLOWER_THAN_BEST = 1.2
# The step near what u can hold, as a share; one that is not larger than that of the scenario by
# this factor is not looked at. Shares of the largest rate of the scenario's step and factors of the
# bandwidth that are tried, and how much slower that step may become.
_NEARLY, _LARGER, _AS_QUICK = 0.9, 1.1, 1.1
_RATES, _FASTER_MODELS = (2.0, 1.4, 1.0, 0.7), (4.0, 2.5, 1.6)
# How long it is looked at, in time constants of the loop and times of the largest rate.
_CONSTANTS_OF_LARGER = 150.0
# Other plants with which a prefilter is tried.
_OTHERS = 4


class Shaped(NamedTuple):
    """A prefilter, and the step of the file with it."""

    prefilter: Any  # None for none
    step: StepFigures | None


@dataclass(frozen=True)
class Axis:
    """The rigid part ``u = c_1 y' + c_2 y''`` of a plant that needs no u at rest."""

    viscous: float
    inertia: float

    @classmethod
    def of(cls, linear: LinearPlant, gain: float) -> Axis | None:
        """Return it, or None for a plant that needs u at rest.

        ``gain`` is that of the loop's controller [u-unit/y-unit], beside which u is small.
        """
        if not abs(held_step(linear)) <= _NO_U * gain:
            return None
        try:
            _, viscous, inertia = Feedforward.of(linear, terms=2).coefficients
        except ValueError:  # a zero at s = 0
            return None
        return cls(abs(viscous), abs(inertia)) if viscous or inertia else None

    @classmethod
    def heaviest(cls, axes: Sequence[Axis]) -> Axis:
        """Return one that needs as much u as any of several."""
        return cls(max(each.viscous for each in axes), max(each.inertia for each in axes))

    def needs(self, tau: float) -> float:
        """Return the largest u of a move by 1 in 20 time constants [u-unit/y-unit]."""
        half = 10.0 * tau
        return self.inertia / half**2 + self.viscous / half

    def profile(
        self, size: float, room: float, ramp: float, beyond: float = 1.0
    ) -> ProfileGenerator:
        """Return the generator that needs ``room`` of u at most, for a largest step ``size``.

        Speed and acceleration each need the room at most, and together ``beyond`` times the room.
        """
        inertia = max(self.inertia, self.viscous * ramp)  # an axis of order 1 follows the ramp
        if inertia == 0.0 or self.viscous * math.sqrt(size * room / inertia) < 1e-6 * room:
            a = room / inertia
            return ProfileGenerator(_FASTER * math.sqrt(size * a), a, a / ramp)
        speeds = room / self.viscous * (np.arange(_SPEEDS) + 0.5) / _SPEEDS
        times = []
        for v in speeds.tolist():
            a = min(beyond * room - self.viscous * v, room) / inertia
            reached = size >= v * v / a
            times.append((size / v + v / a if reached else 2.0 * math.sqrt(size / a)) + ramp)
        v = float(speeds[int(np.argmin(times))])
        a = min(beyond * room - self.viscous * v, room) / inertia
        return ProfileGenerator(v, a, a / ramp)

    def beyond(self, size: float, room: float) -> tuple[float, ...]:
        """Return the ``beyond`` that are tried for a move by ``size``; none without friction."""
        if self.inertia == 0.0 or room <= 0.0:
            return ()
        top = self.viscous * math.sqrt(size * room / self.inertia)
        return BEYOND if top > _FRICTION * room else ()


def behind(controller: Any, prefilter: Any, axis: int | None = None) -> Any:
    """Return a controller behind a prefilter of its reference, or of that of an axis."""
    if axis is None:
        return controller if prefilter is None else Prefiltered(controller, prefilter)
    found = copy.copy(controller)
    found.prefilters = (*found.prefilters[:axis], prefilter, *found.prefilters[axis + 1 :])
    found._initialise()
    return found


def with_less(controller: Any) -> Any:
    """Return a copy of a controller whose limits of u are nearer."""
    found, limits = copy.copy(controller), controller.limits
    share = 1.0 - _LESS_OF_U
    found.set_limits(u_min=share * limits.low, u_max=share * limits.high)
    return found


def room_of_u(
    written: Written, linear: LinearPlant, limits: tuple[float, float], u: float
) -> float:
    """Return what u may do on both sides of ``u`` at rest, less what loads need while r steps."""
    room = min(limits[1] - u, u - limits[0])
    loads = written.loads
    if loads:
        values = loads[0](np.arange(round(written.scenario.duration / written.dt)) * written.dt)
        acting = [values[first:end] for first, end, _ in written.steps] or [values]
        largest = max(float(np.max(np.abs(each - values[0]), initial=0.0)) for each in acting)
        room -= min(abs(held_load(linear)) * largest, MOST_RESERVED * room)
    return room


def profile_for(
    written: Written,
    controller: Controller,
    axis: Axis,
    tau: float,
    room: float,
    period: float = 0.0,
) -> Shaped:
    """Return the quickest profile generator with which the step of the file keeps to its limits.

    ``tau`` is the time constant of the closed loop [s], ``period`` that of a mode [s], beside which
    there may be none.
    """
    if written.largest is None:
        size = 1.0 / axis.needs(tau) * room
        return Shaped(axis.profile(size, SHARES[0] * room, max(SAMPLES[0] * written.dt, tau)), None)
    first, end, step = written.largest
    size, found = abs(step), list[tuple[float, Shaped]]()
    small = []
    if period > 0.0:
        how = max(_RINGING * period, _AFTER * tau), _BEFORE
        small = [written.stepping(share * step, *how) for share in _SMALLER]
        ramps = [(ramp * period, smoothing * period) for ramp, smoothing in _PERIODS]
    else:
        plain = *(n * written.dt for n in SAMPLES), *(n * tau for n in _CONSTANTS)
        ramps = [(ramp, 0.0) for ramp in plain]
    beyond = () if period > 0.0 else axis.beyond(size, room)
    shares = [(SHARES[0], each) for each in beyond] + [(share, 1.0) for share in SHARES]
    for generator in _profiles(axis, size, room, ramps, shares):
        own = _duration(generator, size)
        last = min(end, first + math.ceil((_LOOKED * own + _AFTER * tau) / written.dt))
        shown = _with(written, controller, generator, last)
        most = few_at_limits(own, written.dt)
        if not shown.overshoot <= MOST_OVERSHOOT or math.isnan(shown.settling):
            continue
        whole = behind(controller, generator, written.axis)
        if any(not worst_step(each, whole).overshoot <= MOST_OVERSHOOT for each in small):
            continue
        rank = shown.settling
        if shown.limited > most and beyond:
            weaker = _with(written, with_less(controller), generator, last)
            if not weaker.overshoot <= MOST_OVERSHOOT:
                continue
        elif shown.limited > most:  # comes behind all that do not
            rank = math.inf
            if period > 0.0:
                continue
        found.append((rank, Shaped(generator, shown)))
        if rank <= _QUICK * own:
            break
    if found:
        return min(found, key=lambda pair: pair[0])[1]
    if period > 0.0:
        return Shaped(None, None)
    generator = axis.profile(size, SHARES[-1] * room, max(SAMPLES[0] * written.dt, tau))
    for i in range(TRIES):
        share = SHARES[-1] * SLOWER ** (i + 1)
        generator = axis.profile(size, share * room, tau / math.sqrt(share))
        shown = _with(written, controller, generator, end)
        if shown.overshoot <= MOST_OVERSHOOT and not math.isnan(shown.settling):
            return Shaped(generator, shown)
    return Shaped(generator, None)


def _profiles(
    axis: Axis,
    size: float,
    room: float,
    ramps: Sequence[tuple[float, float]],
    shares: Sequence[tuple[float, float]],
) -> Iterator[ProfileGenerator]:
    """Yield the generators to try, quick ones first.

    ``ramps`` have ramp and smoothing [s], ``shares`` the share of the room and what is beyond it.
    """
    made = [
        replace(axis.profile(size, share * room, ramp, beyond), smoothing=smoothing)
        for share, beyond in shares
        for ramp, smoothing in ramps
    ]
    yield from sorted(made, key=lambda each: _duration(each, size))


def few_at_limits(duration: float, dt: float) -> float:
    """Return the time that u may be at a limit in a move [s]."""
    return max(_LIMITED * duration, _FEW * dt)


def _duration(generator: ProfileGenerator, size: float) -> float:
    """Return how long a move from rest takes [s]."""
    v, a, j = generator.v_max, generator.a_max, generator.j_max
    return LimitedMove(size, v, a, j).duration + generator.smoothing


def _with(written: Written, controller: Controller, prefilter: Any, last: int) -> StepFigures:
    """Return the step of the file with a prefilter, up to a sample; the worst of its plants."""
    return worst_step(written, behind(controller, prefilter, written.axis), last)


def worst_step(written: Written, controller: Controller, last: int | None = None) -> StepFigures:
    """Return the largest overshoot, settling time and time at limits of a file and other plants.

    ``last`` is the sample up to which it is looked at.
    """
    found = []
    for each in (written, *written.others[:_OTHERS]):
        until = None if last is None else each.until_settled(last * each.dt)
        figures = each.figures(controller, each.run(controller, until))
        assert figures is not None
        found.append(figures)
    times = [each.settling for each in found]
    return found[0]._replace(
        overshoot=max(each.overshoot for each in found),
        settling=math.nan if any(map(math.isnan, times)) else max(times),
        limited=max(each.limited for each in found),
    )


def reference_model_for(
    written: Written, controller: Controller, omega: float, order: int = _ORDER, within: bool = True
) -> Shaped:
    """Return the reference model with which the step of the file settles soonest.

    It overshoots by 5 % at most, and ``within`` says whether u has to keep within its limits.

    The first one tried has the bandwidth ``omega`` [rad/s], the next ones are slower.
    """
    assert written.largest is not None
    derivatives = np.ravel(getattr(controller, "derivatives", 0))[written.axis or 0]
    order = max(order, min(int(derivatives), _LARGEST_ORDER))
    end, at_limits, best = written.largest[1], Shaped(None, None), None
    omega = min(omega, 1.0 / written.dt)

    def shown_with(omega: float) -> tuple[ReferenceModel, StepFigures, bool] | None:
        """Return a model, its step and whether u keeps within its limits; None if y does not."""
        model = ReferenceModel(omega, order)
        shown = _with(written, controller, model, end)
        if not shown.overshoot <= MOST_OVERSHOOT or math.isnan(shown.settling):
            return None
        free = not within or shown.limited <= few_at_limits(shown.looked, written.dt)
        return model, shown, free

    for _ in range(_MOST_LAGS):
        tried = shown_with(omega)
        omega *= _BANDWIDTHS
        if tried is None:
            continue
        model, shown, free = tried
        if not free:
            at_limits = Shaped(model, shown) if at_limits.step is None else at_limits
        # A slower one may excite a mode less.
        elif best is None or shown.settling < best[1].settling:
            best = model, shown
        elif shown.settling > _SLOWER_THAN_BEST * best[1].settling:
            break
    if best is None:
        return at_limits
    slow, fast = best[0].omega, best[0].omega / _BANDWIDTHS
    for _ in range(_BETWEEN):
        middle = math.sqrt(slow * fast)
        tried = shown_with(middle)
        if tried is not None and tried[2] and tried[1].settling < best[1].settling:
            slow, best = middle, tried[:2]
        else:
            fast = middle
    return Shaped(*best)


def largest_step(
    written: Written, linear: LinearPlant, limits: tuple[float, float], u: float
) -> float:
    """Return nearly the largest step that u can hold, in the direction of that of the scenario."""
    assert written.largest is not None
    sign = math.copysign(1.0, written.largest[2])
    held = held_step(linear) * sign
    room = limits[1] - u if held > 0.0 else u - limits[0]
    return sign * _NEARLY * room / abs(held) if held else 0.0


def needs_none(written: Written, controller: Controller, most: float, tau: float) -> bool:
    """Return whether a process needs no prefilter: its steps overshoot by 5 % at most without.

    Arguments are those of ``bounded_rate``.
    """
    assert written.largest is not None
    steps = [written]
    if abs(most) >= _LARGER * abs(written.largest[2]):
        steps.append(written.stepping(most, _CONSTANTS_OF_LARGER * tau, _BEFORE))
    shown = [worst_step(each, controller) for each in steps]
    return all(s.overshoot <= MOST_OVERSHOOT and not math.isnan(s.settling) for s in shown)


def bounded_rate(
    written: Written, controller: Controller, model: Any, most: float, tau: float
) -> tuple[Any, StepFigures | None]:
    """Return a reference model with bounded rate, and the step by ``most`` behind it.

    Parameters
    ----------
    written
        the file, in which the step is well behind ``model``, or without one (None).
    controller
        without the model.
    most
        a larger step, which u can hold [y-unit]; a smaller one is not looked at.
    tau
        time constant of the closed loop [s].
    """
    assert written.largest is not None
    size = abs(written.largest[2])
    if abs(most) < _LARGER * size:
        return model, None

    def larger_with(prefilter: Any, slowest: float) -> StepFigures:
        """Return the larger step behind a prefilter."""
        last = _CONSTANTS_OF_LARGER * tau + _LOOKED * abs(most) / slowest
        whole = behind(controller, prefilter)
        return worst_step(written.stepping(most, last, _BEFORE), whole)

    first = model or ReferenceModel(min(1.0 / tau, 1.0 / written.dt), _ORDER)
    # The largest rate of the model's own step: ω (m − 1)^(m−1) e^(1−m)/(m − 1)! of its size.
    m = first.order
    own = first.omega * size * (m - 1) ** (m - 1) * math.exp(1 - m) / math.factorial(m - 1)
    plain = larger_with(model, own)
    well = plain.overshoot <= MOST_OVERSHOOT and not math.isnan(plain.settling)
    if model is None and well:
        return None, plain
    usual = worst_step(written, behind(controller, model))
    best, latest = (model, plain), (1.0 if well else _AS_QUICK) * usual.settling
    for share, factor in itertools.product(_RATES, _FASTER_MODELS):
        omega = min(factor * first.omega, 1.0 / written.dt)
        tried = replace(first, omega=omega, rate_limit=float(f"{share * own:.4g}"))
        step = worst_step(written, Prefiltered(controller, tried))
        limited = step.limited > max(few_at_limits(step.looked, written.dt), usual.limited)
        if limited or not (step.overshoot <= MOST_OVERSHOOT and step.settling < latest):
            continue
        shown = larger_with(tried, tried.rate_limit)
        if shown.overshoot <= MOST_OVERSHOOT and not math.isnan(shown.settling):
            best, latest = (tried, shown), step.settling
    return best


def model_of_linear_step(plants: PlantSet, controller: Controller) -> ReferenceModel | None:
    """Return the fastest reference model with which the linear loop overshoots by 5 % at most.

    None where it does so without one.
    """
    inputs, law = loops.reference_step(plants), law_of(controller)
    y, dt = response(plants.scaled()[0], law, inputs), plants.dt * inputs.distance
    if not np.all(np.isfinite(y)) or np.max(y) - 1.0 <= MOST_OVERSHOOT:
        return None
    # With the pulse response any prefilter is a convolution.
    pulse = np.diff(y, prepend=0.0)
    low, high, best = _SLOWEST / dt, 1.0 / dt, None
    for _ in range(_BISECTIONS):
        omega = math.sqrt(low * high)
        if np.max(_behind(ReferenceModel(omega, _ORDER), pulse, dt)) - 1.0 <= MOST_OVERSHOOT:
            low, best = omega, ReferenceModel(omega, _ORDER)
        else:
            high = omega
    return best


def _behind(model: ReferenceModel, pulse: Vector, dt: float) -> Vector:
    """Return the response to a step through a prefilter (k,)."""
    from scipy.signal import lfilter

    # All its poles are at the same place: r_f is the step through that many equal lags.
    lag = math.exp(-model.omega * dt)
    found = np.cumsum(pulse)
    for _ in range(model.order):
        found = lfilter([1.0 - lag], [1.0, -lag], found)
    return np.asarray(found, dtype=np.float64)
