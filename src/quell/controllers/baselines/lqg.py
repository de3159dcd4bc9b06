"""LQG: state feedback with a Kalman filter that also estimates a disturbance at the input.

::

    minimise ∫ y² + ρ u² dt,      u = −K x̂ − d̂ + N r,      N = 1 / ( C (I − Φ + Γ K)⁻¹ Γ )

(Franklin, Powell & Workman, *Digital Control of Dynamic Systems*, 1998, sections 8.5 and 9;
observer_law.py has the filter.) The cost is sampled exactly (Van Loan, *IEEE Trans. Automatic
Control* 23, 1978) and K comes from its Riccati equation.

The weights follow from two bandwidths. If u reaches y through ν integrators with the gain b, cheap
control places ν poles of the loop in a Butterworth pattern of radius ``(b²/ρ)^(1/(2ν))``, and the
others at the plant's zeros. With a random walk of density q at the input and measurement noise of
density v the filter's N − (n − ν) fast poles have the radius ``(q b²/v)^(1/(2(ν + 1)))``
(Kwakernaak & Sivan, *Linear Optimal Control Systems*, 1972, sections 3.8 and 4.4). So
``ρ = b²/omega_c^(2ν)`` and ``q b²/v = omega_o^(2(ν+1))``: exact for a chain of integrators, else
valid for bandwidths above the plant's own frequencies.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quell import checks
from quell.controllers.baselines.observer_law import (
    check_reachable,
    feedback_law,
    is_singular,
    stationary_gain,
    with_disturbance,
)
from quell.controllers.linear.linear import LinearController
from quell.lti.discretize import gramian, zero_order_hold
from quell.lti.models import leading_gain
from quell.plants.linear import LinearPlant
from quell.types import Matrix, Vector


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
