"""A safe set: bands for y and its rate that no reference, u_0 or learner makes the loop leave.

**The barrier.** For a border y_max of an order-n plant ``y^(n) = b0 u + f − a · x``, let::

    ψ_0 = y_max − y,      ψ_i = (d/dt + α) ψ_{i−1},      i = 1 … n − 1

If ψ_{n−1} never becomes negative, no ψ_i does that begins above zero: each is ψ_{i+1} through a lag
of 1/α. So y does not exceed y_max (exponential control barrier functions: Nguyen & Sreenath,
*American Control Conference* 2016; Ames et al., *European Control Conference* 2019). ψ_{n−1} is
linear in the state::

    ψ_{n−1} = α^(n−1) y_max − c · x,      c_i = C(n − 1, i − 1) α^(n−i)

and one sample later, with u held, it is known exactly: ``x⁺ = Φ x + Γ_u u + Γ_f f``. The condition
is::

    ψ_{n−1}⁺ ≥ λ ψ_{n−1},      λ = exp(−α dt)

It is one bound of u, in closed form, and its limit for dt → 0 is the law of ADRC with the
bandwidth α and the reference y_max::

    c·Γ_u u ≤ (1 − λ) α^(n−1) y_max − c·(Φ − λ I) x̂ − c·Γ_f f̂ − δ                              (1)

For y_min the signs change. A band of the rate y' is the same with n − 1 in place of n. u is changed
as little as these bounds allow; where the two bands contradict each other, that of y counts.

**The margin** δ pays for what is not known (arXiv 2308.13943, 2512.05292: robust barriers with an
estimate of the disturbance). The set has an observer of its own, which receives y and the applied u
and nothing of a learner, so its errors do not depend on what a learner does. They obey::

    e⁺ = (I − L C)(Φ e + w) − L v,      w = ∫ exp(A s) E f'(t − s) ds over a sample

What they do to (1) is ``q = c·(Φ e + w) − λ c·e``. With the sum of the absolute values of the
impulse response of q, δ is the largest ``|q|`` for all signals within the bounds::

    |f'| ≤ f_rate,      |v| ≤ noise,      |b/b0 − 1| ≤ gain_error with |u| ≤ max(|u_min|, |u_max|)

**What holds.** For a plant of that order whose f, noise and gain keep these bounds, a start with
all ψ_i ≥ 0, and an observer that has settled (some lags after a start), ψ_{n−1} ≥ 0 in all samples,
and y and y' stay in their bands: for orders 1 and 2 at all times but for f' dt²/8 of a curve within
a sample, of higher order up to (α dt)² of the band. From a start outside, ψ_{n−1} grows towards
zero as exp(−α t). All of that as long as the limits of u allow what (1) asks for: else u is at the
limit that comes nearest, and the flag ``UNSAFE`` says so. It also says that a measurement was
farther from the expected one than signals within the bounds allow: then a bound does not hold, and
nothing is guaranteed. In a band of width H that takes::

    |b0 u + f| ≤ α² H for n = 2,      3 α³ H for n = 3

So α follows from what the actuator has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import Limits, is_usable, largest_magnitude
from quell.kernels.dispatch import generic_with_default, is_finite, kernel
from quell.kernels.sized import Scalars, clear
from quell.lti.models import System, peak_gain
from quell.observers.eso import ESO
from quell.observers.forms import EsoModel, begin, expected_measurement, observe
from quell.types import Status, Vector

_SAFE_SET_ACTED = int(Status.SAFE_SET_ACTED)
_UNSAFE = int(Status.UNSAFE)

# Nodes and weights for the integral of an absolute value over a sample, and what a change of sign
# between the nodes may add.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_BETWEEN_NODES = 1.01
# An observer has forgotten its start after so many lags: exp(−20) = 2e-9.
_SETTLED_LAGS = 20.0
# Rounding of a measurement and of its prediction, as a share of y; of single precision, too.
_ROUNDING = 1e-6


class NoSafeSet(NamedTuple):
    """The absence of a safe set: nothing bounds u but its limits."""


class NoSafeSetMemory(NamedTuple):
    """State without a safe set."""

    nothing: Vector  # (0,)


class Band(NamedTuple):
    """The bounds that a band of y or of its rate sets for u: ``k r − rest ∓ margin``."""

    low: float  # [y-unit or y-unit/s]; −inf if there is no lower border
    high: float
    border: float  # k: from a border to u
    state: Vector  # from x̂ to the rest (n,)
    f: float  # from f̂ to the rest
    margin: float  # δ in units of u


class SafeSetDesign(NamedTuple):
    """Parameters of a safe set, for a plant of order n."""

    eso: EsoModel  # the observer without learner
    position: Band
    rate: Band
    surprise: float  # largest error of an expected measurement with all signals in their bounds
    settled: float  # samples after which that holds


class SafeSetLoop(Scalars):
    """Scalars of a safe set, kept from one sample to the next."""

    started: float  # 1 after the first finite measurement, else 0
    low: float  # lowest u that keeps the loop in the set
    high: float  # highest u that does
    samples: float  # since the start, up to ``settled``
    surprised: float  # 1 if a measurement was farther from the expected one than bounds allow


class SafeSetMemory(NamedTuple):
    """State of a safe set."""

    z: Vector  # state of the observer without learner (n + 1,)
    estimates: Vector  # of the observer (n + 1,)
    loop: NDArray[SafeSetLoop]  # (1,)


@generic_with_default
def see(design: Any, memory: Any, y: float, u: float) -> None:
    """Take the measurement of a sample, and the u that acted before it."""


@generic_with_default
def nearest_safe(design: Any, memory: Any, u: float) -> tuple[float, int]:
    """Return the u nearest to ``u`` that keeps the loop in the set, and the status flags."""
    return u, 0


BOUNDS = 4
"""Numbers that ``write_bounds`` writes."""


@generic_with_default
def write_bounds(design: Any, memory: Any, row: Vector) -> None:
    """Write the bounds of u by the band of y, and those by both bands, after ``nearest_safe``.

    Without a safe set they are infinite.
    """
    row[0], row[1], row[2], row[3] = -math.inf, math.inf, -math.inf, math.inf


@generic_with_default
def flags_of_applied(design: Any, memory: Any, u: float) -> int:
    """Return the flag for a u, after limits, that does not keep the loop in the set."""
    return 0


@generic_with_default
def forget_motion(design: Any, memory: Any) -> None:
    """Begin at the next measurement."""


@see.register(SafeSetDesign)
def _see(design: SafeSetDesign, memory: SafeSetMemory, y: float, u: float) -> None:
    loop = memory.loop[0]
    if loop.started == 0.0:
        if is_usable(y):
            begin(design.eso, memory.z, memory.estimates, y)
            loop.started = 1.0
        return
    expected = expected_measurement(design.eso, memory.z, u, 0.0)
    loop.surprised = 0.0
    if not is_usable(y):
        y = expected
    elif loop.samples < design.settled:
        loop.samples += 1.0
    elif not abs(y - expected) <= design.surprise + _ROUNDING * abs(y):
        loop.surprised = 1.0
    observe(design.eso, memory.z, memory.estimates, y, u, 0.0)
    if not is_finite(memory.estimates[memory.estimates.size - 1]):
        loop.started = loop.samples = 0.0


@kernel
def _bounds(band: Band, estimates: Vector, low: float, high: float) -> tuple[float, float]:
    """Return the bounds of u within ``low`` … ``high`` that a band leaves, or its nearest ones."""
    rest = band.f * estimates[band.state.size]
    for i in range(band.state.size):
        rest += band.state[i] * estimates[i]
    lowest = band.border * band.low - rest + band.margin
    highest = band.border * band.high - rest - band.margin
    if band.border < 0.0:
        lowest, highest = (
            band.border * band.high - rest + band.margin,
            band.border * band.low - rest - band.margin,
        )
    return max(low, min(lowest, high)), min(high, max(highest, low))


@nearest_safe.register(SafeSetDesign)
def _nearest_safe(design: SafeSetDesign, memory: SafeSetMemory, u: float) -> tuple[float, int]:
    loop = memory.loop[0]
    if loop.started == 0.0:
        return u, 0
    loop.low, loop.high = _bounds(design.position, memory.estimates, -math.inf, math.inf)
    low, high = _bounds(design.rate, memory.estimates, loop.low, loop.high)
    safe = min(max(u, low), high)
    return safe, _SAFE_SET_ACTED if safe != u else 0


@write_bounds.register(SafeSetDesign)
def _write_bounds(design: SafeSetDesign, memory: SafeSetMemory, row: Vector) -> None:
    loop = memory.loop[0]
    row[0], row[1], row[2], row[3] = -math.inf, math.inf, -math.inf, math.inf
    if loop.started != 0.0:
        row[0], row[1] = loop.low, loop.high
        row[2], row[3] = _bounds(design.rate, memory.estimates, loop.low, loop.high)


@flags_of_applied.register(SafeSetDesign)
def _flags_of_applied(design: SafeSetDesign, memory: SafeSetMemory, u: float) -> int:
    loop = memory.loop[0]
    if loop.started == 0.0 or (loop.low <= u <= loop.high and loop.surprised == 0.0):
        return 0
    return _UNSAFE


@forget_motion.register(SafeSetDesign)
def _forget_motion(design: SafeSetDesign, memory: SafeSetMemory) -> None:
    clear(memory.loop)


@generic_with_default
def shift_f(design: Any, memory: Any, change: float) -> None:
    """Add ``change`` to the estimate of f: its meaning has changed with b0 or the model."""


@shift_f.register(SafeSetDesign)
def _shift_f(design: SafeSetDesign, memory: SafeSetMemory, change: float) -> None:
    last = memory.estimates.size - 1
    memory.z[last] += change
    memory.estimates[last] += change


@generic_with_default
def scale_f(design: Any, memory: Any, ratio: float) -> None:
    """Multiply the estimate of f: the loads stay, and the inertia has changed."""


@scale_f.register(SafeSetDesign)
def _scale_f(design: SafeSetDesign, memory: SafeSetMemory, ratio: float) -> None:
    last = memory.estimates.size - 1
    memory.z[last] *= ratio
    memory.estimates[last] *= ratio


@generic_with_default
def divide_bounds(design: Any, memory: Any, ratio: float) -> None:
    """Convert the bounds of ``ratio`` times u, which ``nearest_safe`` found, to those of u."""


@divide_bounds.register(SafeSetDesign)
def _divide_bounds(design: SafeSetDesign, memory: SafeSetMemory, ratio: float) -> None:
    loop = memory.loop[0]
    loop.low /= ratio
    loop.high /= ratio


@generic_with_default
def settle_at_rest(design: Any, memory: Any, y: float, u: float, samples: int) -> None:
    """Let the observer settle at a plant that rests at y under u."""


@settle_at_rest.register(SafeSetDesign)
def _settle_at_rest(
    design: SafeSetDesign, memory: SafeSetMemory, y: float, u: float, samples: int
) -> None:
    begin(design.eso, memory.z, memory.estimates, y)
    for _ in range(samples):
        observe(design.eso, memory.z, memory.estimates, y, u, 0.0)
    memory.loop[0].started = 1.0


@generic_with_default
def set_motion(design: Any, memory: Any, x: Vector, f: float) -> None:
    """Set the observer's estimates to ``x``, of which the first n are taken, and f."""


@set_motion.register(SafeSetDesign)
def _set_motion(design: SafeSetDesign, memory: SafeSetMemory, x: Vector, f: float) -> None:
    last = memory.estimates.size - 1
    begin(design.eso, memory.z, memory.estimates, x[0])
    for i in range(1, last):
        memory.z[i] = memory.estimates[i] = x[i]
    memory.z[last] = memory.estimates[last] = f


def settle_safe_set(design: Any, memory: Any, x: Vector, f: float) -> None:
    """Set the observer of a safe set to given estimates, for a plant that is known there."""
    if isinstance(design, SafeSetDesign):
        size = memory.estimates.size
        memory.estimates[:] = np.append(x, f)
        memory.z[:size], memory.z[size:] = memory.estimates, 0.0
        memory.loop[0].started = 1.0


@dataclass(frozen=True)
class SafeSet:
    """Bands for y and its rate, for ``ADRC(…, safe_set=…)`` and ``Compensator(…, safe_set=…)``.

    The module's docstring has the equations, and what is guaranteed.

    Parameters
    ----------
    y_min, y_max
        band of y [y-unit]; without one border by default.
    rate_min, rate_max
        band of y' [y-unit/s]; none by default. Where both bands can not be kept, y is.
    alpha
        rate at which y may come near to a border [rad/s]: the braking before it is that of a lag
        of 1/alpha. A larger one leaves more of the band to the loop, and asks for more of the
        actuator.
    f_rate
        largest ``|f'|`` of the total disturbance [y-unit/s^(n+1)], of a plant with the observer's
        b0. It says how wrong the estimate of f may be, and so how wide the margin is. With a table
        of b0 the margin is that of its largest one.
    noise
        largest error of the measurement [y-unit], half a step of an encoder for instance.
    gain_error
        largest ``|b/b0 − 1|``; above zero the limits of u must be finite.
    largest_u
        largest ``|u|`` that gain_error is of [u-unit], for a controller without limits of u. Of an
        axis of ``Axes`` it is the largest ``Σ_k |B0_ik u_k|``, and gain_error the largest relative
        error of an entry of B0.

    Raises
    ------
    ValueError
        for bands in the wrong order or none at all, and for numbers that are not positive; in
        ``design`` for an observer with zeros, a delay or another form, and for a band that is
        narrower than the margin.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=100.0, dt=0.001)
    >>> safe = SafeSet(y_max=1.0, alpha=10.0, f_rate=1.0)
    >>> controller = ql.ADRC(observer, omega_c=5.0, safe_set=safe)
    >>> round(safe.margin(observer), 4)  # of u, that is f within 0.03 · b0
    0.0151
    """

    y_min: float = -math.inf
    y_max: float = math.inf
    rate_min: float = -math.inf
    rate_max: float = math.inf
    alpha: float = 10.0
    f_rate: float = 0.0
    noise: float = 0.0
    gain_error: float = 0.0
    largest_u: float = math.inf

    def __post_init__(self) -> None:
        borders = (self.y_min, self.y_max, self.rate_min, self.rate_max)
        checks.interval("y_min", self.y_min, "y_max", self.y_max)
        checks.interval("rate_min", self.rate_min, "rate_max", self.rate_max)
        checks.positive("alpha", self.alpha, "rad/s")
        for name in ("f_rate", "noise", "gain_error"):
            checks.non_negative(name, getattr(self, name))
        if self.gain_error >= 1.0:
            rule = "must be below 1, or the sign of b is not known"
            raise ValueError(f"gain_error = {self.gain_error!r}: {rule}")
        checks.positive_or_infinite("largest_u", self.largest_u, "u-unit")
        if not any(map(math.isfinite, borders)):
            raise ValueError("no border is finite: give y_min, y_max, rate_min or rate_max")
        if math.isfinite(self.largest_u) and self.gain_error == 0.0:
            rule = "says what gain_error is of, which is 0; leave it out or give gain_error"
            raise ValueError(f"largest_u = {self.largest_u!r}: {rule}")

    def design(self, observer: ESO, limits: Limits, ratio: float = 1.0) -> SafeSetDesign:
        """Return the parameters for an observer and limits of u.

        With a schedule b0 is up to ``ratio`` times that of the observer, and so is what f_rate and
        gain_error do; the bounds are those of b0(σ)/b0 u.
        """
        model, n = _plain(observer), observer.order
        if self.alpha * observer.dt > 0.5:
            rule = "alpha * dt must be at most 0.5, or u holds for too long before a border"
            raise ValueError(f"alpha = {self.alpha!r} rad/s with dt = {observer.dt!r} s: {rule}")
        largest = float(largest_magnitude(limits))
        if math.isfinite(largest) and math.isfinite(self.largest_u):
            raise ValueError(
                f"largest_u = {self.largest_u!r}: limits of u say it, {largest:.4g}; leave it out"
            )
        largest = min(largest, self.largest_u)
        if self.gain_error > 0.0 and not math.isfinite(largest):
            raise ValueError(
                f"gain_error = {self.gain_error!r}: the largest |u| bounds what it does; give "
                "u_min and u_max, or largest_u for an axis of quell.Axes"
            )
        how = (largest, ratio)
        position = self._band(observer, model, n, (self.y_min, self.y_max), *how)
        rate = self._band(observer, model, n - 1, (self.rate_min, self.rate_max), *how)
        # The expected measurement is wrong by C (Φ e + w) + v: the same with c = C, λ = 0 and v.
        first = np.eye(n)[0]
        surprise = self._largest_error(observer, model, first, 0.0, *how) + self.noise
        settled = float(round(_SETTLED_LAGS * observer.lag_time / observer.dt))
        return SafeSetDesign(model, position, rate, surprise, settled)

    def memory(self, design: SafeSetDesign) -> SafeSetMemory:
        """Return the state before the first sample."""
        size = design.eso.gain.size
        return SafeSetMemory(np.zeros(size), np.zeros(size), SafeSetLoop.zeros())

    def margin(self, observer: ESO, u_min: float = -math.inf, u_max: float = math.inf) -> float:
        """Return δ of the band of y in units of u: what is kept from each bound of u."""
        limits = Limits(u_min, u_max, math.inf, -math.inf)
        return self.design(observer, limits).position.margin

    def _band(
        self,
        observer: ESO,
        model: EsoModel,
        degree: int,
        borders: tuple[float, float],
        most: float,
        ratio: float,
    ) -> Band:
        """Return the band of the derivative of y that u reaches after ``degree`` integrations."""
        n, dt, (low, high) = observer.order, observer.dt, borders
        if not any(map(math.isfinite, borders)):
            return Band(-math.inf, math.inf, 1.0, np.zeros(n), 0.0, 0.0)
        phi, feed, control = model.transition[:n, :n], model.feed[:n], model.input[:n]
        if degree == 0:  # y' of a plant of order 1: its mean over the sample is (y⁺ − y)/dt
            c, decay, weight = np.ones(1) / dt, 1.0, 1.0
        else:
            c, decay = np.zeros(n), math.exp(-self.alpha * dt)
            for i in range(degree):
                c[n - degree + i] = math.comb(degree - 1, i) * self.alpha ** (degree - 1 - i)
            weight = (1.0 - decay) * self.alpha ** (degree - 1)
        gain = float(c @ control)
        margin = self._largest_error(observer, model, c, decay, most, ratio) / abs(gain)
        state = c @ (phi - decay * np.eye(n)) / gain
        border = weight / gain
        if abs(border) * (high - low) <= 2.0 * margin:
            what = "y_max − y_min" if degree == n else "rate_max − rate_min"
            raise ValueError(
                f"{what} = {high - low:.4g}: must be above {2.0 * margin / abs(border):.4g}, what "
                "errors of the estimate need; make the band wider, alpha or omega_o larger, or "
                "f_rate, noise and gain_error smaller if the machine allows it"
            )
        return Band(low, high, border, state, float(c @ feed) / gain, margin)

    def _largest_error(
        self, observer: ESO, model: EsoModel, c: Vector, decay: float, most: float, ratio: float
    ) -> float:
        """Return δ: the largest |q| for all signals within their bounds."""
        size, dt = model.gain.size, observer.dt
        wide = np.append(c, 0.0)
        correction = np.eye(size) - np.outer(model.gain, np.eye(size)[0])
        N = correction @ model.transition - np.eye(size)
        row = wide @ (model.transition - decay * np.eye(size))

        def largest(entering: Vector) -> float:
            """Return the sum of |q| for a pulse that enters the state."""
            return peak_gain(System(N, correction @ entering, row, float(wide @ entering)))

        total, f_rate = 0.0, ratio * self.f_rate
        if f_rate > 0.0:
            for node, weight in zip(_NODES, _WEIGHTS, strict=True):
                moved = _moved_by_f(observer, 0.5 * dt * (1.0 + float(node)))
                total += _BETWEEN_NODES * 0.5 * dt * float(weight) * f_rate * largest(moved)
        if self.gain_error > 0.0:
            step = np.append(model.feed[:-1], 0.0)
            total += self.gain_error * abs(ratio * observer.b0) * most * largest(step)
        if self.noise > 0.0:
            total += self.noise * peak_gain(System(N, model.gain, row, 0.0))
        return total


def _plain(observer: ESO) -> EsoModel:
    """Return the model of an observer for which equation (1) holds."""
    model = observer.model
    if observer.plant.zeros.size or observer.degree != observer.order:
        raise ValueError(
            "safe_set: the plant has zeros, so derivatives of y are not its states; take a "
            "model-free observer of the relative degree, or a model without zeros"
        )
    if not isinstance(model, EsoModel) or model.predictor:
        raise ValueError(
            "safe_set: the observer must be a linear one in the current form, without a delay of u "
            "and with disturbance_order=1; a barrier on a late or nonlinear estimate is not proved"
        )
    if observer.disturbance_order > 1 or observer.cancel_f == 0.0:
        raise ValueError(
            "safe_set: needs disturbance_order=1 and f that enters the plant where u does"
        )
    return model


def _moved_by_f(observer: ESO, time: float) -> Vector:
    """Return exp(A s) E (n + 1,): where a unit pulse of f' has moved state and f after a time."""
    from scipy.linalg import expm

    n = observer.order
    A = np.zeros((n + 1, n + 1))
    A[: n - 1, 1:n] = np.eye(n - 1)
    A[n - 1, :n] = -observer.cancel
    A[n - 1, n] = 1.0
    return expm(A * time)[:, -1]


__all__ = ["SafeSet"]
