"""Models from records: a transfer function from measured input and output, and what to excite a plant with."""

from quell.identification.design import Excitation, excitation
from quell.identification.empirical import FrequencyResponse, frequency_response
from quell.identification.experiment import excited
from quell.identification.fitting import identify
from quell.identification.identified import Identified, Root
from quell.identification.judge import Residuals
from quell.identification.records import Measured, read_record

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
