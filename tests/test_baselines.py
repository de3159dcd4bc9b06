"""The baselines: each against a closed form, a peer, or what its source promises."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import control
import numpy as np
import pytest

import quell as ql
from quell.controllers import LinearController, Prefiltered
from quell.controllers.baselines import (
    EI,
    LQG,
    MZV,
    PID,
    ZV,
    ZVD,
    Notch,
    NotchPID,
    ResonanceRatio,
    Shaper,
    equivalent_pid,
)
from quell.controllers.baselines.state_feedback import stationary_gain
from quell.lti.models import gramian
from quell.observers import continuous_gain

from .cases import cases

TWO_MASS = ql.plants.two_mass_spring()
LAG = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -1.5]], [0.0, 2.0], [1.0, 0.0])


def loop_poles(controller: LinearController, plant: ql.plants.LinearPlant) -> np.ndarray:
    """Poles in the s-plane of the sampled loop, without limits."""
    law, model, dt = controller.law, plant.sampled(controller.dt), controller.dt
    A, B_y = law.A + np.outer(law.B_u, law.C), law.B_y + law.B_u * law.D_y
    through = np.outer(model.input, model.output) * law.D_y
    matrix = np.block(
        [
            [model.transition + through, np.outer(model.input, law.C)],
            [np.outer(B_y, model.output), A],
        ]
    )
    return np.log(np.linalg.eigvals(matrix).astype(complex)) / dt


def at(controller: PID, omega: float) -> tuple[complex, complex]:
    """Responses of a PID controller in continuous time, from r and from y."""
    numerators, denominator = controller.polynomials()
    return tuple(
        complex(np.polyval(n, 1j * omega) / np.polyval(denominator, 1j * omega)) for n in numerators
    )  # type: ignore[return-value]


# PID
# ------------------------------------------------------------------------------------------------------------------------------


def test_a_pid_controller_is_its_equation() -> None:
    """``(k_p (b R − Y) + k_i/s (R − Y) + k_d s (c R − Y)) / F``, and its sampled response goes there with dt²."""
    controller = PID(2.0, 3.0, 0.5, tf=0.02, b=0.6, c=0.1, dt=1e-3)
    s = 5.0j
    F = 1.0 + 0.02 * s + 0.5 * (0.02 * s) ** 2
    from_r, from_y = at(controller, 5.0)
    assert from_r == pytest.approx((2.0 * 0.6 + 3.0 / s + 0.5 * 0.1 * s) / F)
    assert from_y == pytest.approx(-(2.0 + 3.0 / s + 0.5 * s) / F)
    assert PID(2.0, tf=0.0, dt=0.1).step(1.5, 0.5) == pytest.approx(2.0)


def test_simc_makes_the_loop_that_skogestad_says() -> None:
    """A lag with PI: the loop's time constant is τ_c where no delay is; his example E1 (K_c = 5.5, τ_I = 0.8); the series form."""
    lag = ql.plants.LinearPlant([[-0.5]], [1.0], [1.0])  # gain 2, time constant 2 s
    run = ql.simulate(
        lag, PID.simc(2.0, 2.0, 0.0, tau_c=0.8, dt=1e-3), ql.Scenario(reference=1.0, duration=4.0)
    )
    np.testing.assert_allclose(run["y"], 1.0 - np.exp(-run.t / 0.8), atol=2e-3)
    # 1/((s + 1)(0.2 s + 1)), by the half rule τ1 = 1.1 and θ = 0.1.
    first = PID.simc(1.0, 1.1, 0.1, dt=1e-3)
    assert (first.kp, first.kp / first.ki) == pytest.approx((5.5, 0.8))
    # e^(−0.18 s) / ((1.22 s + 1)(0.22 s + 1)) with τ_c = θ: K_c = 1.22/0.36, τ_I = min(1.22, 1.44),
    # τ_D = 0.22.
    tuned = PID.simc(1.0, 1.22, 0.18, 0.22, dt=1e-3)
    series = 1.22 / 0.36
    assert (tuned.kp, tuned.ki, tuned.kd) == pytest.approx(
        (series * (1 + 0.22 / 1.22), series / 1.22, series * 0.22)
    )


def test_simc_for_a_double_integrator_is_stable_with_its_delay() -> None:
    """The filter is the delay that the rule is told; K_c = 1/(16 k θ²) at τ_c = θ."""
    tuned = PID.simc_double_integrator(2.0, 0.5, dt=0.01, tf=0.5)
    assert tuned.kd == pytest.approx(1.0 / (16.0 * 2.0 * 0.5**2) * 8.0 * 0.5)
    double = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0], [1.0, 0.0])
    assert np.max(loop_poles(tuned, double).real) < -0.05


@pytest.mark.parametrize("order", [1, 2])
def test_a_linear_adrc_is_a_filtered_pid_controller(order: int) -> None:
    """To the last digits, from r and from y, against the state space of law and observer in continuous time."""
    adrc = ql.ADRC(ql.ESO.model_free(order, b0=2.5, omega_o=7.0, dt=1e-3), omega_c=1.3)
    k, size = adrc.parameters.law, order + 1
    gains = np.append(k, 1.0) / 2.5
    A = np.diag(np.ones(order), 1) - np.outer(
        continuous_gain(np.zeros(order), 7.0), np.eye(size)[0]
    )
    B = np.zeros(size)
    B[order - 1] = 2.5
    closed = A - np.outer(B, gains)
    pid = equivalent_pid(adrc)
    for omega in (0.01, 0.3, 5.0, 100.0):
        inner = -np.linalg.solve(
            1j * omega * np.eye(size) - closed,
            np.c_[B * gains[0], continuous_gain(np.zeros(order), 7.0)],
        )
        from_r, from_y = gains @ inner
        assert at(pid, omega) == pytest.approx((gains[0] + from_r, from_y), rel=1e-12)


@pytest.mark.trial
@pytest.mark.parametrize("order", [1, 2])
def test_sampled_adrc_and_its_pid_controller_approach_each_other(order: int) -> None:
    """In a loop with step and load: their difference halves with dt, and is a thousandth at 1 ms."""
    plant = LAG if order == 2 else ql.plants.LinearPlant([[-1.0]], [2.0], [1.0])
    scenario = ql.Scenario(reference=1.0, disturbances=(ql.signals.Step(at=2.0),), duration=4.0)
    gaps = []
    for dt in (2e-3, 1e-3):
        adrc = ql.ADRC(ql.ESO.model_free(order, b0=2.5, omega_o=20.0, dt=dt), omega_c=2.0)
        runs = [ql.simulate(plant, c, scenario)["y"] for c in (adrc, equivalent_pid(adrc))]
        gaps.append(np.max(np.abs(runs[0] - runs[1])))
    assert gaps[1] < 1e-3
    assert gaps[0] / gaps[1] == pytest.approx(2.0, rel=0.1)


# Notch
# ----------------------------------------------------------------------------------------------------------------------------


def test_a_notch_is_as_deep_and_wide_as_it_says() -> None:
    """``depth`` at the centre, in the sampled controller too; about −3 dB at ω (1 ± width/2); a delay below."""
    notch = Notch.at(3.0, depth=0.02, width=0.3)
    plain, notched = PID(2.0, 1.0, dt=0.2), NotchPID(notch, 2.0, 1.0, dt=0.2)
    assert abs(at(notched, 3.0)[1] / at(plain, 3.0)[1]) == pytest.approx(0.02)
    for omega in (3.0 * 0.86, 3.0 * 1.16):
        assert abs(at(notched, omega)[1] / at(plain, omega)[1]) == pytest.approx(
            math.sqrt(0.5), abs=0.02
        )
    low = at(notched, 0.01)[1] / at(plain, 0.01)[1]
    assert -np.angle(low) / 0.01 == pytest.approx(notch.delay, rel=1e-3)
    law = notched.law
    A, z = law.A + np.outer(law.B_u, law.C), np.exp(0.6j)
    sampled = law.C @ np.linalg.solve(z * np.eye(4 - 1) - A, law.B_y + law.B_u * law.D_y) + law.D_y
    assert abs(sampled) == pytest.approx(0.02 * abs(2.0 + 1.0 / 3.0j), rel=1e-9)


def test_a_notch_keeps_a_resonance_from_being_driven() -> None:
    """A soft drive whose PI loop the resonance makes unstable: with the notch it is stable."""
    resonant = ql.plants.LinearPlant(
        np.block(
            [
                [np.array([[-0.5]]), np.zeros((1, 2))],
                [np.array([[0.0], [100.0]]), np.array([[0.0, 1.0], [-100.0, -0.2]])],
            ]
        ),
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
    )
    plain, notched = PID(1.5, 1.0, dt=1e-3), NotchPID(Notch.at(10.0, depth=0.02), 1.5, 1.0, dt=1e-3)
    assert np.max(loop_poles(plain, resonant).real) > 0.0
    assert np.max(loop_poles(notched, resonant).real) < -0.09
    assert notched.name == "PI + notch"


# LQG
# ------------------------------------------------------------------------------------------------------------------------------


def test_the_gains_of_lqg_are_those_of_python_control() -> None:
    """Its ``dlqe``; its ``lqr`` as the sample time goes to zero."""
    mine = LQG(TWO_MASS, 1.2, 6.0, 1e-4)
    K = control.lqr(TWO_MASS.A, TWO_MASS.B, TWO_MASS.C.T @ TWO_MASS.C, [[1.2**-8]])[0]
    np.testing.assert_allclose(mine.K, np.asarray(K)[0], atol=3e-4)
    mine = LQG(TWO_MASS, 1.2, 6.0, 0.02, process_noise=np.diag([0.0, 0.0, 1.0, 2.0]))
    W = np.zeros((5, 5))
    W[:4, :4], W[4, 4] = gramian(TWO_MASS.A, np.diag([0.0, 0.0, 1.0, 2.0]), 0.02), 0.02 * 6.0**10
    L = control.dlqe(mine.model.F, np.eye(5), mine.model.H[None], W, [[50.0]])[0]
    # python-control's gain is the predictor's, F L, or the current one, by its version.
    theirs = np.asarray(L)[:, 0]
    best = min(
        (mine.L, mine.model.F @ mine.L), key=lambda gain: float(np.max(np.abs(gain - theirs)))
    )
    np.testing.assert_allclose(best, theirs, rtol=1e-6)


def test_the_bandwidths_of_lqg_are_its_poles_radii_on_a_chain_of_integrators() -> None:
    """Butterworth patterns: n poles at omega_c, n + 1 at omega_o."""
    chain = ql.plants.LinearPlant(np.diag(np.ones(2), 1), [0.0, 0.0, 4.0], [1.0, 0.0, 0.0])
    radii = np.sort(np.abs(loop_poles(LQG(chain, 2.0, 15.0, 1e-3), chain)))
    np.testing.assert_allclose(radii, [2.0] * 3 + [15.0] * 4, rtol=2e-2)


@pytest.mark.compiled
@pytest.mark.parametrize(
    "make",
    [
        lambda: LQG(TWO_MASS, 1.0, 5.0, 0.01, u_min=-2.0, u_max=2.0),
        lambda: ResonanceRatio(omega_o=5.0, dt=0.01),
    ],
)
def test_the_disturbance_state_takes_out_a_constant_force_wherever_it_acts(make: object) -> None:
    """On either mass, and with a plant that is not quite the model."""
    plant = ql.plants.two_mass_spring(m1=1.1, k=1.1)
    for forces in ((0.3, 0.0), (0.0, 0.3)):
        run = ql.simulate(
            plant, make(), ql.Scenario(reference=1.0, disturbances=forces, duration=150.0)
        )  # type: ignore[operator]
        assert run["y"][-1] == pytest.approx(1.0, abs=1e-3)


# Resonance ratio
# ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("m1", "m2", "k"), [(1.0, 1.0, 1.0), (2.0, 0.5, 3.0)])
def test_at_a_ratio_of_root_five_all_poles_lie_at_the_antiresonance(
    m1: float, m2: float, k: float
) -> None:
    """``(s + ω_a)⁴``: the state feedback in continuous time."""
    plant = ql.plants.two_mass_spring(m1, m2, k)
    K = ResonanceRatio(m1, m2, k, omega_o=20.0, dt=1e-3).K
    np.testing.assert_allclose(
        np.poly(plant.A - plant.B @ K[None]), np.poly([-math.sqrt(k / m2)] * 4), rtol=1e-9
    )


def test_the_load_sees_a_motor_of_another_inertia() -> None:
    """With the motor's position control off, the resonance is H times the anti-resonance."""
    controller = ResonanceRatio(2.0, 0.5, 3.0, omega_o=20.0, dt=1e-3, ratio=3.0)
    plant = ql.plants.two_mass_spring(2.0, 0.5, 3.0)
    kp, kv = 6.0, 4.0 * math.sqrt(6.0)
    torque = controller.K - np.array([2.0 * kp, 0.0, 2.0 * kv, 0.0])
    poles = np.linalg.eigvals(plant.A - plant.B @ torque[None])
    assert np.max(poles.imag) == pytest.approx(3.0 * math.sqrt(6.0), rel=1e-6)


@pytest.mark.compiled
@pytest.mark.trial
@pytest.mark.parametrize("measured", ["load", "motor"])
def test_either_mass_may_be_measured(measured: str) -> None:
    """What is measured goes to the reference under a force on the load, and the loop has the poles it should."""
    c1 = float(measured == "motor")
    plant = ql.plants.two_mass_spring(c1=c1, c2=1.0 - c1)
    controller = ResonanceRatio(omega_o=10.0, dt=1e-3, measured=measured)
    run = ql.simulate(
        plant, controller, ql.Scenario(reference=1.0, disturbances=(0.0, 0.2), duration=60.0)
    )
    assert run["y"][-1] == pytest.approx(1.0, abs=1e-4)
    poles = loop_poles(controller, plant)
    assert np.max(poles.real) < -0.3
    assert np.sum(np.abs(poles + 1.0) < 0.3) >= 4


# Shapers
# --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("omega", "zeta"), [(1.4, 0.0), (5.0, 0.05), (2.0, 0.4)])
@pytest.mark.parametrize("shaper", [ZV, ZVD, MZV, partial(EI, humps=2)])
def test_a_shaper_leaves_no_vibration_of_its_mode(
    shaper: object, omega: float, zeta: float
) -> None:
    """In the formula, and in a mode that is driven by the shaped reference, after the last impulse."""
    made = shaper(omega, zeta)  # type: ignore[operator]
    assert made.residual(omega, zeta) < 1e-12
    assert math.fsum(made.amplitudes) == pytest.approx(1.0)
    mode = ql.plants.LinearPlant(
        [[0.0, 1.0], [-(omega**2), -2.0 * zeta * omega]], [0.0, omega**2], [1.0, 0.0]
    )
    follow = Prefiltered(PID(0.0, setpoint=[0.0, 1.0, 0.0], dt=2e-3), made)  # u = r_shaped
    run = ql.simulate(
        mode, follow, ql.Scenario(reference=1.0, duration=round(made.times[-1] + 3.0, 2))
    )
    assert run["r_shaped"][-1] == pytest.approx(1.0)
    assert np.max(np.abs(run["y"][run.t > made.times[-1] + 4e-3] - 1.0)) < 1e-5


@pytest.mark.parametrize(
    ("made", "published"),
    [
        (partial(EI, humps=1), 0.40),
        (partial(EI, humps=2), 0.73),
        (partial(EI, humps=3), 0.95),
        (ZVD, 0.29),
        (ZV, 0.06),
    ],
)
def test_the_band_in_which_five_per_cent_is_left_is_as_published(
    made: Callable[[float], Shaper], published: float
) -> None:
    """Insensitivity of Singhose and others (1997): width of the band over the frequency, two digits."""
    shaper, omega = made(3.0), 3.0 * np.linspace(0.4, 1.6, 2401)
    left = np.array([shaper.residual(each) for each in omega])
    above = omega[left > 0.05 + 1e-9] / 3.0
    band = np.min(above[above > 1.0]) - np.max(above[above < 1.0])
    assert band == pytest.approx(published, abs=0.016)


@pytest.mark.parametrize("humps", [1, 2, 3])
@pytest.mark.parametrize("zeta", [0.0, 0.02, 0.2])
def test_an_extra_insensitive_shaper_leaves_at_most_its_tolerance(humps: int, zeta: float) -> None:
    """Of the mode that it is made for, at any damping; all amplitudes are positive, so r is not overshot."""
    made = EI(2.0, zeta, tolerance=0.1, humps=humps)
    assert made.residual(2.0, zeta) <= 0.1 + 1e-12
    assert min(made.amplitudes) > 0.0


def test_how_much_a_wrong_frequency_leaves_is_as_published() -> None:
    """Undamped, at 10 % off: |cos(π/2 · 1.1)| = 15.6 % for ZV, its square, 2.4 %, for ZVD; measured in a driven mode."""
    omega, off = 2.0, 1.1
    assert ZV(omega).residual(off * omega) == pytest.approx(abs(math.cos(0.5 * math.pi * off)))
    assert ZVD(omega).residual(off * omega) == pytest.approx(math.cos(0.5 * math.pi * off) ** 2)
    mode = ql.plants.LinearPlant(
        [[0.0, 1.0], [-((off * omega) ** 2), 0.0]], [0.0, (off * omega) ** 2], [1.0, 0.0]
    )
    for made in (ZV(omega), ZVD(omega)):
        follow = Prefiltered(PID(0.0, setpoint=[0.0, 1.0, 0.0], dt=2e-3), made)
        run = ql.simulate(mode, follow, ql.Scenario(reference=1.0, duration=5.0))
        left = np.max(np.abs(run["y"][run.t > made.times[-1] + 4e-3] - 1.0))
        assert left == pytest.approx(made.residual(off * omega), rel=1e-3)


def test_a_delay_between_samples_is_split() -> None:
    """A ramp behind it is late by exactly that; a step takes two samples."""
    shaped = Prefiltered(
        PID(1.0, setpoint=[0.0, 1.0, 0.0], dt=0.1), Shaper((0.0, 0.23), (0.4, 0.6))
    )
    u = [shaped.step(0.1 * k, 0.0) for k in range(20)]
    assert u[19] == pytest.approx(1.9 - 0.6 * 0.23)
    shaped.reset()
    np.testing.assert_allclose(
        [shaped.step(1.0, 0.0) for _ in range(5)], [0.4, 0.4, 0.4 + 0.6 * 0.7, 1.0, 1.0]
    )


# Mistakes
# -------------------------------------------------------------------------------------------------------------------------

HIDDEN = ql.plants.LinearPlant(np.diag([1.0, -1.0]), [0.0, 1.0], [1.0, 1.0])
BLIND = ql.plants.LinearPlant(np.diag([1.0, -1.0]), [1.0, 1.0], [0.0, 1.0])
WASHED_OUT = ql.plants.LinearPlant([[0.0, 1.0], [-1.0, -1.0]], [0.0, 1.0], [0.0, 1.0])


@cases(
    ("wrong", "message"),
    [
        (lambda: PID(1.0, 0.0, 1.0, dt=0.1), "kd = 1.0, tf = 0.0: a derivative needs a filter"),
        (lambda: PID(1.0, dt=0.1, tf=(-1.0, 0.0)), "f1 and f2 must not be negative"),
        (lambda: PID(1.0, dt=0.1, tt=-1.0), "tt = -1.0: must be finite and greater than zero"),
        (lambda: PID(1.0, dt=0.1, setpoint=[]), "setpoint = ..: must be a polynomial in s"),
        (
            lambda: PID(1.0, dt=0.1, setpoint=[1.0, 0.0, 0.0]),
            "is of degree 1, den of degree 0: C.s. must be proper",
        ),
        (lambda: PID(math.nan, dt=0.1), "kp = nan: must be a finite number"),
        (
            lambda: PID.simc(1.0, 1.0, 0.0, dt=0.1),
            "theta, or tau_c, = 0.0: must be finite and greater than zero",
        ),
        (lambda: equivalent_pid("adrc"), "controller = 'adrc': must be an ADRC"),
        (
            lambda: equivalent_pid(ql.ADRC(ql.ESO.model_free(3, 1.0, 10.0, 0.01), 1.0)),
            "controller is of order 3: must be of order 1",
        ),
        (
            lambda: equivalent_pid(ql.ADRC(ql.ESO.model_based(LAG, 10.0, 0.01), 1.0)),
            "controller has an observer with a model",
        ),
        (
            lambda: equivalent_pid(
                ql.ADRC(ql.ESO.model_free(2, 1.0, 10.0, 0.01), 1.0, feedforward=True)
            ),
            "controller has feedforward: a PID controller has no derivatives",
        ),
        (
            lambda: equivalent_pid(
                ql.ADRC(ql.ESO.model_free(2, 1.0, 10.0, 0.01), 1.0, learner=ql.learners.Kalman())
            ),
            "controller has a learner, Kalman",
        ),
        (lambda: Notch.at(0.0), "omega = 0.0: must be finite and greater than zero"),
        (lambda: Notch.at(1.0, depth=1.0), "depth = 1.0: must be below 1"),
        (lambda: NotchPID(1.0, 1.0, dt=0.1), "notch = 1.0: must be from quell.baselines.Notch.at"),
        (
            lambda: NotchPID(Notch.at(40.0), 1.0, dt=0.1),
            "notch at 40.0 rad/s with dt = 0.1 s: must be below pi/dt",
        ),
        (lambda: LQG("plant", 1.0, 5.0, 0.01), "plant = 'plant': must be a linear plant"),
        (
            lambda: LQG(HIDDEN, 1.0, 5.0, 0.01),
            "plant is not stabilisable from u: its mode at s = 1",
        ),
        (lambda: LQG(BLIND, 1.0, 5.0, 0.01), "plant is not detectable from y: its mode at s = 1"),
        (lambda: LQG(WASHED_OUT, 1.0, 5.0, 0.01), "plant has a zero at s = 0"),
        (lambda: LQG(LAG, 1.0, 5.0, 0.01, Q=np.eye(3)), r"Q has shape \(3, 3\)"),
        (lambda: LQG(LAG, 0.0, 5.0, 0.01), "omega_c = 0.0"),
        (lambda: LQG(LAG, 1e200, 5.0, 0.01), "rho = b² / omega_c.2m = 0.0: must be finite"),
        (
            lambda: LQG(control.ss(LAG.A, LAG.B, LAG.C, 0.0, 0.1), 1.0, 5.0, 0.01),
            "plant has a sample time, dt = 0.1",
        ),
        (lambda: ResonanceRatio(omega_o=5.0, dt=0.01, ratio=1.0), "ratio = 1.0: must be above 1"),
        (
            lambda: ResonanceRatio(omega_o=5.0, dt=0.01, measured="x2"),
            "measured = 'x2': must be one of load, motor",
        ),
        (lambda: ResonanceRatio(m1=0.0, omega_o=5.0, dt=0.01), "m1 = 0.0"),
        (lambda: ZV(0.0), "omega = 0.0"),
        (lambda: ZVD(1.0, 1.0), "zeta = 1.0: must be below 1"),
        (lambda: EI(1.0, tolerance=0.6), "tolerance = 0.6: must be at most 0.5"),
        (lambda: EI(1.0, humps=4), "humps = 4: must be 1, 2 or 3"),
        (lambda: Shaper((0.1,), (1.0,)), "times = .0.1,.: must begin at 0.0"),
        (lambda: Shaper((0.0, 1.0), (1.0, 1.0)), "amplitudes = .1.0, 1.0.: must add up to 1"),
        (lambda: ZV(1e-6).design(1e-3), "must be at most 10000000 samples"),
    ],
)
def test_a_mistake_is_named(wrong: object, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        wrong()  # type: ignore[operator]


def test_a_filter_without_solution_says_so() -> None:
    """No noise on a plant with an integrator: the Riccati equation has no stabilising solution."""
    with pytest.raises(ValueError, match="stationary Kalman filter"):
        stationary_gain(LQG(LAG, 1.0, 5.0, 0.01).model, np.zeros((3, 3)), 1.0)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"Q": -np.eye(2)}, "Q has the eigenvalue -1: must have none below zero"),
        ({"process_noise": -np.eye(2)}, "process_noise has the eigenvalue -1"),
    ],
)
def test_weights_of_the_wrong_sign_are_named(weights: dict[str, np.ndarray], message: str) -> None:
    """Before an equation is solved with them."""
    with pytest.raises(ValueError, match=message):
        LQG(LAG, 1.0, 5.0, 0.01, **weights)


def test_an_unsymmetric_weight_is_named() -> None:
    """It would be half ignored."""
    with pytest.raises(ValueError, match="Q: must be symmetric"):
        LQG(ql.plants.two_mass_spring(), 1.0, 5.0, 0.01, Q=np.triu(np.ones((4, 4))))


@pytest.mark.parametrize("omega", [1e2, 1e4])
def test_a_quick_undamped_mode_is_seen_and_reached_in_any_units(omega: float) -> None:
    """LQG takes an oscillator, and one behind a drive; one that is not in y is still refused."""
    drive = np.polymul([1.0, 0.0, omega**2], [1.0, 3.3, 0.0])
    for plant in (([1.0], [1.0, 0.0, omega**2]), ([omega**2], drive)):
        LQG(plant, 0.1 * omega, omega, 0.05 / omega)
    A = np.zeros((3, 3))
    A[0, 0], A[1, 2], A[2, 1] = -1.0, 1.0, -(omega**2)
    hidden = ql.plants.LinearPlant(A, [1.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="plant is not detectable from y"):
        LQG(hidden, 0.1 * omega, omega, 0.05 / omega)
