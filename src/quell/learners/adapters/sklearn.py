"""Incremental regressors of scikit-learn as learners."""

from __future__ import annotations

import copy
from typing import Any, Unpack

from quell.learners.adapters.python import Options, PythonModel, check_methods
from quell.types import Matrix, Vector


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
