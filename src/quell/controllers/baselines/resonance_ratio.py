"""Resonance ratio control of two masses and a spring.

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
slow force d on the load (observer_law.py). The reference is corrected for d at rest::

    r_1 = r − d̂/k − κ d̂/(m_1 k_p)

that is, for the twist of the spring and the deflection of the motor's position control under d.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quell import checks
from quell.controllers.baselines.observer_law import feedback_law, stationary_gain, with_disturbance
from quell.controllers.linear.linear import LinearController
from quell.lti.discretize import gramian
from quell.lti.models import leading_gain
from quell.plants import two_mass_spring


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
