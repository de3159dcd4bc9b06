"""A transfer function from a table of G(jω): poles, zeros, gain and delay.

The model is ::

    G(s) = K/s^q · Π (1 + s/z_i) Π (1 + 2 ζ_i s/ω_i + s²/ω_i²) / Π … · exp(−s τ)

with as many sections in numerator and denominator as it has zeros and poles. The error is that of
the logarithm, ``e = ln G_model − ln G``, whose parts are the relative error of the size and the
error of the phase: a resonance and its foot count alike. The derivatives of ``ln G`` by ``ln ω``,
``ζ``, ``ln K`` and τ are sums over sections, so ``scipy.optimize.least_squares`` has them exactly.

Starts are found by vector fitting (``vector_fitting``); of the zeros of G the small ones are kept.
A delay is tried at several values up to the slope of the phase.

Points may have deviations of their own; else each is weighted by how much its neighbours scatter.
Neighbours whose errors are alike, as those of a model that is not quite right, are fewer points:
with the correlation ρ of neighbouring errors the covariance is multiplied by (1 + ρ)/(1 − ρ).

The order goes up from one. A larger model is taken where the likelihood ratio shows more than
chance, and it *holds*: its poles are stable, within the table, and equal no zero.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.identification.frequencies import KNOWN, hold_of
from quell.identification.frequency_model import (
    DEVIATIONS,
    MOST_ORDER,
    OUTSIDE,
    POOR,
    FrequencyModel,
)
from quell.identification.model import gain_interval, poles_of, zeros_of
from quell.identification.vector_fitting import ROUNDS, vector_fit
from quell.quantities import UNKNOWN, Signals
from quell.types import Matrix, Vector

Complex = NDArray[Any]

_MOST_INTEGRATORS = 2
# Rounds of vector fitting on the way, delays that are tried, and those that are refined. By hand.
_FEW_ROUNDS, _DELAYS, _KEPT = 4, 12, 2
# Errors of delays up to this factor of the least may become the least. By hand.
_NEARLY = 2.0
# Least relative error that counts: that of five digits, as tables have. Chosen by hand.
_DIGITS = 1e-5
# Relative size of the images of G beside G, for a G behind the hold that falls with the third power
# of ω/(2π/dt − ω): two of them. By hand.
_IMAGES, _FALLS = 2.0, 3
# Points that a fit needs.
_LEAST_POINTS = 8
# Points for each parameter below which no interval is given.
_FEW = 2.0
# Largest logarithm of a frequency or a gain, on the way of the search.
_LARGE = 80.0
# Steps of the search at most, on the way and at the end.
_FIRST, _LAST = 15, 200
# Costs up to this factor of an order's least are searched to the end. By hand.
_NEAR_BEST = 10.0
# Orders without a better model that end the search.
_WORSE = 2


class _Shape(NamedTuple):
    """How many sections a model has; real roots carry the sign of their half plane."""

    integrators: int
    poles: tuple[float, ...]  # signs of the real poles
    pole_pairs: int
    zeros: tuple[float, ...]
    zero_pairs: int
    delayed: bool
    sign: float

    @property
    def order(self) -> int:
        return self.integrators + len(self.poles) + 2 * self.pole_pairs

    @property
    def zero_count(self) -> int:
        return len(self.zeros) + 2 * self.zero_pairs

    @property
    def size(self) -> int:
        return self.order - self.integrators + self.zero_count + 1 + self.delayed


class _Data(NamedTuple):
    """The table, in units of its middle frequency."""

    s: Complex
    log: Complex  # ln G, less that of the hold
    std: Vector  # relative deviation of each point
    fixed: float | None  # delay, if it is given


def identify_frequencies(
    omega: Any,
    response: Any,
    order: int | None = None,
    zeros: int | None = None,
    *,
    integrators: int | None = None,
    delay: float | None = None,
    deviation: Any = None,
    dt: float | None = None,
    signals: Signals = UNKNOWN,
) -> FrequencyModel:
    """Fit a transfer function with a delay to a table of G(jω).

    The method and its sources are in ``quell.identification.from_frequencies``.

    Parameters
    ----------
    omega
        frequencies (N,), rising [rad/s].
    response
        G at them (N,), complex [y-unit/u-unit].
    order, zeros
        number of poles, 1 to 8, and of zeros, at most as many; by default the simplest model that
        holds and that no larger one surpasses beyond chance.
    integrators
        number of poles at s = 0; by default as many as the table shows, two at most.
    delay
        [s]; by default it is searched.
    deviation
        relative standard deviation of each G (N,), if it is known; else neighbours tell.
    dt
        time for which u was held while it was measured [s], as in a record of samples; by default
        the table is that of the plant itself, and what hold and computing add is in the delay. Near
        half the sampling rate samples have images of G: points count less there, or not at all.
    signals
        names and units of u and y.

    Raises
    ------
    ValueError
        for a table with fewer than eight frequencies, or with G = 0.

    Examples
    --------
    >>> import numpy as np
    >>> omega = np.geomspace(1.0, 100.0, 60)
    >>> G = 5.0 * np.exp(-0.01j * omega) / (1j * omega) / (1.0 + 0.05j * omega)
    >>> found = identify_frequencies(omega, G)
    >>> found.integrators, round(found.delay, 5), round(found.gain, 4)
    (1, 0.01, 5.0)
    """
    omega = checks.vector("omega", omega)
    response = np.asarray(response, dtype=np.complex128)
    if response.shape != omega.shape or not np.all(np.isfinite(response)):
        raise ValueError(f"response: must be {omega.size} finite numbers, one for each omega")
    if omega.size < _LEAST_POINTS:
        raise ValueError(
            f"omega has {omega.size} frequencies: must have at least {_LEAST_POINTS}; measure more"
        )
    if not (omega[0] > 0.0 and np.all(np.diff(omega) > 0.0)):
        raise ValueError("omega: must rise from above zero on")
    if np.any(response == 0.0):
        at = omega[np.flatnonzero(response == 0.0)[0]]
        raise ValueError(f"response is zero at {at:g} rad/s: has no logarithm; leave it out")
    n = None if order is None else checks.whole("order", order, 1, MOST_ORDER)
    most = MOST_ORDER if n is None else n
    m = None if zeros is None else checks.whole("zeros", zeros, 0, most)
    q = None if integrators is None else checks.whole("integrators", integrators, 0, most)
    fixed = None if delay is None else checks.non_negative("delay", delay, "s")
    dt = None if dt is None else checks.positive("dt", dt, "s")
    middle = math.sqrt(float(omega[0] * omega[-1]))
    s = 1j * omega
    log = np.log(response / hold_of(s, dt))
    if deviation is None:
        std = _scatter(omega, log)
    else:
        std = np.maximum(checks.vector("deviation", deviation, omega.size), _DIGITS)
    if dt is not None:
        # Samples of a held u have images of G around the sampling rate, which the model leaves out.
        image = omega / np.maximum(2.0 * math.pi / dt - omega, omega)
        images = _IMAGES * image**_FALLS
        seen = images <= KNOWN
        if int(np.sum(seen)) >= _LEAST_POINTS:
            parts = omega, response, s, log, np.hypot(std, images)
            omega, response, s, log, std = (part[seen] for part in parts)
    data = _Data(s / middle, log, std, None if fixed is None else fixed * middle)
    best = _searched(data, n, m, q)
    return _result(best, data, middle, omega, response, dt, signals)


def _scatter(omega: Vector, log: Complex) -> Vector:
    """Return how much each point is off a parabola through its neighbours, smoothed."""
    from scipy.ndimage import median_filter

    x = np.log(omega)
    off = np.zeros(omega.size)
    for k in range(omega.size):
        first = min(max(k - 2, 0), omega.size - 5)
        near = np.delete(np.arange(first, first + 5), k - first)
        # The point from four neighbours, by Lagrange's cubic.
        weights = [math.prod((x[k] - x[j]) / (x[i] - x[j]) for j in near if j != i) for i in near]
        away = (log[near] - log[k]).copy()
        away.imag = np.angle(np.exp(1j * away.imag))
        off[k] = abs(np.dot(weights, away)) / math.sqrt(1.0 + float(np.dot(weights, weights)))
    # Beside a resonance with few points the cubic is off: the median of more points holds.
    size = max(min(omega.size // 4, 25) | 1, 3)
    local = median_filter(off, size=size, mode="nearest")
    floor = max(float(np.median(local)) * 0.3, _DIGITS)
    return np.asarray(np.clip(local, floor, None))


class _Fit(NamedTuple):
    shape: _Shape
    theta: Vector
    cost: float  # mean square of the error over its deviation
    error: float  # RMS of the error
    jacobian: Matrix
    residual: Vector
    converged: bool

    @property
    def correlation(self) -> float:
        """Correlation of the errors of neighbouring points, 0 to 0.95."""
        parts = self.residual.reshape(2, -1)
        total = float(np.sum(parts**2))
        if total == 0.0:
            return 0.0
        return min(max(float(np.sum(parts[:, 1:] * parts[:, :-1])) / total, 0.0), 0.95)


def _searched(data: _Data, n: int | None, m: int | None, q: int | None) -> _Fit:
    """Return the simplest model that holds, and that no larger one surpasses beyond chance."""
    orders = range(1, MOST_ORDER + 1) if n is None else [n]
    best: _Fit | None = None
    least: _Fit | None = None
    worse = 0
    for order in orders:
        if 2 * data.s.size < 2 * order + 2 and best is not None:
            break
        fits = _of_order(data, order, m, q)
        if n is not None:
            # Of what is open, the simplest that is not surpassed.
            for one in sorted(fits, key=lambda fit: fit.shape.size):
                least = one if least is None or _surpasses(one, least, data) else least
            continue
        improved = False
        for one in sorted(fits, key=lambda fit: fit.shape.size):
            if least is None or _surpasses(one, least, data):
                least, improved = one, True
            if _holds(one, data) and (best is None or _surpasses(one, best, data)):
                best, improved = one, True
        worse = 0 if improved else worse + 1
        if best is not None and best.error <= POOR and worse >= _WORSE:
            break
    found = best if best is not None else least
    if found is None:
        raise ValueError("response: no model was found; give order, or other frequencies")
    return found


def _surpasses(one: _Fit, than: _Fit, data: _Data) -> bool:
    """Return whether a model is better beyond chance, by the likelihood ratio."""
    ratio = 2.0 * data.s.size * math.log(_cost(than) / _cost(one))
    rho = min(one.correlation, than.correlation)
    ratio *= (1.0 - rho) / (1.0 + rho)
    more = one.shape.size - than.shape.size
    return ratio > (more + 2 if more > 0 else more) * math.log(2.0 * data.s.size)


def _cost(fit: _Fit) -> float:
    return max(fit.cost, 1e-12)


def _of_order(data: _Data, order: int, m: int | None, q: int | None) -> list[_Fit]:
    """Return fits of one order with the numbers of zeros that are asked for."""
    fits: dict[tuple[int, int], _Fit] = {}
    counts = range(order) if m is None else [min(m, order)]
    for delay in _delays(data, order):
        poles, roots = _vector_fit(data, order, delay)
        for integrators in range(min(order, _MOST_INTEGRATORS) + 1) if q is None else [q]:
            slow = np.argsort(np.abs(poles))
            kept = np.delete(poles, slow[:integrators]) if integrators else poles
            # A pair cannot lose one of its poles.
            if integrators and not _closed(kept):
                kept = np.where(kept.imag != 0.0, -np.abs(kept), kept)
            if integrators and q is None and abs(poles[slow[integrators - 1]]) > _slow(data):
                break
            for count in counts:
                zeros = _smallest(roots, count)
                one = _refined(data, kept, zeros, integrators, delay)
                kind = integrators, count
                if kind not in fits or one.cost < fits[kind].cost:
                    fits[kind] = one
    found = [one for one in fits.values() if math.isfinite(one.cost)]
    if not found:
        return []
    enough = _NEAR_BEST * min(one.cost for one in found)
    return [_continued(data, one) for one in found if one.cost <= enough]


def _continued(data: _Data, fit: _Fit) -> _Fit:
    """Return a fit after more steps."""
    if fit.converged:
        return fit
    return _least(data, fit.shape, fit.theta, data.fixed or 0.0, _LAST)


def _slow(data: _Data) -> float:
    """Return the frequency below which a pole may be an integrator."""
    return float(abs(data.s[0])) * 2.0


def _closed(roots: Complex) -> bool:
    """Return whether complex roots come in pairs."""
    upper = np.sum(roots.imag > 0.0)
    return bool(upper == np.sum(roots.imag < 0.0))


def _smallest(roots: Complex, count: int) -> Complex:
    """Return as many small roots, pairs whole; real ones are added where there are too few."""
    found: list[complex] = []
    for root in sorted(roots, key=abs):
        if root.imag < 0.0:
            continue
        pair = [root, root.conjugate()] if root.imag > 0.0 else [root]
        if len(found) + len(pair) > count:
            if len(found) < count:
                found.append(complex(-abs(root)))
            break
        found += pair
    while len(found) < count:
        found.append(complex(-10.0 * max([1.0, *map(abs, found)])))
    return np.array(found, dtype=np.complex128)


def _delays(data: _Data, order: int) -> list[float]:
    """Return delays from which a search begins, the best first."""
    if data.fixed is not None:
        return [data.fixed]
    w, phase = data.s.imag, np.unwrap(data.log.imag)
    upper = w >= 0.3 * w[-1]
    slope = -np.diff(phase[upper]) / np.diff(w[upper])
    most = max(float(np.median(slope)) if slope.size else 0.0, 0.0) * 1.2
    tried = np.linspace(0.0, most, _DELAYS) if most > 0.0 else np.zeros(1)
    errors = []
    for delay in tried.tolist():
        errors.append((_vf_error(data, order, delay), delay))
    errors.sort()
    return [delay for error, delay in errors[:_KEPT] if error <= _NEARLY * errors[0][0]]


def _vf_error(data: _Data, order: int, delay: float) -> float:
    poles, roots = _vector_fit(data, order, delay, _FEW_ROUNDS)
    with np.errstate(all="ignore"):
        s = data.s[:, None]
        model = np.sum(np.log(s - roots), axis=1) - np.sum(np.log(s - poles), axis=1)
        e = model - data.log - data.s * delay
        e = e - np.average(e.real, weights=data.std**-2.0)
        off = [
            float(np.mean(np.hypot(e.real, np.angle(sign * np.exp(1j * e.imag))) / data.std))
            for sign in (1.0, -1.0)
        ]
    return min(off) if all(map(math.isfinite, off)) else math.inf


def _vector_fit(
    data: _Data, order: int, delay: float, rounds: int = ROUNDS
) -> tuple[Complex, Complex]:
    """Return poles and zeros of a rational model of ``order``, as many of both."""
    H = np.exp(data.log + data.s * delay)
    found = vector_fit(data.s, H, 1.0 / (np.abs(H) * data.std), order, rounds)
    return found.poles, found.zeros


def _sections(roots: Complex) -> tuple[tuple[float, ...], list[float], list[float]]:
    """Return signs and logarithms of the real roots, then ``ln ω, ζ`` of the pairs."""
    real = roots[roots.imag == 0.0].real
    upper = roots[roots.imag > 0.0]
    pairs: list[float] = []
    for root in upper:
        pairs += [math.log(abs(root)), -root.real / abs(root)]
    return tuple(np.sign(-real).tolist()), np.log(np.abs(real)).tolist(), pairs


def _refined(data: _Data, poles: Complex, zeros: Complex, integrators: int, delay: float) -> _Fit:
    """Return the least error from a start."""
    of_p, of_z = _sections(poles), _sections(zeros)
    start = np.array([0.0, *of_p[1], *of_p[2], *of_z[1], *of_z[2]])
    if not np.all(np.isfinite(start)):
        return _nothing()
    pole_pairs, zero_pairs = len(of_p[2]) // 2, len(of_z[2]) // 2
    shape = _Shape(integrators, of_p[0], pole_pairs, of_z[0], zero_pairs, False, 1.0)
    size, phase = np.split(_errors(shape, start, data, delay), 2)
    start[0] = -float(np.average(size, weights=1.0 / data.std))
    if np.median(np.abs(phase) * data.std) > 0.5 * math.pi:
        shape = shape._replace(sign=-1.0)
    if data.fixed is not None:
        return _least(data, shape, start, delay, _FIRST)
    late = _least(data, shape._replace(delayed=True), np.append(start, delay), 0.0, _FIRST)
    if not math.isfinite(late.cost):
        return late
    # A delay that may be zero is none; a negative one is a pole that is missing.
    spread = math.sqrt(float(_covariance(late)[-1, -1]))
    if late.theta[-1] > DEVIATIONS * spread:
        return late
    return _least(data, shape._replace(sign=late.shape.sign), late.theta[:-1], 0.0, _FIRST)


def _nothing() -> _Fit:
    none = np.zeros(0)
    shape = _Shape(0, (), 0, (), 0, False, 1.0)
    return _Fit(shape, none, math.inf, math.inf, np.zeros((0, 0)), none, False)


def _terms(shape: _Shape, theta: Vector, s: Complex) -> tuple[Complex, Complex]:
    """Return ln G without sign (N,), and its derivatives (N, size)."""
    found = np.full(s.size, theta[0], dtype=np.complex128) - shape.integrators * np.log(s)
    slopes: list[Complex] = [np.ones(s.size, dtype=np.complex128)]
    at = 1
    for signs, pairs, factor in (
        (shape.poles, shape.pole_pairs, -1.0),
        (shape.zeros, shape.zero_pairs, 1.0),
    ):
        for sign in signs:
            x = sign * s * _exp(-theta[at])
            found += factor * np.log(1.0 + x)
            slopes.append(-factor * x / (1.0 + x))
            at += 1
        for _ in range(pairs):
            x, zeta = s * _exp(-theta[at]), theta[at + 1]
            D = 1.0 + 2.0 * zeta * x + x * x
            found += factor * np.log(D)
            slopes += [-factor * (2.0 * zeta * x + 2.0 * x * x) / D, factor * 2.0 * x / D]
            at += 2
    if shape.delayed:
        found = found - s * theta[at]
        slopes.append(-s)
    return found, np.column_stack(slopes)


def _errors(shape: _Shape, theta: Vector, data: _Data, delay: float) -> Vector:
    """Return the errors of size and phase over their deviations (2 N,)."""
    with np.errstate(all="ignore"):
        found = _terms(shape, theta, data.s)[0]
        away = found - data.s * delay - data.log + (0.0 if shape.sign > 0.0 else 1j * math.pi)
        phase = np.angle(np.exp(1j * away.imag))
        return np.concatenate([away.real, phase]) / np.tile(data.std, 2)


def _least(data: _Data, shape: _Shape, start: Vector, delay: float, steps: int) -> _Fit:
    """Return the least error of a shape from ``start``."""
    from scipy.optimize import least_squares

    twice = np.tile(data.std, 2)[:, None]

    def slopes(theta: Vector, *_: Any) -> Matrix:
        with np.errstate(all="ignore"):
            found = _terms(shape, theta, data.s)[1]
        both = np.vstack([found.real, found.imag]) / twice
        return np.nan_to_num(both, nan=0.0, posinf=0.0, neginf=0.0)

    def errors(theta: Vector) -> Vector:
        return np.nan_to_num(_errors(shape, theta, data, delay), nan=1e6, posinf=1e6, neginf=-1e6)

    try:
        done = least_squares(errors, start, slopes, method="lm", x_scale="jac", max_nfev=steps)
    except (ValueError, np.linalg.LinAlgError):
        return _nothing()
    e = errors(done.x)
    size = math.sqrt(2.0 * float(np.mean((e * np.tile(data.std, 2)) ** 2)))
    cost = float(np.mean(e * e))
    return _Fit(shape, done.x, cost, size, slopes(done.x), e, done.status > 0)


def _holds(fit: _Fit, data: _Data) -> bool:
    """Return whether poles are stable and within the table, and equal no zero."""
    cov = _covariance(fit)
    poles, zeros, slopes_p, slopes_z = _roots(fit)
    w = data.s.imag
    for p in poles:
        if p.real > 0.0 or abs(p) > OUTSIDE * w[-1] or abs(p) < w[0] / OUTSIDE:
            return False
    for z, of_z in zip(zeros, slopes_z, strict=True):
        if abs(z) > OUTSIDE * w[-1]:
            return False
        for p, of_p in zip(poles, slopes_p, strict=True):
            spread = sum(
                math.sqrt(abs(float((of @ cov @ of.conjugate()).real))) for of in (of_p, of_z)
            )
            if abs(p - z) <= DEVIATIONS * spread:
                return False
    return True


def _covariance(fit: _Fit) -> Matrix:
    J = fit.jacobian
    free = max(J.shape[0] - J.shape[1], 1)
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv((J / size).T @ (J / size), hermitian=True, rcond=1e-14)
    rho = fit.correlation
    power = float(np.sum(fit.residual**2)) / free
    # No table is better than its digits.
    factor = max(power, _DIGITS**2) * (1.0 + rho) / (1.0 - rho)
    return np.asarray(factor * inverse / np.outer(size, size))


def _roots(fit: _Fit) -> tuple[list[complex], list[complex], list[Complex], list[Complex]]:
    """Return poles and zeros but those at s = 0, and their derivatives by θ."""
    shape, theta, at = fit.shape, fit.theta, 1
    found: list[list[complex]] = []
    slopes: list[list[Complex]] = []
    for signs, pairs in ((shape.poles, shape.pole_pairs), (shape.zeros, shape.zero_pairs)):
        roots: list[complex] = []
        of: list[Complex] = []
        for sign in signs:
            roots.append(complex(-sign * _exp(theta[at])))
            of.append(_slope(theta.size, at, roots[-1]))
            at += 1
        for _ in range(pairs):
            w, zeta = _exp(theta[at]), float(theta[at + 1])
            root = np.sqrt(complex(zeta * zeta - 1.0))
            for sign in (1.0, -1.0):
                p = w * (-zeta + sign * root)
                roots.append(complex(p))
                slope = _slope(theta.size, at, p)
                slope[at + 1] = w * (-1.0 + sign * zeta / (root or 1e-12))
                of.append(slope)
            at += 2
        found.append(roots)
        slopes.append(of)
    return found[0], found[1], slopes[0], slopes[1]


def _slope(size: int, at: int, value: complex) -> Complex:
    found = np.zeros(size, dtype=np.complex128)
    found[at] = value
    return found


def _coefficients(shape: _Shape, theta: Vector, middle: float) -> Vector:
    """Return a (without those of s = 0) and b in ascending powers, and the delay, in seconds."""
    at = 1
    parts = []
    for signs, pairs in ((shape.poles, shape.pole_pairs), (shape.zeros, shape.zero_pairs)):
        polynomial: Complex = np.ones(1)
        scale = 0.0
        for sign in signs:
            polynomial = np.polymul(polynomial, [1.0, sign * _exp(theta[at]) * middle])
            scale += theta[at] + math.log(middle)
            at += 1
        for _ in range(pairs):
            w = _exp(theta[at]) * middle
            polynomial = np.polymul(polynomial, [1.0, 2.0 * theta[at + 1] * w, w * w])
            scale += 2.0 * math.log(w)
            at += 2
        # The sections are 1 at s = 0; monic they have the product of the roots there.
        signs_product = math.prod(signs) if signs else 1.0
        parts.append((polynomial, scale, signs_product))
    (den, of_den, sign_den), (num, of_num, sign_num) = parts
    b = _exp(theta[0] + of_den - of_num) * sign_den * sign_num * shape.sign
    b *= middle ** (shape.integrators)
    delay = theta[at] / middle if shape.delayed else 0.0
    return np.concatenate([den[:0:-1], b * num[::-1], [delay]])


def _result(
    fit: _Fit,
    data: _Data,
    middle: float,
    omega: Vector,
    response: Complex,
    dt: float | None,
    signals: Signals,
) -> FrequencyModel:
    shape, theta = fit.shape, fit.theta
    values = _coefficients(shape, theta, middle)
    J = np.zeros((values.size, theta.size))
    for k in range(theta.size):
        step = np.zeros(theta.size)
        step[k] = 1e-6
        J[:, k] = _coefficients(shape, theta + step, middle)
        J[:, k] = (J[:, k] - _coefficients(shape, theta - step, middle)) / 2e-6
    cov = J @ _covariance(fit) @ J.T
    free, n = shape.order - shape.integrators, shape.order
    known = 2 * omega.size >= _FEW * theta.size + 2
    if not known:
        cov = np.full_like(cov, np.nan)
    a = np.zeros(n)
    a[shape.integrators :] = values[:free]
    b = values[free:-1]
    size = free + b.size
    covariance = cov[:size, :size]
    delay = values[-1] if data.fixed is None else data.fixed / middle
    with np.errstate(invalid="ignore"):
        poles = poles_of(a, covariance, shape.integrators)
        zeros = zeros_of(b, covariance[free:, free:])
    low, high = gain_interval(
        a[shape.integrators :], float(b[0]), covariance[: free + 1, : free + 1]
    )
    of_delay = np.nan_to_num(cov[-1]) if shape.delayed else np.zeros(size + 1)
    return FrequencyModel(
        num=b[::-1].copy(),
        den=np.append(1.0, a[::-1]),
        covariance=covariance,
        poles=poles,
        zeros=zeros,
        integrators=shape.integrators,
        delay=float(delay),
        delay_covariance=of_delay,
        gain_interval=(low, high),
        error=fit.error,
        omega=omega,
        response=response,
        dt=dt,
        known=known,
        converged=fit.converged,
        signals=signals,
    )


def _exp(x: float) -> float:
    """Return e^x of a number that may be anything on the way of the search."""
    return math.exp(min(max(x, -_LARGE), _LARGE))
