"""Setups: the objects that a file of one axis describes, its tuning, and other values.

A setup with other values is what sweeps (``setup/sweeps.py``) and tuning change of a file. The
arguments of ``quell.tune`` are the plant, its ranges and constraints.
"""

from __future__ import annotations

import html
import os
import re
import types
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, Union, get_args, get_origin

from pydantic_core import PydanticUndefined

from quell import checks
from quell.controllers.base import Controller
from quell.controllers.compensated import Compensated
from quell.controllers.prefilters import Prefiltered
from quell.files import nonfinite_to_none
from quell.plants.base import Plant, signals_of
from quell.plants.linearise import linear_model
from quell.records.metrics import SETTLING_BAND
from quell.setup.description import Description, describe, is_of_axes
from quell.setup.schema import (
    Builder,
    CallTable,
    SetupError,
    Table,
    check_single,
    parameters_of,
    read,
)
from quell.simulation.scenario import Scenario, checked_start
from quell.tuning.constraints import Constraints
from quell.tuning.designs import SIMPLEST, range_of_u
from quell.tuning.plants import with_known_noise
from quell.tuning.structures.registry import FEEDING_FORWARD
from quell.tuning.tables import late_tables, rest_of_plant
from quell.tuning.tuned import checked_range
from quell.tuning.written import Written

# ---- A setup ----

Known: TypeAlias = dict[str, tuple[tuple[Any, ...], Any]]
"""Inputs and object of each part that was built, for ``assembled``."""

# Tables that commands ask for, as short as they can be.
_EXAMPLES = {
    "scenario": "scenario = {duration = 10.0, reference = {kind = 'step'}}",
    "plant": "plant = {kind = 'linear', num = [1.0], den = [1.0, 1.0]}",
    "rig": "rig = {device = 'twin:'}",
}
_EXAMPLES_OF_AXES = {
    "scenario": "scenario = {duration = 10.0}, and reference = {kind = 'step'} in each [[axis]]",
    "plant": "plant = {kind = 'linear', A = …, B = …, C = …}, or {kind = 'arm'}",
    "rig": "rig = {device = 'udp://127.0.0.1:5005'}",
}

EXAMPLES = Path(__file__).parent / "examples"
"""The folder of the files that come along: two_mass.toml, torsional_rig.toml and arm.toml."""


@dataclass(frozen=True, eq=False)
class Setup:
    """The objects that a setup file describes.

    Optional parts that the file does not have are None.
    """

    file: str  #: name of the file
    title: str  #: title of tables and figures
    controller: Controller  #: behind its prefilter if it has one; its ``dt`` is the loop's
    plant: Plant | None  #: the plant
    scenario: Scenario | None  #: the scenario
    rig: dict[str, Any] | None  #: arguments of ``run_rig``, and ``live``
    sweep: dict[str, Any] | None  #: what ``sweep_table`` returns
    windows: tuple[dict[str, Any], ...]  #: arguments of ``Trajectory.metrics`` for each window
    description: Any  #: the file's own tables, a ``Description``, or ``AxesDescription``
    tune: dict[str, Any] | None = None  #: arguments of ``quell.tune``
    trust: bool = False  #: whether Python files that it names were run

    def tables(self) -> dict[str, Any]:
        """Return the file's tables and keys as dictionaries, which ``made`` accepts."""
        return self.description.model_dump(exclude_unset=True)

    def as_json(self) -> dict[str, Any]:
        """Return the file's tables for ``quell.files.write_json``; infinite numbers become None."""
        return nonfinite_to_none(self.tables())

    def needed(self, table: str) -> Any:
        """Return the object of an optional table; raise a ``SetupError`` if it is missing."""
        if getattr(self, table) is None:
            examples = _EXAMPLES_OF_AXES if is_of_axes(self.tables()) else _EXAMPLES
            example = f", {examples[table]}" if table in examples else ""
            raise SetupError([f"{self.file}: {table}: missing; give a table [{table}]{example}"])
        return getattr(self, table)


def assembled(
    name: str, tables: Description, known: Known | None = None, trust: bool = False
) -> Setup:
    """Build the objects of the tables of a file; ``reading.made`` checks what they do together.

    ``known`` has inputs and objects of an earlier call: what is the same is not built again.
    """
    builder = Builder(name, trust)
    build_once = partial(made_once, {} if known is None else known)
    dt = builder.attempt("", (), checks.positive, "dt", tables.dt, "s")

    def build(key: str, **context: Any) -> Any:
        table = getattr(tables, key)
        if table is None:
            return None
        takes = set(parameters_of(table.function))
        if table.written().get("feedforward") not in (None, True, False):
            takes.add("plant")  # the feedforward of a model
        context = {each: context[each] for each in takes & context.keys()}
        inputs = table, dt, *context, *context.values()
        return build_once(key, inputs, partial(builder.build, table, key, dt=dt, **context))

    _check_ranges(name, tables.plant)
    plant = build("plant")
    if plant is not None:
        check_single(name, plant)
    model = None if plant is None else build_once("model", (plant,), partial(linear_model, plant))
    parts = {key: build(key, plant=model) for key in ("observer", "learner", "guard")}
    kind, used = tables.controller.kind_name, tables.controller.context
    if tables.compensator is not None:
        kind, used = f"{kind} with a compensator", tables.compensator.context
    unused = [key for key, part in parts.items() if part is not None and key not in used]
    if unused:
        rule = f"a controller of the kind {kind} does not use it"
        raise SetupError([f"{name}: {key}: {rule}" for key in unused])
    # A controller is designed for the linear part; a feedforward also uses friction and delay.
    designs = "plant" in parameters_of(tables.controller.function)
    own = parts if tables.compensator is None else {}
    controller = build("controller", plant=model if designs else plant, **own)
    if tables.compensator is not None:
        compensator = build("compensator", **parts)
        combine = partial(builder.attempt, "compensator", (), Compensated, controller, compensator)
        controller = build_once("compensated", (controller, compensator), combine)
    prefilter, scenario, rig = build("prefilter"), build("scenario"), build("rig")
    if rig is not None and plant is not None and signals_of(plant).known:
        rig = {"signals": signals_of(plant), **rig}
    sweep = build("sweep")
    if prefilter is not None:
        join = partial(builder.attempt, "prefilter", (), Prefiltered, controller, prefilter)
        controller = build_once("joined", (controller, prefilter), join)
    if scenario is not None and plant is not None:
        count = plant.disturbances
        check = partial(scenario.seeded_signals, count)
        attempt = partial(builder.attempt, "scenario", ("disturbances",), check)
        build_once("signals", (scenario, count), attempt)
        start = partial(checked_start, scenario, plant, dt)
        builder.attempt("scenario", ("x0", "duration"), start)
    windows = windows_of(builder, tables.metrics)
    title = tables.title or title_of(name)
    tune = build("tune")
    built = controller, plant, scenario, rig, sweep, windows
    return Setup(name, title, *built, tables, tune, trust)


def check_windows(setup: Setup) -> None:
    """Raise a ``SetupError`` for windows of [[metrics]] that begin after the scenario's end."""
    if setup.scenario is None:
        return
    end = setup.scenario.duration
    late = [
        f"{setup.file}: metrics[{i}].start = {window['start']:g}: "
        f"must be less than the scenario's duration, {end:g} s"
        for i, window in enumerate(setup.windows)
        if window.get("start", 0.0) >= end
    ]
    if late:
        raise SetupError(late)


def windows_of(builder: Builder, tables: Sequence[Table]) -> tuple[dict[str, Any], ...]:
    """Return the windows of [[metrics]], checked."""
    windows = tuple(window.written() for window in tables)
    for i, window in enumerate(windows):
        builder.attempt(f"metrics[{i}]", [*window], partial(check_window, **window))
    return windows


def title_of(name: str) -> str:
    """Return the title of a setup that has none: the name of its file."""
    return "".join(
        each if unicodedata.category(each)[0] != "C" else "?"
        for each in name.removesuffix(".toml").replace("_", " ")
    )


def _check_ranges(name: str, plant: CallTable | None) -> None:
    """Check that the ranges of a plant are those of its keys, and have a low and a high end."""
    ranges: Mapping[str, Any] = getattr(plant, "uncertain", None) or {}
    for path, ends in ranges.items():
        try:
            checked_range(path, ends)
        except ValueError as error:
            raise SetupError([f"{name}: plant.{error}"]) from None
        table: Any = plant
        for step in path.split("."):
            if isinstance(table, Mapping):  # parameters of a function or an FMU, which know them
                break
            key = step.partition("[")[0]
            known = [*type(table).model_fields] if isinstance(table, Table) else []
            known = [each for each in known if each not in ("kind", "uncertain", "signals")]
            if key not in known:
                where = f"{name}: plant.uncertain: plant.{path}"
                raise SetupError([f"{where}: unknown; {checks.nearest(key, known)}"])
            table = getattr(table, key)


def made_once(known: Known, key: str, inputs: tuple[Any, ...], make: Callable[[], Any]) -> Any:
    """Return the object that was made of the same inputs before, or make it.

    Tables and numbers are the same if they are equal, objects if they are one.
    """
    before = known.get(key)
    if before is None or not _same(before[0], inputs):
        known[key] = inputs, make()
    return known[key][1]


def _same(before: tuple[Any, ...], now: tuple[Any, ...]) -> bool:
    by_value = (Table, float, int, str)
    return len(before) == len(now) and all(
        one is other or (isinstance(other, by_value) and one == other)
        for one, other in zip(before, now, strict=True)
    )


def check_window(
    start: float = 0.0,
    stop: float | None = None,
    target: float | None = None,
    band: float = SETTLING_BAND,
) -> None:
    """Check the arguments of ``Trajectory.metrics`` before the run."""
    checks.non_negative("start", start, "s")
    if stop is not None:
        checks.interval("start", start, "stop", stop)
    if target is not None:
        checks.finite("target", target)
    checks.positive("band", band)


# ---- Tables of all keys of setup files in Markdown, for the documentation ----

_TYPES = {float: "number", int: "whole number", bool: "true or false", str: "text"}


def keys(of: type[Table]) -> list[tuple[str, str, str, str]]:
    """Return name, type, default and description of each key of a table, except ``kind``."""
    return [
        (key, _type(field.annotation), _default(field.default), field.description or "")
        for key, field in of.model_fields.items()
        if key != "kind"
    ]


def table(of: type[Table]) -> str:
    """Return the keys of a table in Markdown; an empty text for a table without keys."""
    bar = r"\|"
    rows = [
        f"| `{key}` | {kind} | {default} | {text.replace('|', bar)} |"
        for key, kind, default, text in keys(of)
    ]
    heading = ["| key | type | default | |", "|---|---|---|---|"]
    return "\n".join(heading + rows if rows else []).replace("``", "`")


def markdown(kinds: Mapping[str, type[CallTable]]) -> str:
    """Return the kinds of a table in Markdown, each with its keys folded below it."""
    folds = []
    for kind, of in kinds.items():
        about = re.sub("`+([^`]+)`+", r"<code>\1</code>", html.escape(str(of.__doc__), False))
        title = f"<summary><code>{kind}</code> {about}</summary>"
        folds.append(f"<details>{title}\n\n{table(of)}\n\n</details>")
    return "\n\n".join(folds)


def _default(value: Any) -> str:
    if value is PydanticUndefined:
        return "**needed**"
    if value is None:
        return ""
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f"`{str(value).lower() if isinstance(value, bool) else repr(value)}`"


def _type(annotation: Any) -> str:
    """Return the name of a type in TOML."""
    if annotation in _TYPES:
        return _TYPES[annotation]
    origin = get_origin(annotation)
    inside = [part for part in get_args(annotation) if part is not types.NoneType]
    if origin is tuple:
        return "list"
    if origin is dict:
        return "table"
    if origin in (Union, types.UnionType):
        named = list(dict.fromkeys(_type(part) for part in inside))
        return "table" if all(name == "table" for name in named) else ", ".join(named)
    if origin is not None and inside:  # Annotated
        return _type(inside[0])
    return "table" if isinstance(annotation, type) and issubclass(annotation, Table) else "numbers"


# ---- A setup with other values ----

# A path is written as in the messages: plant.m1, scenario.disturbances[1].height.
_STEP = re.compile(r"\.?([^.\[\]]+)|\[(\d+)\]")
_PATH = re.compile(r"[^.\[\]]+(?:\.[^.\[\]]+|\[\d+\])*")


def varied(setup: Setup, changes: Mapping[str, Any]) -> Setup:
    """Return the setup of the same file with other values.

    Parameters
    ----------
    setup
        from ``load``; it is not changed.
    changes
        values by path: ``{"plant.m1": 0.7, "scenario.disturbances[1].height": 2.0}``. A value may
        be whatever the file may have there: a number, a list, a table (a dictionary), or None to
        leave out an optional table.

    Raises
    ------
    SetupError
        if a path is none of the file's keys, or a value does not fit; it names the path.

    Examples
    --------
    >>> from quell.setup import EXAMPLES, load
    >>> setup = load(EXAMPLES / "two_mass.toml")
    >>> lighter = varied(setup, {"plant.m1": 0.7, "learner": None})
    >>> float(setup.plant.B[2, 0]), float(lighter.plant.B[2, 0])
    (1.0, 1.4285714285714286)
    """
    if not isinstance(setup, Setup):
        raise ValueError(f"setup = {setup!r:.80}: must be a Setup, as quell.setup.load returns it")
    return unchecked(setup.file, changed(setup.file, setup.tables(), changes), setup.trust)


def controllers_of(setup: Setup) -> Callable[[Mapping[str, float]], Controller]:
    """Return a function from values by path to the setup's controller with these values.

    It is the ``build`` of ``quell.tuning.simulated.search``, which so varies any numbers of
    observer, controller, learner and guard; it may be sent to other processes.

    Raises
    ------
    SetupError
        as ``varied``, when it is called.

    Examples
    --------
    >>> from quell.setup import EXAMPLES, load
    >>> build = controllers_of(load(EXAMPLES / "two_mass.toml"))
    >>> build({"observer.omega_o": 9.0, "learner.prior": 1.0}).learner.prior
    1.0
    """
    return partial(_controller, setup.file, setup.tables(), trust=setup.trust)


def _controller(
    name: str, tables: Mapping[str, Any], values: Mapping[str, float], trust: bool
) -> Controller:
    return unchecked(name, changed(name, tables, values), trust).controller


def unchecked(name: str, data: Mapping[str, Any], trust: bool = False) -> Setup:
    """Build what ``made`` builds, without the checks of what parts do together."""
    return assembled(name, describe(name, data), trust=trust)


def changed(name: str, data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``data``, the content of the file ``name``, with other values at some paths."""
    result: dict[str, Any] = dict(data)
    for path, value in changes.items():
        result = _with(name, result, steps_of(name, path), value, path)
    return result


def steps_of(name: str, path: str) -> list[str | int]:
    """Return the keys and places in lists that a path goes through."""
    if not isinstance(path, str) or not _PATH.fullmatch(path):
        rule = "must be a path of keys, such as plant.m1 or scenario.disturbances[1].height"
        raise SetupError([f"{name}: {path!r}: {rule}"])
    return [key or int(place) for key, place in _STEP.findall(path)]


def _with(name: str, where: Any, steps: list[str | int], value: Any, path: str) -> Any:
    """Return a copy of ``where`` with ``value`` at the end of the steps."""
    if not steps:
        return value
    step, *rest = steps
    if isinstance(step, int):
        if not isinstance(where, list | tuple):
            raise SetupError(
                [f"{name}: {path}: [{step}] is no place in a list here: {where!r:.60}"]
            )
        if step >= len(where):
            raise SetupError(
                [f"{name}: {path}: [{step}] is beyond the list's {len(where)} entries"]
            )
        parts = list(where)
        parts[step] = _with(name, parts[step], rest, value, path)
        return parts
    if isinstance(where, str):  # a text in place of a table is its kind
        where = {"kind": where}
    if where is None:  # a table that the file does not have
        where = {}
    if not isinstance(where, Mapping):
        raise SetupError([f"{name}: {path}: {step} is no key here, but in {where!r:.60}"])
    return {**where, step: _with(name, where.get(step), rest, value, path)}


# ---- Arguments of quell.tune from a setup file ----

REPLACED = ("observer", "controller", "compensator", "learner", "guard", "prefilter")
"""Tables that a tuning replaces."""
NO_CONTROLLER = {"kind": "pid", "kp": 0.0}
"""The table of a law without effect, which stands in for the controller."""


class TuningTask(NamedTuple):
    """Arguments of ``quell.tune``."""

    plant: Any  # a plant, linear unless simulated; with ranges, a function that makes it
    dt: float  # [s]
    options: dict[str, Any]  # all others
    setup: Setup


def tuning_task(
    path: str | os.PathLike[str],
    changes: Mapping[str, Any] | None = None,
    trust: bool = False,
    limits: Mapping[str, float] | None = None,
) -> TuningTask:
    """Read a setup file for ``quell.tune``; ``changes`` are values of ``[tune]`` by name.

    ``limits`` are limits of u that replace those of the file's controller.

    Observer, controller, learner, guard and prefilter of the file are left out: they are what is
    tuned. The limits of u stay, and the tuned controller has the feedforward of a model if the
    file's feeds forward, unless ``[tune]`` says otherwise. Dry friction and limits of the plant are
    left out, too; a tuning by simulation (``trials``) has them.

    Raises
    ------
    SetupError
        as ``load``; for a file without plant, for ranges that are none of the plant's keys, and for
        ``storage`` without ``trials``.
    """
    name, data = read(path)
    given = data.get("controller", {})
    kept = {key: value for key, value in data.items() if key not in REPLACED}
    kept["controller"] = NO_CONTROLLER
    table = data.get("tune", {})
    if isinstance(table, Mapping):
        asked = {**table, **(changes or {})}
        if "storage" in asked and "trials" not in asked:
            rule = "has no effect without trials; give them (--trials), or leave it out"
            raise SetupError([f"{name}: tune.storage = {asked['storage']!r}: {rule}"])
        structure = asked.get("structure", SIMPLEST)
        if isinstance(given, Mapping) and structure in (SIMPLEST, *FEEDING_FORWARD):
            asked = _feedforward(given) | asked
        if asked:
            kept["tune"] = asked
    setup = unchecked(name, kept, trust)
    check_windows(setup)
    plant, ranges = setup.needed("plant"), _ranges(setup)
    options = tuning_options(setup, given, plant, limits or {})
    options["setup"] = tuned_tables(setup, data, plant, options)
    options["written"] = written_loop(setup, options["setup"])
    if "scenario" not in data:
        with suppress(ValueError):  # of a plant without operating point, which tune refuses
            options["rest"] = rest_of_plant(plant, setup.controller.dt)
    part = linear_model
    if "search" in options:
        options["scenario"], part = setup.needed("scenario"), _whole
    if not ranges:
        return TuningTask(part(plant), setup.controller.dt, options, setup)
    for key in ranges:
        _with_tuning_task(
            setup.file, kept, {key: ranges[key][0]}, trust
        )  # an unknown key is an error now

    def make(**values: float) -> Any:
        return part(_with_tuning_task(name, kept, values, trust).plant)

    return TuningTask(make, setup.controller.dt, {**options, "uncertain": ranges}, setup)


def tuning_options(
    setup: Setup, controller: Any, plant: Any, limits: Mapping[str, float]
) -> dict[str, Any]:
    """Return the options of ``[tune]``, with limits of u and the known noise in the constraints.

    Limits are those of ``controller``, the file's table, unless ``[tune]`` or ``limits`` have them.
    """
    options = dict(setup.tune or {})
    if isinstance(controller, Mapping):
        names = ("u_min", "u_max", "rate_limit")
        options = {key: controller[key] for key in names if key in controller} | options
    options |= limits
    bounds, u_limits = options.get("constraints") or Constraints(), range_of_u(options)
    file = Written(plant, setup.scenario, setup.controller.dt)
    noise = 0.0 if setup.scenario is None else file.noise
    options["constraints"] = with_known_noise(bounds, plant, u_limits, noise)
    return options


def tuned_tables(
    setup: Setup, data: Mapping[str, Any], plant: Any, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the tables of the tuned file beside the controller's; ``data`` are the file's.

    Delay and lag of ``[tune]`` become those of the plant.
    """
    tables = {key: value for key, value in data.items() if key not in REPLACED}
    late = {key: options.get(key, 0.0) for key in ("delay", "actuator_lag")}
    late = {key: time for key, time in late.items() if isinstance(time, float) and time > 0.0}
    if not late:
        return tables
    times = late.get("delay", 0.0), late.get("actuator_lag", 0.0)
    try:
        tables = late_tables(tables, plant, setup.controller.dt, *times)
    except ValueError as error:
        raise SetupError([f"{setup.file}: tune: {error}"]) from None
    if "tune" in data:
        tables["tune"] = {key: value for key, value in tables["tune"].items() if key not in late}
    return tables


def _feedforward(controller: Mapping[str, Any]) -> dict[str, Any]:
    """Return the feedforward of a controller's table as an option of [tune]."""
    if controller.get("feedforward"):
        return {"feedforward": controller["feedforward"]}
    if "inertia" in controller:  # of a cascade
        model = {key: controller[key] for key in ("inertia", "viscous") if key in controller}
        return {"feedforward": {"kind": "rigid"} | model}
    return {}


def written_loop(setup: Setup, tables: Mapping[str, Any]) -> Written:
    """Return plant and scenario of the file that a tuning writes."""
    used = ("title", "dt", "plant", "scenario")
    kept = {key: tables[key] for key in used if key in tables} | {"controller": NO_CONTROLLER}
    file = unchecked(setup.file, kept, setup.trust)
    return Written(file.needed("plant"), file.scenario, file.controller.dt)


def _whole(plant: Any) -> Any:
    return plant


def _with_tuning_task(
    name: str, data: Mapping[str, Any], values: Mapping[str, float], trust: bool
) -> Setup:
    changes = {f"plant.{key}": value for key, value in values.items()}
    return unchecked(name, changed(name, data, changes), trust)


def _ranges(setup: Setup) -> dict[str, tuple[float, float]]:
    found = getattr(setup.description.plant, "uncertain", None)
    if found == {}:
        raise SetupError(
            [f"{setup.file}: plant.uncertain: is empty; give a range, m1 = [0.6, 1.4]"]
        )
    return dict(found or {})
