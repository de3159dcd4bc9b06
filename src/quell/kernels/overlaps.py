"""Check whether arguments of a compiled loop share memory that the loop changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

Arrays: TypeAlias = Sequence[np.ndarray]


def overlap(read: Arrays, written: Arrays) -> bool:
    """Return whether an array that is written overlaps another one."""
    owners = [_owner(array) for array in written]
    if None not in owners and len({*owners}) == len(owners):
        others = {_owner(array) for array in read}
        if None not in others and others.isdisjoint(owners):
            return False  # arrays with different owners are apart
    bounds = [(*np.lib.array_utils.byte_bounds(array), False) for array in read]
    bounds += [(*np.lib.array_utils.byte_bounds(array), True) for array in written]
    end, last_is_written = -1, False  # of the arrays so far, the one that ends last
    for first, after, is_written in sorted(bounds):
        if first < end and (is_written or last_is_written):
            return True
        if after > end:
            end, last_is_written = after, is_written
    return False


def _owner(array: Any) -> int | None:
    """Return the identity of the array that owns the memory; None if that is another object."""
    base = array.base
    return id(array) if base is None else id(base) if type(base) is np.ndarray else None
