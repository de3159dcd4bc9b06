"""The search by simulation: candidates from Optuna, their study, the result.

The search: Optuna suggests values, simulations score them, in groups of candidates.

Optuna's study behind a search: its sampler and pruner, and its trials in a journal file.

The file is Optuna's own format (``JournalFileBackend``), one JSON object in each line, so that
its other tools read it. A search that was interrupted continues from it.

Covariance matrix adaptation (CMA-ES) as a sampler of Optuna, without a state of its own.

Hansen, *The CMA Evolution Strategy: A Tutorial* (arXiv 1604.00772), as implemented by the package
``cmaes``. Optuna's own ``CmaEsSampler`` stores pickled objects among the trials and loads them;
this one repeats the finished generations from their parameters and values, which takes
milliseconds. So a search continues from its journal alone, and nothing is unpickled.

Results of a search: its candidates, the best one, and the Pareto front of several objectives.
"""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from quell import checks
from quell.checks import import_extra
from quell.controllers.base import Controller
from quell.files import as_json
from quell.parallel import Where, check_sendable, completed, executor_on
from quell.tuning.simulated.problem import Problem, SearchRange, Space, checked_space, checked_start
from quell.types import DesignWarning, Matrix, Vector

# ---- Optuna's study behind a search ----

SAMPLERS = ("cma", "tpe", "nsga2", "qmc", "random")
PRUNERS = ("median", "halving", "none")
_ABOUT = "quell: problem"  # attribute of the study: what is searched
REASON = "quell: reason"  # and why its values were rejected, if they were
VIOLATION = "quell: violation"  # attribute of a trial: by how much it violates constraints


def optuna() -> Any:
    """Return Optuna's module, silent about each trial; ``ImportError`` names the extra."""
    module = import_extra("optuna", "tuning", "tuning by simulation")
    module.logging.set_verbosity(module.logging.ERROR)
    return module


def open_study(
    storage: str | os.PathLike[str] | None,
    name: str,
    objectives: int,
    about: Mapping[str, Any],
    pruner: Any,
) -> Any:
    """Return a new study, or the one of this name in the journal file ``storage``.

    Raises ``ValueError`` for a file that is no journal, or the journal of another problem.
    """
    module = optuna()
    chosen, backend = _pruner(module, pruner), None
    mine = json.loads(json.dumps(about))
    if storage is not None:
        backend = _journal(module, Path(storage))
        # create_study would write to the file of another search, too.
        if name in {each.study_name for each in backend.get_all_studies()}:
            study = module.load_study(storage=backend, study_name=name, pruner=chosen)
            stored = study.user_attrs.get(_ABOUT, {})
            if stored != mine:
                parts = sorted(key for key in mine if stored.get(key) != mine[key])
                raise ValueError(
                    f"storage = {os.fspath(storage)!r} holds another search, with other "
                    f"{', '.join(parts)}: give another file"
                )
            return study
    study = module.create_study(
        storage=backend, study_name=name, directions=["minimize"] * objectives, pruner=chosen
    )
    study.set_user_attr(_ABOUT, mine)
    return study


def sampler_for(sampler: Any, seed: int, trial: int, fixed: Mapping[str, float] | None) -> Any:
    """Return the sampler of the trial number ``trial``, with ``fixed`` values if there are any.

    A sampler by name is made anew for each trial, seeded by ``seed`` and the number. So a search
    that continues suggests what it would have suggested without the interruption.
    """
    samplers = optuna().samplers
    made = sampler
    if isinstance(sampler, str):
        name = checks.one_of("sampler", sampler, SAMPLERS)
        options: dict[str, Any] = {"seed": seed_of(seed, trial)}
        if name in ("random", "cma"):  # the values of "cma" are ``fixed``
            made = samplers.RandomSampler(**options)
        elif name == "qmc":
            made = _quietly(samplers.QMCSampler, scramble=True, seed=seed)
        elif name == "nsga2":
            made = _quietly(samplers.NSGAIISampler, constraints_func=_constraints, **options)
        else:
            options |= {"multivariate": True, "constraints_func": _constraints}
            made = _quietly(samplers.TPESampler, **options)
    if fixed is None:
        return made
    return _quietly(samplers.PartialFixedSampler, fixed_params=dict(fixed), base_sampler=made)


def seed_of(seed: int, trial: int) -> int:
    """Return the seed of a trial; those of searches with other seeds differ."""
    # NumPy's generators take 32 bits, and make independent streams of consecutive seeds.
    return (seed * 1_000_003 + trial) % 2**32


def begun_trial(study: Any, number: int) -> Any:
    """Return the unfinished trial of an interrupted search, with the values that it has."""
    known = study.get_trials(deepcopy=False)[number]
    return optuna().trial.Trial(study, known._trial_id)


def was_given_up(trial: Any, value: float, rung: int) -> bool:
    """Report the value on the samples so far; return whether the pruner gives the trial up."""
    with warnings.catch_warnings():
        # An interrupted search has reported the same value before.
        warnings.simplefilter("ignore")
        trial.report(value, rung)
    return bool(trial.should_prune())


def tell(study: Any, trial: Any, values: Sequence[float] | None) -> None:
    """Pass the values of a trial to the study; None for one that was given up."""
    if values is None:
        study.tell(trial, state=optuna().trial.TrialState.PRUNED)
    else:
        study.tell(trial, list(values))


def _constraints(trial: Any) -> Sequence[float]:
    return [float(trial.user_attrs.get(VIOLATION, 0.0))]


def _quietly(make: Any, **options: Any) -> Any:
    with warnings.catch_warnings():
        # Optuna warns that these options are experimental.
        warnings.simplefilter("ignore")
        return make(**options)


def _pruner(module: Any, pruner: Any) -> Any:
    if not isinstance(pruner, str):
        return pruner
    checks.one_of("pruner", pruner, PRUNERS)
    if pruner == "median":
        # With fewer finished trials a median says little: Optuna's own default is 5.
        return module.pruners.MedianPruner(n_startup_trials=10)
    if pruner == "halving":
        return module.pruners.SuccessiveHalvingPruner()
    return module.pruners.NopPruner()


def _journal(module: Any, path: Path) -> Any:
    """Return the storage of a journal file; an incomplete last line, of a kill, is cut off."""
    if path.exists():
        _repair(path)
    elif not path.parent.is_dir():
        raise ValueError(f"storage = {os.fspath(path)!r}: the folder does not exist")
    journal = module.storages.journal
    try:
        return module.storages.JournalStorage(journal.JournalFileBackend(os.fspath(path)))
    except (ValueError, KeyError, TypeError, AssertionError) as error:
        raise ValueError(
            f"storage = {os.fspath(path)!r}: must be a journal file of Optuna ({error})"
        ) from None


def _repair(path: Path) -> None:
    """Cut off an incomplete last line; raise a ``ValueError`` if the others are no journal."""
    with path.open("r+b") as file:
        content = file.read()
        end = content.rfind(b"\n") + 1
        if content and not (end and all(map(_is_operation, content[:end].splitlines()))):
            raise ValueError(f"storage = {os.fspath(path)!r}: must be a journal file of Optuna")
        file.truncate(end)


def _is_operation(line: bytes) -> bool:
    try:
        return {"op_code", "worker_id"} <= json.loads(line).keys()
    except (ValueError, AttributeError):
        return False


# ---- Covariance matrix adaptation (CMA-ES) as a sampler of Optuna, without a state of its own ----

# First standard deviation in units of the ranges: the tutorial recommends about 0.3 of a range in
# which the optimum is expected to lie anywhere; ranges here are wide, around a start.
_SIGMA = 0.2
_LARGEST = 1e300  # in place of infinity


class Generations:
    """Generations of CMA-ES over a space, from trials that are finished.

    Parameters
    ----------
    space
        the ranges; each is a coordinate from 0 to 1.
    start
        values of the first generation's mean; by default the middle of the ranges.
    """

    def __init__(self, space: Space, start: Mapping[str, float] | None = None) -> None:
        self.space = space
        self.start = np.full(len(space), 0.5) if start is None else self._coordinates(start)
        self._cma = import_extra("cmaes", "tuning", "the sampler cma").CMA

    def after(self, study: Any) -> Any:
        """Return the strategy after the finished trials of a study, in the order of their numbers.

        A trial that was given up has no value to compare: it comes last in its generation.
        """
        told = []
        for trial in study.get_trials(deepcopy=False):
            if trial.state.is_finished() and set(self.space) <= set(trial.params):
                value = float(trial.value) if trial.state.name == "COMPLETE" else math.inf
                # The strategy compares values only, so any number that keeps their order serves.
                told.append((self._coordinates(trial.params), min(value, _LARGEST)))
        bounds = np.tile([0.0, 1.0], (len(self.space), 1))
        strategy = self._cma(mean=self.start.copy(), sigma=_SIGMA, bounds=bounds, seed=0)
        size = strategy.population_size
        for first in range(0, len(told) - size + 1, size):
            strategy.tell(told[first : first + size])
        return strategy

    def suggested(self, strategy: Any, seed: int) -> dict[str, float]:
        """Return the values of a new trial."""
        strategy.reseed_rng(seed)
        # A point may be beyond an end of a range by rounding.
        point = np.clip(strategy.ask(), 0.0, 1.0)
        pairs = zip(self.space.items(), point.tolist(), strict=True)
        return {name: value_at(each, share) for (name, each), share in pairs}

    def _coordinates(self, values: Mapping[str, float]) -> Vector:
        return np.array([share_of(each, values[name]) for name, each in self.space.items()])


def value_at(each: SearchRange, share: float) -> float:
    """Return the value at a share of a range, rounded to a whole number if it must be one."""
    if each.is_logarithmic:
        value = math.exp(math.log(each.low) + share * math.log(each.high / each.low))
    else:
        value = each.low + share * (each.high - each.low)
    value = float(round(value)) if each.whole else value
    return min(max(value, each.low), each.high)


def share_of(each: SearchRange, value: float) -> float:
    """Return the share of a range at which a value lies."""
    if each.is_logarithmic:
        return math.log(value / each.low) / math.log(each.high / each.low)
    return (value - each.low) / (each.high - each.low)


# ---- Results of a search ----


@dataclass(frozen=True)
class Candidate:
    """Values of the parameters that were tried, and the objectives that they reached."""

    number: int
    parameters: dict[str, float]
    values: dict[str, float]  #: by name of the objective; empty if it was given up early
    violation: float  #: by how much it violates constraints; it was not simulated then
    finished: bool  #: whether it was simulated on all samples
    reason: str = ""  #: why its values were rejected; empty if they were not

    def dominates(self, other: Candidate) -> bool:
        """Whether no objective of this one is worse, and one is better."""
        pairs = [(value, other.values[name]) for name, value in self.values.items()]
        return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


@dataclass(frozen=True)
class Search:
    """The result of a search by simulation."""

    objectives: Sequence[str]
    space: Space
    candidates: Sequence[Candidate]  #: in the order in which they were tried

    @property
    def front(self) -> list[Candidate]:
        """The finished candidates that no other one dominates, by their first objective.

        Of candidates with equal objectives the first one counts.
        """
        possible = [c for c in self.candidates if c.finished and _is_finite(c)]
        seen: dict[tuple[float, ...], Candidate] = {}
        for one in possible:
            if not any(other.dominates(one) for other in possible):
                seen.setdefault(tuple(one.values.values()), one)
        return [seen[key] for key in sorted(seen)]

    @property
    def best(self) -> Candidate:
        """The candidate with the least objective.

        Raises ``ValueError`` if there are several objectives, of which ``front`` has the best ones,
        or if no candidate was possible.
        """
        if len(self.objectives) > 1:
            names = ", ".join(self.objectives)
            raise ValueError(f"best: there are several objectives ({names}); choose from front")
        found = self.front
        if not found:
            raise ValueError(
                f"none of {len(self.candidates)} candidates is possible: {self._why_none()}"
            )
        return found[0]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``; None for infinite numbers."""
        names = ("number", "parameters", "values", "violation", "finished")
        rows = [as_json(each, *names) for each in self.candidates]
        front = [c.number for c in self.front]
        return {"objectives": list(self.objectives), "candidates": rows, "front": front}

    def _why_none(self) -> str:
        reasons = [c.reason for c in self.candidates if c.reason]
        if len(reasons) == len(self.candidates):
            return f"their values are rejected, the last ones because of: {reasons[-1]}"
        least = min((c.violation for c in self.candidates if c.violation > 0.0), default=math.inf)
        if all(c.violation > 0.0 for c in self.candidates):
            return f"all violate the constraints, the best one by {least:.3g}; widen the ranges"
        return "the others have infinite objectives; widen the ranges or weaken the scenario"


def _is_finite(candidate: Candidate) -> bool:
    return all(map(math.isfinite, candidate.values.values()))


# ---- The search ----

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
        where they are simulated; see ``quell.parallel.executor_on``.
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
    build: Build, problem: Problem, violation: Callable[[Controller], float] | None, task: _Task
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
