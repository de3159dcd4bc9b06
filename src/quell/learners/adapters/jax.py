"""Equinox modules, trained by an optax optimiser, as learners."""

from __future__ import annotations

import functools
from typing import Any, Unpack

import numpy as np

from quell import checks
from quell.learners.adapters.python import Options, PythonModel, check_methods
from quell.optional import import_extra
from quell.types import Matrix, Vector


class JaxModel(PythonModel):
    """A learner whose model is an Equinox module.

    It is trained by gradient steps on the mean squared error of each batch. JAX compiles the steps
    in the trial, before the loop runs.

    Parameters
    ----------
    module
        takes an array (p,) and returns a number, or an array (1,), for example
        ``equinox.nn.MLP(2, "scalar", 16, 1, key=jax.random.key(0))``.
    optimizer
        an optax optimiser; ``optax.sgd(0.1)`` by default (see ``TorchModel`` on Adam).
    steps
        gradient steps on each batch.
    **options
        ``features``, ``period``, ``budget``, ``frequency``, ``scale``: see ``PythonModel``.

    Raises
    ------
    ImportError
        if JAX, Equinox or optax is missing.
    ValueError
        for an object that is no module or no optimiser, and as ``PythonModel``.
    """

    def __init__(
        self, module: Any, optimizer: Any = None, *, steps: int = 1, **options: Unpack[Options]
    ) -> None:
        _needed("jax")
        equinox, optax = _needed("equinox"), _needed("optax")
        if not (isinstance(module, equinox.Module) and callable(module)):
            rule = "must be an equinox.Module that takes an array (p,)"
            raise ValueError(f"module = {module!r}: {rule}")
        optimizer = optax.sgd(0.1) if optimizer is None else optimizer
        rule = "must be an optax optimiser, for example optax.sgd(0.1)"
        check_methods("optimizer", optimizer, ("init", "update"), rule)
        model = _Module(module, optimizer, checks.whole("steps", steps, 1))
        self._set_up(type(module).__name__, model, **options)

    def _unwrapped(self, model: Any) -> Any:
        return model.module


def _needed(module: str) -> Any:
    return import_extra(module, "jax", "a JAX learner")


class _Module:
    def __init__(self, module: Any, optimizer: Any, steps: int) -> None:
        equinox = _needed("equinox")
        self.module, self.optimizer, self.steps = module, optimizer, steps
        self.moments = optimizer.init(equinox.filter(module, equinox.is_inexact_array))

    def __deepcopy__(self, memo: Any) -> _Module:
        # Arrays of JAX are immutable, so a shallow copy is enough.
        other = object.__new__(_Module)
        vars(other).update(vars(self))
        return other

    def learn(self, features: Matrix, targets: Vector) -> None:
        step, _ = _compiled()
        # JAX compiles for each shape: batches are padded to a power of two with rows of weight
        # zero.
        count = len(targets)
        size = 1 << (count - 1).bit_length()
        rows, wanted, weights = np.zeros((size, features.shape[1])), np.zeros(size), np.zeros(size)
        rows[:count], wanted[:count], weights[:count] = features, targets, 1.0
        for _ in range(self.steps):
            self.module, self.moments = step(
                self.module, self.moments, self.optimizer, rows, wanted, weights
            )

    def predict(self, features: Vector) -> Any:
        return np.asarray(_compiled()[1](self.module, features))


@functools.cache
def _compiled() -> tuple[Any, Any]:
    """Return a gradient step and a prediction; made at first use, since JAX is slow to import."""
    jax, equinox = _needed("jax"), _needed("equinox")

    def loss(module: Any, rows: Any, wanted: Any, weights: Any) -> Any:
        output = jax.vmap(module)(rows)
        if output.shape not in (wanted.shape, (*wanted.shape, 1)):
            raise ValueError(f"returned shape {output.shape[1:]} for a row: must be one number")
        return (weights * (output.reshape(wanted.shape) - wanted) ** 2).sum() / weights.sum()

    def step(
        module: Any, moments: Any, optimizer: Any, rows: Any, wanted: Any, weights: Any
    ) -> Any:
        gradient = equinox.filter_grad(loss)(module, rows, wanted, weights)
        trained = equinox.filter(module, equinox.is_inexact_array)
        updates, moments = optimizer.update(gradient, moments, trained)
        return equinox.apply_updates(module, updates), moments

    return equinox.filter_jit(step), equinox.filter_jit(lambda module, features: module(features))
