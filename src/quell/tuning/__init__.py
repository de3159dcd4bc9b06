"""Tuning: the controller of a structure with the best objective under constraints.

May import ``identification`` and what stands before it. ``constraints`` says what is asked
for, ``structures`` has the families of controllers and their free parameters, ``loops`` the
frequency responses of a set of plants, ``search`` the optimiser, ``axes`` the bandwidths of several
axes; ``tune`` puts them together and returns a ``Tuned``.
"""

from quell.lazy import imported_on_use, public_names
from quell.tuning.compensator import OnTop, tune_compensator
from quell.tuning.constraints import Constraints, LoadSpectrum
from quell.tuning.interaction import Interaction, Reached
from quell.tuning.plants import identified_plants
from quell.tuning.report import Design
from quell.tuning.schedules import AtPoints, tune_schedule
from quell.tuning.structures import STRUCTURES
from quell.tuning.tune import tune
from quell.tuning.tuned import Check, Tuned

__all__ = [
    "STRUCTURES", "AtPoints", "Check", "Constraints", "Design", "Interaction", "LoadSpectrum",
    "OnTop", "Reached", "Tuned", "identified_plants", "tune", "tune_compensator", "tune_schedule"
]  # fmt: skip

# Names of an earlier release.
_RENAMED = {
    "AxesBound": "Reached",
    "AxesCheck": "Check",
    "AxisResult": "Design",
    "TunedAxes": "Tuned",
    "TunedCompensator": "Tuned",
    "TunedSchedule": "Tuned",
    "tune_axes": "tune",
}

__getattr__ = imported_on_use(__name__, {}, (), _RENAMED)

__dir__ = public_names(__name__)
