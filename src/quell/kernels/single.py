"""Parameters and states in single precision: the same NamedTuples with ``np.float32`` inside."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.kernels.scalars import single_dtype

_LARGEST, _SMALLEST = (float(getattr(np.finfo(np.float32), name)) for name in ("max", "tiny"))


def in_single(value: Any, name: str = "") -> Any:
    """Return a nested NamedTuple with its floats, arrays and records rounded to single precision.

    Integers, flags and all else stay as they are. Arrays that share memory still do so. Entries of
    arrays that are too small become zero: beside the others they have no effect.

    Parameters
    ----------
    value
        numbers, arrays, or tuples of them at any depth.
    name
        what it is called in errors.

    Raises
    ------
    ValueError
        for a finite number whose size is above 3.4e38, and for a single one below 1.2e-38; the
        message has its dotted name.
    """
    return _rounded(value, name, {})


def _rounded(value: Any, name: str, owners: dict[int, Any]) -> Any:
    if isinstance(value, tuple):
        fields = getattr(value, "_fields", range(len(value)))
        parts = [
            _rounded(part, f"{name}.{field}" if name else f"{field}", owners)
            for field, part in zip(fields, value, strict=True)
        ]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, np.ndarray):
        return _rounded_array(value, name, owners)
    if isinstance(value, float):  # np.float64 is one, np.float32 is not
        _check_range(abs(value), value, name)
        if 0.0 < abs(value) < _SMALLEST:
            raise ValueError(f"{name} = {value!r}: below the range of single precision, 1.2e-38")
        return np.float32(value)
    return value


def _rounded_array(array: NDArray[Any], name: str, owners: dict[int, Any]) -> NDArray[Any]:
    """Return the rounded array; a view becomes a view of the rounded owner of its memory."""
    if array.dtype != np.float64 and array.dtype.names is None:
        return array
    owner: Any = array
    while isinstance(owner.base, np.ndarray):
        owner = owner.base
    if owner.dtype != array.dtype:
        owner = array
    if id(owner) not in owners:  # the second entry keeps the owner, and so its number
        owners[id(owner)] = _rounded_values(owner, name), owner
    rounded: NDArray[Any] = owners[id(owner)][0]
    if owner is array:
        return rounded
    offset = (array.ctypes.data - owner.ctypes.data) // 2
    steps = tuple(step // 2 for step in array.strides)
    view: NDArray[Any] = np.ndarray(array.shape, rounded.dtype, rounded, offset, steps)
    view.flags.writeable = array.flags.writeable
    return view


def _rounded_values(array: NDArray[Any], name: str) -> NDArray[Any]:
    if array.dtype.names is not None:
        rounded = np.zeros(array.shape, single_dtype(array.dtype))
        for field in array.dtype.names:
            rounded[field] = array[field]
        return rounded
    if array.size:
        largest = float(np.max(np.abs(np.where(np.isfinite(array), array, 0.0))))
        _check_range(largest, largest, f"the largest entry of {name}")
    with np.errstate(under="ignore", over="ignore"):
        rounded = array.astype(np.float32)
    rounded[np.abs(rounded) < _SMALLEST] = 0.0  # arithmetic with denormal numbers is slow
    rounded.flags.writeable = array.flags.writeable
    return rounded


def _check_range(size: float, value: float, name: str) -> None:
    if _LARGEST < size < np.inf:
        raise ValueError(f"{name} = {value!r}: above the range of single precision, 3.4e38")
