"""Numba's private modules and llvmlite: the only file that imports them, and for which versions.

Kernels need more of Numba than it documents: its passes, its types as words of memory, its disk
cache. All of that may change with each of its versions. Whoever supports another one begins here:
what has moved is found in this file, and the tests of ``kernels`` say whether it still does the
same. Public names (``numba.types``, ``numba.extending``) are imported from Numba where they are
used.
"""

from __future__ import annotations

import re
import sys
import warnings

import numba

# Versions that quell is tested with: of the first to the last, both included.
OLDEST, NEWEST = (0, 68), (0, 68)
REMEDY = "pip install 'numba==0.68.*'"


def is_tested(version: str) -> bool:
    """Return whether quell is tested with a version of Numba."""
    return OLDEST <= _numbers(version) <= NEWEST


def check_version(version: str) -> None:
    """Refuse a Numba that is older than those which quell is tested with; warn about a newer one.

    With a newer one kernels are compiled in Numba's own way, and single precision is refused
    (``controllers/single.py``), because the passes of ``kernels/linking.py`` are left out.

    Raises
    ------
    ImportError
        for an older version.

    Warns
    -----
    RuntimeWarning
        for a newer version.
    """
    tested = f"quell is tested with Numba 0.68, and this is {version}"
    if _numbers(version) < OLDEST:
        raise ImportError(f"{tested}, which is too old; {REMEDY}")
    if _numbers(version) > NEWEST:
        warnings.warn(
            f"{tested}: kernels take twice as long to compile, and single precision runs only with "
            f"interpret=True; {REMEDY}",
            RuntimeWarning,
            stacklevel=2,
        )


def _numbers(version: str) -> tuple[int, ...]:
    """Return the first two numbers of a version; one without numbers counts as newer than all."""
    found = re.match(r"(\d+)\.(\d+)", version)
    return (int(found[1]), int(found[2])) if found else (sys.maxsize,)


try:
    import llvmlite.binding as llvm
    from llvmlite import ir
    from numba._dynfunc import make_function
    from numba.core import event
    from numba.core import ir as numba_ir
    from numba.core.caching import CompileResultCacheImpl, FunctionCache
    from numba.core.cgutils import get_item_pointer, memset, normalize_ir_text, pointer_add
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import CompilerBase, DefaultPassBuilder
    from numba.core.compiler_machinery import AnalysisPass, FunctionPass, register_pass
    from numba.core.datamodel.models import DataModel
    from numba.core.errors import NumbaError
    from numba.core.ir_utils import build_definitions
    from numba.core.targetconfig import ConfigStack
    from numba.core.typed_passes import NativeLowering
    from numba.core.untyped_passes import IRProcessing
except ImportError as error:
    raise ImportError(
        f"quell is tested with Numba 0.68, and {numba.__version__} lacks what it needs ({error}); "
        f"{REMEDY}"
    ) from error

check_version(numba.__version__)

__all__ = [
    "REMEDY", "AnalysisPass", "CompileResultCacheImpl", "CompilerBase", "ConfigStack", "DataModel",
    "DefaultPassBuilder", "FunctionCache", "FunctionPass", "IRProcessing", "JITCodeLibrary",
    "NativeLowering", "NumbaError", "build_definitions", "check_version", "event",
    "get_item_pointer", "ir", "is_tested", "llvm", "make_function", "memset", "normalize_ir_text",
    "numba_ir", "pointer_add", "register_pass"
]  # fmt: skip
