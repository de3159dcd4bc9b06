"""Controllers for other machines: C code generated from the kernels.

May import: everything but setups, experiments and the command line.
"""

from quell.export.c_source import CSource, c_source
from quell.export.fmi import fmu
from quell.export.translate.values import TranslationError

__all__ = ["CSource", "TranslationError", "c_source", "fmu"]
