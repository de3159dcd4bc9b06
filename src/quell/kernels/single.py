"""Parameters and states in single precision: the same NamedTuples with ``np.float32`` inside.

Sums that lose nothing to rounding (Kahan, *Communications of the ACM* 8, 1965).

In single precision a small increment loses most of its digits when it is added to a large number,
or all of them. Here what rounding takes is carried over to the next sample, in a second half of the
array: the sum is as good as one of twice the digits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel
from quell.kernels.functions import is_single
from quell.kernels.sized import remade, single_dtype
from quell.types import Matrix, Vector

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
        return remade(value, parts)
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


@kernel
def add_with_carry(values: Vector, count: int, i: int, increment: float) -> None:
    """Add to entry ``i`` of ``count`` an increment with its carry, ``values[count + i]``, in it."""
    before = values[i]
    values[i] = before + increment
    values[count + i] = increment - (values[i] - before)


@kernel
def add_small(values: Vector, count: int, i: int, increment: float) -> None:
    """Add an increment to entry ``i``: in double precision (count,), else with carries (2 count,).

    For averages that move by so little in a sample that rounding would stop them.
    """
    if is_single(values[i]):
        add_with_carry(values, count, i, increment + values[count + i])
    else:
        values[i] += increment


@kernel
def add_symmetrically(matrix: Matrix, i: int, j: int, increment: float) -> None:
    """Add to entry (i, j), j <= i, of a symmetric matrix (p, p), or with carries of one (p, p + 1).

    With carries the lower triangle has the entries, and what is above has the carries, that of
    (i, j) at (j, i + 1). All entries have one: if the diagonal alone went on where the rest stands
    still, a covariance would become indefinite.
    """
    if matrix.shape[1] > matrix.shape[0]:
        before = matrix[i, j]
        increment += matrix[j, i + 1]
        matrix[i, j] = before + increment
        matrix[j, i + 1] = increment - (matrix[i, j] - before)
    else:
        matrix[i, j] += increment
