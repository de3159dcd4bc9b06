"""System identification: transfer functions from records, and the design of excitations.

May import ``controllers``, ``plants``, ``simulation`` and what they import.

``experiment`` has excitations and records, ``model`` the model and its gradient, ``search`` the
search for its parameters, ``running_loop`` the same for the gain in records of running loops; the
files here put them together.
"""

from quell.identification.excitation import (
    Excitation,
    excitation,
    interleaved_excitations,
    save_excitations,
)
from quell.identification.frequencies import FrequencyResponse, frequency_response
from quell.identification.frequency_model import FrequencyModel
from quell.identification.frequency_table import FrequencyTable, frequency_table
from quell.identification.from_frequencies import identify_frequencies
from quell.identification.gain_by_signal import GainBin, identify_b0_by
from quell.identification.gain_matrix import InputGainMatrix, identify_b0_matrix
from quell.identification.identify import identify
from quell.identification.input_gain import Bandwidth, InputGain, MarginError, identify_b0
from quell.identification.model import Root
from quell.identification.record_file import Measured, excited, read_record
from quell.identification.result import Identified, simulated_plant
from quell.identification.spectra import SpectralMode, SpectralModes, modes_of_spectrum
from quell.identification.structures import (
    Alternative,
    alternatives,
    decided,
    not_told_apart,
)
from quell.identification.swings import Decay, FreeSwing, Mode, free_swing
from quell.identification.validation import Residuals
from quell.lazy import public_names

__all__ = [
    "Alternative",
    "Bandwidth",
    "Decay",
    "Excitation",
    "FreeSwing",
    "FrequencyModel",
    "FrequencyResponse",
    "FrequencyTable",
    "GainBin",
    "Identified",
    "InputGain",
    "InputGainMatrix",
    "MarginError",
    "Measured",
    "Mode",
    "Residuals",
    "Root",
    "SpectralMode",
    "SpectralModes",
    "alternatives",
    "decided",
    "excitation",
    "excited",
    "free_swing",
    "frequency_response",
    "frequency_table",
    "identify",
    "identify_b0",
    "identify_b0_by",
    "identify_b0_matrix",
    "identify_frequencies",
    "interleaved_excitations",
    "modes_of_spectrum",
    "not_told_apart",
    "read_record",
    "save_excitations",
    "simulated_plant",
]

__dir__ = public_names(__name__)
