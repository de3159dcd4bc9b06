"""The kinds of each table, and the function that each kind calls."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

from pydantic import Field

from quell import features, guard, learners, signals
from quell.controllers import (
    ADRC,
    Compensator,
    Feedforward,
    HeldPlant,
    LinearController,
    NonlinearFeedback,
    OnlineGain,
    ProfileGenerator,
    ReferenceModel,
    SafeSet,
    Schedule,
    TrackingDifferentiator,
    adrc_for_dead_time,
    equal_to_pid,
)
from quell.controllers.baselines import (
    EI,
    LQG,
    MZV,
    PID,
    PPI,
    ZV,
    ZVD,
    AdaptiveNotch,
    NotchPID,
    ResonanceRatio,
    Shaper,
    pid,
)
from quell.observers import ESO
from quell.quantities import Signals
from quell.realtime.run import run_rig
from quell.realtime.safety import Safety as RigSafety
from quell.records.trajectory import Trajectory
from quell.setup.schema import AXES_PLANTS as AXES_PLANTS
from quell.setup.schema import PLANTS as PLANTS
from quell.setup.schema import CallTable, Plant, Table, call_table, list_of, one_of
from quell.simulation.scenario import Scenario as SimulationScenario
from quell.sweeping.runs import Normal, Range
from quell.tuning.axes import BOUNDS_TOGETHER, OBJECTIVES
from quell.tuning.constraints import Constraints
from quell.tuning.tune import ONLY_TOGETHER, tune


class Point(Table):
    """An operating point of ``[[tune.schedule.points]]``."""

    at: float | tuple[float, float] = Field(description="value of the signal, or of two signals.")
    plant: dict[str, Any] = Field(
        description="keys of `[plant]` with their values there; with `kind` a plant of its own."
    )


CASE = "case"
"""Name of the parameter that is the case."""


def sweep_table(
    parameters: Mapping[str, Any] | None = None,
    cases: Mapping[str, Mapping[str, Any]] | None = None,
    draws: int = 1,
    sampling: str = "latin-hypercube",
    seed: int = 0,
    metrics: Sequence[str] = ("peak_error", "iae", "control_variation"),
    limits: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Return the arguments of ``quell.sweep`` that a table gives.

    Parameters
    ----------
    parameters
        values by path, such as `"plant.m1"`: `{low = 0.6, high = 1.4}` is drawn, uniformly or with
        `log = true` on a logarithmic scale; with `steps = 5` it is a list of as many values.
        `{mean = 1.0, std = 0.1}` is drawn from a normal distribution. A list has all values, also
        texts and tables.
    cases
        tables of values by path, by the name of the case; all are combined with all else:
        `pid = {controller = {kind = "pid", kp = 2.0}, observer = "none"}`.
    draws
        number of draws; each is combined with all values of all lists.
    sampling
        how ranges are drawn: `latin-hypercube` or `random`.
    seed
        seed of draws and noise.
    metrics
        measures that are stored, in each window of `[[metrics]]`.
    limits
        largest value of some measures; a run with more fails.
    """
    given = _flat(parameters or {})
    if cases is not None:
        if not isinstance(cases, Mapping) or not all(
            isinstance(c, Mapping) for c in cases.values()
        ):
            raise ValueError("cases: must be tables of values by path, by name of the case")
        if not cases:
            raise ValueError("cases is empty: must have at least one case")
        given[CASE] = tuple(cases)
    if not given and draws == 1:
        raise ValueError("parameters: missing; give a value to vary, a case, or several draws")
    options: dict[str, Any] = {"draws": draws, "sampling": sampling, "seed": seed}
    return {
        "parameters": given,
        "cases": cases or {},
        "metrics": metrics,
        "limits": limits or {},
    } | options


def _flat(given: Any, path: str = "") -> dict[str, Any]:
    """Return values by path: ``{"plant": {"m1": …}}`` and ``{"plant.m1": …}`` are the same."""
    if not isinstance(given, Mapping):
        raise ValueError(f"parameters = {given!r:.60}: must be a table of values by path")
    found: dict[str, Any] = {}
    for key, value in given.items():
        where = f"{path}.{key}" if path else str(key)
        kind = next((each for each, needed in _KINDS.items() if _is_of(value, needed)), None)
        if kind is not None:
            try:
                found[where] = kind(**value)
            except (ValueError, TypeError) as error:
                raise ValueError(f"parameters.{where}: {error}") from None
        elif isinstance(value, Mapping):
            found |= _flat(value, where)
        else:
            found[where] = value
    return found


# The keys that tell a distribution from a table of the setup.
_KINDS: Mapping[Any, set[str]] = {Range: {"low", "high"}, Normal: {"mean", "std"}}


def _is_of(value: Any, needed: set[str]) -> bool:
    return isinstance(value, Mapping) and bool(needed & value.keys())


def rig(device: str, live: int | None = None, **options: Any) -> dict[str, Any]:
    """Return the arguments of ``quell run-rig``.

    Parameters
    ----------
    device
        URL of the device: ``udp://127.0.0.1:5005``, ``serial:///dev/ttyACM0``, ``ni://``,
        ``twin:torsional``, ``twin:model.json``, … or ``twin:`` for the plant of this file.
    live
        port at which Foxglove and PlotJuggler can watch, 8765 for instance; none by default.
    telemetry
        files for the record, ending in ``.mcap`` or ``.csv``; relative to the folder where the
        command is run.
    memory
        file in which what the controller learns outlives the run; relative to that folder, too.
    """
    return {"device": device, "live": live, **options}


def points_table(
    points: Sequence[Any],
    parameter: str | Sequence[str] | None = None,
    signal: str | Sequence[str] = "external",
    tables: str = "b0",
    between: int = 1,
) -> dict[str, Any]:
    """Return the arguments of ``quell.tune_schedule`` that a table gives.

    Parameters
    ----------
    points
        operating points, as tables ``[[tune.schedule.points]]`` with the value ``at`` of the
        signal, a pair of two signals, and what is different there in ``plant``; or with
        ``parameter`` numbers, a pair of lists for two signals.
    parameter
        key of ``[plant]`` that the signal is the value of, as ``"plant.m1"``, a pair for two
        signals: the plant is then known between the points, too.
    signal
        what the schedule follows: `reference`, `y`, `speed` or `external`; a pair for two signals.
    tables
        `b0`: a table of b0; `all`: of the bandwidths, too.
    between
        values in each cell at which the result is judged, too; with ``parameter``.
    """
    if not points:
        raise ValueError("points is empty: give two operating points or more")
    described = [isinstance(each, Table) for each in points]
    if any(described) != (parameter is None) or any(described) != all(described):
        raise ValueError(
            "points: must be tables with at and plant, or numbers with parameter, the key of "
            "[plant] that they are values of"
        )
    if parameter is None and between != 1:
        raise ValueError(
            f"between = {between!r}: of points that are tables the plant between them is not "
            "known; leave it out, or give parameter"
        )
    for name in (parameter,) if isinstance(parameter, str) else parameter or ():
        if not name.startswith("plant."):
            raise ValueError(f"parameter = {name!r}: must be a key of [plant], as 'plant.m1'")
    return {"points": points, "parameter": parameter} | {
        "options": {"signal": signal, "tables": tables, "between": between}
    }


def tuning(
    trials: int | None = None,
    storage: str | None = None,
    schedule: Mapping[str, Any] | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Return the arguments of ``quell.tune`` for ``quell tune``.

    Parameters
    ----------
    trials
        candidates of a tuning by simulation in ``[scenario]``, with all that is not linear in the
        plant; ``objective`` is then the name of a metric, ``"iae"`` by default.
    storage
        Optuna's journal file for these candidates, from which an interrupted tuning continues;
        a tuning needs ``trials`` then, here or as ``--trials``.
    schedule
        operating points, for a controller whose gains follow a signal.
    """
    if schedule is not None:
        options["schedule"] = schedule
    if trials is not None:
        options = {"objective": "iae", **options, "search": {"trials": trials}}
        if storage is not None:
            options["search"]["storage"] = storage
    bounds = {name: options.pop(name) for name in (*options,) if name in _BOUNDS}
    return {"constraints": Constraints(**bounds), **options}


def _call_tables(
    functions: Mapping[str, Callable[..., Any]],
    types: Mapping[str, Any] | None = None,
    descriptions: Mapping[str, str] | None = None,
) -> dict[str, type[CallTable]]:
    return {
        kind: call_table(kind, function, types=types, descriptions=descriptions)
        for kind, function in functions.items()
    }


def _public_classes(folder: Any, *methods: str, but: type | None = None) -> dict[str, Any]:
    """Return the public classes of a folder whose parameters all have defaults, by kind."""
    found = {}
    for name in folder.__all__:
        cls = getattr(folder, name)
        if not isinstance(cls, type) or cls is but or not all(map(partial(hasattr, cls), methods)):
            continue
        parameters = inspect.signature(cls).parameters.values()
        if all(parameter.default is not parameter.empty for parameter in parameters):
            kind = re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower()  # gaussian-process, nlms
            found[kind] = cls
    return found


def _switchable(cls: type[signals.Signal]) -> Callable[..., signals.Signal]:
    """Return a function that makes a signal of a class, which may switch to another one."""

    def make(
        until: float | None = None, then: signals.Signal | float | None = None, **parameters: Any
    ) -> signals.Signal:
        signal = cls(**parameters)
        if until is None and then is None:
            return signal
        if until is None or then is None:
            rule = "must be both, the time [s] and the signal or number that holds from it on"
            raise ValueError(f"only one of until and then: {rule}")
        return signal.until(until, then)

    own, more = inspect.signature(cls, eval_str=True), inspect.signature(make, eval_str=True)
    only, keys = inspect.Parameter.KEYWORD_ONLY, ("until", "then")
    added = [more.parameters[key].replace(kind=only) for key in keys]
    make.__signature__ = own.replace(parameters=[*own.parameters.values(), *added])  # type: ignore[attr-defined]
    make.__doc__ = cls.__doc__
    return make


_SWITCHING = {
    "until": "time at which `then` takes over [s].",
    "then": "signal or number from `until` on.",
}
_SWITCHABLE = {kind: _switchable(cls) for kind, cls in signals.KINDS.items()}
SIGNALS = _call_tables(
    _SWITCHABLE, {"then": "SignalTable | None", "cycle": "SignalTable"}, _SWITCHING
)
# A signal may contain a signal: its type is a name until all tables exist.
Signal: Any = one_of(SIGNALS, number=True, many=one_of(SIGNALS, number=True))
for _model in SIGNALS.values():
    _model.model_rebuild(_types_namespace={"SignalTable": Signal})

# A controller's or observer's own model of the plant.
_MODEL = {
    "plant": "model of the plant; by default the linear part of [plant].",
    "E": "how f enters; as u by default.",
}
OBSERVERS = _call_tables(
    {
        "model-free": ESO.model_free,
        "model-based": ESO.model_based,
        "kalman": ESO.kalman,
        "cascade": ESO.cascade,
        "nonlinear": ESO.nonlinear,
    },
    {"plant": Plant | None},
    _MODEL,
)
_OF_ONE_AXIS = _call_tables(_public_classes(features, "design", "names", but=features.Features))
_ALL_AXES = {"features": list_of(one_of(_OF_ONE_AXIS))}
FEATURES = _OF_ONE_AXIS | _call_tables({"all-axes": features.AllAxes}, _ALL_AXES)
LEARNERS = _call_tables(
    _public_classes(learners, "design", "memory"), {"features": list_of(one_of(FEATURES)) | None}
)
Notch = call_table("notch", pid.Notch.at, only=True)
Feedback = call_table("nonlinear-feedback", NonlinearFeedback, only=True)
_SERIES: Mapping[str, Callable[..., Any]] = {
    "model": Feedforward.of,
    "rigid": Feedforward.rigid,
    "series": Feedforward,
}
FEEDFORWARDS = _call_tables(_SERIES, {"plant": Plant | None}, _MODEL)
PARTS = {
    "safe_set": call_table("safe-set", SafeSet, only=True) | None,
    "held": call_table("held-plant", HeldPlant, only=True) | None,
}
_SCHEDULES = {"table": Schedule, "online-gain": OnlineGain}
PARTS["schedule"] = one_of(_call_tables(_SCHEDULES), default="table") | None
LAW = {"feedback": Feedback | None, "feedforward": one_of(FEEDFORWARDS, flag=True), **PARTS}
_DOUBLE_INTEGRATOR = "pid-simc-double-integrator"
_PLANT, _LINEAR, _PID = {"plant": Plant | None}, (LinearController,), (PID, LinearController)
_CONTROLLERS = (
    call_table("adrc", ADRC, types=LAW),
    call_table("adrc-dead-time", adrc_for_dead_time, forwards_to=(ADRC,), types=LAW),
    call_table(
        "adrc-pid",
        ADRC.from_pid,
        forwards_to=(equal_to_pid, ADRC),
        types=LAW,
        without=("half_gain", "feedback", "law_poles"),
    ),
    call_table("compensator", Compensator, types=PARTS),
    call_table("pid", PID, forwards_to=_LINEAR),
    call_table("pid-simc", PID.simc, forwards_to=_PID),
    call_table(_DOUBLE_INTEGRATOR, PID.simc_double_integrator, forwards_to=_PID),
    call_table("notch-pid", NotchPID, forwards_to=_PID, types={"notch": Notch}),
    call_table("p-pi", PPI, forwards_to=_LINEAR, types={"notches": list_of(Notch)}),
    call_table("lqg", LQG, forwards_to=_LINEAR, types=_PLANT, descriptions=_MODEL),
    call_table("adaptive-notch", AdaptiveNotch, types=_PLANT, descriptions=_MODEL),
    call_table("resonance-ratio", ResonanceRatio, forwards_to=_LINEAR),
)
CONTROLLERS = {table.kind_name: table for table in _CONTROLLERS}
_SHAPERS: dict[str, Callable[..., Any]] = {"zv": ZV, "zvd": ZVD, "mzv": MZV, "ei": EI}
PREFILTERS = _call_tables(
    {"reference-model": ReferenceModel, "tracking-differentiator": TrackingDifferentiator}
    | {"profile-generator": ProfileGenerator, "shaper": Shaper}
    | _SHAPERS
)
Observer, Learner, Prefilter = one_of(OBSERVERS), one_of(LEARNERS), one_of(PREFILTERS)
Controller = one_of(CONTROLLERS, default="adrc")
OnTop = call_table("compensator", Compensator, only=True, types=PARTS)
_CERTIFIED = {"certified_for": one_of(PLANTS, many=Plant) | None}
Guard = call_table("guard", guard.Guard, only=True, types=_CERTIFIED)
_SIGNALS = {"reference": Signal, "noise": Signal, "disturbances": list_of(Signal)}
_SIGNALS["schedule"] = list_of(Signal)
Scenario = call_table("scenario", SimulationScenario, only=True, types=_SIGNALS)
Metrics = call_table("metrics", Trajectory.metrics, only=True)
_Y_AND_U = {"y": str, "u": str}
Safety = call_table("safety", RigSafety, only=True)
_LABELS = {"w": list_of(str)} | _Y_AND_U
Labels = call_table("signals", Signals.of, only=True, types=_LABELS, without=("f",))
_RIG = {
    "safety": Safety | None,
    "telemetry": list_of(str),
    "signals": Labels | None,
    "memory": str | None,
}
_BOUNDS = tuple(inspect.signature(Constraints).parameters)
_NOT_IN_FILES = (
    *("constraints", "operating_point", "uncertain", "setup", "written", "progress"),
    *("scenario", "search", "controller", *ONLY_TOGETHER),
)
_OF_ALL = {*inspect.signature(tune).parameters, *_BOUNDS, "trials", "storage", "schedule"}
_OF_SEVERAL = {"objective", "check_samples", "seed", *ONLY_TOGETHER, *BOUNDS_TOGETHER}
Points = call_table(
    "schedule",
    points_table,
    only=True,
    types={"points": list_of(Point | float | tuple[float, ...])},
)
Tune = call_table(
    "tune",
    tuning,
    only=True,
    forwards_to=(tune, Constraints),
    types={
        "reference": Signal | None,
        "objective": str,
        "schedule": Points | None,
        "feedforward": one_of(FEEDFORWARDS, flag=True),
    },
    without=_NOT_IN_FILES,
)
AxesTune = call_table(
    "tune",
    tuning,
    only=True,
    forwards_to=(tune, Constraints),
    types={"objective": Literal[OBJECTIVES], "operating_points": Sequence[Sequence[float]] | None},
    without=tuple(_OF_ALL - _OF_SEVERAL),
)
_NO_KEYS = ("duration", "on_change", "overwrite")
Sweep = call_table("sweep", sweep_table, only=True)
Rig = call_table("rig", rig, only=True, forwards_to=(run_rig,), types=_RIG, without=_NO_KEYS)
_NOT_OF_AXES = (*_NO_KEYS, "signals")
AxesRig = call_table(
    "rig", rig, only=True, forwards_to=(run_rig,), types=_RIG, without=_NOT_OF_AXES
)
