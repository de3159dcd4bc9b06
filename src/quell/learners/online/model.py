"""The contract of a model, from which ``Online`` makes a learner.

A model predicts a number from features and learns from pairs (features, target). It is a NamedTuple
of parameters, a NamedTuple of arrays as its state, and two functions that are registered for the
type of the parameters. Features and target are O(1); lag, scaling and the loop are the task of
``Online`` (``learner.py``).
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from quell.kernels import validation
from quell.kernels.dispatch import generic
from quell.types import Vector


class Model(Protocol):
    """A description of a model."""

    def design(self, features: int, dt: float) -> Any:
        """Return the parameters (a NamedTuple) for the number of features and a sample time [s]."""

    def memory(self, parameters: Any) -> Any:
        """Return the state before anything is learned (a NamedTuple of arrays)."""


@generic
def infer(model: Any, memory: Any, features: Vector) -> float:
    """Return the prediction for ``features`` (p,); change nothing but work space."""
    raise TypeError


@generic
def learn(model: Any, memory: Any, features: Vector, target: float) -> None:
    """Learn from ``features`` (p,) and ``target``; the state must stay bounded for any values."""
    raise TypeError


def checked_design(model: Model, features: int, dt: float) -> Any:
    """Return ``model.design(features, dt)``; check a user-defined model first.

    The model has to infer and learn, interpreted, on a memory that is discarded.
    """
    if not validation.is_user_defined(model):
        return model.design(features, dt)
    name = type(model).__name__
    rule = f"it is shown {features} features, of shape ({features},), and predicts one number"
    what = f"{name}.design({features}, {dt:g})"
    parameters = validation.attempt(what, "design takes (features, dt)", model.design, features, dt)
    validation.check_named_tuple(what, parameters, "numbers and arrays")
    validation.check_registered(name, parameters, infer, learn)
    what = f"{name}.memory(...)"
    memory = validation.attempt(what, "memory takes (parameters)", model.memory, parameters)
    validation.check_arrays(f"{name}.memory", memory, nested=False)
    memory = packed(memory)[0]
    for i in range(3):
        shown = validation.sample_values(features, 1.0 + i)
        what = f"{name}: infer"
        predicted = validation.attempt_kernel(what, rule, infer, parameters, memory, shown)
        if predicted is not validation.UNKNOWN:
            validation.check_number(what, predicted)
        validation.attempt_kernel(f"{name}: learn", rule, learn, parameters, memory, shown, 0.5)
    return parameters


def packed(memory: Any) -> tuple[Any, Vector]:
    """Return a copy of a NamedTuple of arrays as views of one flat array, and that array."""
    arrays = [np.asarray(array, dtype=np.float64) for array in memory]
    flat = np.concatenate([array.ravel() for array in arrays]) if arrays else np.zeros(0)
    ends = np.cumsum([array.size for array in arrays])
    places = zip(ends, arrays, strict=True)
    views = [flat[end - array.size : end].reshape(array.shape) for end, array in places]
    return type(memory)(*views), flat
