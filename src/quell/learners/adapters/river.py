"""Regressors of river as learners."""

from __future__ import annotations

from typing import Any, Unpack

from quell.learners.adapters.python import Options, PythonModel, check_methods
from quell.types import Matrix, Vector


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
