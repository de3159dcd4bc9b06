"""quell: disturbance-rejection control that learns.

The public names; each is imported when it is first used, so that ``import quell`` is quick::

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
        experiments,
        features,
        identification,
        learners,
        metrics,
        observers,
        plants,
        realtime,
        setup,
        signals,
    )
    from quell.batch_record import BatchTrajectory
    from quell.controllers import baselines
    from quell.controllers.adrc import ADRC
    from quell.controllers.bandwidth import omega_c_for
    from quell.controllers.estimate import Estimate
    from quell.guard import Guard, Reason
    from quell.identification.fitting import identify
    from quell.observers.canonical import canonical
    from quell.observers.eso import ESO
    from quell.simulation import Scenario, simulate
    from quell.trajectory import Trajectory
    from quell.types import DesignWarning, Status

__version__ = "0.1.0"

_HOME = {
    "ADRC": "quell.controllers.adrc",
    "DesignWarning": "quell.types",
    "BatchTrajectory": "quell.batch_record",
    "ESO": "quell.observers.eso",
    "Estimate": "quell.controllers.estimate",
    "Guard": "quell.guard",
    "Reason": "quell.guard",
    "Scenario": "quell.simulation",
    "Status": "quell.types",
    "Trajectory": "quell.trajectory",
    "canonical": "quell.observers.canonical",
    "identify": "quell.identification.fitting",
    "omega_c_for": "quell.controllers.bandwidth",
    "simulate": "quell.simulation",
}
_ROOMS = (
    "analysis",
    "baselines",
    "controllers",
    "experiments",
    "features",
    "identification",
    "learners",
    "metrics",
    "observers",
    "plants",
    "realtime",
    "setup",
    "signals",
)

__all__ = [
    "ADRC",
    "ESO",
    "BatchTrajectory",
    "DesignWarning",
    "Estimate",
    "Guard",
    "Reason",
    "Scenario",
    "Status",
    "Trajectory",
    "analysis",
    "baselines",
    "canonical",
    "controllers",
    "experiments",
    "features",
    "identification",
    "identify",
    "learners",
    "metrics",
    "observers",
    "omega_c_for",
    "plants",
    "realtime",
    "setup",
    "signals",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
    elif name in _ROOMS:
        value = importlib.import_module("quell.controllers.baselines" if name == "baselines" else f"quell.{name}")
    else:
        raise AttributeError(f"module 'quell' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
