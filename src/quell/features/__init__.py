"""Features: what a learner is shown of the estimated state and the control signal."""

from quell.features.base import Features, Joined
from quell.features.custom import Custom
from quell.features.fourier import RandomFourier
from quell.features.friction import Friction
from quell.features.linear import Bias, Input, State
from quell.features.polynomial import Polynomial
from quell.features.radial import RBF

__all__ = [
    "RBF",
    "Bias",
    "Custom",
    "Features",
    "Friction",
    "Input",
    "Joined",
    "Polynomial",
    "RandomFourier",
    "State",
]
