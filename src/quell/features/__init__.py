"""Features: what a learner is shown of the estimated state and the control signal."""

from quell.features.base import Features, Joined
from quell.features.linear import Bias, Input, State

__all__ = ["Bias", "Features", "Input", "Joined", "State"]
