"""Controllers: what makes a control signal of a reference and a measurement."""

from quell.controllers import baselines
from quell.controllers.adrc import ADRC
from quell.controllers.bandwidth import omega_c_for
from quell.controllers.base import Controller
from quell.controllers.differentiator import TrackingDifferentiator
from quell.controllers.estimate import Estimate
from quell.controllers.linear import LinearController, LinearLaw
from quell.controllers.prefilter import Prefilter, Prefiltered
from quell.controllers.reference_model import ReferenceModel
from quell.controllers.unwise import warn_if_unwise

__all__ = [
    "ADRC",
    "Controller",
    "Estimate",
    "LinearController",
    "LinearLaw",
    "Prefilter",
    "Prefiltered",
    "ReferenceModel",
    "TrackingDifferentiator",
    "baselines",
    "omega_c_for",
    "warn_if_unwise",
]
