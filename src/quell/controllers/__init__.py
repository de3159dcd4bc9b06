"""Controllers: from reference and measurement to the control signal.

Files of this folder itself are the base of ``adrc``, ``linear``, ``prefilters`` and ``baselines``.
May import ``guard``, ``learners``, ``plants``, ``observers`` and what they import.
"""

from quell.controllers import baselines
from quell.controllers.adrc import (
    ADRC,
    DeadTimeTuning,
    adrc_for_dead_time,
    dead_time_tuning,
    warn_if_unwise,
)
from quell.controllers.axes import Axes
from quell.controllers.base import Controller, omega_c_for
from quell.controllers.compensated import Compensated
from quell.controllers.compensator import Compensator, Estimate
from quell.controllers.feedforward import Feedforward
from quell.controllers.from_pid import PidEqual, equal_to_pid
from quell.controllers.held import HeldPlant
from quell.controllers.law import NonlinearFeedback
from quell.controllers.linear import LinearController, LinearLaw
from quell.controllers.online_gain import GainEstimate, OnlineGain
from quell.controllers.prefilters import (
    Prefilter,
    Prefiltered,
    ReferenceModel,
    TrackingDifferentiator,
)
from quell.controllers.safe_set import SafeSet
from quell.controllers.schedule import Schedule
from quell.controllers.shaping import ProfileGenerator
from quell.controllers.single import in_single_precision
from quell.controllers.state_space import (
    Regulator,
    StateFeedback,
    quadratic_feedback,
    regulator,
    state_feedback,
)
from quell.lazy import imported_on_use, public_names

__all__ = [
    "ADRC", "Axes", "Compensated", "Compensator", "Controller", "DeadTimeTuning", "Estimate",
    "Feedforward", "GainEstimate", "HeldPlant", "LinearController", "LinearLaw",
    "NonlinearFeedback", "OnlineGain", "PidEqual", "Prefilter", "Prefiltered", "ProfileGenerator",
    "ReferenceModel", "Regulator", "SafeSet", "Schedule", "StateFeedback", "TrackingDifferentiator",
    "adrc_for_dead_time", "baselines", "dead_time_tuning", "equal_to_pid", "in_single_precision",
    "omega_c_for", "quadratic_feedback", "regulator", "state_feedback", "warn_if_unwise"
]  # fmt: skip

__getattr__ = imported_on_use(__name__, {})

__dir__ = public_names(__name__)
