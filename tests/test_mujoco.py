"""A second opinion on physics: plants of MuJoCo, controlled by ``controller.step``.

MuJoCo makes the equations of motion from a description of bodies and joints and integrates them. Its accelerations (``qacc``) tell the
total disturbance f = y⁽ⁿ⁾ − b0 u, without any model of quell. An ESO of order n estimates f late: f̂ is f behind n + 1 lags of 1/omega_o,
a kernel that is not negative, with mean T = (n + 1)/omega_o and variance T/omega_o. So, from rest,

    |f̂(t) − f(t)| ≤ T sup|f'|,        |f̂(t) − f(t − T)| ≤ T/(2 omega_o) sup|f''|

Sampling adds a sample to T at most. Nothing else makes these tolerances: there is no noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql

mujoco = pytest.importorskip("mujoco", reason="MuJoCo, the second opinion on physics, is missing")

HEAD = '<option timestep="{dt}" integrator="RK4" gravity="0 0 {gravity}"><flag contact="disable"/></option>'
TWO_MASSES = f"""
<mujoco>{HEAD}
  <worldbody>
    <body><joint name="x1" type="slide" axis="1 0 0"/><geom type="sphere" size="0.1" mass="{{m1}}"/></body>
    <body><joint name="x2" type="slide" axis="1 0 0"/><geom type="sphere" size="0.1" mass="{{m2}}"/></body>
  </worldbody>
  <tendon>
    <fixed stiffness="{{k}}" springlength="0"><joint joint="x1" coef="1"/><joint joint="x2" coef="-1"/></fixed>
  </tendon>
  <actuator><motor joint="x1"/></actuator>
</mujoco>
"""
FLEXIBLE_JOINT = f"""
<mujoco>{HEAD}
  <worldbody>
    <body>
      <joint name="motor" axis="0 1 0" damping="0.2"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.3 0.3 0.3"/>
    </body>
    <body>
      <joint name="link" axis="0 1 0"/>
      <inertial pos="0 0 -0.4" mass="1.5" diaginertia="0.02 0.02 0.02"/>
    </body>
  </worldbody>
  <tendon>
    <fixed stiffness="120" springlength="0"><joint joint="motor" coef="1"/><joint joint="link" coef="-1"/></fixed>
  </tendon>
  <actuator><motor joint="motor"/></actuator>
</mujoco>
"""
CART_POLE = f"""
<mujoco>{HEAD}
  <worldbody>
    <body>
      <joint name="cart" type="slide" axis="1 0 0" damping="0.5"/>
      <geom type="box" size="0.2 0.1 0.1" mass="1"/>
      <body>
        <joint name="pole" axis="0 1 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.8" size="0.03" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="cart"/></actuator>
</mujoco>
"""


class Run(NamedTuple):
    """What MuJoCo and the controller have at each sample."""

    t: Any
    y: Any
    u: Any
    f_hat: Any
    highest: Any  # y⁽ⁿ⁾, from MuJoCo's accelerations with the u of this sample


def run(
    model: Any,
    controller: ql.ADRC,
    reference: Callable[[float], float],
    joint: int,
    highest: Callable[[Any], float],
    duration: float,
    force: Callable[[float], float] = lambda t: 0.0,
) -> Run:
    """Return a run from rest with u held over each sample; ``force`` acts on the joint of y."""
    data, rows = mujoco.MjData(model), []
    dt = model.opt.timestep
    for i in range(round(duration / dt)):
        t, y = i * dt, float(data.qpos[joint])
        data.ctrl[0] = u = controller.step(reference(t), y)
        data.qfrc_applied[joint] = force(t)
        mujoco.mj_forward(model, data)
        rows.append((t, y, u, controller.estimate.f, highest(data)))
        mujoco.mj_step(model, data)
    return Run(*np.array(rows).T)


def check_estimate(found: Run, controller: ql.ADRC) -> None:
    """f̂ is f within what its lag explains, and f a lag ago within what the lag's spread explains."""
    observer, dt = controller.observer, controller.dt
    f = found.highest - observer.b0 * found.u
    lag = (observer.order + 1) / observer.omega_o
    first = np.gradient(f, dt)
    second = np.gradient(first, dt)
    bound = (lag + dt) * np.max(np.abs(first))
    assert np.max(np.abs(found.f_hat - f)) <= bound
    late = np.interp(found.t - lag, found.t, f)
    closer = 0.5 * lag / observer.omega_o * np.max(np.abs(second)) + dt * np.max(np.abs(first))
    assert np.max(np.abs(found.f_hat - late)) <= closer
    # The bounds say something: f is many times as large, and a lag of no length would not do.
    assert closer < 0.15 * np.max(np.abs(f))
    assert np.max(np.abs(found.f_hat - f)) > closer


@pytest.mark.trial
@pytest.mark.parametrize("learner", [None, ql.learners.Kalman()])
def test_two_masses_of_mujoco_move_as_those_of_quell(learner: Any) -> None:
    """With ``step`` in the loop y and u agree with ``simulate``, with a guarded learner, too: 0.1 m under a force to 1e-9 m."""
    dt, m1, m2, k = 5e-3, 0.7, 1.8, 1.3
    plant = ql.plants.two_mass_spring(m1=m1, m2=m2, k=k)
    observer = ql.ESO.model_free(order=4, b0=k / (m1 * m2), omega_o=8.0, dt=dt)
    guard = None if learner is None else ql.Guard()
    controller = ql.ADRC(observer, omega_c=1.0, learner=learner, guard=guard)
    model = mujoco.MjModel.from_xml_string(TWO_MASSES.format(dt=dt, gravity=0, m1=m1, m2=m2, k=k))
    found = run(model, controller, math.sin, 1, lambda data: 0.0, 10.0, lambda t: 0.3 * (t >= 6.0))
    scenario = ql.Scenario(
        reference=ql.signals.Sinusoid(),
        disturbances=(0.0, ql.signals.Step(0.3, at=6.0)),
        duration=10.0,
    )
    own = ql.simulate(plant, controller, scenario)
    count = found.t.size
    assert np.max(np.abs(found.y)) > 0.1
    np.testing.assert_allclose(own["y"][:count], found.y, atol=1e-9)
    np.testing.assert_allclose(own["u"][:count], found.u, atol=1e-6)


def test_f_of_two_masses_is_that_of_mujoco() -> None:
    """The encoder at the load: y'''' = k (x1'' − x2'')/m2 from the accelerations of both masses."""
    dt, m1, m2, k = 5e-3, 0.7, 1.8, 1.3
    model = mujoco.MjModel.from_xml_string(TWO_MASSES.format(dt=dt, gravity=0, m1=m1, m2=m2, k=k))
    observer = ql.ESO.model_free(order=4, b0=k / (m1 * m2), omega_o=20.0, dt=dt)
    controller = ql.ADRC(observer, omega_c=1.5)

    def highest(data: Any) -> float:
        return k * float(data.qacc[0] - data.qacc[1]) / m2

    found = run(model, controller, lambda t: 0.5 - 0.5 * math.cos(t), 1, highest, 12.0)
    check_estimate(found, controller)


@pytest.mark.trial
def test_f_of_a_flexible_joint_is_that_of_mujoco() -> None:
    """A link that swings in gravity, driven through a spring: f contains sin(q), the motor's friction and the spring."""
    dt, gravity = 1e-3, 9.81
    model = mujoco.MjModel.from_xml_string(FLEXIBLE_JOINT.format(dt=dt, gravity=-gravity))
    motor, link = 1.0 / np.diag(accelerations_of_unit_forces(model))
    k = 120.0
    weight = 1.5 * gravity * 0.4
    observer = ql.ESO.model_free(order=4, b0=k / (motor * link), omega_o=80.0, dt=dt)
    controller = ql.ADRC(observer, omega_c=8.0)

    def highest(data: Any) -> float:
        # link q'' = −weight sin(q) − k (q − θ), twice differentiated.
        q, speed, acceleration = data.qpos[1], data.qvel[1], data.qacc[1]
        turning = math.cos(q) * acceleration - math.sin(q) * speed**2
        return float(-weight * turning - k * (acceleration - data.qacc[0])) / link

    found = run(model, controller, lambda t: 0.6 - 0.6 * math.cos(2.0 * t), 1, highest, 4.0)
    assert np.max(np.abs(found.y)) > 1.0  # sin(q) is not q
    check_estimate(found, controller)


@pytest.mark.trial
def test_f_of_a_cart_pole_is_that_of_mujoco() -> None:
    """The pole upright, unstable without control: f contains gravity, the cart's friction, and the change of the input gain."""
    dt = 1e-3
    model = mujoco.MjModel.from_xml_string(CART_POLE.format(dt=dt, gravity=-9.81))
    b0 = float(accelerations_of_unit_forces(model)[1, 0])
    observer = ql.ESO.model_free(order=2, b0=b0, omega_o=100.0, dt=dt)
    controller = ql.ADRC(observer, omega_c=10.0)
    found = run(
        model,
        controller,
        lambda t: 0.15 - 0.15 * math.cos(3.0 * t),
        1,
        lambda data: float(data.qacc[1]),
        4.0,
        lambda t: 0.1 * math.sin(5.0 * t) ** 2,
    )
    assert np.max(np.abs(found.y)) < 0.5
    check_estimate(found, controller)


def accelerations_of_unit_forces(model: Any) -> Any:
    """Return what a unit force on each joint adds to the accelerations at rest: the inverse of the mass matrix."""
    found = []
    for force in (np.zeros(model.nv), *np.eye(model.nv)):
        data = mujoco.MjData(model)
        data.qfrc_applied[:] = force
        mujoco.mj_forward(model, data)
        found.append(data.qacc.copy())
    return (np.array(found[1:]) - found[0]).T
