"""A learner whose model is any Python object."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypedDict, Unpack

import numpy as np

from quell import checks
from quell.described import Described
from quell.features import Features, State
from quell.features.base import checked_design
from quell.learners.adapters.instances import (
    Instance,
    callback_address,
    finite_number,
    instance_of,
    register,
)
from quell.learners.adapters.kernels import Pairs, PythonDesign, PythonMemory
from quell.learners.online.learner import Online
from quell.observers.eso import ESO


class Options(TypedDict, total=False):
    """Options of all learners whose model is a Python object; see ``PythonModel``."""

    features: Features | None
    period: int
    budget: float | None
    frequency: float | None
    scale: Any


def check_methods(name: str, value: Any, methods: tuple[str, ...], rule: str) -> None:
    """Raise a ``ValueError`` with ``rule`` unless the argument ``name`` has these methods."""
    found = all(callable(getattr(value, method, None)) for method in methods)
    if isinstance(value, type) or not found:
        raise ValueError(f"{name} = {value!r}: {rule}")


@dataclass(frozen=True)
class Snapshot:
    """A copy of a model that learns, for a controller's ``state``."""

    model: Any
    failures: int


class PythonModel(Described):
    """A learner whose model is a Python object.

    The loop stays compiled. Every ``period`` samples it calls the model with the pairs collected
    since the last call and with the newest features, and holds the prediction until the next call.
    Pairs are made as for ``Online``: the features are delayed by the observer's lag, and features
    and target are scaled to about [−1, 1].

    Each controller state has its own deep copy of the model, so the object given here never
    changes. A model that draws random numbers should have its own generator with a seed; else two
    runs differ.

    If a model raises, or predicts something other than a finite number, its answer is dropped: the
    step reports ``Status.LEARNER_FAILED``, a ``RuntimeWarning`` and ``last_problem`` describe the
    problem, and a fresh copy continues. After three failures in a row the model is disabled, with a
    prediction of zero, until the controller is reset. ``design`` raises ``ValueError`` if a copy
    of the model fails to learn and predict in a trial with a few pairs.

    Parameters
    ----------
    model
        an object with ``learn(features, targets)``, of shapes (m, p) and (m,), m from 1 to
        ``period``, and ``predict(features)``, which returns a number for features of shape (p,).
    features : Features, optional
        blocks of features; the estimated state by default.
    period : int, optional
        samples between two calls, 10 by default. A prediction is up to one period old: ``period ·
        dt`` should be well below the observer's lag, which is about ``(n + 1) / omega_o``.
    budget : float, optional
        longest time that the loop waits for an answer [s]. By default the model is called in the
        loop's thread, which gives the same bits every time: right for simulation. With a budget it
        runs in its own thread. A late answer is taken at the first call after it has come; until
        then the last prediction is held, new pairs are dropped, and steps report
        ``Status.LEARNER_LATE``.
    frequency : float, optional
        a frequency of the plant [rad/s], for the automatic scaling; ``omega_c`` of the controller
        by default.
    scale : array, optional
        what x_1 … x_n, u and f are divided by, (n + 2,); found automatically by default.
    """

    external_fields = ("model",)  # the field of the memory that refers to the model

    def __init__(self, model: Any, **options: Unpack[Options]) -> None:
        rule = "must be an object with learn(features, targets) and predict(features)"
        check_methods("model", model, ("learn", "predict"), rule)
        self._set_up(type(model).__name__, model, **options)

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints: the model, its features, and when it is called."""
        found = {"model": self._source, "features": self._online.features, "period": self.period}
        more = {"budget": self.budget, "frequency": self.frequency, "scale": self.scale}
        return found | {name: value for name, value in more.items() if value is not None}

    def _set_up(
        self,
        name: str,
        model: Any,
        features: Features | None = None,
        period: int = 10,
        budget: float | None = None,
        frequency: float | None = None,
        scale: Any = None,
    ) -> None:
        self.name, self.frequency, self.scale = name, frequency, scale
        self.period = checks.whole("period", period, 1)
        self.budget = checks.optional(checks.positive, "budget", budget, "s")
        self._online = Online(
            Pairs(self.period),
            State() if features is None else features,
            frequency=frequency,
            scale=scale,
            bias_bandwidth=0.0,
        )
        try:
            self._source = copy.deepcopy(model)
        except Exception as error:
            raise ValueError(
                f"{name}: must be something copy.deepcopy can copy "
                f"({type(error).__name__}: {error})"
            ) from error
        self.last_problem = ""
        """The text of the last problem that a loop had with the model; empty if there was none."""
        self._tried_widths: set[int] = set()

    def design(self, observer: ESO, omega_c: float) -> PythonDesign:
        """Return the parameters for an observer and the controller's bandwidth [rad/s].

        The model is tried on a copy first.
        """
        checked_design(self._online.features, observer.order)
        self._try(self._online.features.names(observer.order))
        online = self._online.design(observer, omega_c)
        return PythonDesign(online, self.period, callback_address())

    def memory(self, parameters: PythonDesign) -> PythonMemory:
        """Return the state before anything is learned, with its own copy of the model."""
        instance = Instance(self._source, self.name, self.budget, self._note)
        return PythonMemory(self._online.memory(parameters.online), np.zeros(4), register(instance))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names: the model has no coefficients with a meaning for the user."""
        return ()

    def trained(self, memory: PythonMemory) -> Any:
        """Return a copy of the model in a state: ``learner.trained(run.final_state.learner)``.

        It learned in scaled units: features and target were divided by ``memory.online.scale``.
        """
        return self._unwrapped(instance_of(memory.model).copy_model()[0])

    def snapshot(self, memory: PythonMemory) -> dict[str, Any]:
        """Return a copy of the model that learns, by the name of its field in the memory.

        It is an object of this process; quell never pickles or unpickles it.
        """
        return {"model": Snapshot(*instance_of(memory.model).copy_model())}

    def recall(self, memory: PythonMemory, snapshots: Mapping[str, Any]) -> None:
        """Continue with copies of what ``snapshot`` returned."""
        snapshot = snapshots["model"]
        if not isinstance(snapshot, Snapshot):
            raise ValueError(
                f"state of {self.name}: must be what controller.state gave, in this process, "
                f"got {type(snapshot).__name__}"
            )
        instance_of(memory.model).replace_model(snapshot.model, snapshot.failures)

    def _unwrapped(self, model: Any) -> Any:
        """Return the user's model from the object that learns."""
        return model

    def _note(self, problem: str) -> None:
        self.last_problem = problem

    def _try(self, names: tuple[str, ...]) -> None:
        """Let a copy of the model learn one pair, then a period's, and predict after each."""
        width = len(names)
        if width in self._tried_widths:
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
                f"{self.name}: {step} fails on a trial with {type(error).__name__}: {error}. "
                f"It is shown {width} features ({', '.join(names)}) and must learn and predict one "
                "number: fit it to that, or choose other features"
            ) from error
        self._tried_widths.add(width)
