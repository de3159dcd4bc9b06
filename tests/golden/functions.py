"""Functions and models of users that cases name: they stay as they are."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell.learners.online import infer, learn


def pendulum(t: float, x: Any, u: float, w: Any) -> tuple[float, float]:
    """Return the derivatives of a pendulum with a torque and a disturbance."""
    return x[1], u + w[0] - math.sin(x[0]) - 0.1 * x[1]


def swing(
    t: float, x: Any, u: float, w: Any, m: float, friction: Any, length: float = 0.5
) -> tuple[float, float]:
    """Return the derivatives of a pendulum with parameters."""
    return x[1], (u + w[0]) / (m * length) - math.sin(x[0]) - friction[1] * x[1] - friction[0]


def mixed(x: Any, gain: float, rows: Any) -> float:
    """Return an output with parameters."""
    value: float = gain * x[0] + rows[1, 0] * x[1] + rows[0, 2]
    return value


def tanks(t: float, x: Any, u: Any, w: Any) -> tuple[float, float, float, float]:
    """Return the derivatives of two masses that a spring and a cross gain couple."""
    pull = x[0] - x[2]
    return (
        x[1],
        u[0] + 0.3 * u[1] - pull - 0.2 * x[1] + w[0],
        x[3],
        0.2 * u[0] + u[1] + pull - 0.1 * x[3] * abs(x[3]),
    )


def places(x: Any) -> tuple[float, float]:
    """Return the positions of ``tanks``."""
    return x[0], x[2]


def products(x: Any, u: float) -> tuple[float, float]:
    """Return two features of one axis."""
    return x[0] * x[1], u * x[1]


def squared(x: Any, u: float) -> tuple[float]:
    """Return a feature of an axis of any order."""
    return (x[0] * abs(x[0]),)


def of_all(x: Any, u: Any) -> tuple[float]:
    """Return a feature of two axes of order 2."""
    return (x[0] * x[3],)


def wide_gain(x: Any) -> Any:
    """Return B0 of two axes with three actuators."""
    c = 0.2 * x[1, 0] / (1.0 + x[1, 0] * x[1, 0])
    return (1.0, c, 0.3), (c, 0.5, -0.3)


def square_gain(x: Any) -> Any:
    """Return B0 of two axes that depends on a position."""
    c = 0.3 / (1.0 + x[1, 0] * x[1, 0])
    if x[0, 0] > 0.3:
        return (1.2, c), (0.2, 0.9)
    return (1.0, c), (0.2, 1.0)


def mass_matrix(x: Any) -> Any:
    """Return M of two axes as an array."""
    c = 0.2 * math.cos(x[1, 0])
    return np.array([[1.0, c], [c, 0.5 + x[0, 1] ** 2]])


def mass_of(x: Any, inertia: float, arms: Any, coupling: Any) -> Any:
    """Return M of two axes with a number, a vector and a matrix as parameters."""
    c = coupling[0, 1] * math.cos(x[1, 0])
    d = coupling[1, 0] * math.cos(x[1, 0])
    return (inertia + arms[0] ** 2, c), (d, 0.5 * inertia + arms[1] ** 2 + coupling[1, 1])


def sometimes_singular(x: Any) -> Any:
    """Return B0 that has no inverse, or no number, at some places."""
    if x[0, 0] > 0.1:
        return (1.0, 1.0), (1.0, 1.0)
    if x[0, 0] < -0.1:
        return (math.nan, 0.0), (0.0, 1.0)
    return (1.0, 0.1), (0.1, 1.0)


class LeakyDesign(NamedTuple):
    """Parameters of a model of a user."""

    size: int
    gain: float


class LeakyMemory(NamedTuple):
    """Its state."""

    weights: Any
    last: Any


class Leaky:
    """A model as a user would write it: a leaky normalised gradient step."""

    def design(self, features: int, dt: float) -> LeakyDesign:
        """Return the parameters."""
        return LeakyDesign(features, dt)

    def memory(self, parameters: LeakyDesign) -> LeakyMemory:
        """Return the state."""
        return LeakyMemory(np.zeros(parameters.size), np.zeros((1, 2)))


@infer.register(LeakyDesign)
def _infer(model: LeakyDesign, memory: LeakyMemory, features: Any) -> float:
    total = 0.0
    for i in range(model.size):
        total += memory.weights[i] * features[i]
    return total


@learn.register(LeakyDesign)
def _learn(model: LeakyDesign, memory: LeakyMemory, features: Any, target: float) -> None:
    error, power = target - infer(model, memory, features), 1.0
    for i in range(model.size):
        power += features[i] * features[i]
    for i in range(model.size):
        memory.weights[i] += model.gain * (error * features[i] / power - 1e-3 * memory.weights[i])
    memory.last[0, 0] = error


class RunningMean:
    """A model that is a Python object: the running mean of the targets."""

    def __init__(self, share: float = 0.02) -> None:
        self.share, self.mean = share, 0.0

    def learn(self, features: Any, targets: Any) -> None:
        """Take some targets."""
        for target in targets:
            self.mean += self.share * (float(target) - self.mean)

    def predict(self, features: Any) -> float:
        """Return the mean."""
        return self.mean


FUNCTIONS = {
    each.__name__: each
    for each in (
        pendulum, swing, mixed, tanks, places, products, squared, of_all, wide_gain, square_gain,
        mass_matrix, mass_of, sometimes_singular,
    )
}  # fmt: skip
"""The functions, by the name in recipes."""
