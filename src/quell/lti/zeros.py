"""Invariant zeros and unobservable modes of systems with several inputs and outputs.

The Rosenbrock pencil of ``x' = A x + B u``, ``y = C x + D u`` (or ``x⁺ = …``) is::

    P(s) = [A − s I, B; C, D]

It has its *normal rank* ``n + r`` at almost every s, where r is the rank of the transfer matrix.
The *invariant zeros* are the s at which its rank is lower. Where ``r`` is the number of inputs, a
zero z has a state x_0 and an input u_0 with ``P(z) [x_0; u_0] = 0``: from x_0, the input ``u_0
e^(zt)`` leaves y at zero. Without inputs the zeros are the *unobservable modes* of (A, C).

**Existence of an observer for x and unknown inputs w** (Chen, Gao & Lin, arXiv 2510.01007; for one
output *GMB-ESO*): (A, C) is observable, and the system from w to y has no invariant zeros, with
``r`` equal to the number of disturbances. If one of them fails, there is a motion of x and w that y
does not show, and no observer of any kind can find it.

**Computation.** The pencil is scaled first, by powers of two: states, inputs, outputs and the unit
of time are chosen so that the logarithms of the nonzero entries have the least sum of squares.
Results do not depend on the units that way. Then the part without finite zeros is split off by
orthogonal transformations, first in the outputs and then in the inputs (Emami-Naeini & Van Dooren,
*Automatica* 18, 1982, as in SLICOT's AB08ND). The zeros are generalised eigenvalues of what is
left, a square pencil. It works for any numbers of inputs and outputs, and if P never has full rank.

Each step decides a rank by singular values. ``kept`` and ``dropped`` have the smallest one that
counted and the largest one that did not, as shares of the scaled pencil's norm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.lti.canonical import format_roots
from quell.types import Matrix, Vector

Complex = NDArray[np.complex128]

# Singular values below this share of the scaled pencil's norm count as zero. Chosen by hand between
# the rounding errors of a dozen states (1e-14) and models that are nearly singular.
RANK_TOLERANCE = 1e-10
# A rank is in doubt if a singular value lies within this factor of the tolerance.
_DOUBT = 100.0
# Scaled entries below this share of the largest one are not used to find the scales: they are
# rounding errors, or do not matter. Chosen by hand.
_NEGLIGIBLE = 1e-11
# Rounds in which entries are left out; three were enough in all trials.
_ROUNDS = 5
# A component counts among those that move most if it is not below this share of the largest.
_MOSTLY = 0.3
# A zero at an unobservable mode, within this share of the fastest zero, is not named twice.
_SAME = 1e-4


# ---- Invariant zeros ----


@dataclass(frozen=True)
class InvariantZeros:
    """The invariant zeros of a system, and how its ranks were decided."""

    values: Complex
    """The zeros (k,), by real part; in the unit of A, rad/s for a model in continuous time."""
    states: Complex
    """States x_0 (k, n), each a unit vector in scaled coordinates; (0, n) if r < inputs."""
    inputs: Complex
    """Inputs u_0 (k, m) that belong to them."""
    prominent: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
    """For each zero the indices of the states and of the inputs that move most, scaled."""
    rank: int
    """r, the rank of the transfer matrix at almost every frequency."""
    inputs_count: int
    """Number of inputs m."""
    residual: Vector
    """Smallest singular value (k,) of the scaled P at each zero that has to vanish, relative."""
    kept: float
    """Smallest singular value that counted in a decision on a rank, relative; 1 if none."""
    dropped: float
    """Largest singular value that counted as zero, relative; 0 if none."""

    @property
    def full_rank(self) -> bool:
        """Whether r is the number of inputs: no input is hidden by another one."""
        return self.rank == self.inputs_count

    @property
    def doubt(self) -> str | None:
        """A line that begins with NOT if a rank is close to another decision; None otherwise."""
        limit = RANK_TOLERANCE
        if self.kept < _DOUBT * limit:
            near = f"a relative singular value of {self.kept:.1e} counts as nonzero"
        elif self.dropped > limit / _DOUBT:
            near = f"a relative singular value of {self.dropped:.1e} counts as zero"
        else:
            return None
        return (
            f"NOT certain: {near}, with a tolerance of {limit:.0e}; the model is close to one with "
            "other zeros: check its small coefficients"
        )


def invariant_zeros(A: Any, B: Any, C: Any, D: Any = None) -> InvariantZeros:
    """Return the invariant zeros of ``x' = A x + B u``, ``y = C x + D u``.

    Parameters
    ----------
    A
        dynamics (n, n), in continuous or discrete time.
    B
        chosen inputs (n, m), or one of them (n,); for zeros from disturbances, their input E.
    C
        chosen outputs (p, n), or one of them (n,).
    D
        direct feedthrough (p, m); zero by default.

    Raises
    ------
    ValueError
        for matrices that do not fit.

    Examples
    --------
    The force on the second of two masses, seen at the first one, has no zeros; the force on the
    first one has those of the second mass alone on its spring.

    >>> A = [[0, 1, 0, 0], [-1, 0, 1, 0], [0, 0, 0, 1], [1, 0, -1, 0]]
    >>> invariant_zeros(A, [0, 0, 0, 1], [1, 0, 0, 0]).values.size
    0
    >>> invariant_zeros(A, [0, 1, 0, 0], [1, 0, 0, 0]).values.round(9).imag.tolist()
    [-1.0, 1.0]
    """
    A, B, C, D = fitting_matrices(A, B, C, D)
    return _zeros(A, B, C, D)


def unobservable_modes(A: Any, C: Any) -> InvariantZeros:
    """Return the modes of ``x' = A x`` that the outputs ``y = C x`` do not show.

    Their eigenvalues are ``values``, their motions ``states``. (A, C) is observable if there are
    none. Arguments and errors as for ``invariant_zeros``.

    Examples
    --------
    The speed of a mass does not show its position, a mode at zero.

    >>> unobservable_modes([[0, 1], [0, 0]], [0, 1]).values.tolist()
    [0j]
    """
    A, C = _dynamics_and_rows(A, C)
    return _zeros(A, np.zeros((A.shape[0], 0)), C, np.zeros((C.shape[0], 0)))


def fitting_matrices(
    A: Any, B: Any, C: Any, D: Any = None, inputs: str = "B", what: str = "inputs"
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return A (n, n), B (n, m), C (p, n) and D (p, m), checked; vectors are one column or row.

    ``inputs`` and ``what`` name the second matrix and its columns in errors.
    """
    A, C = _dynamics_and_rows(A, C)
    n, p = A.shape[0], C.shape[0]
    B = checks.matrix(inputs, np.reshape(B, (-1, 1)) if np.ndim(B) == 1 else B)
    if B.shape[0] != n:
        raise ValueError(
            f"{inputs} has shape {B.shape} and A has shape {A.shape}: {inputs} must have a row for "
            f"each of the {n} states of A, and a column for each of the {what}"
        )
    m = B.shape[1]
    D = np.zeros((p, m)) if D is None else checks.matrix("D", np.atleast_2d(D))
    if D.shape != (p, m):
        raise ValueError(
            f"D has shape {D.shape}: must be ({p}, {m}), a row for each of the {p} outputs of C, "
            f"which has shape {C.shape}, and a column for each of the {m} {what} of {inputs}, "
            f"which has shape {B.shape}"
        )
    return A, B, C, D


def _dynamics_and_rows(A: Any, C: Any) -> tuple[Matrix, Matrix]:
    A = checks.matrix("A", A)
    n = A.shape[0]
    if A.shape[1] != n or n == 0:
        raise ValueError(
            f"A has shape {A.shape}: must be square, a row and a column for each state"
        )
    C = checks.matrix("C", np.reshape(C, (1, -1)) if np.ndim(C) == 1 else C)
    if C.shape[1] != n:
        raise ValueError(
            f"C has shape {C.shape} and A has shape {A.shape}: C must have a row for each output, "
            f"and a column for each of the {n} states of A"
        )
    return A, C


def _zeros(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> InvariantZeros:
    (n, m), p = B.shape, C.shape[0]
    state, inputs, output, rate = (
        np.exp2(np.round(np.log2(scale))) for scale in pencil_scales(A, B, C, D)
    )
    rows, columns = np.append(rate / state, output), np.append(state, inputs)
    pencil = np.block([[A, B], [C, D]]) * rows[:, None] * columns
    norm = float(np.linalg.norm(pencil, 2))
    ranks = _Ranks(RANK_TOLERANCE, norm)
    parts = pencil[:n, :n], pencil[:n, n:], pencil[n:, :n], pencil[n:, n:]
    left = _without_infinite(*parts, ranks)
    left = _without_infinite(left[0].T, left[2].T, left[1].T, left[3].T, ranks)
    A_l, C_l, B_l, D_l = (part.T for part in left)
    rank = D_l.shape[0]
    found = _finite_zeros(A_l, B_l, C_l, D_l)

    def at(s: complex) -> Complex:
        """Return the scaled P(s), with s in scaled units of time."""
        shift = np.zeros((n + p, n + m))
        shift[:n, :n] = np.eye(n)
        return pencil - s * shift

    def smallest(s: complex) -> float:
        values = np.linalg.svd(at(s), compute_uv=False)
        return float(values[n + rank - 1]) / norm

    if smallest(0.0) <= RANK_TOLERANCE:
        found = _with_exact_origin(found)
    scaled: Complex = np.zeros((0, n + m), dtype=complex)
    if rank == m and found.size:
        scaled = np.array([_null_vector(at(s)) for s in found])
    return InvariantZeros(
        values=found / rate,
        states=scaled[:, :n] * state,
        inputs=scaled[:, n:] * inputs,
        prominent=tuple((_largest(v[:n]), _largest(v[n:])) for v in scaled),
        rank=rank,
        inputs_count=m,
        residual=np.array([smallest(s) for s in found]),
        kept=ranks.kept,
        dropped=ranks.dropped,
    )


class _Ranks:
    """Decides ranks, and keeps the singular values closest to the tolerance."""

    def __init__(self, tolerance: float, norm: float) -> None:
        self._limit, self._norm = tolerance * norm, norm
        self.kept, self.dropped = 1.0, 0.0

    def __call__(self, values: Vector) -> int:
        """Return the number of ``values``, singular values in descending order, that count."""
        rank = int(np.count_nonzero(values > self._limit))
        if rank:
            self.kept = min(self.kept, float(values[rank - 1]) / self._norm)
        if rank < values.size:
            self.dropped = max(self.dropped, float(values[rank]) / self._norm)
        return rank


def _without_infinite(
    A: Matrix, B: Matrix, C: Matrix, D: Matrix, ranks: _Ranks
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return a system with the same finite zeros whose D has full row rank.

    Outputs that D does not reach have to stay at zero: the states that they show are zero, and the
    derivatives of these become outputs.
    """
    while True:
        n, p = A.shape[0], D.shape[0]
        left, values, _ = np.linalg.svd(D)
        rank = ranks(values)
        rows, D = left.T @ C, left.T @ D
        reached, C_0 = rows[:rank], rows[rank:]
        if rank == p:
            return A, B, reached, D
        _, values, right = np.linalg.svd(C_0)
        shown = ranks(values) if n else 0
        if shown == 0:
            return A, B, reached, D[:rank]
        # The last ``shown`` coordinates are those that the outputs show.
        V = np.vstack([right[shown:], right[:shown]]).T
        A, B, rest = V.T @ A @ V, V.T @ B, n - shown
        reached = reached @ V
        C = np.vstack([reached[:, :rest], A[rest:, :rest]])
        D = np.vstack([D[:rank], B[rest:]])
        A, B = A[:rest, :rest], B[:rest]


def _finite_zeros(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> Complex:
    """Return the zeros of a system with an invertible D (r, r), by real part."""
    from scipy.linalg import eigvals, qr

    n = A.shape[0]
    if n == 0:
        return np.zeros(0, dtype=complex)
    Q, _ = qr(np.hstack([C, D]).T)
    free = Q[:, D.shape[0] :]  # the states and inputs that keep y at zero
    found = eigvals(np.hstack([A, B]) @ free, free[:n]).astype(complex)
    order: NDArray[np.intp] = np.lexsort([found.imag, found.real])
    return found[order]


def _with_exact_origin(found: Complex) -> Complex:
    """Return zeros (scaled) with those at the origin exact; k of them stray by the k-th root."""
    found, size = found.copy(), np.abs(found)
    order = np.argsort(size, kind="stable")
    for k in range(found.size, 0, -1):
        if size[order[k - 1]] <= RANK_TOLERANCE ** (1.0 / k):
            found[order[:k]] = 0.0
            break
    return found


def _null_vector(P: Complex) -> Complex:
    """Return the right singular vector of the smallest singular value, its largest entry real."""
    vector: Complex = np.linalg.svd(P)[2][-1].conj()
    largest = vector[np.argmax(np.abs(vector))]
    return vector * (abs(largest) / largest)


def _largest(vector: Complex) -> tuple[int, ...]:
    """Return the indices of the largest entries, the largest first."""
    size = np.abs(vector)
    if size.size == 0 or np.max(size) < np.sqrt(RANK_TOLERANCE):
        return ()
    order = np.argsort(-size, kind="stable")
    return tuple(int(i) for i in order if size[i] >= _MOSTLY * size[order[0]])


def pencil_scales(
    A: Matrix, B: Matrix, C: Matrix, D: Matrix
) -> tuple[Vector, Vector, Vector, float]:
    """Return scales of states (n,), inputs (m,) and outputs (p,), and of A.

    With ``x = t x̃`` and so on, the entry ij of the pencil is multiplied by ``r_i c_j``, with ``r_i
    = rate/t_i`` or that of the output, and ``c_j = t_j`` or that of the input. The logarithms of
    the products have the least sum of squares; entries that turn out to be negligible are left out
    and the scales found again.
    """
    (n, m), p = B.shape, C.shape[0]
    size = np.abs(np.block([[A, B], [C, D]]))
    row, column = np.nonzero(size)
    log = np.log2(size[row, column])
    unknowns = n + m + p + 1
    factors = np.zeros((row.size, unknowns))
    at = np.arange(row.size)
    is_state = row < n
    factors[at[is_state], row[is_state]] -= 1.0
    factors[at[is_state], -1] += 1.0
    factors[at[~is_state], m + row[~is_state]] += 1.0
    factors[at, column] += 1.0
    used = np.ones(row.size, dtype=bool)
    found = np.zeros(unknowns)
    for _ in range(_ROUNDS):
        found = np.linalg.lstsq(factors[used], -log[used], rcond=1e-9)[0]
        left = log + factors @ found
        now = left >= np.max(left, initial=-np.inf) + np.log2(_NEGLIGIBLE)
        if np.array_equal(now, used):
            break
        used = now
    scale = np.exp2(found)
    return scale[:n], scale[n : n + m], scale[n + m : -1], float(scale[-1])


# ---- Existence of an observer for states and disturbances ----


@dataclass(frozen=True)
class Existence:
    """Whether an observer of a plant's states and disturbances exists; see ``observer_exists``."""

    unobservable: InvariantZeros
    """The unobservable modes of (A, C)."""
    zeros: InvariantZeros
    """The invariant zeros from the disturbances to the outputs."""
    outputs: int
    """Number of outputs p."""

    def __bool__(self) -> bool:
        return self.exists

    @property
    def exists(self) -> bool:
        """Whether states and disturbances can be found from y, whatever the disturbances are."""
        return self.observable and self.zeros.full_rank and self.zeros.values.size == 0

    @property
    def observable(self) -> bool:
        """Whether y shows all modes of x."""
        return self.unobservable.values.size == 0

    @cached_property
    def finds_polynomials(self) -> bool:
        """Whether constants, and ramps and so on, can be found, with an observer of any speed.

        This is the observability of a continuous-time model with ``w^(m) = 0`` added to it: (A, C)
        is observable, r is the number of disturbances, and no zero is at s = 0. Zeros elsewhere
        are disturbances that such an observer does not find.
        """
        return self.observable and self.zeros.full_rank and not np.any(self.zeros.values == 0.0)

    def __str__(self) -> str:
        lines = [*self._failures(), *self._doubts()]
        if self.exists:
            lines.insert(0, "an observer of x and w exists: y shows all modes, and has no zeros")
        elif self.finds_polynomials:
            lines.append("constant disturbances can still be found: no zero is at 0")
        return "\n".join(lines)

    def _failures(self) -> list[str]:
        found = []
        modes, zeros = self.unobservable, self.zeros
        for which in _one_of_each_pair(modes.values):
            moving = _names("x", modes.prominent[which][0])
            found.append(
                f"(A, C) is not observable: the mode at {_text(modes.values[which])}, a motion of "
                f"{moving}, does not show in y; measure another output, or leave the mode out"
            )
        q = zeros.inputs_count
        if not zeros.full_rank:
            why = f"has the rank {zeros.rank} at every frequency, for {q} disturbances"
            few = self.outputs < q
            found.append(
                f"the disturbances cannot be told apart: from w to y the system {why}"
                + (f" and {_count(self.outputs, 'output')}" if few else "")
                + f"; keep {_count(zeros.rank, 'column')} of E, or measure another output"
            )
        near = _SAME * np.max(np.abs(zeros.values), initial=0.0)
        for which in _one_of_each_pair(zeros.values):
            if np.any(np.abs(modes.values - zeros.values[which]) <= near):
                continue  # an unobservable mode is a zero, too
            found.append(
                f"an invariant zero from w to y at {_text(zeros.values[which])}: "
                f"{_motion(zeros, which)}; measure another output, or change E"
            )
        return found

    def _doubts(self) -> list[str]:
        return list(dict.fromkeys(d for d in (self.unobservable.doubt, self.zeros.doubt) if d))


def observer_exists(A: Any, E: Any, C: Any) -> Existence:
    """Test whether the states of ``x' = A x + E w``, ``y = C x`` and the unknown w follow from y.

    Inputs u that are known do not matter. The result is true if so, and its text names each
    unobservable mode and each invariant zero that prevents it.

    Parameters
    ----------
    A
        dynamics (n, n).
    E
        inputs of the q disturbances (n, q), or one (n,).
    C
        outputs (p, n), or one (n,).

    Raises
    ------
    ValueError
        for matrices that do not fit.

    Examples
    --------
    A motor (1) drives a load (2) through a spring. At the motor's encoder a torque on the load can
    be told; a torque on the motor cannot, if it has the frequency of the load on the spring.

    >>> A = [[0, 1, 0, 0], [-1, 0, 1, 0], [0, 0, 0, 1], [1, 0, -1, 0]]
    >>> print(observer_exists(A, [0, 0, 0, 1], [1, 0, 0, 0]))
    an observer of x and w exists: y shows all modes, and has no zeros
    >>> print(observer_exists(A, [0, 1, 0, 0], [1, 0, 0, 0]))
    an invariant zero from w to y at ±1j: w1 moves as e^(st) with x3 and x4, and y \
stays at zero; measure another output, or change E
    constant disturbances can still be found: no zero is at 0
    """
    A, E, C, _ = fitting_matrices(A, E, C, None, "E", "disturbances")
    return Existence(unobservable_modes(A, C), invariant_zeros(A, E, C), C.shape[0])


def _motion(zeros: InvariantZeros, which: int) -> str:
    if not zeros.full_rank:
        return "there the rank drops further"
    states, inputs = zeros.prominent[which]
    moving = _names("x", states)
    if not inputs:
        return f"{moving} move as e^(st) without w, and y stays at zero"
    wave = "is constant" if zeros.values[which] == 0.0 else "moves as e^(st)"
    return f"{_names('w', inputs)} {wave} with {moving}, and y stays at zero"


def _one_of_each_pair(values: Complex) -> list[int]:
    """Return the indices of the values without those in the lower half plane."""
    return [int(i) for i in np.flatnonzero(values.imag >= 0.0)]


def _text(value: complex) -> str:
    return format_roots(np.array([value]))


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _names(letter: str, indices: Sequence[int]) -> str:
    names = [f"{letter}{i + 1}" for i in sorted(indices)]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
