"""Named scalars of a state: an array of one record, read by name in compiled and interpreted code.

::

    class Loop(Scalars):
        u: float
        samples: int

    class State(NamedTuple):
        loop: NDArray[Loop]

    state = State(Loop.zeros())
    state.loop[0].u = 1.0           # the same statement in a kernel and in Python
    loop = state.loop[0]            # refers to the record, does not copy it

If all fields are floats, ``state.loop.view(np.float64)`` is the record as a vector; the saved state
of a controller uses that. ``single_dtype`` is the same record in single precision. A field must not
have the name of an attribute that NumPy needs (``dtype``, ``view``, ``copy`` …).
"""

from __future__ import annotations

from operator import itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numba.core import cgutils
from numba.core import types as nb_types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from quell.kernels.linking import KERNEL_OPTIONS, OPTIONS

if TYPE_CHECKING:
    _Record = np.generic  # NumPy's stubs forbid subclasses of np.void, NumPy itself does not
else:
    _Record = np.void

_DTYPES = {"float": np.float64, "int": np.int64}


class Scalars(_Record):
    """Base class of a record; a subclass annotates its fields with ``float`` or ``int`` (64 bits).

    Annotations must be postponed (``from __future__ import annotations``).
    """

    _dtype: ClassVar[np.dtype[Any]]

    def __init_subclass__(cls) -> None:
        # With np.record instead of these properties, interpreted loops take up to twice as long.
        for name in cls.__annotations__:
            setattr(cls, name, _field(name))
        fields = [(name, _DTYPES[kind]) for name, kind in cls.__annotations__.items()]
        cls._dtype = np.dtype((cls, fields))

    @classmethod
    def zeros(cls) -> NDArray[Self]:
        """Return an array (1,) whose record is zero in all fields."""
        return np.zeros(1, cls._dtype)


def _field(name: str) -> property:
    def write(record: Any, value: float) -> None:
        record[name] = value

    return property(itemgetter(name), write)


def single_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of the same record with its floats in single precision."""
    names = dtype.names or ()
    kinds = {name: np.float32 if dtype[name] == np.float64 else dtype[name] for name in names}
    return np.dtype((dtype.type, list(kinds.items())))


def clear(scalars: NDArray[Any]) -> None:
    """Set all fields of a record to zero."""
    scalars.view(np.uint8)[:] = 0


# Numba compiles a view of a record as float64 in 0.2 s; this takes a millisecond.
@overload(clear, strict=False, jit_options=OPTIONS | KERNEL_OPTIONS)
def _clear(scalars: Any) -> Any:
    return lambda scalars: _set_to_zero(scalars)


@intrinsic
def _set_to_zero(typing_context: Any, scalars: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        array = context.make_array(scalars)(context, builder, values[0])
        size = context.get_constant(nb_types.intp, scalars.dtype.size)
        cgutils.memset(builder, array.data, size, 0)
        return context.get_dummy_value()

    return nb_types.void(scalars), generate
