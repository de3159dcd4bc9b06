"""Tests of named scalars: the same source reads them by name, compiled and interpreted."""

from __future__ import annotations

import copy
import pickle
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from quell.controllers.stateful import named_arrays
from quell.kernels.dispatch import compiled, interpreted
from quell.kernels.sized import Scalars, clear

pytestmark = pytest.mark.compiled


class Motion(Scalars):
    """Two floats, one of which has the name of a NumPy attribute."""

    position: float
    size: float


class Counters(Scalars):
    """A float beside an integer."""

    total: float
    samples: int


class State(NamedTuple):
    """A state with both."""

    motion: NDArray[Motion]
    counters: NDArray[Counters]


@compiled
def advance(state: State, step: float) -> float:
    """Change all fields; return one of them."""
    motion, counters = state.motion[0], state.counters[0]
    motion.position += step
    motion.size = 2.0 * motion.position
    counters.total += motion.size
    counters.samples += 1
    return motion.size


@compiled
def cleared(state: State) -> None:
    """Clear the record of floats."""
    clear(state.motion)


def test_compiled_and_interpreted_code_read_and_write_the_same_fields() -> None:
    """Both change the arrays in place, and alike; integers remain integers."""
    states = [State(Motion.zeros(), Counters.zeros()) for _ in range(2)]
    for state, function in zip(states, (advance, interpreted(advance)), strict=True):
        assert function(state, 0.1) == 0.2
        assert function(state, 0.3) == 0.8
        assert (state.motion[0].position, state.motion[0].size) == (0.4, 0.8)
        assert (state.counters[0].total, state.counters[0].samples) == (1.0, 2)
        assert isinstance(state.counters[0].samples, np.int64)
    for state, function in zip(states, (cleared, interpreted(cleared)), strict=True):
        function(state)
        assert state.motion.tolist() == [(0.0, 0.0)]


def test_a_record_of_floats_is_saved_as_a_vector_and_can_be_copied() -> None:
    """The vector shares the record's memory; copies and pickles keep the names."""
    motion = Motion.zeros()
    vector = named_arrays(State(motion, motion))["motion"]
    assert vector.dtype == np.float64
    vector[:] = 1.5, 2.5
    for kept in (motion, motion.copy(), copy.deepcopy(motion), pickle.loads(pickle.dumps(motion))):
        assert (kept[0].position, kept[0].size) == (1.5, 2.5)
