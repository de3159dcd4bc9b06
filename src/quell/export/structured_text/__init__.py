"""Controllers in Structured Text of IEC 61131-3, translated from their C code.

May import: the C code of a controller, and what ``quell.export`` may.
"""

from quell.export.structured_text.function_block import FunctionBlock, st, st_source

__all__ = ["FunctionBlock", "st", "st_source"]
