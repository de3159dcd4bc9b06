"""Search for the worst learner by the cross-entropy method.

Rubinstein & Kroese, *The Cross-Entropy Method*, 2004, section 5.1: points are drawn from a normal
distribution with independent entries, scored, and mean and standard deviation move to those of the
best, smoothed (their section 5.1.2), until the generations are used up. The first generation are
random draws of "earn and spend", and the best of them is the first mean.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from quell.experiments.stress.general.attacks import (
    SIZE,
    adversary_at,
    centre,
    earn_and_spend,
    spread,
)
from quell.experiments.stress.general.loops import GeneralLoop
from quell.experiments.stress.general.measures import Measures
from quell.experiments.stress.general.trial import error_of
from quell.guard import Guard
from quell.parallel import in_parallel
from quell.types import Matrix, Vector

# Share of the points that is the best, and weight of the new mean and deviation: usual values.
_ELITE, _SMOOTHING = 0.15, 0.7
# Score of a lost loop: above that of an error a hundredfold.
_LOST = 30.0

# Deviation around the best of the first generation, as a share of that of ``spread``: wider, hardly
# a point in 37 dimensions is better than its centre (in 12 generations the score at order 1 rose by
# 0.1 with 1, by 0.7 with 0.4 and by 1.1 with 0.2).
_AROUND = 0.2

Score = Callable[[Measures], float]


# Ratios that are equally bad: the trial's bars for the largest of all runs.
_BAR_RMS, _BAR_WINDOW = 1.2, 2.5
# Weight of the worst loop against the mean of all: what is sought is the worst. Chosen by hand.
_WORST = 0.5


def harm(ratios: Measures) -> float:
    """Return how bad ratios are: 0 for those of MF-ESO, 1 at the trial's bars."""
    rms, window = np.log(ratios.rms) / np.log(_BAR_RMS), np.log(ratios.window) / np.log(_BAR_WINDOW)
    return float(max(rms, window))


class Found(NamedTuple):
    """The best point of a search, its score, and the best score of each generation."""

    point: Vector
    score: float
    history: list[float]


def search(
    loops: Sequence[GeneralLoop],
    guard: Guard | None,
    rng: np.random.Generator,
    *,
    generations: int = 12,
    population: int = 40,
    score: Score = harm,
) -> Found:
    """Search for the point whose adversary does most harm in some loops.

    Parameters
    ----------
    loops
        in which each point is judged.
    guard
        of the loops; None for none.
    rng
        of the points.
    generations, population
        number of rounds, and of points in each.
    score
        what a point is judged by, from the ratios of a run to MF-ESO's.
    """
    first = np.array([centre()] + [earn_and_spend(rng) for _ in range(population - 1)])
    best, history = Found(first[0], -np.inf, []), []
    mean, deviation = first[0], spread()
    for generation in range(generations):
        points = mean + deviation * rng.normal(size=(population, SIZE)) if generation else first
        points[0] = best.point if generation else first[0]
        scores = judge(points, loops, guard, score)
        order = np.argsort(-scores)
        history.append(float(scores[order[0]]))
        best = Found(points[order[0]], history[-1], history)
        if generation == 0:
            mean, deviation = best.point, _AROUND * deviation
            continue
        elite = points[order[: max(round(_ELITE * population), 2)]]
        mean = (1.0 - _SMOOTHING) * mean + _SMOOTHING * elite.mean(axis=0)
        deviation = (1.0 - _SMOOTHING) * deviation + _SMOOTHING * elite.std(axis=0)
    return best


def judge(
    points: Matrix, loops: Sequence[GeneralLoop], guard: Guard | None, score: Score = harm
) -> Vector:
    """Return the score of each point (points, SIZE): the mean of that over loops and the worst."""
    plain = in_parallel([partial(error_of, loop, None, None) for loop in loops])
    kept = [(loop, base) for loop, base in zip(loops, plain, strict=True) if base is not None]

    def one(point: Vector) -> float:
        scores = [0.0]
        for loop, base in kept:
            run = error_of(loop, adversary_at(point, loop, guard), guard)
            scores.append(_LOST if run is None else score(run.over(base)))
        return float((1.0 - _WORST) * np.mean(scores) + _WORST * np.max(scores))

    return np.array(in_parallel([partial(one, point) for point in points]))
