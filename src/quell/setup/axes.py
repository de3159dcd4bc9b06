"""Setups of several axes: a table ``[[axis]]`` for each, ``[axes]`` for B0 and the actuators.

The keys of an axis are the tables that a setup of one axis has: its observer, of b0 = 1, its
controller, learner and guard; and what it has to follow. The limits of the actuators are in
``[axes]``, as no axis has one of its own.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial, wraps
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, ValidationError

from quell import checks
from quell.controllers.adrc import ADRC
from quell.controllers.axes import Axes
from quell.controllers.compensator import Compensator
from quell.controllers.prefilters import Prefiltered
from quell.controllers.shaped_references import without_prefilter
from quell.features.all_axes import sees_all_axes
from quell.plants.base import PlantWrapper
from quell.plants.linear import LinearPlant
from quell.plants.multibody import Arm, Craft
from quell.plants.nonlinear import NonlinearPlant
from quell.quantities import AxesSignals
from quell.records.trajectory import Trajectory
from quell.setup import loading, registry, schema
from quell.setup.description import DT, TITLE, Title, optional
from quell.simulation.scenario import Scenario
from quell.types import Matrix

if TYPE_CHECKING:  # these types are made at run time, which a type checker cannot follow
    from quell.setup.schema import CallTable as AxesPlant
    from quell.setup.schema import CallTable as AxesTable
    from quell.setup.schema import CallTable as AxisDrive
    from quell.setup.schema import CallTable as Controller
    from quell.setup.schema import CallTable as Guard
    from quell.setup.schema import CallTable as Learner
    from quell.setup.schema import CallTable as Metrics
    from quell.setup.schema import CallTable as Observer
    from quell.setup.schema import CallTable as OnTop
    from quell.setup.schema import CallTable as Prefilter
    from quell.setup.schema import CallTable as Rig
    from quell.setup.schema import CallTable as ScenarioTable
    from quell.setup.schema import CallTable as Sweep
    from quell.setup.schema import CallTable as Tune

# ---- B0 and the actuators ----


def coupled(
    axes: Mapping[str, Compensator],
    plant: Any = None,
    drives: Sequence[Any] | None = None,
    B0: Sequence[Sequence[float]] | str | None = None,
    M: Sequence[Sequence[float]] | None = None,
    u_min: float | Sequence[float] = -math.inf,
    u_max: float | Sequence[float] = math.inf,
    rate_limit: float | Sequence[float] | Sequence[Sequence[float]] = math.inf,
    saturation: str | Sequence[str] = "each",
    weights: Sequence[float] | None = None,
    wished: Sequence[float] | None = None,
    learner: Any = None,
    guard: Any = None,
    of_axes: Mapping[str, tuple[Any, Any]] | None = None,
) -> Axes:
    """Return the controller of several axes: B0, or its inverse M, and limits of the actuators.

    Parameters
    ----------
    axes, plant, drives
        the controllers of the axes by name, the plant, and the controllers below compensators.
    of_axes
        learners with features of all axes, each with its guard, by the name of the axis.
    B0
        from the control signals to the axes, a list of rows, with a row for each axis; ``"plant"``
        takes that of the plant: of an arm the inverse of M(q), of a craft that near the horizontal,
        of a linear plant ``C_i A^(n_i − 1) B``. By default the unit matrix.
    M
        the inverse of B0 instead, a list of rows.
    u_min, u_max
        limits of the actuators [u-unit]: one for all, or a list with one for each.
    rate_limit
        largest rates of the actuators [u-unit/s]: one for all, or a list with one for each, or with
        `[lowest, highest]` for each.
    saturation
        what happens at the limits: `each` cuts each actuator, `direction` scales all, and a list of
        all axes is their order of priority.
    weights
        of the actuators, where there are more than axes or an axis has a safe set.
    wished
        the control signals from which that is measured [u-unit]; zero by default.
    learner, guard
        one learner for all axes, and its guard, of which each axis has its own.
    """
    of_axes = of_axes or {}
    if of_axes and learner is not None:
        raise ValueError(
            f"learner: {', '.join(of_axes)} have learners with features of all axes, too; give "
            "one for all, or one for each"
        )
    if of_axes:
        learner = {name: parts[0] for name, parts in of_axes.items()}
        guard = {name: parts[1] for name, parts in of_axes.items() if parts[1] is not None}
    inverse: Any = M
    gain: Any = B0
    if isinstance(B0, str):
        checks.one_of("B0", B0, ("plant",))
        if plant is None:
            raise ValueError('B0 = "plant": there is no plant; give rows, or a table [plant]')
        gain, inverse = _of_plant(
            plant, [without_prefilter(axis)[0].observer.order for axis in axes.values()], M
        )
    limits: dict[str, Any] = {"u_min": u_min, "u_max": u_max, "rate_limit": rate_limit}
    rest: dict[str, Any] = {"saturation": saturation, "weights": weights, "wished": wished}
    rest |= {"learner": learner, "guard": guard, "drives": drives}
    return Axes(dict(axes), gain, M=inverse, **limits, **rest)


def _of_plant(plant: Any, orders: Sequence[int], M: Any) -> tuple[Any, Any]:
    """Return B0 and M of a plant; one of them is None."""
    if M is not None:
        raise ValueError('B0 = "plant" and M: are two of the same; give one')
    inner = _inner(plant)
    if isinstance(inner, Arm):
        return None, inner.inertia
    if isinstance(inner, Craft):
        return inner.B0, None
    if isinstance(inner, LinearPlant):
        return _markov(inner, orders), None
    raise ValueError(
        f'B0 = "plant": is not known of {plant.name!r}; give its rows, or M, or find it in a '
        "record with quell b0"
    )


def _markov(plant: LinearPlant, orders: Sequence[int]) -> Matrix:
    """Return ``C_i A^(n_i − 1) B`` of a linear plant."""
    if len(orders) != plant.outputs:
        raise ValueError(
            f'B0 = "plant": the plant has {plant.outputs} outputs, there are {len(orders)} axes: '
            "must be as many"
        )
    rows = [
        plant.C[i] @ np.linalg.matrix_power(plant.A, order - 1) @ plant.B
        for i, order in enumerate(orders)
    ]
    return np.array(rows)


# ---- Tuning ----


def axes_task(
    path: str | os.PathLike[str], changes: Mapping[str, Any] | None = None, trust: bool = False
) -> tuple[loading.Setup, dict[str, Any]]:
    """Read a setup file of several axes; return it and further arguments of ``tune``.

    ``changes`` are values of ``[tune]`` by name. Raises ``SetupError`` as ``load``, and for a
    file without plant.
    """
    name, data = schema.read(path)
    tables = dict(data)
    if changes:
        tables["tune"] = {**data.get("tune", {}), **changes}
    setup = assembled_axes(name, tables, trust)
    loading.check_windows(setup)
    plant = setup.needed("plant")
    options = dict(setup.tune or {})
    if options.get("operating_points") is None and isinstance(_inner(plant), NonlinearPlant):
        x0 = None if setup.scenario is None else setup.scenario.x0
        order = getattr(_inner(plant), "order", 0)
        options["operating_points"] = [np.zeros(order) if x0 is None else np.asarray(x0)[:order]]
    return setup, options | {"setup": dict(data)}


def _inner(plant: Any) -> Any:
    while isinstance(plant, PlantWrapper):
        plant = plant.plant
    return plant


# ---- The tables ----


def _with_unit_gain(make: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that makes an observer with b0 = 1, whose input is v = B0 u."""
    given = inspect.signature(make, eval_str=False)
    if "b0" not in given.parameters:
        return make

    @wraps(make)
    def made(**parameters: Any) -> Any:
        return make(b0=1.0, **parameters)

    kept = [each for name, each in given.parameters.items() if name != "b0"]
    made.__signature__ = given.replace(parameters=kept)  # type: ignore[attr-defined]
    return made


OBSERVERS = {
    kind: schema.call_table(
        kind,
        _with_unit_gain(table.function),
        types={"plant": schema.Plant | None},
        descriptions={"plant": "model of the axis, of b0 = 1.", "E": "how f enters; as u."},
    )
    for kind, table in registry.OBSERVERS.items()
}
_OF_ACTUATORS = ("u_min", "u_max", "rate_limit", "schedule")
CONTROLLER = schema.call_table("adrc", ADRC, only=True, types=registry.LAW, without=_OF_ACTUATORS)
ON_TOP = schema.call_table(
    "compensator", Compensator, only=True, types=registry.PARTS, without=_OF_ACTUATORS
)
# Controllers without observer, that are not designed for the linear part of a plant.
_DRIVES = ("pid", "pid-simc", "notch-pid", "p-pi", "resonance-ratio")
DRIVES = {kind: registry.CONTROLLERS[kind] for kind in _DRIVES}
_ACTUATORS = "names and units of the control signals, `torque [N m]`, for files."
AXES = schema.call_table(
    "axes",
    coupled,
    only=True,
    without=("axes", "plant", "drives", "of_axes"),
    beside={
        "actuators": (schema.list_of(str), Field((), description=_ACTUATORS)),
        "learner": (
            registry.Learner | None,
            optional(
                "one learner for all axes, `rls` or `nlms`, with features of kind `all-axes`; one "
                "that learns from its own axis belongs into its `[[axis]]`."
            ),
        ),
        "guard": (
            registry.Guard | None,
            optional("the guard of this learner, of which each axis has its own."),
        ),
    },
)
SCENARIO = schema.call_table(
    "scenario",
    Scenario,
    only=True,
    types={"disturbances": schema.list_of(registry.Signal)},
    without=("reference", "noise", "schedule"),
)
METRICS = schema.call_table("metrics", Trajectory.metrics, only=True, without=("target",))
if not TYPE_CHECKING:
    AxesPlant, Guard = schema.one_of(registry.AXES_PLANTS), registry.Guard
    Prefilter = registry.Prefilter
    Observer, Learner = schema.one_of(OBSERVERS), registry.Learner
    AxisDrive, OnTop = schema.one_of(DRIVES, default="pid"), ON_TOP
    AxesTable, Controller, ScenarioTable, Metrics = AXES, CONTROLLER, SCENARIO, METRICS
    Rig, Sweep, Tune = registry.AxesRig, registry.Sweep, registry.AxesTune


class Axis(schema.Table):
    """A table ``[[axis]]``."""

    name: str = Field("", description="its name; axis1 and so on by default.")
    observer: Observer = Field(description="the observer; its b0 is 1.")
    controller: Controller | None = optional("the ADRC, without limits of u.")
    compensator: OnTop | None = optional("a compensator in place of the ADRC; then of all axes.")
    drive: AxisDrive | None = optional("the controller that gives u_0 below a compensator.")
    learner: Learner | None = optional("the learner; none by default.")
    guard: Guard | None = optional("the guard of the learner; none by default.")
    prefilter: Prefilter | None = optional("the prefilter of the reference; none by default.")
    signal: str = Field("", description="name and unit of its y, `angle [rad]`, for files.")
    reference: registry.Signal = Field(0.0, description="signal that y has to follow [y-unit].")
    noise: registry.Signal = Field(0.0, description="signal added to y before the controller.")


class AxesDescription(schema.Table):
    """The tables and keys of a setup of several axes."""

    title: Title = TITLE
    dt: float = DT
    plant: AxesPlant | None = optional("the plant with several signals, for `quell run`.")
    axes: AxesTable | None = optional("B0 and the actuators; the unit matrix by default.")
    axis: tuple[Axis, ...] = Field(
        description="[[axis]]: an axis, in the order of the outputs.",
        json_schema_extra={"minItems": 1},
    )
    scenario: ScenarioTable | None = optional("duration, disturbances and start.")
    tune: Tune | None = optional("what `quell tune` bounds.")
    sweep: Sweep | None = optional("many runs with other values, for `quell sweep`.")
    rig: Rig | None = optional("the device and its safety limits, for `quell run-rig`.")
    metrics: tuple[Metrics, ...] = Field(
        (), description="[[metrics]]: windows of time in which all axes are judged."
    )


# ---- From a file to objects ----

# Tables of a setup of one axis, and where they are here.
_ELSEWHERE = dict.fromkeys(loading.REPLACED, "belongs into each [[axis]]")


def assembled_axes(
    name: str, data: Mapping[str, Any], trust: bool = False, known: loading.Known | None = None
) -> loading.Setup:
    """Build the objects that ``data`` describes: the content of a file of several axes.

    ``known`` has the plant of an earlier call, which is not built again if its table is the same.

    Raises
    ------
    SetupError
        as ``load``.
    """
    mistakes = [f"{name}: {key}: {rule}" for key, rule in _ELSEWHERE.items() if key in data]
    if mistakes:
        raise schema.SetupError(mistakes)
    values = schema.immutable(data)
    try:
        tables = AxesDescription.model_validate(values)
    except ValidationError as error:
        raise _explained(schema.from_validation(name, error, values)) from None
    if not tables.axis:
        raise schema.SetupError([f"{name}: axis: is empty; give a table [[axis]] for each axis"])
    builder = schema.Builder(name, trust)
    dt = builder.attempt("", (), checks.positive, "dt", tables.dt, "s")
    plant = None
    if tables.plant is not None:
        make = partial(builder.build, tables.plant, "plant", dt=dt)
        plant = loading.made_once({} if known is None else known, "plant", (tables.plant, dt), make)
    names = [axis.name or f"axis{i + 1}" for i, axis in enumerate(tables.axis)]
    if len(set(names)) < len(names):
        raise schema.SetupError([f"{name}: axis: names {', '.join(names)} must be different"])
    made = {
        key: _axis(builder, axis, f"axis[{i}]", dt)
        for i, (key, axis) in enumerate(zip(names, tables.axis, strict=True))
    }
    drives = [
        builder.build(axis.drive, f"axis[{i}].drive", dt=dt)
        for i, axis in enumerate(tables.axis)
        if axis.drive is not None
    ]
    table: Any = AXES() if tables.axes is None else tables.axes
    of_axes = {key: parts for key, (_, *parts) in made.items() if parts}
    axes = {key: parts[0] for key, parts in made.items()}
    shared = {
        key: None if part is None else builder.build(part, f"axes.{key}", dt=dt)
        for key, part in (("learner", table.learner), ("guard", table.guard))
    }
    context = {"axes": axes, "plant": plant, "drives": drives or None, "of_axes": of_axes}
    controller = builder.build(table, "axes", **context, **shared)
    scenario = _scenario(builder, tables, dt)
    if plant is not None:
        builder.attempt("plant", (), _check_fit, plant, controller, scenario)
    windows = loading.windows_of(builder, tables.metrics)
    title = tables.title or loading.title_of(name)
    tune = None if tables.tune is None else builder.build(tables.tune, "tune")
    sweep = None if tables.sweep is None else builder.build(tables.sweep, "sweep")
    rig = None if tables.rig is None else builder.build(tables.rig, "rig", dt=dt)
    signals = builder.attempt("", (), signals_in, tables, controller)
    if rig is not None and signals.known:
        rig = {"signals": signals, **rig}
    parts = (controller, plant, scenario, rig, sweep, windows)
    return loading.Setup(name, title, *parts, tables, tune, trust)


def signals_in(tables: AxesDescription, axes: Any) -> AxesSignals:
    """Return names and units of the signals of a setup of several axes.

    Raises ``ValueError`` for a text that is no name and unit, and another number of actuators than
    there are.
    """
    given: Any = tables.axes
    actuators = [] if given is None else list(given.actuators)
    if actuators and len(actuators) != axes.inputs:
        rule = f"there are {axes.inputs}; give one for each"
        raise ValueError(f"axes.actuators = {actuators!r:.60}: {rule}")
    return AxesSignals.of(
        axes.names, [axis.signal for axis in tables.axis], actuators or [""] * axes.inputs
    )


def _axis(builder: schema.Builder, axis: Axis, path: str, dt: float) -> tuple[Any, ...]:
    """Return the controller of an axis; with its learner and guard if they are of all axes."""
    if (axis.controller is None) == (axis.compensator is None):
        has = "neither" if axis.controller is None else "both"
        rule = f"has {has}; give a controller, which is an ADRC, or a compensator"
        raise schema.SetupError([f"{builder.name}: {path}: {rule}"])
    parts = {
        key: None if table is None else builder.build(table, f"{path}.{key}", dt=dt)
        for key, table in (("observer", axis.observer), ("guard", axis.guard))
    }
    learner = None
    if axis.learner is not None:
        learner = builder.build(axis.learner, f"{path}.learner", dt=dt, **parts)
    outside: tuple[Any, ...] = ()
    if sees_all_axes(learner):
        outside, learner = (learner, parts.pop("guard")), None
    key = "controller" if axis.compensator is None else "compensator"
    table: Any = getattr(axis, key)
    made: Any = builder.build(table, f"{path}.{key}", learner=learner, **parts)
    if axis.prefilter is not None:
        prefilter = builder.build(axis.prefilter, f"{path}.prefilter", dt=dt)
        made = builder.attempt(f"{path}.prefilter", (), Prefiltered, made, prefilter)
    return made, *outside


def _scenario(builder: schema.Builder, tables: AxesDescription, dt: float) -> Scenario | None:
    """Return the scenario, with the references and noises of the axes; None without one."""
    if tables.scenario is None:
        return None
    made: Scenario = builder.build(tables.scenario, "scenario", dt=dt)
    signals: dict[str, Any] = {
        key: tuple(
            builder.value(getattr(axis, key), f"axis[{i}].{key}", True, {"dt": dt})
            for i, axis in enumerate(tables.axis)
        )
        for key in ("reference", "noise")
    }
    return builder.attempt("axis", (), partial(replace, made, **signals))


def _check_fit(plant: Any, controller: Axes, scenario: Scenario | None) -> None:
    """Check that plant, controller and scenario have the same signals."""
    from quell.simulation.scenario import SampledScenario, check_fit

    check_fit(plant, controller)
    if scenario is not None:
        SampledScenario.of(scenario, plant, controller, None)


def _explained(error: schema.SetupError) -> schema.SetupError:
    """Return the errors, with the rule of keys that axes do not have."""
    rules = {
        ".observer.b0: unknown": "is 1 for an axis; the gain of the actuators is B0 in [axes]",
        "scenario.reference: unknown": "belongs into each [[axis]]",
        "scenario.noise: unknown": "belongs into each [[axis]]",
    }
    for key in ("u_min", "u_max", "rate_limit"):
        for table in ("controller", "compensator"):
            rules[f".{table}.{key}: unknown"] = "belongs into [axes]: an actuator moves all axes"
    lines = []
    for line in error.mistakes:
        for begin, rule in rules.items():
            if begin in line:
                line = f"{line.partition(': unknown')[0]}: {rule}"
                break
        lines.append(line)
    return schema.SetupError(lines)
