"""The plant behind a lag and a delay in a running loop: predictor and prediction-error fits.

The predictor of a plant behind a lag and a delay, under a drifting load: sampled exactly.

    y^(n) + a_{n−1} y^(n−1) + … + a_0 y = b u_l + d + w
    d' = −λ d + w_d,     τ u_l' + u_l = u(t − T)

This is the model that ADRC has, y^(n) = f + b u, with the part of f that is linear; a load d that
forgets has λ > 0. For white w, w_d and white noise in y the best prediction of y from the samples
before is that of a Kalman filter, in the innovation form (Ljung, *System Identification*, 2nd ed.
1999, eqs. (4.91), (4.92))::

    x⁺ = Φ x + Γ u + K e,      e = y − ŷ,      ŷ = x_1

with ``x = (x_1 … x_n, d, u_l)`` and free gains K, so that the noises' intensities need not be
known. K is Φ's integral over the sample times ``(l_1 … l_{n+2})``, the last one, of u_l, for a load
in front of the lag. The predictor's matrix ``Φ − K
C`` has to be stable; the plant's need not be.

Without loads only y is noisy, and K follows from the plant. It is zero for a stable plant, whose
state is simulated. The state of an unstable plant cannot be: its best predictor has the unstable
poles mirrored at the unit circle, and the others where the plant has them (Anderson & Moore,
*Optimal Filtering*, 1979, sec. 4.4, for a noise of the state that goes to zero). With λ_j the
unstable poles, ``z_j = exp(λ_j)``, and v_j the eigenvectors of the plant with ``C v_j = 1``::

    K = Σ_j v_j Π_i (z_j − 1/z_i*) / Π_{i≠j} (z_j − z_i)

A sample is a unit of time, as in ``sampling``. u is held between samples, and T need not be a whole
number of them: in a sample the u before acts for the part ``T − ⌊T⌋``, then the next one for the
rest. For given a, l, τ and T, ŷ is linear in b and the initial state.

u may begin before y: its last N samples belong to those of y. So a delay needs no u that is not
known; before its own first sample u is taken to have had that value.

One of several coupled axes is the same plant with several u, behind one lag and one delay, and
with the measured y of the other axes as known inputs::

    y_i^(n) + … + a_0 y_i = Σ_j b_j u_l,j + Σ_k Σ_p c_kp y_k^(p) + d + w,     p < n

so that what couples the axes beyond B0, of friction or gravity for instance, is no load. In the
observable form above ``c_kp y_k`` enters the state ``x_(n−p)``, so no y is differentiated.

Prediction-error fits of the plant behind a lag and a delay.

In a running loop u reacts to noise and loads. The *direct method* needs no knowledge of the
controller: the parameters minimise the error of the prediction one sample ahead (Ljung, *System
Identification*, 2nd ed. 1999, eq. (7.12))::

    min Σ e_k²,      e = y − ŷ(φ, β)

It is consistent in any loop, also with limits or a nonlinear controller, if u reaches y a sample
later at the earliest (it is held) and the model of the noise is true (Ljung 1999, th. 8.3 and sec.
13.4). The output error alone, a model without loads, is biased by them. For given φ the best β is
solved for; φ takes steps of Gauss and Newton, damped by Levenberg and Marquardt's method. In a loop
the errors of plant and noise model depend on each other, so the covariance is that of all
parameters together::

    cov = σ² (Σ ψ ψᵀ)⁻¹,     ψ = ∂ŷ/∂(φ, β)

if e is white, as for a true model of the noise. If it is not quite true, the covariance from sums
of ψ e over blocks of the record holds (``output_error``); the one in which b varies more is taken.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.identification.model import nonzero_lengths, observable
from quell.identification.output_error import block_sums
from quell.kernels.dispatch import compiled
from quell.lti.models import Stack, zero_order_hold
from quell.types import Matrix, Vector

# ---- The predictor of a plant behind a lag and a delay, under a drifting load ----

# Step of the differences that stand for derivatives, relative to the size of the parameters:
# between rounding of the simulation (1e-12) and curvature (second order).
_STEP = 1e-4
# Largest |z| of a stable predictor: one, and rounding of multiple eigenvalues at z = 1.
_LIMIT = 1.0 + 1e-6
# Growth over the record by which a pole may be below the limit and count as at it: no effect on ŷ.
_AT_LIMIT = 0.1
# Least time constant of the lag [samples], so that 1/τ is finite.
_LEAST_LAG = 1e-6
# Growth of an unstable pole's motion over the record, from which on it is not simulated but
# predicted [log]: a factor of 1000 leaves 13 digits. Below, the predictor would have to settle for
# a large part of the record.
_LARGEST_GROWTH = math.log(1e3)
# Largest coefficient of the model [1/sample^n] that is sampled; 1/τ is the largest that has a use.
_LARGEST = 1e7

# States below this become zero, as in ``sampling``: denormal numbers are slow.
_TINY = 1e-140

Complex = NDArray[np.complex128]
Indices = NDArray[np.int64]


class Inputs(NamedTuple):
    """What moves an axis and is known."""

    u: Matrix  # of the actuators (N and more, m)
    others: Matrix  # mean y of the other axes over each sample (N, number)

    @classmethod
    def of(cls, u: Vector, y: Vector) -> Inputs:
        """Return those of a single axis."""
        return cls(u[:, None], np.zeros((y.size, 0)))


class Predictor(NamedTuple):
    """A sampled predictor ``x⁺ = Φ x + Γ v`` for the u before, the u after T's change, and y."""

    phi: Matrix  # Φ − K C (states, states)
    gamma: Matrix  # (states, 3)
    integral: Matrix  # of the plant's Φ over a sample (states, states)


class Form(NamedTuple):
    """The parameters of a model: a, l, λ, τ, T are *nonlinear*, b and the initial state linear."""

    order: int  #: n
    lag: bool  #: whether τ is free; else it is 0
    delay: bool  #: whether T is free; else it is 0
    drift: bool  #: whether l are free; else K follows from the plant, and only y is noisy
    forgets: bool = False  #: whether λ is free; else it is 0
    share: float | None = None
    """The given share of τ in τ + T, which is then the only time that is free; None if both are."""
    actuators: int = 1  #: m, the number of u
    couplings: tuple[tuple[int, int], ...] = ()
    """Number k and derivative p of the y of other axes that act on this one."""

    @property
    def gains(self) -> slice:
        """Places of l."""
        return slice(self.order, self.order + self.drift * (self.order + 1 + self.lag))

    @property
    def times(self) -> slice:
        """Places of τ and T."""
        return slice(self.gains.stop + self.forgets, self.size)

    @property
    def non_negative(self) -> slice:
        """Places of λ, τ and T."""
        return slice(self.gains.stop, self.size)

    @property
    def size(self) -> int:
        """Number of nonlinear parameters."""
        times = self.lag + self.delay if self.share is None else 1
        return self.gains.stop + self.forgets + times

    @property
    def of_times(self) -> int:
        """Number of parameters that a form without lag and delay does not have."""
        return self.lag + self.delay + (self.lag and self.drift)

    @property
    def gains_of_u(self) -> slice:
        """Places of b among all parameters, φ before β."""
        return slice(self.size, self.size + self.actuators)

    @property
    def known(self) -> int:
        """Number of linear parameters before the initial state: b and c."""
        return self.actuators + len(self.couplings)

    @property
    def states(self) -> int:
        """Number of states."""
        return self.order + 1 + self.lag

    def rate_of(self, phi: Vector) -> float:
        """Return λ [1/sample]."""
        return float(phi[self.gains.stop]) if self.forgets else 0.0

    def lag_of(self, phi: Vector) -> float:
        """Return τ [samples]."""
        share = 1.0 if self.share is None else self.share
        return share * float(phi[self.times][0]) if self.lag else 0.0

    def delay_of(self, phi: Vector) -> float:
        """Return T [samples]."""
        share = 0.0 if self.share is None else self.share
        return (1.0 - share) * float(phi[-1]) if self.delay else 0.0


def placed(a: Vector, omega: float) -> Vector:
    """Return a and the gains l that put all poles of ``s^(n+1) + …`` at −omega [1/sample]."""
    target = np.poly(np.full(a.size + 1, -omega)).real[1:]
    return np.concatenate([a, target - np.append(a[::-1], 0.0)])


def is_stable(form: Form, phi: Vector, samples: int) -> bool:
    """Return whether the predictor is stable, or at its limit; one without loads always is."""
    closed = _predictor(form, phi, samples).phi
    if not np.all(np.isfinite(closed)):
        return False
    return not form.drift or bool(np.max(np.abs(np.linalg.eigvals(closed))) <= _LIMIT)


def is_unstable(form: Form, phi: Vector, samples: int) -> bool:
    """Return whether the plant has a pole whose motion grows too far to be simulated."""
    return bool(samples * np.max(_poles(phi[: form.order]).real) > _LARGEST_GROWTH)


def stabilised(form: Form, phi: Vector, samples: int) -> Vector:
    """Return phi with gains l that mirror the poles of an unstable predictor at the unit circle.

    The error has the same spectrum, to a factor, so that a search may cross the limit.
    """
    if not form.drift:
        return phi
    system = _predictor(form, phi, samples)
    if not np.all(np.isfinite(system.phi)):
        return phi
    z, vectors = np.linalg.eig(system.phi)
    out = np.abs(z) > _LIMIT
    if not np.any(out):
        return phi
    with np.errstate(all="ignore"):
        shift = _shift(z[out], vectors[:, out] / vectors[0, out])
        _, (integral,) = zero_order_hold(_motion(form, phi), [np.eye(form.states)], 1.0)
    if not np.all(np.isfinite(shift)):
        return phi
    found = phi.copy()
    found[form.gains] += np.linalg.lstsq(integral, shift, rcond=None)[0]
    return found


def limit_slopes(form: Form, phi: Vector, y: Vector) -> Matrix:
    """Return the derivatives (number, size) by phi of |z| of the predictor's poles at the limit."""

    def sizes(at: Vector) -> Vector:
        closed = _predictor(form, at, y.size).phi
        if not np.all(np.isfinite(closed)):
            return np.full(form.states, np.nan)
        return np.sort(np.abs(np.linalg.eigvals(closed)))[::-1]

    count = int(np.sum(sizes(phi) > 1.0 - _AT_LIMIT / y.size)) if form.drift else 0
    slopes = np.zeros((count, form.size))
    for i, step in enumerate(_steps(form, y) if count else ()):
        one = step * (np.arange(form.size) == i)
        slopes[:, i] = (sizes(phi + one)[:count] - sizes(phi - one)[:count]) / (2.0 * step)
    return slopes


def growth(form: Form, phi: Vector, samples: int) -> float:
    """Return by how much unstable poles that are simulated grow over the record, as a logarithm.

    By twice as much the logarithm of the determinant of the initial state's information grows: the
    likelihood of the output counts it, its sum of squares does not.
    """
    rates = samples * _poles(phi[: form.order]).real
    return 0.0 if form.drift else float(np.sum(rates[(rates > 0.0) & (rates <= _LARGEST_GROWTH)]))


def linear_columns(form: Form, phi: Vector, u: Inputs, y: Vector) -> tuple[Matrix, Vector]:
    """Return ŷ by b, c and each initial state (N, known + states), and its part from y (N,)."""
    system, count, known = _predictor(form, phi, y.size), form.states, form.known
    size, m = known + count + 1, form.actuators
    gamma, start = np.zeros((count, 3, size)), np.zeros((count, size))
    gamma[:, :2, :m], gamma[:, 2, -1] = system.gamma[:, :2, None], system.gamma[:, 2]
    of_u, of_y = np.zeros((2, size), dtype=np.int64)
    of_u[:m] = np.arange(m)
    for i, (k, p) in enumerate(form.couplings):
        gamma[:, 2, m + i], of_y[m + i] = system.integral[:, form.order - 1 - p], k + 1
    start[:, known:-1] = np.eye(count)
    phis = np.repeat(system.phi[:, :, None], size, axis=2)
    late = np.full(size, _whole(form, phi))
    found = _simulated(phis, gamma, (late, of_u, of_y), start, u.u, np.column_stack([y, u.others]))
    return found[:, :-1], found[:, -1]


def predicted(form: Form, phis: list[Vector], beta: Vector, u: Inputs, y: Vector) -> Matrix:
    """Return ŷ (N, number) for each phi and the linear parameters ``beta``: b, c, initial state."""
    systems = [_predictor(form, phi, y.size) for phi in phis]
    gamma = np.stack([one.gamma for one in systems], axis=2)
    start = np.repeat(beta[form.known :, None], len(phis), axis=1)
    late = np.array([_whole(form, phi) for phi in phis])
    phi = np.stack([one.phi for one in systems], axis=2)
    moving = u.u @ beta[: form.actuators]
    none = np.zeros(late.size, dtype=np.int64)
    found = _simulated(phi, gamma, (late, none, none), start, moving[:, None], y[:, None])
    for p in sorted({p for _, p in form.couplings}):
        parts = zip(form.couplings, beta[form.actuators : form.known], strict=True)
        acting = sum((c * u.others[:, k] for (k, q), c in parts if q == p), np.zeros(y.size))
        gamma = np.zeros((form.states, 3, late.size))
        gamma[:, 2] = np.stack([one.integral[:, form.order - 1 - p] for one in systems], axis=1)
        found += _simulated(
            phi, gamma, (late, none, none), 0.0 * start, moving[:, None], acting[:, None]
        )
    return found


def derivatives(form: Form, phi: Vector, beta: Vector, u: Inputs, y: Vector) -> Matrix:
    """Return the derivatives (N, size) of ŷ by a, l, λ, τ and T, by central differences."""
    steps = np.diag(_steps(form, y))
    above, below = phi + steps, phi - steps
    # λ, τ and T are not negative; at zero the difference is one-sided.
    for i in range(form.non_negative.start, form.size):
        below[i, i] = phi[i] if below[i, i] < 0.0 else below[i, i]
    found = predicted(form, [*above, *below], beta, u, y)
    return (found[:, : form.size] - found[:, form.size :]) / np.diag(above - below)


def responses(form: Form, phi: Vector, samples: int, omega: Vector) -> tuple[Vector, Vector]:
    """Return the absolute frequency responses from u and from e to y, with b = 1, at ``omega``.

    ``omega`` is in 1/sample and not zero. The response to e is ``det(z I − Φ + K C)/det(z I − Φ)``.
    """
    system = _predictor(form, phi, samples)
    plant = system.phi.copy()
    plant[:, 0] += system.gamma[:, 2]
    z, s = np.exp(1j * omega)[:, None], 1j * omega
    with np.errstate(all="ignore"):  # a pole at a frequency
        ratio = (z - np.linalg.eigvals(system.phi)) / (z - np.linalg.eigvals(plant))
        of_u = 1.0 / np.polyval(np.append(1.0, phi[: form.order][::-1]), s)
        of_u = of_u / (1.0 + form.lag_of(phi) * s)
    return np.abs(of_u), np.abs(np.prod(ratio, axis=1))


def _steps(form: Form, y: Vector) -> Vector:
    """Return steps of the parameters, small in relation to the speed of y's motion."""
    n = form.order
    slow = 2.0 * math.pi / y.size
    spread = float(np.std(y)) or 1.0
    rate = float(np.clip(np.std(y[n:] - y[:-n]) / (n * spread), 10.0 * slow, 0.3))
    gains = np.minimum(np.arange(1.0, n + 3.0), n + 1.0)
    powers = np.append(n - np.arange(float(n)), gains)[: form.gains.stop]
    powers = np.append(powers, np.ones(int(form.forgets)))
    times = np.full(form.size - form.times.start, 1.0 / rate)
    return _STEP * np.append(rate**powers, times)


def _predictor(form: Form, phi: Vector, samples: int) -> Predictor:
    """Return the predictor, for the inputs u before, u after the delay's change, y.

    Its matrices are NaN for parameters that are too large for numbers.
    """
    n, size = form.order, form.states
    A, B = _motion(form, phi), np.zeros((size, 2))
    if form.drift:
        B[:, 1] = phi[form.gains]
    B[n + 1 if form.lag else n - 1, 0] = -A[n + 1, n + 1] if form.lag else 1.0
    if not (np.max(np.abs(A)) <= _LARGEST and np.all(np.isfinite(B))):
        nothing = np.full((size, size), np.nan)
        return Predictor(nothing, np.full((size, 3), np.nan), nothing)
    late = math.modf(form.delay_of(phi))[0]
    with np.errstate(all="ignore"):
        # The integral of Φ does not depend on l: most derivatives find it in the cache.
        whole, (integral,) = zero_order_hold(A, [np.eye(size)], 1.0)
        _, (rest,) = zero_order_hold(A, [np.eye(size)], 1.0 - late)
        gamma, now = integral @ B, rest @ B[:, 0]
        K = gamma[:, 1] if form.drift else _mirroring(phi[:n], size, samples)
        whole[:, 0] -= K
    return Predictor(whole, np.column_stack([gamma[:, 0] - now, now, K]), integral)


def _motion(form: Form, phi: Vector) -> Matrix:
    """Return the matrix of x' = A x + …, with a load and the lag."""
    n, A = form.order, np.zeros((form.states, form.states))
    A[:n, :n] = observable(phi[:n])
    A[n - 1, n], A[n, n] = 1.0, -form.rate_of(phi)
    if form.lag:
        A[n - 1, n + 1], A[n + 1, n + 1] = 1.0, -1.0 / max(form.lag_of(phi), _LEAST_LAG)
    return A


def _poles(a: Vector) -> Complex:
    """Return the poles of the plant [1/sample]."""
    return np.asarray(np.linalg.eigvals(observable(a)), dtype=np.complex128)


def _mirroring(a: Vector, states: int, samples: int) -> Vector:
    """Return the K (states,) that mirrors the unstable poles, those that grow over the record."""
    K, poles = np.zeros(states), _poles(a)
    poles = poles[samples * poles.real > _LARGEST_GROWTH]
    vectors = np.ones((a.size, poles.size), dtype=np.complex128)
    for i in range(1, a.size):  # v_1 = 1, v_(i+1) = λ v_i + a_(n−i)
        vectors[i] = poles * vectors[i - 1] + a[a.size - i]
    K[: a.size] = _shift(np.exp(poles), vectors)
    return K


def _shift(z: Complex, vectors: Complex) -> Vector:
    """Return the gains that mirror the eigenvalues z; the eigenvectors begin with 1."""
    weights = np.ones(z.size, dtype=np.complex128)
    for j in range(z.size):
        others = np.arange(z.size) != j
        weights[j] = np.prod(z[j] - 1.0 / z.conj()) / np.prod(z[j] - z[others])
    return np.asarray((vectors @ weights).real)


def _whole(form: Form, phi: Vector) -> int:
    """Return ⌊T⌋."""
    return math.floor(form.delay_of(phi))


def _simulated(
    phis: Stack,
    gammas: Stack,
    places: tuple[Indices, Indices, Indices],
    start: Matrix,
    u: Matrix,
    y: Matrix,
) -> Matrix:
    """Return x_1 (N, number) of systems, whose last axis is their number, that start at ``start``.

    ``places`` has, of each, ⌊T⌋ and the columns of u and y that move it. Their loop has the
    systems inside, so that they are computed together.
    """
    out = np.empty((y.shape[0], start.shape[1]))
    states, inputs = np.stack([start, start]), np.empty((3, start.shape[1]))
    u, y = np.ascontiguousarray(u), np.ascontiguousarray(y)
    _simulate(phis, gammas, *places, states, inputs, u, y, out)
    return out


@compiled
def _simulate(
    phis: Stack,
    gammas: Stack,
    late: Indices,
    of_u: Indices,
    of_y: Indices,
    states: Stack,
    inputs: Matrix,
    u: Matrix,
    y: Matrix,
    out: Matrix,
) -> None:
    """Write x_1 into ``out``; ``states`` (2, states, number) and ``inputs`` are work space."""
    _, n, count = states.shape
    first, now, then = u.shape[0] - y.shape[0], 0, 1
    for k in range(y.shape[0]):
        for c in range(count):
            out[k, c] = states[now, 0, c]
            at = k + first - late[c]
            inputs[0, c], inputs[1, c] = u[max(at - 1, 0), of_u[c]], u[max(at, 0), of_u[c]]
            inputs[2, c] = y[k, of_y[c]]
        for i in range(n):
            for c in range(count):
                states[then, i, c] = gammas[i, 2, c] * inputs[2, c]
            for c in range(count):
                states[then, i, c] += gammas[i, 0, c] * inputs[0, c]
            for c in range(count):
                states[then, i, c] += gammas[i, 1, c] * inputs[1, c]
            for j in range(n):
                for c in range(count):
                    states[then, i, c] += phis[i, j, c] * states[now, j, c]
            for c in range(count):
                value = states[then, i, c]
                states[then, i, c] = value if abs(value) > _TINY else 0.0
        now, then = then, now


# ---- Prediction-error fits of the plant behind a lag and a delay ----

# First, least and last μ, and the relative gain that a step without damping must predict: as in
# ``output_error``, chosen by hand. Steps are few, because a start is near.
_MU, _LEAST_MU, _MOST_MU, _CONVERGED, _STEPS = 1e-3, 1e-8, 1e8, 1e-7, 60
# Gain in AIC that ends the search, the number of steps in a row that may gain no more, and the gain
# with which it may end by them, or where rounding stops it: a parameter is then off by the root of
# it, 0.1 and 0.3 of its deviation.
_SETTLED, _SMALL_STEPS, _STALLED = 0.01, 3, 0.1
# Longest lag and delay, as a share of the record: chosen by hand.
_LONGEST = 0.25
# Blocks of the record for the covariance, as in ``output_error``.
_BLOCKS = 60
# Relative mean square that counts as zero: rounding of long simulations.
_ROUNDING = 1e-20
# Least error of the prediction that counts, relative to y: that of the derivatives by differences.
# A record without noise would be taken to determine everything otherwise.
_LEAST_ERROR = 1e-7
# Least variance that is divided by.
_SMALLEST = float(np.finfo(np.float64).tiny)
# Relative singular value that counts as zero, as in ``output_error``.
_RANK = 1e-12


class LoopFit(NamedTuple):
    """A model of the plant and its noise."""

    form: Form
    phi: Vector  # a, l, λ, τ, T in units of a sample
    beta: Vector  # b, c, initial state
    covariance: Matrix  # of phi and beta
    error: Vector  # e (N,)
    aic: float  # N log Σ e² + 2 (number of parameters)
    converged: bool


class _Point(NamedTuple):
    """A model with the best β for its φ."""

    phi: Vector
    beta: Vector
    error: Vector
    columns: Matrix
    power: float  # Σ e²


def power(form: Form, phi: Vector, u: Inputs, y: Vector) -> float:
    """Return Σ e² with the best β for φ."""
    return _solved(form, phi, u, y).power


def fit(form: Form, phi: Vector, u: Inputs, y: Vector) -> LoopFit:
    """Return the model of least prediction error near ``phi``."""
    at, converged = _descend(form, _solved(form, phi, u, y), u, y)
    if not math.isfinite(at.power):
        return _without_model(form, at)
    psi, size = _gradient(form, at, u, y)
    if not np.all(np.isfinite(psi)):
        return _without_model(form, at)
    first, count = at.beta.size, at.beta.size + form.size
    variance = at.power / max(at.error.size - count, 1)
    least = _LEAST_ERROR**2 * float(np.mean(y**2))
    variance = max(variance, least)
    known = _known_by_limits(form, at.phi) * math.sqrt(variance)
    psi[:, first:][:, np.isinf(known)] = 0.0
    rows = np.diag(np.concatenate([np.zeros(first), np.where(np.isinf(known), 0.0, known)]) / size)
    R: Matrix = np.asarray(np.linalg.qr(np.vstack([psi, rows]), mode="r"))
    inverse = _inverse(R)
    order = np.r_[first:count, :first]  # φ before β
    rows = inverse[order] / size[order, None]
    covariance = variance * rows @ rows.T
    half = rows @ (inverse.T @ block_sums(psi, at.error, min(_BLOCKS, at.error.size)).T)
    robust = half @ half.T
    of_b = np.arange(count)[form.gains_of_u]
    ratio = np.diag(covariance)[of_b] / np.maximum(np.diag(robust)[of_b], _SMALLEST)
    if np.any(ratio < 1.0):
        covariance = robust
        more = np.ones(count)  # of several b each has the larger deviation
        more[of_b] = np.sqrt(np.maximum(ratio, 1.0))
        covariance = covariance * np.outer(more, more)
    aic = y.size * math.log(max(at.power, y.size * least)) + 2.0 * count
    aic += 2.0 * growth(form, at.phi, y.size)
    return LoopFit(form, at.phi, at.beta, covariance, at.error, aic, converged)


def is_exact(found: LoopFit, y: Vector) -> bool:
    """Return whether the error is less than counts."""
    return float(found.error @ found.error) <= _LEAST_ERROR**2 * float(y @ y)


def _inverse(R: Matrix) -> Matrix:
    """Return the inverse of a triangle; what the record does not determine has a large one.

    Only parameters that do not vary, those with zeros for a column, have none.
    """
    varies = np.any(R, axis=0)
    U, sizes, V = np.linalg.svd(R[:, varies], full_matrices=False)
    found = np.zeros((R.shape[1], R.shape[0]))
    found[varies] = (V.T / np.maximum(sizes, _RANK * sizes[0])) @ U.T
    return found


def _known_by_limits(form: Form, phi: Vector) -> Vector:
    """Return the inverse deviations (size,) that parameters at their limit, zero, have by it.

    λ does not vary. τ or T varies by as much as the other one has: what is known is their sum, and
    how it is divided counts in the deviation of b.
    """
    found = np.zeros(form.size)
    at_limit = np.arange(form.size)[form.non_negative]
    at_limit = at_limit[phi[at_limit] <= 0.0]
    total = form.lag_of(phi) + form.delay_of(phi)
    found[at_limit] = np.inf
    if total > 0.0:
        found[at_limit[at_limit >= form.times.start]] = 1.0 / total
    return found


def _without_model(form: Form, at: _Point) -> LoopFit:
    """Return what counts as no fit: no start has a prediction."""
    count = at.beta.size + form.size
    covariance = np.full((count, count), np.nan)
    return LoopFit(form, at.phi, at.beta, covariance, at.error, math.inf, False)


def _solved(form: Form, phi: Vector, u: Inputs, y: Vector) -> _Point:
    """Return the model with the best β for φ; its power is infinite if it has none."""
    count = form.known + form.states
    nothing = _Point(phi, np.zeros(count), y, np.empty((0, 0)), math.inf)
    if not is_stable(form, phi, y.size):
        return nothing
    with np.errstate(all="ignore"):
        columns, of_y = linear_columns(form, phi, u, y)
        size, target = nonzero_lengths(columns), y - of_y
        if not (np.all(np.isfinite(size)) and math.isfinite(float(target @ target))):
            return nothing
        scaled = columns / size
        R: Matrix = np.asarray(np.linalg.qr(np.column_stack([scaled, target]), mode="r"))
        beta = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=_RANK)[0]
        error = target - scaled @ beta
    return _Point(phi, beta / size, error, columns, float(error @ error))


def _gradient(form: Form, at: _Point, u: Inputs, y: Vector) -> tuple[Matrix, Vector]:
    """Return the columns ψ of β and φ (N, all), scaled to length 1, and their lengths."""
    with np.errstate(all="ignore"):  # the caller sees numbers that are not finite
        psi = np.hstack([at.columns, derivatives(form, at.phi, at.beta, u, y)])
        size = nonzero_lengths(psi)
        psi /= np.where(np.isfinite(size), size, np.nan)
    return psi, size


def _descend(form: Form, at: _Point, u: Inputs, y: Vector) -> tuple[_Point, bool]:
    """Return the model of least prediction error near ``at``, and whether the search converged."""
    mu, floor, small = _MU, _ROUNDING * float(y @ y), 0
    for _ in range(_STEPS):
        if not math.isfinite(at.power):
            return at, False
        if at.power <= floor:
            return at, True
        psi, size = _gradient(form, at, u, y)
        if not np.all(np.isfinite(psi)):
            return at, False
        R: Matrix = np.asarray(np.linalg.qr(np.column_stack([psi, at.error]), mode="r"))
        if not np.all(np.isfinite(R)):
            return at, False
        first = at.beta.size
        inner, right = R[first:-1, first:-1], R[first:-1, -1]
        inner, step = _within_limits(form, at.phi, inner, right)
        inner, step = _along_limit(form, at.phi, inner, right, step, size[first:], y)
        gain = float(right @ right - np.sum((right - inner @ step) ** 2))
        least = at.power / at.error.size  # that much changes AIC by one
        if gain <= max(_CONVERGED * at.power, _SETTLED * least):
            return at, True
        moved, mu = _damped_step(form, at, inner, right, size[first:], mu, u, y)
        small = small + 1 if moved is None or at.power - moved.power <= _SETTLED * least else 0
        at = at if moved is None else moved
        if moved is None or small == _SMALL_STEPS:
            return at, gain <= _STALLED * least
    return at, False


def _within_limits(form: Form, phi: Vector, inner: Matrix, right: Vector) -> tuple[Matrix, Vector]:
    """Return the equations and their solution without λ, τ or T that would leave zero downwards."""
    step: Vector = np.linalg.lstsq(inner, right, rcond=_RANK)[0].astype(np.float64)
    stuck = np.zeros(step.size, dtype=bool)
    limited = form.non_negative
    stuck[limited] = (phi[limited] <= 0.0) & (step[limited] <= 0.0)
    if np.any(stuck):
        inner = np.where(stuck, 0.0, inner)
        step = np.linalg.lstsq(inner, right, rcond=_RANK)[0].astype(np.float64)
    return inner, step


def _along_limit(
    form: Form, phi: Vector, inner: Matrix, right: Vector, step: Vector, size: Vector, y: Vector
) -> tuple[Matrix, Vector]:
    """Return the equations and their solution without a predictor's pole that would leave |z| < 1.

    Loads that hardly move have such poles, and steps that lead out of the limit would all be
    refused.
    """
    slopes = limit_slopes(form, phi, y) / size
    slopes[:, ~np.any(inner, axis=0)] = 0.0  # those at their own limit
    slopes = slopes[np.all(np.isfinite(slopes), axis=1)]
    slopes = slopes[slopes @ step > 0.0]
    if slopes.size:
        away = np.linalg.qr(slopes.T)[0]
        inner = inner - (inner @ away) @ away.T
        step = np.linalg.lstsq(inner, right, rcond=_RANK)[0].astype(np.float64)
    return inner, step


def _damped_step(
    form: Form,
    at: _Point,
    inner: Matrix,
    right: Vector,
    size: Vector,
    mu: float,
    u: Inputs,
    y: Vector,
) -> tuple[_Point | None, float]:
    """Return a better model by a damped step, None if there is none, and the next μ."""
    count = right.size
    while mu <= _MOST_MU:
        left = np.vstack([inner, math.sqrt(mu) * np.eye(count)])
        step = np.linalg.lstsq(left, np.append(right, np.zeros(count)), rcond=None)[0]
        phi = at.phi + step / size
        limited = form.non_negative
        phi[limited] = np.clip(phi[limited], 0.0, _LONGEST * y.size)
        trial = _solved(form, stabilised(form, phi, y.size), u, y)
        if trial.power < at.power:
            return trial, max(0.1 * mu, _LEAST_MU)
        mu = max(10.0 * mu, 1e-6)
    return None, mu
