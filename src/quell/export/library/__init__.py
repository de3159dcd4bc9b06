"""A controller as a library in C: project files, golden vectors, sizes, and the precision check.

May import everything in ``export`` but ``fmi``.
"""

from quell.export.library.exported import (
    Comparison,
    Difference,
    Exported,
    NoCompilerError,
    Sizes,
    c,
)

__all__ = ["Comparison", "Difference", "Exported", "NoCompilerError", "Sizes", "c"]
