"""A setup: the objects that a file describes."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from quell import checks
from quell.controllers.base import Controller
from quell.controllers.prefilters.prefilter import Prefiltered
from quell.files import nonfinite_to_none
from quell.plants.base import Plant
from quell.plants.labelled import signals_of
from quell.plants.linear_part import linear_model
from quell.records.metrics import SETTLING_BAND
from quell.setup.build import Builder, parameters_of
from quell.setup.description import Description, describe
from quell.setup.errors import SetupError
from quell.setup.schema import CallTable, Table
from quell.setup.toml_file import read
from quell.simulation.scenario import Scenario

Known: TypeAlias = dict[str, tuple[tuple[Any, ...], Any]]
"""Inputs and object of each part that was built, for ``assembled``."""

# Tables that commands ask for, as short as they can be.
_EXAMPLES = {
    "scenario": "scenario = {duration = 10.0, reference = {kind = 'step'}}",
    "plant": "plant = {kind = 'linear', num = [1.0], den = [1.0, 1.0]}",
    "rig": "rig = {device = 'twin:'}",
}

EXAMPLES = Path(__file__).parent / "examples"
"""The folder of the files that come along: ``two_mass.toml`` and ``torsional_rig.toml``."""


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
    description: Description  #: the file's own tables
    tune: dict[str, Any] | None = None  #: arguments of ``quell.tune``
    trust: bool = False  #: whether Python files that it names were run

    def tables(self) -> dict[str, Any]:
        """Return the file's tables and keys as dictionaries, which ``made`` accepts."""
        return self.description.model_dump(exclude_unset=True)

    def as_json(self) -> dict[str, Any]:
        """Return the file's tables for ``quell.files.write_json``; infinite numbers become None."""
        tables: dict[str, Any] = nonfinite_to_none(self.tables())
        return tables

    def needed(self, table: str) -> Any:
        """Return the object of an optional table; raise a ``SetupError`` if it is missing."""
        if getattr(self, table) is None:
            example = f", {_EXAMPLES[table]}" if table in _EXAMPLES else ""
            raise SetupError([f"{self.file}: {table}: missing; give a table [{table}]{example}"])
        return getattr(self, table)


def load(path: str | os.PathLike[str], trust: bool = False) -> Setup:
    r"""Read a TOML file and build the objects that it describes.

    A plant of the kind ``python`` runs a Python file, which is refused without ``trust``. A
    ``SetupError`` has a line for each error: file, path of the key, value and rule, or the
    nearest known name.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> text = "dt = 0.01\ncontroller = {omega_c = 2.0}\n"
    >>> text += "observer = {kind = 'model-free', order = 2, b0 = 1.0, omega_0 = 9.0}"
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "rig.toml"
    ...     _ = path.write_text(text)
    ...     load(path)
    Traceback (most recent call last):
        ...
    quell.setup.errors.SetupError: rig.toml: observer.omega_0: unknown; did you mean omega_o?
    """
    return made(*read(path), trust)


def made(name: str, data: Mapping[str, Any], trust: bool = False) -> Setup:
    """Build the objects that ``data`` describes: the content of a TOML file called ``name``.

    Raises
    ------
    SetupError
        as ``load``.
    """
    return assembled(name, describe(name, data), trust=trust)


def assembled(
    name: str, tables: Description, known: Known | None = None, trust: bool = False
) -> Setup:
    """Build the objects of the tables of a file.

    ``known`` has inputs and objects of an earlier call: what is the same is not built again.
    """
    builder = Builder(name, trust)
    made_once = partial(_made_once, {} if known is None else known)
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
        return made_once(key, inputs, partial(builder.build, table, key, dt=dt, **context))

    _check_ranges(name, tables.plant)
    plant = build("plant")
    model = None if plant is None else made_once("model", (plant,), partial(linear_model, plant))
    parts = {key: build(key, plant=model) for key in ("observer", "learner", "guard")}
    kind, used = tables.controller.kind_name, tables.controller.context
    unused = [key for key, part in parts.items() if part is not None and key not in used]
    if unused:
        rule = f"a controller of the kind {kind} does not use it"
        raise SetupError([f"{name}: {key}: {rule}" for key in unused])
    # A controller is designed for the linear part; a feedforward also uses friction and delay.
    designs = "plant" in parameters_of(tables.controller.function)
    controller = build("controller", plant=model if designs else plant, **parts)
    prefilter, scenario, rig = build("prefilter"), build("scenario"), build("rig")
    if rig is not None and plant is not None and signals_of(plant).known:
        rig = {"signals": signals_of(plant), **rig}
    sweep = build("sweep")
    if prefilter is not None:
        join = partial(builder.attempt, "prefilter", (), Prefiltered, controller, prefilter)
        controller = made_once("joined", (controller, prefilter), join)
    if scenario is not None and plant is not None:
        count = plant.disturbances
        check = partial(scenario.seeded_signals, count)
        attempt = partial(builder.attempt, "scenario", ("disturbances",), check)
        made_once("signals", (scenario, count), attempt)
    windows = tuple(window.written() for window in tables.metrics)
    for i, window in enumerate(windows):
        builder.attempt(f"metrics[{i}]", [*window], partial(_check_window, **window))
    title = tables.title or "".join(
        each if unicodedata.category(each)[0] != "C" else "?"
        for each in name.removesuffix(".toml").replace("_", " ")
    )
    tune = build("tune")
    built = controller, plant, scenario, rig, sweep, windows
    return Setup(name, title, *built, tables, tune, trust)


def _check_ranges(name: str, plant: CallTable | None) -> None:
    """Check that the ranges of a plant are those of its keys."""
    for path in getattr(plant, "uncertain", None) or ():
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


def _made_once(known: Known, key: str, inputs: tuple[Any, ...], make: Callable[[], Any]) -> Any:
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


def _check_window(
    start: float = 0.0,
    stop: float | None = None,
    target: float | None = None,
    band: float = SETTLING_BAND,
) -> None:
    """Check the arguments of ``Trajectory.metrics`` before the run."""
    checks.finite("start", start)
    if stop is not None:
        checks.interval("start", start, "stop", stop)
    if target is not None:
        checks.finite("target", target)
    checks.positive("band", band)
