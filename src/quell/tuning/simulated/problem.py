"""Objectives of a search by simulation: scores, ranges of parameters, statistics.

Objectives of a search by simulation: scores of a controller on samples.

A sample is whatever differs between runs: a plant and the scenario that it runs through, or
anything that the function ``evaluate`` understands. All candidates see the same samples with the
same seeds (common random numbers), so a difference of scores is one of the candidates.

Statistics of the scores on many samples: one number, and its confidence interval.

A score is better if it is lower; one that is not a number counts as infinite. All intervals have
95 % confidence, are two-sided and hold for samples that were not used for the search.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from quell import checks
from quell.controllers.base import Controller
from quell.plants.base import Plant
from quell.records.trajectory import Trajectory
from quell.simulation import Scenario, simulate
from quell.simulation.scenario import check_scenario
from quell.sweeping.sweep import share_interval
from quell.types import Matrix, Vector

# ---- The ranges in which a search varies parameters ----


@dataclass(frozen=True)
class SearchRange:
    """The range of one parameter.

    Parameters
    ----------
    low, high
        its ends, which are allowed values.
    log
        whether the search moves in its logarithm; by default for a range above zero.
    whole
        whether only whole numbers are allowed.

    Raises
    ------
    ValueError
        for ends that are not finite or not in order, or a logarithm of numbers that are not above
        zero.
    """

    low: float
    high: float
    log: bool | None = None
    whole: bool = False

    def __post_init__(self) -> None:
        low, high = checks.finite("low", self.low), checks.finite("high", self.high)
        if not low < high:
            raise ValueError(f"low = {low!r}, high = {high!r}: low must be below high")
        if self.log and low <= 0.0:
            raise ValueError(f"low = {low!r}: must be above zero in a logarithmic range")
        if self.whole and (int(low) != low or int(high) != high):
            raise ValueError(f"low = {low!r}, high = {high!r}: must be whole numbers")

    @property
    def is_logarithmic(self) -> bool:
        """Whether the search moves in the logarithm."""
        return self.low > 0.0 if self.log is None else self.log

    def suggested(self, trial: Any, name: str) -> float:
        """Return the value that a trial of Optuna suggests for the parameter ``name``."""
        if self.whole:
            low, high = int(self.low), int(self.high)
            return float(trial.suggest_int(name, low, high, log=self.is_logarithmic))
        return float(trial.suggest_float(name, self.low, self.high, log=self.is_logarithmic))


Space = Mapping[str, SearchRange]
"""The ranges of all parameters, by name."""


def checked_space(space: Any) -> Space:
    """Return ``space`` if it maps names to ranges and is not empty."""
    if not isinstance(space, Mapping) or not space:
        raise ValueError(
            f"space = {space!r}: must be a dictionary of at least one SearchRange, by name"
        )
    for name, value in space.items():
        if not isinstance(value, SearchRange):
            raise ValueError(f"space[{name!r}] = {value!r}: must be a SearchRange(low, high)")
    return space


def checked_start(space: Space, start: Mapping[str, float]) -> dict[str, float]:
    """Return a start of the search, if it has a value within the range of each parameter."""
    if set(start) != set(space):
        names = ", ".join(space)
        raise ValueError(f"starts has {sorted(start)}: each start must have a value for {names}")
    for name, value in start.items():
        low, high = space[name].low, space[name].high
        if not low <= checks.finite(f"starts: {name}", value) <= high:
            raise ValueError(f"starts: {name} = {value!r}: must lie within {low:g} … {high:g}")
    return {name: float(start[name]) for name in space}


# ---- Statistics of the scores on many samples ----

_CONFIDENCE = 0.95


class Statistic(Protocol):
    """A number that stands for the scores on all samples."""

    def value(self, scores: Vector) -> float:
        """Return the number for scores (samples,)."""
        ...

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return the ends of its confidence interval."""
        ...


def half_width_of_mean(scores: Vector) -> float:
    """Return t s/√n, half of the 95 % interval of the mean of two scores or more (samples,)."""
    from scipy.special import stdtrit

    quantile = float(stdtrit(scores.size - 1, 0.5 + 0.5 * _CONFIDENCE))
    return quantile * float(np.std(scores, ddof=1)) / math.sqrt(scores.size)


@dataclass(frozen=True)
class Mean:
    """The mean; its interval is that of the central limit theorem."""

    def value(self, scores: Vector) -> float:
        """Return the mean of scores (samples,)."""
        return float(np.mean(_numbers(scores)))

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return mean ± t s/√n; infinite with one sample."""
        scores = _numbers(scores)
        middle = self.value(scores)
        if scores.size < 2 or not math.isfinite(middle):
            return -math.inf, math.inf
        half = half_width_of_mean(scores)
        return middle - half, middle + half


@dataclass(frozen=True)
class Quantile:
    """The least score that a share ``level`` of the samples does not exceed.

    Its interval is free of assumptions on the distribution: its ends are the scores whose ranks are
    the binomial distribution's quantiles (David & Nagaraja, *Order Statistics*, 3rd ed., 7.1).
    """

    level: float

    def __post_init__(self) -> None:
        if not 0.0 < checks.finite("level", self.level) < 1.0:
            raise ValueError(f"level = {self.level!r}: must be between 0 and 1, without them")

    def value(self, scores: Vector) -> float:
        """Return the quantile of scores (samples,)."""
        ordered = np.sort(_numbers(scores))
        # Rounding must not move 0.9 · 10 to the tenth score.
        return float(ordered[max(math.ceil(self.level * ordered.size - 1e-9), 1) - 1])

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return two of the scores, or infinite ends if there are too few samples."""
        from scipy.stats import binom

        ordered = np.sort(_numbers(scores))
        n, tail = ordered.size, 0.5 * (1.0 - _CONFIDENCE)
        # P(S_(i) ≤ q ≤ S_(j)) ≥ F(j − 1) − F(i − 1), with F of Binomial(n, level).
        i = int(binom.ppf(tail, n, self.level))
        j = int(binom.ppf(1.0 - tail, n, self.level)) + 1
        low = float(ordered[i - 1]) if i >= 1 else -math.inf
        return low, float(ordered[j - 1]) if j <= n else math.inf


@dataclass(frozen=True)
class Worst:
    """The largest score; nothing bounds that of further samples, so its interval is open."""

    def value(self, scores: Vector) -> float:
        """Return the largest of scores (samples,)."""
        return float(np.max(_numbers(scores)))

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return the largest score and infinity."""
        return self.value(scores), math.inf


@dataclass(frozen=True)
class FailureRate:
    """The share of samples whose score is above ``limit``.

    A score may be a truth value: True, a failure, is above the default limit. The interval is that
    of Clopper & Pearson (*Biometrika* 26, 1934).
    """

    limit: float = 0.5

    def value(self, scores: Vector) -> float:
        """Return the share of scores (samples,) above the limit."""
        return float(np.mean(_numbers(scores) > self.limit))

    def interval(self, scores: Vector) -> tuple[float, float]:
        """Return the exact interval of a binomial share."""
        return share_interval(int(np.sum(_numbers(scores) > self.limit)), scores.size)


def _numbers(scores: Vector) -> Vector:
    return np.where(np.isnan(scores), np.inf, scores)


# ---- Objectives of a search by simulation ----

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
            what is minimised, by name; or one objective, or its score. A run that diverged, or
            whose y ran away from r, has an infinite score, and so has one without the measure.
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
        for i in np.flatnonzero(~runs.lost).tolist():
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
