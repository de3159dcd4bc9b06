"""Design of the linear extended state observer: exact sampling and pole placement.

Extended model (paper eqs. (eq_2) and (eq.leso)), states ``z = (x̂_1 … x̂_n, Δf̂)``::

    x_i' = x_{i+1},    x_n' = −a·x + b0 u + f_L + Δf,    Δf' = 0

For a plant with zeros, the observable canonical form ``z' = Ā z + B̄ u + Ē (f_L + Δf)`` of
``lti/canonical.py`` replaces the first two. It is sampled exactly with zero-order hold.

A *generalised* observer has m extended states, ``z = (x̂_1 … x̂_n, Δf̂, Δf̂', …)``, and its model of
f is a polynomial of degree m − 1 (Miklosovic, Radke & Gao, ACC 2006; Godbole, Kolhe & Talole,
*IEEE Trans. Control Systems Technology* 21, 2013)::

    (Δf^(j))' = Δf^(j+1)   for j = 0 … m − 2,        (Δf^(m−1))' = 0

With all N = n + m poles at −omega_o and a chain of integrators ``l_i = C(N, i) omega_o^i``, and ::

    f̂/f = Σ_{i=n+1}^{N} C(N, i) omega_o^i s^(N−i) / (s + omega_o)^N,
    1 − f̂/f = s^m Σ_{i=0}^{n} C(N, i) omega_o^i s^(n−i) / (s + omega_o)^N

so f̂ follows a polynomial of degree m − 1 without error, with m = 1 a constant. Sampled, f is such a
polynomial from sample to sample and held in between, as u is: ``f⁺ = f + dt f' + dt²/2 f''``, and
only f itself moves x. So a held u cancels it exactly, and the feedback has m poles at z = 1: the
error of y goes to zero for every load that is a polynomial of degree m − 1, whatever the plant and
the sample time. If f moved x within the sample as a ramp, the law ``u = (u_0 − f̂)/b0`` would leave
an error of ``f' dt/(2 k_1)``, and the feedback would have one pole there. A known delay τ of u
leaves ``f' τ/k_1``, because the law cancels the f of now.

All eigenvalues of ``(I − L C) Φ`` lie at ``exp(−omega_o dt)`` (the bandwidth parametrisation of
Gao, ACC 2003, in the z-plane as in Miklosovic, Radke & Gao, ACC 2006), or at ``exp(p_i omega_o
dt)`` with a pattern of poles p of its own. The *reduced* form is the
current form with one pole at z = 0: ``L_1 = 1`` and ``x̂_1 = y``; the other n poles are those of
the reduced-order observer, at ``exp(−omega_o dt)``.

With *half gain* the correction is L/2: nearly the same loop for half the gain from noise (Herbst,
Hempel, Göhrt & Streif, IFAC World Congress 2020, arXiv 2003.03986; Herbst & Madonski, arXiv
2211.07309).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.lti.canonical import Canonical, format_roots
from quell.lti.discretize import zero_order_hold
from quell.lti.pole_pattern import pole_pattern
from quell.observers.linear import EsoModel
from quell.observers.placement import place_poles, sampled_zeros
from quell.types import Matrix, Vector

FORMS = ("current", "predictor", "reduced")
# In the coordinates of the design useful gains are at most O(1); far above, rounding decides where
# the poles are. Chosen by hand; not tuned further.
_LARGEST_GAIN = 1e6


def checked_disturbance_order(value: Any) -> int:
    """Return the number m of extended states; raise a ``ValueError`` if it is not 1, 2 or 3."""
    return checks.whole("disturbance_order", value, 1, 3)


def design_model(
    plant: Canonical,
    b0: float,
    omega_o: float,
    dt: float,
    *,
    form: str,
    half_gain: bool,
    keep_zeros: bool,
    poles: Any = None,
    disturbance_order: int = 1,
) -> EsoModel:
    """Return the update of the observer of ``plant`` with the bandwidth ``omega_o``.

    ``poles`` are those of the observer in units of omega_o, all at −1 by default; the reduced form
    has one less than the others. ``disturbance_order`` is the number m of extended states.
    """
    checks.one_of("form", form, FORMS)
    pattern = None
    if poles is not None:
        if keep_zeros:
            raise ValueError(
                "poles with keep_zeros = True: they exclude each other; put poles at the zeros"
            )
        count = plant.a.size + disturbance_order - (form == "reduced")
        pattern = pole_pattern("poles", poles, count)
    if checks.flag("half_gain", half_gain) and form == "reduced":
        raise ValueError(
            "half_gain = True with form = 'reduced': they exclude each other; use form='current'"
        )
    kept = np.zeros(0)
    if keep_zeros and plant.matched:
        kept = plant.zeros[(plant.zeros.real > -omega_o) & (plant.zeros.real < 0.0)]
    model = _sampled_design(plant, b0, omega_o, dt, form, kept, pattern, disturbance_order)
    return model._replace(gain=0.5 * model.gain) if half_gain else model


def _sampled_design(
    plant: Canonical,
    b0: float,
    omega_o: float,
    dt: float,
    form: str,
    kept: Vector,
    pattern: NDArray[np.complex128] | None,
    m: int,
) -> EsoModel:
    """Sample the extended model and place the poles; ``kept`` are plant zeros that keep a pole.

    The model is sampled in the coordinates ``x_i dt^(i−1)`` and ``f^(j) dt^(q+j)``, where all
    entries are O(1). The poles are placed in the coordinates ``x_i/omega_o^(i−1)``,
    ``f^(j)/omega_o^(q+j)``. There Φ is close to I, but ``Φ − I`` has full precision because it is
    computed as ``∫ e^(A t) A dt``.
    """
    n, q = plant.a.size, plant.f_degree
    size = n + m
    power = np.append(np.arange(n), q + np.arange(m))
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        A = np.diag(np.ones(n), 1)
        A[-2, :-1] -= plant.a * dt ** (n - np.arange(n))
        A[:-1, -1] = plant.E * dt ** (np.arange(n) + 1.0 - q)
        inputs = np.zeros((n + 1, 2))
        inputs[:-1, 0] = plant.B / plant.b * dt ** (np.arange(n) + 1.0 - plant.degree)
        inputs[:, 1] = A[:, -1]
        phi, (difference, gammas) = zero_order_hold(A, [A, inputs], 1.0)
        phi = with_motion_of_f(phi, m, 1.0)
        difference, gammas = with_motion_of_f(difference, m), with_rates(gammas, m)
        step = omega_o * dt
        gain = np.full(size, np.nan)
        if np.all(np.isfinite(phi)):
            difference *= step ** (power[None, :] - power[:, None])
            offsets = np.full(size, -math.expm1(-step), dtype=complex)
            offsets[: kept.size] = sampled_zeros(difference[: n + 1, : n + 1], kept, dt)
            if pattern is not None:
                offsets[: pattern.size] = -np.expm1(step * pattern)
            if form == "reduced":
                offsets[-1] = 1.0
            gain = place_poles(difference, offsets) * step**power
            if form == "reduced" and np.isfinite(gain[0]):
                gain[0] = 1.0  # exactly; it differs from 1 only by rounding
    if not np.all(np.abs(gain) < _LARGEST_GAIN):
        fastest = np.max(np.abs(np.roots([1.0, *plant.a[::-1]])), initial=0.0)
        zeros = f" or its zeros at {format_roots(plant.zeros)} rad/s" if plant.zeros.size else ""
        raise ValueError(
            f"dt = {dt!r} s: too long (or omega_o = {omega_o!r} rad/s too small) for the plant's "
            f"fastest pole of {fastest:.3g} rad/s{zeros}; the sampled model cannot be observed"
        )
    # Back to the plant's coordinates; an input enters with the power of dt of its relative degree.
    scale = dt**power
    return EsoModel(
        transition=np.ascontiguousarray(phi * scale[None, :] / scale[:, None]),
        input=b0 * (gammas[:, 0] * dt**plant.degree / scale),
        feed=gammas[:, 1] * dt**q / scale,
        gain=gain / scale,
        predictor=form == "predictor",
    )


def with_motion_of_f(matrix: Matrix, m: int, diagonal: float = 0.0) -> Matrix:
    """Return Φ, or Φ − I without ``diagonal``, of N = n + m states from that of n + 1.

    In units of the sample time f moves from sample to sample by ``f^(i) ← Σ_{j≥i} f^(j)/(j − i)!``,
    and is held in between.
    """
    if m == 1:
        return matrix
    n = matrix.shape[0] - 1
    found = np.zeros((n + m, n + m))
    found[: n + 1, : n + 1] = matrix
    for i in range(m):
        found[n + i, n + i] = diagonal
        for j in range(i + 1, m):
            found[n + i, n + j] = 1.0 / math.factorial(j - i)
    return found


def with_rates(inputs: Matrix, m: int) -> Matrix:
    """Return the inputs' columns of N = n + m states from those of n + 1: none moves f', …."""
    return np.vstack([inputs, np.zeros((m - 1, inputs.shape[1]))]) if m > 1 else inputs


def continuous_gain(a: Vector, omega_o: float, disturbance_order: int = 1) -> Vector:
    """Return the gain ``l`` (N,) of the continuous-time ESO with all poles at ``−omega_o``.

    With ``α_i`` the coefficients of ``(s + omega_o)^N`` and
    ``y^(n) + a_{n−1} y^(n−1) + … = f``, comparing powers of s in ``det(sI − A + lC)`` gives, with
    ``l_0 = 1``::

        l_i = α_i − Σ_{j<i} a_{n−i+j} l_j   for i = 1 … n,        l_i = α_i   for i = n + 1 … N

    With m extended states N = n + m, and ``l_N = omega_o^N`` for any m.

    The paper's Table I has another ``l_5`` (docs/theory, errata). Sampled designs do not use this
    gain; it is the limit of their ``L/dt``.
    """
    n, size = a.size, a.size + disturbance_order
    ell = np.ones(size + 1)
    for i in range(1, size + 1):
        known = sum(a[n - i + j] * ell[j] for j in range(i)) if i <= n else 0.0
        ell[i] = math.comb(size, i) * omega_o**i - known
    return ell[1:]
