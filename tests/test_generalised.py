"""Observers with several extended states f, f', …: closed forms, steady errors, limits, refusals, files."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse, certify
from quell.controllers import in_single_precision
from quell.experiments.compare import sensitivities
from quell.export import c_source
from quell.observers import continuous_gain
from quell.observers.design import f_learned_response, response
from quell.studio.messages import Granted, forms
from quell.tuning.report import toml_text

from .cases import cases
from .in_c import InC, needs_gcc
from .setups import TWO_MASS

DT, OMEGA_O, OMEGA_C, B0 = 0.01, 12.0, 2.0, 1.5
SPRING = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, B0], [1.0, 0.0])


def loaded(plant: Any) -> ql.plants.LinearPlant:
    """Return a plant with a load at its input."""
    linear = ql.plants.LinearPlant.of(plant)
    column = np.reshape(linear.B, (-1, 1))
    return ql.plants.LinearPlant(linear.A, linear.B, linear.C, column)


def chain(m: int, order: int = 2, dt: float = DT, **options: Any) -> ql.ESO:
    """A model-free observer with m extended states."""
    return ql.ESO.model_free(order, B0, OMEGA_O, dt, disturbance_order=m, **options)


def polynomial(degree: int, size: float = 0.2) -> ql.signals.Signal:
    """A load u_0 t^degree, sampled at DT, with a value for each sample."""
    t = DT * np.arange(12_000)
    return ql.signals.Samples(t, size * t**degree)


def errors(plant: Any, controller: Any, degree: int, duration: float = 40.0) -> Any:
    """Return y of a loop with a load at the plant's input, over time."""
    scenario = ql.Scenario(disturbances=(polynomial(degree),), duration=duration)
    return ql.simulate(loaded(plant), controller, scenario)["y"]


# ---- closed forms


@cases("m", [1, 2, 3])
@cases("order", [1, 2, 4])
def test_the_gain_of_a_chain_is_binomial(order: int, m: int) -> None:
    """``l_i = C(n + m, i) ω_o^i``, and the sampled gain over dt goes there with dt."""
    size = order + m
    expected = [math.comb(size, i) * OMEGA_O**i for i in range(1, size + 1)]
    gain = continuous_gain(np.zeros(order), OMEGA_O, m)
    np.testing.assert_allclose(gain, expected, rtol=1e-14)
    sampled = chain(m, order, dt=1e-6).model.gain / 1e-6
    np.testing.assert_allclose(sampled, expected, rtol=1e-3)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_the_gain_with_a_model_puts_all_poles_in_one_place(m: int) -> None:
    """``det(sI − A + l C) = (s + ω_o)^N`` with the model in the chain; the sampled gain goes there."""
    a = np.array([2.0, 0.3, 1.0])
    A = np.diag(np.ones(2 + m), 1)
    A[2, :3] -= a
    gain = continuous_gain(a, OMEGA_O, m)
    found = np.poly(A - np.outer(gain, np.eye(3 + m)[0]))
    np.testing.assert_allclose(found, np.poly([-OMEGA_O] * (3 + m)), rtol=1e-9)
    observer = ql.ESO.model_based((a, B0), OMEGA_O, 1e-6, disturbance_order=m)
    np.testing.assert_allclose(observer.model.gain / 1e-6, gain, rtol=1e-3)


@cases("m", [2, 3])
@cases("form", ["current", "predictor", "reduced"])
def test_the_poles_are_where_they_are_asked_for(form: str, m: int) -> None:
    """All at ``exp(−ω_o dt)``, one at zero in the reduced form; the characteristic polynomial shows it."""
    found = response(chain(m, form=form).model, 2 + m, 2).transition
    poles = [math.exp(-OMEGA_O * DT)] * (2 + m)
    if form == "reduced":
        poles[-1] = 0.0
    np.testing.assert_allclose(np.poly(found), np.poly(poles), atol=1e-12)
    freed = chain(m, poles=[(-0.8, 0.6), *[-1.5] * m])
    found = np.exp(OMEGA_O * DT * np.array([-0.8 + 0.6j, -0.8 - 0.6j, *[-1.5] * m]))
    np.testing.assert_allclose(
        np.poly(response(freed.model, 2 + m, 2).transition), np.poly(found).real, atol=1e-12
    )


@cases("m", [1, 2, 3])
@cases("order", [1, 2, 3])
def test_the_estimate_of_f_has_its_transfer_function(order: int, m: int) -> None:
    """``Σ_{i>n} C(N, i) ω_o^i s^(N−i) / (s + ω_o)^N``, sampled fast; what is missed begins with s^m."""
    dt, size = 1e-4, order + m
    observer = chain(m, order, dt)
    M, g, c, d = f_learned_response(response(observer.model, size, order))
    s = 1j * np.array([0.01, 0.1, 0.5, 1.0, 3.0]) * OMEGA_O
    z = np.exp(s * dt)
    found = [c @ np.linalg.solve(each * np.eye(size) - M, g) + d for each in z]
    terms = [math.comb(size, i) * OMEGA_O**i * s ** (size - i) for i in range(order + 1, size + 1)]
    expected = sum(terms) / (s + OMEGA_O) ** size
    # A held input is half a sample late, and shows at the next sample.
    np.testing.assert_allclose(np.array(found) * z, expected, rtol=0.0, atol=5.0 * OMEGA_O * dt)
    slow = math.comb(size, order) * (np.abs(s[0]) / OMEGA_O) ** m
    assert abs(1.0 - expected[0]) == pytest.approx(slow, rel=0.05)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_the_poles_of_kalman_gains_are_those_of_butterworth(m: int) -> None:
    """With drift of f^(m−1) alone their radius is ``(drift/(noise dt))^(1/2N)``."""
    size, noise, dt = 2 + m, 1e-6, 1e-3
    drift = noise * dt * 30.0 ** (2 * size)
    observer = ql.ESO.kalman(2, B0, dt, noise_variance=noise, drift=drift, disturbance_order=m)
    assert observer.omega_o == pytest.approx(30.0, rel=0.01)
    poles = np.log(np.linalg.eigvals(response(observer.model, size, 2).transition)) / dt
    np.testing.assert_allclose(np.abs(poles), 30.0, rtol=0.05)


# ---- what it is for


FORMS: dict[str, Any] = {
    "current": lambda m: chain(m),
    "predictor": lambda m: chain(m, form="predictor"),
    "reduced": lambda m: chain(m, form="reduced"),
    "half gain": lambda m: chain(m, half_gain=True),
    "freed": lambda m: chain(m, poles=[(-0.8, 0.6), *[-1.0] * m]),
    "cascade": lambda m: ql.ESO.cascade(2, B0, OMEGA_O, DT, disturbance_order=m),
    "model-based": lambda m: ql.ESO.model_based(SPRING, OMEGA_O, DT, disturbance_order=m),
    "nonlinear": lambda m: ql.ESO.nonlinear(2, B0, OMEGA_O, DT, delta=0.1, disturbance_order=m),
}


@pytest.mark.trial
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("m", [2, 3])
def test_a_ramp_leaves_no_error_with_two_extended_states_and_a_parabola_none_with_three(
    m: int, form: str
) -> None:
    """To rounding, at any sample time; with one state less the error stays, or grows."""
    y, before = (
        errors(SPRING, ql.ADRC(FORMS[form](each), OMEGA_C), m - 1, 80.0) for each in (m, m - 1)
    )
    largest, last = np.max(np.abs(y)), float(np.max(np.abs(y[-100:])))
    assert last < 1e-7 * max(largest, 1e-3), (last, largest)
    assert abs(before[-1]) > 1e-3 * largest


@pytest.mark.trial
def test_a_plant_with_a_zero_follows_too() -> None:
    """The law cancels f where it enters, zeros included."""
    plant = ([1.5, 6.0], [1.0, 0.5, 2.0, 1.0])
    for m, degree in ((2, 1), (3, 2)):
        observer = ql.ESO.model_based(plant, OMEGA_O, DT, disturbance_order=m)
        y = errors(plant, ql.ADRC(observer, OMEGA_C), degree, 80.0)
        assert np.max(np.abs(y[-100:])) < 1e-7 * np.max(np.abs(y))


@pytest.mark.trial
def test_with_one_extended_state_a_ramp_leaves_its_rate_over_k_i() -> None:
    """The reference of the other tests: ``y = f'/(b0 k_i)``, from low frequencies of the loop."""
    controller = ql.ADRC(chain(1), OMEGA_C)
    loop = analyse(SPRING, controller)
    k_i = 1e-4 / abs(complex(loop.response("PS", [1e-4])[0]))
    y = errors(SPRING, controller, 1)
    assert y[-1] == pytest.approx(0.2 / k_i, rel=1e-3)


@pytest.mark.trial
@pytest.mark.parametrize("samples", [1, 4])
def test_behind_a_known_delay_a_ramp_leaves_its_rate_times_the_delay(samples: int) -> None:
    """``y = b f' τ/k_1``: the law cancels the f of now, which arrives late; with one state more than that."""
    delay = samples * DT
    found = []
    for m in (1, 2):
        controller = ql.ADRC(chain(m, delay=delay), OMEGA_C)
        late = ql.plants.delayed(loaded(SPRING), delay, DT)
        scenario = ql.Scenario(disturbances=(polynomial(1),), duration=40.0)
        found.append(float(ql.simulate(late, controller, scenario)["y"][-1]))
    assert found[1] == pytest.approx(B0 * 0.2 * delay / OMEGA_C**2, rel=1e-3)
    assert found[0] > 2.0 * found[1]


@pytest.mark.parametrize("m", [1, 2, 3])
def test_a_slow_load_is_rejected_by_the_power_m(m: int) -> None:
    """The load response falls with ω^m: ten times slower is 10^m times less."""
    loop = analyse(SPRING, ql.ADRC(chain(m), OMEGA_C))
    slow, slower = np.abs(loop.response("PS", [0.02, 0.002]))
    assert slow / slower == pytest.approx(10.0**m, rel=0.02)


def test_the_margin_pays_for_it() -> None:
    """At the same bandwidth of the observer the loop comes closer to −1 with each extended state."""
    margins = [analyse(SPRING, ql.ADRC(chain(m), OMEGA_C)).margins.modulus for m in (1, 2, 3)]
    assert margins[0] > margins[1] > margins[2]


def test_f_and_its_derivatives_are_estimated_and_recorded() -> None:
    """Of a load ``t²`` with three states: f, f', f''; what the estimate of a step says is the record's row."""
    controller = ql.ADRC(chain(3), OMEGA_C)
    linear = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, B0], [1.0, 0.0], [[0.0], [1.0]])
    run = ql.simulate(linear, controller, ql.Scenario(disturbances=(polynomial(2, 0.1),), duration=30.0))  # fmt: skip
    t, rates = run.t[-1], run["f_derivatives"]
    assert rates.shape == (len(run), 2)
    np.testing.assert_allclose(rates[-1], [0.2 * t, 0.2], rtol=0.01)
    assert run["f_hat"][-1] == pytest.approx(0.1 * t**2, rel=1e-3)
    estimate = controller.read(run.final_state)
    np.testing.assert_array_equal(estimate.f_derivatives, rates[-1])
    assert ql.ADRC(chain(1), OMEGA_C).estimate.f_derivatives.size == 0


# ---- limits


def test_one_extended_state_is_the_usual_observer() -> None:
    """To the bit, whether it is said or not."""
    usual = ql.ESO.model_free(2, B0, OMEGA_O, DT)
    for one, other in zip(chain(1).model, usual.model, strict=True):
        np.testing.assert_array_equal(one, other)


def test_within_delta_the_nonlinear_observer_is_the_linear_one() -> None:
    """Its powers go on by halves."""
    nonlinear = ql.ESO.nonlinear(2, B0, OMEGA_O, DT, delta=10.0, disturbance_order=2)
    np.testing.assert_allclose(nonlinear.model.alpha, [1.0, 0.5, 0.25, 0.125])
    y = [errors(SPRING, ql.ADRC(each, OMEGA_C), 1, 5.0) for each in (nonlinear, chain(2))]
    np.testing.assert_allclose(*y, atol=1e-12)


# ---- start, manual operation, retuning


def test_a_start_with_f_and_its_rate_makes_no_bump() -> None:
    """``start_at`` with the load's own f and f': y stays where it is, which without f' it does not."""
    moved = []
    for f in ((0.3, 0.2 * B0), 0.3):
        controller = ql.ADRC(chain(2), OMEGA_C)
        controller.start_at([0.0, 0.0], f=f, u=-0.3 / B0)
        x, load, largest, last = np.zeros(2), 0.2, 0.0, -0.3 / B0
        for k in range(200):
            u = controller.step(0.0, x[0])
            f_now = 0.3 + load * B0 * DT * (k + 1)
            force = f_now + B0 * u
            x = np.array([x[0] + DT * x[1] + 0.5 * DT**2 * force, x[1] + DT * force])
            largest, last = max(largest, abs(x[0])), u
        assert last == pytest.approx(-(0.3 + load * B0 * DT * 200) / B0, rel=0.05)
        moved.append(largest)
    assert moved[0] < 0.05 * moved[1]


def test_a_start_at_rest_has_no_rate_of_f_and_continues_u() -> None:
    """The derivatives end at zero; u is what held the plant, and a retuned observer keeps it."""
    controller = ql.ADRC(chain(3), OMEGA_C)
    controller.start(y=0.5, u=0.7)
    np.testing.assert_allclose(controller.estimate.f_derivatives, 0.0, atol=1e-6)
    assert controller.step(0.5, 0.5) == pytest.approx(0.7, rel=1e-6)
    controller.retune(observer=ql.ESO.model_free(2, B0, 1.3 * OMEGA_O, DT, disturbance_order=3))
    assert controller.step(0.5, 0.5) == pytest.approx(0.7, rel=1e-6)
    tracked = ql.ADRC(chain(2), OMEGA_C)
    for _ in range(1500):
        tracked.track(0.5, 0.5, 0.7)
    tracked.hand_over()
    assert tracked.step(0.5, 0.5) == pytest.approx(0.7, rel=1e-6)


# ---- refusals


@cases("wrong", [0, 4, -1, 1.5, "two", True, None])
def test_another_number_of_states_is_refused(wrong: Any) -> None:
    """It is a whole number from 1 to 3."""
    makers = (
        lambda: chain(wrong),
        lambda: ql.ESO.model_based(SPRING, OMEGA_O, DT, disturbance_order=wrong),
        lambda: ql.ESO.cascade(2, B0, OMEGA_O, DT, disturbance_order=wrong),
        lambda: ql.ESO.nonlinear(2, B0, OMEGA_O, DT, delta=0.1, disturbance_order=wrong),
        lambda: ql.ESO.kalman(2, B0, DT, noise_variance=1e-6, drift=1.0, disturbance_order=wrong),
    )
    for make in makers:
        with pytest.raises((ValueError, TypeError), match="disturbance_order"):
            make()


@pytest.mark.trial
def test_what_needs_one_extended_state_refuses_more_and_says_why() -> None:
    """Guard, certificate, the equivalent PID controller, tuning for k_i; poles, starts, other observers."""
    more, learner = chain(2), ql.learners.Kalman()
    with pytest.raises(ValueError, match="a ramp of f_L moves nothing.*disturbance_order=1"):
        ql.ADRC(more, OMEGA_C, learner=learner, guard=ql.Guard())
    with pytest.raises(ValueError, match="a parabola of f_L moves nothing"):
        ql.Guard().design(chain(3))
    with pytest.raises(ValueError, match="guard with disturbance_order = 2"):
        certify(SPRING, ql.ADRC(more, OMEGA_C, learner=learner))
    with pytest.raises(ValueError, match="so many integrators"):
        ql.baselines.equivalent_pid(ql.ADRC(more, OMEGA_C))
    with pytest.raises(ValueError, match="k_i is infinite with 2 integrators"):
        ql.tune(SPRING, DT, structure="bandwidths-2", objective="load", order=1, compare=())
    with pytest.raises(ValueError, match="poles"):
        chain(2, poles=[-1.0, -1.0, -1.0])
    with pytest.raises(ValueError, match="the observer estimates 2 of f, f'"):
        ql.ADRC(more, OMEGA_C).start_at([0.0, 0.0], f=[1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="observer has disturbance_order = 1, the present one 2"):
        ql.ADRC(more, OMEGA_C).retune(observer=chain(1))


# ---- files, C


@pytest.mark.parametrize("m", [1, 2, 3])
def test_a_setup_file_has_it_and_is_the_same_after_saving(tmp_path: Path, m: int) -> None:
    """The observer's key ``disturbance_order``; the default need not be said."""
    path = tmp_path / "setup.toml"
    line = f"omega_o = 10.0\ndisturbance_order = {m}\n" if m > 1 else "omega_o = 10.0\n"
    path.write_text(TWO_MASS.replace("omega_o = 10.0\n", line))
    setup = ql.setup.load(path)
    assert setup.controller.observer.disturbance_order == m
    again = tmp_path / "again.toml"
    again.write_text(toml_text(setup.tables()))
    assert repr(ql.setup.load(again).controller) == repr(setup.controller)
    assert ("disturbance_order=" in repr(setup.controller)) == (m > 1)


def test_the_form_of_the_studio_has_a_field_for_it() -> None:
    """Of every kind of observer, with its default; the page shows it with its range."""
    for about in forms(Granted((), trust=True))["one"]["observer"].values():
        (field,) = (key for key in about["keys"] if key["key"] == "disturbance_order")
        assert (field["type"], field["default"], field["needed"]) == ("whole number", 1, False)
    page = resources.files("quell.studio") / "page/panels/forms.js"
    assert "RANGES = { disturbance_order: [1, 3] }" in page.read_text(encoding="utf-8")


def test_a_comparison_has_no_k_i_with_two_integrators() -> None:
    """It is infinite, as after a step of the load the integral of y is zero; in a file for programs it is None."""
    plant = ([B0], [1.0, 0.3, 2.0])
    k_i = [sensitivities(plant, ql.ADRC(chain(m), OMEGA_C)).k_i for m in (1, 2, 3)]
    loop = analyse(plant, ql.ADRC(chain(1), OMEGA_C))
    assert k_i[0] == pytest.approx(1e-4 / abs(loop.response("PS", [1e-4])[0]), rel=1e-3)
    assert k_i[1:] == [math.inf, math.inf]


@pytest.mark.trial
def test_a_tuned_controller_has_its_states_and_its_k_i_is_infinite() -> None:
    """The loop keeps its bounds; the controller of the file is the tuned one."""
    plant, bounds = ([B0], [1.0, 0.3, 2.0]), ql.tuning.Constraints(m_s=1.7, m_ks=60.0)
    tuned = ql.tune(plant, DT, structure="bandwidths-2", order=2, constraints=bounds, compare=())
    assert tuned.controller.observer.disturbance_order == 2
    assert tuned.design.k_i == math.inf
    assert tuned.design.to_json()["k_i"] is None
    assert tuned.design.measures["M_s"] <= 1.7 * 1.001
    assert tuned.design.tables["observer"]["disturbance_order"] == 2
    y = errors(plant, tuned.controller, 1, 60.0)
    assert abs(y[-1]) < 1e-6 * np.max(np.abs(y))
    # One integrator rejects a step of the load better, and the report says so.
    assert tuned.designs["bandwidths"].objective < tuned.design.objective
    line = "NOT better with 2 integrators: bandwidths of order 2 has one, and is at least as good"
    assert any(each.startswith(line) for each in tuned.costs), tuned.costs


@needs_gcc
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("m", [2, 3])
def test_exported_c_is_the_interpreted_controller_to_the_bit(
    tmp_path: Path, m: int, precision: str
) -> None:
    """With noise and limits; the estimate has ``f_derivatives``."""
    controller: Any = ql.ADRC(chain(m), OMEGA_C, u_min=-3.0, u_max=3.0)
    if precision == "single":
        controller = in_single_precision(controller)
    source = c_source(controller, "servo")
    assert "f_derivatives" + (f"[{m - 1}]" if m > 2 else "") in source.header
    in_c, noise = InC(source, tmp_path), np.random.default_rng(0).normal(size=300)
    for k, value in enumerate(noise):
        r, y = float(np.float32(0.01 * k)), float(np.float32(0.01 * value))
        assert in_c.run("step", r, y) == controller.step(r, y)
