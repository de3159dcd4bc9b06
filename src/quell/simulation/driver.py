"""The compiled driver: scenarios in segments, plant and controller, judgement of the integration.

A scenario: signals, duration and initial state of a run.

The inner loop: a plant and a controller, sample by sample, in segments of a scenario.

Verdict on finished runs: whether their integration is poor, or why a run diverged.

A loop that diverges for its own reasons often becomes too fast for its sub-steps at last. So a run
that diverged is repeated with enough sub-steps: only if it does not diverge then, the integration
was the cause. A run whose state is suddenly no number has met a function of the user that is not
defined there.

Check of a plant's numerical integration along a run, by step doubling.

From some recorded samples the plant is integrated over one sample with its sub-steps and with twice
as many. Of a method of order 4 the difference is 15/16 of the error (Hairer, Nørsett & Wanner,
*Solving Ordinary Differential Equations I*, II.4). Plants that are solved exactly are not checked.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quell import checks
from quell.controllers.base import (
    Controller,
    reset_loop,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.several import control_all, outputs_of, references_of
from quell.kernels.dispatch import (
    call_specialised,
    compiled,
    compiled_loop,
    explain_compile_errors,
    interpreted,
    is_available,
    kernel,
    specialised,
)
from quell.plants.base import (
    Plant,
    advance,
    as_input,
    begin_run,
    check_run,
    inputs_of,
    measure_all,
)
from quell.plants.base import outputs_of as outputs_of_plant
from quell.plants.channels import EncodedOutputsModel, named
from quell.plants.friction import FrictionModel
from quell.plants.linear import DelayedPlantModel, EncodedPlantModel
from quell.plants.nonlinear import (
    CompiledNonlinear,
    CompiledOfMany,
    CompiledParametric,
    PythonNonlinear,
    PythonOfMany,
    refined,
)
from quell.records.metrics import runs_away
from quell.records.record import columns_of, first_sample_at, in_steps
from quell.signals import BandLimitedNoise, Constant, Signal, as_signal, seeded_apart
from quell.signals.shapes import check_derivative
from quell.types import Channels, Matrix, Status, Vector, called_by_quell, warn

# ---- A scenario ----


@dataclass(frozen=True)
class Scenario:
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
        return (
            every[:references],
            disturbances + (Constant(0.0),) * (inputs - len(given)),
            noise,
        )


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
    own = int(getattr(controller, "inputs", 1)), outputs_of(controller)
    of_plant = inputs_of(plant), outputs_of_plant(plant)
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


# ---- Check of a plant's numerical integration along a run, by step doubling ----

# Largest error of a state in a sample, as a share of the state's largest value. A linear mode
# reaches it where h |λ| is about 1; stiff friction that is integrated well has 1e-4, and one that
# is not resolved 0.1 and more. Chosen by hand.
LARGEST_ERROR = 0.01
# Samples that are checked in a segment: spread over it, and where the states turn most sharply.
_SPREAD, _SHARPEST = 16, 16
# Most doublings of the sub-steps that are tried for advice.
_MOST_DOUBLINGS = 10
_WRAPPERS = (EncodedPlantModel, DelayedPlantModel, EncodedOutputsModel)


class Samples(NamedTuple):
    """Samples of a run, from which the plant is integrated over one sample."""

    t: Vector  # [s] (k,)
    u: Matrix  # (k, m)
    w: Matrix  # (k, q)
    x: Matrix  # (k, n)


@compiled
def step_differences(
    coarse: Any,
    fine: Any,
    t: Vector,
    u: Matrix,
    w: Matrix,
    x: Matrix,
    scratch: Vector,
    after: Matrix,
    difference: Matrix,
) -> None:
    """Write the states after a sample, and what ``coarse`` and ``fine`` differ by, (k, n) each."""
    for k in range(t.size):
        for j in range(x.shape[1]):
            after[k, j] = x[k, j]
            difference[k, j] = x[k, j]
        acting = as_input(coarse, u[k])
        advance(coarse, difference[k], scratch, t[k], acting, w[k])
        advance(fine, after[k], scratch, t[k], acting, w[k])
        for j in range(x.shape[1]):
            difference[k, j] -= after[k, j]


class IntegrationCheck:
    """The check of one run.

    ``error`` is the largest so far, as a share of the state's range; ``enough`` is a number of
    sub-steps with which it is small, zero if none was found.
    """

    def __init__(self, model: Any, as_python: bool) -> None:
        self._size = self._delay = 0
        while isinstance(model, _WRAPPERS):
            if isinstance(model, DelayedPlantModel):
                self._size, self._delay = model.size, 1
            model = model.inner
        several = CompiledOfMany | PythonOfMany
        kinds = CompiledNonlinear | CompiledParametric | PythonNonlinear | FrictionModel | several
        self.needed = isinstance(model, kinds)
        self.model, self.error, self.enough = model, 0.0, 0
        self._step_differences = (
            interpreted(step_differences)
            if as_python
            else partial(call_specialised, step_differences)
        )

    def acquit(self) -> None:
        """Forget the errors: the run diverges with enough sub-steps, too."""
        self.error = 0.0

    @property
    def poor(self) -> bool:
        """True if there were too few sub-steps."""
        return self.error > LARGEST_ERROR

    def add(self, samples: Samples, all_of_them: bool) -> None:
        """Check samples of a segment, some or all of them."""
        if not samples.t.size:
            return
        t, u, w, x = samples
        finite = np.all(np.isfinite(x), axis=1)
        if not np.all(finite):
            self.add(Samples(*(part[finite] for part in samples)), all_of_them)
            return
        if self._delay:  # the state ends with the values of u on their way, the oldest last
            u, x = x[:, -1:], x[:, : self._size]
        scale = np.max(np.abs(x), axis=0)
        chosen = slice(None) if all_of_them else chosen_samples(x, scale)
        picked = Samples(*(np.ascontiguousarray(part[chosen]) for part in (t, u, w, x)))
        errors = self._errors(self.model, picked, scale)
        error, worst = float(np.max(errors)), int(np.argmax(errors))
        if error > max(self.error, LARGEST_ERROR):
            factor = self._factor(Samples(*(part[worst : worst + 1] for part in picked)), scale)
            self.enough = factor * self.model.substeps
        self.error = max(self.error, error)

    def _factor(self, worst: Samples, scale: Vector) -> int:
        """Return how many times as many sub-steps are enough for a sample; 0 if none is found."""
        factors = (2**i for i in range(1, _MOST_DOUBLINGS + 1))
        enough = (
            factor
            for factor in factors
            if self._errors(refined(self.model, factor), worst, scale)[0] <= LARGEST_ERROR
        )
        return next(enough, 0)

    def _errors(self, model: Any, samples: Samples, scale: Vector) -> Vector:
        """Return the largest error of a state in each sample, as a share of the state's range."""
        after, difference = np.empty_like(samples.x), np.empty_like(samples.x)
        with np.errstate(all="ignore"):
            self._step_differences(
                model, refined(model, 2), *samples, np.zeros(6 * scale.size), after, difference
            )
            before = after + difference  # with the plant's own sub-steps
            range_ = np.maximum(scale, np.maximum(np.abs(after), np.abs(before)))
            share = np.abs(difference) / np.where(range_ > 0.0, range_, 1.0)
        return np.asarray(np.max(np.where(np.isfinite(share), share, 1.0), axis=1))


def chosen_samples(x: Matrix, scale: Vector) -> Any:
    """Return the indices of samples that are spread over a segment, or turn most sharply."""
    if len(x) <= _SPREAD + _SHARPEST:
        return slice(None)
    spread = np.linspace(0, len(x) - 1, _SPREAD).astype(np.int64)
    turn = np.abs(np.diff(x, 2, axis=0)) / np.where(scale > 0.0, scale, 1.0)
    sharpest = np.argpartition(np.max(turn, axis=1), -_SHARPEST)[-_SHARPEST:] + 1
    return np.unique(np.concatenate([spread, sharpest]))


def with_substeps(model: Any, substeps: int) -> Any:
    """Return the sampled plant of a check, or one that contains it, with so many sub-steps."""
    if isinstance(model, _WRAPPERS):
        return model._replace(inner=with_substeps(model.inner, substeps))
    return refined(model, substeps // model.substeps)


# ---- The inner loop ----

SIGNALS = ("r", "y", "y_measured", "u")  # the first channels of a log


class Sample(NamedTuple):
    """The signals of one sample; as fields their sizes are constants in compiled code."""

    r: Vector  # references (n,)
    y: Vector  # outputs (p,)
    measured: Vector  # the same with noise (p,)
    u: Vector  # control signals (m,)


def sample_of(plant: Any, controller: Any) -> Sample:
    """Return room for the signals of a sample of a loop."""
    outputs = outputs_of_plant(plant)
    widths = (references_of(controller), outputs, outputs, inputs_of(plant))
    return Sample(*map(np.zeros, widths))


@compiled_loop("plant", "design", "r", "derivatives", "w", "noise")
def run_block(
    plant: Any,
    x: Vector,
    scratch: Vector,
    design: Any,
    state: Any,
    sample: Sample,
    t0: float,
    dt: float,
    r: Matrix,
    derivatives: Matrix,
    w: Matrix,
    noise: Matrix,
    log: Matrix,
    row: int,
    every: int,
    until_next: int,
    limit: float,
) -> tuple[int, int, int, int]:
    """Run ``r.shape[0]`` samples from the time ``t0``; log every ``every``-th from ``row`` on.

    ``sample`` is work space. A log with as many columns as ``SIGNALS`` have gets only these.
    Returns the number of samples that were run (fewer if the loop diverged: ``|y|`` beyond
    ``limit``, or not finite), the next row, the number of samples until it is written, and all
    status flags.
    """
    y, u = sample.y, sample.u
    references, outputs, inputs = sample.r.size, y.size, w.shape[1]
    first_u = references + 2 * outputs
    first_w = first_u + u.size
    first_x = first_w + inputs
    status = 0
    for k in range(r.shape[0]):
        measure_all(plant, x, y)
        for i in range(outputs):
            if not abs(y[i]) <= limit:
                return k, row, until_next, status
            sample.measured[i] = y[i] + noise[k, i]
        for i in range(references):
            sample.r[i] = r[k, i]
        if derivatives.shape[1] > 0:
            set_reference_derivatives(design, state, derivatives[k])
        control_all(design, state, sample.r, sample.measured, u)
        status |= status_flags(design, state)
        if until_next == 0:
            for i in range(references):
                log[row, i] = sample.r[i]
            for i in range(outputs):
                log[row, references + i] = y[i]
                log[row, references + outputs + i] = sample.measured[i]
            for i in range(u.size):
                log[row, first_u + i] = u[i]
            if log.shape[1] > first_w:
                for j in range(inputs):
                    log[row, first_w + j] = w[k, j]
                for j in range(x.size):
                    log[row, first_x + j] = x[j]
                write_row(design, state, log[row, first_x + x.size :])
            row += 1
            until_next = every
        until_next -= 1
        advance(plant, x, scratch, t0 + k * dt, as_input(plant, u), w[k])
    return r.shape[0], row, until_next, status


run_samples = kernel(interpreted(run_block))
"""``run_block`` for compiled loops over several loops, which call it for each of them."""


class Loop:
    """A plant and a controller during a run; ``run`` takes them through a segment.

    ``like`` is a loop with the same controller and a model of the same layout, which runs the same
    code.
    """

    block: Any = staticmethod(run_block)

    def __init__(
        self,
        plant: Any,
        model: Any,
        controller: Any,
        scenario: Any,
        interpret: bool,
        like: Loop | None = None,
    ) -> None:
        self.plant, self.controller, self.interpret = plant, controller, interpret
        self.model, self.design = model, controller.parameters
        self.state = controller.initial_state()
        self.x0, self.limit = scenario.x0, scenario.limit
        self.x, self.scratch = scenario.x0.copy(), np.zeros(6 * plant.order)
        self._sample = sample_of(plant, controller)
        begin_run(model, self.x, self.scratch)
        self.done = self.status = self.until_next = 0
        as_python = interpret or not plant.compiled
        self.integration = IntegrationCheck(model, as_python)
        self.scenario = scenario
        self._as_python = as_python
        self._like = like
        self.last_row: Vector | None = None  # of the log, if the run diverged after it
        self._run_block: Any = None  # the compiled function, from the first segment on

    def _entry(self, function: Any, *arguments: Any) -> Any:
        """Return a function to call with arguments like these."""
        return interpreted(function) if self._as_python else specialised(function, *arguments)

    @property
    def diverged(self) -> bool:
        """True if it has ended early."""
        return bool(self.status & Status.DIVERGED)

    @property
    def width(self) -> int:
        """Number of columns of its log."""
        return sum(width for _, width in logged_channels(self.plant, self.controller))

    @property
    def result_status(self) -> Status:
        """All flags of the run, with that of its integration."""
        poor = Status.POORLY_INTEGRATED if self.integration.poor else Status.OK
        return Status(self.status) | poor

    @property
    def ended(self) -> int:
        """The sample at which it ended."""
        return self.done if self.diverged else self.done - 1

    def run(self, segment: Segment, log: Matrix, row: int, every: int) -> int:
        """Run a segment, log every ``every``-th sample from ``row`` on, and return the next row."""
        first, dt, from_rest = segment[:3]
        from_row, from_sample = row, first + self.until_next
        # An interpreted loop that diverges would warn of every overflow; the status reports it
        # once.
        with (
            np.errstate(all="ignore"),
            explain_compile_errors(self.model, self.design),
        ):
            if from_rest:
                self.x[:] = self.x0
                begin_run(self.model, self.x, self.scratch)
                reset_loop(self.design, self.state)  # it is short: to compile it takes longer
            arguments = self._arguments(segment, log, row, every)
            if self._run_block is None:
                other = None if self._like is None else self._like._run_block
                self._run_block = other or self._entry(self.block, *arguments)
            samples, row, self.until_next, flags = self._run_block(*arguments)
        check_run(self.model, self.scratch)
        self.done = first + samples
        if samples < len(segment.r) and row > 0:
            self.last_row = log[row - 1].copy()
        self.status |= flags if samples == len(segment.r) else flags | Status.DIVERGED
        if self.integration.needed:
            self._check_integration(log[from_row:row], from_sample, every, dt)
        return int(row)

    def run_through(self, every: int, progress: Callable[[float], None] | None) -> Matrix:
        """Run the whole scenario, judge the integration, and return the log of a single run."""
        samples = self.scenario.samples
        log, row = np.empty(((samples - 1) // every + 1, self.width)), 0
        for segment in segments(self.scenario):
            row = self.run(segment, log, row, every)
            if self.diverged:
                break
            if progress is not None:
                progress(self.done / samples)
        judge_integration(self.plant.name, [self])
        return log[:row]

    def is_compiled(self, segment: Segment) -> bool:
        """Return whether its code is in this process, or in the disk cache."""
        log = np.empty((1, self.width))
        return self._as_python or is_available(self.block, *self._arguments(segment, log, 0, 1))

    def _arguments(self, segment: Segment, log: Matrix, row: int, every: int) -> tuple[Any, ...]:
        """Return the arguments of ``run_block``."""
        first, dt, _, *signals = segment
        loop = (self.model, self.x, self.scratch, self.design, self.state, self._sample)
        times = first * dt, dt
        return (*loop, *times, *signals, log, row, every, self.until_next, self.limit)

    def _check_integration(self, log: Matrix, first: int, every: int, dt: float) -> None:
        """Check the plant's integration at rows of the log, ``every`` samples apart.

        Of a run that diverged only the rows before it left its usual range count: far outside, a
        loop that diverges for another reason may be too fast for its sub-steps, too.
        """
        if self.diverged:
            usual = [self.is_usual(row) for row in log]
            log = log[: int(np.argmin(np.append(usual, False)))]
        t = (first + every * np.arange(log.shape[0], dtype=np.float64)) * dt
        first_state = self.first_state
        w = log[:, first_state - self.plant.disturbances : first_state]
        x = log[:, first_state : first_state + self.x.size]
        self.integration.add(Samples(t, self.controls(log), w, x), all_of_them=self.diverged)

    @property
    def first_state(self) -> int:
        """The first column of a log that has the plant's state."""
        return width_of_signals(self.plant, self.controller) + int(self.plant.disturbances)

    def controls(self, log: Matrix) -> Matrix:
        """Return the control signals of rows of a log (rows, m)."""
        last = width_of_signals(self.plant, self.controller)
        return log[:, last - inputs_of(self.plant) : last]

    def is_usual(self, row: Vector) -> bool:
        """Return whether all outputs of a row of a log are in their usual range."""
        first = references_of(self.controller)
        y = row[first : first + outputs_of_plant(self.plant)]
        return bool(np.all(np.abs(y) <= self.scenario.range))

    def measured(self) -> Vector:
        """Return the outputs now (p,)."""
        y = np.zeros(outputs_of_plant(self.plant))
        measure_all(self.model, self.x, y)
        return y


def width_of_signals(plant: Any, controller: Any) -> int:
    """Return the number of columns of ``SIGNALS`` in a log."""
    return sum(part.size for part in sample_of(plant, controller))


def logged_channels(plant: Any, controller: Any) -> Channels:
    """Return name and width of the columns that ``run_block`` logs, in order."""
    widths = (part.size for part in sample_of(plant, controller))
    signals = tuple(zip(SIGNALS, widths, strict=True))
    return (*signals, ("w", plant.disturbances), ("x", plant.order), *controller.channels)


# ---- Verdict on finished runs ----


def judged(log: Any, channels: Channels, loops: Sequence[Loop]) -> NDArray[np.int64]:
    """Return all flags of finished runs, with ``RAN_AWAY`` where y of an axis left r (runs,).

    ``log`` (runs, samples, columns) has the channels ``r`` and ``y``, or nothing more is known. A
    run that diverged has its own flag.
    """
    status = np.array([int(loop.result_status) for loop in loops], dtype=np.int64)
    names = [name for name, _ in channels]
    if "r" not in names or "y" not in names:
        return status
    r, y = (log[..., columns_of(channels, name)] for name in "ry")
    u = log[..., columns_of(channels, "u")] if "u" in names else log[..., :0]
    # Of a loop with another number of outputs than references nothing says which belong together.
    axes = r.shape[-1] if r.shape[-1] == y.shape[-1] else 0
    ended = np.array([loop.diverged for loop in loops])
    for i in range(axes):
        status[runs_away(r[..., i], y[..., i], u) & ~ended] |= int(Status.RAN_AWAY)
    return status


def warn_of_lost(runs: Any) -> None:
    """Warn a user who called ``simulate`` of runs that diverged, or whose y ran away.

    ``simulate`` calls this, for a run or a batch.
    """
    if np.any(runs.lost) and not called_by_quell(2):
        warn(f"{runs.plant}: {runs.message}")


def judge_integration(plant: str, loops: Sequence[Loop]) -> None:
    """Find the cause of divergence, and warn of runs whose integration is poor.

    Afterwards ``Loop.result_status`` has ``POORLY_INTEGRATED`` only where that stands. ``plant`` is
    the plants' name.
    """
    for loop in loops:
        _warn_of_undefined_functions(plant, loop)
        if loop.integration.poor and loop.diverged and _diverges_anyway(loop):
            loop.integration.acquit()
    poor = [loop.integration for loop in loops if loop.integration.poor]
    if not poor:
        return
    worst = max(poor, key=lambda check: check.error)
    runs = f" in {len(poor)} of {len(loops)} runs" if len(loops) > 1 else ""
    remedy = (
        f"give at least substeps = {max(check.enough for check in poor)}, or a lower dt"
        if all(check.enough for check in poor)
        else "it is stiff, or f jumps: make f smoother, or give many more substeps"
    )
    warn(
        f"{plant}: with {worst.model.substeps} sub-steps in a sample a state has an error of "
        f"{100.0 * worst.error:.2g} % of its range in one sample{runs}, more than "
        f"{100.0 * LARGEST_ERROR:g} %: {remedy}"
    )


def _warn_of_undefined_functions(plant: str, loop: Loop) -> None:
    """Warn if a function of the user returned NaN or infinity while y was in its usual range."""
    if not (loop.diverged and loop.integration.needed):
        return
    row, first = loop.last_row, loop.first_state
    before = loop.x0 if row is None else row[first : first + loop.x.size]
    usual = loop.ended == 0 if row is None else loop.is_usual(row)
    with np.errstate(all="ignore"):
        defined = bool(np.all(np.isfinite([*loop.x, *loop.measured()])))
    if defined or not usual:
        return
    warn(
        f"{plant}: f or output returns a number that is not finite; the run ended at t = "
        f"{loop.ended * loop.scenario.dt:.9g} s. The last recorded state was "
        f"{[float(f'{value:.4g}') for value in before]}: both must be defined wherever the "
        "plant goes"
    )


def _diverges_anyway(loop: Loop) -> bool:
    """Return whether a run that diverged leaves its usual range with enough sub-steps, too."""
    if not loop.integration.enough:
        return True
    scenario = replace(loop.scenario, limit=loop.scenario.range)
    model = with_substeps(loop.model, loop.integration.enough)
    again = type(loop)(loop.plant, model, loop.controller, scenario, loop.interpret)
    again.integration.needed = False
    samples = loop.ended + 1
    log, every = np.empty((1, loop.width)), samples
    for first, last in segment_bounds(samples, (k for k in scenario.rest_samples if k < samples)):
        again.run(scenario.segment(first, last), log, 0, every)
        if again.diverged:
            return True
    return False
