"""Which kinds there are of each table, and what each of them calls."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any

from quell import features, guard, learners, signals
from quell.controllers import ADRC, LinearController, ReferenceModel, TrackingDifferentiator
from quell.controllers.baselines import LQG, PID, ZV, ZVD, NotchPID, ResonanceRatio, Shaper, notch
from quell.observers import ESO
from quell.plants import registry as plants
from quell.realtime.loop import safety
from quell.realtime.loop.run import run_rig
from quell.records.trajectory import Trajectory
from quell.setup.schema import Call, call, list_of, one_of
from quell.simulation.scenario import Scenario as SimulationScenario


def rig(device: str, live: int | None = None, **options: Any) -> dict[str, Any]:
    """Return what ``quell run-rig`` closes a loop around, and how.

    Parameters
    ----------
    device
        URL of the device: ``udp://127.0.0.1:5005``, ``serial:///dev/ttyACM0``, ``ni://``, ``twin:torsional``, …
    live
        port at which Foxglove and PlotJuggler can watch, 8765 for instance; none by default.
    telemetry
        files that the record is written to, ending in ``.mcap`` or ``.csv``; from the folder where the command is run.
    """
    return {"device": device, "live": live, **options}


def _calls(
    made: Mapping[str, Callable[..., Any]],
    types: Mapping[str, Any] | None = None,
    words: Mapping[str, str] | None = None,
) -> dict[str, type[Call]]:
    return {kind: call(kind, make, types=types, words=words) for kind, make in made.items()}


def _discovered(room: Any, *methods: str, but: type | None = None) -> dict[str, Callable[..., Any]]:
    """Return the public classes of a room that numbers suffice for: those whose parameters all have defaults."""
    found: dict[str, Callable[..., Any]] = {}
    for name in room.__all__:
        cls = getattr(room, name)
        if (
            not isinstance(cls, type)
            or cls is but
            or not all(hasattr(cls, method) for method in methods)
        ):
            continue
        if all(
            parameter.default is not parameter.empty
            for parameter in inspect.signature(cls).parameters.values()
        ):
            kind = re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower()  # gaussian-process, nlms
            found[kind] = cls
    return found


def _in_time(cls: type[signals.Signal]) -> Callable[..., signals.Signal]:
    """Return what makes a signal of this class, with another one in its place from some time on."""

    def make(
        until: float | None = None, then: signals.Signal | float | None = None, **parameters: Any
    ) -> signals.Signal:
        signal = cls(**parameters)
        if until is None and then is None:
            return signal
        if until is None or then is None:
            raise ValueError(
                "only one of until and then: must be both, the time [s] and the signal or number that holds from it on"
            )
        return signal.until(until, then)

    own, more = inspect.signature(cls, eval_str=True), inspect.signature(make, eval_str=True)
    added = [
        more.parameters[key].replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for key in ("until", "then")
    ]
    make.__signature__ = own.replace(parameters=[*own.parameters.values(), *added])  # type: ignore[attr-defined]
    make.__doc__ = cls.__doc__
    return make


# A plant may be in a plant, and a signal in a signal: their types are known by name until all of their tables are there.
PLANTS = _calls(plants.PLANTS, {"plant": "Plant"})
_IN_TIME = {
    "until": "the end of it [s], where `then` takes over.",
    "then": "the signal, or number, from `until` on.",
}
SIGNALS = {
    kind: call(kind, _in_time(cls), types={"then": "Signal | None"}, words=_IN_TIME)
    for kind, cls in signals.KINDS.items()
}
Plant: Any = one_of(PLANTS)
Signal: Any = one_of(SIGNALS, number=True, several=one_of(SIGNALS, number=True))
for _model in (*PLANTS.values(), *SIGNALS.values()):
    _model.model_rebuild(_types_namespace={"Plant": Plant, "Signal": Signal})

# A controller's or observer's own model of the plant.
_MODEL = {
    "plant": "a model of the plant; by default what [plant] has, less what is not linear in it.",
    "E": "how f enters; as u by default.",
}
OBSERVERS = _calls(
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
FEATURES = _calls(_discovered(features, "design", "names", but=features.Features))
LEARNERS = _calls(
    _discovered(learners, "design", "memory"), {"features": list_of(one_of(FEATURES)) | None}
)
Notch = call("notch", notch.Notch.at, sole=True)
CONTROLLERS = {
    "adrc": call("adrc", ADRC),
    "pid": call("pid", PID, passed_on=(LinearController,)),
    "pid-simc": call("pid-simc", PID.simc, passed_on=(PID, LinearController)),
    "pid-simc-double-integrator": call(
        "pid-simc-double-integrator", PID.simc_double_integrator, passed_on=(PID, LinearController)
    ),
    "notch-pid": call(
        "notch-pid", NotchPID, passed_on=(PID, LinearController), types={"notch": Notch}
    ),
    "lqg": call(
        "lqg", LQG, passed_on=(LinearController,), types={"plant": Plant | None}, words=_MODEL
    ),
    "resonance-ratio": call("resonance-ratio", ResonanceRatio, passed_on=(LinearController,)),
}
PREFILTERS = _calls(
    {
        "reference-model": ReferenceModel,
        "tracking-differentiator": TrackingDifferentiator,
        "zv": ZV,
        "zvd": ZVD,
        "shaper": Shaper,
    }
)
Observer, Learner, Prefilter = one_of(OBSERVERS), one_of(LEARNERS), one_of(PREFILTERS)
Controller = one_of(CONTROLLERS, default="adrc")
Guard = call("guard", guard.Guard, sole=True)
Scenario = call(
    "scenario",
    SimulationScenario,
    sole=True,
    types={"reference": Signal, "noise": Signal, "disturbances": list_of(Signal)},
)
Metrics = call("metrics", Trajectory.metrics, sole=True)
Safety = call("safety", safety.Safety, sole=True)
Rig = call(
    "rig",
    rig,
    sole=True,
    passed_on=(run_rig,),
    types={"safety": Safety | None, "telemetry": list_of(str)},
    without=("duration", "on_change"),
)
