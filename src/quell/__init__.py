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

from typing import TYPE_CHECKING

from quell.lazy import imported_on_use, public_names

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
        monitoring,
        observers,
        plants,
        realtime,
        setup,
        signals,
        sweeping,
        tuning,
    )
    from quell.controllers import baselines
    from quell.controllers.adrc import ADRC
    from quell.controllers.axes import Axes
    from quell.controllers.base import omega_c_for
    from quell.controllers.compensated import Compensated
    from quell.controllers.compensator import Compensator, Estimate
    from quell.controllers.feedforward import Feedforward
    from quell.controllers.held import HeldPlant
    from quell.controllers.online_gain import OnlineGain
    from quell.controllers.safe_set import SafeSet
    from quell.controllers.schedule import Schedule
    from quell.guard import Guard, Reason
    from quell.identification.identify import identify
    from quell.lti.canonical import canonical
    from quell.observers.eso import ESO
    from quell.records import metrics
    from quell.records.plotting import style
    from quell.records.trajectory import BatchTrajectory, Trajectory
    from quell.simulation.scenario import Scenario
    from quell.simulation.simulate import simulate
    from quell.sweeping.sweep import sweep
    from quell.tuning.schedules import tune_schedule
    from quell.tuning.tune import tune
    from quell.tuning.tuned import Tuned
    from quell.types import DesignWarning, Status

__version__ = "0.2.0"

_HOMES = {
    "ADRC": "controllers.adrc",
    "Axes": "controllers.axes",
    "Compensated": "controllers.compensated",
    "Compensator": "controllers.compensator",
    "DesignWarning": "types",
    "BatchTrajectory": "records.trajectory",
    "ESO": "observers.eso",
    "Estimate": "controllers.compensator",
    "Feedforward": "controllers.feedforward",
    "Guard": "guard",
    "HeldPlant": "controllers.held",
    "OnlineGain": "controllers.online_gain",
    "Reason": "guard",
    "SafeSet": "controllers.safe_set",
    "Schedule": "controllers.schedule",
    "Scenario": "simulation.scenario",
    "Status": "types",
    "Trajectory": "records.trajectory",
    "Tuned": "tuning.tuned",
    "canonical": "lti.canonical",
    "identify": "identification.identify",
    "omega_c_for": "controllers.base",
    "simulate": "simulation.simulate",
    "style": "records.plotting",
    "sweep": "sweeping.sweep",
    "tune": "tuning.tune",
    "tune_schedule": "tuning.schedules",
}
_MODULES = (
    "analysis", "controllers", "controllers.baselines", "envs", "experiments", "export", "features",
    "identification", "learners", "monitoring", "observers", "plants", "realtime",
    "records.metrics", "setup", "signals", "sweeping", "tuning",
)  # fmt: skip

__all__ = [
    "ADRC", "ESO", "Axes", "BatchTrajectory", "Compensated", "Compensator", "DesignWarning",
    "Estimate", "Feedforward", "Guard", "HeldPlant", "OnlineGain", "Reason", "SafeSet", "Scenario",
    "Schedule", "Status", "Trajectory", "Tuned", "analysis", "baselines", "canonical",
    "controllers", "envs", "experiments", "export", "features", "identification", "identify",
    "learners", "metrics", "monitoring", "observers", "omega_c_for", "plants", "realtime", "setup",
    "signals", "simulate", "style", "sweep", "sweeping", "tune", "tune_schedule", "tuning",
]  # fmt: skip


# Names of earlier releases.
_RENAMED = {"AxesBatch": "BatchTrajectory", "AxesTrajectory": "Trajectory"}

__getattr__ = imported_on_use(__name__, _HOMES, _MODULES, _RENAMED)

__dir__ = public_names(__name__)
