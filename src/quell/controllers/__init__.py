"""Controllers: from reference and measurement to the control signal.

Files of this folder itself are the base of ``adrc``, ``linear``, ``prefilters`` and ``baselines``.
May import ``guard``, ``learners``, ``plants``, ``observers`` and what they import.
"""

from quell.controllers import baselines
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.adrc.dead_time import (
    DeadTimeTuning,
    adrc_for_dead_time,
    dead_time_tuning,
)
from quell.controllers.adrc.estimate import Estimate
from quell.controllers.adrc.feedback import NonlinearFeedback
from quell.controllers.adrc.feedforward import Feedforward
from quell.controllers.bandwidth import omega_c_for
from quell.controllers.base import Controller
from quell.controllers.design_checks import warn_if_unwise
from quell.controllers.linear.law import LinearLaw
from quell.controllers.linear.linear import LinearController
from quell.controllers.prefilters.differentiator import TrackingDifferentiator
from quell.controllers.prefilters.prefilter import Prefilter, Prefiltered
from quell.controllers.prefilters.profile import ProfileGenerator
from quell.controllers.prefilters.reference_model import ReferenceModel
from quell.controllers.single import in_single_precision

__all__ = [
    "ADRC",
    "Controller",
    "DeadTimeTuning",
    "Estimate",
    "Feedforward",
    "LinearController",
    "LinearLaw",
    "NonlinearFeedback",
    "Prefilter",
    "Prefiltered",
    "ProfileGenerator",
    "ReferenceModel",
    "TrackingDifferentiator",
    "adrc_for_dead_time",
    "baselines",
    "dead_time_tuning",
    "in_single_precision",
    "omega_c_for",
    "warn_if_unwise",
]
