"""Operating points of a setup file: the arguments of ``quell.tune_schedule``.

``[tune.schedule]`` has the points of a signal: each with the keys of ``[plant]`` that are different
there, or as values of one key of ``[plant]``. All other options are those of ``[tune]``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from itertools import product
from typing import Any, NamedTuple, TypeAlias

from quell import checks
from quell.plants.linearise import linear_model
from quell.setup import loading
from quell.setup.schema import SetupError, read
from quell.tuning.tables import rest_of_plant

Place: TypeAlias = tuple[float, ...]
"""Values of the signals at an operating point."""

# Options of [tune] that a schedule has no use for, and what to do instead.
_SIMULATED = "is for a tuning by simulation, which has no schedule"
_RANGES = "is for plants with ranges, which are not tuned with a schedule"
_REFUSED = {
    "trials": _SIMULATED,
    "storage": _SIMULATED,
    "compare": "a schedule is that of an ADRC; compare structures for a single plant",
    "feedforward": "is not tuned with a schedule; add feedforward = true to [controller] of the "
    "tuned file, it follows the tables",
    "samples": _RANGES,
    "check_samples": _RANGES,
    "seed": _RANGES,
}


class ScheduleTask(NamedTuple):
    """Arguments of ``quell.tune_schedule``."""

    plant: Any  # a function of the signals, or plants by point
    dt: float  # [s]
    options: dict[str, Any]  # all others
    setup: loading.Setup  # with the plant of the tuned file


def has_schedule(data: Mapping[str, Any]) -> bool:
    """Return whether the content of a setup file has operating points for a schedule."""
    table = data.get("tune")
    return isinstance(table, Mapping) and "schedule" in table


def schedule_task(
    path: str | os.PathLike[str],
    changes: Mapping[str, Any] | None = None,
    trust: bool = False,
    limits: Mapping[str, float] | None = None,
) -> ScheduleTask:
    """Read a setup file with ``[tune.schedule]`` for ``quell.tune_schedule``.

    ``changes`` are values of ``[tune]`` by name, ``limits`` are limits of u that replace those of
    the file's controller. The tuned file keeps ``[plant]`` if its scenario has the signals, too;
    else it has the plant of the middle point.

    Raises
    ------
    SetupError
        as ``quell.setup.load``; for options that a schedule has no use for, points that make no
        plant, a plant with ranges and a compensator.
    """
    name, data = read(path)
    asked = {**data["tune"], **(changes or {})}
    _check(name, data, asked)
    first = {"dt": data["dt"]} if "dt" in data else {}
    alone = loading.unchecked(name, first | {"controller": loading.NO_CONTROLLER, "tune": asked})
    given = (alone.tune or {})["schedule"]
    how: dict[str, Any] = dict(given["options"])
    at = _Points(name, data, given, asked["schedule"], trust)
    plants = {each: at.plant(*each) for each in at.grid}  # their errors come before the tuning
    middle = at.grid[len(at.grid) // 2]
    scenario, names = data.get("scenario"), how["signal"]
    external = "external" in ((names,) if isinstance(names, str) else names)
    has_signals = isinstance(scenario, Mapping) and (not external or "schedule" in scenario)
    table = data["plant"] if "plant" in data and has_signals else at.table(middle)
    whole = {key: value for key, value in data.items() if key not in loading.REPLACED}
    whole |= {"plant": table, "tune": asked}
    setup = loading.unchecked(name, {**whole, "controller": loading.NO_CONTROLLER}, trust)
    loading.check_windows(setup)
    options = loading.tuning_options(setup, data.get("controller"), setup.plant, limits or {})
    del options["schedule"]
    options |= how
    if "scenario" not in data:
        with suppress(ValueError):  # of a plant without operating point, which tune refuses
            options["rest"] = rest_of_plant(plants[middle], setup.controller.dt)
    options["setup"] = loading.tuned_tables(
        setup, {**whole, "tune": data["tune"]}, setup.plant, options
    )
    options["written"] = loading.written_loop(setup, options["setup"])
    if given["parameter"] is not None:
        options["points"] = at.axes if len(at.axes) > 1 else at.axes[0]
        return ScheduleTask(at.linear, setup.controller.dt, options, setup)
    del options["between"]
    known = {each: linear_model(plant) for each, plant in plants.items()}
    return ScheduleTask(known, setup.controller.dt, options, setup)


def _check(name: str, data: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise a ``SetupError`` for what is not tuned with a schedule."""
    mistakes = [f"tune.{key}: {rule}" for key, rule in _REFUSED.items() if key in asked]
    if "compensator" in data:
        mistakes.append("compensator: is not tuned with a schedule; leave [tune.schedule] out")
    controller = data.get("controller")
    if isinstance(controller, Mapping) and controller.get("feedforward"):
        mistakes.append(f"controller.feedforward: {_REFUSED['feedforward']}")
    if mistakes:
        raise SetupError([f"{name}: {each}" for each in mistakes])


class _Points:
    """The plants at the points of a file, and between them if they are values of a parameter."""

    def __init__(
        self, name: str, data: Mapping[str, Any], given: Any, written: Any, trust: bool
    ) -> None:
        self.name, self.data, self.trust = name, data, trust
        names = given["parameter"]
        self.parameters = () if names is None else (names,) if isinstance(names, str) else names
        self.changes: dict[Place, tuple[int, Mapping[str, Any]]] = {}
        self.axes: list[list[float]] = []
        if self.parameters:
            self._take_values(given["points"])
        else:
            self._take_tables(given["points"], written["points"])

    def _take_values(self, points: Any) -> None:
        lists = [points] if not checks.is_sequence(points[0]) else points
        if len(lists) != len(self.parameters) or not all(map(checks.is_sequence, lists)):
            rule = "must be a list of numbers for parameter, two lists for two parameters"
            raise SetupError([f"{self.name}: tune.schedule.points: {rule}"])
        if "plant" not in self.data:
            rule = "is a key of [plant], which is missing"
            raise SetupError([f"{self.name}: tune.schedule.parameter: {rule}"])
        self.axes = [[float(value) for value in each] for each in lists]
        self.grid: list[Place] = list(product(*self.axes))

    def _take_tables(self, points: Any, written: Any) -> None:
        for i, (point, own) in enumerate(zip(points, written, strict=True)):
            at = tuple(map(float, point.at)) if checks.is_sequence(point.at) else (float(point.at),)
            where = f"{self.name}: tune.schedule.points[{i}]"
            if at in self.changes:
                rule = "is the value of another point, too; each must have its own"
                raise SetupError([f"{where}.at = {point.at}: {rule}"])
            if "plant" not in self.data and "kind" not in own["plant"]:
                rule = "needs the kind of the plant, as the file has no [plant]"
                raise SetupError([f"{where}.plant: {rule}"])
            self.changes[at] = i, own["plant"]
        self.grid = sorted(self.changes)

    def table(self, at: Place) -> Mapping[str, Any]:
        """Return the table of the plant at a point."""
        if self.parameters:
            values = dict(zip(self.parameters, at, strict=True))
            return loading.changed(self.name, self.data, values)["plant"]
        return _merged(self.data.get("plant", {}), self.changes[at][1])

    def plant(self, *at: float) -> Any:
        """Return the plant at a point; the place of the point stands in front of its errors."""
        tables = {
            "dt": self.data.get("dt"),
            "plant": self.table(at),
            "controller": loading.NO_CONTROLLER,
        }
        place = ", ".join(f"{value:g}" for value in at)
        where = f"tune.schedule, at {place}"
        if at in self.changes:
            where = f"tune.schedule.points[{self.changes[at][0]}]"
        try:
            setup = loading.unchecked(self.name, tables, self.trust)
            if getattr(setup.description.plant, "uncertain", None) is not None:
                raise SetupError([f"plant.uncertain: {_RANGES}; b_range of [tune] is a range of b"])
        except SetupError as error:
            begin = f"{self.name}: "
            lines = [line.removeprefix(begin) for line in error.mistakes]
            raise SetupError([f"{begin}{where}: {line}" for line in lines]) from None
        return setup.plant

    def linear(self, *at: float) -> Any:
        """Return the linear model of the plant at a point."""
        return linear_model(self.plant(*at))


def _merged(base: Any, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table with other values; a table with a ``kind`` of its own takes its place."""
    if "kind" in changes:
        return dict(changes)
    found: dict[str, Any] = {"kind": base} if isinstance(base, str) else dict(base)
    for key, value in changes.items():
        inside = isinstance(value, Mapping) and isinstance(found.get(key), Mapping)
        found[key] = _merged(found[key], value) if inside else value
    return found
