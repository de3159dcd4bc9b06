"""Features: the inputs of learners, functions of the estimated state and the control signal.

May import ``observers``, ``kernels`` and what stands before them. A new block needs its own file
and its name here; users can also write one, see ``base.py``.
"""

from quell.features.base import Features, Joined
from quell.features.custom import Custom
from quell.features.fourier import RandomFourier
from quell.features.friction import Friction
from quell.features.linear import Bias, Input, State
from quell.features.periodic import Periodic
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
    "Periodic",
    "Polynomial",
    "RandomFourier",
    "State",
]
