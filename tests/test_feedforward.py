"""Feedforward by a model of the plant: what it does to the loop, and what the observer makes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.feedforward import inverse_series, shifted
from quell.setup import load

from .benchmark_module import benchmark
from .cases import cases
from .in_c import needs_gcc

DT = 1e-3
MOVE = ql.signals.SmoothMove(1.5, 0.5, smoothness=4, start=0.1)
B = 800.0
AXIS = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, B], [1.0, 0.0])
# Two masses of 1 and 2 on a spring of 50 with a damper of 0.1, y that of the first.
TWO_MASSES = ([2.0, 0.1, 50.0], [2.0, 0.3, 150.0, 0.0, 0.0])
SPRING = ql.plants.LinearPlant([[0.0, 1.0], [-30.0, -4.0]], [0.0, B], [1.0, 0.0])


def follow(plant: Any, feedforward: Any, b0: float = 5.0 * B, **options: Any) -> ql.Trajectory:
    """Return a run of the move with a model-free observer of order 2, or with a given one."""
    observer = options.pop("observer", None) or ql.ESO.model_free(2, b0, 150.0, DT)
    controller = ql.ADRC(observer, 40.0, feedforward=feedforward, **options)
    scenario = ql.Scenario(reference=MOVE, duration=0.8)
    return ql.simulate(plant, controller, scenario, interpret=True)


def error(run: ql.Trajectory) -> float:
    """Return the largest error over the distance."""
    return float(np.max(np.abs(run["y"] - run["r"])) / MOVE.distance)


@pytest.mark.trial
@cases("plant", [AXIS, SPRING], ids=["axis", "spring"])
@cases("b0", [B, 5.0 * B])
def test_with_the_exact_model_the_feedback_has_nothing_to_do(plant: Any, b0: float) -> None:
    """Whatever b0 is: y = r, u = u_ff and no disturbance, up to what a held u leaves of (dt/T)²."""
    run = follow(plant, ql.Feedforward.of(plant), b0)
    assert error(run) < 1e-5
    feedback = np.abs(run["u"] - np.ravel(run["u_feedforward"]))
    assert np.max(feedback) < 2e-4 * np.max(np.abs(run["u"]))
    wished = np.max(np.abs(MOVE.derivative().derivative()(run.t)))
    assert np.max(np.abs(run["f_residual"])) < 1e-3 * wished


def test_the_laws_own_feedforward_misses_by_the_factor_of_b0() -> None:
    """The reason for a model: r''/b0 is a fifth of what moves the plant if b0 is five times b."""
    assert error(follow(AXIS, True, B)) < 3e-4
    assert error(follow(AXIS, True)) > 0.05


@pytest.mark.trial
@pytest.mark.parametrize("known", [False, True])
def test_a_delay_is_compensated_whether_or_not_the_observer_knows_it(known: bool) -> None:
    """By derivatives of the reference; one more of them brings the error down by far."""
    plant = ql.plants.delayed(AXIS, 2.0 * DT, DT)
    observer = ql.ESO.model_free(2, 5.0 * B, 150.0, DT, delay=2.0 * DT if known else 0.0)
    model = ql.Feedforward.of(plant)
    assert model.delay == 2.0 * DT
    ahead, late = (
        error(follow(plant, each, observer=observer)) for each in (model, replace(model, delay=0.0))
    )
    fewer = error(follow(plant, replace(model, derivatives=2), observer=observer))
    assert ahead < 0.1 * fewer
    assert ahead < 0.1 * late
    more = error(follow(plant, replace(model, derivatives=4), observer=observer))
    assert more < 0.1 * ahead


@pytest.mark.trial
def test_friction_and_gravity_of_the_model_are_no_disturbance() -> None:
    """A plant with both, at constant speed: f̂ without them holds both, with them neither."""
    force, weight = 0.02, 0.05

    def sliding(t: float, x: Any, u: float, w: Any) -> Any:
        return x[1], B * (u - force * np.tanh(x[1] / 1e-3) - weight)

    plant = ql.plants.NonlinearPlant(sliding, order=2)
    ramp = ql.Scenario(reference=ql.signals.Ramp(1.0), duration=0.6)
    found = {}
    for name, more in (("without", {}), ("with", {"coulomb": force, "constant": weight})):
        model = ql.Feedforward.rigid(1.0 / B, **more)
        controller = ql.ADRC(ql.ESO.model_free(2, B, 150.0, DT), 40.0, feedforward=model)
        run = ql.simulate(plant, controller, ramp, interpret=True)
        found[name] = float(run["f_residual"][-1] / B)
    assert found["without"] == pytest.approx(-(force + weight), rel=1e-3)
    assert found["with"] == pytest.approx(0.0, abs=1e-3 * force)


def test_coulomb_friction_is_in_proportion_below_its_speed() -> None:
    """And has the sign of the speed at which u acts, half a sample later."""
    model = ql.Feedforward((0.0,), coulomb=2.0, coulomb_speed=0.5, derivatives=2)
    controller = ql.ADRC(ql.ESO.model_free(2, 1.0, 150.0, DT), 40.0, feedforward=model)

    def given(*derivatives: float) -> float:
        controller.reset()
        return controller.step(0.0, 0.0, *derivatives)

    law = 80.0  # of r' in the numerator, b0 = 1
    assert given(0.25, 0.0) - law * 0.25 == pytest.approx(1.0)
    assert given(-0.7, 0.0) + law * 0.7 == pytest.approx(-2.0)
    ahead = 2.0 * (0.25 + 0.5 * DT * 10.0) / 0.5
    assert given(0.25, 10.0) - law * 0.25 == pytest.approx(ahead)


def test_no_margin_depends_on_the_feedforward() -> None:
    """The loop of the errors is the one without it, also with friction and a constant."""
    observer = ql.ESO.model_free(2, 5.0 * B, 150.0, DT)
    model = ql.Feedforward.of(SPRING, coulomb=0.1, constant=0.2)
    plain, fed = (
        ql.analysis.analyse(SPRING, ql.ADRC(observer, 40.0, feedforward=each))
        for each in (False, model)
    )
    assert fed.margins.modulus == pytest.approx(plain.margins.modulus, rel=1e-9)
    omega = np.geomspace(1.0, 3000.0, 20)
    np.testing.assert_allclose(fed.response("L", omega), plain.response("L", omega), rtol=1e-9)


def test_a_load_is_answered_as_without_feedforward() -> None:
    """The response to a disturbance during the move is that of the loop at rest."""
    observer = ql.ESO.model_free(2, 5.0 * B, 150.0, DT)
    plant = ql.plants.LinearPlant(AXIS.A, AXIS.B, AXIS.C, [[0.0], [B]])
    load = ql.signals.Step(0.1, at=0.3)
    runs = [
        ql.simulate(
            plant,
            ql.ADRC(observer, 40.0, feedforward=each),
            ql.Scenario(reference=reference, disturbances=(load,), duration=0.6),
            interpret=True,
        )
        for each, reference in ((ql.Feedforward.of(AXIS), MOVE), (False, ql.signals.Constant(0.0)))
    ]
    moving, resting = (run["y"] - run["r"] for run in runs)
    np.testing.assert_allclose(moving, resting, atol=2e-3 * np.max(np.abs(resting)))


@pytest.mark.parametrize("terms", [2, 4, 6])
def test_each_term_of_a_series_comes_closer_to_the_inverse(terms: int) -> None:
    """Of a plant with zeros, at a quarter of their frequency: the rest is of the next even power."""
    axis = benchmark("servo_move").axis()
    model = ql.Feedforward.of(axis, terms=terms)
    omega = 0.25 * np.min(np.abs(ql.canonical(axis).zeros))
    s = 1j * omega
    exact = 1.0 / (axis.C @ np.linalg.solve(s * np.eye(4) - axis.A, axis.B))[0, 0]
    found = sum(c * s**i for i, c in enumerate(model.coefficients))
    assert abs(found - exact) < 1.5 * 0.25**terms * abs(exact)
    assert len(model.coefficients) == terms + 1


def test_the_series_of_a_plant_without_zeros_is_its_polynomial() -> None:
    """Flat: (s³ + 3 s² + 2 s + 5)/4, and nothing beyond; a shift is the series of an exponential."""
    plant = ([4.0], [1.0, 3.0, 2.0, 5.0])
    assert ql.Feedforward.of(plant).coefficients == pytest.approx((1.25, 0.5, 0.75, 0.25))
    np.testing.assert_allclose(
        inverse_series(ql.canonical(plant), 5), [5.0, 2.0, 3.0, 1.0, 0.0, 0.0], atol=1e-12
    )
    np.testing.assert_allclose(
        shifted(np.array([1.0, 0.0, 0.0, 0.0]), 0.5), [1, 0.5, 1 / 8, 1 / 48]
    )


def test_a_model_based_observer_with_zeros_is_told_the_same() -> None:
    """The axis with its encoder at the motor, b0 five times too large: the error is as small."""
    axis = benchmark("servo_move").axis()
    plain = ql.canonical(axis)
    observer = ql.ESO.model_based(axis, 800.0, 2.5e-4, b0=5.0 * plain.b)
    scenario = ql.Scenario(reference=benchmark("servo_move").MOVE, duration=0.2)
    errors = [
        np.max(np.abs(run["y"] - run["r"]))
        for run in (
            ql.simulate(axis, ql.ADRC(observer, 60.0, feedforward=each), scenario, interpret=True)
            for each in (ql.Feedforward.of(axis), True)
        )
    ]
    assert np.degrees(errors[0]) < 0.03
    assert errors[0] < 0.05 * errors[1]


def test_the_flat_output_of_two_masses_is_the_second_one() -> None:
    """d(s)/n(0) and n(s)/n(0) by hand: the inertia of both, and y ahead of z by z''/ω_a²."""
    found = ql.Feedforward.of(TWO_MASSES, flat=True)
    assert found.coefficients == pytest.approx((0.0, 0.0, 3.0, 0.006, 0.04))
    assert found.numerator == pytest.approx((1.0, 0.002, 0.04))
    assert ql.Feedforward.of(SPRING, flat=True) == ql.Feedforward.of(SPRING)
    assert "for y = r + … + 0.04 r^(2)" in found.describe()


@pytest.mark.parametrize("model", [False, True])
def test_a_move_of_the_flat_output_leaves_no_mode_swinging(model: bool) -> None:
    """In 1.2 periods of the mode: y is n(s) r on the way, and the feedback has nothing to do."""
    plant, dt = ql.plants.LinearPlant.of(TWO_MASSES), 2e-3
    move = ql.signals.SmoothMove(1.0, 0.87, smoothness=4, start=0.02)
    observer = ql.ESO.model_free(2, 0.5, 40.0, dt)
    if model:
        observer = ql.ESO.model_based(plant, 40.0, dt, b0=2.0)
    forward = ql.Feedforward.of(plant, flat=True)
    runs = [
        ql.simulate(
            plant,
            ql.ADRC(observer, 8.0, feedforward=each),
            ql.Scenario(move, duration=1.2),
            interpret=True,
        )
        for each in (forward, ql.Feedforward.of(plant, terms=2))
    ]
    y, _ = forward.linear_part(move, runs[0].t, dt)
    errors = [float(np.max(np.abs(run["y"] - y))) for run in runs]
    assert errors[0] < 2e-3
    assert errors[1] > 30.0 * errors[0]
    assert np.max(np.abs(y - runs[0]["r"])) > 0.1


def test_a_retuned_or_handed_over_loop_keeps_what_the_model_knows() -> None:
    """In the middle of the move u does not jump, and the observer finds no new disturbance."""
    model = ql.Feedforward.of(AXIS)
    observers = [ql.ESO.model_free(2, factor * B, 150.0, DT) for factor in (5.0, 3.0)]
    controller = ql.ADRC(observers[0], 40.0, feedforward=model)
    x, signals = np.zeros(2), [MOVE]
    for _ in range(3):
        signals.append(signals[-1].derivative())
    u, largest = 0.0, 0.0
    for k in range(600):
        r = [float(signal(k * DT)) for signal in signals]
        before = u
        u = controller.step(r[0], x[0], *r[1:])
        if 300 <= k <= 302:
            largest = max(largest, abs(u - before))
        if k == 300:
            controller.retune(observer=observers[1], omega_c=50.0)
        x = np.array([x[0] + DT * x[1] + 0.5 * DT**2 * B * u, x[1] + DT * B * u])
    assert largest < 2.0 * DT * np.max(np.abs(signals[3](np.linspace(0.1, 0.6, 500)))) / B
    assert abs(controller.estimate.f) < 1e-3 * B


@cases(
    ("make", "rule"),
    [
        (lambda: ql.Feedforward(()), "coefficients has 0 numbers"),
        (lambda: ql.Feedforward((1.0,), delay=-1.0), "delay = -1.0"),
        (lambda: ql.Feedforward((1.0,), coulomb_speed=0.1), "without coulomb: has no effect"),
        (lambda: ql.Feedforward((1.0,), derivatives=0), "derivatives = 0"),
        (lambda: ql.Feedforward.rigid(0.0), "inertia = 0.0"),
        (lambda: ql.Feedforward((1.0,), numerator=(2.0, 1.0)), "must begin with 1"),
        (lambda: ql.Feedforward.of(TWO_MASSES, flat=True, terms=2), "terms = 2"),
        (
            lambda: ql.ADRC(
                ql.ESO.model_free(2, 1.0, 9.0, 0.01),
                3.0,
                feedforward=ql.Feedforward.of(TWO_MASSES, flat=True),
                feedback=ql.controllers.NonlinearFeedback((0.5, 1.0), (0.1, 0.1)),
            ),
            "numerator with a schedule or a nonlinear feedback",
        ),
        (lambda: ql.Feedforward.of(([1.0, 0.0], [1.0, 1.0, 1.0])), "zero at s = 0"),
        (lambda: ql.ADRC(ql.ESO.model_free(2, 1.0, 9.0, 0.01), 3.0, feedforward=1.0), "quell.Feed"),
        (
            lambda: ql.ADRC(
                ql.ESO.model_based(([1.0], [1.0, 1.0]), 9.0, 0.01), 3.0, feedforward="model"
            ),
            "must be true or false, or quell.Feedforward",
        ),
    ],
)
def test_what_can_not_be_fed_forward_is_refused(make: Any, rule: str) -> None:
    """By name, with the rule."""
    with pytest.raises(ValueError, match=rule):
        make()


def test_an_observer_with_another_input_of_f_is_refused() -> None:
    """It can't be told what enters where u does."""
    plant = ([[0.0, 1.0], [-1.0, -1.0]], [1.0, 0.0], [0.0, 1.0], [1.0, 0.0])
    observer = ql.ESO.model_based((plant[0], plant[1], plant[3]), 9.0, 0.01, E=[0.0, 1.0])
    with pytest.raises(ValueError, match="enters through E"):
        ql.ADRC(observer, 3.0, feedforward=ql.Feedforward((1.0,)))


def test_a_delay_of_part_of_a_sample_is_the_feedforwards_too() -> None:
    """All of it, not only its whole samples."""
    assert ql.Feedforward.of(ql.plants.delayed(SPRING, 1.4 * DT, DT)).delay == pytest.approx(
        1.4 * DT
    )


@pytest.mark.trial
def test_the_tuner_writes_the_feedforward_of_the_model(tmp_path: Path) -> None:
    """Into controller, summary and setup; a PID has none; no margin changes."""
    late = ql.plants.delayed(SPRING, DT, DT)
    constraints = ql.tuning.Constraints(m_ks=1.0)
    how: dict[str, Any] = {"structure": "bandwidths", "compare": (), "constraints": constraints}
    plain, tuned = (ql.tune(late, DT, **how, feedforward=each) for each in (False, True))
    assert tuned.controller.feedforward == ql.Feedforward.of(late)
    assert tuned.design.values == plain.design.values
    assert "feedforward: u = 0.0375 r + 0.005 r' + 0.00125 r''" in tuned.summary()
    tuned.save(tmp_path / "tuned.toml")
    assert load(tmp_path / "tuned.toml").controller.feedforward == tuned.controller.feedforward
    assert "feedforward" not in plain.toml()
    with pytest.raises(ValueError, match="feedforward: pi has none; give a structure that has"):
        ql.tune(late, DT, **how | {"structure": "pi"}, feedforward=True)


@pytest.mark.trial
def test_the_simplest_structure_is_one_that_can_feed_forward() -> None:
    """Where that is asked for; PID, which is simpler, has no feedforward."""
    how: dict[str, Any] = {"compare": ("pid", "bandwidths"), "objective": "load"}
    lags = [1.0], [1.0, 3.0, 3.0, 1.0]
    assert ql.tune(lags, 0.02, **how).design.name == "pid"
    tuned = ql.tune(lags, 0.02, **how, feedforward=True)
    assert tuned.design.name.startswith("bandwidths")
    assert tuned.controller.feedforward == ql.Feedforward.of(lags)


@pytest.mark.trial
@pytest.mark.parametrize("structure", ["bandwidths", "p-pi-notch"])
def test_tracking_is_optimised_with_the_feedforward_that_runs(structure: str) -> None:
    """The objective is the RMS of the simulated error, for a plant that is not the model."""
    move = ql.signals.SmoothMove(distance=1.0, duration=1.0)
    true = [9.0], [1.0, 3.0, 0.0]
    how: dict[str, Any] = {"objective": "tracking", "reference": move, "duration": 3.0}
    how |= {"structure": structure, "compare": (), "dt": 5e-3}
    model = ql.Feedforward.of(([12.0], [1.0, 3.0, 0.0]), terms=2)
    constraints = ql.tuning.Constraints(m_ks=40.0)
    tuned = ql.tune(true, feedforward=model, constraints=constraints, **how)
    scenario = ql.Scenario(reference=move, duration=3.0)
    run = ql.simulate(ql.plants.LinearPlant.of(true), tuned.controller, scenario)
    error = float(np.sqrt(np.mean((run["r"] - run["y"]) ** 2)))
    assert tuned.design.objective == pytest.approx(error, rel=0.02)
    plain = ql.tune(true, constraints=constraints, **how)
    assert tuned.design.objective < 0.5 * plain.design.objective


SETUP = """dt = 0.001
plant = { kind = "linear", A = [[0.0, 1.0], [0.0, -0.6]], B = [0.0, 2.0], C = [1.0, 0.0] }
observer = { kind = "model-free", order = 2, b0 = 10.0, omega_o = 60.0 }
controller = { omega_c = 20.0, feedforward = GIVEN }
"""


@cases(
    ("given", "expected"),
    [
        ("true", True),
        ('"model"', ql.Feedforward((0.0, 0.3, 0.5))),
        (
            '{ kind = "rigid", inertia = 0.5, coulomb = 0.1 }',
            ql.Feedforward.rigid(0.5, coulomb=0.1),
        ),
        (
            '{ kind = "series", coefficients = [1.0], delay = 0.1, numerator = [1.0, 0.2] }',
            ql.Feedforward((1.0,), delay=0.1, numerator=(1.0, 0.2)),
        ),
    ],
)
def test_a_setup_file_has_each_kind(tmp_path: Path, given: str, expected: Any) -> None:
    """The kind model takes the plant of the file by default."""
    (tmp_path / "setup.toml").write_text(SETUP.replace("GIVEN", given))
    assert load(tmp_path / "setup.toml").controller.feedforward == expected


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ("1", "controller.feedforward = 1: must be true or false"),
        ('{ kind = "rigid" }', "controller.feedforward.inertia: missing"),
        ('"serie"', "did you mean series"),
    ],
)
def test_a_setup_file_with_another_one_is_refused(tmp_path: Path, given: str, rule: str) -> None:
    """With the path of the key."""
    (tmp_path / "setup.toml").write_text(SETUP.replace("GIVEN", given))
    with pytest.raises(ValueError, match=rule):
        load(tmp_path / "setup.toml")


@pytest.mark.trial
def test_a_tuned_servo_axis_moves_by_a_quarter_turn_within_its_bars() -> None:
    """90° in 0.12 s with a model-based observer: 0.3° with the right inertia, 0.8° with 30 % more."""
    move = benchmark("servo_move")
    controller = move.tuned("model-based")
    for factor in (1.0, 1.3):
        run = move.run_of(controller, factor, interpret=True)
        assert move.error_of(run) < move.BARS[factor]


@pytest.mark.trial
@needs_gcc
def test_the_exported_servo_has_the_feedforward_bit_for_bit() -> None:
    """All derivatives are arguments of its step."""
    move = benchmark("servo_move")
    observer = ql.ESO.model_free(2, 4400.0, 2000.0, move.DT)
    model = ql.Feedforward.of(move.axis(), delay=move.DT)
    controller = ql.ADRC(observer, 44.0, feedforward=model, u_min=-3.5, u_max=3.5)
    run = move.run_of(controller, 1.3, interpret=True)
    assert move.in_c(controller, run) == 0.0
