"""Kernels of a learner whose model is a Python object.

They collect pairs in the compiled loop and call the model every ``period`` samples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.function_pointers import call
from quell.kernels.sized import Buffer
from quell.learners.adapters.instances import COUNTDOWN, DISABLED, PREDICTION, STATUS
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    forget,
    no_coefficients,
    predict,
    restart,
    trouble,
)
from quell.learners.feature_learner import write_features
from quell.learners.online.learner import OnlineDesign, OnlineMemory, has_pairs
from quell.learners.online.model import infer, learn
from quell.types import Status, Vector

_FAILED = int(Status.LEARNER_FAILED)


class PairsDesign(NamedTuple):
    """Parameters of a model that only collects its pairs."""

    size: int  # number of pairs
    width: int  # number of features p


class PairsMemory(NamedTuple):
    """State of a model that only collects its pairs."""

    features: Buffer  # (size, p)
    targets: Buffer  # (size,)
    filled: Vector  # (1,): number of pairs


class PythonDesign(NamedTuple):
    """Parameters of a learner whose model is a Python object."""

    online: OnlineDesign  # features, scaling and lag
    period: int  # samples between two calls
    address: int  # address of the function that calls the model


class PythonMemory(NamedTuple):
    """State of a learner whose model is a Python object."""

    online: OnlineMemory
    answer: Vector  # (4,), see ``instances.PREDICTION`` and the other indices
    model: Vector  # (1,): number of the instance that learns (``instances.py``)


class Pairs:
    """A description of a model that only collects ``size`` pairs."""

    def __init__(self, size: int) -> None:
        self.size = size

    def design(self, features: int, dt: float) -> PairsDesign:
        """Return the parameters for the number of features."""
        return PairsDesign(self.size, features)

    def memory(self, parameters: PairsDesign) -> PairsMemory:
        """Return an empty batch."""
        size = parameters.size
        return PairsMemory(np.zeros((size, parameters.width)), np.zeros(size), np.zeros(1))


@infer.register(PairsDesign)
def _infer(model: PairsDesign, memory: PairsMemory, features: Vector) -> float:
    return 0.0


@learn.register(PairsDesign)
def _learn(model: PairsDesign, memory: PairsMemory, features: Vector, target: float) -> None:
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
    if answer[DISABLED] != 0.0:
        answer[PREDICTION] = 0.0
        answer[STATUS] = _FAILED
        return
    adapt(learner.online, online, seen, y, u_before, f_plain)
    if not has_pairs(learner.online, online):
        answer[STATUS] = 0.0
        return
    answer[COUNTDOWN] -= 1.0
    if answer[COUNTDOWN] > 0.0:
        return
    now, batch = online.features, online.model
    write_features(learner.online.inputs, online, seen, u_before, now)
    if batch.filled[0] > 0.0 and _finite(now):
        address, filled = learner.address, int(batch.filled[0])
        call(address, memory.model, batch.features, batch.targets, filled, now.size, now, answer)
        batch.filled[0] = 0.0
        answer[COUNTDOWN] = learner.period


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
    memory.answer[PREDICTION] = memory.answer[COUNTDOWN] = 0.0


@forget.register(PythonDesign)
def _forget(learner: PythonDesign, memory: PythonMemory) -> None:
    forget(learner.online, memory.online)
    restart(learner, memory)
    now, batch = memory.online.features, memory.online.model
    # Without pairs the call means that the model is to start again.
    call(
        *(learner.address, memory.model, batch.features, batch.targets, 0),
        *(now.size, now, memory.answer),
    )


@trouble.register(PythonDesign)
def _trouble(learner: PythonDesign, memory: PythonMemory) -> int:
    return int(memory.answer[STATUS])


coefficients.register(PythonDesign)(no_coefficients)
