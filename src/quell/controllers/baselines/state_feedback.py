"""State feedback as a baseline: LQG, and resonance ratio control of two masses.

State feedback of an observer with a disturbance state, as one linear law.

The sampled plant with a disturbance that is a random walk, z = (x, d)::

    z⁺ = F z + G u,    F = [[Φ, Γ_d], [0, 1]],    G = [Γ; 0],    y = H z = C x

A Kalman filter in its current form, as the observers of this package, driven by the applied u, and
state feedback::

    z  = z⁻ + L (y − H z⁻),     L = P H' (H P H' + V)⁻¹
    u  = N r − K z,             z⁻⁺ = F z + G u

with P from the Riccati equation of (F', H', W, V). At rest the innovation is zero, and therefore
``y − r`` is zero for any plant and any constant disturbance: d̂ acts as integral action. Because
the filter receives the applied u, it does not wind up.

LQG: state feedback with a Kalman filter that also estimates a disturbance at the input.

::

    minimise ∫ y² + ρ u² dt,      u = −K x̂ − d̂ + N r,      N = 1 / ( C (I − Φ + Γ K)⁻¹ Γ )

(Franklin, Powell & Workman, *Digital Control of Dynamic Systems*, 1998, sections 8.5 and 9;
the filter is the one above.) The cost is sampled exactly (Van Loan, *IEEE Trans. Automatic
Control* 23, 1978) and K comes from its Riccati equation.

The weights follow from two bandwidths. If u reaches y through ν integrators with the gain b, cheap
control places ν poles of the loop in a Butterworth pattern of radius ``(b²/ρ)^(1/(2ν))``, and the
others at the plant's zeros. With a random walk of density q at the input and measurement noise of
density v the filter's N − (n − ν) fast poles have the radius ``(q b²/v)^(1/(2(ν + 1)))``
(Kwakernaak & Sivan, *Linear Optimal Control Systems*, 1972, sections 3.8 and 4.4). So
``ρ = b²/omega_c^(2ν)`` and ``q b²/v = omega_o^(2(ν+1))``: exact for a chain of integrators, else
valid for bandwidths above the plant's own frequencies.

Resonance ratio control of two masses and a spring.

The torque of the spring ``T = k (x_1 − x_2)``, fed back to the motor, changes the motor's inertia
as seen by the load from m_1 to m_1/κ::

    u = m_1 v + (1 − κ) T        so that      x_1'' = v − κ T/m_1,      x_2'' = T/m_2

The resonance is then at H times the anti-resonance ``ω_a = √(k/m_2)``, with ``H² = 1 + κ m_2/m_1``;
the resonance ratio H is a design parameter. With motor position control ``v = k_p (r_1 − x_1) − k_v
x_1'`` the characteristic polynomial of the loop is::

    s⁴ + k_v s³ + (k_p + H² ω_a²) s² + k_v ω_a² s + k_p ω_a²

which for ``H = √5, k_v = 4 ω_a, k_p = ω_a²`` is ``(s + ω_a)⁴`` (Yuki, Murakami & Ohnishi, *IECON*
1993; Hori, Sawada & Chun, *IEEE Trans. Industrial Electronics* 46, 1999, with a disturbance
observer so slow that both masses move as one).

They measure the motor and estimate T by a disturbance observer there. Here the only measurement y
is the position of either mass, so x_1, x_1' and T come from a Kalman filter of both masses with a
slow force d on the load (above). The reference is corrected for d at rest::

    r_1 = r − d̂/k − κ d̂/(m_1 k_p)

that is, for the twist of the spring and the deflection of the motor's position control under d.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.linear import LinearController, LinearLaw
from quell.hints import explained
from quell.lti.models import gramian, leading_gain, zero_order_hold
from quell.plants import two_mass_spring
from quell.plants.linear import LinearPlant
from quell.types import Matrix, Vector

# ---- State feedback of an observer with a disturbance state, as one linear law ----

# Relative size below which singular values and distances to the imaginary axis count as zero.
# Chosen by hand, above rounding errors.
_TINY = 1e-9
# The rounding of a zero eigenvalue, relative to the matrix; scalings of rows and columns, which
# converge quickly. Chosen by hand.
_ROUNDING, _SCALINGS = 1e-12, 10
_HINT = "check the noise densities, dt and the plant's units"


class SampledModel(NamedTuple):
    """``z⁺ = F z + G u``, ``y = H z``, of N = n + 1 states, the last of them the disturbance."""

    F: Matrix
    G: Vector
    H: Vector


def with_disturbance(A: Matrix, B: Matrix, C: Matrix, E: Matrix, dt: float) -> SampledModel:
    """Sample the plant with a constant disturbance that enters through ``E`` (n, 1)."""
    n = A.shape[0]
    phi, (gamma, gamma_d) = zero_order_hold(A, [B, E], dt)
    F = np.block([[phi, gamma_d], [np.zeros((1, n)), np.ones((1, 1))]])
    return SampledModel(F, np.append(gamma[:, 0], 0.0), np.append(C[0], 0.0))


def check_reachable(A: Matrix, B: Matrix, what: str) -> None:
    """Check the rank of (A − λ, B) for each pole λ that does not decay (Popov, Belevitch, Hautus).

    The error, for a mode that B does not reach, begins with ``what``.
    """
    from scipy.linalg import matrix_balance

    A, (scale, _) = matrix_balance(A, permute=False, separate=True)
    B = B / scale[:, None]
    for pole in np.linalg.eigvals(A):
        if pole.real >= -_TINY * np.linalg.norm(A):
            own = np.diag(A) - pole
            own[np.abs(own) <= _ROUNDING * np.linalg.norm(A)] = 0.0  # of eigenvalues
            inner = A - np.diag(np.diag(A)) + np.diag(own)
            if is_singular(np.hstack([inner, B])):
                raise ValueError(f"{what}: its mode at s = {pole:.4g} rad/s does not decay")


def is_singular(matrix: Any) -> bool:
    """Return whether the rows of a matrix depend on each other, but for rounding.

    Rows and columns are scaled before, by the geometric mean of their largest and least entries,
    which does not change the rank: in given units a quick undamped mode can look as if it had no
    effect on y.
    """
    for _ in range(_SCALINGS):
        for axis in (1, 0):
            entries = np.ma.masked_equal(np.abs(matrix), 0.0)
            ends = [np.ma.filled(of(entries, axis=axis), 1.0) for of in (np.ma.min, np.ma.max)]
            matrix = matrix / np.expand_dims(np.sqrt(ends[0] * ends[1]), axis)
    singular = np.linalg.svd(matrix, compute_uv=False)
    return bool(singular[-1] <= _TINY * singular[0])


def stationary_gain(model: SampledModel, W: Matrix, V: float) -> Vector:
    """Return the gain L (N,) of the stationary Kalman filter.

    The process noise per sample is W (N, N) [state-unit²], the measurement variance V [y-unit²];
    only their ratio counts. Raises ``ValueError`` if the Riccati equation has no solution with a
    stable filter.
    """
    from scipy.linalg import solve_discrete_are

    F, _, H = model
    try:
        P = solve_discrete_are(F.T, H[:, None], W, np.array([[V]]))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(f"no stationary Kalman filter: {error}; {_HINT}") from None
    gain: Vector = P @ H / (H @ P @ H + V)
    if not np.max(np.abs(np.linalg.eigvals(F - np.outer(F @ gain, H)))) < 1.0:
        raise ValueError(f"no stable stationary Kalman filter: {_HINT}")
    return gain


def feedback_law(model: SampledModel, L: Vector, K: Vector, N: float) -> LinearLaw:
    """Return ``u = N r − K z`` with the filter of gain L as a law whose state is z⁻."""
    F, G, H = model
    corrected = np.eye(G.size) - np.outer(L, H)
    B_r, D_y = np.zeros(G.size), -float(K @ L)
    return LinearLaw(F @ corrected, B_r, F @ L, G.copy(), -K @ corrected, N, D_y)


# ---- LQG ----


@explained("quell.baselines.LQG(plant, omega_c=3.0, omega_o=20.0, dt=1e-3)")
class LQG(LinearController):
    """Linear-quadratic state feedback with a Kalman filter and a disturbance state.

    Raises ``ValueError`` for a plant that is not stabilisable from u or not detectable from y, or
    has a zero at s = 0 (a constant disturbance then has no effect on y).

    Parameters
    ----------
    plant
        anything that ``LinearPlant.of`` takes, which defines the states of a transfer function.
    omega_c, omega_o
        bandwidths of state feedback and filter [rad/s], which set the weights.
    dt
        sample time [s].
    Q
        (n, n), symmetric, weight of the state in place of ``C'C`` [1/s of cost].
    rho
        weight of u², instead of the one from ``omega_c``.
    process_noise
        (n, n), symmetric, density of white noise on the state's derivatives, in addition to that of
        the disturbance, relative to the density of the measurement noise [(state-unit/s)²/y-unit²];
        none by default.
    u_min, u_max, rate_limit, name
        as for ``LinearController``.

    Attributes
    ----------
    K : (n,) array
        gains of the state; that of d̂ is 1.
    L : (n + 1,) array
        gains of the filter.
    N : float
        gain of the reference.

    Examples
    --------
    >>> from quell.plants import two_mass_spring
    >>> controller = LQG(two_mass_spring(), omega_c=1.0, omega_o=10.0, dt=1e-2)
    >>> controller.K.shape, controller.L.shape
    ((4,), (5,))
    """

    def __init__(
        self,
        plant: Any,
        omega_c: float,
        omega_o: float,
        dt: float,
        *,
        Q: Any = None,
        rho: float | None = None,
        process_noise: Any = None,
        **options: Any,
    ) -> None:
        linear = LinearPlant.of(plant)
        A, B, C = linear.A, linear.B, linear.C
        n = A.shape[0]
        omega_c = checks.positive("omega_c", omega_c, "rad/s")
        omega_o, dt = checks.positive("omega_o", omega_o, "rad/s"), checks.positive("dt", dt, "s")
        self.omega_c, self.omega_o = omega_c, omega_o
        check_reachable(A, B, "plant is not stabilisable from u")
        check_reachable(A.T, C.T, "plant is not detectable from y")
        _check_zero(A, B, C)
        first = leading_gain(A, B, C)
        if first is None:
            raise ValueError("u does not reach y: B or C is zero, or they have no mode in common")
        b, degree = first
        name = "rho"
        if rho is None:
            name = "rho = b² / omega_c^2m"
            with np.errstate(all="ignore"):
                rho = float(b**2 / np.float64(omega_c) ** (2 * degree))
        rho = checks.positive(name, rho)
        weight = C.T @ C if Q is None else checks.weight("Q", Q, n)
        self.K = _state_gain(A, B, weight, rho, dt)
        self.model = with_disturbance(A, B, C, B, dt)
        # Variances per sample: the density of y divided by dt, that of the walk times dt.
        W = np.zeros((n + 1, n + 1))
        W[n, n] = dt * omega_o ** (2 * (degree + 1)) / b**2
        if process_noise is not None:
            W[:n, :n] = gramian(A, checks.weight("process_noise", process_noise, n), dt)
        self.L = stationary_gain(self.model, W, 1.0 / dt)
        phi, gamma = self.model.F[:n, :n], self.model.G[:n]
        closed_loop = np.eye(n) - phi + np.outer(gamma, self.K)
        self.N = 1.0 / float(C[0] @ np.linalg.solve(closed_loop, gamma))
        law = feedback_law(self.model, self.L, np.append(self.K, 1.0), self.N)
        super().__init__(law, dt, **({"name": "LQG"} | options))

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints: the arguments, and the gains that follow from them."""
        return super().described() | {"K": self.K, "L": self.L, "N": self.N}


def _check_zero(A: Matrix, B: Matrix, C: Matrix) -> None:
    if is_singular(np.block([[A, B], [C, np.zeros((1, 1))]])):
        raise ValueError("plant has a zero at s = 0: y cannot follow a constant reference")


def _state_gain(A: Matrix, B: Matrix, Q: Matrix, rho: float, dt: float) -> Vector:
    """Return K (n,) of the sampled regulator with the cost ``∫ x'Qx + ρ u² dt``."""
    from scipy.linalg import solve_discrete_are

    n = A.shape[0]
    inner = np.block([[A, B], [np.zeros((1, n + 1))]])
    cost = np.zeros((n + 1, n + 1))
    cost[:n, :n], cost[n, n] = Q, rho
    sampled = gramian(inner.T, cost, dt)
    phi, (gamma,) = zero_order_hold(A, [B], dt)
    S, R = sampled[:n, n:], sampled[n:, n:]
    try:
        P = solve_discrete_are(phi, gamma, sampled[:n, :n], R, s=S)
    except (np.linalg.LinAlgError, ValueError) as error:
        rule = "Q must weight every mode that does not decay"
        raise ValueError(f"no stabilising state feedback: {error}; {rule}") from None
    gain: Vector = np.linalg.solve(R + gamma.T @ P @ gamma, gamma.T @ P @ phi + S.T)[0]
    return gain


# ---- Resonance ratio control of two masses and a spring ----


class ResonanceRatio(LinearController):
    """Resonance ratio control of ``quell.plants.two_mass_spring``; y is either mass's position.

    Parameters
    ----------
    m1, m2, k
        motor and load [kg], spring [N/m] of the design; for torsion inertias and stiffness.
    omega_o
        bandwidth of the filter [rad/s]: the radius of its fastest poles, if above the resonance.
    dt
        sample time [s].
    omega_d
        bandwidth of the estimated load force [rad/s]; by default half the anti-resonance.
    ratio
        H, above 1; √5 by default.
    measured
        ``"load"``: y = x2, or ``"motor"``: y = x1.
    u_min, u_max, rate_limit, name
        as for ``LinearController``.

    Attributes
    ----------
    kappa : float
        κ, the factor by which the motor's inertia appears smaller to the load.
    K : (4,) array
        gains of (x1, x2, x1', x2').
    L : (5,) array
        gains of the filter.

    Raises
    ------
    ValueError
        for a number out of range.

    Examples
    --------
    >>> controller = ResonanceRatio(omega_o=10.0, dt=1e-2)
    >>> controller.kappa, controller.K.round(6).tolist()
    (4.0, [4.0, -3.0, 4.0, 0.0])
    """

    def __init__(
        self,
        m1: float = 1.0,
        m2: float = 1.0,
        k: float = 1.0,
        *,
        omega_o: float,
        dt: float,
        omega_d: float | None = None,
        ratio: float = math.sqrt(5.0),
        measured: str = "load",
        **options: Any,
    ) -> None:
        c1 = float(checks.one_of("measured", measured, ("load", "motor")) == "motor")
        plant = two_mass_spring(m1, m2, k, c1, 1.0 - c1)
        omega_o, dt = checks.positive("omega_o", omega_o, "rad/s"), checks.positive("dt", dt, "s")
        if not checks.positive("ratio", ratio) > 1.0:
            raise ValueError(f"ratio = {ratio!r}: must be above 1, as the resonance always is")
        self.m1, self.m2, self.k, self.ratio, self.measured = m1, m2, k, ratio, measured
        self.omega_o = omega_o
        w_a = math.sqrt(k / m2)
        self.kappa = round((ratio**2 - 1.0) * m1 / m2, 12)  # 4 for √5, not 4.000000000000001
        omega_d = checks.optional(checks.positive, "omega_d", omega_d, "rad/s") or 0.5 * w_a
        self.omega_d = omega_d
        kp, kv = w_a**2, 4.0 * w_a
        torque = (1.0 - self.kappa) * k
        self.K = np.array([m1 * kp - torque, torque, m1 * kv, 0.0])
        # At rest under d the spring carries it: x1 − x2 = −d/k, u = −d, y = x2 + c1 (x1 − x2) = r.
        self.K_d = float(1.0 + (self.K[0] * (1.0 - c1) - self.K[1] * c1) / k)
        model = with_disturbance(plant.A, plant.B, plant.C, plant.E[:, 1:], dt)
        # White noise in the force on the other mass, and a random walk in d that crosses it at
        # omega_d. Their size gives the filter's fastest poles the radius omega_o. The force on the
        # measured mass alone would not do: at the anti-resonance it has no effect on y, and the
        # filter would have undamped poles there.
        far = plant.E[:, :1] if measured == "load" else plant.E[:, 1:]
        gains = [leading_gain(plant.A, column, plant.C) for column in (far, plant.E[:, 1:])]
        # The spring joins both masses, so no gain is None.
        (b_far, degree_far), (b_d, degree_d) = (found for found in gains if found is not None)
        density_far = omega_o ** (2 * degree_far) / b_far**2
        density = min(density_far, omega_o ** (2 * degree_d + 2) / (b_d * omega_d) ** 2)
        W = np.zeros((5, 5))
        W[:4, :4] = gramian(plant.A, far @ far.T * density, dt)
        W[4, 4] = dt * density * omega_d**2
        self.L = stationary_gain(model, W, 1.0 / dt)
        law = feedback_law(model, self.L, np.append(self.K, self.K_d), m1 * kp)
        super().__init__(law, dt, **({"name": "resonance ratio"} | options))

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints: the arguments, and the gains that follow from them."""
        return super().described() | {"K": self.K, "L": self.L}
