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

If all fields are floats, ``state.loop.view(np.float64)`` is the record as a vector; ``clear`` and
the saved state of a controller use that. A field must not have the name of an attribute that NumPy
needs (``dtype``, ``view``, ``copy`` …).
"""

from __future__ import annotations

from operator import itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel

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


@kernel
def clear(scalars: NDArray[Any]) -> None:
    """Set all fields of a record of floats to zero."""
    values = scalars.view(np.float64)
    for i in range(values.size):
        values[i] = 0.0
