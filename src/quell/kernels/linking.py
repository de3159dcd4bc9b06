"""Faster compilation: kernels become machine code only in the entry points they are linked into.

By default Numba takes every function through all of LLVM: what it calls is inlined, the whole is
optimised twice, made machine code and wrapped for calls from C. Kernels are called by compiled code
only and always inlined, so each loop was optimised again at each level of its calls, for code that
nobody runs. Here a kernel gets only the passes over single functions, which keep its code small;
the entry point gets the rest. This halves the compile time of a loop and does not slow it down.

Literals of kernels in single precision, where a kernel gets numbers in single precision.

Numba takes each float in the code of a function for double, so a product of one with a number in
single precision is double, and so is all that follows. Interpreted, and in C with literals like
``0.5f``, it is single. So where an argument of a kernel is in single precision, its constants are
made single before Numba assigns types.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from numba import types as nb_types

from quell.kernels.numba_internals import (
    AnalysisPass,
    CompilerBase,
    ConfigStack,
    DefaultPassBuilder,
    FunctionPass,
    IRProcessing,
    JITCodeLibrary,
    NativeLowering,
    build_definitions,
    ir,
    is_tested,
    llvm,
    make_function,
    normalize_ir_text,
    numba_ir,
    register_pass,
)

F = TypeVar("F", bound=Callable[..., Any])


def in_both_precisions(function: F) -> F:
    """Mark a kernel that converts between double and single precision: its literals stay double."""
    function.in_both_precisions = True  # type: ignore[attr-defined]
    return function


@register_pass(mutates_CFG=False, analysis_only=False)
class SingleLiterals(FunctionPass):
    """Make the constants of a function single if it has an argument in single precision."""

    _name = "single_literals"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Replace constants; return whether there were any."""
        if hasattr(state.func_id.func, "in_both_precisions"):
            return False
        if not any(map(_has_single, state.args)):
            return False
        changed = False
        for block in state.func_ir.blocks.values():
            for statement in block.find_insts(numba_ir.Assign):
                new = _in_single(state.func_ir, statement.value)
                if new is not None:
                    statement.value, changed = new, True
        if changed:
            state.func_ir._definitions = build_definitions(state.func_ir.blocks)
        return changed


def _has_single(kind: Any) -> bool:
    """Return whether a type contains numbers in single precision."""
    if isinstance(kind, nb_types.BaseTuple):
        return any(map(_has_single, kind.types))
    if isinstance(kind, nb_types.Array):
        return _has_single(kind.dtype)
    if isinstance(kind, nb_types.Record):
        return any(_has_single(field.type) for field in kind.fields.values())
    return bool(kind == nb_types.float32)


def _in_single(code: Any, value: Any) -> Any:
    """Return what to put in place of a value in a function's code; None to keep it."""
    if isinstance(value, numba_ir.Const | numba_ir.Global | numba_ir.FreeVar):
        constant = value.value
        if constant is float:
            return numba_ir.Global("float32", np.float32, value.loc)
        rounded = _rounded(constant)
        return None if rounded is constant else numba_ir.Const(rounded, value.loc)
    if isinstance(value, numba_ir.Expr) and value.op == "getattr":
        owner = code._definitions.get(value.value.name, [None])[0]
        if isinstance(owner, numba_ir.Global) and owner.value is math:
            constant = getattr(math, value.attr)
            return (
                numba_ir.Const(np.float32(constant), value.loc) if type(constant) is float else None
            )
    return None


def _rounded(constant: Any) -> Any:
    """Return a float as ``np.float32``, also in a tuple; all else as it is."""
    if type(constant) is float:
        with np.errstate(over="ignore"):  # thresholds of double precision, which are not used
            return np.float32(constant)
    if type(constant) is tuple and any(type(part) is float for part in constant):
        return tuple(map(_rounded, constant))
    return constant


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
KERNEL_OPTIONS: dict[str, Any] = (
    {"no_cfunc_wrapper": True, "pipeline_class": KernelCompiler}
    if is_tested(numba.__version__)
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
