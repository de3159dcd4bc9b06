"""A learner of any model: features, scaling, and the lag of the observer taken out of the pairs it learns from.

What the observer shows of f, ``f^F = Δf̂ + f_L^F``, is f filtered (``lag.py``), about f as it was D samples ago, D being the filter's group
delay. So a black box is given the pair

    ( φ(k − D),  f^F(k) )

and what it learns has no lag bias, up to second order in frequency over omega_o. (A model that is linear in its parameters can do without
the approximation: ``regression.py``.)

What does not stand clear of noise is shown as its mean, and nothing is learned while nothing moves, or where noise hides f
(``noise_gate.py``): at rest a black box would learn by heart what it sees, and forget the rest. A fast bias d follows what the model leaves, as
in ``regression.py``.

A scale that grows, by a factor of two or more, makes the same motion look smaller to the model, which then has to learn anew what it
knew. That is so in the first motions, and where a motion is larger than all before; ``scale`` avoids it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.features import Bias, Features, State
from quell.features.base import checked_design, write
from quell.features.scaling import Scaling, scaling, update_scale
from quell.kernels.dispatch import is_finite, kernel
from quell.learners.base import adapt, coefficients, commit, predict, restart
from quell.learners.lag import group_delay, startup_samples
from quell.learners.noise_gate import (
    NoiseGate,
    NoiseGateMemory,
    confidence,
    gated,
    noise_gate,
    noise_gate_memory,
    reset_gate,
    update_gate,
)
from quell.learners.online.model import infer, learn, packed, validated_design
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# Places in OnlineMemory.place.
_ROW, _SINCE, _LEFT = range(3)


class OnlineDesign(NamedTuple):
    """Parameters of a learner around a model with p features."""

    features: Any
    scaling: Scaling
    gate: NoiseGate
    model: Any
    follow: float
    """λ dt, at most 1."""
    delay: int
    """D [samples]."""
    watch: int
    """Samples after a start from rest in which nothing is learned."""


class OnlineMemory(NamedTuple):
    """State of a learner around a model."""

    scale: Vector
    """(n + 2,): what x_1 … x_n, u and f are divided by."""
    scaled: Vector
    """Room for the scaled state (n,)."""
    now: Vector
    """Room for the features of a prediction (p,)."""
    ring: Matrix
    """The last features (D + 1, p)."""
    place: Vector
    """(3,): where the next row goes; samples since the start from rest; d, in the plant's units."""
    gate: NoiseGateMemory
    model: Any
    flat: Vector
    """All arrays of ``model``, end to end: the same memory."""
    fresh: Vector
    """What ``flat`` was before anything was learned."""


@kernel
def show(learner: OnlineDesign, memory: OnlineMemory, seen: Vector, u: float, out: Vector) -> None:
    """Write the features of the estimates ``seen`` and of ``u`` into ``out`` (p,), scaled."""
    scale, scaled = memory.scale, memory.scaled
    for i in range(scaled.size):
        scaled[i] = gated(learner.gate, memory.gate, i, seen[i]) / scale[i]
    write(
        learner.features,
        scaled,
        gated(learner.gate, memory.gate, scaled.size, u) / scale[scaled.size],
        out,
    )


@kernel
def ready(learner: OnlineDesign, memory: OnlineMemory) -> bool:
    """Return whether there are pairs to learn from yet, and something to predict."""
    return bool(memory.place[_SINCE] > learner.watch + learner.delay + 1)


@adapt.register(OnlineDesign)
def _adapt(
    learner: OnlineDesign,
    memory: OnlineMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    moves = update_gate(learner.gate, memory.gate, seen, y, u_before)
    if memory.place[_SINCE] <= learner.watch:
        return
    scale = memory.scale
    update_scale(learner.scaling, scale, seen, u_before, f_plain)
    if not ready(learner, memory):
        return
    # The ring has just been written at the row before: the oldest of its D + 1 rows, D samples older, is where the next one goes.
    features, f_scale = (
        memory.ring[min(max(int(memory.place[_ROW]), 0), learner.delay)],
        scale[scale.size - 1],
    )
    if learner.follow > 0.0:
        left = (
            f_plain - f_scale * infer(learner.model, memory.model, features) - memory.place[_LEFT]
        )
        if is_finite(left):
            memory.place[_LEFT] += learner.follow * left
    if moves and confidence(learner.gate, memory.gate, scale[0]) > 0.5:
        learn(learner.model, memory.model, features, f_plain / f_scale)


@predict.register(OnlineDesign)
def _predict(
    learner: OnlineDesign, memory: OnlineMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    if not ready(learner, memory):
        return 0.0, 0.0
    scale = memory.scale
    show(learner, memory, seen, u_before, memory.now)
    return scale[scale.size - 1] * infer(learner.model, memory.model, memory.now) + memory.place[
        _LEFT
    ], 0.0


@commit.register(OnlineDesign)
def _commit(
    learner: OnlineDesign, memory: OnlineMemory, seen: Vector, u: float, f_learned: float
) -> None:
    row = min(max(int(memory.place[_ROW]), 0), learner.delay)
    show(learner, memory, seen, u, memory.ring[row])
    row += 1
    memory.place[_ROW] = 0.0 if row > learner.delay else row
    memory.place[_SINCE] += 1.0


@restart.register(OnlineDesign)
def _restart(learner: OnlineDesign, memory: OnlineMemory) -> None:
    memory.place[_ROW] = memory.place[_SINCE] = memory.place[_LEFT] = 0.0
    reset_gate(memory.gate)
    finite = True
    for i in range(memory.flat.size):
        finite = finite and abs(memory.flat[i]) <= 1e100
    if not finite:
        for i in range(memory.flat.size):
            memory.flat[i] = memory.fresh[i]


@coefficients.register(OnlineDesign)
def _coefficients(learner: OnlineDesign, memory: OnlineMemory, theta: Vector) -> None:
    pass


class Online:
    """A learner made of a model and features.

    Parameters
    ----------
    model
        what learns: a description with ``design(features, dt)`` and ``memory(parameters)`` (``model.py``).
    features
        what it is shown; the state and a constant by default.
    frequency
        a frequency the plant has [rad/s], for the automatic scaling; ``omega_c`` of the controller by default.
    scale
        what x_1 … x_n, u and f are divided by, (n + 2,), where it shall not be found automatically.
    bias_bandwidth
        how fast a bias follows what the model leaves, λ [rad/s]; ``omega_o`` of the observer by default, 0 for none.

    Raises
    ------
    ValueError
        for arguments that fit nothing.
    """

    def __init__(
        self,
        model: Any,
        features: Features | None = None,
        *,
        frequency: float | None = None,
        scale: Any = None,
        bias_bandwidth: float | None = None,
    ) -> None:
        if isinstance(model, type) or not (hasattr(model, "design") and hasattr(model, "memory")):
            raise ValueError(
                f"model = {model!r}: must have design(features, dt) and memory(parameters); see docs/extend"
            )
        self.model = model
        self.features = State() + Bias() if features is None else features
        if not isinstance(self.features, Features):
            raise ValueError(
                f"features = {features!r}: must be made of blocks from quell.features, for example State() + Bias()"
            )
        self.frequency = (
            None if frequency is None else checks.positive("frequency", frequency, "rad/s")
        )
        self.bias_bandwidth = (
            None
            if bias_bandwidth is None
            else checks.non_negative("bias_bandwidth", bias_bandwidth, "rad/s")
        )
        self.scale = None if scale is None else checks.positive_vector("scale", scale)

    def fitted_model(self, observer: ESO, omega_c: float) -> Any:
        """Return the model; one that is fitted to observer and controller does that here."""
        return self.model

    def design(self, observer: ESO, omega_c: float) -> OnlineDesign:
        """Return the parameters for ``observer`` and a controller of bandwidth ``omega_c`` [rad/s]."""
        n = observer.order
        if self.scale is not None:
            checks.vector("scale", self.scale, n + 2)
        return OnlineDesign(
            features=checked_design(self.features, n),
            scaling=scaling(observer, self.frequency or omega_c, self.scale is not None),
            gate=noise_gate(observer, self.frequency or omega_c),
            model=validated_design(
                self.fitted_model(observer, omega_c), len(self.features.names(n)), observer.dt
            ),
            follow=min(
                (observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth)
                * observer.dt,
                1.0,
            ),
            delay=max(round(group_delay(observer)), 0),
            watch=startup_samples(observer),
        )

    def memory(self, parameters: OnlineDesign) -> OnlineMemory:
        """Return a state with nothing learned."""
        n = parameters.scaling.floors.size - 2
        p = len(self.features.names(n))
        model, flat = packed(self.model.memory(parameters.model))
        return OnlineMemory(
            scale=np.full(n + 2, 1e-100) if self.scale is None else self.scale.copy(),
            scaled=np.zeros(n),
            now=np.zeros(p),
            ring=np.zeros((parameters.delay + 1, p)),
            place=np.zeros(3),
            gate=noise_gate_memory(n),
            model=model,
            flat=flat,
            fresh=flat.copy(),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names: what a black box has learned is not said by coefficients."""
        return ()
