"""A compiled controller step, called from Python one sample at a time.

Numba unpacks a NamedTuple at each call, array by array: 2.7 µs for ten arrays. A ``structref``
holds the same parameters and state unpacked, and a call of the compiled function itself, without
the look-up of its argument types, costs a tenth of a microsecond.

Inside the call the parameters and the state are used without reference counting, which with thirty
arrays would take longer than the control law. The step therefore runs the same code as the
simulation, which does not allocate.
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
    """Parameters and state of a controller for compiled code; shares the state's arrays."""

    def __new__(cls, design: Any, state: Any) -> Any:
        """Make a packed controller."""
        return structref.StructRefProxy.__new__(cls, design, state)


structref.define_proxy(PackedController, _PackedType, ["design", "state"])


@compiled
def _one_sample(design: Any, state: Any, r: float, y: float) -> float:
    return control(design, state, r, y)


@intrinsic
def _control_without_counting(typing_context: Any, packed: Any, r: Any, y: Any) -> Any:
    """Call ``_one_sample`` with borrowed references; the caller's ``packed`` keeps them alive."""
    fields = packed.field_dict
    callee = nb_types.Dispatcher(_one_sample.uncached)  # type: ignore[attr-defined]
    inner = callee.get_call_type(typing_context, (fields["design"], fields["state"], r, y), {})

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        struct = context.make_helper(builder, packed, value=values[0])
        address = context.nrt.meminfo_data(builder, struct.meminfo)
        pointer_type = context.get_value_type(packed.get_data_type()).as_pointer()
        address = builder.bitcast(address, pointer_type)
        data = context.make_helper(builder, packed.get_data_type(), ref=address)
        arguments = (data.design, data.state, values[1], values[2])
        return context.get_function(callee, inner)(builder, arguments)

    return nb_types.float64(packed, r, y), generate


@compiled_call
def step_packed(packed: Any, r: float, y: float) -> float:
    """Take one sample; see ``controllers.base.control``."""
    return _control_without_counting(packed, r, y)


def entry_point(dispatcher: Any, *args: Any) -> Any:
    """Return the compiled function that ``dispatcher`` calls for arguments of these types.

    Without access to it, return the dispatcher itself. The function checks its arguments less than
    the dispatcher: pass only arguments of exactly these types, or Python numbers for floats.
    """
    signature = tuple(dispatcher.typeof_pyval(arg) for arg in args)
    compiled = dispatcher.overloads.get(signature)
    return getattr(compiled, "entry_point", None) or dispatcher
