"""System identification: transfer functions from records, and the design of excitations.

May import ``controllers``, ``plants``, ``simulation`` and what they import.

``identify`` is the search; ``structure`` has the model and its gradient, ``sampling`` the filters
below it.
"""

from quell.identification.excitation import Excitation, excitation
from quell.identification.frequency_response import FrequencyResponse, frequency_response
from quell.identification.identify import identify
from quell.identification.measured import Measured, excited
from quell.identification.record_file import read_record
from quell.identification.result import Identified
from quell.identification.roots import Root
from quell.identification.validation import Residuals

__all__ = [
    "Excitation",
    "FrequencyResponse",
    "Identified",
    "Measured",
    "Residuals",
    "Root",
    "excitation",
    "excited",
    "frequency_response",
    "identify",
    "read_record",
]
