"""A controller as a library in C: project files, golden vectors, sizes, and the precision check.

May import everything in ``export`` but ``fmi``.
"""

from quell.export.library.exported import Exported, NoCompilerError, Sizes, c
from quell.export.library.precision import Comparison, Difference

__all__ = ["Comparison", "Difference", "Exported", "NoCompilerError", "Sizes", "c"]
