"""Objectives of a search by simulation: scores of a controller on samples.

A sample is whatever differs between runs: a plant and the scenario that it runs through, or
anything that the function ``evaluate`` understands. All candidates see the same samples with the
same seeds (common random numbers), so a difference of scores is one of the candidates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from quell import checks
from quell.controllers.base import Controller
from quell.plants.base import Plant
from quell.records.trajectory import Trajectory
from quell.simulation import Scenario, simulate
from quell.simulation.scenario import check_scenario
from quell.sweeping.shares import share_interval
from quell.tuning.simulated.statistics import Mean, Statistic
from quell.types import Matrix

Score: TypeAlias = str | Callable[[Trajectory], float]
"""A name of ``Trajectory.metrics``, as ``"iae"``, or a function of a run; lower is better."""


@dataclass(frozen=True)
class Objective:
    """A score of a run, and the statistic that stands for the scores on all samples."""

    score: Score
    statistic: Statistic = field(default_factory=Mean)


class Sample(NamedTuple):
    """A plant and what it runs through."""

    plant: Plant
    scenario: Scenario


class Checked(NamedTuple):
    """An objective on samples that the search did not use."""

    value: float  #: the statistic on these samples
    low: float  #: lower end of its 95 % confidence interval
    high: float  #: upper end
    samples: int  #: number of samples
    exceeds: tuple[float, float, float]
    """Share of samples above the value that the search had found, and its 95 % interval."""


@dataclass(frozen=True)
class Problem:
    """Samples, the function that scores a controller on them, and the statistics to minimise.

    Make it with ``Problem.of_runs``; a function of your own serves for criteria that are not scores
    of single runs.

    Attributes
    ----------
    samples : Sequence
        at least one.
    evaluate : callable
        ``evaluate(controller, samples)`` returns the scores (objectives, samples) of a part of the
        samples. It runs in several threads at once; for other processes it must be picklable.
    statistics : Mapping[str, Statistic]
        by name of the objective, in the order of the scores.
    """

    samples: Sequence[Any]
    evaluate: Callable[[Controller, Sequence[Any]], Matrix]
    statistics: Mapping[str, Statistic]

    def __post_init__(self) -> None:
        if not len(self.samples):
            raise ValueError("samples is empty: must have at least one")
        if not self.statistics:
            raise ValueError("statistics is empty: must have at least one objective, by name")

    @classmethod
    def of_runs(
        cls,
        plants: Plant | Sequence[Plant],
        scenario: Scenario | Sequence[Scenario],
        objectives: Mapping[str, Objective] | Objective | Score,
        *,
        limit: float | None = None,
    ) -> Problem:
        """Return the problem of simulated runs.

        Parameters
        ----------
        plants
            a plant, or a sequence of plants of one kind.
        scenario
            what they run through; one for each plant, or one for all. Then run i has the seed
            ``scenario.seed + i``, so that noise differs between the samples.
        objectives
            what is minimised, by name; or one objective, or its score. A run that diverged has an
            infinite score.
        limit
            ``|y|`` at which a run ends; see ``simulate``.
        """
        given: Any = plants
        several: list[Plant] = list(given) if checks.is_sequence(given) else [given]
        if isinstance(scenario, Scenario):
            seeds = range(scenario.seed, scenario.seed + len(several))
            scenarios = [replace(scenario, seed=seed) for seed in seeds]
        else:
            if not checks.is_sequence(scenario):
                check_scenario(scenario)
            scenarios = list(scenario)
            for i, each in enumerate(scenarios):
                check_scenario(each, f"scenario[{i}]")
            several = several if checks.is_sequence(given) else several * len(scenarios)
        if len(several) != len(scenarios):
            raise ValueError(
                f"scenario has {len(scenarios)} entries, plants {len(several)}: "
                "must be the same number"
            )
        samples = [Sample(*pair) for pair in zip(several, scenarios, strict=True)]
        named = _named(objectives)
        evaluate = _Runs(tuple(o.score for o in named.values()), limit)
        return cls(samples, evaluate, {name: o.statistic for name, o in named.items()})

    def scores(self, controller: Controller, first: int = 0, last: int | None = None) -> Matrix:
        """Return the scores (objectives, samples) of a part of the samples."""
        part = self.samples[first:last]
        found = np.asarray(self.evaluate(controller, part), dtype=np.float64)
        if found.shape != (len(self.statistics), len(part)):
            raise ValueError(
                f"evaluate returned scores of shape {found.shape}: must be "
                f"({len(self.statistics)}, {len(part)}), objectives and samples"
            )
        return found

    def values(self, scores: Matrix) -> list[float]:
        """Return the statistic of each objective for scores (objectives, samples)."""
        pairs = zip(self.statistics.values(), scores, strict=True)
        return [float(statistic.value(row)) for statistic, row in pairs]

    def check(
        self, controller: Controller, found: Mapping[str, float] | None = None
    ) -> dict[str, Checked]:
        """Evaluate a controller on this problem's samples, with confidence intervals.

        The intervals hold only for samples that had no part in the choice of the controller.
        ``found`` are the values of the search, against which scores are compared.
        """
        scores, found = self.scores(controller), found or {}
        checked: dict[str, Checked] = {}
        for (name, statistic), row in zip(self.statistics.items(), scores, strict=True):
            above = int(np.sum(~(row <= found.get(name, math.inf))))
            share = (above / row.size, *share_interval(above, row.size))
            low, high = statistic.interval(row)
            checked[name] = Checked(statistic.value(row), low, high, row.size, share)
        return checked


def _named(objectives: Mapping[str, Objective] | Objective | Score) -> dict[str, Objective]:
    if not isinstance(objectives, Mapping):
        one = objectives if isinstance(objectives, Objective) else Objective(objectives)
        name = one.score if isinstance(one.score, str) else getattr(one.score, "__name__", "score")
        objectives = {name: one}
    for name, objective in objectives.items():
        if not isinstance(objective, Objective):
            raise ValueError(f"objectives[{name!r}] = {objective!r}: must be an Objective")
    return dict(objectives)


@dataclass(frozen=True)
class _Runs:
    """Simulate a batch and score its runs; the cores are used by other candidates."""

    functions: tuple[Score, ...]
    limit: float | None

    def __call__(self, controller: Controller, samples: Sequence[Sample]) -> Matrix:
        plants, scenarios = [s.plant for s in samples], [s.scenario for s in samples]
        channels = None if all(isinstance(f, str) for f in self.functions) else "all"
        options: dict[str, Any] = {"limit": self.limit, "workers": 1, "record": channels}
        runs = simulate(plants, controller, scenarios, **options)
        found = np.full((len(self.functions), len(samples)), np.inf)
        for i in np.flatnonzero(~runs.diverged).tolist():
            run = runs.run(i)
            found[:, i] = [_scored(function, run) for function in self.functions]
        return found


def _scored(score: Score, run: Trajectory) -> float:
    if callable(score):
        return float(score(run))
    measures = run.metrics()
    if score not in measures and score not in measures.missing:
        known = ", ".join(sorted({*measures, *measures.missing}))
        raise ValueError(f"score = {score!r}: must be a function of a run, or one of {known}")
    return measures.get(score, math.inf)
