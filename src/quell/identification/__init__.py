"""System identification: transfer functions from records, and the design of excitations.

May import ``controllers``, ``plants``, ``simulation`` and what they import.

``experiment`` has excitations and records, ``model`` the model and its gradient, ``search`` the
search for its parameters, ``running_loop`` the same for the gain in records of running loops; the
files here put them together.
"""

from quell.identification.alternatives import Alternative, alternatives, decided, not_told_apart
from quell.identification.experiment.excitation import Excitation, excitation
from quell.identification.experiment.frequency_response import FrequencyResponse, frequency_response
from quell.identification.experiment.measured import Measured, excited
from quell.identification.experiment.record_file import read_record
from quell.identification.friction_plant import simulated_plant
from quell.identification.identify import identify
from quell.identification.input_gain import Bandwidth, InputGain, MarginError, identify_b0
from quell.identification.model.roots import Root
from quell.identification.result import Identified
from quell.identification.validation import Residuals

__all__ = [
    "Alternative",
    "Bandwidth",
    "Excitation",
    "FrequencyResponse",
    "Identified",
    "InputGain",
    "MarginError",
    "Measured",
    "Residuals",
    "Root",
    "alternatives",
    "decided",
    "excitation",
    "excited",
    "frequency_response",
    "identify",
    "identify_b0",
    "not_told_apart",
    "read_record",
    "simulated_plant",
]
