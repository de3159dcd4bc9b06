"""Sampled linear controllers of two degrees of freedom, in double and in single precision.

The sampled linear law of two degrees of freedom, its checks and its state of rest.

A sampled linear law from a transfer function in s: realisation, sampling, anti-windup.

A law is not stored as polynomials in z: with fast sampling all their roots crowd at z = 1, and a
rounding error of a coefficient moves them. It is realised in continuous time, in coordinates where
entries are O(1), and sampled as a state-space system, whose matrices are of the form I + O(dt).

A linear law in delta form with compensated sums, for single precision.

An integrator adds a small share of the error to its state. In single precision that share loses
its last digits in the sum, and all of them where it is below a unit of the state's last digit: the
controller then leaves a steady error. So only the increment is calculated, and what rounding takes
from the sum is carried over to the next sample, as in ``observers/forms.py``::

    d  = (A − I) x + B_r r + B_y y + B_u u + c
    x⁺ = x + d,      c⁺ = d − (x⁺ − x)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import (
    Limits,
    RateLimit,
    apply_limits,
    checked_limits,
    control,
    control_at_rest,
    hold_integrators,
    hold_last_good,
    is_usable_control,
    largest_wish,
    reset_loop,
    set_applied_control,
    status_flags,
    write_row,
)
from quell.controllers.stateful import StatefulController
from quell.kernels.dispatch import generic, generic_with_default, kernel
from quell.kernels.sized import Scalars, Size, clear
from quell.lti.models import zero_order_hold
from quell.types import Channels, Matrix, Status, Vector

# ---- The sampled linear law of two degrees of freedom, its checks and its state of rest ----

# Singular values below this share of the largest one count as zero: they belong to integrators.
# Chosen by hand, above rounding errors.
_RANK = 1e-10


class LinearLaw(NamedTuple):
    """A sampled linear law of m states that receives the applied u.

    ::

        u_wished = C x + D_r r + D_y y          u = limited(u_wished)
        x⁺       = A x + B_r r + B_y y + B_u u

    Without limits, u is u_wished and the law is linear with A + B_u C etc. B_u prevents windup.
    """

    A: Matrix  # (m, m)
    B_r: Vector  # (m,)
    B_y: Vector  # (m,)
    B_u: Vector  # (m,)
    C: Vector  # (m,)
    D_r: float  # [u-unit/y-unit]
    D_y: float  # [u-unit/y-unit]


@generic
def advance_law(law: Any, x: Vector, work: Vector, r: float, y: float, u: float) -> None:
    """Advance the state ``x`` (m,) by a sample; ``work`` (m,) is zero before the first one."""
    raise TypeError


@advance_law.register(LinearLaw)
def _advance(law: LinearLaw, x: Vector, work: Vector, r: float, y: float, u: float) -> None:
    for i in range(x.size):
        total = law.B_r[i] * r + law.B_y[i] * y + law.B_u[i] * u
        for j in range(x.size):
            total += law.A[i, j] * x[j]
        work[i] = total
    for i in range(x.size):
        x[i] = work[i]


@generic_with_default
def correct_state(law: Any, x: Vector, work: Vector, change: float) -> None:
    """Add ``B_u change`` to the state ``x`` (m,), as a change of the applied u."""
    for i in range(x.size):
        x[i] += law.B_u[i] * change


def checked_law(law: Any) -> LinearLaw:
    """Return the law with checked, contiguous arrays that can't be written to."""
    if not isinstance(law, LinearLaw):
        raise ValueError(f"law = {law!r}: must be a quell.controllers.LinearLaw")
    A = checks.matrix("law.A", law.A)
    m = A.shape[0]
    checks.matrix("law.A", A, m, m)
    names = ("B_r", "B_y", "B_u", "C")
    B_r, B_y, B_u, C = (checks.vector(f"law.{name}", getattr(law, name), m) for name in names)
    for array in (A, B_r, B_y, B_u, C):
        array.flags.writeable = False
    D_r, D_y = checks.finite("law.D_r", law.D_r), checks.finite("law.D_y", law.D_y)
    return LinearLaw(A, B_r, B_y, B_u, C, D_r, D_y)


def rest_state(law: LinearLaw, y: float = 1.0, u: float = 0.0) -> Vector:
    """Return the state (m,) of a law at rest at r = y, with ``u`` or as close as possible.

    Of all states with ``x = (A + B_u C) x + (B_r + B_y + B_u (D_r + D_y)) y`` it is the one whose
    control signal is closest to u: an integrator balances the rest of the law. Without such a
    state, it is the least-squares solution.
    """
    if law.C.size == 0:
        return np.zeros(0)
    D = law.D_r + law.D_y
    difference = np.eye(law.C.size) - law.A - np.outer(law.B_u, law.C)
    x = np.linalg.pinv(difference, rcond=_RANK) @ ((law.B_r + law.B_y + law.B_u * D) * y)
    _, singular, rows = np.linalg.svd(difference)
    free = rows[singular <= _RANK * np.max(singular)]
    output = free @ law.C
    if output @ output > 0.0:
        x = x - free.T @ output * ((law.C @ x + D * y - u) / (output @ output))
    return np.ascontiguousarray(x)


def held_integrator(law: LinearLaw) -> tuple[int, Vector]:
    """Return the number of modes of a law that do not decay, and the share of r and y in one (2,).

    With the left eigenvector w of ``A + B_u C`` at one, scaled to ``w B_u = 1``, w x is what the
    integrator holds, and a sample adds ``w (B_r + B_u D_r) r + w (B_y + B_u D_y) y`` to it. With
    several modes, or one that B_u does not reach, the share is zero and the number at least two.
    """
    nothing = np.zeros(2)
    values, vectors = np.linalg.eig((law.A + np.outer(law.B_u, law.C)).T)
    marginal = np.flatnonzero(np.abs(values) > 1.0 - _MARGINAL)
    if marginal.size != 1:
        return marginal.size, nothing
    w = np.real(vectors[:, marginal[0]])
    reach = float(w @ law.B_u)
    if abs(values[marginal[0]] - 1.0) > _RANK or abs(reach) <= _RANK * np.linalg.norm(law.B_u):
        return 2, nothing
    w = w / reach
    return 1, np.array([w @ law.B_r + law.D_r, w @ law.B_y + law.D_y])


# ---- A sampled linear law from a transfer function in s ----

METHODS = ("tustin", "zoh")
# Poles this close to the unit circle, or outside of it, count as integrators: they do not decay
# while u is at a limit. Chosen by hand, above the rounding error of a pole at 1.
_MARGINAL = 1e-9
# Poles and zeros below the one and above the other of these multiples of the fastest pole count as
# zero and as infinite, which rounding turns into such values. Chosen by hand.
_ZERO, _INFINITE = 1e-6, 1e6

System = tuple[Matrix, Matrix, Matrix, Matrix]


def as_state_space(num: Any, den: Any = None) -> System:
    """Return (A, B, C, D) of a transfer function, in balanced coordinates.

    Raises ``ValueError`` for several inputs or outputs, a system that is not proper, or one with a
    sample time.

    Parameters
    ----------
    num, den
        polynomials in s, highest power first; or a ``control.TransferFunction`` or
        ``control.StateSpace`` in continuous time.
    """
    if den is not None:
        return realised([num], den)
    if getattr(num, "dt", None):
        raise ValueError(f"transfer function has a sample time, dt = {num.dt!r}: must have none")
    if hasattr(num, "num") and hasattr(num, "den"):
        shape = np.shape(num.num)[:2]
        if shape != (1, 1):
            raise ValueError(f"transfer function has {shape} outputs and inputs: must have (1, 1)")
        return realised([num.num[0][0]], num.den[0][0])
    if all(hasattr(num, name) for name in "ABCD"):
        A = checks.matrix("A", num.A)
        m = A.shape[0]
        shapes = {"A": (m, m), "B": (m, 1), "C": (1, m), "D": (1, 1)}
        system = (checks.matrix(name, getattr(num, name), *shape) for name, shape in shapes.items())
        return balanced(*system)
    kinds = "a polynomial, with den, or a control.TransferFunction or control.StateSpace"
    raise ValueError(f"num = {num!r}: must be {kinds}")


def realised(numerators: list[Any], den: Any) -> System:
    """Return (A, B, C, D) of one output ``Σ N_i(s)/D(s) · input_i``, in balanced coordinates.

    It is the observer canonical form, in time scaled by the geometric mean of the poles other than
    zero. Several inputs need no more states than D has roots.
    """
    D = np.trim_zeros(checks.vector("den", den), "f")
    if D.size == 0:
        raise ValueError(f"den = {den!r}: must not be zero")
    m = D.size - 1
    N = np.zeros((len(numerators), m + 1))
    for row, given in zip(N, numerators, strict=True):
        polynomial = np.trim_zeros(checks.vector("num", given), "f")
        if polynomial.size > m + 1:
            raise ValueError(
                f"num = {np.asarray(given).tolist()!r}: is of degree {polynomial.size - 1}, den of "
                f"degree {m}: C(s) must be proper; add a filter"
            )
        row[m + 1 - polynomial.size :] = polynomial
    last = np.flatnonzero(D)[-1]  # the coefficients after it stand for poles at zero
    unit = abs(D[last] / D[0]) ** (1.0 / last) if last else 1.0
    powers = unit ** -np.arange(m + 1.0) / D[0]
    D, N = D * powers, N * powers
    through = N[:, :1]
    A = np.diag(np.ones(m - 1), 1) if m else np.zeros((0, 0))
    if m:
        A[:, 0] = -D[1:]
    B = (N[:, 1:] - through * D[1:]).T
    C = np.eye(1, m)
    # Back from scaled time: s = unit · scaled s.
    return balanced(unit * A, unit * B, C, through.T.copy())


def balanced(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> System:
    """Scale the states so that rows and columns of A are of similar size, and B and C too."""
    from scipy.linalg import matrix_balance

    if A.shape[0] == 0:
        return A, B, C, D
    A, (scale, _) = matrix_balance(A, permute=False, separate=True)
    B, C = B / scale[:, None], C * scale
    input_size, output_size = float(np.max(np.abs(B))), float(np.max(np.abs(C)))
    factor = math.sqrt(output_size / input_size) if input_size > 0.0 and output_size > 0.0 else 1.0
    return A, B * factor, C / factor, D


def tustin(system: System, dt: float, prewarp: float | None = None) -> System:
    """Sample by the trapezoidal rule ``s = (z − 1) / (h (z + 1))``.

    With h = dt/2, or tan(ω dt/2)/ω for prewarping at ω < π/dt, which is exact there:
    ``A_d = (I − hA)⁻¹ (I + hA)``, ``B_d = 2h (I − hA)⁻¹ B``, ``C_d = C (I − hA)⁻¹``,
    ``D_d = D + h C (I − hA)⁻¹ B`` (Franklin, Powell & Workman, *Digital Control of Dynamic
    Systems*, 1998, section 6.1).
    """
    h = 0.5 * dt
    if prewarp is not None:
        if checks.positive("prewarp", prewarp, "rad/s") * dt >= math.pi:
            rule = f"must be below pi/dt = {math.pi / dt:.3g} rad/s"
            raise ValueError(f"prewarp = {prewarp!r} rad/s with dt = {dt!r} s: {rule}")
        h = math.tan(0.5 * prewarp * dt) / prewarp
    A, B, C, D = system
    one = np.eye(A.shape[0])
    inverse = np.asarray(np.linalg.inv(one - h * A), dtype=np.float64)
    B_d, C_d = 2.0 * h * inverse @ B, C @ inverse
    return inverse @ (one + h * A), B_d, C_d, D + 0.5 * C @ B_d


def sampled_law(
    system: System,
    dt: float,
    *,
    method: str = "tustin",
    prewarp: float | None = None,
    tracking_time: float | None = None,
) -> LinearLaw:
    """Return the law of a continuous-time system from (r, y) to u; see ``LinearController``."""
    if checks.one_of("method", method, METHODS) == "tustin":
        A, B, C, D = tustin(system, dt, prewarp)
    else:
        if prewarp is not None:
            raise ValueError(f"prewarp = {prewarp!r}: goes with method = 'tustin' only")
        (B, C, D), (A, [B]) = system[1:], zero_order_hold(system[0], [system[1]], dt)
    time = checks.optional(checks.positive, "tracking_time", tracking_time, "s")
    B_u = anti_windup(A, C[0], math.exp(-dt / (time or _default_tracking_time(system))))
    D_r, D_y = D[0]
    B_r, B_y = B[:, 0] - B_u * D_r, B[:, 1] - B_u * D_y
    return LinearLaw(A - np.outer(B_u, C[0]), B_r, B_y, B_u, C[0], D_r, D_y)


def anti_windup(A: Matrix, C: Vector, pole: float) -> Vector:
    """Return the gain B_u (m,) of ``x⁺ = A x + … + B_u (u − u_wished)``, for anti-windup.

    The law is treated as an observer of its own state with the applied u as measurement (Åström &
    Wittenmark, *Computer-Controlled Systems*, 1997, section 3.5; Kothare, Campo, Morari & Nett,
    *Automatica* 30, 1994). Poles on the unit circle or outside of it, which do not decay, are moved
    to ``pole``; the others stay. For a PID controller this is back-calculation: the integrator
    alone follows, with the tracking time ``−dt / ln(pole)``.
    """
    from scipy.linalg import schur

    if A.shape[0] == 0:
        return np.zeros(0)

    def is_marginal(re: float, im: float = 0.0) -> bool:
        return abs(complex(re, im)) > 1.0 - _MARGINAL

    block, basis, count = schur(A, output="real", sort=is_marginal)
    # The pole placement needs an observable pair; an unobservable block does not reach u and stays.
    inner, output = block[:count, :count], C @ basis[:, :count]
    rows, power, moved = np.empty((count, count)), np.eye(count), np.eye(count)
    for i in range(count):
        rows[i] = output @ power
        power, moved = power @ (inner - np.eye(count)), moved @ (inner - pole * np.eye(count))
    if count == 0 or np.linalg.matrix_rank(rows) < count:
        return np.zeros(A.shape[0])
    gain = moved @ np.linalg.solve(rows, np.eye(count)[-1])
    return np.ascontiguousarray(basis[:, :count] @ gain)


def _default_tracking_time(system: System) -> float:
    """Return the time constant of the slowest zero from y, else pole, other than zero [s]."""
    from scipy.linalg import eigvals

    A, B, C, D = system
    if A.shape[0] == 0:
        return 1.0
    poles = np.linalg.eigvals(A)
    pencil = np.block([[A, B[:, 1:]], [C, D[:, 1:]]])
    zeros = eigvals(pencil, np.diag([*np.ones(A.shape[0]), 0.0]))
    fastest = float(np.max(np.abs(poles)))
    lowest, highest = (_ZERO * fastest, _INFINITE * fastest) if fastest > 0.0 else (0.0, math.inf)
    for candidates in (zeros, poles):
        sizes = np.abs(candidates[np.isfinite(candidates)])
        sizes = sizes[(sizes > lowest) & (sizes < highest)]
        if sizes.size:
            return float(1.0 / np.min(sizes))
    return 1.0


# ---- The controller of a sampled linear law of two degrees of freedom ----

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_OVERFLOWED = int(Status.OVERFLOWED)
# An integrator gives a control signal to rounding; other laws miss it by far more. Chosen by hand.
_NEAR = 1e-6


class LinearDesign(NamedTuple):
    """Parameters of the controller."""

    law: Any  # a LinearLaw or DeltaLaw
    start: Vector  # initial state for y = 1 (m,), see ``rest_state``
    limits: Limits
    integrators: Size  # modes that do not decay
    integrated: Vector  # what a sample adds to the only one for r = 1 and y = 1 (2,)


class LinearLoop(Scalars):
    """Scalars of the control loop, kept from one sample to the next."""

    u: float  # applied control signal
    u_unlimited: float  # control signal of the law before limits
    r: float  # last finite reference
    y: float  # last finite measurement
    started: float  # 1 after the first finite measurement, else 0
    has_reference: float  # 1 after the first finite reference, else 0
    status: float  # status flags of the last sample


class LinearState(NamedTuple):
    """State of the controller."""

    x: Vector  # state of the law (m,)
    next: Vector  # memory for the next state, or carries of a law in delta form (m,)
    loop: NDArray[LinearLoop]  # (1,)


@kernel
def _set_rest(design: LinearDesign, state: LinearState, y: float) -> None:
    """Set the state of the law to rest at ``y``."""
    for i in range(state.x.size):
        state.x[i] = design.start[i] * y
        state.next[i] = 0.0


@kernel
def _unlimited_control(design: LinearDesign, state: LinearState) -> float:
    unlimited = design.law.D_r * state.loop[0].r + design.law.D_y * state.loop[0].y
    for i in range(state.x.size):
        unlimited += design.law.C[i] * state.x[i]
    return unlimited


@control.register(LinearDesign)
def _control(design: LinearDesign, state: LinearState, r: float, y: float) -> float:
    loop = state.loop[0]
    status = hold_last_good(loop, r, y)
    if loop.started == 0.0:
        if status & _MEASUREMENT_HELD != 0:
            loop.u = loop.u_unlimited = control_at_rest(design.limits)
            loop.status = status
            return loop.u
        _set_rest(design, state, loop.y)
        loop.started = 1.0
    unlimited = _unlimited_control(design, state)
    if not is_usable_control(design.limits, unlimited):
        status |= _OVERFLOWED
        _set_rest(design, state, loop.y)
        unlimited = loop.u
    elif abs(unlimited) > largest_wish(design.limits):
        status |= _OVERFLOWED
        _set_rest(design, state, loop.y)
        unlimited = _unlimited_control(design, state)
    u, cut = apply_limits(design.limits, unlimited, loop.u)
    advance_law(design.law, state.x, state.next, loop.r, loop.y, u)
    loop.u = u
    loop.u_unlimited = unlimited
    loop.status = status | cut
    return u


@write_row.register(LinearDesign)
def _write_row(design: LinearDesign, state: LinearState, row: Vector) -> None:
    row[0] = state.loop[0].u_unlimited
    row[1] = state.loop[0].status


@status_flags.register(LinearDesign)
def _status_flags(design: LinearDesign, state: LinearState) -> int:
    return int(state.loop[0].status)


@reset_loop.register(LinearDesign)
def _reset_loop(design: LinearDesign, state: LinearState) -> None:
    clear(state.loop)


@set_applied_control.register(LinearDesign)
def _set_applied_control(design: LinearDesign, state: LinearState, u: float) -> None:
    # The state was updated with the u that ``control`` returned.
    correction = u - state.loop[0].u
    for i in range(state.x.size):
        state.x[i] += design.law.B_u[i] * correction
    state.loop[0].u = u


@hold_integrators.register(LinearDesign)
def _hold_integrators(design: LinearDesign, state: LinearState, u_before: float) -> None:
    loop = state.loop[0]
    if design.integrators == 1:
        added = design.integrated[0] * loop.r + design.integrated[1] * loop.y
        correct_state(design.law, state.x, state.next, loop.u_unlimited - loop.u - added)
    elif design.integrators > 1:
        set_applied_control(design, state, u_before)


class LinearController(StatefulController):
    """A sampled linear law of two degrees of freedom, with limits.

    It starts from rest: the initial state is that of a loop at rest at r = y = y_0 with u = 0,
    where y_0 is the first finite measurement. So u starts without a bump if the law has such a
    state, as every law with integral action has. Otherwise the state is constant and u follows from
    it.

    The applied control signal, after limits, drives the law through ``B_u``, which
    ``from_transfer_function`` chooses. Values that are not finite are replaced by the last finite
    ones, and u waits for a first finite measurement, as in ``ADRC``.

    Parameters
    ----------
    law
        the law, sampled with ``dt``.
    dt
        sample time [s].
    u_min, u_max
        limits of the control signal [u-unit].
    rate_limit
        largest rate of the control signal, in both directions, or (lowest, highest) [u-unit/s].
    name
        label in tables and plots.

    Raises
    ------
    ValueError
        for matrices of unsuitable shape or with entries that are not finite, limits in the wrong
        order, or a rate limit or sample time that is not positive.

    Examples
    --------
    >>> num, den = [2.0, 1.0], [1.0, 0.0]  # 2 + 1/s
    >>> controller = LinearController.from_transfer_function(num, den, dt=0.1, u_max=1.5)
    >>> controller.step(r=1.0, y=0.0)
    1.5
    >>> controller.status
    <Status.SATURATED: 4>
    """

    features: tuple[str, ...] = ()
    channels: Channels = (("u_wished", 1), ("status", 1))

    def __init__(
        self,
        law: LinearLaw,
        dt: float,
        *,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: RateLimit = math.inf,
        name: str = "linear controller",
    ) -> None:
        self.law = checked_law(law)
        self.dt = checks.positive("dt", dt, "s")
        self.name = name
        self._limits = checked_limits(u_min, u_max, rate_limit, self.dt)
        self._initialise()

    @classmethod
    def from_transfer_function(
        cls,
        num: Any,
        den: Any = None,
        dt: float | None = None,
        *,
        feedback: str = "error",
        method: str = "tustin",
        prewarp: float | None = None,
        tracking_time: float | None = None,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: RateLimit = math.inf,
        name: str = "transfer function",
    ) -> LinearController:
        """Return the controller ``u = C (r − y)`` or ``u = −C y`` for a transfer function C(s).

        C is sampled in scaled, balanced coordinates of its state, not as polynomials in z: their
        roots are close to 1, where coefficients determine them badly. Raises ``ValueError`` for a
        C(s) that is not proper or has several inputs or outputs.

        Parameters
        ----------
        num, den
            polynomials in s, highest power first; or ``num`` is a ``control.TransferFunction`` or
            ``control.StateSpace`` in continuous time, without ``den``.
        dt
            sample time [s].
        feedback
            ``"error"``: C acts on r − y; ``"output"``: C acts on −y.
        method
            ``"tustin"``: ``s = 2 (z − 1) / (dt (z + 1))``; or ``"zoh"``: r and y are constant
            between samples, which delays by half a sample.
        prewarp
            frequency [rad/s] at which the response with Tustin's method is exactly that of C(s).
        tracking_time
            time constant with which integrators follow u at its limits [s]; see
            ``quell.controllers.linear.anti_windup``. By default that of C's slowest zero
            other than s = 0, or of its slowest pole if it has no such zero.
        u_min, u_max, rate_limit, name
            as for the class.
        """
        dt = checks.positive("dt", dt, "s")
        on_error = checks.one_of("feedback", feedback, ("error", "output")) == "error"
        A, B, C, D = as_state_space(num, den)
        from_r = 1.0 if on_error else 0.0
        system = (A, np.hstack([from_r * B, -B]), C, np.hstack([from_r * D, -D]))
        law = sampled_law(system, dt, method=method, prewarp=prewarp, tracking_time=tracking_time)
        return LinearController(law, dt, u_min=u_min, u_max=u_max, rate_limit=rate_limit, name=name)

    def _update_parameters(self) -> None:
        rest, limits = rest_state(self.law), self._limits
        self.parameters = LinearDesign(self.law, rest, limits, *held_integrator(self.law))

    def initial_state(self) -> LinearState:
        """Return a state before the first sample."""
        size = self.law.C.size
        return LinearState(np.zeros(size), np.zeros(size), LinearLoop.zeros())

    def start(self, y: float, u: float = 0.0, r: float | None = None) -> None:
        """Start at a plant that rests at ``y`` under ``u``: the next ``step`` continues from ``u``.

        Parameters
        ----------
        y
            measurement [y-unit].
        u
            control signal that holds the plant there [u-unit]; should be within the limits.
        r
            reference of the next step [y-unit]; ``y`` by default.

        Raises
        ------
        ValueError
            for a law without integral action, whose u follows from r and y, and for numbers that
            are not finite.
        """
        y, u = checks.signal("y", y), checks.signal("u", u)
        goal = y if r is None else checks.signal("r", r)
        wanted = u - self.law.D_r * (goal - y)  # what the law would give at r = y
        x = rest_state(self.law, y, wanted)
        given = float(self.law.C @ x) + (self.law.D_r + self.law.D_y) * y
        if abs(given - wanted) > _NEAR * (abs(given) + abs(wanted)):
            rule = "the law has no integral action, its u follows from r and y; leave start out"
            raise ValueError(f"u = {u!r} at y = {y!r}: {rule}")
        self.reset()
        self._state.x[:] = x
        loop = self._state.loop[0]
        loop.u, loop.u_unlimited, loop.r, loop.y = u, u, goal, y
        loop.started = loop.has_reference = 1.0

    @property
    def status(self) -> Status:
        """Status flags of the last step."""
        return Status(int(self._state.loop[0].status))


# ---- A linear law in delta form with compensated sums, for single precision ----


class DeltaLaw(NamedTuple):
    """A ``LinearLaw`` with m states and m carries."""

    difference: Matrix  # A − I (m, m)
    B_r: Vector  # (m,)
    B_y: Vector  # (m,)
    B_u: Vector  # (m,)
    C: Vector  # (m,)
    D_r: float  # [u-unit/y-unit]
    D_y: float  # [u-unit/y-unit]


@advance_law.register(DeltaLaw)
def _advance_delta(law: DeltaLaw, x: Vector, work: Vector, r: float, y: float, u: float) -> None:
    for i in range(x.size):
        total = law.B_r[i] * r + law.B_y[i] * y + law.B_u[i] * u + work[i]
        for j in range(x.size):
            total += law.difference[i, j] * x[j]
        work[i] = total
    for i in range(x.size):
        before, increment = x[i], work[i]
        x[i] = before + increment
        work[i] = increment - (x[i] - before)


@correct_state.register(DeltaLaw)
def _correct_delta(law: DeltaLaw, x: Vector, work: Vector, change: float) -> None:
    for i in range(x.size):
        before, increment = x[i], work[i] + law.B_u[i] * change
        x[i] = before + increment
        work[i] = increment - (x[i] - before)


def delta_law(law: LinearLaw) -> DeltaLaw:
    """Return a law in delta form."""
    return DeltaLaw(law.A - np.eye(law.C.size), *law[1:])
