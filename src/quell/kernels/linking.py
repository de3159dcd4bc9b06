"""Kernels are linked into what calls them, and made machine code there only.

Left to itself, Numba takes every function it meets through all of LLVM: what it calls is inlined,
the whole optimised twice, made machine code and wrapped for calls from C. A kernel is called by
compiled code alone and always inlined, so a loop was optimised again at each level of its calls,
for code that nobody runs. Here a kernel gets the passes over one function at a time, which keep its
code small, and the rest is left to the entry point it ends up in. This halves the time a loop takes
to compile; the loop is as fast.
"""

from __future__ import annotations

import weakref
from typing import Any

import llvmlite.binding as llvm
import numba
from llvmlite import ir
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.typed_passes import AnnotateTypes

# What Numba calls the variables that point to a function's environment: what its ``print`` makes
# Python objects with.
_ENVIRONMENT = "_ZN08NumbaEnv"


class KernelLibrary(JITCodeLibrary):
    """The code of a kernel, to be linked into other code."""

    def _optimize_final_module(self) -> None:
        """Leave it to the entry point."""

    def _finalize_final_module(self) -> None:
        """Give the engine nothing but the variables that Numba sets once for a function, wherever that is linked into."""
        variables = self._codegen._create_empty_module(f"{self.name}.variables")
        pointer = ir.IntType(8).as_pointer()
        for variable in self._final_module.global_variables:
            if variable.name.startswith(_ENVIRONMENT):
                declared = ir.GlobalVariable(variables, pointer, variable.name)
                declared.linkage, declared.initializer = "common", ir.Constant(pointer, None)
        self._finalize_dynamic_globals()
        cleanup = self._codegen._add_module(llvm.parse_assembly(str(variables)))
        if cleanup:
            weakref.finalize(self, cleanup)
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return zero, which is to say that Python can not call it."""
        self._ensure_finalized()
        return 0


@register_pass(mutates_CFG=False, analysis_only=True)
class _ToLibrary(AnalysisPass):
    _name = "kernel_to_library"

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        state.library = KernelLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        return False


class KernelCompiler(CompilerBase):
    """Numba's compiler, with another place for the code."""

    def define_pipelines(self) -> list[Any]:
        """Return Numba's passes, with the place chosen before code is made."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_ToLibrary, AnnotateTypes)
        passes.finalize()
        return [passes]


# For ``overload`` and ``register_jitable``. What this stands on is no promise of Numba's: with
# versions that it was not tried with, kernels take Numba's own way, which gives the same code and
# takes twice as long.
_TRIED = ("0.68.",)
KERNEL_OPTIONS: dict[str, Any] = (
    {"no_cfunc_wrapper": True, "pipeline_class": KernelCompiler}
    if numba.__version__.startswith(_TRIED)
    else {}
)
