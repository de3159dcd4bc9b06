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
from numba._dynfunc import make_function
from numba.core.cgutils import normalize_ir_text
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.targetconfig import ConfigStack
from numba.core.typed_passes import NativeLowering
from numba.core.untyped_passes import IRProcessing

from quell.kernels.single_literals import SingleLiterals

# Prefix of Numba's variables that point to a function's environment, which ``print`` needs.
_ENVIRONMENT = "_ZN08NumbaEnv"


class KernelLibrary(JITCodeLibrary):
    """The code of a kernel, to be linked into other code."""

    uses_environment = False  # whether its own code does

    def add_ir_module(self, ir_module: ir.Module) -> None:
        """Do as Numba does; see whether more of the environment is there than its declaration."""
        text = normalize_ir_text(str(ir_module))
        self.uses_environment |= text.count(_ENVIRONMENT) > 1
        ll_module = llvm.parse_assembly(text)
        ll_module.name = ir_module.name
        ll_module.verify()
        self.add_llvm_module(ll_module)

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
        """Make no machine code; add the environment variables to the engine if they are used."""
        self._finalize_dynamic_globals()
        if self.uses_environment:
            self._add_environments()
        self._finalized = True

    def _add_environments(self) -> None:
        """Add only the environment variables to the engine: Numba sets each of them once."""
        variables = self._codegen._create_empty_module(f"{self.name}.variables")
        pointer = ir.IntType(8).as_pointer()
        for variable in self._final_module.global_variables:
            if variable.name.startswith(_ENVIRONMENT):
                declared = ir.GlobalVariable(variables, pointer, variable.name)
                declared.linkage, declared.initializer = "common", ir.Constant(pointer, None)
        cleanup = self._codegen._add_module(llvm.parse_assembly(str(variables)))
        if cleanup:
            weakref.finalize(self, cleanup)


@register_pass(mutates_CFG=False, analysis_only=True)
class _FinishKernel(AnalysisPass):
    """Finish a kernel as Numba finishes code that Python calls, but without machine code."""

    _name = "finish_kernel"

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        lowered, library, target = state.cr, state.library, state.targetctx
        library.finalize()
        module, name = lowered.fndesc.lookup_module(), lowered.fndesc.qualname
        handle = make_function(module, name, "a kernel", 0, lowered.env, (library,))
        if library.uses_environment:
            library.codegen.set_env(target.get_env_name(lowered.fndesc), lowered.env)
        target.insert_user_function(handle, lowered.fndesc, [library])
        state.reload_init.extend(library._reload_init)
        state.cr = lowered._replace(cfunc=handle)
        return False


class KernelCompiler(CompilerBase):
    """Numba's compiler, writing to a ``KernelLibrary``."""

    def define_pipelines(self) -> list[Any]:
        """Return Numba's passes, with single literals, and the end of the lowering replaced."""
        state = self.state
        state.library = KernelLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        passes = DefaultPassBuilder.define_nopython_pipeline(state)
        passes.add_pass_after(SingleLiterals, IRProcessing)
        passes.add_pass_after(_FinishKernel, NativeLowering)
        passes.finalize()
        return [passes]


class EntryCompiler(CompilerBase):
    """Numba's compiler for an entry point, which shares the kernels that it calls.

    In Numba's table of compiled functions, the flags of their caller are a part of the key. How
    Python calls an entry point says nothing about what it calls: without these flags, kernels are
    not compiled again for an entry point that keeps the interpreter lock.
    """

    def define_pipelines(self) -> list[Any]:
        """Return Numba's passes."""
        of_callees = ConfigStack.top_or_none()  # a copy of the flags, which callees inherit from
        of_callees.discard("release_gil")
        of_callees.no_cpython_wrapper = of_callees.no_cfunc_wrapper = True
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


class WithoutOverlaps(EntryCompiler):
    """The compiler for an entry point that writes to no memory which it reaches in two ways.

    LLVM may then keep in registers what it has read, although the code writes to other arrays.
    """

    def define_pipelines(self) -> list[Any]:
        """Return Numba's passes."""
        self.state.flags.noalias = True
        return super().define_pipelines()


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
