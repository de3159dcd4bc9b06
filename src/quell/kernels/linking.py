"""Faster compilation: kernels become machine code only in the entry points they are linked into.

By default Numba takes every function through all of LLVM: what it calls is inlined, the whole is
optimised twice, made machine code and wrapped for calls from C. Kernels are called by compiled code
only and always inlined, so each loop was optimised again at each level of its calls, for code that
nobody runs. Here a kernel gets only the passes over single functions, which keep its code small;
the entry point gets the rest. This halves the compile time of a loop and does not slow it down.
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
from numba.core.untyped_passes import IRProcessing

from quell.kernels.single_literals import SingleLiterals

# Prefix of Numba's variables that point to a function's environment, which ``print`` needs.
_ENVIRONMENT = "_ZN08NumbaEnv"


class KernelLibrary(JITCodeLibrary):
    """The code of a kernel, to be linked into other code."""

    def _optimize_functions(self, ll_module: Any) -> None:
        """Do as Numba does, but not for declarations: most of a module are the kernels it calls."""
        ll_module.data_layout = self._codegen._data_layout
        passes, builder = self._codegen._function_pass_manager()
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def _optimize_final_module(self) -> None:
        """Do nothing: the entry point is optimised as a whole."""

    def _finalize_final_module(self) -> None:
        """Add only the environment variables to the engine: Numba sets each of them once."""
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
        """Return zero: Python can not call a kernel."""
        self._ensure_finalized()
        return 0


@register_pass(mutates_CFG=False, analysis_only=True)
class _UseKernelLibrary(AnalysisPass):
    _name = "use_kernel_library"

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        state.library = KernelLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        return False


class KernelCompiler(CompilerBase):
    """Numba's compiler, writing to a ``KernelLibrary``."""

    def define_pipelines(self) -> list[Any]:
        """Return Numba's passes, with single literals, and the library replaced."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(SingleLiterals, IRProcessing)
        passes.add_pass_after(_UseKernelLibrary, AnnotateTypes)
        passes.finalize()
        return [passes]


class WithoutOverlaps(CompilerBase):
    """Numba's compiler for an entry point that writes to no memory which it reaches in two ways.

    LLVM may then keep in registers what it has read, although the code writes to other arrays.
    """

    def define_pipelines(self) -> list[Any]:
        """Return Numba's passes."""
        self.state.flags.noalias = True
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


# Options for ``overload`` and ``register_jitable``. They depend on internals of Numba: with
# versions that were not tested, kernels are compiled in Numba's own way, which takes twice as long.
_TESTED_VERSIONS = ("0.68.",)
KERNEL_OPTIONS: dict[str, Any] = (
    {"no_cfunc_wrapper": True, "pipeline_class": KernelCompiler}
    if numba.__version__.startswith(_TESTED_VERSIONS)
    else {}
)

# Fused multiply-add is allowed. Sums are not re-ordered: the order would depend on what a kernel is
# inlined into, and a rig would no longer be its simulation to the last bit. (Write what is known
# late at the end of a sum: the processor works on the rest meanwhile.) Inlining is forced because a
# NamedTuple of arrays is passed as some forty words, which costs more than most kernels do.
OPTIONS: dict[str, Any] = {
    "fastmath": {"contract", "nsz"},
    "error_model": "numpy",
    "forceinline": True,
}
