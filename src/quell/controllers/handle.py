"""Calling a compiled controller from Python, one sample at a time.

Numba unpacks a NamedTuple anew at each call, array by array: 2.7 µs for ten. A ``structref`` holds the same parameters and state
unpacked; and the compiled function itself, called past the look-up of its argument types, costs a tenth of a microsecond.
"""

from __future__ import annotations

from typing import Any

from numba.core import types as nb_types
from numba.experimental import structref

from quell.controllers.base import control
from quell.dispatch import compiled_call


@structref.register
class _HandleType(nb_types.StructRef):
    pass


class Handle(structref.StructRefProxy):
    """Parameters and state of a controller, unpacked for compiled code; the state's arrays are shared, not copied."""

    def __new__(cls, design: Any, state: Any) -> Any:
        """Make a handle."""
        return structref.StructRefProxy.__new__(cls, design, state)


structref.define_proxy(Handle, _HandleType, ["design", "state"])


def bind(design: Any, state: Any) -> Any:
    """Return a handle on a controller's parameters and state."""
    return Handle(design, state)


@compiled_call
def bound_control(handle: Any, r: float, y: float) -> float:
    """Take one sample; see ``controllers.base.control``."""
    return control(handle.design, handle.state, r, y)


def entry_point(dispatcher: Any, *args: Any) -> Any:
    """Return the compiled function that ``dispatcher`` calls for arguments of these types, or the dispatcher where it can't be had.

    It checks less than the dispatcher does, so only arguments of the very same types may be passed, or Python numbers for floats.
    """
    signature = tuple(dispatcher.typeof_pyval(arg) for arg in args)
    compiled = dispatcher.overloads.get(signature)
    return getattr(compiled, "entry_point", None) or dispatcher
