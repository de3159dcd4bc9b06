"""Controllers for other machines: C code generated from the kernels.

May import: everything but setups, experiments and the command line.
"""

from quell.export.c_files import CSource, plant_source
from quell.export.controller_source import c_source
from quell.export.exact import ExactLaw, exact_law
from quell.export.fmi import fmu
from quell.export.library import Comparison, Difference, Exported, NoCompilerError, Sizes, c
from quell.export.loop_stability import Stability, stability
from quell.export.proof import Alarm, Proof
from quell.export.ros2 import ros2
from quell.export.structured_text import FunctionBlock, st, st_source
from quell.export.translate.text import TranslationError
from quell.lazy import public_names

__all__ = [
    "Alarm", "CSource", "Comparison", "Difference", "ExactLaw", "Exported", "FunctionBlock",
    "NoCompilerError", "Proof", "Sizes", "Stability", "TranslationError", "c", "c_source",
    "exact_law", "fmu", "plant_source", "ros2", "st", "st_source", "stability",
]  # fmt: skip

__dir__ = public_names(__name__)
