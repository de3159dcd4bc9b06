"""Features: the inputs of learners, functions of the estimated state and the control signal.

May import ``observers``, ``kernels`` and what stands before them. A new block needs its own file
and its name here; users can also write one, see ``base.py``.
"""

from quell.features.all_axes import AllAxes
from quell.features.base import Bias, Custom, Features, Input, Joined, Polynomial, State
from quell.features.basis import RBF, Friction, Periodic, RandomFourier
from quell.lazy import imported_on_use, public_names

__all__ = [
    "RBF", "AllAxes", "Bias", "Custom", "Features", "Friction", "Input", "Joined", "Periodic",
    "Polynomial", "RandomFourier", "State"
]  # fmt: skip

__getattr__ = imported_on_use(__name__, {})

__dir__ = public_names(__name__)
