"""The search: Optuna suggests values, simulations score them, in groups of candidates."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from quell import checks
from quell.controllers.base import Controller
from quell.executors import Where, check_sendable, completed, executor_on
from quell.tuning.simulated.cma import Generations
from quell.tuning.simulated.problem import Problem
from quell.tuning.simulated.result import Candidate, Search
from quell.tuning.simulated.space import Space, checked_space, checked_start
from quell.tuning.simulated.study import (
    REASON,
    VIOLATION,
    begun_trial,
    open_study,
    sampler_for,
    seed_of,
    tell,
    was_given_up,
)
from quell.types import DesignWarning, Matrix

Build: TypeAlias = Callable[[Mapping[str, float]], Controller]
# Candidates that are simulated at the same time: enough for usual numbers of cores, few enough that
# a sampler learns from most of the trials before. Chosen by hand.
_AT_ONCE = 8
# Shares of the samples after which a candidate may be given up: halving, as in successive halving
# (Jamieson & Talwalkar, AISTATS 2016), down to an eighth.
_RUNGS = (0.125, 0.25, 0.5, 1.0)
# Least samples of the first rung: fewer rank candidates by chance. Chosen by hand.
_FIRST_RUNG = 4


class _Task(NamedTuple):
    """A candidate and the part of the samples on which it is to be scored."""

    place: int
    values: dict[str, float]
    first: int
    last: int


class _Score(NamedTuple):
    """The result of a task."""

    scores: Matrix | None  # None for a design that is not possible
    violation: float
    reason: str = ""  # why there is no such design


def search(
    build: Build,
    space: Space,
    problem: Problem,
    *,
    trials: int = 200,
    sampler: Any = None,
    pruner: Any = "median",
    storage: str | os.PathLike[str] | None = None,
    name: str = "quell",
    seed: int = 0,
    starts: Iterable[Mapping[str, float]] = (),
    violation: Callable[[Controller], float] | None = None,
    at_once: int = _AT_ONCE,
    executor: Where = None,
    workers: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Search:
    """Search the parameters of a controller that minimise a problem's objectives.

    The result depends on ``seed`` and ``at_once``, not on the executor or its workers, and is the
    same after an interruption.

    Parameters
    ----------
    build
        ``build(values)`` returns the controller for values of all parameters; a ``ValueError``
        rejects the values.
    space
        the range of each parameter, by name.
    problem
        samples, scores and statistics; with several objectives the result is their Pareto front.
    trials
        number of candidates, those of an interrupted search in ``storage`` included.
    sampler
        ``"cma"`` (covariance matrix adaptation), ``"tpe"`` (tree-structured Parzen estimator),
        ``"nsga2"``, ``"qmc"``, ``"random"``, or a sampler of Optuna. By default ``"cma"``, with one
        parameter ``"tpe"``, with several objectives ``"nsga2"``.
    pruner
        what gives candidates up after an eighth, a quarter and half of the samples: ``"median"``,
        ``"halving"``, ``"none"``, or a pruner of Optuna. With several objectives there is none.
    storage
        Optuna's journal file, created if missing; a search in it continues.
    name
        name of the search in the file, which may hold several.
    seed
        seed of the sampler.
    starts
        values that are tried first; CMA-ES begins around the first of them.
    violation
        a function of the controller: zero or less if it meets all constraints, else by how much it
        does not. Such candidates are not simulated.
    at_once
        candidates that are suggested, and simulated, at the same time.
    executor, workers
        where they are simulated; see ``quell.executors.executor_on``.
    progress
        called with the share of trials done.

    Raises
    ------
    ValueError
        for arguments out of range, a file in ``storage`` of another search, or if no candidate is
        possible (with the reason for the last one).
    ImportError
        without Optuna (extra ``tuning``).
    """
    space = checked_space(space)
    first = [checked_start(space, start) for start in starts]
    checks.whole("trials", trials, 1)
    checks.whole("at_once", at_once, 1)
    checks.whole("seed", seed, 0)
    about = _about(space, problem, seed)
    study = open_study(storage, name, len(problem.statistics), about, pruner)
    evaluate = partial(_evaluate, build, problem, violation)
    sampler = _default_sampler(space, problem) if sampler is None else sampler
    generations = Generations(space, first[0] if first else None) if sampler == "cma" else None
    if executor == "processes":
        check_sendable("build, scores and violation", evaluate)
    with executor_on(executor, workers) as pool, warnings.catch_warnings():
        warnings.simplefilter("ignore", DesignWarning)  # a candidate may be unwise: it is judged
        while True:
            known = study.get_trials(deepcopy=False)
            left = [trial for trial in known if not trial.state.is_finished()]
            done = len(known) - len(left)
            if progress is not None:
                progress(min(done / trials, 1.0))
            if done >= trials:
                break
            # Groups begin at multiples of at_once, also after an interruption within one.
            begin = min((trial.number for trial in left), default=done)
            end = min((begin // at_once + 1) * at_once, trials)
            group, strategy = [], generations.after(study) if generations else None
            for number in [*(trial.number for trial in left), *range(len(known), end)]:
                fixed = first[number] if number < len(first) else None
                if fixed is None and generations is not None:
                    fixed = generations.suggested(strategy, seed_of(seed, number))
                study.sampler = sampler_for(sampler, seed, number, fixed)
                trial = study.ask() if number >= len(known) else begun_trial(study, number)
                group.append((trial, {n: r.suggested(trial, n) for n, r in space.items()}))
            _run(study, group, problem, lambda tasks: completed(pool, evaluate, tasks))
    return Search(tuple(problem.statistics), space, _candidates(study, space, problem))


def _default_sampler(space: Space, problem: Problem) -> str:
    if len(problem.statistics) > 1:
        return "nsga2"
    return "cma" if len(space) > 1 else "tpe"


def _about(space: Space, problem: Problem, seed: int) -> dict[str, Any]:
    """Return what two searches that share a file must have in common."""
    ranges = {name: [r.low, r.high, r.is_logarithmic, r.whole] for name, r in space.items()}
    objectives = {name: repr(statistic) for name, statistic in problem.statistics.items()}
    return {
        "ranges": ranges,
        "objectives": objectives,
        "samples": len(problem.samples),
        "seed": seed,
    }


def _run(
    study: Any,
    group: Sequence[tuple[Any, dict[str, float]]],
    problem: Problem,
    completed: Callable[[list[_Task]], Iterable[tuple[_Task, _Score]]],
) -> None:
    """Simulate a group of candidates on more and more samples, and tell the study the results.

    The study is told in the order of the candidates, so that nothing depends on which of them was
    done first.
    """
    count, objectives = len(problem.samples), len(problem.statistics)
    scores = [np.zeros((objectives, 0)) for _ in group]
    alive, first = list(range(len(group))), 0
    # Optuna gives candidates up by one objective only.
    for rung, last in enumerate(_rungs(count) if objectives == 1 else [count]):
        tasks = [_Task(i, group[i][1], first, last) for i in alive]
        found = {task.place: score for task, score in completed(tasks)}
        ended: list[tuple[Any, list[float] | None]] = []
        for i in list(alive):
            trial, one = group[i][0], found[i]
            if one.scores is None:
                trial.set_user_attr(VIOLATION, one.violation)
                if one.reason:
                    trial.set_user_attr(REASON, one.reason)
                ended.append((trial, [math.inf] * objectives))
                alive.remove(i)
                continue
            scores[i] = np.hstack([scores[i], one.scores])
            reached = problem.values(scores[i])
            if last == count:
                ended.append((trial, reached))
            elif was_given_up(trial, reached[0], rung):
                ended.append((trial, None))
                alive.remove(i)
        for trial, values in ended:
            tell(study, trial, values)
        first = last


def _rungs(samples: int) -> list[int]:
    ends = {math.ceil(share * samples) for share in _RUNGS}
    return sorted(end for end in ends if end >= min(_FIRST_RUNG, samples))


def _evaluate(
    build: Build,
    problem: Problem,
    violation: Callable[[Controller], float] | None,
    task: _Task,
) -> _Score:
    try:
        controller = build(task.values)
    except ValueError as error:
        return _Score(None, 1.0, str(error))
    if violation is not None and task.first == 0:
        beyond = float(violation(controller))
        if not beyond <= 0.0:
            # One that is not a number is worse than most: a loop that has no margins.
            return _Score(None, beyond if math.isfinite(beyond) else 1e3)
    return _Score(problem.scores(controller, task.first, task.last), 0.0)


def _candidates(study: Any, space: Space, problem: Problem) -> tuple[Candidate, ...]:
    found = []
    for trial in study.get_trials(deepcopy=False):
        # Optuna gives a trial that was given up the value on the samples so far.
        complete = trial.state.name == "COMPLETE"
        values = dict(zip(problem.statistics, trial.values, strict=True)) if complete else {}
        over = float(trial.user_attrs.get(VIOLATION, 0.0))
        parameters = {name: trial.params[name] for name in space if name in trial.params}
        finished = complete and over <= 0.0
        reason = str(trial.user_attrs.get(REASON, ""))
        found.append(Candidate(trial.number, parameters, values, over, finished, reason))
    return tuple(found)
