"""Controllers: what makes a control signal of a reference and a measurement."""

from quell.controllers.adrc import ADRC, Estimate
from quell.controllers.base import Controller

__all__ = ["ADRC", "Controller", "Estimate"]
