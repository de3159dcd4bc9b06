"""Whether arguments of a compiled loop share memory that the loop changes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np

_Use: TypeAlias = tuple[np.ndarray, bool]  # an array, and whether it is written to


def overlap(arguments: Sequence[Any], written: Sequence[int]) -> bool:
    """Return whether an array in the arguments at the indices ``written`` overlaps another array.

    NamedTuples are searched at any depth.
    """
    by_owner: dict[int | None, list[_Use]] = defaultdict(list)
    for i, argument in enumerate(arguments):
        for array in _arrays(argument):
            owner = array if array.base is None else array.base
            # Arrays with different owners are apart. What memory other objects own is unknown.
            key = id(owner) if isinstance(owner, np.ndarray) else None
            by_owner[key].append((array, i in written))
    if None in by_owner:
        by_owner = {None: [use for group in by_owner.values() for use in group]}
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


def _arrays(value: Any) -> Iterator[np.ndarray]:
    if isinstance(value, np.ndarray):
        if value.size:
            yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from _arrays(part)
