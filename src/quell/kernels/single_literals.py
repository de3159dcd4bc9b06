"""Literals of kernels in single precision, where a kernel gets numbers in single precision.

Numba takes each float in the code of a function for double, so a product of one with a number in
single precision is double, and so is all that follows. Interpreted, and in C with literals like
``0.5f``, it is single. So where an argument of a kernel is in single precision, its constants are
made single before Numba assigns types.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numba.core import ir
from numba.core import types as nb_types
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.ir_utils import build_definitions

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
            for statement in block.find_insts(ir.Assign):
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
    if isinstance(value, ir.Const | ir.Global | ir.FreeVar):
        constant = value.value
        if constant is float:
            return ir.Global("float32", np.float32, value.loc)
        rounded = _rounded(constant)
        return None if rounded is constant else ir.Const(rounded, value.loc)
    if isinstance(value, ir.Expr) and value.op == "getattr":
        owner = code._definitions.get(value.value.name, [None])[0]
        if isinstance(owner, ir.Global) and owner.value is math:
            constant = getattr(math, value.attr)
            return ir.Const(np.float32(constant), value.loc) if type(constant) is float else None
    return None


def _rounded(constant: Any) -> Any:
    """Return a float as ``np.float32``, also in a tuple; all else as it is."""
    if type(constant) is float:
        with np.errstate(over="ignore"):  # thresholds of double precision, which are not used
            return np.float32(constant)
    if type(constant) is tuple and any(type(part) is float for part in constant):
        return tuple(map(_rounded, constant))
    return constant
