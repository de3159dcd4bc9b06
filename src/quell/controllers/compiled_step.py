"""Calling a compiled controller from Python, one sample at a time.

Numba unpacks a NamedTuple anew at each call, array by array: 2.7 µs for ten. A ``structref`` holds the same parameters and state
unpacked; and the compiled function itself, called past the look-up of its argument types, costs a tenth of a microsecond.

What a handle holds is borrowed for a call, not counted: with thirty arrays, and a count up and down wherever one is named, counting would
take longer than the control law. So a step is the same code as in the driver, which can't allocate.
"""

from __future__ import annotations

from typing import Any

from numba.core import types as nb_types
from numba.experimental import structref
from numba.extending import intrinsic

from quell.controllers.base import control
from quell.kernels.dispatch import compiled, compiled_call


@structref.register
class _PackedType(nb_types.StructRef):
    pass


class PackedController(structref.StructRefProxy):
    """Parameters and state of a controller, unpacked for compiled code; the state's arrays are shared, not copied."""

    def __new__(cls, design: Any, state: Any) -> Any:
        """Make a handle."""
        return structref.StructRefProxy.__new__(cls, design, state)


structref.define_proxy(PackedController, _PackedType, ["design", "state"])


def pack(design: Any, state: Any) -> Any:
    """Return a handle on a controller's parameters and state."""
    return PackedController(design, state)


@compiled
def _one_sample(design: Any, state: Any, r: float, y: float) -> float:
    return control(design, state, r, y)


@intrinsic
def _borrowed_control(typing_context: Any, handle: Any, r: Any, y: Any) -> Any:
    """Call ``_one_sample`` with what the handle holds; the caller's handle keeps it alive."""
    fields = handle.field_dict
    callee = nb_types.Dispatcher(_one_sample.uncached)  # type: ignore[attr-defined]
    inner = callee.get_call_type(typing_context, (fields["design"], fields["state"], r, y), {})

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        held = context.make_helper(builder, handle, value=values[0])
        kept = context.nrt.meminfo_data(builder, held.meminfo)
        kept = builder.bitcast(kept, context.get_value_type(handle.get_data_type()).as_pointer())
        data = context.make_helper(builder, handle.get_data_type(), ref=kept)
        return context.get_function(callee, inner)(
            builder, (data.design, data.state, values[1], values[2])
        )

    return nb_types.float64(handle, r, y), generate


@compiled_call
def step_packed(handle: Any, r: float, y: float) -> float:
    """Take one sample; see ``controllers.base.control``."""
    return _borrowed_control(handle, r, y)


def entry_point(dispatcher: Any, *args: Any) -> Any:
    """Return the compiled function that ``dispatcher`` calls for arguments of these types, or the dispatcher where it can't be had.

    It checks less than the dispatcher does, so only arguments of the very same types may be passed, or Python numbers for floats.
    """
    signature = tuple(dispatcher.typeof_pyval(arg) for arg in args)
    compiled = dispatcher.overloads.get(signature)
    return getattr(compiled, "entry_point", None) or dispatcher
