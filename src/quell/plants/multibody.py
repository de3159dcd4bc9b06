"""Machines with coupled axes: a planar arm with rigid or elastic joints, the attitude of a craft.

*A planar arm* of n links. θ_i = q_1 + … + q_i is the angle of link i against the horizontal, l_i
its length, c_i the distance of its centre of mass from its joint, m_i its mass and I_i its inertia
about that centre. With

    a_ii = I_i + m_i c_i² + l_i² Σ_(k>i) m_k,      a_ij = l_i (m_j c_j + l_j Σ_(k>j) m_k),  i < j
    g_i = γ (m_i c_i + l_i Σ_(k>i) m_k)

the equations in the angles of the joints q follow from Lagrange's for θ (Spong, Hutchinson &
Vidyasagar, *Robot Modeling and Control*, 2nd ed., ch. 6)::

    M(q) q'' + c(q, q') + G(q) + d_v q' + F_c tanh(q'/v) = τ + w
    M_ab = J_a δ_ab + Σ_(i≥a) Σ_(j≥b) a_ij cos(θ_i − θ_j)
    c_a = Σ_(i≥a) Σ_j a_ij sin(θ_i − θ_j) θ_j'²,       G_a = Σ_(i≥a) g_i cos θ_i

J_a is the inertia of the motor and gear of joint a, seen at the joint. A joint with a finite
stiffness k has a motor with the angle φ before it (Spong, *J. Dyn. Sys. Meas. Control* 109, 1987)::

    J φ'' = u − k (φ − q) − d (φ' − q'),       τ = k (φ − q) + d (φ' − q')

*Attitude of a craft* with the body's rates Ω and inertias I::

    I Ω' = K T − Ω × (I Ω) + w,       φ' = p + tan ϑ (q sin φ + r cos φ),
    ϑ' = q cos φ − r sin φ,           ψ' = (q sin φ + r cos φ)/cos ϑ

T are the thrusts of the rotors, which follow u with a time constant, and K (3, m) their arms
(Stevens, Lewis & Johnson, *Aircraft Control and Simulation*, 3rd ed., eq. 1.3-22).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numba
import numpy as np

from quell import checks
from quell.plants.nonlinear import NonlinearPlant
from quell.types import Matrix, Vector

# ---- A planar arm ----


class Arm(NonlinearPlant):
    """A planar arm; make it with ``arm``.

    The states are the angles of the joints, their rates, then angles and rates of the motors of
    elastic joints. u are the torques of the motors, w further torques at the links.

    Its numbers are ``parameters`` of compiled code that all arms share: however many arms are made,
    one of each number of links is compiled.
    """

    @property
    def inertia(self) -> Callable[[Matrix], Matrix]:
        """The function M(x) of the arm for ``quell.Axes(M=…)``, of ``x[axis, derivative]``.

        It is the inertia that u meets at low frequencies: with the motors behind elastic joints.
        """
        numbers: Any = self.parameters
        return partial(_inertia, a=numbers["a"], motor=numbers["joints"][_MOTOR])

    def mass_matrix(self, q: Any) -> Matrix:
        """Return M(q) (n, n) [kg m²] for angles of the joints (n,) [rad]."""
        angles = checks.vector("q", q, self.inputs)
        return np.asarray(self.inertia(angles[:, None].copy()))


def arm(
    lengths: Sequence[float] = (0.4, 0.3),
    masses: Sequence[float] = (2.0, 1.0),
    *,
    centres: Sequence[float] | None = None,
    inertias: Sequence[float] | None = None,
    gravity: float = 9.81,
    viscous: float | Sequence[float] = 0.0,
    coulomb: float | Sequence[float] = 0.0,
    coulomb_width: float = 0.01,
    motor_inertia: float | Sequence[float] = 0.0,
    stiffness: float | Sequence[float] = math.inf,
    damping: float | Sequence[float] = 0.0,
    payload: float = 0.0,
    encoders: str = "motor",
    substeps: int | None = None,
    name: str = "",
) -> Arm:
    """Return a planar arm of n links with a motor at each joint.

    Parameters
    ----------
    lengths
        of the links [m].
    masses
        of the links [kg].
    centres
        distance of each centre of mass from the joint before it [m]; half of the length by default.
    inertias
        of the links about their centres of mass [kg m²]; of slender rods by default, m l²/12.
    gravity
        [m/s²], in the plane of the arm; 0 for a horizontal plane.
    viscous, coulomb
        friction of the joints [N m s/rad], [N m]; one for all or one for each.
    coulomb_width
        speed v at which three quarters of the Coulomb friction act [rad/s].
    motor_inertia
        of motor and gear, seen at the joint [kg m²].
    stiffness
        of the joints [N m/rad]; infinite for rigid joints. One that is finite needs a motor
        inertia.
    damping
        of elastic joints [N m s/rad].
    payload
        mass at the tip [kg].
    encoders
        where the angles are measured: ``"motor"``, ``"link"``, or ``"both"``, with the motors'
        first. At a rigid joint motor and link have one angle.
    substeps, name
        as for ``NonlinearPlant``.

    Raises
    ------
    ValueError
        for vectors of different lengths and values out of range.

    Examples
    --------
    >>> import quell as ql
    >>> robot = ql.plants.arm(lengths=(0.4, 0.3), masses=(2.0, 1.0), gravity=0.0)
    >>> robot.order, robot.inputs, robot.outputs
    (4, 2, 2)
    >>> robot.mass_matrix([0.0, 0.5]).round(4).tolist()
    [[0.402, 0.0827], [0.0827, 0.03]]
    """
    link = checks.positive_vector("lengths", lengths)
    n = link.size
    mass = checks.positive_vector("masses", masses)
    centre = 0.5 * link if centres is None else checks.vector("centres", centres, n)
    rods = mass * link**2 / 12.0 if mass.size == n else mass
    about = rods if inertias is None else checks.vector("inertias", inertias, n)
    for what, values in (("masses", mass), ("inertias", about)):
        checks.vector(what, values, n)
        if np.any(values < 0.0):
            raise ValueError(f"{what} = {values.tolist()!r}: must not be negative")
    motor = _each("motor_inertia", motor_inertia, n)
    spring = _each("stiffness", stiffness, n, finite=False)
    elastic = np.isfinite(spring)
    if np.any(elastic & ~((motor > 0.0) & (spring > 0.0))):
        raise ValueError(
            f"stiffness = {stiffness!r}, motor_inertia = {motor_inertia!r}: an elastic joint needs "
            "a stiffness and a motor inertia above zero"
        )
    checks.one_of("encoders", encoders, ("motor", "link", "both"))
    load = checks.non_negative("payload", payload, "kg")
    a, g = _coefficients(link, mass, centre, about, load)
    g = g * checks.finite("gravity", gravity)
    friction = (_each("viscous", viscous, n), _each("coulomb", coulomb, n))
    width = checks.positive("coulomb_width", coulomb_width, "rad/s")
    rigid_inertia = np.where(elastic, 0.0, motor)
    order = 2 * n + 2 * int(np.sum(elastic))
    parts = (motor, np.where(elastic, spring, 0.0), _each("damping", damping, n), elastic)
    parameters = {
        "a": a, "g": g, "friction": np.array(friction), "width": width,
        "joints": np.array([*parts, rigid_inertia], dtype=np.float64),
    }  # fmt: skip
    return Arm(
        _arm_rate if n > 1 else _rate_of_one_link, order, _encoder_rows(encoders, elastic, order),
        n, substeps, name or f"arm of {checks.counted(n, 'link')}", parameters, inputs=n,
    )  # fmt: skip


def _rate_of_one_link(t, x, u, w, a, g, friction, width, joints):  # type: ignore[no-untyped-def]
    return _arm_rate(t, x, np.full(1, u), w, a, g, friction, width, joints)  # type: ignore[no-untyped-call]


def _each(name: str, value: Any, count: int, *, finite: bool = True) -> Vector:
    """Return one value for each joint, not negative."""
    given = [value] * count if np.ndim(value) == 0 else value
    try:
        values = np.array(given, dtype=float)
    except (TypeError, ValueError):
        values = np.full(count, np.nan)
    if values.shape != (count,) or not np.all(values >= 0.0) or (finite and np.any(values > 1e300)):
        raise ValueError(
            f"{name} = {value!r}: must be one number, or one for each of the {count} joints, not "
            "negative"
        )
    return values


def _coefficients(
    link: Vector, mass: Vector, centre: Vector, about: Vector, load: float
) -> tuple[Matrix, Vector]:
    """Return a (n, n) and g (n,) for a gravity of one."""
    n = link.size
    beyond = np.array([np.sum(mass[i + 1 :]) + load for i in range(n)])
    moment = mass * centre + link * beyond
    a = np.zeros((n, n))
    for i in range(n):
        a[i, i] = about[i] + mass[i] * centre[i] ** 2 + link[i] ** 2 * beyond[i]
        for j in range(i + 1, n):
            a[i, j] = a[j, i] = link[i] * moment[j]
    return a, moment


def _encoder_rows(encoders: str, elastic: Any, order: int) -> Matrix:
    """Return the matrix C of what is measured."""
    n, unit = elastic.size, np.eye(order)
    motors = np.cumsum(elastic) - 1 + 2 * n
    of_motors = unit[np.where(elastic, motors, np.arange(n))]
    of_links = unit[:n]
    rows = {"motor": of_motors, "link": of_links, "both": np.vstack([of_motors, of_links])}
    return rows[encoders]


# Rows of the parameters of the joints: inertia and stiffness of the motors, damping, whether a
# joint is elastic, and the inertia of motors without a spring before them.
_MOTOR, _SPRING, _DAMPING, _ELASTIC, _RIGID = range(5)


def _inertia(x, a, motor):  # type: ignore[no-untyped-def]
    n = motor.size
    M = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            between = 0.0  # θ_i − θ_j
            for k in range(min(i, j) + 1, max(i, j) + 1):
                between += x[k, 0]
            share = a[i, j] * math.cos(between)
            for row in range(i + 1):
                for column in range(j + 1):
                    M[row, column] += share
        M[i, i] += motor[i]
    return M


@numba.njit(error_model="numpy")
def _solved(M, b):  # type: ignore[no-untyped-def]
    """Solve M x = b for a positive definite M by Gauss; both are overwritten."""
    n = b.size
    for k in range(n):
        for i in range(k + 1, n):
            factor = M[i, k] / M[k, k]
            for j in range(k, n):
                M[i, j] -= factor * M[k, j]
            b[i] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= M[k, j] * b[j]
        b[k] /= M[k, k]
    return b


def _arm_rate(t, x, u, w, a, g, friction, width, joints):  # type: ignore[no-untyped-def]
    n = g.size
    dx, M, tau = np.zeros(x.size), np.zeros((n, n)), np.zeros(n)
    at = 2 * n
    for i in range(n):
        dx[i] = x[n + i]
        tau[i] = u[i]
        if joints[_ELASTIC, i] != 0.0:
            twist, speed = x[at] - x[i], x[at + 1] - x[n + i]
            tau[i] = joints[_SPRING, i] * twist + joints[_DAMPING, i] * speed
            dx[at] = x[at + 1]
            dx[at + 1] = (u[i] - tau[i]) / joints[_MOTOR, i]
            at += 2
        viscous, coulomb = friction[0, i], friction[1, i]
        tau[i] += w[i] - viscous * x[n + i] - coulomb * math.tanh(x[n + i] / width)
        M[i, i] += joints[_RIGID, i]
    theta = 0.0
    for i in range(n):
        theta += x[i]
        weight = g[i] * math.cos(theta)
        other = omega = 0.0
        for j in range(n):
            other += x[j]
            omega += x[n + j]
            weight += a[i, j] * math.sin(theta - other) * omega * omega
            share = a[i, j] * math.cos(theta - other)
            for row in range(i + 1):
                for column in range(j + 1):
                    M[row, column] += share
        for row in range(i + 1):
            tau[row] -= weight
    acceleration = _solved(M, tau)
    for i in range(n):
        dx[n + i] = acceleration[i]
    return dx


# ---- The attitude of a craft with rotors ----


class Craft(NonlinearPlant):
    """The attitude of a craft; make it with ``quadrotor_attitude``."""

    @property
    def B0(self) -> Matrix:  # noqa: N802
        """The matrix from the thrusts to the angles near the horizontal, K/I [rad/s² per N]."""
        numbers: Any = self.parameters
        return numbers["lever"] / numbers["inertia"][:, None]


def quadrotor_attitude(
    inertia: Sequence[float] = (0.012, 0.012, 0.022),
    arm: float = 0.17,
    *,
    drag: float = 0.015,
    motor_lag: float = 0.02,
    name: str = "quadrotor attitude",
) -> Craft:
    """Return the attitude of a quadrotor with rotors at the corners of a square.

    The outputs are roll, pitch and yaw [rad]; the control signals are the commanded thrusts of the
    rotors [N], front right, rear right, rear left and front left, of which the first and the third
    turn one way and the others the other way; the disturbances are torques about the body's axes
    [N m]. The states are the angles, the body's rates and the thrusts.

    Parameters
    ----------
    inertia
        about the body's axes [kg m²].
    arm
        distance of the rotors from the centre [m].
    drag
        torque about the rotor's axis over its thrust [m].
    motor_lag
        time constant of the thrusts [s].

    Examples
    --------
    >>> import quell as ql
    >>> craft = ql.plants.quadrotor_attitude()
    >>> craft.order, craft.inputs, craft.outputs
    (10, 4, 3)
    """
    about = checks.vector("inertia", checks.positive_vector("inertia", inertia), 3)
    lag = checks.positive("motor_lag", motor_lag, "s")
    lever = rotor_levers(arm, drag)
    parameters = {"inertia": about, "lever": lever, "lag": lag}
    return Craft(_craft_rate, 10, np.eye(10)[:3], 3, None, name, parameters, inputs=4)


def _craft_rate(t, x, u, w, inertia, lever, lag):  # type: ignore[no-untyped-def]
    dx = np.zeros(10)
    ixx, iyy, izz = inertia[0], inertia[1], inertia[2]
    roll, pitch = x[0], x[1]
    p, q, r = x[3], x[4], x[5]
    turn = q * math.sin(roll) + r * math.cos(roll)
    dx[0] = p + math.tan(pitch) * turn
    dx[1] = q * math.cos(roll) - r * math.sin(roll)
    dx[2] = turn / math.cos(pitch)
    torque = np.zeros(3)
    for i in range(3):
        torque[i] = w[i]
        for j in range(4):
            torque[i] += lever[i, j] * x[6 + j]
    dx[3] = (torque[0] + (iyy - izz) * q * r) / ixx
    dx[4] = (torque[1] + (izz - ixx) * r * p) / iyy
    dx[5] = (torque[2] + (ixx - iyy) * p * q) / izz
    for j in range(4):
        dx[6 + j] = (u[j] - x[6 + j]) / lag
    return dx


def rotor_levers(arm: float, drag: float) -> Matrix:
    """Return the torques about the body's axes of a thrust of 1 N of each rotor, K (3, 4) [m].

    Parameters are those of ``quadrotor_attitude``; with inertias I the matrix B0 of three axes near
    the horizontal is ``K / I[:, None]``.
    """
    side = checks.positive("arm", arm, "m") * math.sqrt(0.5)
    turn = checks.non_negative("drag", drag, "m")
    return np.array(
        [[-side, -side, side, side], [side, -side, -side, side], [-turn, turn, -turn, turn]]
    )
