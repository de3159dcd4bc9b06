"""Models from records: a transfer function from measured input and output, and what to excite a plant with."""

from quell.identification.excitation import Excitation, excitation
from quell.identification.experiment import excited
from quell.identification.frequency_response import FrequencyResponse, frequency_response
from quell.identification.identify import identify
from quell.identification.measured import Measured, read_record
from quell.identification.result import Identified, Root
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
