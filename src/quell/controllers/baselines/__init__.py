"""Common controllers to compare ADRC with, each with its usual design rule and its source.

May import ``controllers`` with ``adrc``, ``linear`` and ``prefilters``, and what they import.
"""

from quell.controllers.baselines.equivalent import equivalent_pid
from quell.controllers.baselines.lqg import LQG
from quell.controllers.baselines.notch import Notch, NotchPID
from quell.controllers.baselines.p_pi import PPI
from quell.controllers.baselines.pid import PID
from quell.controllers.baselines.resonance_ratio import ResonanceRatio
from quell.controllers.prefilters.shaping import ZV, ZVD, Shaper

__all__ = [
    "LQG",
    "PID",
    "PPI",
    "ZV",
    "ZVD",
    "Notch",
    "NotchPID",
    "ResonanceRatio",
    "Shaper",
    "equivalent_pid",
]
