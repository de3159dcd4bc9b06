"""State feedback of several inputs, and the regulator equations."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag, expm, solve_discrete_are

from quell.controllers import quadratic_feedback, regulator, state_feedback
from quell.observers.eso import ESO

from .benchmark_module import benchmark
from .cases import cases
from .test_multivariable_observer import DT, ENCODERS, JL, JM, LOAD, SERVO, TORQUE, K

AT_LOAD = ENCODERS[1:]


def test_a_load_is_carried_through_the_spring() -> None:
    """A torque on the load of a servo: u is against it, and the coupling is wound up by d/k."""
    found = regulator(SERVO, TORQUE, AT_LOAD, LOAD)
    np.testing.assert_allclose(found.Gamma, [[-1.0]], rtol=1e-9)
    np.testing.assert_allclose(found.Pi[:, 0], [-1.0 / K, 0, 0, 0], atol=1e-9 / K)
    np.testing.assert_allclose(found.X[:, 0], [1, 0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(found.U, [[0.0]], atol=1e-9)


def test_a_matched_disturbance_is_cancelled_at_its_place() -> None:
    """Π = 0 and B Γ = −E, in all derivatives."""
    found = regulator(SERVO, TORQUE, AT_LOAD, 3.0 * TORQUE, disturbance_order=2)
    np.testing.assert_allclose(found.Gamma, [[-3.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(found.Pi, np.zeros((4, 2)), atol=1e-12)


def test_each_derivative_of_a_load_adds_its_part() -> None:
    """With w = (d, d', d'') the equations with S hold: A Π + B Γ + Ē = Π S, C Π = 0.

    The part of d'' is the motor's inertia times the acceleration that winds up the spring.
    """
    found = regulator(SERVO, TORQUE, AT_LOAD, LOAD, disturbance_order=3)
    S, E = np.diag([1.0, 1.0], 1), np.hstack([LOAD, np.zeros((4, 2))])
    left = SERVO @ found.Pi + TORQUE @ found.Gamma + E - found.Pi @ S
    assert np.max(np.abs(left)) < 1e-9 * np.max(np.abs(E))
    assert np.max(np.abs(AT_LOAD @ found.Pi)) < 1e-12
    no_damping = SERVO.copy()
    no_damping[1, [1, 3]] = no_damping[3, [1, 3]] = 0.0
    found = regulator(no_damping, TORQUE, AT_LOAD, LOAD, disturbance_order=3)
    np.testing.assert_allclose(found.Gamma, [[-1.0, 0.0, -JM / K]], rtol=1e-9, atol=1e-12)


def test_random_plants_satisfy_the_equations() -> None:
    """50 plants with more inputs than outputs, or as many; Γ is not longer than another one."""
    random = np.random.default_rng(7)
    for _ in range(50):
        outputs, q = int(random.integers(1, 4)), int(random.integers(1, 4))
        n, m = int(random.integers(4, 8)), outputs + int(random.integers(0, 2))
        A, B, C, E = (random.normal(size=s) for s in ((n, n), (n, m), (outputs, n), (n, q)))
        found = regulator(A, B, C, E)
        np.testing.assert_allclose(A @ found.Pi + B @ found.Gamma + E, 0.0, atol=1e-8)
        np.testing.assert_allclose(C @ found.X, np.eye(outputs), atol=1e-8)
        whole = np.block([[A, B], [C, np.zeros((outputs, m))]])
        wanted = np.vstack([-E, np.zeros((outputs, q))])
        least = np.linalg.lstsq(whole, wanted, rcond=None)[0][n:]
        assert np.all(np.linalg.norm(found.Gamma, axis=0) <= np.linalg.norm(least, axis=0) + 1e-8)


def test_what_no_u_does_is_named() -> None:
    """A zero at the origin, and more outputs than inputs."""
    with pytest.raises(ValueError, match=r"no u keeps d1 from .* 1 inputs for 2 outputs"):
        regulator(SERVO, TORQUE, ENCODERS, LOAD)
    with pytest.raises(ValueError, match="no u moves z1 to a constant r.*invariant zero at s = 0"):
        regulator(SERVO, TORQUE, [0.0, 1.0, 0.0, 0.0], TORQUE)
    with pytest.raises(ValueError, match="E has shape"):
        regulator(SERVO, TORQUE, AT_LOAD, np.eye(3))


@pytest.mark.parametrize(("omega_c", "dt"), [(20.0, DT), (120.0, DT), (120.0, 1e-3)])
def test_all_poles_of_a_servos_loop_lie_in_one_place(omega_c: float, dt: float) -> None:
    """So says the characteristic polynomial of ``Φ − Γ K`` about z = 1."""
    gain = state_feedback(SERVO, TORQUE, omega_c, dt)
    held = expm(np.block([[SERVO, TORQUE], [np.zeros((1, 5))]]) * dt)
    scale = np.array([1.0, omega_c, 1.0, omega_c])
    error = (held[:4, :4] - held[:4, 4:] @ gain - np.eye(4)) * scale / scale[:, None]
    found = np.poly(error / -math.expm1(-omega_c * dt))
    np.testing.assert_allclose(found, [1, 4, 6, 4, 1], atol=1e-3)


@cases("dt", [DT, 1e-3])
@cases("omega_c", [30.0, 120.0, 400.0])
def test_the_quadratic_feedback_is_that_of_the_riccati_equation(omega_c: float, dt: float) -> None:
    """SciPy's solution for a servo, and the rigid axis' bandwidth where that is slow."""
    weight, control = AT_LOAD.T @ AT_LOAD, 1.0 / ((JM + JL) ** 2 * omega_c**4)
    gain = quadratic_feedback(SERVO, TORQUE, weight, control, dt)
    held = expm(np.block([[SERVO, TORQUE], [np.zeros((1, 5))]]) * dt)
    phi, gamma = held[:4, :4], held[:4, 4:]
    P = solve_discrete_are(phi, gamma, weight, [[control]])
    wanted = np.linalg.solve(control + gamma.T @ P @ gamma, gamma.T @ P @ phi)
    np.testing.assert_allclose(gain, wanted, rtol=1e-5, atol=1e-6 * np.max(np.abs(wanted)))
    slow = np.sort(np.abs(np.log(np.linalg.eigvals(phi - gamma @ gain).astype(complex))))[0] / dt
    assert slow == pytest.approx(omega_c, rel=0.1)


def test_axes_that_are_not_coupled_have_gains_of_their_own() -> None:
    """Two double integrators: ω_c² and 2 ω_c over each axis' own gain."""
    A = block_diag(*[np.diag([1.0], 1)] * 2)
    B = np.array([[0.0, 0.0], [50.0, 0.0], [0.0, 0.0], [0.0, 0.2]])
    gain = state_feedback(A, B, 30.0, 1e-6)
    wanted = [[900 / 50, 60 / 50, 0, 0], [0, 0, 900 / 0.2, 60 / 0.2]]
    np.testing.assert_allclose(gain, wanted, rtol=1e-3, atol=1e-6)


@cases(
    ("call", "message"),
    [
        (lambda: state_feedback(SERVO, [0.0] * 4, 20.0, DT), "u must move all states"),
        (lambda: state_feedback(SERVO, TORQUE, 0.0, DT), "omega_c = 0.0"),
        (lambda: state_feedback(SERVO, TORQUE, 20.0, -1.0), "dt = -1.0"),
        (lambda: quadratic_feedback(SERVO, TORQUE, np.eye(4), 0.0, DT), "control_weight = 0.0"),
        (lambda: quadratic_feedback(SERVO, TORQUE, np.eye(3), 1.0, DT), "state_weight has shape"),
        (lambda: quadratic_feedback(SERVO, TORQUE, 0.0 * SERVO, 1.0, DT), "state_weight must see"),
        (lambda: state_feedback(SERVO, [1.0], 20.0, DT), "B has shape"),
    ],
)
def test_bad_arguments_of_a_state_feedback_are_named(call: Any, message: str) -> None:
    """With their value and the rule."""
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.trial
def test_a_servo_under_a_load_comes_back_to_its_reference() -> None:
    """Observer, regulator and state feedback together: no error remains under a load of 0.2 N m.

    ``ESO.state_space`` with an encoder at the load finds the load and, with both torques, the
    friction of the motor.
    """
    observer = ESO.state_space(
        SERVO,
        TORQUE,
        ENCODERS,
        np.hstack([TORQUE, LOAD]),
        DT,
        noise_variance=[1e-12] * 2,
        drift=[1.0, 1.0],
    )
    law = regulator(SERVO, TORQUE, AT_LOAD, observer.E)
    gain = state_feedback(SERVO, TORQUE, 60.0, DT)
    inputs = np.hstack([TORQUE, LOAD])
    held = expm(np.block([[SERVO, inputs], [np.zeros((2, 6))]]) * DT)
    running, x, u, r = observer.estimator(), np.zeros(4), 0.0, 0.5
    running.start([0.0, 0.0], [0.0])
    for k in range(4000):
        load = 0.2 if k > 1000 else 0.0
        x = held[:4, :4] @ x + held[:4, 4:] @ [u - 0.05, load]
        running.step(ENCODERS @ x, [u])
        aim = law.X[:, 0] * r + law.Pi @ running.d
        u = float((law.U * r)[0, 0] + law.Gamma[0] @ running.d - gain[0] @ (running.x - aim))
    assert x[2] == pytest.approx(0.5, abs=1e-9)
    assert x[0] - x[2] == pytest.approx(-0.2 / K, abs=1e-9)


def test_a_second_encoder_brings_margins_to_a_known_linear_axis_and_no_more() -> None:
    """Peak and noise with the load's encoder alone are those with both; M_s is 18 against 1.9.

    (A short version of ``benchmarks/second_encoder.py``.)
    """
    trial = benchmark("second_encoder")
    names = "load's encoder, d on the load", "both, d on the load"
    alone, both = (trial.linear(trial.law_of(*trial.DESIGNS[name], 80.0, 0.1)) for name in names)
    assert both.peak == pytest.approx(alone.peak, rel=1e-3)
    assert both.noise == pytest.approx(alone.noise, rel=2e-3)
    assert both.peak_sensitivity < 2.0 < 10.0 < alone.peak_sensitivity


@pytest.mark.trial
@pytest.mark.compiled
def test_two_encoders_hold_a_load_behind_play_and_friction() -> None:
    """With a disturbance at each side the load rests within a fifth of the motor encoder's error."""
    trial = benchmark("second_encoder")
    random = np.random.default_rng(9)
    machines = [trial.draw(random) for _ in range(3)]
    settings = {"motor's encoder, d at the motor": (120.0, 100.0), "both, d at both": (400.0, 1.0)}
    one, two = (
        [trial.run(trial.law_of(*trial.DESIGNS[name], *design), each, 2.0) for each in machines]
        for name, design in settings.items()
    )
    for alone, both in zip(one, two, strict=True):
        assert both.resting < 0.2 * alone.resting
