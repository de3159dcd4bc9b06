"""Selection of the states that a block of features uses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quell import checks

StateIndices = NDArray[np.int64]


def check_states(states: Sequence[int] | None) -> None:
    """Raise a ``ValueError`` unless ``states`` is None or a tuple of different numbers from 1."""
    if states is None:
        return
    if not isinstance(states, tuple | list) or len(states) == 0:
        rule = "must be a tuple of the numbers of states, for example (1, 2)"
        raise ValueError(f"states = {states!r}: {rule}")
    for i, state in enumerate(states):
        checks.whole(f"states[{i}]", state, 1)
    if len(set(states)) < len(states):
        raise ValueError(f"states = {states!r}: must not repeat a state")


def state_indices(
    states: Sequence[int] | None, order: int, default: int | None = None
) -> StateIndices:
    """Return the indices (k,) of ``states`` in x; by default the first ``default``, or all."""
    if states is None:
        return np.arange(order if default is None else min(order, default))
    if max(states) > order:
        rule = f"a plant of order {order} has no state {max(states)}"
        raise ValueError(f"states = {states!r}: {rule}")
    return np.array(states, dtype=np.int64) - 1
