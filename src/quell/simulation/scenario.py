"""A scenario: signals, duration and initial state of a run; its samples, evaluated in segments."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, field, fields, is_dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.checks import Described
from quell.controllers.base import Controller
from quell.controllers.several import inputs_of, outputs_of, references_of
from quell.hints import explained
from quell.plants.base import Plant
from quell.plants.base import inputs_of as inputs_of_plant
from quell.plants.base import outputs_of as outputs_of_plant
from quell.plants.channels import named
from quell.records.record import first_sample_at, in_steps
from quell.signals import BandLimitedNoise, Constant, Signal, as_signal, seeded_apart
from quell.signals.shapes import check_derivative
from quell.types import Matrix, Vector, warn

# ---- A scenario ----


@explained("quell.Scenario(reference=1.0, duration=10.0, disturbances=(load,))")
@dataclass(frozen=True, repr=False)
class Scenario(Described):
    """Signals, duration and initial state of a run.

    Parameters
    ----------
    reference
        signal or number that y has to follow [y-unit]; for several axes a sequence with one for
        each.
    disturbances
        one signal or number for each disturbance input of the plant, in its order; missing ones are
        zero.
    noise
        signal added to y before the controller sees it; none by default. For several outputs one
        for all, which draws numbers of its own for each, or a sequence with one for each.
    duration
        length of the run [s]; the record has the samples from 0 to ``duration``, both included.
    x0
        the plant's state at the start; zero by default.
    rest_at
        times [s] at which the plant is put back to ``x0`` and the controller starts from rest; it
        keeps what it has learned.
    schedule
        external signals that the controller's ``Schedule`` follows, in its order; as many as it
        has.
    seed
        seed of all random signals; the same seed gives the same bits.

    Raises
    ------
    ValueError
        if the duration is not positive, the seed is negative, a signal is none, or the times in
        ``rest_at`` do not increase within the duration.
    """

    reference: Signal | float | Sequence[Signal | float] = 0.0
    duration: float = 10.0
    disturbances: Sequence[Signal | float] = ()
    noise: Signal | float | Sequence[Signal | float] = 0.0
    x0: ArrayLike | None = None
    rest_at: Sequence[float] = field(default=())
    seed: int = 0
    schedule: Sequence[Signal | float] = ()

    def __post_init__(self) -> None:
        checks.positive("duration", self.duration, "s")
        checks.whole("seed", self.seed, 0)
        for name in ("reference", "noise", "disturbances", "schedule"):
            given = getattr(self, name)
            if name in ("reference", "noise") and not checks.is_sequence(given):
                as_signal(given, name)
                continue
            if not checks.is_sequence(given):
                raise ValueError(f"{name} = {given!r}: must be a sequence of signals or numbers")
            for i, signal in enumerate(given):
                as_signal(signal, f"{name}[{i}]")
        times = np.array([0.0, *checks.vector("rest_at", self.rest_at), self.duration])
        if np.any(np.diff(times) <= 0.0):
            rule = f"must increase and lie within (0, duration = {self.duration!r})"
            raise ValueError(f"rest_at = {self.rest_at!r}: {rule}")

    def seeded_signals(self, inputs: int) -> tuple[Signal, tuple[Signal, ...], Signal]:
        """Return the reference, ``inputs`` disturbances and the noise of one axis, seeded.

        Setup files and tuning take no list in the place of one signal; ``simulate`` takes one of
        one.
        """
        for name in ("reference", "noise"):
            if checks.is_sequence(given := getattr(self, name)):
                raise ValueError(_one_signal(name, given))
        reference, disturbances, noise = self.seeded(1, inputs, 1)
        return reference[0], disturbances, noise[0]

    def seeded(
        self, references: int, inputs: int, outputs: int, plant: Any = None
    ) -> tuple[tuple[Signal, ...], tuple[Signal, ...], tuple[Signal, ...]]:
        """Return references, disturbances and noise, as many as there are, seeded.

        ``plant`` is the one whose disturbances they are, for errors.
        """
        given = tuple(map(as_signal, self.disturbances))
        if len(given) > inputs:
            have = checks.counted(len(given), "signal")
            most = checks.counted(inputs, "disturbance input")
            raise ValueError(f"disturbances has {have}: the plant has {most}{named(plant, 'w')}")
        alone = references == outputs == 1
        reference = _one_for_each("reference", self.reference, references, alone)
        noise = _one_for_each("noise", self.noise, outputs, alone)
        if outputs == 1:
            # The noise has the seed itself: its bits must not depend on the number of disturbances.
            noise = (noise[0].seeded(self.seed),)
            every = tuple(seeded_apart((*reference, *given), self.seed))
        else:
            # Signals are seeded apart, so the noise of each output has numbers of its own.
            every = tuple(seeded_apart((*reference, *given, *noise), self.seed))
            noise = every[-outputs:]
        disturbances = every[references : references + len(given)]
        return (every[:references], disturbances + (Constant(0.0),) * (inputs - len(given)), noise)


def _one_for_each(name: str, given: Any, count: int, alone: bool) -> tuple[Signal, ...]:
    """Return a signal for each axis or output, from one for all or one for each.

    ``alone`` says whether the loop has one of each.
    """
    if not checks.is_sequence(given):
        return (as_signal(given, name),) * count
    if len(given) != count:
        have = checks.counted(len(given), "signal")
        if alone:
            raise ValueError(_one_signal(name, given))
        what = "axes" if name == "reference" else "outputs"
        raise ValueError(f"{name} has {have}: there are {count} {what}, give one each")
    return tuple(as_signal(each, f"{name}[{i}]") for i, each in enumerate(given))


def _one_signal(name: str, given: Any) -> str:
    """Return the error about a list in the place of one signal."""
    return (
        f"{name} = {given!s:.60}: is a list of {checks.counted(len(given), 'signal')}, and the "
        "loop has one output: must be one number or signal, without brackets; several axes are "
        "controlled by quell.Axes"
    )


def check_scenario(value: Any, name: str = "scenario") -> None:
    """Raise a ``ValueError`` if ``value``, the argument ``name``, is not a scenario."""
    if isinstance(value, type) or not hasattr(value, "seeded_signals"):
        raise ValueError(f"{name} = {value!r}: must be a quell.Scenario")


def is_random(scenario: Scenario) -> bool:
    """Return whether another seed changes a signal of a scenario."""
    given = (scenario.reference, scenario.noise, scenario.disturbances, scenario.schedule)
    several: list[Any] = [each if checks.is_sequence(each) else (each,) for each in given]
    return any(_is_drawn(as_signal(each)) for signals in several for each in signals)


def _is_drawn(signal: Signal) -> bool:
    one, other = signal.seeded(0), signal.seeded(1)
    try:
        return one is not other and one != other
    except ValueError:  # signals that hold arrays
        return True


# ---- A scenario as the samples of a loop, evaluated in segments ----

# Samples for which signals are evaluated at once: enough that Python's share of the time is small,
# few enough to stay in the processor's cache. Chosen by hand.
_SEGMENT = 8192
# Times the largest of 1, |x0| and the reference: |y| beyond it has diverged. Chosen by hand, far
# above the overshoot of any loop.
DIVERGED = 1e6
# Times the same: |y| beyond it is outside of the usual range. Chosen by hand.
UNUSUAL = 10.0
_NOTHING = Constant(0.0)  # what inputs without a signal get
# Noise with a shorter sample time, in units of dt, was not meant so. Chosen by hand: a sensor that
# is sampled twice as quickly as the loop is usual.
_QUICKEST_NOISE = 0.1
# Up to here time in steps of dt is exact to a thousandth of a step (2e-16 · 1e12).
_MOST_SAMPLES = 10**12


class Segment(NamedTuple):
    """The signals at some consecutive samples: a column for each reference or output."""

    first: int
    dt: float
    from_rest: bool  # true if the loop starts from rest at the first of them
    r: Matrix
    derivatives: Matrix
    w: Matrix
    noise: Matrix


@dataclass(frozen=True, eq=False)
class SampledScenario:
    """A scenario for a plant and a controller."""

    reference: tuple[Signal, ...]
    derivatives: tuple[Signal, ...]  # those that the first axis uses, …, and those of a schedule
    disturbances: tuple[Signal, ...]
    noise: tuple[Signal, ...]
    samples: int
    dt: float
    x0: Vector
    limit: float
    range: float  # |y| beyond it is unusual, though the run may not have diverged [y-unit]
    rest_samples: frozenset[int]

    @classmethod
    def of(
        cls, scenario: Scenario, plant: Plant, controller: Controller, limit: float | None
    ) -> SampledScenario:
        """Sample a scenario for a plant and a controller; ``limit`` as in ``simulate``."""
        check_fit(plant, controller)
        dt = controller.dt
        samples, x0 = samples_and_start(scenario, plant, dt)
        reference, disturbances, noise = scenario.seeded(
            references_of(controller), plant.disturbances, outputs_of(controller), plant
        )
        derivatives = derivatives_in(reference, controller)
        derivatives += _schedule_signals(scenario, controller)
        size = max(size_of(signal, x0, samples, dt) for signal in reference)
        return cls(
            reference,
            tuple(derivatives),
            disturbances,
            noise,
            samples,
            dt,
            x0,
            DIVERGED * size if limit is None else checks.positive("limit", limit),
            UNUSUAL * size,
            rest_samples(scenario, dt, samples),
        )

    def segment(self, first: int, last: int) -> Segment:
        """Return the samples from ``first`` to before ``last``."""
        t = np.arange(first, last, dtype=np.float64) * self.dt
        every = (self.reference, self.derivatives, self.disturbances, self.noise)
        columns = [columns_at(signals, t) for signals in every]
        return Segment(first, self.dt, first in self.rest_samples, *columns)


def derivatives_in(reference: Sequence[Signal], controller: Controller) -> list[Signal]:
    """Return the derivatives of the references that a controller uses, axis by axis."""
    given: Any = getattr(controller, "derivatives", 0)
    counts = given if isinstance(given, tuple) else (given,)
    found: list[Signal] = []
    for derivative, count in zip(reference, counts, strict=False):
        for _ in range(count):
            check_derivative(derivative)
            derivative = derivative.derivative()
            found.append(derivative)
    return found


def check_fit(plant: Any, controller: Any) -> None:
    """Raise a ``ValueError`` unless a plant has as many signals as a controller."""
    own = inputs_of(controller), outputs_of(controller)
    of_plant = inputs_of_plant(plant), outputs_of_plant(plant)
    if own == of_plant:
        return
    u = checks.counted(of_plant[0], "control signal")
    y = checks.counted(of_plant[1], "output")
    remedy = (
        "control it by quell.Axes"
        if own == (1, 1)
        else "must be a plant with as many, for example quell.plants.arm()"
    )
    raise ValueError(
        f"plant = {getattr(plant, 'name', plant)!r} has {u}{named(plant, 'u')} and "
        f"{y}{named(plant, 'y')}, the controller {own[0]} and {own[1]}: {remedy}"
    )


def samples_and_start(scenario: Scenario, plant: Any, dt: float) -> tuple[int, Vector]:
    """Return the number of samples of a run, and the plant's state at its start."""
    samples, x0 = checked_start(scenario, plant, dt)
    _warn_of_times(scenario, dt, samples)
    return samples, x0


def checked_start(scenario: Scenario, plant: Any, dt: float) -> tuple[int, Vector]:
    """Do what ``samples_and_start`` does, without warnings about the times."""
    duration = scenario.duration
    if duration / dt > _MOST_SAMPLES:
        raise ValueError(
            f"duration = {duration!r} s with dt = {dt!r} s: must be at most "
            f"{_MOST_SAMPLES:.0e} samples"
        )
    given = scenario.x0
    x0 = np.zeros(plant.order) if given is None else checks.vector("x0", given, plant.order)
    return math.floor(in_steps(duration, dt)) + 1, x0


def rest_samples(scenario: Scenario, dt: float, samples: int) -> frozenset[int]:
    """Return the samples at which the plant is put back to its start."""
    return frozenset(first_sample_at(time, dt, samples) for time in scenario.rest_at)


def check_schedule(scenario: Scenario, controller: Controller) -> None:
    """Raise a ``ValueError`` unless a scenario has as many signals as the schedule follows."""
    given, used = len(scenario.schedule), int(getattr(controller, "external_signals", 0))
    if given != used:
        raise ValueError(
            f"scenario.schedule has {checks.counted(given, 'signal')}, and the schedule of the "
            f"controller follows {used} external ones: must be as many"
        )


def _schedule_signals(scenario: Scenario, controller: Controller) -> list[Signal]:
    """Return the external signals of a controller's schedule, seeded."""
    check_schedule(scenario, controller)
    if not scenario.schedule:
        return []
    reference: Any = scenario.reference
    before = (reference, *scenario.disturbances)  # which have the first seeds
    signals = [as_signal(each) for each in (*before, *scenario.schedule)]
    return list(seeded_apart(signals, scenario.seed)[len(before) :])


def sampled_schedule(scenario: Scenario, controller: Controller) -> Matrix:
    """Return the external signals of a controller's schedule at each sample (N, signals)."""
    samples = math.floor(in_steps(scenario.duration, controller.dt)) + 1
    t = controller.dt * np.arange(samples, dtype=np.float64)
    return columns_at(tuple(_schedule_signals(scenario, controller)), t)


def segments(scenario: Any) -> Iterator[Any]:
    """Return an iterator over all segments, which evaluates the next one in another thread.

    The compiled loop releases the interpreter lock, so the signals then cost no time.
    """
    bounds = deque(segment_bounds(scenario.samples, scenario.rest_samples))
    if len(bounds) == 1:
        yield scenario.segment(*bounds[0])
        return
    context = copy_context()  # with the caller's np.errstate

    def evaluate(samples: tuple[int, int]) -> Any:
        return context.run(scenario.segment, *samples)

    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(evaluate, bounds.popleft())
        while bounds:
            segment = coming.result()
            coming = thread.submit(evaluate, bounds.popleft())
            yield segment
        yield coming.result()


def segment_bounds(samples: int, rest_samples: Iterable[int]) -> list[tuple[int, int]]:
    """Return begin and end of segments; starts from rest are only at the beginning of one."""
    return list(pairwise(sorted({*range(0, samples, _SEGMENT), *rest_samples, samples})))


def _warn_of_times(scenario: Scenario, dt: float, samples: int) -> None:
    """Warn of a duration between two samples, and of noise that is far quicker than the samples."""
    last = (samples - 1) * dt
    if in_steps(scenario.duration, dt) != samples - 1:
        warn(
            f"duration = {scenario.duration!r} s with dt = {dt!r} s: is no whole number of "
            f"samples, so the run ends at {last:.9g} s; {last + dt:.9g} s is the next one"
        )
    for name, value in (("noise", scenario.noise), ("disturbances", scenario.disturbances)):
        for noise in _noises(value):
            if noise.power > 0.0 and noise.sample_time < _QUICKEST_NOISE * dt:
                warn(
                    f"{name}: sample_time = {noise.sample_time!r} s is far below dt = {dt!r} s: "
                    "each sample sees one draw, whose variance power/sample_time = "
                    f"{noise.power / noise.sample_time:.3g} is that of a much wider band; "
                    "give sample_time = dt, or the power for it"
                )


def _noises(value: Any) -> Iterator[BandLimitedNoise]:
    """Return an iterator over all noises in a signal, or in a sequence of signals."""
    if isinstance(value, BandLimitedNoise):
        yield value
    elif isinstance(value, Signal) and is_dataclass(value):
        for field in fields(value):
            yield from _noises(getattr(value, field.name))
    elif checks.is_sequence(value):
        for part in value:
            yield from _noises(part)


def columns_at(signals: tuple[Signal, ...], t: Vector) -> Matrix:
    """Return signals at the times ``t`` as the columns of a matrix."""
    columns = np.zeros((t.size, len(signals)))
    for j, signal in enumerate(signals):
        if signal != _NOTHING:
            columns[:, j] = signal(t)
    return columns


def size_of(reference: Signal, x0: Vector, samples: int, dt: float) -> float:
    """Return the largest of 1, ``|x0|`` and the reference in the first samples.

    The limit depends on these because a loop in encoder counts has large values and is stable.
    """
    early = reference(np.arange(min(samples, _SEGMENT)) * dt)
    largest = np.max(np.abs(early), initial=1.0, where=np.isfinite(early))
    return float(np.max(np.abs(x0), initial=largest))
