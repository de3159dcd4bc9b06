"""quell: disturbance-rejection control that learns.

Public names are imported when they are first used, so that ``import quell`` is fast::

    import quell as ql

    plant      = ql.plants.two_mass_spring()
    observer   = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-3)
    controller = ql.ADRC(observer, omega_c=1.0, learner=ql.learners.Kalman())
    scenario   = ql.Scenario(reference=ql.signals.Step(), duration=60.0)
    run        = ql.simulate(plant, controller, scenario)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quell import (
        analysis,
        controllers,
        envs,
        experiments,
        export,
        features,
        identification,
        learners,
        observers,
        plants,
        realtime,
        setup,
        signals,
        sweeping,
        tuning,
    )
    from quell.controllers import baselines
    from quell.controllers.adrc import ADRC, Estimate
    from quell.controllers.base import omega_c_for
    from quell.controllers.feedforward import Feedforward
    from quell.guard import Guard, Reason
    from quell.identification.identify import identify
    from quell.lti.canonical import canonical
    from quell.observers.eso import ESO
    from quell.records import metrics
    from quell.records.plotting import style
    from quell.records.trajectory import BatchTrajectory, Trajectory
    from quell.simulation.driver import Scenario
    from quell.simulation.simulate import simulate
    from quell.sweeping.sweep import sweep
    from quell.tuning.tune import tune
    from quell.tuning.tuned import Tuned
    from quell.types import DesignWarning, Status

__version__ = "0.2.0"

# Modules of the public classes and functions, and of modules that are deeper than ``quell.<name>``.
_HOME = {
    "ADRC": "quell.controllers.adrc",
    "DesignWarning": "quell.types",
    "BatchTrajectory": "quell.records.trajectory",
    "ESO": "quell.observers.eso",
    "Estimate": "quell.controllers.adrc",
    "Feedforward": "quell.controllers.feedforward",
    "Guard": "quell.guard",
    "Reason": "quell.guard",
    "Scenario": "quell.simulation.driver",
    "Status": "quell.types",
    "Trajectory": "quell.records.trajectory",
    "Tuned": "quell.tuning.tuned",
    "canonical": "quell.lti.canonical",
    "identify": "quell.identification.identify",
    "omega_c_for": "quell.controllers.base",
    "simulate": "quell.simulation.simulate",
    "style": "quell.records.plotting",
    "sweep": "quell.sweeping.sweep",
    "tune": "quell.tuning.tune",
}
_MODULES = {"baselines": "quell.controllers.baselines", "metrics": "quell.records.metrics"}

__all__ = [
    "ADRC", "ESO", "BatchTrajectory", "DesignWarning", "Estimate", "Feedforward", "Guard",
    "Reason", "Scenario", "Status", "Trajectory", "Tuned", "analysis", "baselines", "canonical",
    "controllers", "envs", "experiments", "export", "features", "identification", "identify",
    "learners", "metrics", "observers", "omega_c_for", "plants", "realtime", "setup", "signals",
    "simulate", "style", "sweep", "sweeping", "tune", "tuning",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'quell' has no attribute {name!r}")
    if name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
    else:
        value = importlib.import_module(_MODULES.get(name, f"quell.{name}"))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
