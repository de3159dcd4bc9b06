"""The compiled side of a learner whose model is a Python object: it gathers pairs and asks every ``period`` samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.function_pointers import call
from quell.learners.adapters.instances import GIVEN_UP, PREDICTION, STATUS, UNTIL
from quell.learners.base import adapt, coefficients, commit, predict, restart, trouble
from quell.learners.online.learner import OnlineDesign, OnlineMemory, ready, show
from quell.learners.online.model import infer, learn
from quell.types import Matrix, Status, Vector

_FAILED = int(Status.LEARNER_FAILED)


class BatchDesign(NamedTuple):
    """Parameters of a model that only gathers what it should learn."""

    size: int
    """Number of pairs."""
    width: int
    """Number of features p."""


class BatchMemory(NamedTuple):
    """State of a model that only gathers."""

    features: Matrix
    """(size, p)."""
    targets: Vector
    """(size,)."""
    filled: Vector
    """(1,): how many there are."""


class PythonDesign(NamedTuple):
    """Parameters of a learner whose model is a Python object."""

    online: OnlineDesign
    """What is around the model: features, scaling, lag."""
    period: int
    """Samples from one call to the next."""
    address: int
    """Of the function that asks the model."""


class PythonMemory(NamedTuple):
    """State of a learner whose model is a Python object."""

    online: OnlineMemory
    answer: Vector
    """(4,): the last prediction, scaled; status flags; samples until the next call; whether the model is left alone."""
    model: Vector
    """(1,): the number of the instance that learns (``instances.py``)."""


class Batch:
    """A description of a model that only gathers ``size`` pairs."""

    def __init__(self, size: int) -> None:
        self.size = size

    def design(self, features: int, dt: float) -> BatchDesign:
        """Return the parameters for so many features."""
        return BatchDesign(self.size, features)

    def memory(self, parameters: BatchDesign) -> BatchMemory:
        """Return an empty batch."""
        return BatchMemory(
            np.zeros((parameters.size, parameters.width)), np.zeros(parameters.size), np.zeros(1)
        )


@infer.register(BatchDesign)
def _infer(model: BatchDesign, memory: BatchMemory, features: Vector) -> float:
    return 0.0


@learn.register(BatchDesign)
def _learn(model: BatchDesign, memory: BatchMemory, features: Vector, target: float) -> None:
    k = int(memory.filled[0])
    if k == model.size or not is_finite(target) or not _finite(features):
        return
    for j in range(features.size):
        memory.features[k, j] = features[j]
    memory.targets[k] = target
    memory.filled[0] = k + 1.0


@kernel
def _finite(values: Vector) -> bool:
    finite = True
    for i in range(values.size):
        finite = finite and is_finite(values[i])
    return finite


@adapt.register(PythonDesign)
def _adapt(
    learner: PythonDesign,
    memory: PythonMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    online, answer = memory.online, memory.answer
    if answer[GIVEN_UP] != 0.0:
        answer[PREDICTION] = 0.0
        answer[STATUS] = _FAILED
        return
    adapt(learner.online, online, seen, y, u_before, f_plain)
    if not ready(learner.online, online):
        answer[STATUS] = 0.0
        return
    answer[UNTIL] -= 1.0
    if answer[UNTIL] > 0.0:
        return
    show(learner.online, online, seen, u_before, online.now)
    batch = online.model
    if batch.filled[0] > 0.0 and _finite(online.now):
        filled = int(batch.filled[0])
        call(
            learner.address,
            memory.model,
            batch.features,
            batch.targets,
            filled,
            online.now.size,
            online.now,
            answer,
        )
        batch.filled[0] = 0.0
        answer[UNTIL] = learner.period


@predict.register(PythonDesign)
def _predict(
    learner: PythonDesign, memory: PythonMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    scale = memory.online.scale
    return memory.answer[PREDICTION] * scale[scale.size - 1], 0.0


@commit.register(PythonDesign)
def _commit(
    learner: PythonDesign, memory: PythonMemory, seen: Vector, u: float, f_learned: float
) -> None:
    commit(learner.online, memory.online, seen, u, f_learned)


@restart.register(PythonDesign)
def _restart(learner: PythonDesign, memory: PythonMemory) -> None:
    restart(learner.online, memory.online)
    memory.online.model.filled[0] = 0.0
    memory.answer[PREDICTION] = memory.answer[UNTIL] = 0.0


@trouble.register(PythonDesign)
def _trouble(learner: PythonDesign, memory: PythonMemory) -> int:
    return int(memory.answer[STATUS])


@coefficients.register(PythonDesign)
def _coefficients(learner: PythonDesign, memory: PythonMemory, theta: Vector) -> None:
    pass
