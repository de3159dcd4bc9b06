"""ADRC as a structure: bandwidths, own poles, models, sampled feedback, equivalents of PID.

ADRC by bandwidths, with poles of its own, at half gain, of reduced order, with a model.

The poles of the law and of the observer are each one number, the bandwidth, or *free*: a factor
``s² + 2 ζ ω s + ω²`` for each two of them, real or complex, and a real pole if their number is odd.
An ADRC of order 1 with free poles has the feedback of a PI controller with a filter of first order,
one of order 2 that of a PID controller with a filter of second order
(``controllers/baselines/pid.py``), as long as the loop with its own nominal plant is stable. The
search starts from these.

The ADRC with free poles whose feedback is that of a given PI or PID controller with a filter.

In continuous time, with ``C = B(s)/(s A(s))``, A monic of degree n, and the nominal plant
``b0/s^n``, the poles of the law and of the observer are together the poles of the loop::

    s^(n+1) A(s) + b0 B(s) = p_law(s) p_observer(s)

This generalises the formulas of ``controllers/baselines/pid.py`` (Zhong, Huang & Guo,
*Science China Information Sciences* 63, 2020) to any poles. b0 is free: of its values, those are
taken for which all poles are damped. The sampled controllers agree to first order in dt.

The feedback of many sampled ADRC designs at many frequencies, without building controllers.

With the observer in its current form, c = (1, 0, …) and the law ``u = −K ẑ`` (``observers/forms``,
``controllers/law``), z⁻ the prediction and d the samples by which u is delayed::

    ẑ = z⁻ + L (y − c z⁻),     z z⁻ = (Φ − z^(−d) Γ K) ẑ
    C_y = z K ( z I − (I − L c) (Φ − z^(−d) Γ K) )⁻¹ L

and with ``ζ = z − 1``, ``Δ = Φ − I`` nothing is a small difference of large numbers::

    z I − (I − L c) (Φ − z^(−d) Γ K) = ζ I + L c − (I − L c) (Δ − z^(−d) Γ K)

L follows from Ackermann's formula, ``L = π(−Δ) O⁻¹ e_N`` but for signs, with π the polynomial with
the roots ``1 − z_i`` and O the observability matrix: it is linear in the coefficients of π.

C_y has a pole at z = 1. With v and w the right and left null vectors of that matrix M at ζ = 0, its
residue is ``K v · w L / (w M'(0) v)``, from which the integral gain follows. All is in coordinates
``x_i/ω^(i−1)``, ``f^(j)/ω^(q+j)`` with ω the geometric mean of the observer's poles; then C_y is
``ω^r/b0`` times a function of the poles alone.

With e extended states the pole at z = 1 has the multiplicity e, the integral gain is infinite, and
at low frequencies M is singular to rounding. There C_y is found from the innovation, with
A = Δ − Γ K. The states x of it do not depend on f, because u cancels it where it enters, and f is a
chain of its own, so that its powers of 1/ζ are exact::

    (ζ I − A) W = (I + A) L,        C_y = K (W + L) / (1 + c W)
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.analysis.margins import Complex
from quell.controllers.adrc import ADRC
from quell.controllers.feedforward import Feedforward
from quell.controllers.linear import LinearLaw
from quell.lti.canonical import Canonical, Reduced, canonical, without_far_zeros
from quell.lti.models import zero_order_hold
from quell.observers.design import motion_of_f, with_motion_of_f, with_rates
from quell.observers.eso import ESO
from quell.plants.linear import LinearPlant
from quell.tuning.structures.base import Model, Parameter, resonances
from quell.tuning.structures.baselines import FilteredPID
from quell.types import Matrix, Vector

# ---- The feedback of many sampled ADRC designs at many frequencies ----

Stack = NDArray[np.float64]

# A pole of the controller beyond is unstable; the integrator, to rounding, is not.
_OUTSIDE = 1e-7


class SampledChain(NamedTuple):
    """The extended model of a plant, sampled in ``x_i dt^(i−1)``, ``f^(j) dt^(q+j)``."""

    difference: Matrix  # Φ − I (N, N)
    input: Vector  # Γ for b0 = 1 and u in units of dt^−r (N,)
    placing: Matrix  # Δ^j O⁻¹ e_N in row N − j (N + 1, N)
    power: Vector  # 0 … n − 1, q, q + 1, …
    cancel: Vector  # (n,)
    cancel_f: float
    degree: int
    dt: float
    integrators: int  # number of poles of the feedback at z = 1


def sampled_chain(
    plant: Canonical, dt: float, extended: int = 1, frequencies: Sequence[float] = ()
) -> SampledChain:
    """Sample the model of ``plant`` with extended states as ``observers/design`` does."""
    n, q = plant.a.size, plant.f_degree
    A = np.diag(np.ones(n), 1)
    A[-2, :-1] -= plant.a * dt ** (n - np.arange(n))
    A[:-1, -1] = plant.E * dt ** (np.arange(n) + 1.0 - q)
    column = np.zeros((n + 1, 1))
    column[:-1, 0] = plant.B / plant.b * dt ** (np.arange(n) + 1.0 - plant.degree)
    _, (difference, gamma) = zero_order_hold(A, [A, column], 1.0)
    motion = motion_of_f(extended, np.array(frequencies) * dt)
    difference, gamma = with_motion_of_f(difference, motion), with_rates(gamma, extended)
    cancel = plant.a if plant.degree == n else -np.eye(n)[plant.degree]
    power = np.append(np.arange(float(n)), q + np.arange(float(extended)))
    matched = 1.0 if plant.matched else 0.0
    placing, integrators = _placing(difference), extended - 2 * len(frequencies)
    return SampledChain(
        *(difference, gamma[:, 0], placing, power, cancel, matched, plant.degree, dt, integrators)
    )


def _placing(difference: Matrix) -> Matrix:
    """Return what places poles: L is a combination of its rows (Ackermann's formula)."""
    size = difference.shape[0]
    rows = [difference[0] + np.eye(size)[0]]
    for _ in range(size - 1):
        rows.append(rows[-1] @ difference)
    found = [np.linalg.solve(np.array(rows), np.eye(size)[-1])]
    for _ in range(size):
        found.append(difference @ found[-1])
    return np.array(found[::-1])


@dataclass(frozen=True, eq=False)
class Designs:
    """m designs in coordinates of similar size."""

    gain: Matrix  # L (m, N)
    law: Matrix  # K (m, N)
    factor: Vector  # ω^r (m,); C_y = factor / b0 times the response of these
    base: Stack  # L c − (I − L c) Δ (m, N, N)
    closing: Stack  # (I − L c) Γ K (m, N, N)
    inner: Stack  # A = Δ − Γ K (m, N, N)
    difference: Stack  # Δ (m, N, N)
    column: Matrix  # Γ (m, N)
    delay: int
    dt: float
    integrators: int  # number of poles of C_y at z = 1

    @cached_property
    def integral_gain(self) -> Vector:
        """``k_i b0 / ω^r`` (m,)."""
        if self.integrators > 1:
            return np.full(self.gain.shape[0], np.inf)
        left, _, right = np.linalg.svd(self.base + self.closing)
        v, w = right[:, -1, :], left[:, :, -1]
        slope = np.eye(v.shape[1]) - self.delay * self.closing
        inner = np.einsum("mi,mij,mj->m", w, slope, v)
        through = np.sum(self.law * v, axis=1) * np.sum(w * self.gain, axis=1)
        return through / inner / self.dt


def designs(
    chain: SampledChain,
    law: Matrix,
    poles: NDArray[np.complex128],
    kept: NDArray[np.intp],
    *,
    reduced: bool = False,
    half_gain: bool = False,
    delay: int = 0,
) -> Designs:
    """Return designs with law gains k (m, r) and observer poles (m, N), or (m, N − 1) if reduced.

    With more than one extended state there must be no delay.

    ``kept`` are the numbers of those to return: not by itself, because in a product of matrices a
    single row has other rounding. ``delay`` is the known delay of u [samples].
    """
    count, size = law.shape[0], chain.power.size
    omega = np.exp(np.sum(np.log(np.abs(poles)), axis=1) / poles.shape[1])
    step = omega * chain.dt
    power = chain.power
    offsets = -np.expm1(poles * chain.dt)
    if reduced:
        offsets = np.hstack([offsets, np.ones((count, 1))])
    gain = monic(-offsets) @ chain.placing
    gain, law, omega, step = gain[kept], law[kept], omega[kept], step[kept]
    gain *= step[:, None] ** -power
    if reduced:
        gain[:, 0] = 1.0
    if half_gain:
        gain *= 0.5
    K = np.zeros((kept.size, size))
    K[:, : law.shape[1]] = law
    n = chain.cancel.size
    K[:, :n] -= chain.cancel
    K[:, n] = chain.cancel_f
    K *= omega[:, None] ** (power - chain.degree)
    correct = np.empty((kept.size, size, size))  # I − L c
    correct[:] = np.eye(size)
    correct[:, :, 0] -= gain
    column = chain.input * step[:, None] ** (chain.degree - power)
    closing = (correct @ column[:, :, None]) * K[:, None, :]
    difference = chain.difference * step[:, None, None] ** (power - power[:, None])
    base = -(correct @ difference)
    base[:, :, 0] += gain
    inner = difference - column[:, :, None] * K[:, None, :]
    factor = omega**chain.degree
    rest = difference, column, delay, chain.dt, chain.integrators
    return Designs(gain, K, factor, base, closing, inner, *rest)


def joined(parts: Sequence[Designs], order: NDArray[np.intp]) -> Designs:
    """Return the designs of all parts, which have the same size, in an order."""
    names = ("gain", "law", "factor", "base", "closing", "inner", "difference", "column")
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(each, name) for each in parts])[order] for name in names
    }
    return replace(parts[0], **arrays)


def coefficients(roots: NDArray[np.complex128]) -> Matrix:
    """Return ``c_0 … c_(n−1)`` (m, n) of the polynomials ``s^n + … + c_1 s + c_0`` with roots."""
    return np.ascontiguousarray(monic(roots)[:, :0:-1])


def monic(roots: NDArray[np.complex128]) -> Matrix:
    """Return the coefficients (m, n + 1), highest power first, of the polynomials with roots."""
    count, size = roots.shape
    found = np.zeros((count, size + 1), dtype=complex)
    found[:, 0] = 1.0
    for i in range(size):
        found[:, 1 : i + 2] -= roots[:, i : i + 1] * found[:, : i + 1]
    return np.ascontiguousarray(found.real)


def feedback(found: Designs, omega: Vector) -> Complex:
    """Return ``C_y b0 / ω^r`` (m, k) at frequencies (k,) [rad/s]."""
    if found.integrators > 1:
        return _feedback_by_innovation(found, omega)
    matrix, z = _matrices(found, omega)
    solved = np.linalg.solve(matrix, found.gain[:, None, :, None])[..., 0]
    return np.einsum("mkn,mn->mk", solved, found.law) * z


def _feedback_by_innovation(found: Designs, omega: Vector) -> Complex:
    zeta, A = np.expm1(1j * omega * found.dt), found.inner
    count, size = found.gain.shape
    n = size - found.integrators
    given = found.gain + np.einsum("mij,mj->mi", A, found.gain)  # (I + A) L
    given[:, :n] = found.gain[:, :n] + np.einsum("mij,mj->mi", A[:, :n, :n], found.gain[:, :n])
    W = np.empty((count, omega.size, size), dtype=complex)
    for i in range(size - 1, n - 1, -1):
        later = np.einsum("mj,mkj->mk", A[:, i, i + 1 :], W[:, :, i + 1 :])
        W[:, :, i] = (given[:, i, None] + later) / zeta
    matrix = zeta[:, None, None] * np.eye(n) - A[:, None, :n, :n]
    given_x = np.broadcast_to(given[:, None, :n, None], (count, omega.size, n, 1))
    W[:, :, :n] = np.linalg.solve(matrix, given_x)[..., 0]
    corrected = np.einsum("mki,mi->mk", W + found.gain[:, None, :], found.law)
    return corrected / (1.0 + W[:, :, 0])


def _matrices(found: Designs, omega: Vector) -> tuple[Complex, Complex]:
    """Return M (m, k, N, N) and z (k,)."""
    base, closing = found.base[:, None], found.closing[:, None]
    zeta = np.expm1(1j * omega * found.dt)
    z = 1.0 + zeta
    if found.delay:
        closing = z[:, None, None] ** -float(found.delay) * closing
    count, _, size, _ = base.shape
    matrix = np.empty((count, omega.size, size, size), dtype=complex)
    matrix[...] = base + closing
    _diagonals(matrix)[...] = zeta[:, None] + _diagonals(base) + _diagonals(closing)
    return matrix, z


def _diagonals(matrix: NDArray[Any]) -> NDArray[Any]:
    """Return the diagonals (m, k, N) of matrices (m, k, N, N), to read or to write."""
    return np.einsum("mkii->mki", matrix)


def unstable_poles(found: Designs) -> Vector:
    """Return the number (m,) of poles of C_y outside of the unit circle.

    With a delay the poles are counted by the argument of det M(z) over the upper half circle, which
    is ``π (N − unstable − 1/2)`` with the integrator's pole at z = 1.
    """
    base, closing = found.base, found.closing
    if found.delay == 0:
        shifted: Any = np.linalg.eigvals(-(base + closing))
        if found.integrators > 1:
            # Rounding moves an e-fold pole by its e-th root: the integrators are those next to 1.
            near = np.argsort(np.abs(shifted), axis=1)
            shifted = np.take_along_axis(shifted, near[:, found.integrators :], axis=1)
        outside = np.abs(1.0 + shifted) > 1.0 + _OUTSIDE
        return np.sum(outside, axis=1).astype(np.float64)
    top, size = np.pi / found.dt, base.shape[1]
    even = np.linspace(0.0, top, 24 * (found.delay + size) + 2)[1:]
    omega = np.unique(np.concatenate([np.geomspace(1e-5 * top, top, 200), even]))
    angle = np.angle(np.linalg.det(_matrices(found, omega)[0]))
    steps = np.remainder(np.diff(angle, axis=1) + np.pi, 2.0 * np.pi) - np.pi
    return np.maximum(np.round(size - 0.5 - np.sum(steps, axis=1) / np.pi), 0.0)


# ---- ADRC by bandwidths, with poles of its own, at half gain, of reduced order, with a model ----

# Bounds of a pole in units of the plant's phase crossover, and of the damping of a pair. The law's
# poles are those of the ideal response to the reference: with a damping of 0.6 it overshoots by
# 9 %. The observer's poles show in no response to the reference, but while u is at a limit; the
# equivalents of PID controllers with slow filters have them hardly damped.
_SLOWEST = 1e-3
# Free frequencies of resonators lie below this share of half the sampling rate; where the load is
# not known they start at these shares of the plant's phase crossover.
_HIGHEST, _PLACES, _BESIDE = 0.5, (0.03, 0.1, 0.3), 1e-3
_DAMPING = {"c": (0.6, 20.0), "o": (0.03, 20.0)}
# Bandwidths to start from: of the law in units of the plant's phase crossover, and of the observer
# in units of the law's.
_LAW_STARTS = (0.02, 0.07, 0.2, 0.5, 1.2, 3.0)
_OBSERVER_STARTS = (0.3, 1.0, 3.0, 10.0, 30.0)
# With more extended states one slower than the law is often the best under bounds of M_s.
_SLOW_OBSERVER = 0.1
# Damping of the observer's pair at a resonance of the plant, and of the law's, to start from.
_RESONANCE_STARTS, _MOVED = (0.1, 0.4), 0.7
# With a model there are many valleys, also with an observer far slower than a quick law: a grid of
# bandwidths from this share of the crossover to this one of the fastest, with so many for each.
_FROM, _TO, _COUNT = 0.03, 0.98, 9
# k_i is infinite where a second pole comes to z = 1. Beside it, on the side of positive k_i, may be
# the best optimum: the law's bandwidths in units of that of an optimum, the observer's that are
# searched, and their distance from there, as a share.
_LAWS, _LOWEST_OBSERVER, _OBSERVERS, _OFF = (0.5, 1.0, 2.0), 1e-3, 300, 0.1


@dataclass(frozen=True)
class Form:
    """Which kind of ADRC a structure has."""

    free_poles: bool = False
    reduced: bool = False
    half_observer: bool = False
    half_law: bool = False
    based: bool = False
    knows_delay: bool = False
    extended: int = 1  # number of extended states
    resonators: int = 0  # number of sinusoids in the model of f, two of these states for each


class _Designed(NamedTuple):
    """Designs for values (m, p): one for neighbouring rows that differ in b0 only."""

    designs: Designs
    of_row: NDArray[np.intp]  # number of the design of each row (m,)


class AdrcStructure:
    """An ADRC of one form and order."""

    gain_power = -1

    def __init__(
        self, model: Model, name: str, order: int, form: Form, reduced: Reduced | None = None
    ) -> None:
        self.name, self.form = name, form
        # The design model of a form with a model; all else is about the plant itself.
        self.reduced = reduced
        if reduced is not None and str(reduced):
            own = canonical(reduced.plant)
            model = model._replace(plant=reduced.plant, degree=own.degree, b=abs(own.b))
        self.model = model
        self.gain_sign = model.sign
        # With s^(n+1) A + b0 B = p_law p_observer the poles of 1/A are as fast as the loop's. With
        # a model, D s A + b0 N B has A less the model's own poles: it may have a slow one.
        self.may_swing = form.based and form.extended == 1
        self.integrators = form.extended - 2 * form.resonators
        self.plant: Canonical = (
            canonical(model.plant) if form.based else canonical((np.zeros(order), 1.0))
        )
        if form.based and self.plant.unstable_zeros.size:
            raise ValueError("the plant has zeros outside of the left half plane, which it inverts")
        self.order, self.degree = self.plant.a.size, self.plant.degree
        self._last: tuple[bytes, Any] = b"", None
        self._values = np.zeros((0, 1))  # those of the last designs
        self._delay = round(model.delay / model.dt) if form.knows_delay else 0
        self._fastest = model.constraints.omega_o_dt / model.dt
        self._damping = dict(_DAMPING)
        least = model.constraints.damping
        if least is not None and not resonances(model, least):
            low, high = _DAMPING["o"]
            self._damping["o"] = (max(low, least), high)
            if form.resonators:
                self._damping["c"] = (max(low, least), high)
        self._observed = self.order + form.extended - form.reduced
        unit = model.gain * model.omega**self.degree
        self.parameters = (
            Parameter("b0", f"y-unit/u-unit/s^{self.degree}", 1e-10 * unit, 1e10 * unit),
            *self._pole_parameters("c", self.degree),
            *self._pole_parameters("o", self._observed),
        )
        # Frequencies that are not known are further parameters, the last ones.
        self._known = model.frequencies if form.resonators else ()
        if self._known and len(self._known) != form.resonators:
            raise ValueError(
                f"frequencies = {list(self._known)!r}: {name} has {form.resonators} of them; give "
                "as many, or none to have them tuned"
            )
        self._free = form.resonators - len(self._known)
        top = _HIGHEST * math.pi / model.dt
        self.parameters += tuple(
            Parameter(f"omega_r{i + 1}", "rad/s", min(_SLOWEST * model.omega, 0.1 * top), top)
            for i in range(self._free)
        )
        self._chain = self._chain_of(np.zeros(0)) if self._free == 0 else None

    def _chain_of(self, frequencies: Vector) -> SampledChain:
        known = (*self._known, *frequencies.tolist())
        return sampled_chain(self.plant, self.model.dt, self.form.extended, known)

    def _frequencies(self, values: Vector) -> tuple[float, ...]:
        """Return the frequencies of the resonators [rad/s]."""
        return (*self._known, *values[len(self.parameters) - self._free :].tolist())

    def on_circle(self, values: Matrix) -> Matrix:
        """Return the frequencies (m, k) at which C_y has poles on the unit circle [rad/s]."""
        return np.array([self._frequencies(row) for row in values]).reshape(len(values), -1)

    def _pole_parameters(self, which: str, count: int) -> list[Parameter]:
        bounds = (min(_SLOWEST * self.model.omega, 0.1 * self._fastest), self._fastest)
        if not self.form.free_poles:
            return [Parameter(f"omega_{which}", "rad/s", *bounds)]
        found = []
        for i in range(count // 2):
            found.append(Parameter(f"omega_{which}{i + 1}", "rad/s", *bounds))
            found.append(Parameter(f"damping_{which}{i + 1}", "", *self._damping[which]))
        if count % 2:
            found.append(Parameter(f"pole_{which}", "rad/s", *bounds))
        return found

    # ---- poles from the parameters

    def _columns(self) -> int:
        return 1 + (self.degree if self.form.free_poles else 1)

    def poles(self, values: Matrix) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the poles of the law (m, r) and of the observer (m, N) [rad/s]."""
        split = self._columns()
        parts = ((values[:, 1:split], self.degree), (values[:, split:], self._observed))
        law, observer = (self._roots(part, count) for part, count in parts)
        return law, observer

    def _roots(self, values: Matrix, count: int) -> NDArray[np.complex128]:
        if not self.form.free_poles:
            return np.repeat(-values[:, :1].astype(complex), count, axis=1)
        columns = []
        for i in range(count // 2):
            omega, damping = values[:, 2 * i], values[:, 2 * i + 1].astype(complex)
            root = np.sqrt(damping**2 - 1.0)
            columns += [-omega * (damping - root), -omega * (damping + root)]
        if count % 2:
            columns.append(-values[:, count - 1].astype(complex))
        return np.stack(columns, axis=1)

    def rows_of(self, b0: float, law: Any, observer: Any) -> Vector | None:
        """Return the values with these poles; None if they cannot be put into pairs."""
        row = [b0]
        for poles in (law, observer):
            factors = _factors(np.asarray(poles, dtype=complex))
            if factors is None:
                return None
            row += factors
        return np.array(row)

    def from_other(self, other: AdrcStructure, values: Vector) -> Vector | None:
        """Return the values with the poles of another form of the same order, if there are any."""
        same = (other.degree, other.order, other.form.based, other.form.extended)
        own = (self.degree, self.order, self.form.based, self.form.extended)
        if other is self or same != own or self.form.resonators or other.form.resonators:
            return None
        law, observer = (poles[0] for poles in other.poles(values[None, :]))
        if not self.form.free_poles:
            sizes = [float(np.exp(np.mean(np.log(np.abs(poles))))) for poles in (law, observer)]
            return np.array([float(values[0]), *sizes])
        if observer.size != self._observed:
            return None
        return self.rows_of(float(values[0]), law, observer)

    # ---- the structure

    def shapes(self) -> Matrix:
        """Return bandwidths in wide ranges; free poles start in one place, or in two."""
        omega, rows, where = self.model.omega, [], self._frequencies_to_start()
        b0 = self.model.b if self.degree == self.model.degree else 1.0
        ratios = (
            _OBSERVER_STARTS if self.form.extended == 1 else (_SLOW_OBSERVER, *_OBSERVER_STARTS)
        )
        for law, ratio in itertools.product(_LAW_STARTS, ratios):
            pair = (law * omega, law * ratio * omega)
            if max(pair) > 0.999 * self._fastest:
                pair = (min(pair[0], 0.9 * self._fastest), 0.99 * self._fastest)
            if not self.form.free_poles:
                rows.append(np.array([b0, *pair]))
                continue
            counts = (self.degree, self._observed)
            poles = [np.full(n, -p) for n, p in zip(counts, pair, strict=True)]
            found = self.rows_of(b0, *poles)
            if found is not None:
                rows += [np.append(found, each) for each in where]
        return np.array(rows)

    def _frequencies_to_start(self) -> list[Vector]:
        """Return free frequencies of resonators to start from: where the load has its power."""
        if self._free == 0:
            return [np.zeros(0)]
        load, count = self.model.load, self._free
        if load is None:
            return [place * self.model.omega * np.arange(1.0, count + 1) for place in _PLACES]
        share = np.cumsum(load.power) / np.sum(load.power)
        at = (np.arange(count) + 0.5) / count
        # Beside them: at a frequency of the spectrum itself C_y is infinite there.
        return [(1.0 + _BESIDE) * load.omega[np.searchsorted(share, at)]]

    def _around_resonance(self, shape: Vector) -> list[Vector]:
        """Return values with a pair of the observer's poles where the plant resonates.

        An observer leaves a resonance where it is, and damps it. Where the law moves it, too, it
        has poles there as well.
        """
        roots = np.roots(np.append(1.0, self.plant.a[::-1]))
        size = np.abs(roots)
        resonant = size[(roots.imag > 0.0) & (-roots.real < 0.5 * size) & (size < self._fastest)]
        resonant = resonant[resonant > 1e-6 * np.max(size, initial=0.0)]
        law, observer = (poles[0] for poles in self.poles(shape[None, :]))
        b0, found = float(shape[0]), []
        for omega, damping in itertools.product(resonant.tolist(), _RESONANCE_STARTS):
            seen = np.concatenate([observer[2:], _pair(omega, damping)])
            found.append(self.rows_of(b0, law, seen))
            if self.degree > 2:
                moved = np.concatenate([law[2:], _pair(omega, _MOVED)])
                found.append(self.rows_of(b0, moved, seen))
        return [row for row in found if row is not None]

    def grid(self) -> tuple[Matrix, float]:
        """Return pairs of bandwidths, the law's and the observer's, for structures with a model.

        With free poles they are those around the plant's resonances, without a spacing.
        """
        if not self.form.based:
            return np.zeros((0, len(self.parameters))), 0.0
        if self.form.free_poles:
            around = [row for shape in self.shapes() for row in self._around_resonance(shape)]
            return np.array(around).reshape(-1, len(self.parameters)), 0.0
        low = max(_FROM * self.model.omega, self.parameters[1].low)
        each = np.geomspace(min(low, 0.1 * self._fastest), _TO * self._fastest, _COUNT)
        rows = np.array([[self.model.b, *pair] for pair in itertools.product(each, each)])
        return rows, float(np.log(each[1] / each[0]))

    def beside(self, values: Vector) -> Matrix:
        """Return values beside the bandwidths of the observer at which k_i is infinite."""
        found: list[list[float]] = []
        if not self.form.based or self.form.free_poles:
            return np.zeros((0, len(self.parameters)))
        b0, law = values[:2].tolist()
        observers = np.geomspace(
            min(max(_LOWEST_OBSERVER * law, self.parameters[2].low), 0.1 * self._fastest),
            _TO * self._fastest,
            _OBSERVERS,
        )
        for omega_c in (min(factor * law, _TO * self._fastest) for factor in _LAWS):
            tried = np.column_stack([np.broadcast_to((b0, omega_c), (_OBSERVERS, 2)), observers])
            with np.errstate(divide="ignore"):
                inverse = 1.0 / self.integral_gain(tried)
            for i in np.flatnonzero(np.signbit(inverse[1:]) != np.signbit(inverse[:-1])):
                share = inverse[i] / (inverse[i] - inverse[i + 1])
                infinite = observers[i] * (observers[i + 1] / observers[i]) ** share
                beside = 1.0 + _OFF if inverse[i + 1] > 0.0 else 1.0 / (1.0 + _OFF)
                found.append([b0, omega_c, float(infinite * beside)])
        return np.array(found).reshape(-1, 3)

    def _designs(self, values: Matrix) -> _Designed:
        key = values.tobytes()
        if key != self._last[0]:  # response and integral gain are asked for in turn
            self._last, self._values = (key, self._made(values)), values.copy()
        return self._last[1]

    def _made(self, values: Matrix) -> _Designed:
        law, observer = self.poles(values)
        gains = coefficients(law) * (0.5 if self.form.half_law else 1.0)
        is_new = np.ones(len(values), dtype=bool)
        is_new[1:] = np.any(values[1:, 1:] != values[:-1, 1:], axis=1)
        how: dict[str, Any] = {"reduced": self.form.reduced, "delay": self._delay}
        how["half_gain"] = self.form.half_observer
        kept = np.flatnonzero(is_new)
        if self._chain is not None:
            found = designs(self._chain, gains, observer, kept, **how)
        else:
            found = self._with_free_frequencies(values, gains, observer, kept, how)
        return _Designed(found, np.cumsum(is_new) - 1)

    def _with_free_frequencies(
        self, values: Matrix, gains: Matrix, observer: Any, kept: NDArray[np.intp], how: Any
    ) -> Designs:
        """Return the designs of rows whose resonators differ; equal ones have one chain."""
        free = values[kept, len(self.parameters) - self._free :]
        if kept.size == 0:
            free = np.ones((1, 1)) * np.arange(1.0, self._free + 1.0)
        unique, group = np.unique(free, axis=0, return_inverse=True)
        members = [np.flatnonzero(group == i) for i in range(len(unique))]
        parts = [
            designs(self._chain_of(each), gains, observer, kept[own] if kept.size else kept, **how)
            for each, own in zip(unique, members, strict=True)
        ]
        return joined(parts, np.argsort(np.concatenate(members)[: kept.size]))

    def response(self, values: Matrix, omega: Vector) -> Complex:
        """Return C_y (m, k)."""
        found, of_row = self._designs(values)
        factor = self.model.sign * found.factor[of_row] / values[:, 0]
        return factor[:, None] * feedback(found, omega)[of_row]

    def integral_gain(self, values: Matrix) -> Vector:
        """Return k_i (m,)."""
        found, of_row = self._designs(values)
        return (found.integral_gain * found.factor)[of_row] / values[:, 0]

    def unstable_poles(self, values: Matrix) -> Vector:
        """Return how many poles of C_y are unstable (m,)."""
        found, of_row = self._designs(values)
        return unstable_poles(found)[of_row]

    def rules(self, values: Matrix) -> Matrix:
        """Return ``1 − 2 ζ ω/R + (ω/R)²`` of each pair: negative if one real pole is beyond R.

        The bounds of the parameters keep ω below R.
        """
        columns, split = [], self._columns()
        if self.form.free_poles:
            for first, count in ((1, self.degree), (split, self._observed)):
                for i in range(count // 2):
                    share = values[:, first + 2 * i] / self._fastest
                    damping = values[:, first + 2 * i + 1]
                    columns.append(1.0 - 2.0 * damping * share + share**2)
        return np.stack(columns, axis=1) if columns else np.zeros((values.shape[0], 0))

    # ---- what comes of it

    def _patterns(self, values: Vector) -> tuple[float, float, Any, Any]:
        """Return omega_c, omega_o and the patterns of poles in units of them."""
        law, observer = (poles[0] for poles in self.poles(values[None, :]))
        if not self.form.free_poles:
            return float(-law[0].real), float(-observer[0].real), None, None
        omega_c, omega_o = (float(np.exp(np.mean(np.log(np.abs(p))))) for p in (law, observer))
        return omega_c, omega_o, _pattern(law / omega_c), _pattern(observer / omega_o)

    def controller(self, values: Vector, **options: Any) -> ADRC:
        """Return the controller."""
        omega_c, omega_o, law, observer = self._patterns(values)
        b0, dt = self.model.sign * float(values[0]), self.model.dt
        form: dict[str, Any] = {
            "form": "reduced" if self.form.reduced else "current",
            "half_gain": self.form.half_observer,
            "delay": self._delay * dt,
            "poles": observer,
            "disturbance_order": self.integrators,
            "frequencies": self._frequencies(values),
        }
        if self.form.based:
            form |= {"far": math.inf}
            eso = ESO.model_based(self.model.plant, omega_o, dt, b0=b0, **form)
        else:
            eso = ESO.model_free(self.order, b0, omega_o, dt, **form)
        return ADRC(eso, omega_c, half_gain=self.form.half_law, law_poles=law, **options)

    def feedforward(self, of_model: Feedforward) -> dict[str, Any]:
        """Return the feedforward as it is."""
        return {"feedforward": of_model}

    def law(self, values: Vector) -> tuple[LinearLaw, int]:
        """Return the law without reference, in the coordinates of ``Designs``, and u's delay.

        No controller is made for it, which takes some thirty times as long::

            z⁻⁺ = Φ (I − L c) z⁻ + Φ L y + Γ u,      u = −K (I − L c) z⁻ − K L y
        """
        at = np.flatnonzero(np.all(self._values == values, axis=1))
        if at.size == 0:
            self._designs(np.vstack([values, values]))
        found, of_row = self._last[1]
        i = of_row[at[0] if at.size else 0]
        scale = self.model.sign * float(found.factor[i]) / float(values[0])
        L, K, Phi = (
            found.gain[i],
            scale * found.law[i],
            found.difference[i] + np.eye(found.law[i].size),
        )
        A, C = Phi.copy(), -K
        A[:, 0] -= Phi @ L
        C[0] += K @ L
        law = LinearLaw(
            A, np.zeros(L.size), Phi @ L, found.column[i] / scale, C, 0.0, -float(K @ L)
        )
        return law, self._delay

    def tables(self, values: Vector) -> dict[str, dict[str, Any]]:
        """Return the tables of observer and controller."""
        omega_c, omega_o, law, poles = self._patterns(values)
        b0 = self.model.sign * float(values[0])
        observer: dict[str, Any] = {"kind": "model-based" if self.form.based else "model-free"}
        if not self.form.based:
            observer["order"] = self.order
        observer |= {"b0": b0, "omega_o": omega_o}
        if self.reduced is not None:  # the plant of the file may be late, or not linear
            observer["plant"] = {"kind": "linear", **matrices(self.reduced)}
            far = without_far_zeros(self.model.plant, omega_o).zeros.size > 0
            if far and not str(self.reduced):
                observer["far"] = math.inf
        if poles is not None:
            observer["poles"] = _listed(poles)
        if self.form.reduced:
            observer["form"] = "reduced"
        if self.form.half_observer:
            observer["half_gain"] = True
        if self.integrators > 1:
            observer["disturbance_order"] = self.integrators
        if self.form.resonators:
            observer["frequencies"] = list(self._frequencies(values))
        if self._delay:
            observer["delay"] = self._delay * self.model.dt
        controller: dict[str, Any] = {"kind": "adrc", "omega_c": omega_c}
        if law is not None:
            controller["law_poles"] = _listed(law)
        if self.form.half_law:
            controller["half_gain"] = True
        return {"observer": observer, "controller": controller}


def matrices(model: Reduced) -> dict[str, Any]:
    """Return the keys of a setup file for a model: num and den, or A, B and C of a whole plant."""
    if str(model):
        num, den = (np.asarray(part).tolist() for part in model.plant)
        return {"num": num, "den": den}
    linear = LinearPlant.of(model.plant)
    parts = zip("ABC", (linear.A, linear.B, linear.C), strict=True)
    return {key: part.tolist() for key, part in parts}


def _pair(omega: float, damping: float) -> NDArray[np.complex128]:
    """Return two conjugate poles."""
    root = 1j * np.sqrt(1.0 - damping**2)
    return np.array([-omega * (damping - root), -omega * (damping + root)])


def _pattern(poles: NDArray[np.complex128]) -> tuple[Any, ...]:
    """Return poles as numbers, and pairs (real, imaginary) for two conjugate ones."""
    real = [float(p.real) for p in poles if p.imag == 0.0]
    pairs = [(float(p.real), float(p.imag)) for p in poles if p.imag > 0.0]
    return (*real, *pairs)


def _listed(pattern: tuple[Any, ...]) -> list[Any]:
    return [list(entry) if isinstance(entry, tuple) else entry for entry in pattern]


def _factors(poles: NDArray[np.complex128]) -> list[float] | None:
    """Return (ω, ζ) of pairs of poles, and the size of a single one; None for unstable ones."""
    if not np.all(poles.real < 0.0):
        return None
    tiny = 1e-9 * np.abs(poles)
    pairs = list(poles[poles.imag > tiny])
    real = sorted(-poles.real[np.abs(poles.imag) <= tiny])
    found: list[float] = []
    for p in pairs:
        found += [float(abs(p)), float(-p.real / abs(p))]
    # Of real poles the fastest ones form pairs; a single one is the slowest.
    single = [real.pop(0)] if len(real) % 2 else []
    while real:
        slow, fast = real.pop(0), real.pop(0)
        omega = float(np.sqrt(slow * fast))
        found += [omega, 0.5 * float(slow + fast) / omega]
    return found + [float(p) for p in single]


# ---- The ADRC with free poles that is equal to a PI or PID controller with a filter ----

# Damping of the law's poles that is enough; it is the least one of the structure.
_LEAST = 0.6
# Damping of the poles of a start, above the least damping of an observer.
_LEAST_OF_ALL = 0.05
# Values of b0 that are tried, over this range around the one that makes the slowest terms equal.
_GAINS = np.logspace(-4.0, 4.0, 161)


def equivalents(pid: FilteredPID, values: Vector, adrc: AdrcStructure, most: int = 3) -> Matrix:
    """Return values (k, p) of an ADRC with free poles and the same feedback, k ≤ ``most``.

    Of a PID controller that stabilises no nominal plant ``b0/s^n``, the poles that are unstable or
    hardly damped are replaced by damped ones of the same size: that is near it only. There are none
    for a structure with another order or form.
    """
    rows: list[tuple[float, Vector]] = []
    order = 2 if pid.derivative else 1
    form = adrc.form
    usable = form.free_poles and not form.based and not form.reduced and form.extended == 1
    if not usable or adrc.order != order or not pid.filtered:
        return np.zeros((0, len(adrc.parameters)))
    kp, ki, kd, f1, f2 = (float(part[0]) for part in pid.parts(values[None, :]))
    filters, numerator = ([f2, f1, 1.0], [kd, kp, ki]) if order == 2 else ([f1, 1.0], [kp, ki])
    A, B = np.array(filters) / filters[0], np.array(numerator) / filters[0]
    unit = adrc.parameters[0]
    center = np.sqrt(unit.low * unit.high)
    for b0 in center * _GAINS:
        whole = np.concatenate([A, np.zeros(order + 1)])
        whole[-order - 1 :] += b0 * B
        poles = np.roots(whole)
        damping = _damping(poles)
        split = _split(poles if damping > 0.0 else _damped(poles), order)
        row = None if split is None else adrc.rows_of(b0, *split)
        if split is not None and row is not None:
            rows.append((min(damping, _damping(split[0]) / 6.0), row))
    rows.sort(key=lambda entry: -entry[0])
    exact = [entry for entry in rows if entry[0] > 0.0] or rows[:most]
    kept = exact[:: max(len(exact) // most, 1)][:most]
    return np.array([row for _, row in kept]).reshape(-1, len(adrc.parameters))


def _damped(poles: Any) -> Any:
    """Return the poles with a damping of at least that of an observer."""
    size, least = np.abs(poles), _LEAST_OF_ALL
    few = -poles.real < least * size
    angle = np.sqrt(1.0 - least**2)
    moved = size * (-least + 1j * angle * np.sign(poles.imag))
    moved = np.where(poles.imag == 0.0, -size, moved)
    return np.where(few, moved, poles)


def _split(poles: Any, order: int) -> tuple[Any, Any] | None:
    """Return ``order`` poles for the law, conjugates together, and the others.

    The feedback does not depend on the choice. The response to the reference does: the law gets the
    slowest poles that are well damped, else the best damped ones.
    """
    found = []
    by_size = sorted(range(poles.size), key=lambda i: float(abs(poles[i])))
    for chosen in itertools.combinations(by_size, order):
        law = poles[list(chosen)]
        if abs(np.sum(law.imag)) < 1e-9 * np.max(np.abs(law)):
            found.append((law, np.delete(poles, list(chosen))))
    for law, observer in found:
        if _damping(law) >= _LEAST:
            return law, observer
    return max(found, key=lambda split: _damping(split[0]), default=None)


def _damping(poles: Any) -> float:
    return float(np.min(-poles.real / np.abs(poles)))
