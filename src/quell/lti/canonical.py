"""From a model of any kind to the observable canonical form that an ESO is built on.

    S = [C; C A; …; C A^(n−1)]        z = S x,    z' = Ā z + B̄ u + Ē f,    y = z_1

with ``Ā = S A S⁻¹`` a companion matrix (last row −a), and ``B̄ = S B``, ``Ē = S E`` the Markov parameters ``C A^(i−1) B`` and
``C A^(i−1) E`` (paper, eq. (transform), which has the case where both are zero but for their last entries). What u and f feed through on
the way is not in z, so nothing has to be differentiated:

    z_i = y^(i−1) − Σ_{j<i} (B̄_j u^(i−1−j) + Ē_j f^(i−1−j))

The first entry of B̄ that is not zero is the r-th, r being the relative degree from u to y: ``y^(r) = z_{r+1} + B̄_r u + Ē_r f``, or
``−a·z + …`` for r = n. The n − r zeros from u are the eigenvalues of what is left of the plant while u holds y at zero: of the last n − r
rows and columns of ``Ā − B̄ e_{r+1}ᵀ/B̄_r``. The same with Ē gives the zeros from f.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell.lti.models import ZERO_TOLERANCE, StateSpace, TransferFunction, read_model
from quell.types import Matrix, Vector

# A state that y shows less than this is not put into larger units: it is not seen.
_NOT_SEEN = 1e-8
# Of coefficients, to the power of the fastest pole that they have as unit.
_ROUNDING = 1e-13
# Below this ratio of singular values the balanced observability matrix counts as rank deficient.
_RANK_TOLERANCE = 1e-10
# A zero this much slower than the plant's fastest pole or zero counts as one at s = 0.
_AT_REST = 1e-9


class Canonical(NamedTuple):
    """A plant in observable canonical form, ``z = S x``; without zeros it is ``y^(n) = −a_0 y − … − a_{n−1} y^(n−1) + b u + f``."""

    a: Vector
    """(n,) [1/s^(n−i)]."""
    b: float
    """Gain from u to y^(degree) [y-unit / u-unit / s^degree]."""
    S: Matrix
    """(n, n): from the user's states to z; the identity for a plant given without states."""
    B: Vector
    """S B (n,): zero before entry ``degree``, which is b."""
    E: Vector
    """S E / f_gain (n,): zero before entry ``f_degree``, which is 1."""
    degree: int
    """Relative degree r from u to y."""
    f_degree: int
    """Relative degree from f to y; f is measured in y-unit/s^f_degree."""
    f_gain: float
    """f is this times the disturbance that enters through E (through B, in units of u, where there is no E)."""
    zeros: Vector
    """The n − degree zeros from u to y [rad/s], complex."""
    condition: float
    """Largest over smallest singular value of S with rows of length 1: from 1e10 on the plant counts as unobservable."""

    @property
    def matched(self) -> bool:
        """Whether f enters as u does."""
        return self.f_degree == self.degree

    @property
    def unstable_zeros(self) -> Vector:
        """Those of the zeros that are not in the left half plane, or damped by less than a millionth."""
        return self.zeros[self.zeros.real >= -1e-6 * np.abs(self.zeros)]


def canonical(plant: Any, E: Any = None) -> Canonical:
    """Bring a plant with one input and one output to observable canonical form, and check what an ESO needs of it.

    Parameters
    ----------
    plant
        one of

        * a plant with ``A`` (n, n), ``B`` (n, 1), ``C`` (1, n): ``LinearPlant``, ``control.StateSpace``; D must be zero,
        * matrices ``(A, B, C)``, or ``(A, B, E, C)`` as in the paper's eq. (1); B, E and C may be vectors,
        * ``control.TransferFunction``, or the pair ``(numerator, denominator)`` of sequences in descending powers of s,
        * the pair ``(a, b)`` with a number b: ``y^(n) = −a_0 y − … − a_{n−1} y^(n−1) + b u``.
    E
        where the disturbance enters: a column (n,) or (n, 1), or the index of one of the plant's own disturbance inputs. By default it
        enters where u does.

    Returns
    -------
    Canonical

    Raises
    ------
    ValueError
        each with its own message: the plant is not observable from y (assumption 1 of the paper), u or the disturbance does not reach y,
        a disturbance with a channel of its own has invariant zeros to y (assumption 3), a transfer function is improper or biproper, the
        model is of discrete time, shapes do not fit.

    Examples
    --------
    >>> found = canonical(([1.0, 3.0], [1.0, 0.4, 1.0]))
    >>> found.degree, found.zeros.real.round(6).tolist(), found.B.round(6).tolist()
    (1, [-3.0], [1.0, 2.6])
    """
    model = read_model(plant, E)
    return (
        _from_transfer_function(model)
        if isinstance(model, TransferFunction)
        else _from_state_space(model)
    )


def _from_transfer_function(model: TransferFunction) -> Canonical:
    """Divide the numerator by the denominator: the quotient's powers of 1/s are the Markov parameters."""
    n = model.a.size
    B = np.empty(n)
    for k in range(n):
        B[k] = model.c[n - 1 - k] - sum(model.a[n - j] * B[k - j] for j in range(1, k + 1))
    return _assemble(model.a, B, None, np.eye(n), 1.0)


def _from_state_space(model: StateSpace) -> Canonical:
    A, n = model.A, model.B.size
    # In states of such units that rows and columns of A are of one size: whether y shows them must not depend on the user's units.
    A, units = _balanced(A)
    S = np.empty((n, n))
    S[0] = model.C * units
    for i in range(1, n):
        S[i] = S[i - 1] @ A
    # Rows of one size, whatever the unit of time; and columns, for states that nothing ties to the others.
    rows = np.maximum(np.linalg.norm(S, axis=1), np.finfo(float).tiny)
    columns = np.maximum(np.linalg.norm(S / rows[:, None], axis=0), np.finfo(float).tiny)
    balanced = S / rows[:, None] / np.where(columns > _NOT_SEEN, columns, 1.0)
    singular = np.linalg.svd(balanced, compute_uv=False)
    if not singular[-1] > _RANK_TOLERANCE * singular[0]:
        rank = int(np.sum(singular > _RANK_TOLERANCE * singular[0]))
        raise ValueError(
            f"plant is not observable from y: its observability matrix has rank {rank}, not {n} "
            f"(smallest over largest singular value {singular[-1] / max(singular[0], 1e-300):.1e}); "
            "measure another output or reduce the model"
        )
    # Row n of the companion matrix: C A^n = −a S. What is no more than its rounding is zero.
    condition = float(singular[0] / singular[-1])
    a = -np.linalg.solve((S / rows[:, None]).T, S[-1] @ A) / rows
    fastest = float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))
    a[np.abs(a) <= _ROUNDING * condition * fastest ** (n - np.arange(n))] = 0.0
    S = S / units
    return _assemble(
        a, _markov(S, model.B), None if model.E is None else _markov(S, model.E), S, condition
    )


def _balanced(A: Matrix) -> tuple[Matrix, Vector]:
    """Return A in balanced states (Parlett & Reinsch, *Numer. Math.* 13, 1969), and what one unit of each is in the user's."""
    from scipy.linalg import matrix_balance

    balanced, (scale, _) = matrix_balance(A, permute=False, separate=True)
    return balanced, scale


def _markov(S: Matrix, column: Vector) -> Vector:
    """Return ``S column``, without what is only the rounding of sums that cancel."""
    markov = S @ column
    markov[np.abs(markov) <= ZERO_TOLERANCE * (np.abs(S) @ np.abs(column))] = 0.0
    return markov


def _assemble(a: Vector, B: Vector, E: Vector | None, S: Matrix, condition: float) -> Canonical:
    n = a.size
    if not np.any(B):
        raise ValueError(
            f"b = 0: u does not reach y through any of the {n} states (B or the output is wrong)"
        )
    degree = int(np.flatnonzero(B)[0]) + 1
    b = float(B[degree - 1])
    # The same channel, up to a factor.
    E = B if E is None or _parallel(E, B) else E
    if not np.any(E):
        raise ValueError(
            f"E: the disturbance does not reach y through any of the {n} states; it can be neither estimated nor does it matter"
        )
    f_degree = int(np.flatnonzero(E)[0]) + 1
    if E is not B and f_degree < n:
        raise ValueError(
            f"E: the disturbance has invariant zeros to y (assumption 3), {format_roots(_zeros(a, E))} rad/s, its relative degree is {f_degree} "
            f"and not {n}; leave E out (f then enters where u does), or measure another output"
        )
    return Canonical(
        a,
        b,
        S,
        B,
        E / E[f_degree - 1],
        degree,
        f_degree,
        float(E[f_degree - 1]),
        _zeros(a, B),
        condition,
    )


def _parallel(one: Vector, other: Vector) -> bool:
    at = np.flatnonzero(other)[0]
    return bool(
        one[at] != 0.0
        and np.allclose(one, other * (one[at] / other[at]), rtol=ZERO_TOLERANCE, atol=0.0)
    )


def _zeros(a: Vector, column: Vector) -> Vector:
    """Return the zeros from an input with the Markov parameters ``column`` (module docstring)."""
    n = a.size
    r = int(np.flatnonzero(column)[0]) + 1
    companion = np.diag(np.ones(n - 1), 1)
    companion[-1] = -a
    if r == n:
        return np.zeros(0, dtype=complex)
    rest = companion[r:, r:].copy()
    rest[:, 0] -= column[r:] / column[r - 1]
    zeros = np.linalg.eigvals(rest).astype(complex)
    fastest = max(np.max(np.abs(zeros)), np.max(np.abs(np.linalg.eigvals(companion))))
    zeros[np.abs(zeros) <= _AT_REST * fastest] = 0.0
    return zeros[np.argsort(zeros.real, kind="stable")]


def format_roots(zeros: Vector) -> str:
    """Return zeros as text, conjugate pairs as one."""
    told = []
    for z in zeros[zeros.imag >= 0.0].tolist():
        real = f"{z.real:.4g}" if abs(z.real) > 1e-9 * abs(z) or z == 0.0 else ""
        told.append(real + (f"±{z.imag:.4g}j" if z.imag > 0.0 else ""))
    return ", ".join(told)
