"""Many states of one layout, one after the other in memory, for a compiled loop over them.

A state is a NamedTuple of arrays. Compiled code gets the first one and the distance to the next;
``member`` then moves the addresses of all its arrays, so that nothing is copied, and the shapes
stay constants (``kernels/sized.py``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import cgutils
from numba.core import types as nb_types
from numba.extending import intrinsic, overload

from quell.kernels.linking import KERNEL_OPTIONS, OPTIONS

_ALIGNMENT = 8  # bytes, of each array
_LINE = 64  # bytes of a line of the processor's cache: two threads never write into the same one


class Stacked:
    """Copies of a NamedTuple, or of several of one layout, in one block of memory.

    Parameters
    ----------
    values
        the NamedTuples; their arrays have equal shapes and types. Numbers in them are not copied.
    """

    def __init__(self, values: list[Any]) -> None:
        self._sizes: list[int] = []
        self._layout(values[0])
        self.stride = -(-sum(self._sizes) // _LINE) * _LINE or _LINE
        block = np.zeros(len(values) * self.stride + _LINE, np.uint8)
        start = -block.ctypes.data % _LINE
        self.memory = block[start : start + len(values) * self.stride].reshape(len(values), -1)
        self.members = [self._view(value, i) for i, value in enumerate(values)]

    def _layout(self, value: Any) -> None:
        if isinstance(value, np.ndarray):
            self._sizes.append(-(-value.nbytes // _ALIGNMENT) * _ALIGNMENT)
        elif isinstance(value, tuple):
            for part in value:
                self._layout(part)

    def _view(self, value: Any, i: int) -> Any:
        """Return a copy of the value in row i of the memory."""
        place = 0

        def copy(part: Any) -> Any:
            nonlocal place
            if isinstance(part, np.ndarray):
                size = -(-part.nbytes // _ALIGNMENT) * _ALIGNMENT
                block = self.memory[i, place : place + part.nbytes]
                place += size
                if part.nbytes == 0:
                    return part.copy()
                there = block.view(part.dtype).reshape(part.shape)
                there[...] = part
                return there
            if isinstance(part, tuple):
                parts = [copy(entry) for entry in part]
                return type(part)(*parts) if hasattr(part, "_fields") else tuple(parts)
            return part

        return copy(value)


def member(first: Any, stride: int, i: int) -> Any:
    """Return member ``i`` of a stack, ``stride`` bytes each.

    ``first`` is the first one for compiled code, and the list of all for Python. A list of one, or
    a stride of zero, stands for members that are all the same.
    """
    return first[i if stride else 0]


@overload(member, strict=False, jit_options=OPTIONS | KERNEL_OPTIONS)
def _compiled_member(first: Any, stride: Any, i: Any) -> Any:
    return lambda first, stride, i: _moved(first, stride * i)


@intrinsic
def _moved(typing_context: Any, first: Any, shift: Any) -> Any:
    """Return a tuple whose arrays lie ``shift`` bytes behind those of ``first``."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        def move(kind: Any, value: Any) -> Any:
            if isinstance(kind, nb_types.BaseTuple):
                parts = [move(part, builder.extract_value(value, j)) for j, part in enumerate(kind)]
                return context.make_tuple(builder, kind, parts)
            if isinstance(kind, nb_types.Array):
                array = context.make_array(kind)(context, builder, value)
                place = cgutils.pointer_add(builder, array.data, values[1])
                array.data = builder.bitcast(place, array.data.type)
                return array._getvalue()
            return value

        return move(first, values[0])

    return first(first, nb_types.intp), generate
