"""Common controllers to compare ADRC with, each with its usual design rule and its source.

May import ``controllers`` with ``adrc``, ``linear`` and ``prefilters``, and what they import.
"""

from quell.controllers.baselines.adaptive_notch import AdaptiveNotch
from quell.controllers.baselines.pid import PID, PPI, Notch, NotchPID, equivalent_pid
from quell.controllers.baselines.state_feedback import LQG, ResonanceRatio
from quell.controllers.shaping import EI, MZV, ZV, ZVD, Shaper
from quell.lazy import imported_on_use, public_names

__all__ = [
    "EI",
    "LQG",
    "MZV",
    "PID",
    "PPI",
    "ZV",
    "ZVD",
    "AdaptiveNotch",
    "Notch",
    "NotchPID",
    "ResonanceRatio",
    "Shaper",
    "equivalent_pid",
]

__getattr__ = imported_on_use(__name__, {})

__dir__ = public_names(__name__)
