"""Observers: what estimates the state and the total disturbance."""

from quell.lti.canonical import Canonical, canonical
from quell.observers.eso import ESO, continuous_gain

__all__ = ["ESO", "Canonical", "canonical", "continuous_gain"]
