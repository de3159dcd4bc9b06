"""Loops analysed: laws, systems, margins, noise, frozen learners, pictures."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest

import quell as ql
from quell import analysis
from quell.analysis.frozen_learner import Frozen
from quell.analysis.sampled_plant import sampled_plant
from quell.controllers.linear.law import LinearLaw
from quell.learners.base import NoLearnerMemory, predict

PLANT = ql.plants.LinearPlant([[0.0, 1.0], [-3.0, -0.4]], [0.0, 2.0], [1.0, 0.0])
LEARNED = np.array([-2.5, -0.3, 0.1, 0.05])


class Held:
    """A learner that has learned and learns no more."""

    def __init__(self, gain: Any, before: float = 0.0, slope: float = 0.0) -> None:
        self.gain, self.before, self.slope = gain, before, slope

    def design(self, observer: ql.ESO, omega_c: float) -> Frozen:
        """Return what was learned."""
        return Frozen(np.append(self.gain[: observer.order], 0.0), self.before, self.slope)

    def memory(self, parameters: Frozen) -> NoLearnerMemory:
        """Return nothing."""
        return NoLearnerMemory(np.zeros(0))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


def chain(order: int) -> ql.plants.LinearPlant:
    """Return integrators with a little of everything on the last."""
    A = np.diag(np.ones(order - 1), 1)
    A[-1] = [-1.0, -2.0, -1.5, -0.5][:order]
    return ql.plants.LinearPlant(A, 1.3 * np.eye(order)[-1], np.eye(order)[0])


def adrc(
    order: int,
    form: str = "current",
    *,
    model: bool = False,
    learner: Any = None,
    dt: float = 0.01,
    **limits: float,
) -> ql.ADRC:
    """Return a controller for ``chain``."""
    observer = (
        ql.ESO.model_based(chain(order), omega_o=12.0, dt=dt, form=form)
        if model
        else ql.ESO.model_free(order=order, b0=1.0, omega_o=12.0, dt=dt, form=form)
    )
    return ql.ADRC(observer, omega_c=2.0, learner=learner, **limits)


def integrator(gain: float, dt: float) -> Any:
    """Return a controller of proportional action."""
    nothing = np.zeros(0)
    return SimpleNamespace(
        dt=dt, law=LinearLaw(np.zeros((0, 0)), nothing, nothing, nothing, nothing, gain, -gain)
    )


CASES = [
    (order, form, model, learner)
    for order in (1, 2, 3, 4)
    for form in ("current", "predictor")
    for model, learner in (
        (False, None),
        (True, None),
        (False, Held(LEARNED)),
        (False, Held(LEARNED, 0.1, 0.3)),
    )
]


@pytest.mark.parametrize(("order", "form", "model", "learner"), CASES)
def test_exported_systems_answer_as_the_simulated_loop_does(
    order: int, form: str, model: bool, learner: Any
) -> None:
    """To 1e-9 of the answer: the closed loop, and python-control's own interconnection of plant and both degrees of freedom."""
    controller = adrc(order, form, model=model, learner=learner)
    run = ql.simulate(
        chain(order),
        controller,
        ql.Scenario(
            reference=1.0, duration=12.0, disturbances=(ql.signals.Step(height=0.5, at=6.0),)
        ),
    )
    loop = analysis.analyse(chain(order), controller)
    w = np.array(run["w"][:, 0])

    def answer(system: Any, source: np.ndarray) -> np.ndarray:
        return control.forced_response(system, run.t, source).outputs

    for target in ("y", "u"):
        told = answer(loop.system(f"r → {target}"), run["r"]) + answer(
            loop.system(f"w1 → {target}"), w
        )
        np.testing.assert_allclose(
            told, run[target], rtol=0.0, atol=1e-9 * np.max(np.abs(run[target]))
        )
    P, C_r, C_y = (loop.system(name) for name in ("P", "C_r", "C_y"))
    told = answer(control.feedback(P, C_y) * C_r, run["r"]) + answer(control.feedback(P, C_y), w)
    np.testing.assert_allclose(told, run["y"], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_transfer_functions_answer_as_the_simulated_loop_does(order: int) -> None:
    """Closed by python-control, the plant and the controller's two: to 1e-9. The closed loop as one fraction loses more."""
    controller = adrc(order)
    run = ql.simulate(chain(order), controller, ql.Scenario(reference=1.0, duration=12.0))
    loop = analysis.analyse(chain(order), controller)
    fractions = [loop.transfer_function(name) for name in ("P", "C_r", "C_y")]
    assert all(isinstance(fraction, control.TransferFunction) for fraction in fractions)
    np.testing.assert_array_equal(fractions[1].den[0][0], fractions[2].den[0][0])
    assert fractions[2].den[0][0].size == order + 2
    P, C_r, C_y = map(control.ss, fractions)
    y = control.forced_response(control.feedback(P, C_y) * C_r, run.t, run["r"]).outputs
    np.testing.assert_allclose(y, run["y"], rtol=0.0, atol=1e-9)
    y = control.forced_response(loop.transfer_function("closed_loop"), run.t, run["r"]).outputs
    np.testing.assert_allclose(y, run["y"], rtol=0.0, atol=(1e-11, 1e-8, 1e-5)[order - 1])


@pytest.mark.parametrize("learner", [None, Held(LEARNED, 0.1, 0.3)])
@pytest.mark.parametrize("form", ["current", "predictor"])
def test_a_law_does_what_the_controller_does_at_its_limits_too(form: str, learner: Any) -> None:
    """It is told the applied u, as the observer is: fed with the run's y and u, it wishes what the controller applied or had cut."""
    controller = adrc(3, form, learner=learner, u_min=-1.0, u_max=1.6)
    run = ql.simulate(
        chain(3),
        controller,
        ql.Scenario(reference=ql.signals.Sinusoid(amplitude=2.0, omega=1.0), duration=10.0),
    )
    law = analysis.linear_law(controller)
    assert np.any(run["u"] == 1.6)
    assert np.any(run["u"] == -1.0)
    x = np.zeros(law.A.shape[0])
    for r, y, u in zip(run["r"], run["y"], run["u"], strict=True):
        wished = law.C @ x + law.D_r * r + law.D_y * y
        assert min(max(wished, -1.0), 1.6) == pytest.approx(u, abs=1e-9)
        x = law.A @ x + law.B_r * r + law.B_y * y + law.B_u * u


def test_poles_are_those_of_the_design_where_the_plant_is_its_model() -> None:
    """There are n at −omega_c and n + 1 at −omega_o, as far as sampling the law allows; u before is a pole at z = 0."""
    loop = analysis.analyse(chain(2), adrc(2, model=True, dt=1e-4))
    poles = loop.s_poles[np.isfinite(loop.s_poles)]
    np.testing.assert_allclose(np.poly(poles), np.poly([-2.0] * 2 + [-12.0] * 3), rtol=2e-3)
    assert np.min(np.abs(loop.poles)) < 1e-7


def test_margins_of_an_integrator_are_those_of_the_closed_form() -> None:
    """``L = K dt/(z − 1)`` has the real part −K dt/2 at all frequencies."""
    K, dt = 20.0, 0.01
    m = analysis.analyse(([1.0], [1.0, 0.0]), integrator(K, dt)).margins
    crossing = 2.0 / dt * math.asin(0.5 * K * dt)
    assert m.gain == pytest.approx((0.0, 2.0 / (K * dt)), rel=1e-12)
    assert m.gain_omega[1] == pytest.approx(math.pi / dt)
    assert m.phase_omega == pytest.approx(crossing, rel=1e-12)
    assert m.phase == pytest.approx(90.0 - math.degrees(0.5 * crossing * dt), rel=1e-12)
    assert m.delay == pytest.approx(math.radians(m.phase) / crossing, rel=1e-12)
    assert m.modulus == pytest.approx(1.0 - 0.5 * K * dt, rel=1e-12)
    # |S − ½| is largest there too: (1 + 0.1)/(1 − 0.1)/2.
    assert m.disk == pytest.approx(2.0 * 0.9 / 1.1, rel=1e-12)
    assert m.disk_gain[1] == pytest.approx(m.gain[1], rel=1e-9)


def test_margins_go_to_the_textbook_s_as_sampling_gets_faster() -> None:
    """``1/(s(s + 1))`` with unit gain: crossover 0.786 rad/s, phase margin 51.83°."""
    m = analysis.analyse(([1.0], [1.0, 1.0, 0.0]), integrator(1.0, 1e-4)).margins
    crossing = math.sqrt((math.sqrt(5.0) - 1.0) / 2.0)
    assert m.phase_omega == pytest.approx(crossing, rel=1e-4)
    assert m.phase == pytest.approx(90.0 - math.degrees(math.atan(crossing)), rel=1e-4)


@pytest.mark.parametrize("plant", [chain(2), chain(4), ql.plants.two_mass_spring()])
def test_margins_are_those_of_python_control(plant: Any) -> None:
    """Gain, phase, modulus and disk margin; ours are refined between the points of a grid, so ours are never larger."""
    controller = adrc(plant.order)
    loop = analysis.analyse(plant, controller)
    m, L = loop.margins, loop.system("L")
    omega = np.geomspace(0.1, 100.0, 4000)
    data = control.FrequencyResponseData(loop.response("L", omega), omega)
    gain, phase, modulus, _, at, _ = control.stability_margins(data)
    assert m.gain[1] == pytest.approx(gain, rel=1e-4)
    assert (m.phase, m.phase_omega) == pytest.approx((phase, at), rel=1e-4)
    assert m.modulus == pytest.approx(modulus, rel=1e-4)
    disk, _, disk_phase = control.disk_margins(L, omega)
    assert (m.disk, m.disk_phase) == pytest.approx((disk, disk_phase), rel=1e-3)
    np.testing.assert_allclose(
        loop.response("L", omega), L(np.exp(1j * omega * loop.dt)), rtol=1e-6
    )


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
            f"stable for a gain from {loop.b_range[0]:.3g} to {loop.b_range[1]:.3g} times what it is"
            in loop.summary()
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


def test_the_summary_says_what_the_disk_margin_allows() -> None:
    """As a factor of the gain and as an angle: a gain or a phase at its end, on the edge of the disk, keeps the loop stable."""
    loop = analysis.analyse(PLANT, adrc(2))
    m = loop.margins
    said = f"disk margin {m.disk:.3f}: gain {m.disk_gain[0]:.3g} … {m.disk_gain[1]:.3g} or phase ±{m.disk_phase:.1f}°, or some of both"
    assert said in loop.summary().splitlines()
    assert m.gain[0] < m.disk_gain[0] < 1.0 < m.disk_gain[1] < m.gain[1]
    assert 0.0 < m.disk_phase < m.phase


def test_a_loop_is_lost_with_the_first_sample_of_delay_beyond_its_delay_margin() -> None:
    """And with the last before it, it is stable."""
    controller = adrc(2)
    samples = analysis.analyse(chain(2), controller).margins.delay / controller.dt
    assert samples > 3.0
    for count, stable in ((math.floor(samples), True), (math.ceil(samples), False)):
        assert analysis.analyse(chain(2), controller, delay=count * controller.dt).stable is stable


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


def test_noise_moves_u_as_much_as_is_said(rng: np.random.Generator) -> None:
    """White noise in each of 200 000 samples, RMS to 1 %; and no sinusoid is amplified more than the peak says."""
    controller = adrc(2)
    noise = rng.normal(size=200_001)
    loop = analysis.analyse(chain(2), controller)
    scenario = ql.Scenario(
        noise=ql.signals.Samples(np.arange(noise.size) * 0.01, noise), duration=2000.0
    )
    run = ql.simulate(chain(2), controller, scenario)
    assert np.std(run["u"][1000:]) == pytest.approx(loop.noise_to_control, rel=0.01)
    omega = np.geomspace(1.0, math.pi / 0.01, 5000)
    size = np.abs(loop.response("CS", omega))
    assert np.max(size) == pytest.approx(loop.noise_to_control_peak, rel=1e-4)
    # The RMS is the mean square over all frequencies, Parseval says.
    even = np.linspace(0.0, math.pi / 0.01, 20_001)[1:]
    mean_square = np.mean(np.abs(loop.response("CS", even)) ** 2)
    assert math.sqrt(mean_square) == pytest.approx(loop.noise_to_control, rel=1e-3)


def test_responses_are_those_of_the_exported_systems() -> None:
    """All that have a name."""
    loop = analysis.analyse(PLANT, adrc(2))
    omega = np.array([0.1, 1.0, 10.0, 100.0])
    for name in ("P", "C_r", "C_y", "L", "S", "T", "PS", "CS", "closed_loop"):
        np.testing.assert_allclose(
            loop.system(name)(np.exp(1j * omega * 0.01)), loop.response(name, omega), rtol=1e-8
        )


def test_an_unstable_loop_has_no_margins() -> None:
    """They are zero, not those of a formula that presumes stability; and it says so."""
    loop = analysis.analyse(([-1.0], [1.0, 0.0, 0.0]), adrc(2))
    assert not loop.stable
    assert (loop.margins.phase, loop.margins.modulus, loop.margins.delay, loop.margins.gain) == (
        0.0,
        0.0,
        0.0,
        (1.0, 1.0),
    )
    assert loop.noise_to_control == math.inf
    assert "unstable" in repr(loop)


TRAINING = ql.Scenario(
    reference=ql.signals.Sinusoid(omega=1.0),
    noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
    duration=20.0,
)


@pytest.mark.parametrize(
    "learner", [ql.learners.Kalman(), ql.learners.Kalman(u=True), ql.learners.Harmonic()]
)
def test_what_the_record_says_of_a_learner_is_what_its_state_says(learner: Any) -> None:
    """For learners that are linear in state and u, θ is the gain, whatever they call the bias or add as a feedforward."""
    controller = adrc(2, learner=learner)
    run = ql.simulate(chain(2), controller, TRAINING)
    recorded, final = analysis.frozen(controller, run, 20.0), analysis.frozen(controller, run)
    np.testing.assert_allclose(recorded.gain, final.gain, atol=1e-8 * np.max(np.abs(final.gain)))
    assert recorded.slope == pytest.approx(final.slope, rel=1e-9)
    assert recorded.gain[0] == pytest.approx(-1.0, abs=0.6)


def test_a_guard_s_authority_scales_what_is_fed_back() -> None:
    """At 8 s the learner is only half heard."""
    controller = ql.ADRC(
        adrc(2).observer, omega_c=2.0, learner=ql.learners.Kalman(), guard=ql.Guard(time=10.0)
    )
    run = ql.simulate(chain(2), controller, TRAINING)
    authority = run["authority"]
    half = int(np.flatnonzero((authority > 0.1) & (authority < 0.9))[0])
    np.testing.assert_allclose(
        analysis.frozen(controller, run, run.t[half]).gain[:2],
        authority[half] * run["theta"][half, :2],
    )
    assert not np.any(analysis.frozen(controller, run, 0.0).gain)


def test_a_network_is_what_it_is_for_small_motions() -> None:
    """Its gains are the slope of its own prediction, and asking for them leaves it as it was."""
    controller = adrc(2, learner=ql.learners.MLP(hidden=4))
    run = ql.simulate(chain(2), controller, TRAINING)
    memory, before = (
        run.final_state.learner,
        [array.copy() for array in run.final_state.learner.model],
    )
    gain = analysis.frozen(controller, run).gain
    seen, small = run.final_state.seen, np.array([1e-5, -2e-5, 0.0])
    moved = [
        predict(controller.parameters.learner, memory, seen + sign * small, 0.0)[0]
        for sign in (1.0, -1.0)
    ]
    assert 0.5 * (moved[0] - moved[1]) == pytest.approx(gain @ small, rel=1e-5)
    assert np.any(gain != 0.0)
    for array, old in zip(memory.model, before, strict=True):
        np.testing.assert_array_equal(array, old)
    (loop,) = analysis.loops_over_time(chain(2), controller, TRAINING, [20.0])
    np.testing.assert_allclose(loop.poles, analysis.analyse(chain(2), controller, at=run).poles)


def test_a_learner_that_knows_the_plant_leaves_the_poles_of_the_design() -> None:
    """There are n at −omega_c, as with a model; the observer's are those of the plant with the model-free gain, not all at −omega_o."""
    loop = analysis.analyse(chain(2), adrc(2, learner=Held([-1.0, -2.0], 0.0, 0.3), dt=1e-4))
    observer = np.array([[-36.0, 1.0, 0.0], [-1.0 - 432.0, -2.0, 1.0], [-1728.0, 0.0, 0.0]])
    poles = loop.s_poles[np.isfinite(loop.s_poles)]
    np.testing.assert_allclose(
        np.poly(poles), np.polymul([1.0, 4.0, 4.0], np.poly(observer)), rtol=5e-3
    )


def test_margins_over_time_are_those_of_each_instant() -> None:
    """From the record; the same from the scenario, simulated up to there."""
    controller = adrc(2, learner=ql.learners.Kalman())
    run = ql.simulate(chain(2), controller, TRAINING, record_every=10)
    times = [1.0, 7.0, 20.0]
    recorded, again = (
        analysis.loops_over_time(chain(2), controller, source, times) for source in (run, TRAINING)
    )
    modulus = [loop.margins.modulus for loop in recorded]
    np.testing.assert_allclose(modulus, [loop.margins.modulus for loop in again], rtol=1e-7)
    assert modulus[0] != pytest.approx(modulus[2], rel=1e-3)


class Python:
    """A model in Python."""

    def learn(self, features: np.ndarray, targets: np.ndarray) -> None:
        """Learn nothing."""

    def predict(self, features: np.ndarray) -> float:
        """Return nothing."""
        return 0.0


def test_what_can_not_be_analysed_is_said_in_a_line() -> None:
    """By name, value and rule."""
    controller = adrc(2, learner=ql.learners.MLP(hidden=2))
    run = ql.simulate(chain(2), controller, TRAINING)
    pendulum = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u - np.sin(x[0])), order=2)
    outside = adrc(2, learner=ql.learners.PythonModel(Python()))
    other = ql.simulate(chain(2), adrc(2, learner=ql.learners.Kalman()), TRAINING)
    for message, call in (
        ("linearised first", lambda: analysis.analyse(pendulum, adrc(2))),
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
        ("asked once a period", lambda: analysis.analyse(PLANT, outside)),
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


def test_a_feature_that_is_not_linear_needs_more_than_its_coefficient() -> None:
    """The record of θ does not do; the state at the end of a run does."""
    controller = adrc(2, learner=ql.learners.RLS(ql.features.Polynomial(2)))
    run = ql.simulate(chain(2), controller, replace(TRAINING, duration=4.0), interpret=True)
    with pytest.raises(ValueError, match=r"is not linear.*pass the scenario to loops_over_time,"):
        analysis.frozen(controller, run, 3.0)
    assert np.any(analysis.frozen(controller, run).gain != 0.0)


def test_without_python_control_all_but_its_systems_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And the error says which extra brings it."""
    real = importlib.import_module

    def missing(name: str, *rest: Any) -> Any:
        if name == "control":
            raise ImportError("No module named 'control'")
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", missing)
    loop = analysis.analyse(PLANT, adrc(2))
    assert loop.margins.phase > 0.0
    with pytest.raises(ImportError, match=r"pip install 'quell\[control\]'"):
        loop.system("L")


def test_pictures_show_what_was_calculated() -> None:
    """Curves and margins, in axes of one's own too; a wrong number of axes is an error."""
    plt = importlib.import_module("matplotlib.pyplot")
    loop = analysis.analyse(PLANT, adrc(2))
    top, low = analysis.plot_bode(loop)
    np.testing.assert_allclose(
        top.lines[0].get_ydata(), np.abs(loop.response("L", loop.omega[:-1]))
    )
    assert f"{loop.margins.phase:.0f}°" in [text.get_text() for text in low.texts]
    four = analysis.plot_gang_of_four(loop)
    np.testing.assert_allclose(
        four[3].lines[0].get_ydata(), np.abs(loop.response("CS", loop.omega))
    )
    omegas = [5.0, 10.0]

    def make(omega_o: float) -> ql.ADRC:
        return ql.ADRC(ql.ESO.model_free(order=2, b0=2.0, omega_o=omega_o, dt=0.01), omega_c=2.0)

    axes = analysis.plot_margins_against_omega_o(PLANT, make, omegas)
    assert axes[1].lines[0].get_ydata()[1] == pytest.approx(
        analysis.analyse(PLANT, make(10.0)).margins.phase
    )
    axes = analysis.plot_margins_over_time([0.0, 1.0], [loop, loop], plt.subplots(3)[1])
    assert axes[0].lines[0].get_ydata()[0] == loop.margins.modulus
    with pytest.raises(ValueError, match="must be 2 matplotlib axes, got 3"):
        analysis.plot_bode(loop, plt.subplots(3)[1])
    plt.close("all")


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
