"""A learner around any model: features, scaling, and pairs that compensate the observer's lag.

The observer's estimate ``f^F = Δf̂ + f_L^F`` is f filtered (``lag.py``): approximately f as it
was D samples ago, with the filter's group delay D. So the model learns from the pair

    ( φ(k − D),  f^F(k) )

without lag bias, up to second order in frequency over omega_o. (A model that is linear in its
parameters does not need the approximation: ``regression/kernels.py``, where the bias is described.)
A model at rest would learn the noise it is shown and forget the rest, so it learns nothing while
nothing moves or noise hides f (``noise_gate.py``).

When a scale grows, by a factor of at least two, the same motion gives smaller features, and the
model has to learn them again. This happens in the first motions, and when a motion is larger than
all before; it does not happen if ``scale`` is given.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.features import Features
from quell.features.scaling import reset_scale, update_scale
from quell.features.sizes import reset_sizes
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import is_single
from quell.kernels.scalars import Scalars, clear
from quell.kernels.sized import Buffer
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    forget,
    no_coefficients,
    predict,
    restart,
)
from quell.learners.feature_learner import (
    FeatureLearner,
    Inputs,
    update_feature_sizes,
    write_features,
)
from quell.learners.lag import group_delay
from quell.learners.noise_gate import (
    NoiseGateMemory,
    confidence,
    noise_gate_memory,
    reset_gate,
    update_gate,
)
from quell.learners.online.model import Model, checked_design, infer, learn, packed
from quell.observers.eso import ESO
from quell.types import Vector

# Least confidence in f with which a model learns: at least half of f² is not noise. Chosen by hand.
_LEAST_CONFIDENCE = 0.5
# A state beyond this is as good as infinite: squares of it overflow; in single precision earlier.
_LARGEST, _LARGEST_SINGLE = 1e100, 1e15


class OnlineDesign(NamedTuple):
    """Parameters of a learner around a model with p features."""

    inputs: Inputs
    model: Any
    delay: int  # D [samples]


class OnlineLoop(Scalars):
    """Scalars of a learner around a model, kept from one sample to the next."""

    row: float  # of the ring, for the next features
    samples: float  # since the start from rest
    bias: float  # d, in the plant's units


class OnlineMemory(NamedTuple):
    """State of a learner around a model."""

    scale: Vector  # (n + 2,): what x_1 … x_n, u and f are divided by
    sizes: Vector  # (k,): what features of unknown size are divided by
    scaled: Vector  # work space for the scaled state (n,)
    features: Vector  # work space for the features of a prediction (p,)
    ring: Buffer  # the last features (D + 1, p)
    loop: NDArray[OnlineLoop]
    gate: NoiseGateMemory
    model: Any
    flat: Buffer  # all arrays of ``model``, end to end: the same memory
    initial: Buffer  # ``flat`` before anything was learned


@kernel
def has_pairs(learner: OnlineDesign, memory: OnlineMemory) -> bool:
    """Return whether there are pairs to learn from and features to predict from."""
    return bool(memory.loop[0].samples > learner.inputs.startup + learner.delay + 1)


@kernel
def _row(learner: OnlineDesign, memory: OnlineMemory) -> int:
    return min(max(int(memory.loop[0].row), 0), learner.delay)


@adapt.register(OnlineDesign)
def _adapt(
    learner: OnlineDesign,
    memory: OnlineMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    inputs, scale, loop = learner.inputs, memory.scale, memory.loop[0]
    moves = update_gate(inputs.gate, memory.gate, seen, y, u_before)
    if loop.samples <= inputs.startup:
        return
    update_scale(inputs.scaling, scale, seen, u_before, f_plain)
    update_feature_sizes(inputs, memory, seen, u_before)
    if not has_pairs(learner, memory):
        return
    # The next row to be written is the oldest of the D + 1 rows: D samples older than the newest.
    features, f_scale = memory.ring[_row(learner, memory)], scale[scale.size - 1]
    if inputs.bias_gain > 0.0:
        left = f_plain - f_scale * infer(learner.model, memory.model, features) - loop.bias
        if is_finite(left):
            loop.bias += inputs.bias_gain * left
    if moves and confidence(inputs.gate, memory.gate, scale[0]) > _LEAST_CONFIDENCE:
        learn(learner.model, memory.model, features, f_plain / f_scale)


@predict.register(OnlineDesign)
def _predict(
    learner: OnlineDesign, memory: OnlineMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    if not has_pairs(learner, memory):
        return 0.0, 0.0
    write_features(learner.inputs, memory, seen, u_before, memory.features)
    output = infer(learner.model, memory.model, memory.features)
    return memory.scale[memory.scale.size - 1] * output + memory.loop[0].bias, 0.0


@commit.register(OnlineDesign)
def _commit(
    learner: OnlineDesign, memory: OnlineMemory, seen: Vector, u: float, f_learned: float
) -> None:
    row = _row(learner, memory)
    write_features(learner.inputs, memory, seen, u, memory.ring[row])
    memory.loop[0].row = 0.0 if row == learner.delay else row + 1
    memory.loop[0].samples += 1.0


@restart.register(OnlineDesign)
def _restart(learner: OnlineDesign, memory: OnlineMemory) -> None:
    clear(memory.loop)
    reset_gate(memory.gate)
    finite = True
    for i in range(memory.flat.size):
        value = memory.flat[i]
        largest = _LARGEST_SINGLE if is_single(value) else _LARGEST
        finite = finite and abs(value) <= largest
    if not finite:
        _forget_model(memory)


@kernel
def _forget_model(memory: OnlineMemory) -> None:
    for i in range(memory.flat.size):
        memory.flat[i] = memory.initial[i]


@forget.register(OnlineDesign)
def _forget(learner: OnlineDesign, memory: OnlineMemory) -> None:
    restart(learner, memory)
    _forget_model(memory)
    reset_scale(learner.inputs.scaling, memory.scale)
    reset_sizes(memory.sizes)


coefficients.register(OnlineDesign)(no_coefficients)


class Online(FeatureLearner):
    """A learner made of a model and features.

    Parameters
    ----------
    model
        a description with ``design(features, dt)`` and ``memory(parameters)`` (``model.py``).

    The other parameters are described in the base class ``FeatureLearner``.

    Raises
    ------
    ValueError
        for an argument that is out of range, or is no model or no block of features.
    """

    def __init__(
        self,
        model: Model,
        features: Features | None = None,
        *,
        frequency: float | None = None,
        scale: Any = None,
        bias_bandwidth: float | None = None,
    ) -> None:
        if isinstance(model, type) or not (hasattr(model, "design") and hasattr(model, "memory")):
            raise ValueError(
                f"model = {model!r}: must have design(features, dt) and memory(parameters); "
                "see docs/extend"
            )
        super().__init__(features, frequency, scale, bias_bandwidth)
        self.model: Any = model

    def fitted_model(self, observer: ESO, omega_c: float) -> Model:
        """Return the model with the parameters that depend on observer and controller."""
        model: Model = self.model
        return model

    def design(self, observer: ESO, omega_c: float) -> OnlineDesign:
        """Return the parameters for an observer and the controller's bandwidth [rad/s]."""
        inputs, p = self._inputs(observer, omega_c), len(self.features.names(observer.order))
        return OnlineDesign(
            inputs=inputs,
            model=checked_design(self.fitted_model(observer, omega_c), p, observer.dt),
            delay=max(round(group_delay(observer)), 0),
        )

    def memory(self, parameters: OnlineDesign) -> OnlineMemory:
        """Return the state before anything is learned."""
        n = parameters.inputs.order
        p = len(self.features.names(n))
        model, flat = packed(self.model.memory(parameters.model))
        return OnlineMemory(
            scale=self._initial_scale(parameters.inputs),
            sizes=self._initial_sizes(parameters.inputs),
            scaled=np.zeros(n),
            features=np.zeros(p),
            ring=np.zeros((parameters.delay + 1, p)),
            loop=OnlineLoop.zeros(),
            gate=noise_gate_memory(n),
            model=model,
            flat=flat,
            initial=flat.copy(),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names: the model has no coefficients with a meaning for the user."""
        return ()
