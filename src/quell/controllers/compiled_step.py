"""A compiled controller step, called from Python one sample at a time.

Numba unpacks a NamedTuple at each call, array by array: 2.7 µs for ten arrays. A packed controller
holds the same parameters and state as the words that compiled code needs, in the memory of one
Python object. A call of the compiled function itself with it, without the look-up of its argument
types, costs a tenth of a microsecond. The words are written from Python, so packing compiles
nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numba.core import types as nb_types
from numba.extending import NativeValue, intrinsic, models, register_model, unbox

from quell.controllers.base import control
from quell.kernels import dispatch
from quell.kernels.dispatch import compiled_call
from quell.kernels.sized import Constant, ConstantFlag, SizedArray, type_of


class PackedType(nb_types.Type):
    """The Numba type of a packed controller; ``content`` is that of (parameters, state)."""

    def __init__(self, content: Any) -> None:
        self.content = content
        super().__init__(f"Packed({content})")


register_model(PackedType)(models.OpaqueModel)


class PackedController(bytes):
    """Parameters and state of a controller for compiled code; shares the state's arrays.

    The bytes are the words that Numba passes to a compiled function for them, 8 bytes each.

    Parameters
    ----------
    design, state
        of the controller.
    before
        one with the same state, and with parameters of the same ``layout_of``: then only the new
        parameters are packed.

    Raises
    ------
    TypeError
        if they contain something that compiled code can not receive.
    """

    type: PackedType
    arrays: Any

    def __new__(
        cls, design: Any, state: Any, before: PackedController | None = None
    ) -> PackedController:
        """Pack a controller."""
        kind = PackedType(type_of((design, state))) if before is None else before.type
        parameters = _words(kind.content[0], design)
        rest = _words(kind.content[1], state) if before is None else before[len(parameters) :]
        packed = super().__new__(cls, parameters + rest)
        packed.type, packed.arrays = kind, (design, state)  # keeps the arrays alive
        return packed


def _words(kind: Any, value: Any) -> bytes:
    """Return the words of a value of a Numba type."""
    formats: list[str] = []
    words: list[float] = []

    def add(kind: Any, value: Any) -> None:
        # Questions about a Numba type are slow; those about the value come first.
        if isinstance(value, tuple):
            for part, entry in zip(kind, value, strict=True):
                add(part, entry)
        elif type(kind) in (Constant, ConstantFlag):
            pass  # compiled code knows it
        elif type(kind) is SizedArray:
            formats.append("q")
            words.append(value.ctypes.data)
        elif isinstance(value, np.ndarray):
            formats.append("qqqqq" + 2 * value.ndim * "q")
            owners = (0, 0)  # nothing is counted
            words.extend((*owners, value.size, value.itemsize, value.ctypes.data))
            words.extend((*value.shape, *value.strides))
        elif kind is nb_types.float64:
            formats.append("d")
            words.append(value)
        elif kind is nb_types.float32:
            formats.append("f4x")
            words.append(value)
        elif isinstance(kind, nb_types.Integer | nb_types.Boolean):
            formats.append("Q")
            words.append(int(value) % 2**64)
        elif value is None:
            formats.append("q")
            words.append(0)
        else:
            raise TypeError(
                f"parameters or state contain {value!r}: must be numbers, arrays, or tuples of them"
            )

    add(kind, value)
    return struct.pack("".join(formats), *words)


@unbox(PackedType)
def _address(kind: Any, packed: Any, c: Any) -> Any:
    return NativeValue(c.pyapi.bytes_as_string(packed))


@intrinsic
def _unpacked(typing_context: Any, packed: Any) -> Any:
    """Return parameters and state of a packed controller."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        packer = context.get_arg_packer([packed.content])
        arguments = []
        for i, kind in enumerate(packer.argument_types):
            address = builder.gep(values[0], [context.get_constant(nb_types.intp, 8 * i)])
            arguments.append(builder.load(builder.bitcast(address, kind.as_pointer())))
        return packer.from_arguments(builder, arguments)[0]

    return packed.content(packed), generate


@compiled_call
def step_packed(packed: Any, r: float, y: float) -> float:
    """Take one sample; see ``controllers.base.control``."""
    design, state = _unpacked(packed)
    return control(design, state, r, y)


def entry_point(dispatcher: Any, packed: PackedController) -> Callable[[Any, float, float], float]:
    """Return the compiled function of ``dispatcher`` for controllers of one type.

    It checks its arguments less than the dispatcher: pass only packed controllers of this type, and
    numbers.
    """
    if dispatch.interpret_all:
        return _step_as_python
    compiled: Callable[[Any, float, float], float] = dispatcher.compile(
        (packed.type, nb_types.float64, nb_types.float64)
    )
    return compiled


def _step_as_python(packed: Any, r: float, y: float) -> float:
    design, state = packed.arrays
    with np.errstate(all="ignore"):  # compiled code does not warn
        return float(control(design, state, r, y))
