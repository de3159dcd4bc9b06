"""Learners that are Python objects, of those libraries that are installed."""

from __future__ import annotations

import functools
import importlib.util
import os
from typing import Any

import numpy as np

import quell as ql


class LeastMeanSquares:
    """The smallest model there is: linear, by normalised gradient descent."""

    def __init__(self, rate: float = 0.2) -> None:
        self.rate = rate
        self.theta = np.zeros(0)

    def learn(self, features: np.ndarray, targets: np.ndarray) -> None:
        """Go a step down for each pair."""
        if self.theta.size == 0:
            self.theta = np.zeros(features.shape[1])
        for row, target in zip(features, targets, strict=True):
            self.theta += self.rate * (target - self.theta @ row) * row / (1.0 + row @ row)

    def predict(self, features: np.ndarray) -> float:
        """Return θ·φ."""
        return float(self.theta @ features)


def has(*modules: str) -> bool:
    """Whether all of these can be imported; looks, but does not import."""
    return all(importlib.util.find_spec(module) is not None for module in modules)


def torch_mlp(hidden: int = 16) -> Any:
    """A small network, the same each time."""
    import torch

    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(2, hidden), torch.nn.Tanh(), torch.nn.Linear(hidden, 1)).double()


def jax_mlp(hidden: int = 16) -> Any:
    """A small network, the same each time."""
    import equinox
    import jax

    return equinox.nn.MLP(2, "scalar", hidden, 1, activation=jax.numpy.tanh, key=jax.random.key(0))


def python_learners() -> dict[str, Any]:
    """Return a learner for each library that is installed."""
    found: dict[str, Any] = {"PythonModel": ql.learners.PythonModel(LeastMeanSquares())}
    if has("sklearn"):
        from sklearn.linear_model import SGDRegressor
        from sklearn.neural_network import MLPRegressor

        found["SGDRegressor"] = ql.learners.SklearnModel(SGDRegressor(learning_rate="constant", eta0=0.05))
        mlp = MLPRegressor(hidden_layer_sizes=(16,), activation="tanh", solver="sgd", learning_rate_init=0.05, momentum=0.0)
        found["MLPRegressor"] = ql.learners.SklearnModel(mlp)
    if has("river"):
        from river import linear_model, optim, preprocessing

        pipeline = preprocessing.StandardScaler() | linear_model.LinearRegression(optimizer=optim.SGD(0.05))
        found["river pipeline"] = ql.learners.RiverModel(pipeline)
    if has("torch"):
        import torch

        found["torch MLP"] = ql.learners.TorchModel(torch_mlp(), functools.partial(torch.optim.SGD, lr=0.1))
    if has("jax", "equinox", "optax"):
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
        found["Equinox MLP"] = ql.learners.JaxModel(jax_mlp())
    return found
