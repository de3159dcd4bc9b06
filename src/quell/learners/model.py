"""The contract of a model: what one has to write to bring a learner of one's own.

A model predicts a number from features and learns from pairs (features, target). It is a NamedTuple of parameters, a NamedTuple of arrays
for its state, and two functions registered for the type of the parameters. Features and target are O(1); lag, scaling and the loop are
the business of ``Online`` (``online.py``), which makes a learner of a model.
"""

from __future__ import annotations

from typing import Any, Protocol

from quell.dispatch import generic
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
