"""Whether arguments of a compiled loop share memory that the loop changes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np

_Use: TypeAlias = tuple[np.ndarray, bool]  # an array, and whether it is written to


def overlap(arguments: Sequence[Any], written: Sequence[int]) -> bool:
    """Return whether an array in the arguments at the indices ``written`` overlaps another array.

    NamedTuples are searched at any depth.
    """
    arrays = _arrays(arguments, [])
    owners = [array if array.base is None else array.base for array in arrays]
    # Arrays with different owners are apart. What memory other objects own is unknown.
    known = all(isinstance(owner, np.ndarray) for owner in owners)
    if known and len(set(map(id, owners))) == len(owners):
        return False
    by_owner: dict[int, list[_Use]] = defaultdict(list)
    changed = {id(array) for array in _arrays([arguments[i] for i in written], [])}
    for array, owner in zip(arrays, owners, strict=True):
        by_owner[id(owner) if known else 0].append((array, id(array) in changed))
    return any(_overlap(group) for group in by_owner.values() if len(group) > 1)


def _overlap(uses: list[_Use]) -> bool:
    """Compare the bounds of arrays in the order of their addresses."""
    end, last_is_written = -1, False  # of the arrays so far, the one that ends last
    bounds = [(*np.lib.array_utils.byte_bounds(array), written) for array, written in uses]
    for first, after, written in sorted(bounds):
        if first < end and (written or last_is_written):
            return True
        if after > end:
            end, last_is_written = after, written
    return False


def _arrays(values: Iterable[Any], found: list[np.ndarray]) -> list[np.ndarray]:
    """Append the arrays that are not empty to ``found``, and return it."""
    for value in values:
        if isinstance(value, tuple):
            _arrays(value, found)
        elif isinstance(value, np.ndarray) and value.size:
            found.append(value)
    return found
