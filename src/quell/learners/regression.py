"""Linear regressions on features: kernels, base class, and ``NLMS``.

Kernels of the learners ``f_L = θ · φ(x̂, u)`` that compensate the observer's lag exactly.

The features pass through the observer's own lag filter (``learners/base.py``), so that

    Δf̂ + f_L^F = θ · φ^F + noise

is a regression without lag bias for any features. A *rule* determines θ: a NamedTuple for whose
type ``update_theta`` and ``reset_uncertainty`` are registered, and ``share_excess`` where it has a
covariance.

*Scaling.* States, u and f are divided by powers of two (``features/base.py``). When a scale
grows, θ and the filters are converted; for features that are products of signals this is exact, and
nothing jumps; so it is for functions of signals in the plant's units, which are divided by their
own sizes (``features/base.py``). A nonlinear feature of the scaled signal becomes another
function, so its coefficient is learned again. This happens in the first motions, and when a motion
is larger than all before.

*Rest.* A signal that does not move is replaced by its mean, and θ is not updated while nothing
moves (``learners/base.py``): a load that comes at rest carries no information on the features.

*Bias.* A fast bias d follows what θ does not explain, ``d' = λ (Δf̂ + f_L^F − θ·φ^F − d)``, and is
added to f_L. θ is updated without d: two estimates that learn from a common remainder would divide
it arbitrarily.

*Input.* With ``Input()`` the last feature is u itself. f_L is then affine in u, and the controller
solves for u exactly. The effective gain ``(b0 + θ_u)/b0`` is kept in an interval: as it goes to
zero, the gain of the loop goes to infinity.

Normalised least mean squares: the cheapest rule, O(p) a sample.

    θ ← θ + rate dt · φ ε / (ρ + φ·φ)

with the error ε and the filtered features φ. Along φ the error decays as ``exp(−rate t)``, for
features of any size and for any dt; it decays more slowly where noise hides it
(``confidence`` of ``learners/base.py``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.features import Features
from quell.features.base import reset_scale, reset_sizes, update_scale, write, write_units
from quell.kernels.dispatch import generic, generic_with_default, is_finite, kernel
from quell.kernels.sized import Flag, Scalars, Size, Work, clear
from quell.learners.base import (
    FeatureLearner,
    Inputs,
    NoiseGateMemory,
    adapt,
    coefficients,
    commit,
    confidence,
    features_first,
    forget,
    lag_memory,
    lag_of,
    lag_push,
    meaning,
    noise_gate_memory,
    predict,
    reset_gate,
    reset_lag,
    restart,
    update_feature_sizes,
    update_gate,
    write_features,
)
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# ---- Kernels of the learners f_L = θ · φ(x̂, u) that compensate the observer's lag exactly ----

# Below this confidence nothing is learned: noise that stays constant for several samples has more
# effect than the white noise that the gate assumes. Chosen by hand; not tuned further.
LEAST_CONFIDENCE = 0.1


# Samples are counted up to this; in single precision a count ends at 2²⁴. It is longer than any
# start of a loop that is fast enough for its observer.
MOST_SAMPLES = 2.0**23


@generic
def update_theta(
    rule: Any, memory: Any, theta: Vector, features: Vector, error: float, confidence: float
) -> None:
    """Move ``theta`` (p,) to reduce ``error = target − θ·features``.

    ``confidence``, in (0, 1], is the share of the target that is not noise.
    """
    raise TypeError


@generic
def reset_uncertainty(rule: Any, memory: Any) -> None:
    """Set the uncertainty of θ back to the prior: the features have changed their meaning."""
    raise TypeError


@generic_with_default
def share_excess(rule: Any, memory: Any, theta: Vector, i: int, excess: float) -> None:
    """Move the other coefficients of ``theta`` (p,) as a limit takes ``excess`` from the one at i.

    A rule without a covariance does not know how they belong together: they stay.
    """


@generic_with_default
def restart_rule(rule: Any, memory: Any, theta: Vector) -> None:
    """Start from rest: the position may have another origin now. By default nothing changes."""


@generic_with_default
def forget_rule(rule: Any, memory: Any) -> None:
    """Forget what the rule keeps besides θ; by default only ``reset_uncertainty``."""
    reset_uncertainty(rule, memory)


@generic_with_default
def convert_rule(rule: Any, memory: Any, ratio: float) -> None:
    """Convert what the rule keeps in units of the scaled f, which is now ``ratio`` of before."""


@kernel
def keep_within(
    rule: Any, memory: Any, theta: Vector, i: int, lowest: float, highest: float
) -> None:
    """Move ``theta`` (p,) so that its coefficient ``i`` is between ``lowest`` and ``highest``."""
    within = min(max(theta[i], lowest), highest)
    excess = theta[i] - within
    if excess != 0.0:
        share_excess(rule, memory, theta, i, excess)
    theta[i] = within


class LinearDesign(NamedTuple):
    """Parameters for p features, a plant of order n and an observer with N = n + 1 states."""

    inputs: Inputs
    lag: Any
    rule: Any
    constant: Size  # index of the feature that is the constant 1; −1 without one
    with_u: Flag
    slope_low: float  # least θ_u, in the plant's units
    slope_high: float  # largest θ_u
    depends: Matrix  # (p, n + 1): 1 if a feature depends on the state or on u, else 0


class LinearLoop(Scalars):
    """Scalars of a linear learner, kept from one sample to the next."""

    samples: float  # since the start from rest
    has_scale: float  # 1 once there are scales
    bias: float  # d, in the plant's units
    learn_after: float  # number of the sample after which θ is updated


class LinearMemory(NamedTuple):
    """State of a linear learner."""

    theta: Vector  # (p,), scaled
    scale: Vector  # (n + 2,): what x_1 … x_n, u and f are divided by
    sizes: Vector  # (k,): what features of unknown size are divided by
    old_scale: Work  # work space (n + 2,)
    scaled: Work  # work space for the scaled state (n,)
    features: Work  # work space (p,)
    units: Vector  # (p,): ``unit`` of the features for ``scale``
    chain: Matrix  # (p, N): the lag filters of the features
    filtered: Vector  # (p,): their outputs
    loop: NDArray[LinearLoop]
    gate: NoiseGateMemory
    rule: Any


@adapt.register(LinearDesign)
def _adapt(
    learner: LinearDesign,
    memory: LinearMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    loop, theta, inputs = memory.loop[0], memory.theta, learner.inputs
    moves = update_gate(inputs.gate, memory.gate, estimates, y, u_before)
    if loop.samples <= inputs.startup:
        return
    rescale(learner, memory, estimates, u_before, f_plain)
    if loop.samples <= inputs.startup:
        return
    scale = memory.scale
    error = f_plain / scale[scale.size - 1]
    for i in range(theta.size):
        error -= theta[i] * memory.filtered[i]
    if not is_finite(error):
        return
    loop.bias += inputs.bias_gain * (error * scale[scale.size - 1] - loop.bias)
    share = confidence(inputs.gate, memory.gate, scale[0])
    if not moves or share < LEAST_CONFIDENCE or loop.samples <= loop.learn_after:
        return
    update_theta(learner.rule, memory.rule, theta, memory.filtered, error, share)
    if learner.with_u:
        last = theta.size - 1
        in_plant = scale[scale.size - 1] / scale[scale.size - 2]
        low, high = learner.slope_low / in_plant, learner.slope_high / in_plant
        keep_within(learner.rule, memory.rule, theta, last, low, high)


@kernel
def rescale(
    learner: LinearDesign, memory: LinearMemory, estimates: Vector, u: float, f: float
) -> None:
    """Let the scales grow, and convert what is in their units."""
    theta, scale, old, units = memory.theta, memory.scale, memory.old_scale, memory.units
    loop, inputs, last = memory.loop[0], learner.inputs, scale.size - 1
    for i in range(scale.size):
        old[i] = scale[i]
    update_scale(inputs.scaling, scale, estimates, u, f, True)
    grown = update_feature_sizes(inputs, memory, estimates, u, True)
    if loop.has_scale == 0.0:
        # There were no features before this sample: the filters have to settle once more.
        loop.has_scale = 1.0
        loop.samples = 0.0
        write_units(inputs.features, inputs.unscaled, scale, memory.sizes, units)
        return
    if scale[last] != old[last]:
        for i in range(theta.size):
            theta[i] *= old[last] / scale[last]
        convert_rule(learner.rule, memory.rule, old[last] / scale[last])
    for j in range(last):
        grown = grown or scale[j] != old[j]
    if not grown:
        return
    write_units(inputs.features, inputs.unscaled, scale, memory.sizes, memory.features)
    converted = False
    for i in range(theta.size):
        affected = memory.features[i] != units[i]
        for j in range(last):
            affected = affected or (scale[j] != old[j] and learner.depends[i, j] > 0.0)
        if not affected:
            continue
        converted = True
        ratio = memory.features[i] / units[i]
        units[i] = memory.features[i]
        if ratio == 1.0 or not ratio > 0.0:
            # The feature is another function now: its coefficient is zero until the filter has
            # settled.
            ratio = theta[i] = 0.0
            loop.learn_after = loop.samples + inputs.startup
        else:
            theta[i] /= ratio
        memory.filtered[i] *= ratio
        for j in range(memory.chain.shape[1]):
            memory.chain[i, j] *= ratio
    if converted:
        reset_uncertainty(learner.rule, memory.rule)


@predict.register(LinearDesign)
def _predict(
    learner: LinearDesign, memory: LinearMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    if memory.loop[0].has_scale == 0.0:
        return 0.0, 0.0
    theta, scale = memory.theta, memory.scale
    write_features(learner.inputs, memory, estimates, u_before, memory.features)
    size = theta.size - 1 if learner.with_u else theta.size
    constant = 0.0
    for i in range(size):
        constant += theta[i] * memory.features[i]
    f_scale = scale[scale.size - 1]
    slope = theta[size] * f_scale / scale[scale.size - 2] if learner.with_u else 0.0
    return f_scale * constant + memory.loop[0].bias, slope


@commit.register(LinearDesign)
def _commit(
    learner: LinearDesign, memory: LinearMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    loop = memory.loop[0]
    if loop.samples < MOST_SAMPLES:
        loop.samples += 1.0
    elif loop.learn_after > 0.0:
        loop.learn_after -= 1.0
    if loop.has_scale == 0.0:
        return
    write_features(learner.inputs, memory, estimates, u, memory.features)
    for i in range(memory.filtered.size):
        memory.filtered[i] = lag_push(learner.lag, memory.chain, i, memory.features[i])


@restart.register(LinearDesign)
def _restart(learner: LinearDesign, memory: LinearMemory) -> None:
    loop = memory.loop[0]
    loop.samples = loop.bias = loop.learn_after = 0.0
    reset_lag(memory.chain)
    for i in range(memory.filtered.size):
        memory.filtered[i] = 0.0
    reset_gate(memory.gate)
    finite = True
    for i in range(memory.theta.size):
        finite = finite and is_finite(memory.theta[i])
    if finite:
        restart_rule(learner.rule, memory.rule, memory.theta)
    else:
        _forget_theta(learner, memory)


@kernel
def _forget_theta(learner: LinearDesign, memory: LinearMemory) -> None:
    for i in range(memory.theta.size):
        memory.theta[i] = 0.0
    forget_rule(learner.rule, memory.rule)


@forget.register(LinearDesign)
def _forget(learner: LinearDesign, memory: LinearMemory) -> None:
    restart(learner, memory)
    clear(memory.loop)
    _forget_theta(learner, memory)
    reset_scale(learner.inputs.scaling, memory.scale)
    reset_sizes(memory.sizes)
    for i in range(memory.units.size):
        memory.units[i] = 1.0


@coefficients.register(LinearDesign)
def _coefficients(learner: LinearDesign, memory: LinearMemory, theta: Vector) -> None:
    f_scale = memory.scale[memory.scale.size - 1]
    scaled = memory.loop[0].has_scale > 0.0
    for i in range(theta.size):
        theta[i] = memory.theta[i] * memory.units[i] * f_scale if scaled else 0.0
    if learner.constant >= 0:
        theta[learner.constant] += memory.loop[0].bias


@meaning.register(LinearDesign)
def _meaning(learner: LinearDesign) -> Any:
    return meaning(learner.inputs), learner.constant, learner.with_u, type(learner.rule).__name__


# ---- The base class of the learners that are linear in θ ----


GAIN_INTERVAL = (0.5, 2.0)
"""Limits of the effective gain over b0 by default."""


class Linear(FeatureLearner):
    """Base class of linear learners; a subclass defines the rule that finds θ.

    Parameters
    ----------
    gain_interval
        limits of the effective gain ``(b0 + θ_u)/b0`` if ``Input()`` is a feature.

    The other parameters are described in the base class ``FeatureLearner``.
    """

    def __init__(
        self,
        features: Features | None,
        frequency: float | None,
        scale: Any,
        gain_interval: tuple[float, float],
        bias_bandwidth: float | None,
    ) -> None:
        super().__init__(features, frequency, scale, bias_bandwidth)
        self.gain_interval = checks.around_one("gain_interval", gain_interval)
        if not self.features.has_input and self.gain_interval != GAIN_INTERVAL:
            raise ValueError(
                f"gain_interval = {gain_interval!r}: has no effect without u among the features; "
                "leave it out, or add Input() to features"
            )

    def rule(self, observer: ESO, omega_c: float, features: int) -> Any:
        """Return the parameters of the rule (a NamedTuple)."""
        raise NotImplementedError

    def rule_memory(self, rule: Any, features: int) -> Any:
        """Return the initial state of the rule (an array or a NamedTuple of arrays)."""
        raise NotImplementedError

    def design(self, observer: ESO, omega_c: float) -> LinearDesign:
        """Return the parameters for an observer and the controller's bandwidth [rad/s]."""
        order, inputs = observer.order, self._inputs(observer, omega_c)
        p = len(self.features.names(order))
        slopes = sorted(observer.b0 * (share - 1.0) for share in self.gain_interval)
        return LinearDesign(
            inputs=inputs,
            lag=lag_of(observer),
            rule=self.rule(observer, omega_c, p),
            constant=self.features.constant(order),
            with_u=self.features.has_input,
            slope_low=slopes[0],
            slope_high=slopes[1],
            depends=_dependence(inputs.features, order, p),
        )

    def memory(self, parameters: LinearDesign) -> LinearMemory:
        """Return the state before anything is learned."""
        n = parameters.inputs.order
        p = len(self.features.names(n))
        return LinearMemory(
            theta=np.zeros(p),
            scale=self._initial_scale(parameters.inputs),
            sizes=self._initial_sizes(parameters.inputs),
            old_scale=np.zeros(n + 2),
            scaled=np.zeros(n),
            features=np.zeros(p),
            units=np.ones(p),
            chain=lag_memory(parameters.lag, p),
            filtered=np.zeros(p),
            loop=LinearLoop.zeros(),
            gate=noise_gate_memory(parameters.inputs.gate),
            rule=self.rule_memory(parameters.rule, p),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return the names of the features."""
        return self.features.names(order)


def _dependence(features: Any, n: int, p: int) -> Matrix:
    """Return which features depend on which state and on u (p, n + 1); test ten random points."""
    rng, depends = np.random.default_rng(0), np.zeros((p, n + 1))
    one, other = np.zeros(p), np.zeros(p)
    for point in rng.uniform(-1.0, 1.0, (10, n + 1)):
        write(features, point[:n], float(point[n]), one)
        for j in range(n + 1):
            moved = point.copy()
            moved[j] = rng.uniform(-1.0, 1.0)
            write(features, moved[:n], float(moved[n]), other)
            depends[:, j] = np.maximum(depends[:, j], one != other)
    return depends


# ---- Normalised least mean squares ----


class NlmsRule(NamedTuple):
    """Parameters."""

    gain: float  # rate · dt, at most 1
    floor: float  # ρ


@update_theta.register(NlmsRule)
def _update_theta(
    rule: NlmsRule, memory: Vector, theta: Vector, features: Vector, error: float, confidence: float
) -> None:
    power = rule.floor
    for i in range(theta.size):
        power += features[i] * features[i]
    step = rule.gain * confidence * error / power
    for i in range(theta.size):
        theta[i] += step * features[i]


@reset_uncertainty.register(NlmsRule)
def _reset_uncertainty(rule: NlmsRule, memory: Vector) -> None:
    pass


class NLMS(Linear):
    """Normalised least mean squares on any features.

    θ moves in proportion to the error and nothing else is remembered, so the learner follows
    drifting plants and is hard to mislead. Similar features take long to separate; ``RLS`` is
    better there.

    Parameters
    ----------
    features
        blocks of features; the state and a bias by default.
    rate
        rate at which an observed error decays [1/s]; ``omega_c`` of the controller by default.
    regularisation
        ρ: features smaller than its square root are learned from less. Features are O(1).

    The other parameters are described in the base classes ``Linear`` and ``FeatureLearner``.

    Raises
    ------
    ValueError
        for an argument out of range.

    References
    ----------
    Nagumo & Noda, *A learning method for system identification*, IEEE Trans. Automatic Control 12
    (1967); Haykin, *Adaptive Filter Theory*, chapter on normalised least mean squares.
    """

    def __init__(
        self,
        features: Features | None = None,
        rate: float | None = None,
        *,
        regularisation: float = 1e-2,
        frequency: float | None = None,
        scale: Any = None,
        gain_interval: tuple[float, float] = GAIN_INTERVAL,
        bias_bandwidth: float | None = None,
    ) -> None:
        features, rate = features_first(features, rate, None, "rate")
        super().__init__(features, frequency, scale, gain_interval, bias_bandwidth)
        self.rate = checks.optional(checks.positive, "rate", rate, "1/s")
        self.regularisation = checks.positive("regularisation", regularisation)

    def rule(self, observer: ESO, omega_c: float, features: int) -> NlmsRule:
        """Return step size and regularisation."""
        return NlmsRule(min((self.rate or omega_c) * observer.dt, 1.0), self.regularisation)

    def rule_memory(self, rule: NlmsRule, features: int) -> Vector:
        """Return an empty state; the learner holds θ."""
        return np.zeros(0)
