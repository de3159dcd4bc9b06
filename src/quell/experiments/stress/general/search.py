"""Search for the worst learner by the cross-entropy method.

Rubinstein & Kroese, *The Cross-Entropy Method*, 2004, section 5.1: points are drawn from a normal
distribution with independent entries, scored, and mean and standard deviation move to those of the
best, smoothed (their section 5.1.2), until the generations are used up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from quell.experiments.stress.general.attacks import SIZE, centre, program, spread
from quell.experiments.stress.general.loops import GeneralLoop
from quell.experiments.stress.general.measures import Measures
from quell.experiments.stress.general.trial import error_of
from quell.guard import Guard
from quell.parallel import in_parallel
from quell.types import Matrix, Vector

# Share of the points that is the best, and weight of the new mean and deviation: usual values.
_ELITE, _SMOOTHING = 0.15, 0.7
# Score of a lost loop: as a hundredfold error.
_LOST = 100.0

Score = Callable[[Measures], float]


def harm(ratios: Measures) -> float:
    """Return how bad ratios are: the mean logarithm of RMS error and worst window."""
    return 0.5 * float(np.log(ratios.rms) + np.log(ratios.window))


class Found(NamedTuple):
    """The best point of a search, its score, and the mean score of each generation."""

    point: Vector
    score: float
    history: list[float]


def search(
    draw: Callable[[int], Sequence[GeneralLoop]],
    guard: Guard | None,
    rng: np.random.Generator,
    *,
    generations: int = 12,
    population: int = 40,
    score: Score = harm,
) -> Found:
    """Search for the point whose adversary does most harm, on average over loops.

    Parameters
    ----------
    draw
        returns the loops of a generation. New ones in each generation find an adversary for all
        such loops, the same ones the worst for these.
    guard
        of the loops; None for none.
    rng
        of the points.
    generations, population
        number of rounds, and of points in each.
    score
        what a point is judged by, from the ratios of a run to MF-ESO's.
    """
    mean, deviation = centre(), spread()
    best, history = Found(mean, -np.inf, []), []
    for generation in range(generations):
        points = mean + deviation * rng.normal(size=(population, SIZE))
        points[0] = mean
        loops = list(draw(generation))
        scores = judge(points, loops, guard, score)
        order = np.argsort(-scores)
        elite = points[order[: max(round(_ELITE * population), 2)]]
        mean = (1.0 - _SMOOTHING) * mean + _SMOOTHING * elite.mean(axis=0)
        deviation = (1.0 - _SMOOTHING) * deviation + _SMOOTHING * elite.std(axis=0)
        history.append(float(scores[order[0]]))
        if scores[order[0]] > best.score:
            best = Found(points[order[0]], float(scores[order[0]]), history)
    return (
        Found(mean, best.score, history)
        if best.score < history[-1]
        else best._replace(history=history)
    )


def judge(
    points: Matrix, loops: Sequence[GeneralLoop], guard: Guard | None, score: Score = harm
) -> Vector:
    """Return the mean score of each point (points, SIZE) over loops; a lost one counts as 100."""
    plain = in_parallel([partial(error_of, loop, None, None) for loop in loops])
    kept = [(loop, base) for loop, base in zip(loops, plain, strict=True) if base is not None]

    def one(point: Vector) -> float:
        total = 0.0
        for loop, base in kept:
            run = error_of(loop, program(point, loop, guard), guard)
            total += float(np.log(_LOST)) if run is None else score(run.over(base))
        return total / max(len(kept), 1)

    return np.array(in_parallel([partial(one, point) for point in points]))
