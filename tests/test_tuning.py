"""The optimiser of linear loops: responses, stability, optima, constraints, results, errors."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.quantities import Signals
from quell.setup import load
from quell.tuning import Constraints, designs, report
from quell.tuning.optimiser import loops, requirements, search
from quell.tuning.optimiser.requirements import sizes
from quell.tuning.plants import given_plants, model_of, plant_set
from quell.tuning.structures.adrc import equivalents
from quell.tuning.structures.registry import make_structure

from .cases import cases

LAGS = ([1.0], [1.0, 3.0, 3.0, 1.0])
DT = 0.02
ALL_STRUCTURES = [
    ("pi-unfiltered", 0), ("pi", 0), ("pid", 0), ("bandwidths", 1), ("bandwidths", 3),
    ("poles", 2), ("poles", 3), ("half-gain", 2), ("half-gain-law", 2), ("reduced", 2),
    ("model-based", 0), ("model-based-poles", 0), ("delay", 1), ("delay-poles", 2),
    ("bandwidths-2", 1), ("bandwidths-2", 2), ("bandwidths-3", 2), ("poles-2", 1), ("poles-2", 2),
    ("poles-3", 1), ("poles-3", 2), ("model-based-2", 0),
    ("resonator", 1), ("resonator", 2), ("resonator-2", 2),
]  # fmt: skip


def loop_of(plant: Any, dt: float, delay: float = 0.0) -> Any:
    """Return a set of one plant and what structures know of it."""
    given = given_plants(plant, dt, delay=delay)
    plants = plant_set(given, dt)
    return plants, model_of(given, plants, Constraints())


@pytest.fixture(scope="module")
def tuned() -> ql.Tuned:
    """Three lags under the usual constraints, tuned for the integral gain."""
    how: dict[str, Any] = {"structure": "poles", "objective": "load"}
    return ql.tune(LAGS, DT, order=2, compare=("pi", "pid", "bandwidths"), **how)


# ---- structures


@pytest.mark.parametrize(("name", "order"), ALL_STRUCTURES)
def test_the_response_of_a_structure_is_that_of_the_controller_it_builds(
    name: str, order: int
) -> None:
    """C_y of its starts, as ``analyse`` has it from the controller's own step."""
    _, model = loop_of(LAGS, DT, 10 * DT)
    structure = make_structure(name, model, order)
    values = structure.shapes()[5:7]
    omega = np.array([0.01, 0.3, 2.0, 40.0])
    found = structure.response(values, omega)
    for row, response in zip(values, found, strict=True):
        loop = analyse(LAGS, structure.controller(row), delay=10 * DT)
        np.testing.assert_allclose(response, loop.response("C_y", omega), rtol=1e-7)


@cases(("name", "order"), ALL_STRUCTURES)
def test_the_integral_gain_is_the_residue_at_zero_frequency(name: str, order: int) -> None:
    """``C_y → k_i dt/(z − 1)`` for ω → 0, its real part counts; infinite with two integrators."""
    _, model = loop_of(LAGS, DT, 10 * DT)
    structure = make_structure(name, model, order)
    values = structure.shapes()[-8:-6]
    omega = np.array([1e-6])
    if structure.integrators > 1:
        assert np.all(structure.integral_gain(values) == np.inf)
        return
    residue = structure.response(values, omega)[:, 0] * np.expm1(1j * omega * DT) / DT
    np.testing.assert_allclose(structure.integral_gain(values), residue.real, rtol=1e-4)


@pytest.mark.parametrize(
    ("plant", "delay", "order"),
    [
        (LAGS, 0.0, 2),
        (([1.0], [1.0, 0.0, 0.0]), 0.0, 2),
        (([1.0], [1.0, 0.0, -1.0]), 0.0, 2),
        (([1.0], [1.0, 1.0]), 1.0, 1),
        (ql.plants.two_mass_spring(), 0.0, 4),
    ],
)
def test_unstable_loops_are_counted_as_their_poles_are(
    plant: Any, delay: float, order: int
) -> None:
    """With integrators, an unstable plant, a dead time, an undamped resonance."""
    plants, model = loop_of(plant, DT, delay)
    structure = make_structure("bandwidths", model, order)
    values = structure.shapes()
    values = np.vstack([values * [factor, 1.0, 1.0] for factor in (0.2, 1.0, 5.0)])
    found = plants.unstable_loops(
        structure.response(values, plants.omega), structure.unstable_poles(values)
    )[:, 0]
    seen = np.isfinite(found)
    assert np.sum(seen) > 0.6 * seen.size
    compared = set()
    for row, count in zip(values[seen][::4], found[seen][::4], strict=True):
        poles = analyse(plant, structure.controller(row), delay=delay).poles
        if np.min(np.abs(np.abs(poles) - 1.0)) > 1e-4:
            assert (count > 0.5) == (np.max(np.abs(poles)) > 1.0), row
            compared.add(count > 0.5)
    assert compared == {False, True}


@pytest.mark.parametrize("order", [1, 2])
def test_a_freed_adrc_has_the_feedback_of_a_filtered_pi_or_pid_controller(order: int) -> None:
    """Up to the sampling, which differs by half a sample of delay."""
    dt = 1e-4
    _, model = loop_of(LAGS, dt)
    pid = make_structure("pi" if order == 1 else "pid", model)
    values = np.array([0.6, 2.0, 0.1] if order == 1 else [2.0, 2.0, 0.6, 0.1])
    adrc = make_structure("poles", model, order)
    rows = equivalents(pid, values, adrc)
    assert len(rows)
    omega = np.geomspace(1e-2, 1e2, 30)
    expected = pid.response(values[None, :], omega)[0]
    for row in rows:
        found = adrc.response(row[None, :], omega)[0]
        np.testing.assert_allclose(found, expected, rtol=1.5e-2)


# ---- optima


@pytest.mark.trial
def test_constraints_hold_on_a_grid_a_hundred_times_finer(tuned: ql.Tuned) -> None:
    """Within 0.1 %, and each active one is reached."""
    x = np.log(tuned.plants.omega)
    fine = np.exp(np.linspace(x[0], x[-1], 100 * x.size))
    P = tuned.plants.responses(fine)
    limits = {"M_s": 1.6, "M_t": 1.6, "M_ks": tuned.constraints.m_ks}
    for design in tuned.designs.values():
        C = design.solution.structure.response(design.solution.values[None, :], fine)[0]
        worst = {kind: float(np.max(sizes(kind, P, C))) for kind in limits}
        assert all(worst[kind] <= 1.001 * limit for kind, limit in limits.items())
        for active in design.active:
            if active.name in worst:
                assert worst[active.name] == pytest.approx(active.value, rel=1e-3)
        assert any(worst[kind] > 0.995 * limit for kind, limit in limits.items())


def test_measures_are_those_of_the_analysis(tuned: ql.Tuned) -> None:
    """M_s, M_ks, the gain of noise and the delay margin of ``LoopAnalysis``."""
    measures, loop = tuned.design.measures, tuned.analysis
    assert loop.stable
    assert measures["M_s"] == pytest.approx(1.0 / loop.margins.modulus, rel=1e-5)
    assert measures["M_ks"] == pytest.approx(loop.noise_to_control_peak, rel=1e-4)
    assert measures["noise_gain"] == pytest.approx(loop.noise_to_control, rel=1e-3)
    assert measures["delay_margin"] == pytest.approx(loop.margins.delay, rel=1e-4)


def test_freed_poles_are_better_than_bandwidths_and_pid(tuned: ql.Tuned) -> None:
    """At ten times the M_ks of the optimal PI controller; the result says by how much."""
    k_i = {name: design.k_i for name, design in tuned.designs.items()}
    assert k_i["poles"] > 1.0 * k_i["pid"] > k_i["bandwidths"] > 2.0 * k_i["pi"]
    assert any("PID" in line for line in tuned.costs)
    assert "best of those tried" in tuned.costs[-1]


@pytest.mark.parametrize(("objective", "better"), [("load", "more"), ("load-iae", "less")])
def test_costs_are_one_ratio_of_values(objective: str, better: str, tuned: ql.Tuned) -> None:
    """The value of a structure over that of the other one, whether it is the best or not."""
    pair = [replace(tuned.design, name=name, objective=x) for name, x in (("a", 2.0), ("b", 3.0))]
    named, what = {each.name: each for each in pair}, f"{report.quantity(objective)} ({better}"
    lines = [report.costs(each, named, objective)[-1] for each in pair]
    best = 1 if objective == "load" else 0
    ratio = {0: "0.667", 1: "1.5"}[1 - best]
    first, last = pair[best].name, pair[1 - best].name
    start = f"{last} has {ratio} times the {what} is better) of"
    assert lines[1 - best] == f"{start} {first}, the best of those tried"
    assert lines[best] == f"{first} is the best of those tried; next: {start} it"


def test_unstable_loops_have_the_worst_cost_without_a_warning() -> None:
    """Of an inertia whose gain varies by 30 %, with gains that are far too high, and with low ones."""
    one = [([gain], [2e-4, 2e-3, 0.0]) for gain in (1.0, 1.1, 1.2, 1.3)]
    plants = plant_set(given_plants(one, 1e-3), 1e-3)
    cost = requirements.cost_of(
        "load-iae", loops.SetResponses(plants, loops.load_step(plants)), 1.0
    )
    structure = make_structure("bandwidths", loop_of(one[0], 1e-3)[1], 2)
    stable, unstable = structure.shapes()[:1].copy(), structure.shapes()[:1].copy()
    stable[0], unstable[0] = (5e3, 10.0, 60.0), (50.0, 60.0, 400.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cost(structure, unstable)[0] == 200.0
        assert cost(structure, stable)[0] < 2.0


def test_a_bound_of_the_delay_margin_is_exceeded_by_a_smaller_one() -> None:
    """The ratio is that of the bound to the margin, which a loop's analysis gives as well."""
    given = ([1.0], [2e-4, 2e-3, 0.0])
    plants = plant_set(given_plants(given, 1e-3), 1e-3)
    over = loops.SetResponses(plants, loops.load_step(plants))
    structure = make_structure("pid", loop_of(given, 1e-3)[1], None)
    values = structure.shapes()[:3]
    margins = search.delay_margin(plants, structure, values)
    assert np.all(margins > 0.0)
    for least in (1e-4, 5e-3):
        (bound,) = [
            each
            for each in search.extras_of(Constraints(delay_margin=least), over)
            if each.name == "delay margin"
        ]
        np.testing.assert_allclose(bound.ratio(structure, values) * margins, least)


def test_a_structure_for_resonances_that_is_not_tried_is_named(tuned: ql.Tuned) -> None:
    """For a plant with a resonance, until it is among the designs."""
    assert "NOT tried: model-based-poles" in report.not_tried(tuned.designs, True)[0]
    assert report.not_tried(tuned.designs, False) == []
    assert report.not_tried({**tuned.designs, "model-based-poles": tuned.design}, True) == []


@pytest.mark.trial
def test_a_result_does_not_depend_on_what_it_is_compared_with(tuned: ql.Tuned) -> None:
    """An ADRC with free poles starts at the optimal PID controller also if that is not shown."""
    alone = ql.tune(LAGS, DT, order=2, structure="poles", objective="load", compare=())
    assert set(alone.designs) == {"poles"}
    assert alone.design.k_i == pytest.approx(tuned.design.k_i, rel=1e-3)


@pytest.mark.trial
def test_the_integral_gain_of_a_design_with_a_model_stands_for_its_load_response() -> None:
    """Without a bound a second slow pole gave a motor k_i = 19 000, with y swinging."""
    motor = ([50.0], [1.0, 22.0, 40.0, 0.0])
    how: dict[str, Any] = {"objective": "load", "compare": ()}
    free = Constraints(noise_over_pi=None)
    pi = ql.tune(motor, 1e-3, structure="pi-unfiltered", constraints=free, **how).design
    bounds = Constraints(m_ks=10.0 * pi.measures["M_ks"])
    found = ql.tune(motor, 1e-3, structure="model-based", constraints=bounds, **how).design
    assert 1.0 <= found.k_i * found.measures["iae"] <= 3.0
    assert "k_i |P S/ω|" in [each.name for each in found.active]


@pytest.fixture(scope="module")
def by_default() -> ql.Tuned:
    """Three lags by default."""
    return ql.tune(LAGS, DT)


@pytest.mark.trial
def test_the_default_is_as_good_as_the_best_structure_that_was_tried(by_default: ql.Tuned) -> None:
    """Its IAE is within 5 % of the least one; no simpler structure's is."""
    iae = {name: design.measures["iae"] for name, design in by_default.designs.items()}
    chosen = by_default.design.measures["iae"]
    assert chosen <= 1.05 * min(iae.values())
    simpler = ("pi", "pid", "bandwidths")[: ("pi", "pid", "bandwidths").index("pid")]
    assert all(iae[name] > 1.05 * min(iae.values()) for name in simpler)


@pytest.mark.trial
def test_the_default_does_not_ring(by_default: ql.Tuned) -> None:
    """All poles of its closed loop have a damping of 0.4 or more, as those of the plant have."""
    z = np.asarray(by_default.analysis.poles, dtype=complex)
    poles = np.log(z[z != 0.0]) / DT  # those at zero are gone after a sample
    slow = poles[np.abs(poles) < 0.5 * np.pi / DT]
    assert np.min(-slow.real / np.abs(slow)) > 0.4


@pytest.mark.trial
def test_a_prefilter_is_offered_where_the_step_overshoots(by_default: ql.Tuned) -> None:
    """With it a simulated step overshoots by 5 % and settles when the report says."""
    found, judged = by_default.reference_step, by_default.judged
    assert found.overshoot > 0.05
    assert "[prefilter]" in str(judged)
    controller = ql.controllers.Prefiltered(by_default.controller, judged.offered)
    scenario = ql.Scenario(reference=ql.signals.Step(), duration=60.0)
    plant = ql.plants.LinearPlant.of(LAGS)
    for one, overshoot in ((controller, 0.05), (by_default.controller, found.overshoot)):
        y = ql.simulate(plant, one, scenario)["y"]
        assert np.max(y) - 1.0 == pytest.approx(overshoot, abs=2e-3)


@pytest.mark.trial
def test_the_worst_case_of_a_set_is_that_of_all_its_plants() -> None:
    """The search looks at few plants at a time; the objective is that of the worst one."""
    gains = np.linspace(0.8, 1.2, 7)
    plants = [([gain], [1.0, 2.0, 1.0]) for gain in gains.tolist()]
    found = ql.tune(plants, DT, structure="bandwidths", order=2, compare=())
    assert found.design.objective == pytest.approx(found.design.measures["iae"], rel=1e-9)


@pytest.mark.trial
def test_noise_and_limits_of_u_give_the_bound_of_noise() -> None:
    """std(u) is at most 2 % of half the range of u, for the rounding of the encoder."""
    motor, step = ([45_000.0], [1.0, 3.3, 0.0]), 360.0 / 2**16
    bounds = Constraints(resolution=step)
    how: dict[str, Any] = {"structure": "bandwidths", "compare": (), "delay": 2e-3}
    found = ql.tune(motor, 1e-3, constraints=bounds, u_min=-0.5, u_max=0.5, **how)
    assert found.constraints.u_std == pytest.approx(0.01)
    assert found.design.measures["noise_gain"] * step / np.sqrt(12.0) <= 0.0101
    assert "2 % of half the range of u" in found.noise_bound


@pytest.mark.trial
@pytest.mark.parametrize("late", [False, True])
def test_the_resolution_of_a_plants_encoder_is_known(late: bool) -> None:
    """Counts and y of a turn, as 360 degrees, give the same design as the resolution; also behind a delay."""
    motor, limits = ql.plants.LinearPlant.of(([45_000.0], [1.0, 3.3, 0.0])), {"u_max": 0.5}
    seen = ql.plants.encoded(motor, 2**16, turn=360.0)
    how: dict[str, Any] = {"structure": "pid", "compare": (), "u_min": -0.5, **limits}
    found = ql.tune(ql.plants.delayed(seen, 2e-3, 1e-3) if late else seen, 1e-3, **how)
    bounds = Constraints(resolution=360.0 / 2**16)
    given = ql.tune(motor, 1e-3, constraints=bounds, delay=2e-3 if late else 0.0, **how)
    assert found.design.values == given.design.values
    assert found.noise_bound == given.noise_bound


@pytest.mark.trial
def test_an_encoder_does_not_replace_a_bound_that_is_given() -> None:
    """M_ks bounds what noise does to u, and without limits of u the noise bounds nothing."""
    seen = ql.plants.encoded(ql.plants.LinearPlant.of(([1.0], [1.0, 1.0, 1.0])), 4096)
    how: dict[str, Any] = {"structure": "pi", "compare": ()}
    bounds = Constraints(m_ks=3.0)
    found = ql.tune(seen, 0.1, constraints=bounds, u_min=-1.0, u_max=1.0, **how)
    assert (found.constraints.u_std, found.constraints.m_ks) == (None, 3.0)
    assert ql.tune(seen, 0.1, **how).constraints.u_std is None


def test_a_feedforward_that_the_cascade_does_not_use_is_refused() -> None:
    """It has inertia and viscous friction, and no Coulomb friction, gravity or delay."""
    motor, how = ([45_000.0], [1.0, 3.3, 0.0]), {"structure": "p-pi-notch", "compare": ()}
    given = ql.Feedforward.rigid(2e-5, coulomb=0.01, delay=1e-3)
    with pytest.raises(ValueError, match="coulomb, delay would have no effect"):
        ql.tune(motor, 1e-3, feedforward=given, **how)


@pytest.mark.parametrize("more", [{}, {"m_ks": 3.0}])
def test_a_noise_without_effect_is_refused(more: dict[str, float]) -> None:
    """It needs the limits of u, and says nothing beside M_ks."""
    bounds = Constraints(resolution=0.01, **more)
    with pytest.raises(ValueError, match="m_ks" if more else "u_min and u_max"):
        ql.tune(([1.0], [1.0, 1.0]), 0.1, constraints=bounds, structure="pi", compare=())


def test_limits_of_u_in_the_wrong_order_are_named() -> None:
    """Not the bound of noise that would follow from them."""
    how: dict[str, Any] = {"structure": "pi", "compare": (), "u_min": 1.0, "u_max": -1.0}
    with pytest.raises(ValueError, match=r"u_min = 1\.0, u_max = -1\.0"):
        ql.tune(([1.0], [1.0, 1.0]), 0.1, constraints=Constraints(resolution=0.01), **how)


@pytest.mark.trial
def test_without_a_pi_controller_of_use_the_bound_of_noise_is_that_of_a_pid_controller() -> None:
    """An integrated inertia has no PI controller, a damped one a bad one: k_i of 1e-4 for 1."""
    for den, least in (([1.0, 0.0, 0.0], 100.0), ([1.0, 3.3, 0.0], 30.0)):
        found = ql.tune(([1.0], den), 0.01, structure="pid", objective="load", compare=())
        assert "PID" in found.noise_bound
        assert "a guess" in found.noise_bound
        assert found.design.k_i > least


@pytest.mark.trial
def test_a_guessed_bound_of_noise_has_a_curve_and_a_known_one_none() -> None:
    """Five bounds of M_ks; the guess, in the middle, has the objective of the result."""
    found = ql.tune(LAGS, DT, structure="pid", compare=())
    limits, values = zip(*found.noise_curve, strict=True)
    assert limits == pytest.approx([found.constraints.m_ks * 2.0**k for k in range(-2, 3)])
    assert values[2] == found.design.objective
    assert sorted(values, reverse=True) == list(values)
    known = replace(Constraints(), m_ks=found.constraints.m_ks)
    assert ql.tune(LAGS, DT, structure="pid", compare=(), constraints=known).noise_curve == []


def test_the_knee_of_the_noise_is_where_doubling_it_brings_less_than_a_tenth() -> None:
    """In a step of two or of four, of a size and of a gain."""
    curve = [(1.0, 4.0), (2.0, 3.0), (4.0, 2.5), (8.0, 2.4), (32.0, 2.3)]
    assert "above 4 doubling it improves by less than 10 %" in report.noise_line(curve, "load-iae")
    assert report.noise_line(curve[:3], "load-iae").endswith("more noise in u still brings more")
    gains = [(limit, 1.0 / value) for limit, value in curve]
    assert "above 4 doubling" in report.noise_line(gains, "load")


@pytest.mark.trial
def test_without_any_pid_controller_of_use_noise_is_not_bounded_and_the_report_says_so() -> None:
    """Three integrators have none, so nothing tells how much of u noise may use."""
    found = ql.tune(([1.0], [1.0, 0, 0, 0]), 0.01, structure="bandwidths", order=3, compare=())
    assert found.noise_bound.startswith("NOT bounded: M_ks: neither a PI controller nor a PID")
    assert "give the limits of u" in found.noise_bound
    assert found.noise_bound in found.summary()


def test_the_law_of_a_freed_adrc_is_well_damped(tuned: ql.Tuned) -> None:
    """Its poles are those of the ideal response to the reference."""
    poles = tuned.design.solution.structure.poles(tuned.design.solution.values[None, :])[0][0]
    assert np.min(-poles.real / np.abs(poles)) >= 0.6 - 1e-9


@pytest.mark.trial
def test_the_tradeoff_is_monotone(tuned: ql.Tuned) -> None:
    """A lower limit costs integral gain, a higher one gives some; of the damping the reverse."""
    for name in {name for name, _, _ in tuned.tradeoff}:
        low, high = (value for key, _, value in tuned.tradeoff if key == name)
        if name == "damping":
            low, high = high, low
        assert low < tuned.design.k_i < high


@pytest.mark.trial
def test_limits_of_noise_and_delay_are_kept() -> None:
    """std(u) and the delay margin, as ``analyse`` finds them."""
    how: dict[str, Any] = {"structure": "pi", "compare": ()}
    free = ql.tune(LAGS, DT, **how).analysis
    noise, delay = 0.1 * 0.5 * free.noise_to_control, 1.3 * free.margins.delay
    bounds = Constraints(u_std=noise, noise_std=0.1, delay_margin=delay)
    loop = ql.tune(LAGS, DT, constraints=bounds, **how).analysis
    assert loop.margins.delay >= 0.999 * delay
    assert 0.1 * loop.noise_to_control <= 1.002 * noise


@pytest.mark.trial
def test_the_integral_of_the_error_is_that_of_a_simulation() -> None:
    """``load-iae``; and it is less than that of the loop with the largest integral gain."""
    how: dict[str, Any] = {"structure": "pi", "compare": ()}
    integral = {}
    for objective in ("load", "load-iae"):
        tuned = ql.tune(LAGS, DT, objective=objective, **how)
        scenario = ql.Scenario(disturbances=(ql.signals.Step(),), duration=30.0)
        run = ql.simulate(ql.plants.LinearPlant.of(LAGS), tuned.controller, scenario)
        integral[objective] = DT * float(np.sum(np.abs(run["y"])))
    assert tuned.design.objective == pytest.approx(integral["load-iae"], rel=2e-3)
    assert integral["load-iae"] <= integral["load"]


@pytest.mark.trial
@pytest.mark.parametrize(
    ("plant", "dt", "how"),
    [
        # An oven of 50 K at full power, three lags of an hour, 1 Hz; 312 000 samples long.
        (([50.0], np.poly([-1 / 3600] * 3) * 3600.0**3), 1.0, {}),
        # One lag of an hour and 10 s of dead time, and noise that allows a slow loop only.
        (([50.0], [3600.0, 1.0]), 1.0, {"delay": 10.0, "m_ks": 0.02}),
        # A servo of 2e-4 kg m² with 1e-4 N m s/rad and a slow current loop, 20 kHz.
        (([1.0], [2e-4, 1e-4, 0.0]), 5e-5, {"actuator_lag": 0.02}),
    ],
    ids=["oven", "oven with noise", "servo"],
)
def test_the_integral_of_the_error_has_the_end_of_a_slow_response(
    plant: Any, dt: float, how: dict[str, Any]
) -> None:
    """The measure is that of all samples until y is at rest, so never below 1/k_i."""
    bounds = Constraints(m_ks=how.pop("m_ks", None))
    tuned = ql.tune(
        plant, dt, structure="pi", compare=(), objective="load", constraints=bounds, **how
    )
    loop = analyse(plant, tuned.controller, **how)
    system = loop.closed_loop("d", "y")
    assert system.largest_pole < 1.0
    length = int(20.0 / -np.log(system.largest_pole))
    y = np.cumsum(loops.pulse_in_blocks(system, length))
    total = dt * float(np.sum(np.abs(y)))
    assert tuned.design.measures["iae"] == pytest.approx(total, rel=1e-3)
    assert tuned.design.measures["iae"] >= (1.0 - 1e-3) / tuned.design.k_i


@pytest.mark.trial
@pytest.mark.parametrize(
    "how",
    [
        {"duration": 3.0},
        {"duration": 3.0, "reference": 2.0},
        {"reference": ql.signals.Step(2.0)},
        {"duration": 3.0, "load": -2.5},
    ],
    ids=str,
)
def test_the_integral_of_the_error_is_never_cut(how: dict[str, Any]) -> None:
    """A duration and a reference bound u; ∫|y| after the load is that of the simulation, to its end."""
    bounds = Constraints(u_max=100.0)
    tuned = ql.tune(LAGS, DT, structure="pi", compare=(), constraints=bounds, **how)
    load = how.get("load", 1.0)
    scenario = ql.Scenario(disturbances=(load,), duration=60.0)
    run = ql.simulate(ql.plants.LinearPlant.of(LAGS), tuned.controller, scenario)
    assert tuned.design.objective == pytest.approx(DT * np.sum(np.abs(run["y"])), rel=1e-6)
    assert tuned.design.objective == pytest.approx(abs(load) * tuned.design.measures["iae"])


def test_a_slow_response_at_a_distance_is_that_of_all_samples() -> None:
    """Every fourth sample of y and u of a loop is the same."""
    plant = ([50.0], np.poly([-1 / 3600] * 3) * 3600.0**3)
    tuned = ql.tune(plant, 4.0, structure="pi", compare=(), objective="load")
    plants, law = tuned.task.plants, loops.law_of(tuned.controller)
    one = np.ones(4001)
    for target in ("y", "u"):
        whole = loops.response(plants.scaled()[0], law, loops.Inputs(0.0 * one, one), target)
        apart = loops.Inputs(0.0 * one, one, distance=4)
        part = loops.response(plants.scaled()[0], law, apart, target)
        np.testing.assert_allclose(part[:1000], whole[:4000:4], rtol=1e-6, atol=1e-9)


def test_a_profile_is_tracked_within_limits_of_u() -> None:
    """The largest u of the simulated run is the limit."""
    profile = ql.signals.Trapezoid(distance=1.0, duration=6.0)
    bounds = Constraints(u_max=1.1, m_ks=20.0)
    how = {"reference": profile, "duration": 12.0, "structure": "pi-unfiltered"}
    tuned = ql.tune(LAGS, DT, objective="tracking", constraints=bounds, compare=(), **how)
    scenario = ql.Scenario(reference=profile, duration=12.0)
    run = ql.simulate(ql.plants.LinearPlant.of(LAGS), tuned.controller, scenario)
    assert np.max(np.abs(run["u"])) <= 1.1 * 1.002
    error = math.sqrt(float(np.mean((run["r"] - run["y"]) ** 2)))
    assert error == pytest.approx(tuned.design.objective, rel=0.01)


@pytest.mark.trial
def test_a_number_is_a_reference_that_is_followed_from_rest() -> None:
    """As in a scenario: 2.0 is what a step of 2 from the start on is, with and without feedforward."""
    how: dict[str, Any] = {"objective": "tracking", "structure": "bandwidths", "order": 1}
    how |= {"compare": (), "duration": 20.0}
    first = ([1.0], [1.0, 1.0])
    for forward in (False, True):
        step, number = (
            ql.tune(first, DT, reference=given, feedforward=forward, **how).design
            for given in (ql.signals.Step(2.0), 2.0)
        )
        assert number.objective == step.objective > 0.0
        assert number.values == step.values


SERVO = {"inertias": [2e-4, 3e-4], "stiffnesses": [23.2], "dampings": [0.002]}  # kg m², N m/rad


@pytest.mark.parametrize(
    ("plant", "dt", "how", "rule"),
    [
        (ql.plants.n_mass(**SERVO), 2.5e-4, {}, "load = 1, and at rest |u| must be 1 there"),
        (ql.plants.n_mass(**SERVO), 2.5e-4, {"load": -0.7}, "at rest |u| must be 0.7 there"),
        (
            ([0.8], [90.0, 1.0]),  # °C/%, a lag of 90 s
            1.0,
            {"objective": "tracking", "reference": ql.signals.Step(20.0), "duration": 900.0},
            "the reference, which ends at 20, and at rest |u| must be 25 there",
        ),
    ],
)
def test_a_bound_of_u_below_that_at_rest_is_refused_at_once(
    plant: Any, dt: float, how: dict[str, Any], rule: str
) -> None:
    """Where u holds the load, and the reference against the plant's gain, for any controller."""
    bounds = Constraints(u_max=0.64)
    with pytest.raises(ValueError, match=r"u_max = 0.64: NOT possible") as caught:
        ql.tune(plant, dt, constraints=bounds, **how)
    assert rule in str(caught.value)


# ---- sets of plants


@pytest.mark.trial
def test_constraints_hold_for_all_plants_and_on_fresh_ones() -> None:
    """A range of a lag and of the gain; without the set the same structure exceeds M_s."""

    def make(tau: float) -> Any:
        return [1.0], np.polymul([tau, 1.0], [1.0, 2.0, 1.0]).tolist()

    how: dict[str, Any] = {"structure": "pi", "compare": ()}
    ranges = {"uncertain": {"tau": (0.5, 2.0)}, "b_range": (0.8, 1.25), "samples": 4}
    robust = ql.tune(make, DT, check_samples=100, **ranges, **how)
    assert robust.check.unstable == 0
    assert robust.check.violating <= 2
    low, high = robust.check.interval
    assert low <= robust.check.violating / 100 <= high
    nominal = ql.tune(make(1.25), DT, **how)
    for plant in (make(0.5), make(2.0)):
        assert 1.0 / analyse(plant, robust.controller).margins.modulus <= 1.601
    assert robust.design.k_i < nominal.design.k_i


# ---- results


@pytest.mark.trial
def test_the_setup_of_a_result_has_the_same_controller(tuned: ql.Tuned, tmp_path: Path) -> None:
    """To the last digit, through TOML; an existing file is not replaced."""
    path = tmp_path / "tuned.toml"
    tuned.save(path)
    setup = load(path)
    omega = np.geomspace(1e-2, 1e2, 7)
    again = analyse(LAGS, setup.controller).response("C_y", omega)
    np.testing.assert_allclose(again, tuned.analysis.response("C_y", omega), rtol=1e-9)
    assert setup.scenario is not None
    with pytest.raises(ValueError, match="exists"):
        tuned.save(path)


def test_a_result_is_drawn_beside_its_references(tuned: ql.Tuned) -> None:
    """Four axes: loop, sensitivities with two bounds, two responses, in the plant's units."""
    signals = Signals.of(y="angle [rad]", u="voltage [V]")
    axes = np.ravel(replace(tuned, signals=signals).plot())
    assert [axis.get_ylabel() for axis in axes[2:]] == ["angle [rad]"] * 2
    assert axes[3].get_title().endswith("by 1 V")
    assert len(axes) == 4
    labels = [text.get_text() for text in axes[3].get_legend().get_texts()]
    assert len(labels) == 3
    assert "pid" in labels[2]


def test_the_bode_diagram_has_the_phase_of_the_margin(tuned: ql.Tuned) -> None:
    """At the frequency where |L| is 1, on an axis at the right; the chosen design comes first."""
    bode = np.ravel(tuned.plot())[0]
    (phase,) = [axis for axis in bode.figure.axes if axis.get_ylabel() == "phase of L [°]"]
    omega, degrees = phase.lines[0].get_data()
    margins = tuned.analysis.margins
    at = np.interp(np.log(margins.phase_omega), np.log(omega), degrees)
    assert at == pytest.approx(-180.0 + margins.phase, abs=0.5)
    assert degrees[0] == pytest.approx(-90.0, abs=0.1)


# ---- bad input


@pytest.mark.trial
def test_where_no_start_keeps_to_the_limits_the_optima_of_other_limits_are_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """M_s of 1.6 has a controller although no start of its own leads to one."""
    how: dict[str, Any] = {"structure": "pi-unfiltered", "compare": ()}
    found = ql.tune(([1.0], [1.0, 3.0, 3.0, 1.0]), DT, **how)
    original, limits = designs.best_solution, []

    def misses(problem: Any, *arguments: Any) -> Any:
        limits.append(problem.bounds[0].limit)
        best = original(problem, *arguments)
        return replace(best, violation=0.1) if limits[-1] == 1.6 else best

    monkeypatch.setattr(designs, "best_solution", misses)
    again = ql.tune(([1.0], [1.0, 3.0, 3.0, 1.0]), DT, **how)
    assert again.design.k_i == pytest.approx(found.design.k_i, rel=1e-3)
    assert limits[-1] == pytest.approx(0.85 * 1.6)


@pytest.mark.trial
def test_contradicting_constraints_are_named_with_their_excess() -> None:
    """An unstable plant needs more gain than M_ks allows at so small an M_t."""
    unstable = ([1.0], [1.0, -1.0])
    bounds = Constraints(m_s=1.05, m_t=1.05, m_ks=3.0)
    with pytest.raises(ValueError, match=r"contradict .*M_t 1.05.*excess that was found is \d"):
        ql.tune(unstable, DT, structure="pi-unfiltered", constraints=bounds, compare=())


@pytest.mark.trial
def test_a_bound_of_u_near_that_at_rest_is_named_with_the_least_that_was_found() -> None:
    """With a PI controller the speed of an inertia makes u overshoot the load, for any gains."""
    speed = ([1.0], [2e-4, 0.0])  # rad/s for N m
    bounds = Constraints(u_max=1.01)
    with pytest.raises(
        ValueError, match=r"contradict .*u_max 1.01.*least that was found is 1\.\d+"
    ):
        ql.tune(speed, 2.5e-4, structure="pi-unfiltered", constraints=bounds, compare=())


def test_a_plant_that_no_controller_of_the_structure_stabilises_is_said() -> None:
    """A PI controller and a double integrator."""
    with pytest.raises(ValueError, match="no controller of this structure was found that stab"):
        ql.tune(([1.0], [1.0, 0.0, 0.0]), DT, structure="pi", compare=())


@pytest.mark.trial
def test_a_set_may_have_plants_of_different_relative_degree() -> None:
    """One pole, or two: the controller keeps its limits for both."""
    plants = [([1.0], [1.0, 1.0]), ([1.0], [0.1, 1.1, 1.0])]
    tuned = ql.tune(plants, DT, structure="pi", compare=())
    margins = [ql.analysis.analyse(plant, tuned.controller).margins for plant in plants]
    assert max(1.0 / one.modulus for one in margins) == pytest.approx(1.6, rel=0.01)


@pytest.mark.parametrize(
    ("plant", "message"),
    [
        ([([1.0], [1.0, 1.0]), ([-1.0], [1.0, 1.0])], "other sign of the gain"),
        (([1.0, 0.0], [1.0, 2.0, 1.0]), "zero at s = 0"),
    ],
)
def test_plants_that_do_not_fit_are_refused(plant: Any, message: str) -> None:
    """A set with different signs, and a plant that blocks integral action."""
    with pytest.raises(ValueError, match=message):
        ql.tune(plant, DT)


@cases(
    ("arguments", "message"),
    [
        ({"M_s": 1.4}, r"M_s = 1.4: .*give constraints=quell.tuning.Constraints\(m_s=1.4\)"),
        ({"limit": 1.0}, "limit: tune has no such argument, did you mean rate_limit"),
        ({"constraint": {}}, "constraint: tune has no such argument, did you mean constraints"),
        ({"uncertain": {"a": (1.0, 2.0)}}, "plant = .*: with uncertain it must be a function"),
        (
            {"plant": lambda a: ([a], [1.0, 1.0]), "uncertain": {"b": (1.0, 2.0)}},
            "uncertain: plant can't be called with these: missing a required argument: 'a'",
        ),
        ({"constraints": 3}, "constraints = 3: must be quell.tuning.Constraints"),
        ({"compare": 3}, "compare = 3: must be a list of structures"),
        ({"compare": "pid"}, "compare = 'pid': must be a list of structures"),
        ({"seed": -1}, "seed = -1: must be a whole number of at least 0"),
        (
            {"objective": "tracking", "reference": ql.signals.Step(), "duration": 1e6},
            r"duration = 1e\+06 s has 100000000 samples of dt = 0.01 s: .* give a shorter duration",
        ),
        ({"scenario": 3.0}, "scenario = 3.0: must be a quell.Scenario"),
        ({"scenario": [3.0]}, r"scenario\[0\] = 3.0: must be a quell.Scenario"),
    ],
)
def test_arguments_that_do_not_fit_are_named(arguments: dict[str, Any], message: str) -> None:
    """Before anything is searched, whatever would have failed later."""
    with pytest.raises(ValueError, match=message):
        ql.tune(arguments.pop("plant", ([1.0], [1.0, 1.0])), 0.01, **{"compare": (), **arguments})


SEVERAL = [([1.0], [1.0, 1.0]), ([1.0], [1.1, 1.0])]
STEP = ql.signals.Step()
U_MAX = Constraints(u_max=9.0)
RUN = ql.Scenario(duration=1.0)


@cases(
    ("arguments", "message"),
    [
        (
            {"duration": 3.0},
            r"duration = 3.0: .*∫\|y\| and k_i are those until y is at rest; give obj",
        ),
        ({"reference": 1.0}, "reference = 1.0: .*is about the load; give objective = 'tracking'"),
        (
            {"objective": "tracking", "reference": STEP, "load": 2.0},
            "load = 2.0: .*follows the ref",
        ),
        ({"objective": "load", "load": 2.0}, "load = 2.0: .*k_i is the same for all loads"),
        (
            {"objective": "load", "load": 2.0, "reference": 1.0, "constraints": U_MAX},
            "load = 2.0: .*k_i is the same for all loads",
        ),
        ({"quantile": 0.5}, "quantile = 0.5: .*there is one plant; give several, b_range, or"),
        (
            {"plant": SEVERAL, "quantile": 0.5, "objective": "load"},
            "quantile = 0.5: .*the same for",
        ),
        ({"samples": 3}, "samples = 3: .*no plant is drawn; give ranges"),
        ({"samples": 3, "b_range": (0.8, 1.2)}, "samples = 3: .*no plant is drawn; give ranges"),
        (
            {"check_samples": 10},
            r"check_samples = 10: .*\(\[plant.uncertain\]\), or b_range, or leave",
        ),
        ({"plant": SEVERAL, "seed": 3}, "seed = 3: .*no plant is drawn; give ranges"),
        (
            {"constraints": Constraints(noise_share=0.5)},
            "noise_share = 0.5: .*is not known; give noi",
        ),
        (
            {"constraints": Constraints(noise_share=0.5, u_std=0.1, noise_std=0.01)},
            "noise_share = 0.5: .*u_std bounds what noise does to u",
        ),
        (
            {"constraints": Constraints(noise_over_pi=3.0, m_ks=5.0)},
            "noise_over_pi = 3.0: .*m_ks bounds what noise does to u",
        ),
        (
            {"constraints": Constraints(noise_over_pi=3.0, noise_std=0.01), "u_min": 0, "u_max": 1},
            "noise_over_pi = 3.0: .*the noise of y is known",
        ),
        (
            {"scenario": RUN, "objective": "iae", "duration": 3.0},
            "duration = 3.0: .*the scenario says",
        ),
        (
            {"scenario": RUN, "objective": "iae", "reference": 1.0},
            "reference = 1.0: .*the scenario",
        ),
        ({"scenario": RUN, "objective": "iae", "load": 2.0}, "load = 2.0: .*the scenario says"),
        (
            {"scenario": RUN, "objective": "iae", "quantile": 0.5},
            "quantile = 0.5: .*give an Objectiv",
        ),
        ({"scenario": RUN, "objective": "iae", "samples": 3}, "samples = 3: .*no plant is drawn"),
    ],
)
def test_options_without_effect_are_refused(arguments: dict[str, Any], message: str) -> None:
    """With their value, why, and what to do, before anything is searched."""
    with pytest.raises(ValueError, match=message):
        ql.tune(arguments.pop("plant", ([1.0], [1.0, 1.0])), 0.01, **{"compare": (), **arguments})


@pytest.mark.trial
def test_the_constraints_of_a_result_can_be_given_again() -> None:
    """The bound of noise that a share or a ratio made takes their place, and is the same again."""
    how: dict[str, Any] = {"structure": "pi", "compare": (), "u_min": -1.0, "u_max": 1.0}
    given = (Constraints(noise_std=1e-3, noise_share=0.1), Constraints(noise_over_pi=3.0))
    for constraints, name in zip(given, ("u_std", "m_ks"), strict=True):
        found = ql.tune(LAGS, DT, constraints=constraints, **how)
        again = ql.tune(LAGS, DT, constraints=found.constraints, **how)
        assert getattr(again.constraints, name) == getattr(found.constraints, name) is not None
        assert again.design.objective == pytest.approx(found.design.objective, rel=1e-3)


@cases(
    ("bounds", "message"),
    [
        ({"m_s": 1.0}, "m_s = 1.0: must be above 1"),
        ({"m_s": None, "m_t": None}, "one of them must bound"),
        ({"u_std": 0.1}, "needs noise_std"),
        ({"m_ks": -1.0}, "m_ks = -1.0"),
    ],
)
def test_impossible_constraints_are_refused(bounds: dict[str, Any], message: str) -> None:
    """Before anything is searched."""
    with pytest.raises(ValueError, match=message):
        Constraints(**bounds)


# ---- poles of their own


def test_an_observer_has_the_poles_that_it_is_given() -> None:
    """exp(p dt) in the z-plane, real and complex, in units of omega_o; all at −1 as without."""
    poles = [-0.5, (-0.6, 0.8)]
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=4.0, dt=0.01, poles=poles)
    model = observer.model
    corrected = (np.eye(3) - np.outer(model.gain, np.eye(3)[0])) @ model.transition
    expected = np.exp(0.04 * np.array([-0.6 - 0.8j, -0.6 + 0.8j, -0.5]))
    found = np.sort_complex(np.linalg.eigvals(corrected))
    np.testing.assert_allclose(found, np.sort_complex(expected), atol=1e-9)
    usual = ql.ESO.model_free(order=2, b0=1.0, omega_o=4.0, dt=0.01)
    same = ql.ESO.model_free(order=2, b0=1.0, omega_o=4.0, dt=0.01, poles=[-1, -1, -1])
    np.testing.assert_allclose(same.model.gain, usual.model.gain, rtol=1e-12)
    assert usual.has_one_pole
    assert not observer.has_one_pole


def test_a_law_has_the_poles_that_it_is_given_and_retunes_with_omega_c() -> None:
    """``s² + k_2 s + k_1`` has them in units of omega_c."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01)
    controller = ql.ADRC(observer, omega_c=2.0, law_poles=[(-0.6, 0.8)])
    np.testing.assert_allclose(controller.parameters.law, [4.0, 2.4], rtol=1e-12)
    controller.retune(omega_c=1.0)
    np.testing.assert_allclose(controller.parameters.law, [1.0, 1.2], rtol=1e-12)


@cases(
    ("poles", "message"),
    [
        ([-1.0, -1.0], "has 2 poles, must have 3"),
        ([-1.0, -1.0, 0.5], "below zero"),
        ([-1.0, -1.0 + 1.0j, -1.0 + 1.0j], "conjugate"),
        (-1.0, "must be a list of poles"),
    ],
)
def test_impossible_poles_are_refused(poles: Any, message: str) -> None:
    """With the argument and the rule."""
    with pytest.raises(ValueError, match=message):
        ql.ESO.model_free(order=2, b0=1.0, omega_o=4.0, dt=0.01, poles=poles)
