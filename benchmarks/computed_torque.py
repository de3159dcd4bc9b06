"""Axes beside the usual control of arms: computed torque, with an integrator, and adaptive.

    python benchmarks/computed_torque.py [--seconds 30] [--omega-c 8]

The arm, the motion and the noise of docs/axes: links of 0.4 and 0.3 m, 2 and 1 kg, in a vertical
plane, joints that follow 0.5 sin 2t and 0.8 sin 3t, 1 kHz, torques up to 40 N m. Its equations are
linear in seven numbers ``p = (a_00, a_01, a_11, g_0, g_1, d_0, d_1)``. In the angles of the links
θ = T q, with any second rate ``θ_r'`` in the place of one of the two (``Y`` below)::

    Y_θ p = Σ_j a_ij (cos(θ_i − θ_j) θ_r,j'' + sin(θ_i − θ_j) θ_j' θ_r,j') + g_i cos θ_i
    τ = Y(q, q', q_r', q_r'') p = Tᵀ Y_θ p + d q_r'

With e = r − q, all poles of an exact model at −ω_c, and the same ω_c for all:

*computed torque* (Spong, Hutchinson & Vidyasagar, *Robot Modeling and Control*, ch. 8)::

    τ = Y(q, q', q', r'' + 2 ω_c e' + ω_c² e) p̂

*with integrator*: ``r'' + 3 ω_c e' + 3 ω_c² e + ω_c³ ∫e``, whose integral rests at a limit.

*adaptive* (Slotine & Li, *Int. J. Robotics Research* 6, 1987)::

    q_r' = r' + ω_c e,   s = q_r' − q',   τ = Y(q, q', q_r', q_r'') p̂ + ω_c M_0 s,   p̂' = Γ Yᵀ s

with the diagonal of M in the middle of the motion for M_0, and ``Γ = γ diag(p²)`` of the model. Of
γ = 0.1, 0.3, 1, 3, 10 and 30 ``GAMMA`` leaves least at joint 2 with a model that is 20 % off.

*ADRC* is ``Axes`` with M(q) of the model, feedforward and ω_o = 60 rad/s, without a model of
gravity and of centrifugal forces; *learning* has ``Harmonic`` and a guard in each joint, or one
``RLS`` of monomials to degree 2 for both with guards.

The rates of the others are r' less the difference of e behind a lag of 3 ms. The model is exact,
or the first link is 5 % or 20 % lighter in it and the second one heavier; adaptive control begins
with it. RMS error in the second half, in the first five seconds after the start at rest in the
middle, and the change of torque in a second, which the motion and noise make.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from measured import options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.features import AllAxes, Bias, Polynomial, State
from quell.kernels import dispatch
from quell.types import Matrix, Vector

DT, OMEGA_O, LIMIT, NOISE = 1e-3, 60.0, 40.0, 1e-5
LENGTHS, MASSES, VISCOUS, GRAVITY = (0.4, 0.3), (2.0, 1.0), 0.1, 9.81
SIZES, OMEGAS = np.array([0.5, 0.8]), np.array([2.0, 3.0])
RATE_LAG, GAMMA, FIRST = 3e-3, 3.0, 5.0
MODELS = {"exact": (1.0, 1.0), "5 % off": (0.95, 1.05), "20 % off": (0.8, 1.2)}
SUM = np.array([[1.0, 0.0], [1.0, 1.0]])  # T: angles of the links from those of the joints


def numbers(shares: Any = (1.0, 1.0)) -> Vector:
    """Return p (7,) of the arm with ``shares`` (2,) of its masses."""
    (l1, l2), (m1, m2) = LENGTHS, np.multiply(shares, MASSES).tolist()
    inertias = m1 * l1**2 / 3.0 + m2 * l1**2, m2 * l1 * l2 / 2.0, m2 * l2**2 / 3.0
    weights = GRAVITY * (m1 * l1 / 2.0 + m2 * l1), GRAVITY * m2 * l2 / 2.0
    return np.array([*inertias, *weights, VISCOUS, VISCOUS])


def regressor(q: Vector, dq: Vector, rate: Vector, acceleration: Vector) -> Matrix:
    """Return Y (2, 7); ``rate`` and ``acceleration`` are q_r' and q_r'' (2,)."""
    c, s = np.cos(q[1]), np.sin(q[1])  # of θ_2 − θ_1
    d1, d2 = dq[0], dq[0] + dq[1]
    r1, r2 = rate[0], rate[0] + rate[1]
    a1, a2 = acceleration[0], acceleration[0] + acceleration[1]
    Y = np.zeros((2, 7))
    Y[0, 0] = a1
    Y[1, 1] = c * a1 + s * d1 * r1  # of the second link
    Y[0, 1] = c * a2 - s * d2 * r2 + Y[1, 1]
    Y[0, 2] = Y[1, 2] = a2
    Y[0, 3] = np.cos(q[0])
    Y[0, 4] = Y[1, 4] = np.cos(q[0] + q[1])
    Y[0, 5], Y[1, 6] = rate[0], rate[1]
    return Y


def accelerations(p: list[float], x: list[float], u: Vector) -> list[float]:
    """Return q' and q'' of the arm with the state ``x = (q, q')``."""
    q1, q2, d1, d2 = x
    c, s = math.cos(q2), p[1] * math.sin(q2)
    m11, m12, m22 = p[0] + p[2] + 2.0 * p[1] * c, p[2] + p[1] * c, p[2]
    second = p[4] * math.cos(q1 + q2)
    t1 = u[0] + s * d2 * (2.0 * d1 + d2) - p[3] * math.cos(q1) - second - p[5] * d1
    t2 = u[1] - s * d1 * d1 - second - p[6] * d2
    det = m11 * m22 - m12 * m12
    return [d1, d2, (m22 * t1 - m12 * t2) / det, (m11 * t2 - m12 * t1) / det]


def moved(p: list[float], x: list[float], u: Vector) -> list[float]:
    """Return the state after a sample with the torques u held, by a Runge-Kutta step."""

    def ahead(share: float, slope: list[float]) -> list[float]:
        return [a + share * DT * b for a, b in zip(x, slope, strict=True)]

    k1 = accelerations(p, x, u)
    k2 = accelerations(p, ahead(0.5, k1), u)
    k3 = accelerations(p, ahead(0.5, k2), u)
    k4 = accelerations(p, ahead(1.0, k3), u)
    mean = [(a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)]
    return ahead(1.0, mean)


class ModelBased:
    """Computed torque, with an integrator if asked for, or adaptive control, of the two joints."""

    def __init__(self, kind: str, p: Vector, omega_c: float, gamma: float = GAMMA) -> None:
        self.kind, self.p, self.omega_c = kind, p.copy(), omega_c
        self.adaptation = gamma * p**2
        self.M0 = np.array([p[0] + p[2] + 2.0 * p[1], p[2]])
        self.integral, self.rate, self.before = np.zeros(2), np.zeros(2), None

    def step(self, r: Vector, y: Vector, dr: Vector, ddr: Vector) -> Vector:
        """Take one sample; return the torques."""
        w, e = self.omega_c, r - y
        before = e if self.before is None else self.before
        self.rate = self.rate + (1.0 - np.exp(-DT / RATE_LAG)) * ((e - before) / DT - self.rate)
        self.before, de = e, self.rate
        dq = dr - de
        if self.kind == "adaptive":
            s, rate = de + w * e, dr + w * e
            Y = regressor(y, dq, rate, ddr + w * de)
            u = Y @ self.p + w * self.M0 * s
            self.p = self.p + DT * self.adaptation * (Y.T @ s)
            return np.clip(u, -LIMIT, LIMIT)
        wished = ddr + 2.0 * w * de + w**2 * e
        if self.kind == "with integrator":
            wished = ddr + 3.0 * w * de + 3.0 * w**2 * e + w**3 * self.integral
        u = regressor(y, dq, dq, wished) @ self.p
        if np.all(np.abs(u) <= LIMIT):
            self.integral = self.integral + DT * e
        return np.clip(u, -LIMIT, LIMIT)


def axes(shares: Any, omega_c: float, learner: Any = None, of_both: Any = None) -> ql.Axes:
    """Return ``Axes`` with M(q) of an arm with ``shares`` of the masses."""
    model = ql.plants.arm(LENGTHS, np.multiply(shares, MASSES))
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=OMEGA_O, dt=DT)
    guard = None if learner is None else ql.Guard()
    one = partial(ql.ADRC, observer, omega_c, feedforward=True, learner=learner, guard=guard)
    watch = None if of_both is None else ql.Guard()
    how: dict[str, Any] = {"u_min": -LIMIT, "u_max": LIMIT}
    return ql.Axes([one(), one()], M=model.inertia, learner=of_both, guard=watch, **how)


def controllers(shares: Any, omega_c: float) -> dict[str, Any]:
    """Return the controllers whose model has ``shares`` of the masses."""
    L, p = ql.learners, numbers(shares)
    both = L.RLS(AllAxes(State() + Polynomial(2)) + Bias())
    kinds = ("computed torque", "with integrator", "adaptive")
    return {
        **{kind: ModelBased(kind, p, omega_c) for kind in kinds},
        "ADRC": axes(shares, omega_c),
        "ADRC, Harmonic": axes(shares, omega_c, L.Harmonic()),
        "ADRC, RLS of both": axes(shares, omega_c, of_both=both),
    }


def run(controller: Any, seconds: float) -> dict[str, list[float]]:
    """Return the figures of a controller on the true arm: errors [mrad], changes of u [N m/s]."""
    rng, p, x = np.random.default_rng(0), numbers().tolist(), [0.0] * 4
    count = round(seconds / DT)
    errors, u = np.empty((count, 2)), np.zeros((count, 2))
    for k in range(count):
        phase = OMEGAS * (k * DT)
        r, dr = SIZES * np.sin(phase), SIZES * OMEGAS * np.cos(phase)
        y = np.add(x[:2], NOISE * rng.standard_normal(2))
        u[k] = controller.step(r, y, dr, -(OMEGAS**2) * r)
        errors[k] = r - x[:2]
        x = moved(p, x, u[k])
    half, first = count // 2, round(min(FIRST, 0.5 * seconds) / DT)
    rms = {
        "late [mrad]": 1e3 * np.sqrt(np.mean(errors[half:] ** 2, axis=0)),
        "first 5 s [mrad]": 1e3 * np.sqrt(np.mean(errors[:first] ** 2, axis=0)),
        "change of u [N m/s]": np.sum(np.abs(np.diff(u[half:], axis=0)), axis=0)
        / ((count - half) * DT),
    }
    return {name: values.tolist() for name, values in rms.items()}


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--omega-c", type=float, default=8.0)
    options = options_of(parser, seconds=0.2)
    dispatch.interpret_all = options.quick
    figures: dict[str, Any] = {}
    for name, shares in MODELS.items():
        figures[name] = {}
        table = Table("controller", "late", "first 5 s", "change of u", title=f"Model {name}")
        for label, controller in controllers(shares, options.omega_c).items():
            found = run(controller, options.seconds)
            table.add_row(label, *("; ".join(f"{v:.2f}" for v in each) for each in found.values()))
            figures[name][label] = found
        Console(width=100).print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
