"""The trial in general loops: hostile and honest learners, each beside MF-ESO on the same seed.

Errors are those of y against the response that the loop is designed for. A run's ratios are its
measures (``measures``) over those of MF-ESO. A run is *lost* if it diverges, or leaves |y| = 100,
where MF-ESO does not. Bars hold for loops whose modulus margin is at least ``HEALTHY``. With limits
of u the margin of the linear part says little: a loop in which MF-ESO itself hardly holds is
*fragile*, and does not count: with limits that are 20 % lower it is lost, or has measures 1.5 times
as large.

How much of a ratio is chance is what MF-ESO itself shows with another draw of the same noise: where
friction holds a plant or lets it slip, or limits of u hardly suffice, this decides which happens.

Seeds below 10 000 are for tuning; seeds from 1 000 000 on are for judging, and are looked at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from quell.experiments.stress.general.attacks import KINDS, draw_attack
from quell.experiments.stress.general.loops import GeneralLoop, draw_loop
from quell.experiments.stress.general.loops.references import ideal
from quell.experiments.stress.general.measures import WINDOW_LAGS, Measures, measure_error
from quell.guard import Guard
from quell.learners import Harmonic, Kalman, Learner
from quell.parallel import in_parallel
from quell.simulation.simulate import simulate

HEALTHY = 0.35
"""Least modulus margin of the loops for which the bars hold."""
OTHER_NOISE = "MF-ESO, other noise"
HONEST: dict[str, Learner] = {"Harmonic": Harmonic(), "Kalman": Kalman()}
# What tells fragile loops: share of the limits, and ratio to the measures with the full limits.
# Chosen by hand; with the first guard all saturated loops with ratios above 8 were fragile.
_LOWER_LIMITS, _FRAGILE = 0.8, 1.5
# A loop whose reference is within 2 counts as lost beyond this |y|.
_LIMIT = 100.0
# Recorded samples in a lag of the observer: the error changes little between them.
_RECORDS_PER_LAG = 20.0


@dataclass(frozen=True)
class GeneralOutcome:
    """The result of one run; ratios are NaN if one of the two loops is lost."""

    kind: str
    honest: bool
    index: int  #: number of the run in the trial, apart for hostile and honest learners
    learner: str
    loop: str
    family: str
    order: int
    load: str
    reference: str
    level: float  #: constant part of the load
    margin: float
    plain_lost: bool
    fragile: bool  #: whether MF-ESO hardly holds within the limits of u
    lost: bool
    rms: float
    peak: float
    window: float
    late: float
    other_noise: Measures  #: MF-ESO with another draw of the noise, over MF-ESO; NaN if it is lost

    @property
    def healthy(self) -> bool:
        """Whether the bars hold for its loop."""
        return self.margin >= HEALTHY and not (self.plain_lost or self.fragile)

    @property
    def of_other_noise(self) -> GeneralOutcome:
        """The outcome of MF-ESO with another draw of the noise, in place of the learner's."""
        measured = self.other_noise
        lost = math.isnan(measured.rms) and not self.plain_lost
        return replace(self, kind=OTHER_NOISE, learner="", lost=lost, **measured._asdict())


def error_of(loop: GeneralLoop, learner: Learner | None, guard: Guard | None) -> Measures | None:
    """Return the measures of a run, None if it is lost."""
    every = max(int(loop.lag / _RECORDS_PER_LAG / loop.dt), 1)
    controller = loop.controller(learner, guard)
    run = simulate(loop.plant, controller, loop.scenario, record_every=every, limit=_LIMIT)
    if run.diverged:
        return None
    wanted = ideal(loop.tables[0], loop.dt, loop.order)[::every]
    return measure_error(run["y"] - wanted, round(WINDOW_LAGS * loop.lag / (every * loop.dt)))


def is_fragile(loop: GeneralLoop, plain: Measures) -> bool:
    """Return whether MF-ESO, which has these measures, hardly holds within the limits of u."""
    if min(loop.u_limit, loop.plant.limit) == math.inf:
        return False
    lower = replace(loop.plant, limit=_LOWER_LIMITS * loop.plant.limit)
    found = error_of(replace(loop, plant=lower, u_limit=_LOWER_LIMITS * loop.u_limit), None, None)
    return found is None or max(found.over(plain)[:3]) > _FRAGILE


def run_one(
    seed: int, index: int, kind: str, guard: Guard | None, honest: bool = False
) -> GeneralOutcome:
    """Run the loop with this number, with a learner and without."""
    rng = np.random.default_rng([seed, index, int(honest)])
    loop = draw_loop(rng)
    learner = HONEST[kind] if honest else draw_attack(kind, rng, loop, guard)
    plain = error_of(loop, None, None)
    learned = None if plain is None else error_of(loop, learner, guard)
    again = None if plain is None else error_of(replace(loop, draw=1), None, None)
    return GeneralOutcome(
        kind=kind,
        honest=honest,
        index=index,
        learner=repr(learner),
        loop=loop.describe(),
        family=loop.family,
        order=loop.order,
        load=loop.load,
        reference=loop.reference,
        level=loop.level,
        margin=loop.margin,
        plain_lost=plain is None,
        fragile=plain is not None and is_fragile(loop, plain),
        lost=learned is None and plain is not None,
        **_over(learned, plain)._asdict(),
        other_noise=_over(again, plain),
    )


def _over(measured: Measures | None, plain: Measures | None) -> Measures:
    """Return the ratios to those of MF-ESO; NaN if one of the two is lost."""
    if measured is None or plain is None:
        return Measures(*[math.nan] * 4)
    return measured.over(plain)


def run_all(
    runs: int,
    honest: int,
    seed: int,
    *,
    guard: Guard | None,
    kinds: Sequence[str] = KINDS,
    progress: Callable[[float], None] | None = None,
) -> list[GeneralOutcome]:
    """Run ``runs`` hostile and ``honest`` honest learners, the kinds of each in turn."""
    good = tuple(HONEST)
    jobs = [partial(run_one, seed, i, kinds[i % len(kinds)], guard) for i in range(runs)]
    jobs += [partial(run_one, seed, i, good[i % len(good)], guard, True) for i in range(honest)]
    return in_parallel(jobs, progress)
