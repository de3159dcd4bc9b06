"""Tuning: the controller of a structure with the best objective under constraints.

May import ``identification`` and what stands before it. ``constraints`` and ``objectives`` say what
is asked for, ``structures`` has the families of controllers and their free parameters, ``loops``
the frequency responses of a set of plants, ``search`` the optimiser; ``tune`` puts them together
and returns a ``Tuned``.
"""

from quell.lazy import public_names
from quell.tuning.axes import tune_axes
from quell.tuning.compensator import TunedCompensator, tune_compensator
from quell.tuning.constraints import Constraints
from quell.tuning.plants import identified_plants
from quell.tuning.schedules import TunedSchedule, tune_schedule
from quell.tuning.structures import STRUCTURES
from quell.tuning.tune import tune
from quell.tuning.tuned import Tuned
from quell.tuning.tuned_axes import AxesBound, AxesCheck, AxisResult, TunedAxes

__all__ = [
    "STRUCTURES",
    "AxesBound",
    "AxesCheck",
    "AxisResult",
    "Constraints",
    "Tuned",
    "TunedAxes",
    "TunedCompensator",
    "TunedSchedule",
    "identified_plants",
    "tune",
    "tune_axes",
    "tune_compensator",
    "tune_schedule",
]

__dir__ = public_names(__name__)
