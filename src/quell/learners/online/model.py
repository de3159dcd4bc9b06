"""The contract of a model: what one has to write to bring a learner of one's own.

A model predicts a number from features and learns from pairs (features, target). It is a NamedTuple of parameters, a NamedTuple of arrays
for its state, and two functions registered for the type of the parameters. Features and target are O(1); lag, scaling and the loop are
the business of ``Online`` (``online.py``), which makes a learner of a model.
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
        """Return the parameters (a NamedTuple) for so many features and a sample time [s]."""

    def memory(self, parameters: Any) -> Any:
        """Return the state before anything was learned: a NamedTuple of arrays."""


@generic
def infer(model: Any, memory: Any, features: Vector) -> float:
    """Return what the model predicts for ``features`` (p,); changes nothing but room for calculation."""
    raise TypeError


@generic
def learn(model: Any, memory: Any, features: Vector, target: float) -> None:
    """Learn from a pair of ``features`` (p,) and ``target``; the state must stay bounded whatever they are."""
    raise TypeError


def validated_design(model: Any, features: int, dt: float) -> Any:
    """Return ``model.design(features, dt)``; a model of the user's own has to infer and learn once, interpreted, on a memory of its own.

    Raises
    ------
    ValueError
        that names the model's class and the rule, for whatever is wrong.
    """
    if not validation.is_user_defined(model):
        return model.design(features, dt)
    name, rule = (
        type(model).__name__,
        f"it is shown {features} features, of shape ({features},), and learns and predicts one number",
    )
    what = f"{name}.design({features}, {dt:g})"
    parameters = validation.check_named_tuple(
        what,
        validation.attempt(what, "design takes (features, dt)", model.design, features, dt),
        "numbers and arrays",
    )
    validation.check_registered(name, parameters, infer, learn)
    validation.check_arrays(
        f"{name}.memory",
        validation.attempt(
            f"{name}.memory(...)", "memory takes (parameters)", model.memory, parameters
        ),
        nested=False,
    )
    memory = packed(model.memory(parameters))[0]
    for i in range(3):
        shown = validation.sample_values(features, 1.0 + i)
        predicted = validation.attempt_kernel(
            f"{name}: infer", rule, infer, parameters, memory, shown
        )
        if predicted is not validation.UNKNOWN:
            validation.check_number(f"{name}: infer", predicted)
        validation.attempt_kernel(f"{name}: learn", rule, learn, parameters, memory, shown, 0.5)
    return parameters


def packed(memory: Any) -> tuple[Any, Vector]:
    """Return a copy of a NamedTuple of arrays whose arrays all lie in one, and that one."""
    arrays = [np.asarray(array, dtype=np.float64) for array in memory]
    flat = np.concatenate([array.ravel() for array in arrays]) if arrays else np.zeros(0)
    places = np.cumsum([0, *(array.size for array in arrays)])
    views = [
        flat[start : start + array.size].reshape(array.shape)
        for start, array in zip(places, arrays, strict=False)
    ]
    return type(memory)(*views), flat
