"""The observable canonical form of a linear model, on which an ESO is built.

    S = [C; C A; …; C A^(n−1)]        z = S x,    z' = Ā z + B̄ u + Ē f,    y = z_1

``Ā = S A S⁻¹`` is a companion matrix (last row −a). ``B̄ = S B`` and ``Ē = S E`` are the Markov
parameters ``C A^(i−1) B`` and ``C A^(i−1) E`` (paper, eq. (transform), for the case in which only
their last entries are nonzero). z excludes the feedthrough of u and f, so nothing has to be
differentiated:

    z_i = y^(i−1) − Σ_{j<i} (B̄_j u^(i−1−j) + Ē_j f^(i−1−j))

The first nonzero entry of B̄ is the r-th, where r is the relative degree from u to y:
``y^(r) = z_{r+1} + B̄_r u + Ē_r f``, or ``−a·z + …`` for r = n. The n − r zeros from u are the
eigenvalues of the dynamics that remain while u holds y at zero: of the last n − r rows and columns
of ``Ā − B̄ e_{r+1}ᵀ/B̄_r``. The same with Ē gives the zeros from f.

Models of reduced order for a design: the poles and zeros up to a frequency.

A loop sees nothing of a zero or of a mode that is far beyond its bandwidth, but a design that
inverts it, or an observer that has its states, does. A factor ``1 − s/p`` or ``1 − s/z`` with a
large p or z is nearly 1 at the frequencies below: the reduced model leaves it out, so that the gain
at low frequencies is that of the plant::

    P_r(s) = b Π(s − z_kept) Π(−z_dropped) / (Π(s − p_kept) Π(−p_dropped))

(truncation of modes: Skogestad & Postlethwaite, *Multivariable Feedback Control*, 2nd ed. 2005,
section 11.2, with the gain at low frequencies of residualisation). What is left out belongs to the
total disturbance; margins have to be those of the whole plant.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.checks import text
from quell.lti.models import ZERO_TOLERANCE, StateSpace, TransferFunction, read_model
from quell.types import Matrix, Vector

# The thresholds below separate rounding errors from properties of the model. They were chosen by
# hand between the unit roundoff of 1e-16 and 1, and not tuned further.

# A state that y shows less than this is not scaled up: it counts as unobservable.
_UNOBSERVABLE = 1e-8
# Coefficients below this, in units of powers of the fastest pole and times the condition, are zero.
_ROUNDING = 1e-13
# Below this ratio of singular values the balanced observability matrix counts as rank deficient.
_RANK_TOLERANCE = 1e-10
# A zero slower than this share of the plant's fastest pole or zero counts as one at s = 0.
_AT_REST = 1e-9
# Zeros with less relative damping than this count as not in the left half plane.
_LEAST_DAMPING = 1e-6


class Canonical(NamedTuple):
    """A plant in observable canonical form, ``z = S x``.

    Without zeros it is ``y^(n) = −a_0 y − … − a_{n−1} y^(n−1) + b u + f``.
    """

    a: Vector  #: (n,) [1/s^(n−i)]
    b: float  #: gain from u to y^(degree) [y-unit / u-unit / s^degree]
    S: Matrix  #: (n, n), from the user's states to z; the identity for a plant given without states
    B: Vector  #: S B (n,): zero before entry ``degree``, which is b
    E: Vector  #: S E / f_gain (n,): zero before entry ``f_degree``, which is 1
    degree: int  #: relative degree r from u to y
    f_degree: int  #: relative degree from f to y; f is measured in y-unit/s^f_degree
    f_gain: float  #: f over the disturbance that enters through E (without E: through B, as u)
    zeros: Vector  #: the n − degree zeros from u to y [rad/s], complex
    condition: float  #: condition number of S with rows of length 1; unobservable from 1e10 on

    def __repr__(self) -> str:
        return text(self)

    @property
    def matched(self) -> bool:
        """Whether f enters as u does."""
        return self.f_degree == self.degree

    @property
    def unstable_zeros(self) -> Vector:
        """The zeros that are not in the left half plane, or have a damping of less than 1e-6."""
        return self.zeros[self.zeros.real >= -_LEAST_DAMPING * np.abs(self.zeros)]


def canonical(plant: Any, E: Any = None) -> Canonical:
    """Return a plant with one input and output in observable canonical form, checked for an ESO.

    Parameters
    ----------
    plant
        a linear model of any kind that ``LinearPlant.of`` accepts.
    E
        input of the disturbance: a column (n,) or (n, 1), or the index of one of the plant's own
        disturbance inputs. By default it enters where u does.

    Raises
    ------
    ValueError
        if the plant is not observable from y (assumption 1 of the paper), u or the disturbance does
        not reach y, a disturbance with an input of its own has invariant zeros to y (assumption 3),
        or the transfer function is improper or biproper.

    Examples
    --------
    >>> found = canonical(([1.0, 3.0], [1.0, 0.4, 1.0]))
    >>> found.degree, found.zeros.real.round(6).tolist(), found.B.round(6).tolist()
    (1, [-3.0], [1.0, 2.6])
    """
    model = read_model(plant, E)
    if isinstance(model, TransferFunction):
        return _from_transfer_function(model)
    return _from_state_space(model)


def _from_transfer_function(model: TransferFunction) -> Canonical:
    """Divide the numerator by the denominator: the powers of 1/s have the Markov parameters."""
    n = model.a.size
    B = np.empty(n)
    for k in range(n):
        B[k] = model.c[n - 1 - k] - sum(model.a[n - j] * B[k - j] for j in range(1, k + 1))
    return _assemble(model.a, B, None, np.eye(n), 1.0)


def _from_state_space(model: StateSpace) -> Canonical:
    from scipy.linalg import matrix_balance

    # Balanced states (Parlett & Reinsch, Numer. Math. 13, 1969): whether y shows a state must not
    # depend on the user's units.
    n = model.B.size
    A, (units, _) = matrix_balance(model.A, permute=False, separate=True)
    S = np.empty((n, n))
    S[0] = model.C * units
    for i in range(1, n):
        S[i] = S[i - 1] @ A
    # Scale rows, for the unit of time, and columns, for states that are coupled to no others.
    rows = np.maximum(np.linalg.norm(S, axis=1), np.finfo(float).tiny)
    columns = np.maximum(np.linalg.norm(S / rows[:, None], axis=0), np.finfo(float).tiny)
    balanced = S / rows[:, None] / np.where(columns > _UNOBSERVABLE, columns, 1.0)
    singular = np.linalg.svd(balanced, compute_uv=False)
    if not singular[-1] > _RANK_TOLERANCE * singular[0]:
        rank = int(np.sum(singular > _RANK_TOLERANCE * singular[0]))
        ratio = singular[-1] / max(singular[0], 1e-300)
        raise ValueError(
            f"plant is not observable from y: its observability matrix has rank {rank}, not {n} "
            f"(smallest over largest singular value {ratio:.1e}); "
            "measure another output or reduce the model"
        )
    # Row n of the companion matrix, C A^n = −a S. Entries of the size of their rounding are zero.
    condition = float(singular[0] / singular[-1])
    a = -np.linalg.solve((S / rows[:, None]).T, S[-1] @ A) / rows
    fastest = float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))
    a[np.abs(a) <= _ROUNDING * condition * fastest ** (n - np.arange(n))] = 0.0
    S = S / units
    E = None if model.E is None else _markov(S, model.E)
    return _assemble(a, _markov(S, model.B), E, S, condition)


def _markov(S: Matrix, column: Vector) -> Vector:
    """Return ``S column``, with entries of the size of their rounding set to zero."""
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
    E = B if E is None or _parallel(E, B) else E
    if not np.any(E):
        raise ValueError(
            f"E: the disturbance does not reach y through any of the {n} states: leave E out"
        )
    f_degree = int(np.flatnonzero(E)[0]) + 1
    if E is not B and f_degree < n:
        raise ValueError(
            f"E: the disturbance has invariant zeros to y (assumption 3), "
            f"{format_roots(_zeros(a, E))} rad/s, its relative degree is {f_degree} and not {n}; "
            "leave E out (f then enters where u does), or measure another output"
        )
    b, f_gain = float(B[degree - 1]), float(E[f_degree - 1])
    zeros = _zeros(a, B)
    return Canonical(a, b, S, B, E / f_gain, degree, f_degree, f_gain, zeros, condition)


def _parallel(one: Vector, other: Vector) -> bool:
    """Return whether two vectors are equal up to a factor."""
    at = np.flatnonzero(other)[0]
    multiple = other * (one[at] / other[at])
    return bool(one[at] != 0.0 and np.allclose(one, multiple, rtol=ZERO_TOLERANCE, atol=0.0))


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


def format_roots(roots: Vector) -> str:
    """Return poles or zeros as text, conjugate pairs as one."""
    texts = []
    for root in roots[roots.imag >= 0.0].tolist():
        real = f"{root.real:.4g}" if abs(root.real) > 1e-9 * abs(root) or root == 0.0 else ""
        texts.append(real + (f"±{root.imag:.4g}j" if root.imag > 0.0 else ""))
    return ", ".join(texts)


# A zero is beyond all poles if it is so many times as large as the fastest.
_BEYOND = 3.0
# Two sizes of poles or zeros closer than this factor are not divided by a cut.
_GAP = 1.15
# A pair of poles with less damping is a resonance.
_RESONANT = 0.5


class Reduced(NamedTuple):
    """A model for a design, and what of the plant is not in it."""

    plant: Any  #: the transfer function (num, den); the plant as given, if nothing is left out
    zeros: Vector  #: zeros that are left out [rad/s]
    poles: Vector  #: poles that are left out [rad/s]

    @property
    def order(self) -> int:
        """Number of poles of the model."""
        return canonical(self.plant).a.size

    def __str__(self) -> str:
        """Return what is left out as text; empty if nothing is."""
        parts = []
        for name, roots in (("zero", self.zeros), ("pole", self.poles)):
            if roots.size:
                many = "s" if roots.size > 1 else ""
                parts.append(f"{name}{many} at {format_roots(roots)} rad/s")
        return " and ".join(parts)


def reduced_model(plant: Any, below: float) -> Reduced:
    """Return the model with the poles and zeros of a plant up to a frequency.

    Parameters
    ----------
    plant
        a linear model of any kind that ``LinearPlant.of`` accepts.
    below
        largest size of the poles and zeros that are kept [rad/s]; infinite keeps all.

    Returns
    -------
    Reduced
        ``plant``, a transfer function (numerator, denominator) for ``ESO.model_based`` and others,
        and the ``zeros`` and ``poles`` that are left out.

    Raises
    ------
    ValueError
        if no pole, or not more poles than zeros, would be left, or unstable poles would be left
        out.

    Examples
    --------
    >>> found = reduced_model(([1.0, 500.0], [1.0, 2.0, 0.0]), below=100.0)
    >>> [part.round(6).tolist() for part in found.plant], str(found)
    ([[500.0], [1.0, 2.0, 0.0]], 'zero at -500 rad/s')
    """
    if np.isnan(below) or below <= 0.0:
        checks.positive("below", below, "rad/s")
    return _reduced(plant, canonical(plant), float(below))


def without_far_zeros(plant: Any, beyond: float) -> Reduced:
    """Return the model without zeros that are far beyond all poles and beyond a frequency [rad/s].

    Zeros from 3 times the fastest pole on are far.
    """
    whole = canonical(plant)
    limit = max(beyond, _BEYOND * float(np.max(np.abs(_poles(whole)), initial=0.0)))
    return _reduced(plant, whole, limit)


def design_models(plant: Any) -> tuple[Reduced, ...]:
    """Return models for designs, the plant itself first, then those of reduced order.

    They are without zeros far beyond all poles, and without the fastest resonances and what is
    beyond them, down to one resonance. Models whose own zeros are not stable are left out, but the
    plant itself.
    """
    whole = canonical(plant)
    none = np.zeros(0)
    found = [Reduced(plant, none, none)]
    poles = _poles(whole)
    far = _BEYOND * float(np.max(np.abs(poles), initial=0.0))
    sizes = np.abs(np.concatenate([poles, whole.zeros]))
    sizes = np.unique(sizes[sizes > 0.0])[::-1]
    resonant = np.sort(
        np.abs(poles[(poles.imag > 0.0) & (-poles.real < _RESONANT * np.abs(poles))])
    )
    for upper, lower in itertools.pairwise(sizes):
        if upper < _GAP * lower or (resonant.size and lower < (1.0 - 1e-9) * resonant[0]):
            continue
        cut = float(np.sqrt(upper * lower))
        if lower > far:  # far zeros are left out together
            continue
        drops_zeros = upper > far
        drops_resonance = resonant.size > 1 and cut < resonant[-1]
        if not (drops_zeros or drops_resonance):
            continue
        try:
            one = _reduced(plant, whole, cut)
        except ValueError:
            continue
        if not canonical(one.plant).unstable_zeros.size:
            found.append(one)
    return tuple(found)


def _poles(whole: Canonical) -> Vector:
    """Return the poles; integrators, which the form has exactly, are exactly zero."""
    integrators = int(np.argmax(np.append(whole.a != 0.0, True)))
    rest = np.roots(np.append(1.0, whole.a[integrators:][::-1]))
    return np.concatenate([np.zeros(integrators), rest]).astype(complex)


def _reduced(plant: Any, whole: Canonical, limit: float) -> Reduced:
    poles = _poles(whole)
    is_fast, is_far = np.abs(poles) > limit, np.abs(whole.zeros) > limit
    dropped, zeros = poles[is_fast], whole.zeros[is_far]
    if not dropped.size and not zeros.size:
        return Reduced(plant, zeros, dropped)
    left = int(np.sum(~is_fast)), int(np.sum(~is_far))
    if left[0] <= left[1]:
        rule = f"leaves {left[0]} poles and {left[1]} zeros: must leave more poles than zeros"
        raise ValueError(f"below = {limit:.4g} rad/s: {rule}")
    if np.any(dropped.real > 0.0):
        rule = f"leaves out the unstable poles {format_roots(dropped[dropped.real > 0.0])} rad/s"
        raise ValueError(f"below = {limit:.4g} rad/s: {rule}; choose a larger one")
    gain = whole.b * float(np.real(np.prod(-zeros) / np.prod(-dropped)))
    num = gain * np.real(np.poly(whole.zeros[~is_far]))
    return Reduced((np.atleast_1d(num), np.real(np.poly(poles[~is_fast]))), zeros, dropped)
