"""Learners that are Python objects, of those libraries that are installed."""

from __future__ import annotations

import functools
import importlib.util
import os
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

import quell as ql

HARD_SPRING = ql.plants.NonlinearPlant(
    lambda t, x, u, w: (x[1], u + w[0] - 6.0 * x[0] - 8.0 * x[0] ** 3 - 1.5 * x[1] * abs(x[1])),
    order=2,
    name="hard spring",
)
CHAIN = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
OBSERVER = ql.ESO.model_free(order=2, b0=1.0, omega_o=15.0, dt=5e-3)
SHORT = ql.Scenario(reference=ql.signals.Sinusoid(omega=1.5), duration=4.0, rest_at=(2.0,))


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


class Sleeper(LeastMeanSquares):
    """A model that takes its time."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds = seconds

    def predict(self, features: np.ndarray) -> float:
        """Sleep, then return θ·φ."""
        time.sleep(self.seconds)
        return super().predict(features)


class Broken(LeastMeanSquares):
    """A model that does well for some calls, and then what it is told."""

    def __init__(self, well: int, then: Any) -> None:
        super().__init__()
        self.well, self.then, self.calls = well, then, 0

    def predict(self, features: np.ndarray) -> Any:
        """Return θ·φ, or do what it was told."""
        self.calls += 1
        if self.calls <= self.well:
            return super().predict(features)
        if isinstance(self.then, BaseException):
            raise self.then
        return self.then


class Counter(LeastMeanSquares):
    """A model that writes down what it is called with."""

    def __init__(self) -> None:
        super().__init__()
        self.batches: list[int] = []

    def learn(self, features: np.ndarray, targets: np.ndarray) -> None:
        """Learn, and take note of the batch."""
        self.batches.append(len(targets))
        super().learn(features, targets)


def has(*modules: str) -> bool:
    """Whether all of these can be imported; looks, but does not import."""
    return all(importlib.util.find_spec(module) is not None for module in modules)


def torch_mlp(hidden: int = 16) -> Any:
    """A small network, the same each time."""
    import torch

    torch.manual_seed(0)
    return torch.nn.Sequential(
        torch.nn.Linear(2, hidden), torch.nn.Tanh(), torch.nn.Linear(hidden, 1)
    ).double()


def jax_mlp(hidden: int = 16) -> Any:
    """A small network, the same each time."""
    import equinox
    import jax

    return equinox.nn.MLP(2, "scalar", hidden, 1, activation=jax.numpy.tanh, key=jax.random.key(0))


class OnDemand(Mapping[str, Any]):
    """Examples by name, each made when it is first asked for: to collect tests imports no library."""

    def __init__(self, makers: dict[str, Callable[[], Any]]) -> None:
        self._makers = makers
        self._made: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._made:
            self._made[name] = self._makers[name]()
        return self._made[name]

    def __contains__(self, name: object) -> bool:
        return name in self._makers

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


def _sgd_regressor() -> Any:
    from sklearn.linear_model import SGDRegressor

    return ql.learners.SklearnModel(SGDRegressor(learning_rate="constant", eta0=0.05))


def _mlp_regressor() -> Any:
    from sklearn.neural_network import MLPRegressor

    mlp = MLPRegressor(
        hidden_layer_sizes=(16,),
        activation="tanh",
        solver="sgd",
        learning_rate_init=0.05,
        momentum=0.0,
    )
    return ql.learners.SklearnModel(mlp)


def _river_pipeline() -> Any:
    from river import linear_model, optim, preprocessing

    pipeline = preprocessing.StandardScaler() | linear_model.LinearRegression(
        optimizer=optim.SGD(0.05)
    )
    return ql.learners.RiverModel(pipeline)


def _torch_mlp() -> Any:
    import torch

    return ql.learners.TorchModel(torch_mlp(), functools.partial(torch.optim.SGD, lr=0.1))


def _equinox_mlp() -> Any:
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    return ql.learners.JaxModel(jax_mlp())


def python_learners() -> OnDemand:
    """Return a learner for each library that is installed."""
    found: dict[str, Callable[[], Any]] = {
        "PythonModel": lambda: ql.learners.PythonModel(LeastMeanSquares())
    }
    if has("sklearn"):
        found |= {"SGDRegressor": _sgd_regressor, "MLPRegressor": _mlp_regressor}
    if has("river"):
        found["river pipeline"] = _river_pipeline
    if has("torch"):
        found["torch MLP"] = _torch_mlp
    if has("jax", "equinox", "optax"):
        found["Equinox MLP"] = _equinox_mlp
    return OnDemand(found)


def law(learner: Any, **options: Any) -> ql.ADRC:
    """A controller for a plant of order two."""
    return ql.ADRC(OBSERVER, omega_c=4.0, learner=learner, **options)
