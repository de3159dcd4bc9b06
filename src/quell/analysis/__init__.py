"""Analysis of loops: poles, margins, sensitivity functions, what noise does; as systems of python-control, and as pictures."""

from quell.analysis.frozen import Frozen, frozen
from quell.analysis.laws import linear_law
from quell.analysis.loop import LoopAnalysis, analyse
from quell.analysis.margins import Margins

__all__ = ["Frozen", "LoopAnalysis", "Margins", "analyse", "frozen", "linear_law"]
