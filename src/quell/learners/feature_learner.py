"""The common part of learners on features: choice of features, scaling, noise gate, bias, start."""

from __future__ import annotations

from typing import Any, NamedTuple

from quell import checks
from quell.described import Described
from quell.features import Bias, Features, State
from quell.features.base import checked_design, write, write_physical
from quell.features.scaling import Scaling, initial_scale, scaling
from quell.features.sizes import (
    Indices,
    initial_sizes,
    scale_by_sizes,
    unscaled_indices,
    update_sizes,
)
from quell.kernels.dispatch import kernel
from quell.learners.lag import startup_samples
from quell.learners.noise_gate import NoiseGate, gated, noise_gate
from quell.observers.eso import ESO
from quell.types import Vector
from quell.warn import warn


class Inputs(NamedTuple):
    """Parameters that all learners on features share, for a plant of order n."""

    features: Any
    unscaled: Indices  # of the features whose size is unknown (k,)
    scaling: Scaling
    gate: NoiseGate
    bias_gain: float  # λ dt, at most 1
    startup: int  # samples after a start from rest in which nothing is learned

    @property
    def order(self) -> int:
        """Order n of the plant."""
        return int(self.scaling.floors.size) - 2


@kernel
def write_features(inputs: Inputs, memory: Any, seen: Vector, u: float, out: Vector) -> None:
    """Write the features of the estimates ``seen`` (n + 1,) and ``u`` into ``out`` (p,).

    A signal that does not move is replaced by its mean. ``memory`` is the learner's, with ``gate``,
    ``scale`` (n + 2,), which divides x_1 … x_n, u and f, ``sizes`` (k,), which divides the features
    of unknown size, and the work space ``scaled`` (n,).
    """
    scale, scaled = memory.scale, memory.scaled
    moving_u = _write_physical(inputs, memory, seen, u, out)
    scale_by_sizes(inputs.unscaled, memory.sizes, out)
    for i in range(scaled.size):
        scaled[i] /= scale[i]
    write(inputs.features, scaled, moving_u / scale[scaled.size], out)


@kernel
def _write_physical(inputs: Inputs, memory: Any, seen: Vector, u: float, out: Vector) -> float:
    """Write the features of signals in the plant's units, and these signals into ``scaled``.

    Return the control signal, or its mean if it does not move.
    """
    gate, scaled = memory.gate, memory.scaled
    for i in range(scaled.size):
        scaled[i] = gated(inputs.gate, gate, i, seen[i])
    moving_u = gated(inputs.gate, gate, scaled.size, u)
    write_physical(inputs.features, scaled, moving_u, out)
    return moving_u


@kernel
def update_feature_sizes(inputs: Inputs, memory: Any, seen: Vector, u: float) -> bool:
    """Let ``memory.sizes`` cover the features of a sample; return whether one grew."""
    if inputs.unscaled.size == 0:
        return False
    _write_physical(inputs, memory, seen, u, memory.features)
    return update_sizes(inputs.unscaled, memory.sizes, memory.features)


def features_first(features: Any, number: Any, default: Any, name: str) -> tuple[Any, Any]:
    """Return features and the number behind them; a call in the old order warns.

    The number came first before version 0.2. The types of the arguments tell the orders apart.
    """
    if isinstance(features, int | float) and (number is default or isinstance(number, Features)):
        features, number = None if number is default else number, features
    elif isinstance(number, Features) and features is None:
        features, number = number, default
    else:
        return features, number
    rule = f"features are the first argument now; give {name}= by its name"
    warn(f"{name} = {number!r} came first: {rule}", DeprecationWarning)
    return features, number


class FeatureLearner(Described):
    """Base class of the learners that are given scaled features of the state and of u.

    Parameters
    ----------
    features
        blocks of features, for example ``State() + Bias()``, which is the default.
    frequency
        a frequency of the plant [rad/s], for the automatic scaling; ``omega_c`` of the controller
        by default.
    scale
        what x_1 … x_n, u and f are divided by, (n + 2,); found automatically by default.
    bias_bandwidth
        bandwidth λ of a bias that follows what is not learned otherwise [rad/s]; ``omega_o`` of the
        observer by default, 0 for no bias.
    """

    def __init__(
        self,
        features: Features | None,
        frequency: float | None,
        scale: Any,
        bias_bandwidth: float | None,
    ) -> None:
        self.features = State() + Bias() if features is None else features
        if not isinstance(self.features, Features):
            raise ValueError(
                f"features = {features!r}: must be made of blocks from quell.features, "
                "for example State() + Bias()"
            )
        self.frequency = checks.optional(checks.positive, "frequency", frequency, "rad/s")
        self.scale = checks.optional(checks.positive_vector, "scale", scale)
        check = checks.non_negative
        self.bias_bandwidth = checks.optional(check, "bias_bandwidth", bias_bandwidth, "rad/s")

    def _inputs(self, observer: ESO, omega_c: float) -> Inputs:
        order, frequency = observer.order, self.frequency or omega_c
        if self.scale is not None:
            checks.vector("scale", self.scale, order + 2)
        bandwidth = observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth
        return Inputs(
            features=checked_design(self.features, order),
            unscaled=unscaled_indices(self.features, order),
            scaling=scaling(observer, frequency, self.scale is not None),
            gate=noise_gate(observer, frequency),
            bias_gain=min(bandwidth * observer.dt, 1.0),
            startup=startup_samples(observer),
        )

    def _initial_scale(self, inputs: Inputs) -> Vector:
        return initial_scale(inputs.scaling) if self.scale is None else self.scale.copy()

    def _initial_sizes(self, inputs: Inputs) -> Vector:
        return initial_sizes(inputs.unscaled)
