"""Runs of a sweep: plan and values, what a worker does, the folder.

The plan of a sweep: the parameters, seed and name of each run.

The values of a sweep's parameters: ranges, normal distributions, lists.

The runs of a part of a sweep: what a worker does.

The folder of a sweep: what it is, and a file for each part of its runs.

Each file is written whole or not at all. The folder of a sweep that was killed holds the parts that
were done; what is missing is done when the sweep goes on.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import Controller, check_controller
from quell.files import write_json, written_atomically
from quell.lti.models import is_linear_model
from quell.parallel import one_blas_thread
from quell.plants.base import Plant, check_plant
from quell.plants.linear import LinearPlant
from quell.records.record import netcdf_of
from quell.simulation.scenario import Scenario, check_scenario, is_random
from quell.simulation.simulate import simulate
from quell.sweeping.measures import Measure, Measures, check_axis, describe_measures, measure_runs
from quell.types import Matrix, Vector

# ---- The values of a sweep's parameters ----


@runtime_checkable
class Distribution(Protocol):
    """A distribution to draw from: ``Range``, ``Normal``, or one of ``scipy.stats``."""

    def ppf(self, q: Vector) -> Vector:
        """Return the quantiles of the probabilities ``q``, the inverse of its distribution."""


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``: drawn, or ``steps`` of them at equal distances.

    Parameters
    ----------
    low, high
        least and largest value.
    steps
        number of values from ``low`` to ``high``, both included, that are combined with those of
        all other parameters; None to draw the values from a uniform distribution.
    log
        whether distances are equal, or the distribution is uniform, on a logarithmic scale.

    Raises
    ------
    ValueError
        if ``low`` is not less than ``high``, is not positive on a logarithmic scale, or there are
        fewer than two steps.
    """

    low: float
    high: float
    steps: int | None = None
    log: bool = False

    def __post_init__(self) -> None:
        checks.finite("low", self.low)
        checks.finite("high", self.high)
        checks.interval("low", self.low, "high", self.high)
        checks.optional(checks.whole, "steps", self.steps, 2)
        if checks.flag("log", self.log) and self.low <= 0.0:
            rule = "must be greater than zero on a logarithmic scale"
            raise ValueError(f"low = {self.low!r}: {rule}")

    def ppf(self, q: Vector) -> Vector:
        """Return the values at the shares ``q`` of the way from ``low`` to ``high``."""
        low, high = float(self.low), float(self.high)
        if self.log:
            return np.clip(low * (high / low) ** np.asarray(q), low, high)
        return np.clip(low + (high - low) * np.asarray(q), low, high)


@dataclass(frozen=True)
class Normal:
    """Numbers of a normal distribution.

    Parameters
    ----------
    mean, std
        mean and standard deviation.

    Raises
    ------
    ValueError
        if the mean is not finite, or the deviation is not positive.
    """

    mean: float
    std: float

    def __post_init__(self) -> None:
        checks.finite("mean", self.mean)
        checks.positive("std", self.std)

    def ppf(self, q: Vector) -> Vector:
        """Return the quantiles of the probabilities ``q``."""
        from scipy.special import ndtri

        return np.asarray(self.mean + self.std * ndtri(np.asarray(q)))


def latin_hypercube(rng: np.random.Generator, count: int, size: int) -> Matrix:
    """Return points (count, size) of the unit cube, one in each stratum of width 1/count.

    McKay, Beckman & Conover, *Technometrics* 21, 1979. That of ``scipy.stats`` does the same; its
    import takes 45 MB and a second, and its arguments depend on the version.
    """
    shares = rng.random((count, size))
    for column in shares.T:
        column += rng.permutation(count)
    return shares / count


def as_values(name: str, given: Any) -> Distribution | tuple[Any, ...]:
    """Return a distribution, or the tuple of all values of the parameter ``name``.

    A single value, such as a number, a text or a table, is the only one.
    """
    if isinstance(given, Range) and given.steps is not None:
        return tuple(given.ppf(np.linspace(0.0, 1.0, given.steps)).tolist())
    if isinstance(given, Distribution) and not isinstance(given, type):
        return given
    if isinstance(given, np.ndarray):
        given = given.tolist()
    values = tuple(given) if checks.is_sequence(given) else (given,)
    if not values:
        raise ValueError(f"parameters[{name!r}] is empty: must have at least one value")
    if all(map(_is_number, values)):
        for value in values:
            checks.finite(f"parameters[{name!r}]", value)
    return values  # as they are: a whole number stays one


def labels(values: Sequence[Any]) -> list[str] | None:
    """Return texts for values that are not all numbers, in tables and files; None for numbers."""
    if all(map(_is_number, values)):
        return None
    found = [_label(value) for value in values]
    return [
        text if found.count(text) == 1 else f"{text} ({found[:i].count(text) + 1})"
        for i, text in enumerate(found)
    ]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool | np.bool_)


def _label(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    if isinstance(value, Mapping | list | tuple):
        try:
            return json.dumps(value)
        except (TypeError, ValueError):
            return type(value).__name__
    if isinstance(value, int | float | np.number):
        return f"{value:g}"
    return str(getattr(value, "__name__", None) or type(value).__name__)


# ---- The plan of a sweep ----

SAMPLINGS = ("latin-hypercube", "random")
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
# More runs would need days and a design of gigabytes; it is most likely a mistake. By hand.
_MOST_RUNS = 10**9
# Words of the seed of each draw: 63 bits, so that two of 1e6 draws are equal with probability 5e-8.
_SEEDS_BELOW = 2**63


def name_of(run: int, values: Mapping[str, Any], seed: int) -> str:
    """Return the name of a run from its parameters, numbers or texts."""
    parts = [
        f"{name} = {value}" if isinstance(value, str) else f"{name} = {value:.6g}"
        for name, value in values.items()
    ]
    return f"run {run}: {', '.join([*parts, f'seed {seed}'])}"


class Part(NamedTuple):
    """The runs of a plan from ``first`` to before ``last``."""

    first: int
    last: int
    lists: Mapping[str, tuple[Any, ...]]  # parameters with all their values
    drawn: Mapping[str, NDArray[np.float64]]  # parameters that are drawn (draws,), of this part
    seeds: NDArray[np.int64]  # (draws,)

    @property
    def combinations(self) -> int:
        """Number of runs of each draw."""
        return math.prod(map(len, self.lists.values()))

    def places(self, runs: NDArray[np.int64]) -> tuple[NDArray[np.int64], dict[str, Any]]:
        """Return the draw of some runs within this part, and their places in each list."""
        draws, rest = np.divmod(runs, self.combinations)
        found = {}
        for name, values in reversed([*self.lists.items()]):
            rest, found[name] = np.divmod(rest, len(values))
        return draws - self.first // self.combinations, found

    def values(self, run: int) -> dict[str, Any]:
        """Return the parameters of a run."""
        draw, places = self.places(np.array(run))
        values = {name: column[draw].item() for name, column in self.drawn.items()}
        return values | {name: self.lists[name][int(places[name])] for name in self.lists}

    def seed(self, run: int) -> int:
        """Return the seed of a run."""
        return int(self.seeds[run // self.combinations - self.first // self.combinations])

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return each parameter of all runs: numbers, or places in the list if it has others."""
        draws, places = self.places(np.arange(self.first, self.last))
        columns: dict[str, NDArray[Any]] = {k: v[draws] for k, v in self.drawn.items()}
        for name, values in self.lists.items():
            numbers = labels(values) is None
            columns[name] = np.array(values, np.float64)[places[name]] if numbers else places[name]
        return columns


@dataclass(frozen=True, eq=False)
class Plan:
    """Which runs a sweep consists of.

    Each draw is combined with all values of all lists and of ranges with steps; the last of these
    parameters changes first from run to run. Without a distribution among the parameters, one draw
    is a full grid.

    Parameters
    ----------
    parameters
        values by name: a ``Range``, a ``Normal`` or another distribution with a method ``ppf``
        (``scipy.stats``), a list of values of any type, or a single value.
    draws
        number of draws. Each has a seed of its own, which all its combinations share: controllers
        that are compared get the same noise.
    sampling
        how distributions are drawn: ``latin-hypercube``, which covers each range evenly (McKay,
        Beckman & Conover, *Technometrics* 21, 1979), or ``random``, independently.
    seed
        seed of draws and noise.

    Raises
    ------
    ValueError
        for an argument out of range, and values that are no finite numbers where they are drawn.
    """

    parameters: Mapping[str, Any]
    draws: int = 1
    sampling: str = SAMPLINGS[0]
    seed: int = 0
    _lists: dict[str, tuple[Any, ...]] = field(init=False, repr=False)
    _distributions: dict[str, Distribution] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        checks.whole("draws", self.draws, 1)
        checks.one_of("sampling", self.sampling, SAMPLINGS)
        checks.whole("seed", self.seed, 0)
        given: Any = self.parameters
        if not isinstance(given, Mapping):
            rule = "must be a dictionary of values by name"
            raise ValueError(f"parameters = {given!r:.60}: {rule}")
        found = {name: as_values(name, each) for name, each in given.items()}
        lists = {name: each for name, each in found.items() if isinstance(each, tuple)}
        drawn = {name: each for name, each in found.items() if not isinstance(each, tuple)}
        object.__setattr__(self, "_lists", lists)
        object.__setattr__(self, "_distributions", drawn)
        if self.runs > _MOST_RUNS:
            raise ValueError(
                f"parameters: {self.runs:.3g} runs, draws × all combinations of lists and steps: "
                f"must be at most {_MOST_RUNS:.0e}"
            )

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.draws) * math.prod(map(len, self._lists.values()))

    @property
    def is_drawn(self) -> bool:
        """Whether a parameter is drawn from a distribution."""
        return bool(self._distributions)

    @property
    def lists(self) -> Mapping[str, tuple[Any, ...]]:
        """All values of the parameters that are not drawn."""
        return self._lists

    @cached_property
    def drawn(self) -> dict[str, NDArray[np.float64]]:
        """Values of the parameters that are drawn (draws,)."""
        shares = self._shares()
        found = {}
        for (name, each), column in zip(self._distributions.items(), shares.T, strict=True):
            values = np.array(each.ppf(column), np.float64)
            if values.shape != column.shape or not np.all(np.isfinite(values)):
                rule = "ppf must return a finite number for each share between 0 and 1"
                raise ValueError(f"parameters[{name!r}] = {each!r}: {rule}")
            found[name] = values
        return found

    @cached_property
    def seeds(self) -> NDArray[np.int64]:
        """Seed of each draw (draws,)."""
        return np.random.default_rng([self.seed, 1]).integers(0, _SEEDS_BELOW, self.draws)

    def part(self, first: int, last: int) -> Part:
        """Return the runs from ``first`` to before ``last``."""
        each = self.runs // self.draws
        draws = slice(first // each, (last - 1) // each + 1)
        drawn = {name: values[draws] for name, values in self.drawn.items()}
        return Part(first, last, self._lists, drawn, self.seeds[draws])

    def values(self, run: int) -> dict[str, Any]:
        """Return the parameters of a run."""
        return self.part(run, run + 1).values(run)

    def describe(self, run: int) -> str:
        """Return the name of a run: its number, its parameters, its seed."""
        part = self.part(run, run + 1)
        places = part.places(np.array(run))[1]
        values = part.values(run)
        for name, each in self._lists.items():
            texts = labels(each)
            values[name] = values[name] if texts is None else texts[int(places[name])]
        return name_of(run, {name: values[name] for name in self.parameters}, part.seed(run))

    def digest(self) -> str:
        """Return a hash of all values and seeds."""
        found = hashlib.sha256(f"{self.runs} {self.seed} {self.draws}".encode())
        for name, column in self.drawn.items():
            found.update(name.encode() + b"\0" + column.tobytes())
        for name, values in self._lists.items():
            # Objects without a text of their own have their address in it.
            found.update(f"{name}\0{_ADDRESS.sub('', repr(values))}\0".encode())
        return found.hexdigest()

    def _shares(self) -> Matrix:
        """Return draws (draws, distributions) from the unit cube, without its faces."""
        rng, size = np.random.default_rng([self.seed, 0]), len(self._distributions)
        random = self.sampling == "random"
        shares = (
            rng.random((self.draws, size)) if random else latin_hypercube(rng, self.draws, size)
        )
        return np.clip(shares, np.finfo(np.float64).tiny, 1.0 - np.finfo(np.float64).epsneg)


# ---- The runs of a part of a sweep ----

ERROR = -1
"""Status of a run that could not be built, simulated or judged; its message says why."""

# Memory for the records of the runs that are simulated at once [bytes]: as quick as more, and many
# workers fit into a machine. Runs at once: enough that a batch's own cost is small. By hand.
_RECORD_BYTES, _MOST_AT_ONCE = 8e6, 256
# Seconds for which runs are repeated to know their time. By hand.
_TIMING = 2.0


@dataclass(frozen=True)
class Job:
    """The work of each run of a sweep."""

    build: Callable[..., Any]  #: returns the parts of a run, see ``sweep``
    measures: Measures
    record: tuple[str, ...]  #: channels that functions of a run need
    takes_seed: bool  #: whether ``build`` gets the seed of the run; otherwise the scenario does


class Parts(NamedTuple):
    """A plant, a controller and a scenario."""

    plant: Plant
    controller: Controller
    scenario: Scenario


class Outcome(NamedTuple):
    """Results of some runs."""

    measures: dict[str, Vector]
    status: NDArray[np.int64]  # flags, or ``ERROR``
    ended: Vector  # [s]
    messages: dict[int, str]  # why a run has ``ERROR``, by its place among them

    @classmethod
    def empty(cls, measures: Measures, runs: int) -> Outcome:
        """Return the outcome of ``runs`` runs of which nothing is known."""
        values = {name: np.full(runs, np.nan) for name in measures}
        return cls(values, np.full(runs, ERROR), np.full(runs, np.nan), {})


def run_part(job: Job, part: Part, runs: Sequence[int] | None = None) -> Outcome:
    """Do the runs of a part, by default all, some at a time; errors of single runs are recorded."""
    which = range(part.first, part.last) if runs is None else runs
    outcome = Outcome.empty(job.measures, len(which))
    at, size = 0, 1
    with one_blas_thread():
        while at < len(which):
            block = which[at : at + size]
            samples = _run_block(job, part, block, at, outcome)
            at += len(block)
            per_run = 8.0 * (len(job.record) + 1) * max(samples, 1)
            size = int(np.clip(_RECORD_BYTES / per_run, 1, _MOST_AT_ONCE))
    return outcome


def probe(job: Job, parts: Sequence[Part], more: Part) -> tuple[float, Outcome]:
    """Do the first run of each part; return the seconds for a run of many, and the outcome.

    This compiles the loops, or loads them from the disk cache, which all workers of a machine have
    in common. The time is that of runs in ``more``.
    """
    outcome = Outcome.empty(job.measures, len(parts))
    for i, part in enumerate(parts):
        found = run_part(job, part, [part.first])
        outcome.status[i] = found.status[0]
        if found.messages:
            outcome.messages[i] = found.messages[0]
    seconds = _seconds(job, more, 1)
    runs = min(int(_TIMING / max(seconds, 1e-9)), more.last - more.first)
    return _seconds(job, more, runs) / runs if runs > 1 else seconds, outcome


def _seconds(job: Job, part: Part, runs: int) -> float:
    """Return how long the first runs of a part take [s]."""
    began = time.perf_counter()
    run_part(job, part, range(part.first, part.first + runs))
    return time.perf_counter() - began


def built(job: Job, part: Part, run: int) -> Parts:
    """Return the parts of a run."""
    values = part.values(run)
    seed = part.seed(run)
    made = job.build(**values, seed=seed) if job.takes_seed else job.build(**values)
    plant, controller, scenario = _three(made)
    if not hasattr(plant, "sampled") and is_linear_model(plant):
        plant = LinearPlant.of(plant)
    check_plant(plant)
    check_controller(controller, several=True)
    check_scenario(scenario)
    for each in job.measures.values():
        if isinstance(each, Measure):
            check_axis(each.axis, each.name, _axes_of(controller))
    if not job.takes_seed and is_random(scenario):
        scenario = replace(scenario, seed=seed)
    return Parts(plant, controller, scenario)


def check_draws(plan: Plan, job: Job) -> None:
    """Raise a ``ValueError`` for several draws of runs that do not differ.

    They differ by what is drawn from a distribution, by a seed that ``build`` takes, or by random
    signals in one of the scenarios. Runs that cannot be built are left to the sweep, which says so.
    """
    if plan.draws == 1 or plan.is_drawn or job.takes_seed:
        return
    any_built = False
    for run in range(plan.runs // plan.draws):
        try:
            scenario = built(job, plan.part(run, run + 1), run).scenario
        except Exception:  # a function of the user's may raise anything
            continue
        if is_random(scenario):
            return
        any_built = True
    if any_built:
        raise ValueError(
            f"draws = {plan.draws}: nothing in the scenario is random and no parameter is drawn "
            "from a range, so each run would be repeated as it is; add noise or random "
            "disturbances, give a range without steps, or leave draws out"
        )


def _three(made: Any) -> tuple[Any, Any, Any]:
    needed = getattr(made, "needed", None)
    if callable(needed):  # a quell.setup.Setup
        return needed("plant"), made.controller, needed("scenario")
    try:
        plant, controller, scenario = made
    except (TypeError, ValueError):
        rule = "must return (plant, controller, scenario), or a setup"
        raise ValueError(f"build returned {made!r:.60}: {rule}") from None
    return plant, controller, scenario


def _run_block(job: Job, part: Part, runs: Sequence[int], at: int, outcome: Outcome) -> int:
    """Do some runs, whose places in the outcome begin at ``at``; return the samples of the longest.

    Runs that fit into a batch are simulated as one.
    """
    groups: dict[Hashable, list[tuple[int, Parts]]] = {}
    samples, scenario = 0, None
    for place, run in enumerate(runs, at):
        try:
            parts = built(job, part, run)
        except Exception as error:  # a function of the user's may raise anything
            outcome.messages[place] = _text(error)
            continue
        # Runs of one scenario share its samples.
        if scenario is not None and _same(scenario, parts.scenario):
            parts = parts._replace(scenario=scenario)
        scenario = parts.scenario
        groups.setdefault(_batch_key(parts), []).append((place, parts))
        samples = max(samples, int(scenario.duration / parts.controller.dt) + 1)
    for group in groups.values():
        _run_group(job, group, outcome)
    return samples


def _same(one: Scenario, other: Scenario) -> bool:
    try:
        return one is other or bool(one == other)
    except ValueError:  # arrays within them
        return False


def _batch_key(parts: Parts) -> Hashable:
    """Return what the runs of a batch must have in common."""
    plant, controller, scenario = parts
    about_plant = type(plant), plant.order, plant.disturbances
    about_controller = controller.dt, controller.channels, controller.features
    return *about_plant, *about_controller, type(controller), scenario.duration


def _axes_of(controller: Any) -> tuple[str, ...] | None:
    return tuple(getattr(controller, "names", ())) if hasattr(controller, "inputs") else None


def _run_group(job: Job, group: Sequence[tuple[int, Parts]], outcome: Outcome) -> None:
    """Simulate runs as one batch; if one of them makes that impossible, in halves."""
    places = [place for place, _ in group]
    plants, controllers, scenarios = zip(*(parts for _, parts in group), strict=True)
    has_axes = any(name == "v" for name, _ in controllers[0].channels)  # what their u is
    record = (*job.record, "v") if has_axes else job.record
    options: dict[str, Any] = {"record": record, "workers": 1}
    try:
        result = simulate(list(plants), list(controllers), list(scenarios), **options)
    except Exception as error:  # a plant of the user's may raise anything
        if len(group) == 1:
            outcome.messages[places[0]] = _text(error).replace("run 0: ", "", 1)
            return
        half = len(group) // 2
        _run_group(job, group[:half], outcome)
        _run_group(job, group[half:], outcome)
        return
    runs = [result.run(i) for i in range(len(result))]
    _take(job, places, runs, result.status, result.ended, outcome)


def _take(
    job: Job, places: list[int], runs: Sequence[Any], status: Any, ended: Any, outcome: Outcome
) -> None:
    """Write the measures of some runs into an outcome."""
    values, errors = measure_runs(runs, job.measures)
    for name, column in values.items():
        outcome.measures[name][places] = column
    outcome.ended[places] = ended
    outcome.status[places] = np.where([bool(text) for text in errors], ERROR, status)
    outcome.messages.update(
        {place: text for place, text in zip(places, errors, strict=True) if text}
    )


def _text(error: Exception) -> str:
    """Return the message of an error in one line, with its type if it is not about a value."""
    text = " ".join(str(error).split())
    return text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}"


# ---- The folder of a sweep ----

MANIFEST = "sweep.json"
_FORMAT = "quell sweep 1"
# Limit of the manifest's size: it has texts of the setup and no value of each run. By hand.
_MOST_BYTES = 16_000_000


@dataclass(frozen=True)
class Store:
    """The folder of a sweep."""

    folder: Path
    runs: int
    chunk: int  #: runs in a file
    about: Mapping[str, Any]  #: what makes it this sweep
    labels: Mapping[str, list[str] | None]  #: texts of parameters that are not numbers, by name
    measures: Mapping[str, Any]  #: attributes of the measures, by name

    def file(self, first: int) -> Path:
        """Return the file of the runs from ``first`` on."""
        return self.folder / f"runs-{first:010d}.nc"

    def parts(self) -> Iterator[tuple[int, int]]:
        """Return an iterator over first run and end of each file."""
        for first in range(0, self.runs, self.chunk):
            yield first, min(first + self.chunk, self.runs)

    def missing(self) -> list[tuple[int, int]]:
        """Return the parts that have no file yet."""
        there = {file.name for file in self.folder.iterdir()}
        return [each for each in self.parts() if self.file(each[0]).name not in there]

    def write(self, part: Part, outcome: Outcome) -> None:
        """Write the file of a part."""
        errors = sorted(outcome.messages)
        seeds = part.seeds[part.places(np.arange(part.first, part.last))[0]]
        variables: dict[str, tuple[str, Any, Mapping[str, Any]]] = {
            name: ("run", values, self.measures[name]) for name, values in outcome.measures.items()
        }
        variables["status"] = ("run", outcome.status.astype(np.int32), {})
        variables["ended"] = ("run", outcome.ended, {"units": "s"})
        variables["seed"] = ("run", seeds, {})
        variables["error_run"] = ("error", np.array(errors, np.int64) + part.first, {})
        variables["error"] = ("error", [outcome.messages[i] for i in errors], {})
        for name, column in part.columns().items():
            texts = self.labels[name]
            codes = column if texts is None else column.astype(np.int32)
            about = {} if texts is None else {"labels": texts}
            variables[parameter_variable(name)] = ("run", codes, {"parameter": name, **about})
        attributes = {"format": _FORMAT, "first": part.first}
        image = netcdf_of(
            {"run": part.last - part.first, "error": len(errors)}, variables, attributes
        )
        with written_atomically(self.file(part.first), overwrite=True) as file:
            file.write_bytes(image)


def parameter_variable(name: str) -> str:
    """Return the name of a parameter's variable: a slash would be a group of the file."""
    return f"parameter_{name.replace('/', '_')}"


def open_store(folder: str | os.PathLike[str]) -> Store:
    """Return the sweep that a folder holds.

    Raises
    ------
    ValueError
        if there is none.
    """
    path = Path(folder)
    try:
        with (path / MANIFEST).open("rb") as file:
            text = file.read(_MOST_BYTES + 1)
        if len(text) > _MOST_BYTES:
            raise ValueError(f"is larger than {_MOST_BYTES / 1e6:.0f} MB")
        told = json.loads(text)
        if not isinstance(told, dict) or told.get("format") != _FORMAT:
            raise ValueError(f"format is not {_FORMAT!r}")
        return Store(
            path,
            checks.whole("runs", told["runs"], 1),
            checks.whole("chunk", told["chunk"], 1),
            dict(told["about"]),
            dict(told["labels"]),
            dict(told["measures"]),
        )
    except OSError as error:
        why = f"{MANIFEST} can't be read ({error.strerror})"
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        why = f"{MANIFEST} is none of quell's: {error}"
    raise ValueError(f"folder = {str(path)!r}: holds no sweep: {why}")


def existing_store(folder: str | os.PathLike[str], about: Mapping[str, Any]) -> Store | None:
    """Return the sweep in a folder if it is the same; None if the folder is empty or not there.

    Raises
    ------
    ValueError
        if the folder holds another sweep or other files, or is no folder.
    """
    path = Path(folder)
    if not os.path.lexists(path):
        return None
    if not path.is_dir():
        raise ValueError(f"folder = {str(path)!r}: must be a folder, is a file")
    if not (path / MANIFEST).exists():
        if any(not each.name.startswith(".") for each in path.iterdir()):
            raise ValueError(f"folder = {str(path)!r}: holds other files; choose an empty folder")
        return None
    store = open_store(path)
    differ = [key for key, value in about.items() if store.about.get(key) != value]
    if differ:
        raise ValueError(
            f"folder = {str(path)!r}: holds the results of another sweep, which differs in "
            f"{', '.join(differ)}; choose another folder"
        )
    return store


def new_store(
    folder: str | os.PathLike[str],
    plan: Plan,
    chunk: int,
    about: Mapping[str, Any],
    measures: Measures,
) -> Store:
    """Make the folder of a sweep, and the file that says what it is."""
    path, runs = Path(folder), plan.runs
    texts = {name: labels(plan.lists.get(name, ())) for name in plan.parameters}
    store = Store(path, runs, chunk, about, texts, describe_measures(measures))
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"folder = {str(path)!r}: can't be made ({error.strerror})") from None
    told = {"format": _FORMAT, "runs": runs, "chunk": chunk}
    told |= {"about": about, "labels": store.labels, "measures": store.measures}
    write_json(path / MANIFEST, told)
    return store


def hash_of(value: Any) -> str:
    """Return a short hash of what JSON can hold."""
    text = json.dumps(value, sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
