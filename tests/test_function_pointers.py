"""Calls by address."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest

from quell.kernels import dispatch
from quell.kernels.user_functions import call, evaluate

pytestmark = pytest.mark.compiled

_POINTER = ctypes.POINTER(ctypes.c_double)
SEEN: list[tuple[int, float]] = []


@ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_double, _POINTER)
def write(count: int, value: float, array: Any) -> None:
    """Python behind an address: fill an array."""
    SEEN.append((count, value))
    for i in range(count):
        array[i] = value


@ctypes.CFUNCTYPE(ctypes.c_double, _POINTER, ctypes.c_double)
def times(array: Any, factor: float) -> float:
    """Return the first number times a factor."""
    return array[0] * factor


@dispatch.compiled
def both(writer: int, reader: int, room: np.ndarray) -> float:
    """Call one function that returns nothing and one that returns a number."""
    call(writer, room.size, 2.5, room)
    return evaluate(reader, room, 4.0)


@pytest.mark.parametrize("function", [both, dispatch.interpreted(both)])
def test_python_can_be_called_by_address_from_compiled_and_interpreted_code(function: Any) -> None:
    """Whole numbers, numbers and arrays arrive; a number comes back; the lock is taken where the loop has let it go."""
    addresses = [ctypes.cast(target, ctypes.c_void_p).value for target in (write, times)]
    room = np.zeros(3)
    SEEN.clear()
    assert function(*addresses, room) == 10.0
    np.testing.assert_array_equal(room, 2.5)
    assert SEEN == [(3, 2.5)]
