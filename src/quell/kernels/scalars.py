"""Named scalars of a state: an array of one record, read and written by name in compiled and in interpreted code.

::

    class Loop(Scalars):
        u: float                    # 0.0 at first
        samples: int

    class State(NamedTuple):
        loop: NDArray[Loop]

    state = State(Loop.zeros())
    state.loop[0].u = 1.0           # the same statement in a kernel and in Python
    loop = state.loop[0]            # refers to the record, does not copy it

Where all fields are floats, ``state.loop.view(np.float64)`` is the record as a vector. Fields may
have any names but those that Python itself needs of a NumPy scalar (``dtype``, ``view``, ``copy``
…).
"""

from __future__ import annotations

from operator import itemgetter
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

_DTYPES = {"float": np.float64, "int": np.int64}


class Scalars(np.void):  # type: ignore[misc]  # the stubs call it final, NumPy does not
    """Base class of a record; a subclass annotates its fields with ``float`` or ``int`` (64 bits), under postponed annotations."""

    def __init_subclass__(cls) -> None:
        # Properties, as np.record's own attribute access takes 2.5 times as long in an interpreted
        # loop.
        for name in cls.__annotations__:
            setattr(cls, name, _field(name))

    @classmethod
    def zeros(cls) -> NDArray[Self]:
        """Return an array (1,) whose record is zero in all fields."""
        fields = [(name, _DTYPES[kind]) for name, kind in cls.__annotations__.items()]
        return np.zeros(1, np.dtype((cls, fields)))


def _field(name: str) -> property:
    def write(record: Any, value: float) -> None:
        record[name] = value

    return property(itemgetter(name), write)
