"""Controllers: what makes a control signal of a reference and a measurement."""

from quell.controllers.adrc import ADRC
from quell.controllers.base import Controller
from quell.controllers.differentiator import TrackingDifferentiator
from quell.controllers.estimate import Estimate

__all__ = ["ADRC", "Controller", "Estimate", "TrackingDifferentiator"]
