"""Models of scikit-learn, river, PyTorch and JAX as learners."""

from __future__ import annotations

import copy
import functools
from typing import Any, Unpack

import numpy as np

from quell import checks
from quell.checks import import_extra
from quell.learners.python_model import Options, PythonModel, check_methods
from quell.types import Matrix, Vector

# ---- Equinox modules, trained by an optax optimiser, as learners ----


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


# ---- Regressors of river as learners ----


class RiverModel(PythonModel):
    """A learner whose model is a river regressor or pipeline.

    Any object with ``learn_one`` and ``predict_one`` can be used. It is shown the features as a
    dictionary with the keys 0, 1, ….

    Parameters
    ----------
    regressor
        for example ``river.preprocessing.StandardScaler() |
        river.linear_model.LinearRegression()``.
    **options
        ``features``, ``period``, ``budget``, ``frequency``, ``scale``: see ``PythonModel``.

    Raises
    ------
    ValueError
        for a regressor without these methods, and as ``PythonModel``.
    """

    def __init__(self, regressor: Any, **options: Unpack[Options]) -> None:
        rule = "must have learn_one and predict_one, as river's regressors have"
        check_methods("regressor", regressor, ("learn_one", "predict_one"), rule)
        self._set_up(type(regressor).__name__, _Regressor(regressor), **options)

    def _unwrapped(self, model: Any) -> Any:
        return model.regressor


class _Regressor:
    def __init__(self, regressor: Any) -> None:
        self.regressor = regressor

    def learn(self, features: Matrix, targets: Vector) -> None:
        for row, target in zip(features.tolist(), targets.tolist(), strict=True):
            self.regressor.learn_one(dict(enumerate(row)), target)

    def predict(self, features: Vector) -> Any:
        return self.regressor.predict_one(dict(enumerate(features.tolist())))


# ---- Incremental regressors of scikit-learn as learners ----


class SklearnModel(PythonModel):
    """A learner whose model is a scikit-learn estimator.

    Any object with ``partial_fit`` and ``predict`` can be used. Features and target are scaled, so
    no scaler is needed. A ``random_state`` of None is set to 0 in the copy that learns, so that a
    run can be repeated.

    Parameters
    ----------
    estimator
        for example ``sklearn.linear_model.SGDRegressor()`` or
        ``sklearn.neural_network.MLPRegressor()``.
    **options
        ``features``, ``period``, ``budget``, ``frequency``, ``scale``: see ``PythonModel``.

    Raises
    ------
    ValueError
        for an estimator that cannot learn incrementally, and as ``PythonModel``.
    """

    def __init__(self, estimator: Any, **options: Unpack[Options]) -> None:
        rule = (
            "must have partial_fit and predict, as SGDRegressor and MLPRegressor have; pass the "
            "last step of a pipeline: features come scaled"
        )
        check_methods("estimator", estimator, ("partial_fit", "predict"), rule)
        self._set_up(type(estimator).__name__, _Estimator(estimator), **options)

    def _unwrapped(self, model: Any) -> Any:
        return model.estimator


class _Estimator:
    def __init__(self, estimator: Any) -> None:
        self.estimator = copy.deepcopy(estimator)
        parameters = estimator.get_params(deep=False) if hasattr(estimator, "get_params") else {}
        if "random_state" in parameters and parameters["random_state"] is None:
            self.estimator.set_params(random_state=0)

    def learn(self, features: Matrix, targets: Vector) -> None:
        self.estimator.partial_fit(features, targets)

    def predict(self, features: Vector) -> Any:
        return self.estimator.predict(features.reshape(1, -1))


# ---- PyTorch modules as learners ----


class TorchModel(PythonModel):
    """A learner whose model is a PyTorch module.

    It is trained by gradient steps on the mean squared error of each batch.

    Parameters
    ----------
    module
        takes a tensor (m, p) and returns one of shape (m, 1) or (m,), on the CPU.
    optimizer
        an optimiser of the module's parameters, or a function that makes one from parameters, for
        example ``functools.partial(torch.optim.SGD, lr=0.05)``; SGD with a learning rate of 0.1 by
        default. Consecutive pairs are similar, and an optimiser that takes long steps on small
        gradients (Adam at its usual rates) unlearns the rest.
    steps
        gradient steps on each batch.
    **options
        ``features``, ``period``, ``budget``, ``frequency``, ``scale``: see ``PythonModel``.

    Raises
    ------
    ImportError
        if PyTorch is missing.
    ValueError
        for an object that is no module or no optimiser, and as ``PythonModel``.
    """

    def __init__(
        self, module: Any, optimizer: Any = None, *, steps: int = 1, **options: Unpack[Options]
    ) -> None:
        torch = import_extra("torch", "torch", "a PyTorch learner")
        if not isinstance(module, torch.nn.Module):
            raise ValueError(f"module = {module!r}: must be a torch.nn.Module")
        parameters = list(module.parameters())
        if not parameters:
            raise ValueError(f"module = {module!r}: must have parameters to train")
        if optimizer is None:
            optimizer = torch.optim.SGD(parameters, lr=0.1)
        elif not isinstance(optimizer, torch.optim.Optimizer) and callable(optimizer):
            optimizer = optimizer(parameters)
        if not isinstance(optimizer, torch.optim.Optimizer):
            raise ValueError(
                f"optimizer = {optimizer!r}: must be a torch optimiser, or a function that makes "
                "one from parameters"
            )
        own = {id(parameter) for parameter in parameters}
        if not own.issuperset(id(p) for group in optimizer.param_groups for p in group["params"]):
            raise ValueError(
                "optimizer: must be on the parameters of the module; use its parameters()"
            )
        model = _TorchModule(module, optimizer, checks.whole("steps", steps, 1))
        self._set_up(type(module).__name__, model, **options)

    def _unwrapped(self, model: Any) -> Any:
        return model.module.eval()


class _TorchModule:
    # Module and optimiser are copied together: the copied optimiser has the copied module's
    # parameters.
    def __init__(self, module: Any, optimizer: Any, steps: int) -> None:
        self.module, self.optimizer, self.steps = module, optimizer, steps
        self.dtype = next(module.parameters()).dtype

    def learn(self, features: Matrix, targets: Vector) -> None:
        torch = import_extra("torch", "torch", "a PyTorch learner")
        rows, wanted = (torch.from_numpy(array).to(self.dtype) for array in (features, targets))
        self.module.train()
        for _ in range(self.steps):
            self.optimizer.zero_grad()
            output = self.module(rows)
            if tuple(output.shape) not in ((len(wanted), 1), (len(wanted),)):
                raise ValueError(
                    f"returned shape {tuple(output.shape)} for {len(wanted)} rows: "
                    "must be one number for each"
                )
            torch.nn.functional.mse_loss(output.reshape(-1), wanted).backward()
            self.optimizer.step()

    def predict(self, features: Vector) -> Any:
        torch = import_extra("torch", "torch", "a PyTorch learner")
        self.module.eval()
        with torch.no_grad():
            row = torch.from_numpy(features.reshape(1, -1)).to(self.dtype)
            return self.module(row).numpy()


__all__ = ["JaxModel", "PythonModel", "RiverModel", "SklearnModel", "TorchModel"]
