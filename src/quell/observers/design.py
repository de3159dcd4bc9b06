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

With *sinusoids* of known frequencies ω_1 … ω_k two of the m extended states belong to each, and the
model of f is that of an internal model (Francis & Wonham, *Automatica* 12, 1976; Johnson, *IEEE
Trans. Automatic Control* 16, 1971): ``p(d/dt) Δf = 0`` with ::

    p(s) = s^(m−2k) Π_j (s² + ω_j²),        (Δf^(m−1))' = −Σ_i p_i Δf^(i)

sampled exactly, and held within a sample as above. So the feedback has m − 2k poles at z = 1 and
pairs at ``exp(±i ω_j dt)``: loads of these frequencies are rejected without error.

All eigenvalues of ``(I − L C) Φ`` lie at ``exp(−omega_o dt)`` (the bandwidth parametrisation of
Gao, ACC 2003, in the z-plane as in Miklosovic, Radke & Gao, ACC 2006), or at ``exp(p_i omega_o
dt)`` with a pattern of poles p of its own. The *reduced* form is the
current form with one pole at z = 0: ``L_1 = 1`` and ``x̂_1 = y``; the other n poles are those of
the reduced-order observer, at ``exp(−omega_o dt)``.

With *half gain* the correction is L/2: nearly the same loop for half the gain from noise (Herbst,
Hempel, Göhrt & Streif, IFAC World Congress 2020, arXiv 2003.03986; Herbst & Madonski, arXiv
2211.07309).

The steady-state Kalman gain of the extended state observer, from variances.

White noise is assumed to drive the extended model: ``f^(m) = w`` with the density ``drift`` and m
extended states, ``x_n' = … + f + v`` with the density ``jitter``. y is measured with noise of the
variance ``noise`` in each sample. Sampled exactly (Van Loan, *IEEE Trans. Automatic Control* 23,
1978)::

    Q  = ∫_0^dt exp(A s) G exp(Aᵀ s) ds
    P⁻ = Φ (P⁻ − P⁻ Cᵀ (C P⁻ Cᵀ + R)⁻¹ C P⁻) Φᵀ + Q,      L = P⁻ Cᵀ / (C P⁻ Cᵀ + R)

With drift alone and fast sampling, the poles lie in a Butterworth pattern of the radius
``(drift/(noise dt))^(1/2N)`` (symmetric root locus of a chain of N integrators; Anderson & Moore,
*Optimal Control*, 1990).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.lti.canonical import Canonical, format_roots
from quell.lti.models import gramian, pole_pattern, zero_order_hold
from quell.observers.forms import EsoModel, NonlinearModel, observe, without_delay
from quell.types import Matrix, Vector

# ---- Pole placement for observers, in terms of 1 − pole to keep full precision near z = 1 ----


def place_poles(difference: Matrix, offsets: Vector) -> Vector:
    """Return L that puts the eigenvalues of ``(I − L C) Φ``, C = (1, 0, …), at ``1 − offsets``.

    ``difference`` is ``Φ − I`` (N, N), in coordinates in which it is O(1) after division by the
    largest offset; complex offsets (N,) come in conjugate pairs. L (N,) is NaN if Φ can't be
    observed through C.

    Ackermann's formula: ``L = Π (Φ − β_i I) O⁻¹ e_N`` with the rows ``C Φ (Φ − I)^i`` for O.
    Differences instead of powers do not change ``O⁻¹ e_N`` and make O triangular for a chain of
    integrators, where powers would be nearly parallel. Dividing by the largest offset makes them
    O(1).
    """
    size = difference.shape[0]
    unit = np.max(np.abs(offsets))
    rate = difference / unit
    rows = np.empty((size, size))
    rows[0] = difference[0]
    rows[0, 0] += 1.0
    for i in range(1, size):
        rows[i] = rows[i - 1] @ rate
    try:
        vector = np.linalg.solve(rows, np.eye(size)[-1])
    except np.linalg.LinAlgError:
        return np.full(size, np.nan)
    for offset in offsets / unit:
        vector = rate @ vector + offset * vector
    return unit * np.real(vector)


def sampled_zeros(difference: Matrix, zeros: Vector, dt: float) -> Vector:
    """Return ``1 − ζ`` for the z-plane zeros ζ from f to y that belong to the plant's ``zeros``.

    The plant's zeros [rad/s] come in conjugate pairs. ζ are close to ``exp(zeros dt)`` among the
    finite eigenvalues of the pencil ``[[Φ − I − λ I, Γ], [C, 0]]`` with ``λ = ζ − 1``; the others
    are due to sampling. Γ, the response to a held f, is the last column of Φ.
    """
    from scipy.linalg import eigvals

    size = difference.shape[0]
    pencil = difference.copy()
    pencil[-1] = np.eye(size)[0]
    found = eigvals(pencil, np.diag(np.append(np.ones(size - 1), 0.0)))
    found = found[np.isfinite(found)]
    offsets = np.empty(zeros.size, dtype=complex)
    for i, zero in enumerate(zeros):
        nearest = int(np.argmin(np.abs(found - np.expm1(zero * dt))))
        offsets[i] = -found[nearest]
        found = np.delete(found, nearest)
    return offsets


# ---- Design of the linear extended state observer ----

FORMS = ("current", "predictor", "reduced")
# In the coordinates of the design useful gains are at most O(1); far above, rounding decides where
# the poles are. Chosen by hand; not tuned further.
_LARGEST_GAIN = 1e6


def checked_disturbance_order(value: Any, frequencies: Any = (), dt: float = 1.0) -> int:
    """Return the number m of extended states; raise a ``ValueError`` if it is not 1, 2 or 3.

    For each of the ``frequencies`` [rad/s], which lie below π/dt, there are two more.
    """
    known = checks.vector("frequencies", frequencies)
    if not np.all((known > 0.0) & (known * dt < math.pi)):
        raise ValueError(
            f"frequencies = {known.tolist()!r}: must be above 0 and below pi/dt = "
            f"{math.pi / dt:.4g} rad/s"
        )
    if np.unique(known).size < known.size:
        raise ValueError(f"frequencies = {known.tolist()!r}: must differ from each other")
    return checks.whole("disturbance_order", value, 1, 3) + 2 * known.size


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
    frequencies: Any = (),
) -> EsoModel:
    """Return the update of the observer of ``plant`` with the bandwidth ``omega_o``.

    ``poles`` are those of the observer in units of omega_o, all at −1 by default; the reduced form
    has one less than the others. ``disturbance_order`` is the number m of extended states, two of
    them for each of ``frequencies`` [rad/s].
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
    motion = motion_of_f(disturbance_order, np.ravel(frequencies) * dt)
    model = _sampled_design(plant, b0, omega_o, dt, form, kept, pattern, motion)
    return model._replace(gain=0.5 * model.gain) if half_gain else model


def _sampled_design(
    plant: Canonical,
    b0: float,
    omega_o: float,
    dt: float,
    form: str,
    kept: Vector,
    pattern: NDArray[np.complex128] | None,
    motion: Matrix,
) -> EsoModel:
    """Sample the extended model and place the poles; ``kept`` are plant zeros that keep a pole.

    The model is sampled in the coordinates ``x_i dt^(i−1)`` and ``f^(j) dt^(q+j)``, where all
    entries are O(1). The poles are placed in the coordinates ``x_i/omega_o^(i−1)``,
    ``f^(j)/omega_o^(q+j)``. There Φ is close to I, but ``Φ − I`` has full precision because it is
    computed as ``∫ e^(A t) A dt``.
    """
    n, q, m = plant.a.size, plant.f_degree, motion.shape[0]
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
        phi = with_motion_of_f(phi, motion + np.eye(m))
        difference, gammas = with_motion_of_f(difference, motion), with_rates(gammas, m)
        step = omega_o * dt
        gain = np.full(size, np.nan)
        ratios = step ** (power[None, :] - power[:, None])
        if not np.all(np.isfinite(ratios)):
            raise ValueError(
                f"omega_o = {omega_o!r} rad/s with dt = {dt!r} s: powers of omega_o dt up to "
                f"{power[-1]} are out of the range of numbers; take an omega_o below 1/dt"
            )
        if np.all(np.isfinite(phi)):
            difference *= ratios
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


def motion_of_f(m: int, angles: Vector) -> Matrix:
    """Return what a sample adds to f, f', … (m, m) in units of the sample time.

    A polynomial moves by ``f^(i) ← Σ_{j≥i} f^(j)/(j − i)!``; ``angles`` are ω_j dt of sinusoids.
    """
    if angles.size == 0:
        found = np.zeros((m, m))
        for i in range(m):
            for j in range(i + 1, m):
                found[i, j] = 1.0 / math.factorial(j - i)
        return found
    model = np.ones(1)
    for angle in angles.tolist():
        model = np.convolve(model, [1.0, 0.0, angle**2])
    chain = np.diag(np.ones(m - 1), 1)
    chain[-1, m - model.size + 1 :] = -model[:0:-1]
    _, (added,) = zero_order_hold(chain, [chain], 1.0)
    return added


def with_motion_of_f(matrix: Matrix, motion: Matrix) -> Matrix:
    """Return Φ, or Φ − I, of N = n + m states from that of n + 1.

    f moves from sample to sample as ``motion`` (m, m) says, and is held in between.
    """
    m = motion.shape[0]
    if m == 1:
        return matrix
    n = matrix.shape[0] - 1
    found = np.zeros((n + m, n + m))
    found[: n + 1, : n + 1] = matrix
    found[n:, n:] = motion
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

    The paper's Table I has another ``l_5`` (docs/paper). Sampled designs do not use this
    gain; it is the limit of their ``L/dt``.
    """
    n, size = a.size, a.size + disturbance_order
    ell = np.ones(size + 1)
    for i in range(1, size + 1):
        known = sum(a[n - i + j] * ell[j] for j in range(i)) if i <= n else 0.0
        ell[i] = math.comb(size, i) * omega_o**i - known
    return ell[1:]


# ---- The steady-state Kalman gain of the extended state observer, from variances ----


def kalman_gain(
    A: Matrix, order: int, dt: float, noise: float, drift: float, jitter: float
) -> tuple[Vector, float]:
    """Return L (N,) and the geometric mean of ``|ln z_i|/dt`` over the poles [rad/s].

    L is in the coordinates of ``A`` (N, N), whose states from n + 1 on, with n the ``order``, are f
    and its derivatives. The equation is solved in the time unit of the Butterworth pattern, where
    the entries of Φ, Q and P have similar sizes.
    """
    from scipy.linalg import solve_discrete_are

    size = A.shape[0]
    # With drift alone q/(r dt) is the bandwidth to the power 2N, with jitter alone to the power
    # 2n, n being the order. Take the faster one.
    density = noise * dt
    with np.errstate(all="ignore"):
        by_drift, by_jitter = np.float64(drift) / density, np.float64(jitter) / density
        omega = float(max(by_drift ** (0.5 / size), by_jitter ** (0.5 / order)))
    refusal = ValueError(
        f"noise_variance = {noise!r}, drift = {drift!r}, jitter = {jitter!r} with "
        f"dt = {dt!r} s: no steady-state gain is found; they ask for about {omega:.3g} rad/s, "
        "which should be between 1e-3/dt and 1/dt"
    )
    if not 0.0 < omega < np.inf:
        raise refusal
    scale = omega ** -np.arange(size, dtype=np.float64)
    scaled = A * scale[:, None] / scale[None, :] / omega
    drive = np.zeros((size, size))
    drive[-1, -1] = drift / density * (scale[-1] / omega) ** 2
    drive[order - 1, order - 1] = jitter / density * (scale[order - 1] / omega) ** 2
    step = omega * dt
    phi, _ = zero_order_hold(scaled, [], step)
    phi[:order, order + 1 :] = 0.0  # f is held within a sample, as in the design above
    C, R = np.eye(1, size), np.array([[1.0 / step]])
    try:
        with np.errstate(invalid="ignore"):  # what overflows is found below
            P = solve_discrete_are(phi.T, C.T, gramian(scaled, drive, step), R)
    except (np.linalg.LinAlgError, ValueError):
        P = np.full((size, size), np.nan)
    gain = P[:, 0] / (P[0, 0] + R[0, 0])
    poles = np.array([np.inf])
    if np.all(np.isfinite(gain)):
        poles = np.linalg.eigvals((np.eye(size) - np.outer(gain, C)) @ phi)
    with np.errstate(divide="ignore"):
        rate = float(np.exp(np.mean(np.log(np.abs(np.log(poles.astype(complex)))))))
    if not (np.max(np.abs(poles)) < 1.0 and rate < np.pi):
        raise refusal
    return np.asarray(gain / scale), rate / dt


# ---- The matrices of a linear observer, found by applying its update to unit vectors ----


class Response(NamedTuple):
    """The update ``z⁺ = M z + G (y, u, f_L)`` and the estimates ``C z + D (y, u, f_L)``.

    There are m states and N estimates, ``x̂_1 … x̂_n, Δf̂`` and its derivatives, if there are any.
    """

    transition: Matrix  #: M (m, m)
    input: Matrix  #: G (m, 3)
    output: Matrix  #: C (N, m)
    feedthrough: Matrix  #: D (N, 3)
    at_f: int  #: n, the place of Δf̂ among the estimates


def response(model: Any, estimates: int, at_f: int) -> Response:
    """Return the matrices of the update of a linear observer's ``model``, for N ``estimates``."""
    if isinstance(without_delay(model), NonlinearModel):
        raise ValueError(
            "observer is nonlinear: it has no exact lag for learners and guards; use a linear one"
        )
    m = model.states
    state, estimated = np.zeros((m, m + 3)), np.zeros((estimates, m + 3))
    for i, one in enumerate(np.eye(m + 3)):
        z, estimate = one[:m].copy(), np.zeros(estimates)
        observe(model, z, estimate, *one[m:].tolist())
        state[:, i], estimated[:, i] = z, estimate
    parts = state[:, :m], state[:, m:], estimated[:, :m], estimated[:, m:]
    transition, given, output, feedthrough = (part.copy() for part in parts)
    return Response(transition, given, output, feedthrough, at_f)


def f_learned_response(found: Response, every: int = 1) -> tuple[Matrix, Vector, Vector, float]:
    """Return ``(M, g, c, d)`` of ``s⁺ = M s + g f_L``, ``−Δf̂ = c·s + d f_L``, for y = u = 0.

    With ``every`` = m they are those of each m-th sample, for an f_L that is constant in between::

        s_(k+m) = M^m s_k + Σ_(i<m) M^i g f_L
        −Δf̂_(k+m) = c M^(m−1) s_k + (c Σ_(i<m−1) M^i g + d) f_L
    """
    M, g, c = found.transition, found.input[:, 2], -found.output[found.at_f]
    d, given = -float(found.feedthrough[found.at_f, 2]), g.copy()
    for _ in range(every - 1):
        c, d, given = c @ M, d + float(c @ g), M @ given + g
    return np.linalg.matrix_power(M, every), given, c, d


def scaled_response(model: Any, units: Vector, at_f: int) -> Response:
    """Return the response without the delay of u, with the states divided by ``units`` (N,).

    ``ESO.units`` makes the poles O(1) in the time unit ``1/omega_o``. The estimates keep theirs.
    """
    found = response(without_delay(model), units.size, at_f)
    units = np.resize(units, found.transition.shape[0])
    return found._replace(
        transition=found.transition * units[None, :] / units[:, None],
        input=found.input / units[:, None],
        output=found.output * units[None, :],
    )


def total_time_constant(found: Response) -> float:
    """Return ``Σ 1/|ln z_i|`` over the poles [samples], to second order ``tr (I − M)⁻¹ − m/2``."""
    m = found.transition.shape[0]
    return float(np.trace(np.linalg.inv(np.eye(m) - found.transition))) - 0.5 * m


def f_lag(found: Response) -> float:
    """Return the lag of the estimate behind a slowly varying f [samples], ``c (I − M)⁻² g``."""
    M, g, c, _ = f_learned_response(found)
    at_rest = np.eye(M.shape[0]) - M
    return float(c @ np.linalg.solve(at_rest, np.linalg.solve(at_rest, g)))
