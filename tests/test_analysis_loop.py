"""Loops analysed: poles, ranges of b, noise, plants of every kind, what can not be analysed."""

from __future__ import annotations

import importlib
import math
import tracemalloc
from typing import Any

import control
import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.analysis.loop import subsystem
from quell.plants.linear import sampled_plant
from tests.analysed_loops import PLANT, TRAINING, adrc, chain


def test_poles_are_those_of_the_design_where_the_plant_is_its_model() -> None:
    """There are n at −omega_c and n + 1 at −omega_o, as far as sampling the law allows; u before is a pole at z = 0."""
    loop = analysis.analyse(chain(2), adrc(2, model=True, dt=1e-4))
    poles = loop.s_poles[np.isfinite(loop.s_poles)]
    np.testing.assert_allclose(np.poly(poles), np.poly([-2.0] * 2 + [-12.0] * 3), rtol=2e-3)
    assert np.min(np.abs(loop.poles)) < 1e-7


@pytest.mark.parametrize("plant", [chain(3), ql.plants.two_mass_spring()])
def test_the_range_of_b_ends_where_a_pole_reaches_the_unit_circle(plant: Any) -> None:
    """Found from crossings of the negative real axis; found again by bisection on the eigenvalues."""
    loop = analysis.analyse(plant, adrc(plant.order))
    b = 1.3 if plant.order == 3 else 1.0  # b0 is 1
    assert (loop.b_range[0] == 0.0) is (
        plant.order == 3
    )  # which is stable without control, the other is not
    for end, outwards in zip(loop.b_range, (0.01, 100.0), strict=True):
        if end == 0.0:
            continue
        inside, outside = 1.0, outwards
        for _ in range(60):
            middle = math.sqrt(inside * outside)
            eigenvalues = 1.0 + np.linalg.eigvals(loop.closed_loop_matrix(middle))
            inside, outside = (
                (middle, outside) if np.all(np.abs(eigenvalues) < 1.0) else (inside, middle)
            )
        assert end == pytest.approx(inside * b, rel=1e-7)


def test_the_range_of_b_does_not_depend_on_the_gain_that_the_plant_has() -> None:
    """With zeros neither: b is the gain to the derivative that u reaches first, as b0 is."""
    num, den = np.array([2.0, 6.0]), [1.0, 0.4, 9.0, 0.0]
    controller = ql.ADRC(ql.ESO.model_based((num, den), omega_o=40.0, dt=1e-3), omega_c=4.0)
    once, twice = (analysis.analyse((gain * num, den), controller) for gain in (1.0, 2.0))
    assert (once.b_over_b0, twice.b_over_b0) == pytest.approx((1.0, 2.0))
    assert once.b_range == pytest.approx(once.margins.gain)
    assert twice.b_range == pytest.approx(once.b_range, rel=1e-7)
    assert "stable for b/b0 from 0.197 to 4.35" in once.summary()


def test_where_b_can_not_be_compared_with_b0_the_range_is_in_gains_of_the_plant() -> None:
    """For a plant that was given sampled, and for one that u reaches later than the controller thinks; and that is what it is called."""
    plt = importlib.import_module("matplotlib.pyplot")
    sampled = control.sample_system(control.ss(PLANT.A, PLANT.B, PLANT.C, 0.0), 0.01, method="zoh")
    later = ([200.0], np.polymul([1.0, 100.0], [1.0, 0.4, 3.0]))
    for plant in (sampled, later):
        loop = analysis.analyse(plant, adrc(2))
        assert loop.b_over_b0 is None
        assert loop.b_range == loop.margins.gain
        assert (
            f"stable for a gain from {loop.b_range[0]:.3g} to {loop.b_range[1]:.3g} times what it "
            "is" in loop.summary()
        )
        axes = analysis.plot_margins_over_time([0.0], [loop])
        assert axes[2].get_ylabel() == "gain for which\nit is stable"
    known = analysis.analyse(PLANT, adrc(2))
    assert known.b_range == pytest.approx([2.0 * gain for gain in known.margins.gain])
    assert (
        analysis.plot_margins_over_time([0.0], [known])[2].get_ylabel()
        == "b/b0 for which\nit is stable"
    )
    plt.close("all")


def test_a_fraction_of_a_sample_of_delay_is_exact() -> None:
    """An integrator that u reaches 1.3 samples late moves by 0.7 dt u(k − 1) + 0.3 dt u(k − 2)."""
    plant = sampled_plant(([1.0], [1.0, 0.0]), 0.1, delay=0.13)
    x, y = np.zeros(3), []
    for k in range(5):
        y.append(plant.C @ x)
        x = x + plant.N @ x + plant.B * float(k == 0)
    np.testing.assert_allclose(np.diff(y), [0.0, 0.07, 0.03, 0.0], atol=1e-15)


def test_an_actuator_lag_is_a_part_of_the_plant() -> None:
    """The same margins come from a plant that has the lag in its transfer function."""
    controller = adrc(2)
    told = analysis.analyse(([2.0], [1.0, 0.4, 3.0]), controller, actuator_lag=0.05).margins
    built_in = analysis.analyse(
        ([2.0], np.polymul([0.05, 1.0], [1.0, 0.4, 3.0])), controller
    ).margins
    np.testing.assert_allclose(np.hstack([*told]), np.hstack([*built_in]), rtol=1e-6)


def test_plants_of_every_kind_are_the_same_plant() -> None:
    """A LinearPlant, a state space, a transfer function, a pair of polynomials, and one sampled by python-control."""
    model = control.tf([2.0], [1.0, 0.4, 3.0])
    space = control.ss(PLANT.A, PLANT.B, PLANT.C, 0.0)
    expected = analysis.analyse(PLANT, adrc(2)).margins
    for plant in (
        model,
        space,
        ([2.0], [1.0, 0.4, 3.0]),
        control.sample_system(space, 0.01, method="zoh"),
    ):
        found = analysis.analyse(plant, adrc(2)).margins
        np.testing.assert_allclose(np.hstack([*found]), np.hstack([*expected]), rtol=1e-6)


def test_noise_moves_u_as_much_as_is_said() -> None:
    """A pulse of one sample has in u the sum of squares that is the mean square under white noise; and no sinusoid is amplified more than the peak says."""
    controller = adrc(2)
    noise = np.zeros(2001)
    noise[10] = 1.0
    loop = analysis.analyse(chain(2), controller)
    scenario = ql.Scenario(
        noise=ql.signals.Samples(np.arange(noise.size) * 0.01, noise), duration=20.0
    )
    run = ql.simulate(chain(2), controller, scenario)
    assert np.linalg.norm(run["u"]) == pytest.approx(loop.noise_to_control, rel=1e-6)
    omega = np.geomspace(1.0, math.pi / 0.01, 5000)
    size = np.abs(loop.response("CS", omega))
    assert np.max(size) == pytest.approx(loop.noise_to_control_peak, rel=1e-4)
    # The RMS is the mean square over all frequencies, Parseval says.
    even = np.linspace(0.0, math.pi / 0.01, 20_001)[1:]
    mean_square = np.mean(np.abs(loop.response("CS", even)) ** 2)
    assert math.sqrt(mean_square) == pytest.approx(loop.noise_to_control, rel=1e-3)


def test_a_prefilter_is_not_in_the_loop() -> None:
    """What comes before a controller changes none of its margins."""
    plant, law = ([1.0], [1.0, 1.0, 0.0]), ql.ADRC(ql.ESO.model_free(2, 1.0, 20.0, 0.01), 2.0)
    behind = ql.controllers.Prefiltered(law, ql.baselines.ZV(3.0))
    assert ql.analysis.analyse(plant, behind).margins == ql.analysis.analyse(plant, law).margins


def test_a_response_at_a_pole_is_refused_by_its_frequency() -> None:
    """An integrator has none at 0 rad/s."""
    loop = ql.analysis.analyse(
        ([1.0], [1.0, 0.0]), ql.ADRC(ql.ESO.model_free(1, 1.0, 20.0, 0.01), 2.0)
    )
    with pytest.raises(ValueError, match=r"omega = \[0.0\] rad/s: the response is infinite"):
        loop.response("P", [0.0])


class Python:
    """A model in Python."""

    def learn(self, features: np.ndarray, targets: np.ndarray) -> None:
        """Learn nothing."""

    def predict(self, features: np.ndarray) -> float:
        """Return nothing."""
        return 0.0


@pytest.mark.trial
def test_what_can_not_be_analysed_is_said_in_a_line() -> None:
    """By name, value and rule."""
    controller = adrc(2, learner=ql.learners.MLP(hidden=2))
    run = ql.simulate(chain(2), controller, TRAINING)
    pendulum = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u - np.cos(x[0])), order=2)
    outside = adrc(2, learner=ql.learners.PythonModel(Python()))
    other = ql.simulate(chain(2), adrc(2, learner=ql.learners.Kalman()), TRAINING)
    for message, call in (
        ("give the point at which it is linearised", lambda: analysis.analyse(pendulum, adrc(2))),
        ("biproper", lambda: analysis.analyse(([1.0, 1.0], [1.0, 2.0]), adrc(2))),
        (
            "may not follow the input at once",
            lambda: analysis.analyse(control.ss(-1.0, 1.0, 1.0, 1.0), adrc(2)),
        ),
        ("controller's dt", lambda: analysis.analyse(control.ss(0.5, 1.0, 1.0, 0.0, 0.5), adrc(2))),
        (
            "whole samples",
            lambda: analysis.analyse(control.ss(0.5, 1.0, 1.0, 0.0, 0.01), adrc(2), delay=0.005),
        ),
        ("at most 200 samples", lambda: analysis.analyse(PLANT, adrc(2), delay=3.0)),
        ("must be an ADRC", lambda: analysis.analyse(PLANT, "adrc")),
        (
            "MLP has no coefficients to record; pass the scenario to loops_over_time,",
            lambda: analysis.frozen(controller, run, 3.0),
        ),
        (
            "a time of the record",
            lambda: analysis.frozen(adrc(2, learner=ql.learners.Kalman()), other, 30.0),
        ),
        ("a run of this controller", lambda: analysis.frozen(controller, other, 3.0)),
        ("run = 3: must be a run", lambda: analysis.analyse(PLANT, controller, at=3)),
        ("called once a period", lambda: analysis.analyse(PLANT, outside)),
        (
            "a Trajectory or a Scenario",
            lambda: analysis.loops_over_time(PLANT, controller, None, [1.0]),
        ),
        ("must be one of", lambda: analysis.analyse(PLANT, adrc(2)).response("Q", [1.0])),
        ("source = 'w2'", lambda: analysis.analyse(PLANT, adrc(2)).system("w2 → y")),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("known", [0.0, 0.35])
def test_a_dead_time_is_a_power_of_z(known: float) -> None:
    """Responses are those of all states to 1e-12, and memory does not grow with the samples of the delay."""
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=1.0, omega_o=5.0, dt=0.01, delay=known), omega_c=0.3
    )
    loop = analysis.analyse(ql.plants.two_mass_spring(c1=0.5, c2=0.5), controller, delay=1.505)
    omega = np.geomspace(1e-3, np.pi / 0.01, 2000)
    few = omega[::100]
    for name in ("P", "C_r", "C_y", "L"):
        N, B, C, D = subsystem(loop.plant, loop.law, name)
        zeta = np.expm1(1j * few * loop.dt)[:, None, None]
        solved = np.linalg.solve(zeta * np.eye(B.size) - N, np.tile(B[:, None], (few.size, 1, 1)))
        np.testing.assert_allclose(loop.response(name, few), solved[:, :, 0] @ C + D, rtol=1e-11)
    tracemalloc.start()
    loop.response("L", omega)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 40e6  # the matrices of all states took 1.5 GB


def test_delays_that_do_not_act_are_poles_at_zero() -> None:
    """Plant and controller both store the late u: one of the two decides about the poles, the other's are exactly zero."""
    controller = ql.ADRC(
        ql.ESO.model_free(order=1, b0=1.0, omega_o=5.0, dt=0.01, delay=0.5), omega_c=0.3
    )
    loop = analysis.analyse(([1.0], [1.0, 1.0]), controller, delay=0.5)
    assert np.count_nonzero(loop.poles == 0.0) >= 50
    # All of them are those of the whole matrix: compared by its powers' traces.
    A = np.eye(loop.poles.size) + loop.closed_loop_matrix()
    for power in (1, 2, 7, 51, 60):
        trace = np.trace(np.linalg.matrix_power(A, power))
        assert np.sum(loop.poles**power) == pytest.approx(trace, rel=1e-9, abs=1e-12)


def test_delays_and_encoders_around_a_plant_are_taken_off() -> None:
    """The delay is that of the loop, and an encoder's steps are no gain."""
    inner = ql.plants.two_mass_spring(c1=0.5, c2=0.5)
    controller = adrc(4)
    late = ql.plants.encoded(ql.plants.delayed(inner, delay=0.03, dt=0.01), counts=1000)
    found = analysis.analyse(late, controller, delay=0.01)
    assert found.margins == analysis.analyse(inner, controller, delay=0.04).margins
    with pytest.raises(ValueError, match=r"delayed by samples of 0\.02 s, .*dt = 0\.01 s: must be"):
        analysis.analyse(ql.plants.delayed(inner, delay=0.04, dt=0.02), controller)


def test_a_nonlinear_plant_is_analysed_about_its_operating_point() -> None:
    """The pendulum is a spring when it hangs and drives away when it stands: closed forms for both."""
    pendulum = ql.plants.NonlinearPlant(
        lambda t, x, u, w: (x[1], 2.0 * u + w[0] - 9.81 * math.sin(x[0]) - 0.4 * x[1]),
        order=2,
        output=lambda x: math.sin(x[0] / 2.0),
    )
    for angle in (0.0, 2.0):
        found = ql.plants.linearised(pendulum, [angle, 0.0])
        slope = 0.5 * math.cos(angle / 2.0)
        expected = [[0.0, 1.0], [-9.81 * math.cos(angle), -0.4]]
        np.testing.assert_allclose(found.A, expected, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(found.C, [[slope, 0.0]], rtol=1e-8, atol=1e-12)
        loop = analysis.analyse(pendulum, adrc(2), operating_point=([angle, 0.0], 1.0))
        direct = analysis.analyse((expected, [0.0, 2.0], [slope, 0.0]), adrc(2))
        assert loop.margins.phase == pytest.approx(direct.margins.phase, rel=1e-6)
        assert loop.b_over_b0 == pytest.approx(2.0 * slope, rel=1e-8)
    pushed = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u - 1.0), order=2)
    with pytest.raises(ValueError, match=r"is nonlinear, .* give the point .* operating_point=\(x"):
        analysis.analyse(pushed, adrc(2))
    with pytest.raises(ValueError, match=r"is a function: pass quell\.plants\.NonlinearPlant\(f"):
        analysis.analyse(pendulum.f, adrc(2))
    with pytest.raises(ValueError, match=r"operating_point = 3\.0: must be a state and a control"):
        analysis.analyse(pendulum, adrc(2), operating_point=3.0)


def test_a_cubic_spring_is_as_stiff_as_its_twist_makes_it() -> None:
    """``k + 3 k_cubic d²``, in all entries where k is."""
    plant = ql.plants.lagged_two_mass_spring(m1=2.0, m2=0.5, k=1.0, k_cubic=0.7)
    found = ql.plants.linearised(plant, [0.3, -0.2, 0.0, 0.0, 0.0])
    stiff = ql.plants.lagged_two_mass_spring(m1=2.0, m2=0.5, k=1.0 + 3.0 * 0.7 * 0.25)
    np.testing.assert_allclose(found.A, stiff.A, rtol=1e-14, atol=1e-15)


def test_a_force_that_grows_with_the_square_of_the_speed_has_no_slope_at_rest() -> None:
    """Centrifugal forces: the slope is zero, and no corner."""
    plant = ql.plants.NonlinearPlant(
        lambda t, x, u, w: (x[1], u - 3.0 * x[1] ** 2 - 2.0 * x[0]), order=2
    )
    found = ql.plants.linearised(plant, [0.3, 0.0])
    np.testing.assert_allclose(found.A, [[0.0, 1.0], [-2.0, 0.0]], atol=1e-9)


@pytest.mark.parametrize("friction", [np.sign, abs, lambda v: max(v, 0.0)])
def test_a_point_without_derivative_is_refused(friction: Any) -> None:
    """Dry friction at standstill has no slope; beside it, it has."""
    plant = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u - friction(x[1])), order=2)
    with pytest.raises(ValueError, match=r"f has no derivative by entry 1 of"):
        ql.plants.linearised(plant, [0.0, 0.0])
    ql.plants.linearised(plant, [0.0, 0.1])
    smooth = ql.plants.NonlinearPlant(
        lambda t, x, u, w: (x[1], u - math.tanh(x[1] / 1e-3)), order=2
    )
    assert ql.plants.linearised(smooth, [0.0, 0.0]).A[1, 1] == pytest.approx(-1000.0, rel=1e-5)
    with pytest.raises(ValueError, match=r"has dry friction, limits or an encoder.*plant\.linear"):
        analysis.analyse(ql.plants.torsional(), adrc(2))
