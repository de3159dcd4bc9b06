"""A learner of any Python object."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypedDict, Unpack

import numpy as np

from quell import checks
from quell.features import Features, State
from quell.features.base import checked_design
from quell.learners.adapters.instances import Instance, address, enter, finite_number, instance_of
from quell.learners.adapters.kernels import Batch, PythonDesign, PythonMemory
from quell.learners.online.learner import Online
from quell.observers.eso import ESO


class Options(TypedDict, total=False):
    """What all learners of Python objects may be told; see ``PythonModel``."""

    features: Features | None
    period: int
    budget: float | None
    frequency: float | None
    scale: Any


@dataclass(frozen=True)
class Snapshot:
    """A copy of a model at work, for a controller's ``state``."""

    model: Any
    failures: int


class PythonModel:
    """A learner whose model is a Python object.

    The loop stays compiled. Every ``period`` samples it calls the model, with the pairs gathered since the last call and with the features
    of this moment, and holds the prediction until the next call. Pairs are made as for ``Online``: the features are delayed by the
    observer's lag, features and target are scaled to about [−1, 1].

    Each controller state has a deep copy of the model to itself, so that what is given here never changes. A model that draws random
    numbers should have a generator of its own with a seed, or two runs will differ.

    A model that raises, or predicts something that is no finite number, is not listened to: the step reports
    ``Status.LEARNER_FAILED``, a ``RuntimeWarning`` and ``last_problem`` say what happened, and a fresh copy takes over. After three
    failures in a row the model is left alone, with a prediction of zero, until the controller is reset.

    Parameters
    ----------
    model
        an object with ``learn(features, targets)``, of shapes (m, p) and (m,), m from 1 to ``period``, and ``predict(features)``, which
        returns a number for features of shape (p,).
    features : Features, optional
        what it is shown; the estimated state by default.
    period : int, optional
        samples from one call to the next, 10 by default. A prediction is up to so old: ``period · dt`` should be well below the observer's
        lag, which is about ``(n + 1) / omega_o``.
    budget : float, optional
        how long the loop waits for an answer [s]. By default the model is called in the loop and waited for, which gives the same bits
        every time: right for simulation. With a budget it runs in a thread of its own. A late answer is taken at the first call after
        it has come; until then the last prediction holds, new pairs are dropped, and steps report ``Status.LEARNER_LATE``.
    frequency : float, optional
        a frequency the plant has [rad/s], for the automatic scaling; ``omega_c`` of the controller by default.
    scale : array, optional
        what x_1 … x_n, u and f are divided by, (n + 2,), where it shall not be found automatically.

    Raises
    ------
    ValueError
        for arguments that fit nothing; in ``design``, where a copy of the model, tried on a few pairs, does not learn and predict.
    """

    external_fields = ("model",)
    """The field of the memory that stands for the model."""

    def __init__(self, model: Any, **options: Unpack[Options]) -> None:
        if isinstance(model, type) or not all(
            callable(getattr(model, name, None)) for name in ("learn", "predict")
        ):
            raise ValueError(
                f"model = {model!r}: must be an object with learn(features, targets) and predict(features)"
            )
        self.name = type(model).__name__
        self._set_up(model, **options)

    def _set_up(
        self,
        model: Any,
        features: Features | None = None,
        period: int = 10,
        budget: float | None = None,
        frequency: float | None = None,
        scale: Any = None,
    ) -> None:
        self.period = checks.whole("period", period, 1)
        self.budget = None if budget is None else checks.positive("budget", budget, "s")
        self._online = Online(
            Batch(self.period),
            State() if features is None else features,
            frequency=frequency,
            scale=scale,
            bias_bandwidth=0.0,
        )
        try:
            self._source = copy.deepcopy(model)
        except Exception as error:
            raise ValueError(
                f"{self.name}: must be something copy.deepcopy can copy ({type(error).__name__}: {error})"
            ) from error
        self.last_problem = ""
        """The text of the last problem that a loop had with the model; empty where there was none."""
        self._tried: set[int] = set()

    def design(self, observer: ESO, omega_c: float) -> PythonDesign:
        """Return the parameters for ``observer`` and a controller of bandwidth ``omega_c`` [rad/s]; try the model on a copy first."""
        checked_design(self._online.features, observer.order)
        self._try(self._online.features.names(observer.order))
        return PythonDesign(self._online.design(observer, omega_c), self.period, address())

    def memory(self, parameters: PythonDesign) -> PythonMemory:
        """Return a state with nothing learned, and with a copy of the model behind it."""
        instance = Instance(self._source, self.name, self.budget, self._note)
        return PythonMemory(self._online.memory(parameters.online), np.zeros(4), enter(instance))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names: what a black box has learned is not said by coefficients."""
        return ()

    def trained(self, memory: PythonMemory) -> Any:
        """Return a copy of the model as it is in a state: ``learner.trained(run.final_state.learner)``.

        What it learned is in scaled units: features and target were divided by ``memory.online.scale``.
        """
        return self._unwrapped(instance_of(memory.model).copied()[0])

    def snapshot(self, memory: PythonMemory) -> dict[str, Any]:
        """Return a copy of the model that learns, by the name of the field that stands for it.

        It is an object of this process. quell never pickles one, nor unpickles it.
        """
        return {"model": Snapshot(*instance_of(memory.model).copied())}

    def recall(self, memory: PythonMemory, snapshots: Mapping[str, Any]) -> None:
        """Go on with copies of what ``snapshot`` returned."""
        snapshot = snapshots["model"]
        if not isinstance(snapshot, Snapshot):
            raise ValueError(
                f"state of {self.name}: must be what controller.state gave, in this process, got {type(snapshot).__name__}"
            )
        instance_of(memory.model).replaced(snapshot.model, snapshot.failures)

    def _unwrapped(self, model: Any) -> Any:
        """Return what the user knows of a model."""
        return model

    def _note(self, problem: str) -> None:
        self.last_problem = problem

    def _try(self, names: tuple[str, ...]) -> None:
        width = len(names)
        if width in self._tried:
            return
        wave = np.sin(1.0 + np.arange((self.period + 1) * width)).reshape(self.period + 1, width)
        step = "learn"
        try:
            model = copy.deepcopy(self._source)
            for rows in (wave[:1], wave[1:]):
                step = "learn"
                model.learn(rows.copy(), 0.5 * rows[:, 0])
                step = "predict"
                finite_number(model.predict(wave[0].copy()))
        except ImportError:
            raise
        except Exception as error:
            raise ValueError(
                f"{self.name}: {step} fails on a trial with {type(error).__name__}: {error}. It is shown {width} features "
                f"({', '.join(names)}) and must learn and predict one number: fit it to that, or choose other features"
            ) from error
        self._tried.add(width)
