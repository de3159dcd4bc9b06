"""A sampled linear law from a transfer function in s: realisation, sampling, anti-windup.

A law is not stored as polynomials in z: with fast sampling all their roots crowd at z = 1, and a
rounding error of a coefficient moves them. It is realised in continuous time, in coordinates where
entries are O(1), and sampled as a state-space system, whose matrices are of the form I + O(dt).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.linear.law import LinearLaw
from quell.lti.discretize import zero_order_hold
from quell.types import Matrix, Vector

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
