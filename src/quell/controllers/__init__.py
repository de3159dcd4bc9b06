"""Controllers: what makes a control signal of a reference and a measurement."""

from quell.controllers.adrc import ADRC
from quell.controllers.bandwidth import omega_c_for
from quell.controllers.base import Controller
from quell.controllers.differentiator import TrackingDifferentiator
from quell.controllers.estimate import Estimate
from quell.controllers.unwise import warn_if_unwise

__all__ = ["ADRC", "Controller", "Estimate", "TrackingDifferentiator", "omega_c_for", "warn_if_unwise"]
