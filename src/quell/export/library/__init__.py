"""A controller as a library in C: project files, golden vectors, sizes, and the precision check.

May import everything in ``export`` but ``fmi``.
"""

from quell.export.library.comparison import Comparison
from quell.export.library.exported import Exported, c
from quell.export.library.toolchain import NoCompilerError, Sizes

__all__ = ["Comparison", "Exported", "NoCompilerError", "Sizes", "c"]
