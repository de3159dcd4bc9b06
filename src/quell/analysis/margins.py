"""Frequency responses of sampled systems, and stability margins from them.

Stability margins of a loop from its frequency response.

With L the loop, broken at the plant's input, and ``S = 1/(1 + L)``, a stable loop stays stable as
long as

* its gain is multiplied by a factor between the lower and the upper *gain margin*;
* its phase changes by less than the *phase margin*;
* its dead time grows by less than the *delay margin*;
* L changes by less than the *modulus margin* ``1/max |S| = min |1 + L|`` (Landau; Åström & Murray's
  stability margin s_m);
* gain and phase vary together in the disk ``(1 + δ/2)/(1 − δ/2)``, ``|δ| <`` the *disk margin* ``α
  = 1/max |S − ½|`` (Seiler, Packard & Gahinet, *IEEE Control Systems* 40, 2020, with skew 0): gain
  by any factor in ``(2 − α)/(2 + α) … (2 + α)/(2 − α)`` or phase by ``2 atan(α/2)``.

Frequency responses of sampled systems, and the frequencies at which to evaluate them.

No polynomial is formed: poles of an observer coincide close to z = 1, where the roots of a
polynomial of degree 5 move by the fifth root of its rounding errors. A response is a linear solve,
``C (ζI − N)⁻¹ B + D`` with ``ζ = e^(jω dt) − 1`` and ``N = A − I``, so that slow dynamics are not
the difference of two numbers near one. A dead time is a power of z (``pure_delays``).

Sampled systems whose pure delays are powers of z⁻¹ instead of states.

A dead time of d samples is a chain of d states, each of which takes the value of the one before.
Such a state, whose next value is ``g`` times one other state and nothing else, is ``X_i = g z⁻¹
X_j``. Substituting this along the chains leaves r states (of both plant and controller few)::

    (z I − A − Σ_k z^(−k) M_k) X = B U,        Y = (C + Σ_k z^(−k) C_k) X + D U

which is exact. A frequency then costs r³ instead of (r + d)³ operations, and its memory r².
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.lti.models import MatrixSystem, System
from quell.types import Matrix, Vector

# ---- Sampled systems whose pure delays are powers of z⁻¹ instead of states ----

# With fewer states to remove, the matrices of the whole system are as quick. Chosen by hand.
_WORTH = 4


class Delays(NamedTuple):
    """A matrix ``A − I`` without its chains of delays."""

    kept: NDArray[np.intp]  # indices of the r states that are left
    N: Matrix  # A − I of these (r, r)
    source: NDArray[np.intp]  # for each state of the whole: the state, of the r, that it delays
    steps: NDArray[np.intp]  # by so many samples; 0 for a state that is left
    factor: Vector  # and multiplies by this


def without_delays(N: Matrix, *inputs: Vector) -> Delays | None:
    """Return ``A − I`` (n, n) without the states that only delay another; None if there are few.

    States that one of the ``inputs`` (n,) reaches at once are kept.
    """
    size = N.shape[0]
    A_nonzero = N != 0.0
    np.fill_diagonal(A_nonzero, np.diag(N) != -1.0)
    candidates = (np.count_nonzero(A_nonzero, axis=1) == 1) & (np.diag(N) == -1.0)
    for column in inputs:
        candidates &= column == 0.0
    if np.count_nonzero(candidates) < _WORTH:
        return None
    before = np.argmax(A_nonzero, axis=1)
    source, steps = np.arange(size), np.zeros(size, dtype=np.intp)
    factor, is_kept = np.ones(size), ~candidates
    for start in np.flatnonzero(candidates):
        chain, at = [], int(start)
        while not is_kept[at] and steps[at] == 0 and at not in chain:
            chain.append(at)
            at = int(before[at])
        if at in chain:  # a cycle of delays: one of them stays a state
            is_kept[at] = True
            chain = chain[: chain.index(at)]
        for state in reversed(chain):
            j = before[state]
            source[state], steps[state] = source[j], steps[j] + 1
            factor[state] = factor[j] * N[state, j]
    kept = np.flatnonzero(is_kept)
    position = np.zeros(size, dtype=np.intp)
    position[kept] = np.arange(kept.size)
    return Delays(kept, N[np.ix_(kept, kept)], position[source], steps, factor)


def delayed_parts(delays: Delays, rows: Matrix) -> tuple[Vector, NDArray[np.float64]]:
    """Return the numbers of samples k (K,) and the parts (K, m, r) of ``rows`` (m, n) at z⁻ᵏ."""
    used = np.flatnonzero((delays.steps > 0) & np.any(rows != 0.0, axis=0))
    steps = np.unique(delays.steps[used])
    parts = np.zeros((steps.size, rows.shape[0], delays.kept.size))
    for i in used:
        k = np.searchsorted(steps, delays.steps[i])
        parts[k, :, delays.source[i]] += rows[:, i] * delays.factor[i]
    return steps.astype(np.float64), parts


def eigenvalues(N: Matrix) -> NDArray[np.complex128]:
    """Return the eigenvalues less one (n,) of A, given ``N = A − I`` (n, n).

    Chains of delays that feed nothing back, or that repeat another one, have all their eigenvalues
    at z = 0, where rounding errors would spread them: of a nilpotent block of 200 states over a
    circle of the radius 0.83. They are found from the structure instead.
    """
    whole, left_out = without_idle_chains(N)
    found = np.linalg.eigvals(whole).astype(np.complex128)
    return np.append(found, np.full(left_out, -1.0 + 0.0j)) if left_out else found


def without_idle_chains(N: Matrix) -> tuple[Matrix, int]:
    """Return ``A − I`` without chains of delays as in ``eigenvalues``, and how many states less."""
    delays = without_delays(N)
    if delays is None:
        return N, 0
    steps, M = delayed_parts(delays, N[delays.kept])
    rest, M = _merge_equal(delays.N.copy(), M)
    last = np.zeros(rest.shape[0], dtype=np.intp)  # longest delay of each state
    for k, part in zip(steps.astype(np.intp), M, strict=True):
        last[np.any(part != 0.0, axis=0)] = k
    first = rest.shape[0] + np.cumsum(last) - last  # place of the first state of each chain
    size = rest.shape[0] + int(np.sum(last))
    whole = np.zeros((size, size))
    whole[: rest.shape[0], : rest.shape[0]] = rest
    for j in np.flatnonzero(last):
        for k in range(last[j]):
            at = first[j] + k
            whole[at, at] = -1.0
            whole[at, at - 1 if k else j] = 1.0
    for k, part in zip(steps.astype(np.intp), M, strict=True):
        for j in np.flatnonzero(np.any(part != 0.0, axis=0)):
            whole[: rest.shape[0], first[j] + k - 1] += part[:, j]
    return whole, N.shape[0] - size


def _merge_equal(N: Matrix, M: NDArray[np.float64]) -> tuple[Matrix, NDArray[np.float64]]:
    """Return the matrices without states that always equal another one after a sample."""
    while True:
        size = N.shape[0]
        rows = np.hstack([N + np.eye(size), *M])
        _, first, to = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        if first.size == size:
            return N, M
        twin = first[to.ravel()]  # each state's first equal
        kept = np.flatnonzero(twin == np.arange(size))
        for i in np.flatnonzero(twin != np.arange(size)):
            N[:, twin[i]] += N[:, i]
            M[:, :, twin[i]] += M[:, :, i]
        N, M = N[np.ix_(kept, kept)], M[:, kept][:, :, kept]


# ---- Frequency responses of sampled systems, and the frequencies at which to evaluate them ----

Complex = NDArray[np.complex128]

# The grid only brackets extrema and sign changes, which ``margins`` refines. With 10 to 240 points
# per decade, and without the points beside resonances, the margins of 63 loops (chains, two masses,
# weak resonances; ADRC, LQG, PID) agree to 1e-11; the points beside resonances are for plots.
_POINTS_PER_DECADE = 60
# Points beside a resonance, in units of its damping; without damping, as shares of its frequency.
_BESIDE_DAMPED = np.array([0.0, 0.1, 0.3, 1.0, 3.0])
_BESIDE_UNDAMPED = np.logspace(-6.0, -1.0, 11)
# Numbers in the matrices of the frequencies that are solved together: 16 MB. Chosen by hand; larger
# blocks are not quicker.
_BLOCK = 1_000_000
# What a set takes of each response.
_PARTS = ("_N", "_B", "_C", "_D", "_steps", "_M", "_C_late")


class Response:
    """The frequency response of a system, prepared for many frequencies."""

    def __init__(self, system: System | MatrixSystem) -> None:
        self._one = isinstance(system, System)
        N, D = system.N, np.asarray(system.D)
        B, C = (system.B[:, None], system.C[None]) if self._one else (system.B, system.C)
        steps, M, C_late = np.zeros(0), np.zeros((0, *N.shape)), np.zeros((0, *C.shape))
        delays = without_delays(N, *B.T)
        if delays is not None:
            kept, r = delays.kept, delays.kept.size
            steps, parts = delayed_parts(delays, np.vstack([N[kept], C]))
            N, B, C, M, C_late = delays.N, B[kept], C[:, kept], parts[:, :r], parts[:, r:]
        scale = balancing_scales(N, M) if N.size else np.ones(0)
        self._steps, self._D, self._identity = steps, D, np.eye(N.shape[0])
        self._M = (M * scale / scale[:, None]).reshape(steps.size, N.size)
        self._N, self._B = N * scale / scale[:, None], (B / scale[:, None]).astype(complex)
        self._C, self._C_late = C * scale, (C_late * scale).reshape(steps.size, C.size)

    def __call__(self, omega: Any, dt: float) -> Complex:
        """Return the response (k,), or (k, p, m), at the frequencies ``omega`` (k,) [rad/s].

        A complex frequency −j s gives the transfer function at s. Raises ``ValueError`` at the
        frequency of a pole.
        """
        omega = np.atleast_1d(np.asarray(omega))
        if omega.dtype != np.complex128:
            omega = omega.astype(np.float64)
        count = math.ceil(omega.size * (self._N.size + self._steps.size) / _BLOCK)
        if count < 2:
            return self._block(omega, dt)
        return np.concatenate([self._block(part, dt) for part in np.array_split(omega, count)])

    def _block(self, omega: Vector, dt: float) -> Complex:
        resolvent = np.expm1(1j * omega * dt)[:, None, None] * self._identity - self._N
        output: Any = self._C
        if self._steps.size:
            late = np.exp(-1j * dt * omega[:, None] * self._steps)
            resolvent -= (late @ self._M).reshape(resolvent.shape)
            output = self._C + (late @ self._C_late).reshape(-1, *self._C.shape)
        try:
            solved = np.linalg.solve(resolvent, self._B)
        except np.linalg.LinAlgError:
            raise ValueError(
                f"omega = {omega.tolist()!r} rad/s: the response is infinite at one of "
                "them, a pole; leave it out"
            ) from None
        if not self._one:
            return output @ solved + self._D
        # A third of the time of the matrix product, and tuning asks for little else.
        row, column = output[..., 0, :], solved[:, :, 0]
        product = column @ row if row.ndim == 1 else np.sum(column * row, axis=1)
        return np.asarray(product + self._D, dtype=np.complex128)


class ResponseSet:
    """Responses of systems of one input and output, those of equal size found together."""

    def __init__(self, responses: Sequence[Response]) -> None:
        sizes = [(each._N.shape[0], each._steps.size) for each in responses]
        self._groups: list[tuple[Any, ...]] = []
        for size in dict.fromkeys(sizes):
            numbers = [i for i, other in enumerate(sizes) if other == size]
            place = np.full(len(responses), -1)
            place[numbers] = np.arange(len(numbers))
            parts = [[getattr(responses[i], name) for i in numbers] for name in _PARTS]
            self._groups.append((place, *map(np.array, parts)))

    def __call__(self, omega: Any, members: NDArray[np.intp], dt: float) -> Complex:
        """Return the responses (k,) at frequencies (k,), each of the system with that number.

        Raises ``ValueError`` at the frequency of a pole.
        """
        found = np.empty(omega.size, dtype=np.complex128)
        for place, N, B, C, D, steps, M, C_late in self._groups:
            own = np.flatnonzero(place[members] >= 0)
            count = math.ceil(own.size * (N[0].size + 1) / _BLOCK)
            for part in np.array_split(own, count) if count else ():
                i, w = place[members[part]], omega[part]
                resolvent, output = (-N[i]).astype(complex), C[i, 0]
                np.einsum("kii->ki", resolvent)[...] += np.expm1(1j * w * dt)[:, None]
                if steps.size:
                    late = np.exp(-1j * dt * w[:, None] * steps[i])[:, None]
                    resolvent -= (late @ M[i]).reshape(resolvent.shape)
                    output = output + (late @ C_late[i])[:, 0]
                try:
                    solved = np.linalg.solve(resolvent, B[i])[:, :, 0]
                except np.linalg.LinAlgError:
                    raise ValueError("omega: the response is infinite at one of them") from None
                found[part] = np.sum(solved * output, axis=1) + D[i]
        return found


def balancing_scales(N: Matrix, M: NDArray[np.float64]) -> Vector:
    """Return factors that balance a matrix with the sizes of its delayed parts."""
    from scipy.linalg import matrix_balance

    size = np.abs(N) + np.sum(np.abs(M), axis=0)
    _, (scale, _) = matrix_balance(size, permute=False, separate=True)
    return scale


def in_s_plane(shifted: Complex, dt: float) -> Complex:
    """Return ``log(z)/dt`` for poles given as z − 1; a pole at z = 0 becomes −inf."""
    with np.errstate(divide="ignore"):
        size = np.where(
            np.abs(1.0 + shifted) < 1e-7,  # z = 0, found as an eigenvalue of a defective matrix
            -np.inf,
            0.5 * np.log1p(2.0 * shifted.real + np.abs(shifted) ** 2),
        )
    angle = np.where(np.isinf(size), 0.0, np.angle(1.0 + shifted))
    return size / dt + 1j * (angle / dt)


def frequencies(poles: Complex, dt: float) -> Vector:
    """Return frequencies [rad/s] up to half the sampling rate, dense near the s-plane poles."""
    top = math.pi / dt
    size = np.abs(poles)
    finite = size[(size > 1e-9 * top) & (size < top)]  # smaller ones are integrators, to rounding
    bottom = 1e-2 * float(np.min(finite, initial=0.1 * top))
    grid = [np.geomspace(bottom, top, math.ceil(_POINTS_PER_DECADE * math.log10(top / bottom)) + 1)]
    for pole in poles[np.isfinite(poles) & (poles.imag > 0.0)]:
        center, damping = pole.imag, abs(pole.real)
        away = damping * _BESIDE_DAMPED if damping > 1e-6 * center else center * _BESIDE_UNDAMPED
        grid += [center - away, center + away]
    omega = np.unique(np.concatenate(grid))
    return omega[(omega >= bottom) & (omega <= top)]


# ---- Stability margins of a loop from its frequency response ----

LoopFunction = Callable[[Vector], Complex]

# Range of the search for the edge of stability: far beyond any physical error of a gain.
_LEAST_FACTOR, _LARGEST_FACTOR = 1e-9, 1e9
# How far below the lowest frequency of the grid ω → 0 is evaluated.
_TOWARDS_ZERO = 1e-3
# Local minima to refine: a sharp dip may lie beside a grid point that is not the lowest. Chosen by
# hand; one was enough in the loops that ``frequency_response`` names.
_MINIMA = 3
# Relative errors of the refined frequencies. The value of a flat minimum is exact before.
_MINIMUM_TOLERANCE, _CROSSING_TOLERANCE = 1e-9, 1e-13


class Margins(NamedTuple):
    """Margins of a loop, each with its frequency [rad/s] or NaN; zero for an unstable loop."""

    gain: tuple[float, float]
    """Range of factors of the gain; (1, 1) for an unstable loop. Factors below 1e-9 and above 1e9
    are not searched, and count as 0 and as infinite."""
    gain_omega: tuple[float, float]
    phase: float
    """[degrees]; infinite if the gain is never 1."""
    phase_omega: float
    modulus: float
    modulus_omega: float
    disk: float
    disk_omega: float
    delay: float
    """[s]; exact for whole numbers of samples."""
    delay_omega: float

    @property
    def disk_gain(self) -> tuple[float, float]:
        """Factors of the gain that the disk margin allows, at any phase in its disk."""
        high = math.inf if self.disk >= 2.0 else (2.0 + self.disk) / (2.0 - self.disk)
        return 1.0 / high, high

    @property
    def disk_phase(self) -> float:
        """Phase that the disk margin allows, at any gain in its disk [degrees]."""
        return math.degrees(2.0 * math.atan(self.disk / 2.0))


def margins(
    loop: LoopFunction, omega: Vector, dt: float, stable_with: Callable[[float], bool]
) -> Margins:
    """Return the margins of a loop, given as a function from frequencies [rad/s] to L.

    Extrema and crossings are refined between the frequencies ``omega``. ``stable_with`` returns
    whether the closed loop is stable with its gain times a factor.
    """
    nan = math.nan
    if not stable_with(1.0):
        return Margins((1.0, 1.0), (nan, nan), 0.0, nan, 0.0, nan, 0.0, nan, 0.0, nan)
    L = loop(omega)
    gain, gain_omega = _gain_margin(loop, omega, L, dt, stable_with)
    modulus, modulus_omega = least(lambda w: np.abs(1.0 + loop(w)), omega, np.abs(1.0 + L))
    disk, disk_omega = least(lambda w: _disk_distance(loop(w)), omega, _disk_distance(L))
    with np.errstate(divide="ignore"):
        crossings = _sign_changes(lambda w: np.log(np.abs(loop(w))), omega, np.log(np.abs(L)))
    phase, phase_omega, delay, delay_omega = math.inf, nan, math.inf, nan
    for at in crossings:
        # Angle from −1, counter-clockwise: 0 … 2π.
        lead = math.pi + float(np.angle(loop(np.array([at])))[0])
        if abs(math.remainder(lead, 2.0 * math.pi)) < phase:
            phase, phase_omega = abs(math.remainder(lead, 2.0 * math.pi)), at
        if lead / at < delay:
            delay, delay_omega = lead / at, at
    return Margins(
        *(gain, gain_omega, math.degrees(phase), phase_omega, modulus, modulus_omega),
        *(disk, disk_omega, delay, delay_omega),
    )


def _disk_distance(L: Complex) -> Vector:
    """Return ``1/|S − ½| = 2 |1 + L| / |1 − L|``."""
    with np.errstate(divide="ignore"):
        distance: Vector = 2.0 * np.abs(1.0 + L) / np.abs(1.0 - L)
    return distance


def _gain_margin(
    loop: LoopFunction, omega: Vector, L: Complex, dt: float, stable_with: Callable[[float], bool]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the range of gain factors for which the loop is stable, and the frequencies there.

    A pole is on the unit circle for the factor κ where ``κ L = −1``: at crossings of the negative
    real axis, at ω → 0 and at half the sampling rate. Between two such factors stability does not
    change, so one test between them is enough.
    """

    def inverse(w: float) -> complex:
        """Return 1/L(ω), which is zero at a pole of an undamped plant."""
        try:
            return complex(1.0 / loop(np.array([w]))[0])
        except ValueError:
            return 0.0

    def imaginary_part(w: Vector) -> Vector:
        return np.array([inverse(float(w[0])).imag])

    crossings = _sign_changes(imaginary_part, omega, np.imag(1.0 / L))
    candidates = {}
    for at in [*crossings, float(omega[0]) * _TOWARDS_ZERO, math.pi / dt]:
        factor = -inverse(at).real
        if _LEAST_FACTOR < factor < _LARGEST_FACTOR:
            candidates[factor] = at

    def edge(factors: list[float], last: float) -> tuple[float, float] | None:
        """Return the first of the factors beyond which the loop is unstable, with its frequency."""
        for factor, beyond in pairwise([*factors, last]):
            if not stable_with(math.sqrt(factor * beyond)):
                return factor, candidates[factor]
        return None

    # Beyond the last candidate stability does not change, so any larger (smaller) factor tests it.
    above = sorted(k for k in candidates if k > 1.0)
    below = sorted((k for k in candidates if k <= 1.0), reverse=True)
    high, high_omega = edge(above, 4.0 * max([1.0, *above])) or (math.inf, math.nan)
    low, low_omega = edge(below, 0.25 * min([1.0, *below])) or (0.0, math.nan)
    return (low, high), (low_omega, high_omega)


def least(
    function: Callable[[Vector], Vector], omega: Vector, values: Vector
) -> tuple[float, float]:
    """Return the minimum of a function and its frequency; ``values`` are those at ``omega``."""
    from scipy.optimize import minimize_scalar

    best = int(np.argmin(values))
    found = float(values[best]), float(omega[best])
    inside = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])) + 1
    for i in inside[np.argsort(values[inside])][:_MINIMA]:
        near = minimize_scalar(
            lambda x: float(function(np.exp(np.array([x])))[0]),
            bounds=(math.log(omega[i - 1]), math.log(omega[i + 1])),
            method="bounded",
            options={"xatol": _MINIMUM_TOLERANCE},
        )
        if near.fun < found[0]:
            found = float(near.fun), math.exp(near.x)
    return found


def _sign_changes(
    function: Callable[[Vector], Vector], omega: Vector, values: Vector
) -> list[float]:
    """Return the frequencies at which a function changes its sign."""
    from scipy.optimize import brentq

    @cache  # brentq begins with the ends of a bracket, which are known
    def at(x: float) -> float:
        return float(function(np.exp(np.array([x])))[0])

    found = []
    for i in np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:])):
        low, high = math.log(omega[i]), math.log(omega[i + 1])
        # At half the sampling rate a response is real: the sign of its imaginary part is a rounding
        # error, which does not repeat.
        if np.isfinite(values[i]) and np.isfinite(values[i + 1]) and at(low) * at(high) < 0.0:
            root = brentq(at, low, high, xtol=_CROSSING_TOLERANCE, rtol=_CROSSING_TOLERANCE)
            found.append(math.exp(root))
    return found
