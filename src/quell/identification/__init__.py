"""Models from records: a transfer function from measured input and output, and what to excite a plant with."""

from quell.identification.empirical import FrequencyResponse, frequency_response
from quell.identification.identified import Identified, Root
from quell.identification.identify import identify
from quell.identification.judge import Residuals

__all__ = ["FrequencyResponse", "Identified", "Residuals", "Root", "frequency_response", "identify"]
