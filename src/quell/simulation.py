"""The one driver: a plant and a controller, sample by sample, through a scenario."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.base import Controller, control, flags, heed, report, rest
from quell.dispatch import compiled, compiling, for_types, interpreted
from quell.plants.base import Plant, advance, measure
from quell.signals import Constant, Signal, as_signal, seeded_apart
from quell.trajectory import Trajectory, first_sample_at, in_steps
from quell.types import Matrix, Status, Vector

# Signals are evaluated so many samples at a time: enough to make Python's share small, few enough to stay in cache.
_BLOCK = 8192
# Time in steps of dt is exact to a part in a thousand of a step up to here.
_MOST_SAMPLES = 10**12


@dataclass(frozen=True)
class Scenario:
    """What happens to the loop.

    Parameters
    ----------
    reference
        what y has to follow [y-unit]; a signal or a number.
    disturbances
        one signal or number for each disturbance input of the plant, in its order; missing ones are zero.
    noise
        what is added to y before the controller sees it; none by default.
    duration
        how long it takes [s]; the record has the samples from 0 to ``duration``, both included.
    x0
        the plant's state at the start; zero by default.
    rest_at
        times [s] at which the plant is put back to ``x0`` and the controller starts from rest, with what it has learned.
    seed
        which noise; the same seed gives the same bits.

    Raises
    ------
    ValueError
        for a duration that is not positive, a seed below zero, something that is no signal, or ``rest_at`` times that do not increase
        within the duration.
    """

    reference: Signal | float = 0.0
    duration: float = 10.0
    disturbances: Sequence[Signal | float] = ()
    noise: Signal | float = 0.0
    x0: Any = None
    rest_at: Sequence[float] = field(default=())
    seed: int = 0

    def __post_init__(self) -> None:
        checks.positive("duration", self.duration, "s")
        checks.whole("seed", self.seed, 0)
        as_signal(self.reference, "reference")
        as_signal(self.noise, "noise")
        if not isinstance(self.disturbances, Sequence):
            raise ValueError(f"disturbances = {self.disturbances!r}: must be a sequence of signals or numbers, one for each input")
        for i, disturbance in enumerate(self.disturbances):
            as_signal(disturbance, f"disturbances[{i}]")
        times = checks.vector("rest_at", self.rest_at)
        if times.size and (np.any(np.diff(times) <= 0.0) or times[0] <= 0.0 or times[-1] >= self.duration):
            raise ValueError(f"rest_at = {self.rest_at!r}: must increase and lie within (0, duration = {self.duration!r})")

    def seeded_signals(self, inputs: int) -> tuple[Signal, tuple[Signal, ...], Signal]:
        """Return the reference, ``inputs`` disturbances and the noise, with all that is random drawn from ``seed``."""
        if len(self.disturbances) > inputs:
            raise ValueError(f"disturbances has {len(self.disturbances)} signals: the plant has {inputs} disturbance inputs")
        given = (as_signal(self.reference), *map(as_signal, self.disturbances))
        noise = as_signal(self.noise).seeded(self.seed)
        # The noise takes the seed itself, so that its bits do not depend on how many disturbances there are.
        reference, *disturbances = seeded_apart(given, self.seed)
        return reference, (*disturbances, *[Constant(0.0)] * (inputs - len(disturbances))), noise


@compiled
def run_block(
    plant: Any,
    x: Vector,
    scratch: Vector,
    design: Any,
    state: Any,
    t0: float,
    dt: float,
    r: Vector,
    derivatives: Matrix,
    w: Matrix,
    noise: Vector,
    log: Matrix,
    row: int,
    every: int,
    until_next: int,
    limit: float,
) -> tuple[int, int, int, int]:
    """Run ``r.size`` samples from the time ``t0``; write every ``every``-th into ``log`` from ``row`` on.

    Returns how many samples were run (fewer than asked where the loop diverged: ``|y|`` beyond ``limit``, or not finite), the next row,
    how many samples are left until it is written, and all status flags that were seen.
    """
    inputs = w.shape[1]
    status = 0
    for k in range(r.size):
        y = measure(plant, x)
        measured = y + noise[k]
        if not abs(y) <= limit:
            return k, row, until_next, status
        if derivatives.shape[1] > 0:
            heed(design, state, derivatives[k])
        u = control(design, state, r[k], measured)
        status |= flags(design, state)
        if until_next == 0:
            log[row, 0] = r[k]
            log[row, 1] = y
            log[row, 2] = measured
            log[row, 3] = u
            for j in range(inputs):
                log[row, 4 + j] = w[k, j]
            for j in range(x.size):
                log[row, 4 + inputs + j] = x[j]
            report(design, state, log[row, 4 + inputs + x.size :])
            row += 1
            until_next = every
        until_next -= 1
        advance(plant, x, scratch, t0 + k * dt, u, w[k])
    return r.size, row, until_next, status


@compiled
def start_from_rest(design: Any, state: Any) -> None:
    """Start the controller from rest, with what it has learned."""
    rest(design, state)


def simulate(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    *,
    record_every: int = 1,
    limit: float | None = None,
    interpret: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Trajectory:
    """Run a controller on a plant through a scenario.

    The controller starts with nothing learned, on a state of its own: neither it nor the plant is changed.

    Parameters
    ----------
    plant, controller, scenario
        what to run; the sample time is the controller's.
    record_every
        keep every so-many-th sample; the memory used is that of the record.
    limit
        the run ends early, with ``Status.DIVERGED``, where ``|y|`` goes beyond it or is not finite [y-unit]; by default at a million
        times the largest of 1, ``|x0|`` and the reference in the first samples.
    interpret
        run the same functions as plain Python, the plant's too, to debug; about a thousand times slower.
    progress
        called with the share done, 0 to 1, every few thousand samples.

    Returns
    -------
    Trajectory
        what was recorded, as far as the run went.

    Raises
    ------
    ValueError
        for arguments out of range, an x0 of the wrong size, or more disturbances than the plant has inputs.
    """
    _check_kinds(plant, controller, scenario)
    every = checks.whole("record_every", record_every, 1)
    dt = controller.dt
    samples = _sample_count(scenario.duration, dt)
    x0 = np.zeros(plant.order) if scenario.x0 is None else checks.vector("x0", scenario.x0, plant.order)
    signals = scenario.seeded_signals(plant.disturbances)
    derivatives = _derivatives(signals[0], getattr(controller, "derivatives", 0))
    limit = _default_limit(signals[0], x0, samples, dt) if limit is None else checks.positive("limit", limit)
    channels = (
        *(("r", 1), ("y", 1), ("y_measured", 1), ("u", 1), ("w", plant.disturbances), ("x", plant.order)),
        *controller.channels,
    )
    log = np.empty(((samples - 1) // every + 1, sum(width for _, width in channels)))
    design, state, model = controller.parameters, controller.initial_state(), plant.sampled(dt, interpret)
    as_python = interpret or not plant.compiled
    block, to_rest = (interpreted(f) if as_python else for_types(f, model, design) for f in (run_block, start_from_rest))

    x, scratch = x0.copy(), np.zeros(6 * plant.order)
    row = until_next = done = status = 0
    rests = {first_sample_at(time, dt, samples) for time in scenario.rest_at}
    # An interpreted loop that diverges would warn of every overflow; the status says it once.
    with np.errstate(over="ignore", invalid="ignore"), compiling(model, design):
        for first, last in pairwise(sorted({*range(0, samples, _BLOCK), *rests, samples})):
            if first in rests:
                x[:] = x0
                to_rest(design, state)
            times = np.arange(first, last) * dt
            r, w, noise = _evaluated(signals, times)
            rates = np.array([rate(times) for rate in derivatives]).reshape(len(derivatives), times.size).T.copy()
            ran, row, until_next, seen = block(
                *(model, x, scratch, design, state, first * dt, dt, r, rates, w, noise, log, row, every, until_next, limit)
            )
            done = first + ran
            status |= seen
            if done < last:
                status |= Status.DIVERGED
                break
            if progress is not None:
                progress(done / samples)
    return Trajectory(
        log=log[:row],
        channels=channels,
        dt=dt,
        every=every,
        status=Status(status),
        ended=(done if status & Status.DIVERGED else samples - 1) * dt,
        limit=limit,
        plant=plant.name,
        features=controller.features,
        final_state=state,
    )


def _check_kinds(plant: Any, controller: Any, scenario: Any) -> None:
    for name, value, has, wanted in (
        ("plant", plant, "sampled", "a plant, for example quell.plants.two_mass_spring()"),
        ("controller", controller, "initial_state", "a controller, for example quell.ADRC(...)"),
        ("scenario", scenario, "seeded_signals", "a quell.Scenario"),
    ):
        if isinstance(value, type) or not hasattr(value, has):
            raise ValueError(f"{name} = {value!r}: must be {wanted}")


def _sample_count(duration: float, dt: float) -> int:
    """Return how many samples there are until ``duration``, both ends included, give or take rounding."""
    if duration / dt > _MOST_SAMPLES:
        raise ValueError(f"duration = {duration!r} s with dt = {dt!r} s: must be at most {_MOST_SAMPLES:.0e} samples")
    return math.floor(in_steps(duration, dt)) + 1


def _default_limit(reference: Signal, x0: Vector, samples: int, dt: float) -> float:
    """Return a million times what is asked of the loop: a loop in encoder counts is not one that diverges."""
    early = reference(np.arange(min(samples, _BLOCK)) * dt)
    sizes = np.abs([1.0, *x0, *early[np.isfinite(early)]])
    return 1e6 * float(np.max(sizes))


def _derivatives(reference: Signal, count: int) -> list[Signal]:
    """Return the first ``count`` derivatives of the reference."""
    found: list[Signal] = []
    for _ in range(count):
        found.append((found[-1] if found else reference).derivative())
    return found


def _evaluated(signals: tuple[Signal, tuple[Signal, ...], Signal], t: Vector) -> tuple[Vector, Matrix, Vector]:
    """Return reference (k,), disturbances (k, m) and noise (k,) at the times ``t``."""
    reference, disturbances, noise = signals
    w = np.empty((t.size, len(disturbances)))
    for j, disturbance in enumerate(disturbances):
        w[:, j] = disturbance(t)
    return np.ascontiguousarray(reference(t)), w, np.ascontiguousarray(noise(t))
