"""The model of a record: structure, derivatives, exact filters, poles and correlations.

Sample correlations of two signals, by the fast Fourier transform.

Poles, zeros and gain with their deviations.

Those of poles and zeros are of first order: ``δp = −Σ p^i δa_i / A'(p)``.

The gain ``K = b_0/a_q`` is a ratio, whose distribution is far from normal where a_q, a slow pole,
is uncertain. Its 95 % interval has all K for which ``b_0 − K a_q`` is within 1.96 standard
deviations of zero (Fieller, *J. Royal Statistical Society B* 16, 1954)::

    K² (a² − z² V_aa) − 2 K (a b − z² V_ab) + b² − z² V_bb ≤ 0,      z = 1.96

It may be open to one side: then a_q may be zero, the plant an integrator. A fast pole that the
record does not show makes a_q and b_0 uncertain, both by the same factor; so both are divided first
by the coefficient of A, or one, that leaves the smallest relative deviation of b_0.

Filters 1/A(s) and their derivatives, sampled exactly: the basis of identification.

Polynomials are in ``p = s dt``: a sample is a unit of time, and nothing depends on the user's
seconds. The vector ``a`` (n,) holds the coefficients of ``A = p^n + a_{n−1} p^(n−1) + … + a_0`` in
ascending powers. A *chain* is the filter bank ``p^i/A(p)``, i = 0 … n − 1, of one signal: the
states of the controllable companion form.

The model structure: its parameters θ, its output, and the derivatives of the output by θ.

    A(p) y = B(p) u + Σ_j F_j(p) v_j + D(p) δ(t),        A = p^q (p^(n−q) + … + a_q),   p = s dt

u is held between samples; v_j are further known inputs (1 for a constant force, −sign(speed) for
Coulomb friction), and D stands for the initial state: ``D(p)/A(p) δ`` is the free motion from any
state. The output is exact at the samples, and with ``ŷ = A⁻¹(B u + …)`` so are its derivatives::

    ∂ŷ/∂a_i = −p^i/A ŷ,      ∂ŷ/∂b_i = p^i/A u,      ∂ŷ/∂d_i = p^i/A δ

(Ljung, *System Identification*, 2nd ed. 1999, eqs. (10.52)–(10.55), in the shift operator.)

With *direct feedthrough* u also acts on y at once, ``y = B/A u + D_u u + …``: a numerator ``B + D_u
A`` with as many zeros as poles. D_u is a linear parameter as b is, and its derivative is u.

**Coulomb friction** is an input of its own, minus the sign of a speed::

    A y = B u + F₁ v₁ + F₂ v₂,      v₁ = −sign(speed of the driven side),   v₂ = −sign(y')

For known v the model is linear in F. The v are taken from the motion of the last model (at first v₂
from the measured motion), then the parameters are fitted for these v, and so on until the v no
longer change; the last steps are those of the simulated model, which takes v from its own speeds.

v is held over a sample as u is, so it is the mean of −sign(w) of a speed w. To first order w is a
straight line in a sample: it ends at ``w_0 + Δ`` where v = −sign(w_0) acts all along. If it keeps
its sign, this is v. Else w is zero after the share ``λ = −w_0/Δ`` of the sample. If u overcomes the
friction, w goes on with the other sign, and ``v = (1 − 2 λ) sign(w_0)``; if not, the side sticks,
and v is the value within ±1 for which w ends at zero (the implicit step of Acary & Brogliato,
*Numerical Methods for Nonsmooth Dynamical Systems*, 2008, ch. 1).

Friction on the measured side acts on y″ directly: F₂ has degree n − 2. Friction on the driven side
enters like u: F₁ has degree 0. Up to order 3 the sides move as one, and there is only v₂. From
order 4 on there may be a spring between them. For inertias J₁ (driven) and J₂ with a spring k::

    J₂ y″ = k (θ₁ − y) − …     so   θ₁' = y' + y‴/ω_a²,     ω_a² = k/J₂

ω_a, the frequency at which the driven side stands still while the other oscillates, is not a zero
of y and has to be searched for: it is below the resonance ``ω_r² = ω_a² (1 + J₂/J₁)``.

In order 1 y is itself the speed, ``y' + a y = b u − F sign(y)``: the record of a drive's speed.

**Start at rest.** A plant that has been at rest at u_0 and y_0 before the record obeys::

    y = y_0 + B/A (u − u_0) + F₁/A v₁ + …        from zero initial states

with one unknown y_0 in place of the n of D and the constant force.

**Several records** have the same A, B and F, but each has its own D, or its own y_0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import compiled
from quell.lti.models import zero_order_hold
from quell.types import Matrix, Vector

# ---- Sample correlations of two signals, by the fast Fourier transform ----


def correlation(a: Vector, b: Vector, lags: int) -> Vector:
    """Return ``mean(a[k + τ] b[k])`` for τ = −lags … lags."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(a.size + lags, real=True)
    found = irfft(rfft(a, size) * np.conj(rfft(b, size)), size) / a.size
    return np.concatenate([found[size - lags :], found[: lags + 1]])


def autocorrelation(error: Vector, lags: int) -> Vector:
    """Return ``R(τ)/R(0)`` for τ = 0 … lags, of ``error`` without its mean; zero for a constant."""
    e = error - np.mean(error)
    found = correlation(e, e, lags)[lags:]
    return found / (found[0] or 1.0)


# ---- Poles, zeros and gain with their deviations ----

# Deviations within which a normal number lies with 95 %.
WITHIN_95 = 1.96


class Root(NamedTuple):
    """A pole or a zero; of a conjugate pair both are listed."""

    value: complex  #: [rad/s]
    real_std: float  #: standard deviation of the real part [rad/s]; 0 for a root that was set
    imag_std: float  #: standard deviation of the imaginary part [rad/s]

    @property
    def omega(self) -> float:
        """Distance from s = 0 [rad/s]."""
        return abs(self.value)

    @property
    def deviation(self) -> float:
        """Standard deviation of the distance to the true root [rad/s]."""
        return math.hypot(self.real_std, self.imag_std)

    @property
    def damping(self) -> float:
        """Damping ratio; 1 for real roots in the left half plane, NaN at s = 0."""
        return -self.value.real / abs(self.value) if self.value else math.nan


def _root(a: Vector, covariance: Matrix, value: complex) -> Root:
    """Return a root of ``p^n + a_{n−1} p^(n−1) + … + a_0`` with its deviations."""
    real, imag = (math.sqrt(max(part, 0.0)) for part in root_covariance(a, covariance, value))
    return Root(complex(value), real, imag if complex(value).imag else 0.0)


def gain_interval(a: Vector, b: float, covariance: Matrix) -> tuple[float, float]:
    """Return the 95 % interval of ``b/a_0``; infinite ends if a_0 may be zero.

    ``a`` (n,) are the coefficients of the poles that are not set to s = 0, ascending, and
    ``covariance`` is that of a and b. Without any a it is the interval of b. An interval that has
    zero in it and is open has both ends infinite.
    """
    n = a.size
    if not np.all(np.isfinite(covariance)):
        return -math.inf, math.inf
    if n == 0:
        half = WITHIN_95 * math.sqrt(max(float(covariance[n, n]), 0.0))
        return b - half, b + half
    candidates = []
    for i in range(n):
        # i = 0 divides by one, the others by a_i: α = a_0/s, β = b/s.
        s, of_s = (1.0, np.zeros(n + 1)) if i == 0 else (float(a[i]), np.eye(n + 1)[i])
        if s == 0.0:
            continue
        alpha, beta = float(a[0]) / s, float(b) / s
        slopes = np.array([np.eye(n + 1)[0], np.eye(n + 1)[n]])
        slopes = (slopes - np.outer([alpha, beta], of_s)) / s
        part = slopes @ covariance @ slopes.T
        candidates.append((float(part[1, 1]) / beta**2 if beta else math.inf, alpha, beta, part))
    _, alpha, beta, part = min(candidates, key=lambda one: one[0])
    return _fieller(alpha, beta, part)


def _fieller(a: float, b: float, covariance: Matrix) -> tuple[float, float]:
    """Return the interval of b/a that has the estimate in it."""
    z2 = WITHIN_95**2
    of_a, of_b, both = float(covariance[0, 0]), float(covariance[1, 1]), float(covariance[0, 1])
    square, linear, constant = a * a - z2 * of_a, a * b - z2 * both, b * b - z2 * of_b
    # linear² − square · constant, without the terms that cancel
    spread = a * a * of_b + b * b * of_a - 2.0 * a * b * both
    root = z2 * spread + z2 * z2 * (both * both - of_a * of_b)
    if square > 0.0:
        half = math.sqrt(max(root, 0.0))
        return (linear - half) / square, (linear + half) / square
    if root <= 0.0 or square == 0.0:
        return -math.inf, math.inf
    half = math.sqrt(root)
    ends = sorted([(linear - half) / square, (linear + half) / square])
    if constant <= 0.0:  # zero is in it
        return -math.inf, math.inf
    return (-math.inf, ends[0]) if a * b < 0.0 else (ends[1], math.inf)


def poles_of(a: Vector, covariance: Matrix, integrators: int) -> tuple[Root, ...]:
    """Return the poles, slow ones first; a_i is zero for i < ``integrators``."""
    free = a[integrators:]
    part = covariance[: free.size, : free.size]
    found = [_root(free, part, value) for value in np.roots(np.append(1.0, free[::-1])).tolist()]
    known = [Root(0j, 0.0, 0.0)] * integrators
    return tuple(sorted([*known, *found], key=lambda root: (root.omega, -root.value.imag)))


def zeros_of(b: Vector, covariance: Matrix) -> tuple[Root, ...]:
    """Return the roots of the numerator b, in ascending powers."""
    if b.size < 2:
        return ()
    monic = b[:-1] / b[-1]
    slope = np.column_stack([np.eye(monic.size), -monic]) / b[-1]
    part = slope @ covariance @ slope.T
    return tuple(_root(monic, part, value) for value in np.roots(b[::-1]).tolist())


def squared_distance_from_zero(
    a: Vector, covariance: Matrix, roots: NDArray[np.complex128]
) -> float:
    """Return the squared distance of one or two roots from s = 0, in standard deviations."""
    slopes = np.array([pole_slope(a, root) for root in roots])
    if roots.size == 1:
        coefficients, slopes = -roots, -slopes
    else:
        coefficients = np.array([roots[0] * roots[1], -roots[0] - roots[1]])
        slopes = np.array([roots[1] * slopes[0] + roots[0] * slopes[1], -slopes[0] - slopes[1]])
    part = slopes.real @ covariance @ slopes.real.T
    size = np.sqrt(np.maximum(np.diag(part), 1e-300))
    away = coefficients.real / size
    return float(away @ np.linalg.pinv(part / np.outer(size, size), hermitian=True) @ away)


def root_covariance(a: Vector, covariance: Matrix, root: complex) -> tuple[float, float]:
    """Return the variances of real and imaginary part of a root, from the covariance of a."""
    slope = pole_slope(a, root)
    return float(slope.real @ covariance @ slope.real), float(slope.imag @ covariance @ slope.imag)


def pole_slope(a: Vector, root: complex) -> NDArray[np.complex128]:
    """Return the derivatives of a root by a."""
    powers = root ** np.arange(a.size)
    return np.asarray(-powers / np.polyval(np.polyder(np.append(1.0, a[::-1])), root))


# ---- Filters 1/A(s) and their derivatives, sampled exactly ----

# States below this become zero: far below all values that matter, far above the denormal numbers
# (1e-308) that processors are slow with.
_TINY = 1e-140

Bank = NDArray[np.float64]  # states of a chain for several inputs (N, n, m)
Indices = NDArray[np.int64]


class Sampled(NamedTuple):
    """A sampled system ``x⁺ = Φ x + Γ v + Γ₁ (v⁺ − v)``, with held or linear inputs."""

    phi: Matrix  # Φ (n, n)
    gamma: Matrix  # Γ (n, m)
    slope: Matrix  # Γ₁ (n, m); zero for held inputs


@compiled
def _states(phi: Matrix, gamma: Matrix, slope: Matrix, v: Matrix, x: Vector, out: Matrix) -> None:
    """Write the states for inputs ``v`` (N, m) into ``out`` (N, n), starting at ``x``."""
    n, m = gamma.shape
    last = v.shape[0] - 1
    for k in range(v.shape[0]):
        for i in range(n):
            out[k, i] = x[i]
        after = min(k + 1, last)
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += phi[i, j] * out[k, j]
            for j in range(m):
                total += gamma[i, j] * v[k, j] + slope[i, j] * (v[after, j] - v[k, j])
            x[i] = total if abs(total) > _TINY else 0.0


@compiled
def _chains(phi: Matrix, gamma: Vector, v: Matrix, x: Matrix, out: Bank) -> None:
    """Write the states for held inputs ``v`` (N, m) into ``out`` (N, n, m), starting at ``x``."""
    n, m = x.shape
    for k in range(v.shape[0]):
        for i in range(n):
            for c in range(m):
                out[k, i, c] = x[i, c]
                x[i, c] = gamma[i] * v[k, c]
        for i in range(n):
            for j in range(n):
                for c in range(m):
                    x[i, c] += phi[i, j] * out[k, j, c]
            for c in range(m):
                x[i, c] = x[i, c] if abs(x[i, c]) > _TINY else 0.0


@compiled
def _gradient(
    one: Sampled,
    bank: Matrix,
    columns: Indices,
    both: Sampled,
    x: Vector,
    skipped: int,
    v: Matrix,
    y: Vector,
    out: Matrix,
) -> None:
    """Write y (N,) and its derivatives ``out`` (N, size); see ``structure.gradient``.

    ``one`` is the filter on each input, ``bank`` (2, n, inputs) its states now and at the next
    sample; ``columns`` (n, inputs) are their columns in ``out``, negative for none. ``both`` is the
    model followed by the filter, ``x`` (2, 2 n) their states.
    """
    _, n, m = bank.shape
    now, then = 0, 1
    for k in range(v.shape[0]):
        y[k] = x[now, 0]
        for i in range(skipped, n):
            out[k, i - skipped] = -x[now, n + i]
        for i in range(n):
            for c in range(m):
                if columns[i, c] >= 0:
                    out[k, columns[i, c]] = bank[now, i, c]
        for i in range(n):
            for c in range(m):
                bank[then, i, c] = one.gamma[i, 0] * v[k, c]
            for j in range(n):
                for c in range(m):
                    bank[then, i, c] += one.phi[i, j] * bank[now, j, c]
            for c in range(m):
                bank[then, i, c] = bank[then, i, c] if abs(bank[then, i, c]) > _TINY else 0.0
        for i in range(2 * n):
            total = 0.0
            for j in range(n if i < n else 2 * n):
                total += both.phi[i, j] * x[now, j]
            for c in range(m - 1):
                total += both.gamma[i, c] * v[k, c]
            x[then, i] = total if abs(total) > _TINY else 0.0
        now, then = then, now


@compiled
def _mean_sign(now: float, free: float, gain: float) -> float:
    """Return the mean over a sample of minus the sign of a speed; see ``structure``.

    The speed is ``now`` at the start, and ``free + gain v`` at the end if v acts all along.
    """
    if gain <= 0.0:  # it drives the motion: a model on the way of the search
        return -1.0 if now > 0.0 else (1.0 if now < 0.0 else 0.0)
    sign = 1.0 if now > 0.0 else (-1.0 if now < 0.0 else 0.0)
    change = free - sign * gain - now
    if now * (now + change) > 0.0:
        return -sign
    if sign != 0.0 and (change + 2.0 * sign * gain) * sign < 0.0:
        return sign * (1.0 + 2.0 * now / change)
    return min(max(-free / gain, -1.0), 1.0)


@compiled
def _states_with_friction(
    phi: Matrix, gamma: Matrix, v: Matrix, speeds: Matrix, offset: float, x: Vector, out: Matrix
) -> None:
    """Write the states and the last inputs: minus the mean signs of ``speeds`` times the state.

    ``offset`` is added to the speeds.
    """
    n, m = gamma.shape
    first = m - speeds.shape[0]
    for k in range(v.shape[0]):
        for i in range(n):
            out[k, i] = x[i]
        for i in range(n):
            x[i] = 0.0
            for j in range(n):
                x[i] += phi[i, j] * out[k, j]
            for j in range(first):
                x[i] += gamma[i, j] * v[k, j]
        for j in range(first, m):
            now = free = offset
            gain = 0.0
            for i in range(n):
                now += speeds[j - first, i] * out[k, i]
                free += speeds[j - first, i] * x[i]
                gain += speeds[j - first, i] * gamma[i, j]
            v[k, j] = _mean_sign(now, free, gain)
            for i in range(n):
                x[i] += gamma[i, j] * v[k, j]


def companion(a: Vector) -> tuple[Matrix, Matrix]:
    """Return A and B of the controllable companion form, with states ``p^i/A(p) v``."""
    n = a.size
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -a
    return A, np.eye(n)[:, -1:]


def observable(a: Vector) -> Matrix:
    """Return A of the observable companion form; numerators, descending, are columns of B."""
    A = np.diag(np.ones(a.size - 1), 1)
    A[:, 0] -= a[::-1]
    return A


def sampled(A: Matrix, B: Matrix, straight: bool = False) -> Sampled:
    """Sample ``x' = A x + B v`` exactly over a unit of time; ``v`` is held or ``straight``."""
    n, m = B.shape
    if not straight:
        # An unstable model may give no finite numbers; the caller sees this in the output.
        with np.errstate(all="ignore"):
            phi, (gamma,) = zero_order_hold(A, [B], 1.0)
        return Sampled(phi, gamma, np.zeros((n, m)))
    # A linear input is the state of an integrator whose own input, the slope, is held.
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A, B
    phi, (slope,) = zero_order_hold(block, [np.eye(n + m)[:, n:]], 1.0)
    return Sampled(*map(np.ascontiguousarray, (phi[:n, :n], phi[:n, n:], slope[:n])))


def states(system: Sampled, v: Matrix, x0: Vector | None = None) -> Matrix:
    """Return the states (N, n) for the inputs ``v`` (N, m), starting at ``x0``, zero by default."""
    n = system.phi.shape[0]
    out = np.empty((v.shape[0], n))
    start = np.zeros(n) if x0 is None else np.array(x0, dtype=np.float64)
    _states(*system, np.ascontiguousarray(v), start, out)
    return out


def states_with_friction(
    system: Sampled, v: Matrix, speeds: Matrix, x0: Vector, offset: float = 0.0
) -> tuple[Matrix, Matrix]:
    """Return states and inputs; the last are minus the mean signs of ``speeds`` times the state.

    ``offset`` is added to the speeds.
    """
    out, inputs = np.empty((v.shape[0], x0.size)), np.array(v, order="C")
    speeds, x = np.ascontiguousarray(speeds), np.array(x0, dtype=np.float64)
    _states_with_friction(system.phi, system.gamma, inputs, speeds, offset, x, out)
    return out, inputs


def chain(a: Vector, v: Vector) -> Matrix:
    """Return ``p^i/A(p) v`` (N, n) at the samples, from rest, for ``v`` linear between them."""
    return states(sampled(*companion(a), straight=True), v[:, None])


def chains(a: Vector, v: Matrix) -> Bank:
    """Return ``p^i/A(p)`` (N, n, inputs + 1) of held inputs ``v`` and of an initial impulse."""
    one, count = sampled(*companion(a)), v.shape[1] + 1
    out = np.empty((v.shape[0], a.size, count))
    _chains(one.phi, one.gamma[:, 0].copy(), _with_impulse(v), _first(a.size, count), out)
    return out


def gradient(
    a: Vector, B: Matrix, start: Vector, columns: Indices, skipped: int, v: Matrix, size: int
) -> tuple[Vector, Matrix]:
    """Return y (N,) of a model in observable companion form, and its derivatives (N, size).

    The first are ``−p^i/A y`` for i from ``skipped`` on; the others are the states of ``chains``,
    in the columns given by ``columns`` (n, inputs + 1).
    """
    n = a.size
    A, both = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, B.shape[1]))
    A[:n, :n], A[n:, n:] = observable(a), companion(a)[0]
    A[-1, 0] = 1.0
    both[:n] = B
    x, bank = np.zeros((2, 2 * n)), np.zeros((2, n, v.shape[1] + 1))
    x[0, :n], bank[0] = start, _first(n, v.shape[1] + 1)
    y, out = np.empty(v.shape[0]), np.empty((v.shape[0], size))
    one, model, v = sampled(*companion(a)), sampled(A, both), _with_impulse(v)
    _gradient(one, bank, columns, model, x, skipped, v, y, out)
    return y, out


def _with_impulse(v: Matrix) -> Matrix:
    """Return the inputs and zeros for the impulse, which only sets the initial state."""
    return np.column_stack([v, np.zeros(v.shape[0])])


def _first(n: int, count: int) -> Matrix:
    """Return the initial states of ``count`` chains, the last of which starts with an impulse."""
    x = np.zeros((n, count))
    x[-1, -1] = 1.0
    return x


# ---- The model structure ----


class Structure(NamedTuple):
    """The parameters θ: a_q … a_{n−1}; numerators of the inputs; D_u; D or y_0 of each record."""

    order: int  #: n
    integrators: int  #: q, the number of poles that are set to s = 0
    degrees: tuple[int, ...]  #: degree of the numerator of each input, u first
    friction: tuple[float, ...] = ()
    """1/ω_a² [samples²] of each friction input, the last ones; 0.0 on the measured side."""
    direct: bool = False
    """Whether u also acts on y at once: ``y = … + D_u u``; then B has the degree n − 1."""
    at_rest: bool = False
    """Whether the records start at rest; then the first input is u − u_0."""
    samples: tuple[int, ...] = ()
    """Number of samples of each record, if there are several."""

    @property
    def free(self) -> int:
        """Number of free coefficients of A."""
        return self.order - self.integrators

    @property
    def common(self) -> int:
        """Number of parameters that all records have in common."""
        return self.free + sum(self.degrees) + len(self.degrees) + self.direct

    @property
    def of_start(self) -> int:
        """Number of parameters of the start of each record."""
        return 1 if self.at_rest else self.order

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.common + self.of_start * max(len(self.samples), 1)

    def denominator(self, theta: Vector) -> Vector:
        """Return a (n,), in ascending powers."""
        a = np.zeros(self.order)
        a[self.integrators :] = theta[: self.free]
        return a

    @property
    def places(self) -> list[int]:
        """Places in θ where the numerator of each input begins."""
        sizes = [degree + 1 for degree in self.degrees[:-1]]
        return list(accumulate(sizes, initial=self.free))

    def numerators(self, theta: Vector) -> Matrix:
        """Return the numerators (inputs, n), in ascending powers."""
        found = np.zeros((len(self.degrees), self.order))
        for row, degree, at in zip(found, self.degrees, self.places, strict=True):
            row[: degree + 1] = theta[at : at + degree + 1]
        return found

    def initial(self, theta: Vector) -> Vector:
        """Return D (n,) of a single record, in ascending powers; zero for a start at rest."""
        return np.zeros(self.order) if self.at_rest else theta[self.common :]

    def level(self, theta: Vector) -> float:
        """Return y_0 of a single record that starts at rest, else zero."""
        return float(theta[-1]) if self.at_rest else 0.0

    def feedthrough(self, theta: Vector) -> float:
        """Return D_u, zero without direct feedthrough."""
        return float(theta[self.common - 1]) if self.direct else 0.0

    def powers(self, unit: float) -> Vector:
        """Return the factor of each parameter for a unit of time that is ``unit`` times as long."""
        n = self.order
        a = unit ** (n - np.arange(float(self.integrators), n))
        numerators = [unit ** (n - np.arange(degree + 1.0)) for degree in self.degrees]
        direct = np.ones(int(self.direct))
        start = np.ones(1) if self.at_rest else unit ** (n - 1.0 - np.arange(n))
        return np.concatenate([a, *numerators, direct, np.tile(start, max(len(self.samples), 1))])

    def records(self, count: int) -> list[slice]:
        """Return the places of each record in ``count`` samples."""
        edges = accumulate(self.samples or (count,), initial=0)
        return [slice(*pair) for pair in pairwise(edges)]

    def single(self) -> Structure:
        """Return the structure for one of the records."""
        return self._replace(samples=())


def _each(structure: Structure, theta: Vector, count: int) -> Iterator[tuple[slice, Vector, slice]]:
    """Yield the samples of each record, its own θ, and the places of its start in θ."""
    for i, place in enumerate(structure.records(count)):
        at = structure.common + i * structure.of_start
        start = slice(at, at + structure.of_start)
        yield place, np.append(theta[: structure.common], theta[start]), start


def linear_columns(structure: Structure, a: Vector, v: Matrix) -> Matrix:
    """Return the derivatives of y by all parameters except those of A (N, size − free)."""
    found = np.zeros((v.shape[0], structure.size - structure.free))
    common = structure.common - structure.free
    for i, place in enumerate(structure.records(v.shape[0])):
        bank = chains(a, v[place])
        parts = [bank[:, : degree + 1, j] for j, degree in enumerate(structure.degrees)]
        found[place, :common] = np.hstack([*parts, v[place, : int(structure.direct)]])
        at = common + i * structure.of_start
        start = 1.0 if structure.at_rest else bank[:, :, -1]
        found[place, at : at + structure.of_start] = start
    return found


def output(structure: Structure, theta: Vector, v: Matrix) -> Vector:
    """Return y (N,) for the inputs ``v`` (N, inputs)."""
    return free_run(structure, theta, v)[0]


def free_run(
    structure: Structure, theta: Vector, v: Matrix, own_friction: bool = False
) -> tuple[Vector, Matrix]:
    """Return y (N,) and the inputs, with ``own_friction`` those of the model's own speeds."""
    if structure.samples:
        single, parts = structure.single(), _each(structure, theta, v.shape[0])
        runs = [free_run(single, own, v[place], own_friction) for place, own, _ in parts]
        return np.concatenate([y for y, _ in runs]), np.vstack([inputs for _, inputs in runs])
    A = observable(structure.denominator(theta))
    B = np.ascontiguousarray(structure.numerators(theta)[:, ::-1].T)
    system, initial = sampled(A, B), structure.initial(theta)[::-1]
    direct = structure.feedthrough(theta) * v[:, 0] + structure.level(theta)
    if not (own_friction and structure.friction):
        return states(system, v, initial)[:, 0] + direct, v
    if structure.order == 1:
        # y, and with it the sign of the speed, has a level of its own.
        speeds, offset = np.ones((1, 1)), structure.level(theta)
    else:
        # y' and y‴ without the direct effect of the inputs; y = x_1
        first, offset = A[0], 0.0
        third = first @ A @ A
        speeds = np.array([first + weight * third for weight in structure.friction])
    x, inputs = states_with_friction(system, v, speeds, initial, offset)
    return x[:, 0] + direct, inputs


def cost(structure: Structure, theta: Vector, v: Matrix, y: Vector) -> float:
    """Return the mean square of the output error [y-unit²]; infinite if it is not finite."""
    if not np.all(np.isfinite(theta)):
        return math.inf
    with np.errstate(all="ignore"):
        value = float(np.mean((y - output(structure, theta, v)) ** 2))
    return value if math.isfinite(value) else math.inf


def output_gradient(structure: Structure, theta: Vector, v: Matrix) -> tuple[Vector, Matrix]:
    """Return y (N,) and its derivatives by θ (N, size)."""
    if structure.samples:
        y, psi = np.empty(v.shape[0]), np.zeros((v.shape[0], structure.size))
        single, common = structure.single(), structure.common
        for place, own, start in _each(structure, theta, v.shape[0]):
            y[place], part = output_gradient(single, own, v[place])
            psi[place, :common], psi[place, start] = part[:, :common], part[:, common:]
        return y, psi
    n, degrees = structure.order, structure.degrees
    columns = np.full((n, len(degrees) + 1), -1)
    for j, (degree, at) in enumerate(zip(degrees, structure.places, strict=True)):
        columns[: degree + 1, j] = np.arange(at, at + degree + 1)
    if not structure.at_rest:
        columns[:, -1] = np.arange(structure.common, structure.size)
    a, B = structure.denominator(theta), structure.numerators(theta)[:, ::-1].T
    initial = structure.initial(theta)[::-1]
    y, psi = gradient(a, B, initial, columns, structure.integrators, v, structure.size)
    # The derivatives by a are those of the part of y that has passed through 1/A.
    if structure.direct:
        psi[:, structure.common - 1] = v[:, 0]
        y += structure.feedthrough(theta) * v[:, 0]
    if structure.at_rest:
        psi[:, -1] = 1.0
        y += structure.level(theta)
    return y, psi


def lengths(columns: Matrix) -> Vector:
    """Return the Euclidean lengths of the columns."""
    return np.sqrt(np.einsum("ki,ki->i", columns, columns))


def nonzero_lengths(columns: Matrix) -> Vector:
    """Return the lengths of the columns, 1 for a zero column, to divide by."""
    size = lengths(columns)
    return np.where(size > 0.0, size, 1.0)
