"""The guard's trial in general loops: its plants are right, it repeats, it can fail."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.cli.stress import _figure
from quell.experiments.stress import general, loops, study
from quell.experiments.stress.adversaries import INPUTS, Program, Watched
from quell.experiments.stress.general import (
    Case,
    GeneralOutcome,
    GeneralResult,
    Measures,
    perfect_case,
    search,
)
from quell.experiments.stress.loops import FAMILIES, GeneralLoop, GeneralPlant, draw_loop
from quell.experiments.stress.study import Bar
from quell.kernels.dispatch import call_specialised, compiled, interpreted
from quell.learners.base import adapt, commit, predict
from quell.plants import LinearPlant
from quell.plants.base import advance, measure

from .cases import cases

DT = 0.01
POINTS = 300


def response(plant: Any, u: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
    """Return the output (samples,) to a control signal, from interpreted functions."""
    model = plant.sampled(DT, True)
    x, scratch = np.zeros(plant.order), np.zeros(6 * plant.order)
    if x0 is not None:
        x[: x0.size] = x0
    y = np.empty(u.size)
    for k in range(u.size):
        y[k] = measure(model, x)
        advance(model, x, scratch, k * DT, u[k], np.full(plant.disturbances, 0.3))
    return y


LINEAR = LinearPlant.of(([2.0], [1.0, 0.5, 1.0]))


def test_its_plant_equals_the_plants_of_the_library(rng: np.random.Generator) -> None:
    """Linear, delayed and quantised."""
    u = rng.normal(size=POINTS)
    assert response(GeneralPlant(LINEAR), u) == pytest.approx(response(LINEAR, u), abs=1e-12)
    late = response(ql.plants.delayed(LINEAR, 7 * DT, DT), u)
    assert response(GeneralPlant(LINEAR, delay=7), u) == pytest.approx(late, abs=1e-12)
    seen = response(ql.plants.encoded(LINEAR, 1000), u)
    quantum = math.tau / 1000
    assert response(GeneralPlant(LINEAR, quantum=quantum), u) == pytest.approx(seen, abs=1e-12)
    limited = response(LINEAR, np.clip(u, -0.4, 0.4))
    assert response(GeneralPlant(LINEAR, limit=0.4), u) == pytest.approx(limited, abs=1e-12)


MASS = LinearPlant.of(([1.0], [1.0, 0.0, 0.0]))


def test_friction_holds_what_rests_and_stops_what_moves() -> None:
    """A mass rests below the friction; above, it stops after v/F, having gone v²/2F."""
    stiff = GeneralPlant(MASS, velocity=1, friction=0.8)
    rests = response(stiff, np.full(POINTS, 0.4))  # 0.3 of load comes to it
    assert np.max(np.abs(rests)) < 1e-15
    gone = response(stiff, np.full(POINTS, -0.3), np.array([0.0, 1.0]))
    assert gone[-1] == pytest.approx(1.0 / (2.0 * 0.8), rel=0.01)
    assert np.argmax(np.diff(gone) < 1e-15) * DT == pytest.approx(1.0 / 0.8, abs=2 * DT)


def test_gravity_is_that_of_a_pendulum() -> None:
    """Its energy stays, and its period is the pendulum's (by Runge-Kutta)."""
    pendulum = ql.plants.NonlinearPlant(
        lambda t, x, u, w: (x[1], u + w[0] - 4.0 * math.sin(2.0 * x[0])), order=2
    )
    start, u = np.array([0.6, 0.0]), np.full(POINTS, -0.3)
    ours = response(GeneralPlant(MASS, velocity=1, strength=4.0, rate=2.0), u, start)
    assert ours == pytest.approx(response(pendulum, u, start), abs=2e-3)


def one(family: str, order: int | None = None, seed: int = 0) -> GeneralLoop:
    """Return a loop of a family."""
    return draw_loop(np.random.default_rng(seed), family, order)


@cases("family", ["unstable", "lagged", "delayed", "two masses"])
def test_a_loop_states_its_modulus_margin(family: str) -> None:
    """That of the full analysis, within the grid of frequencies."""
    loop = one(family)
    plant: Any = loop.plant.linear
    if loop.plant.delay:
        plant = ql.plants.delayed(plant, loop.plant.delay * loop.dt, loop.dt)
    exact = analyse(plant, loop.controller()).margins.modulus
    assert loop.margin == pytest.approx(exact, rel=0.01)
    assert loop.margin >= exact


def test_an_unstable_loop_has_no_margin() -> None:
    """A gain of the wrong sign."""
    from quell.experiments.stress.loops import modulus_margin

    loop = one("stable", 2)
    wrong = LinearPlant(loop.plant.linear.A, -loop.plant.linear.B, loop.plant.linear.C)
    assert modulus_margin(wrong, loop.controller()) == 0.0


@pytest.mark.trial
def test_loops_repeat_and_are_of_all_kinds() -> None:
    """The same seed gives the same loop; families, orders, loads and references all occur."""
    drawn = [draw_loop(np.random.default_rng(seed)) for seed in range(150)]
    assert {loop.family for loop in drawn} == set(FAMILIES)
    assert {loop.order for loop in drawn} == {1, 2, 3, 4}
    assert {loop.load for loop in drawn} == set(loops.LOADS)
    assert {loop.reference for loop in drawn} == set(loops.REFERENCES)
    assert min(loop.margin for loop in drawn) >= 0.2
    for mine, again in zip(
        drawn[3].tables, draw_loop(np.random.default_rng(3)).tables, strict=True
    ):
        assert np.array_equal(mine, again)


@cases("kind", loops.LOADS)
def test_a_load_keeps_its_level_and_size(kind: str, rng: np.random.Generator) -> None:
    """From rest to the level, then what varies, of about the amplitude."""
    t = DT * np.arange(60_000)
    w = loops.load_table(kind, t, rng, omega=0.5, amplitude=2.0, level=40.0, start=100.0, lag=0.5)
    assert w[0] == 0.0
    assert w[(t > 20.0) & (t < 100.0)] == pytest.approx(40.0)
    varies = w[t >= 100.0] - 40.0
    assert 1.0 < np.max(np.abs(varies)) < 9.0


def test_the_ideal_response_is_that_of_equal_poles() -> None:
    """``1 − e^(−t) Σ t^k/k!`` to a step."""
    t = DT * np.arange(1000)
    for order in (1, 2, 3, 4):
        found = loops.ideal(np.ones_like(t), DT, order)
        terms = sum(t**k / math.factorial(k) for k in range(order))
        assert found == pytest.approx(1.0 - np.exp(-t) * terms, abs=2e-5)


def test_measures_of_an_error_that_is_known() -> None:
    """A burst of ten samples of size 2 in a hundred of zeros."""
    error = np.zeros(100)
    error[20:30] = -2.0
    found = general.measure_error(error, 20)
    assert found.peak == 2.0
    assert found.rms == pytest.approx(2.0 * math.sqrt(0.1))
    assert found.window == pytest.approx(2.0 * math.sqrt(0.5))
    assert found.late == 0.0


def watched(weights: np.ndarray, rules: tuple[float, ...], load: np.ndarray) -> Watched:
    """Return a controller of order 1 whose learner is a program."""
    observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=10.0, dt=DT)
    program = Program(weights, rules, 1.0, load, ql.Guard())  # type: ignore[arg-type]
    return Watched(observer, 1.0, learner=program, guard=ql.Guard())


def spender() -> tuple[Watched, np.ndarray]:
    """Return a controller whose learner says the load until it is trusted, and then its negative; and the load."""
    load = np.sin(2.0 * DT * np.arange(1500))
    weights = np.zeros((2, len(INPUTS)))
    weights[0, INPUTS.index("load")], weights[1, INPUTS.index("load")] = 1.0, -1.0
    return watched(weights, (0.9, -1.0, 0.0, 1e9), load), load


@pytest.mark.trial
def test_a_program_earns_trust_with_the_load_itself_and_then_spends_it() -> None:
    """It sees the guard's own memory, and changes its mode by the authority there."""
    controller, load = spender()
    state = controller.initial_state()
    assert state.learner.guard is state.guard
    plant = GeneralPlant(LinearPlant.of(([1.0], [1.0, 0.0])))
    scenario = ql.Scenario(0.0, DT * (load.size - 1), (loops.Table(load, DT),))
    run = ql.simulate(plant, controller, scenario)
    trusted = run["authority"] >= 0.9
    assert trusted.any()
    turned = int(np.argmax(trusted))
    earned = slice(int(np.argmax(run["authority"] > 0.3)), turned)
    assert np.corrcoef(run["f_learned"][earned], load[earned])[0, 1] > 0.9
    assert run["authority"][-1] < 0.5


@compiled
def follow(learner: Any, memory: Any, seen: Any, u: Any, authority: Any, said: Any) -> None:
    """Show a program estimates and an authority, with no loop around it."""
    for k in range(u.size):
        memory.guard.sample[0].authority = authority[k]
        adapt(learner, memory, seen[k], seen[k, 0], u[k], seen[k, 1])
        said[k] = predict(learner, memory, seen[k], u[k])[0]
        commit(learner, memory, seen[k], u[k], said[k])


@pytest.mark.trial
@pytest.mark.compiled
def test_a_program_says_the_same_compiled_and_interpreted(rng: np.random.Generator) -> None:
    """With weights of all its inputs, in both modes, which the authority changes."""
    controller = watched(
        rng.normal(size=(2, len(INPUTS))), (0.9, 0.1, 0.0, 1e9), rng.normal(size=9)
    )
    seen, u = 0.1 * rng.normal(size=(400, 2)).cumsum(axis=0), rng.normal(size=400)
    authority = 0.5 + 0.6 * np.sin(0.1 * np.arange(400))
    found = []
    for entry in (interpreted(follow), partial(call_specialised, follow)):
        memory, said = controller.initial_state().learner, np.empty(400)
        entry(controller.parameters.learner, memory, seen, u, authority, said)
        found.append((said, memory.now))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_exact_weights_are_those_of_f() -> None:
    """``f = −a x + (b − b0) u + w``: with them, an ESO's remaining estimate is zero."""
    loop = one("stable", 2)
    weights = dict(zip(INPUTS, general.exact_weights(loop), strict=True))
    a = -loop.plant.linear.A[-1]
    assert weights["k1 x1"] == pytest.approx(-a[0])
    assert weights["k2 x2"] == pytest.approx(-a[1] / 2.0)
    b = loop.plant.linear.B[-1, 0]
    assert weights["b0 u"] * loop.b0 == pytest.approx(b - loop.b0)
    assert weights["load"] == 1.0


@pytest.mark.trial
@pytest.mark.usefixtures("one_draw")
def test_a_perfect_learner_removes_the_load(monkeypatch: pytest.MonkeyPatch) -> None:
    """All but a thousandth without guard; with it, more than half; from 50 to 80 of the trial's 100 to 300 lags."""
    monkeypatch.setattr(general, "PERFECT_FROM_LAGS", 50.0)
    monkeypatch.setattr(general, "_PERFECT_LAGS", 80.0)
    case = perfect_case(1, "sine", ql.Guard(), 0)
    assert case.unguarded < 1e-3 * case.plain
    assert case.lost_share < 0.5
    assert 0.0 < abs(case.of_other_noise.lost_share) < 1e-3


@pytest.fixture
def one_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    """One draw of the noise in place of the trial's four."""
    for module in (general, study):
        monkeypatch.setattr(module, "USUAL", range(1))
        monkeypatch.setattr(module, "OTHERS", range(1, 2))


@pytest.fixture
def short_runs(monkeypatch: pytest.MonkeyPatch, one_draw: None) -> None:
    """Runs of 80 lags in place of the trial's 250, with one draw of the noise."""
    monkeypatch.setattr("quell.experiments.stress.loops.RUN_LAGS", 80.0)
    monkeypatch.setattr("quell.experiments.stress.loops._LEAST_DURATION", 0.0)


@pytest.mark.trial
@pytest.mark.usefixtures("short_runs")
def test_a_search_finds_learners_that_do_harm() -> None:
    """Without guard their errors are several times as large, so the trial can fail."""
    loop = one("stable", 1, seed=8)
    found = search([loop], None, np.random.default_rng(0), generations=2, population=3)
    assert len(found.history) == 2
    assert found.score > 3.0
    assert found.point.shape == (general.SIZE,)


@pytest.mark.trial
@pytest.mark.usefixtures("short_runs")
def test_a_loop_is_fragile_if_u_hardly_suffices_for_the_load() -> None:
    """With limits at the load itself, not with twice as much, and never without limits."""
    loop = one("stable", 1, seed=8)
    enough = float(np.max(np.abs(loop.tables[1]))) * loop.gain_error / loop.b0
    for limit, fragile in ((enough, True), (2.0 * enough, False), (math.inf, False)):
        limited = replace(loop, u_limit=limit)
        plain = general.error_of(limited, None, None)
        assert general.is_fragile([limited], plain) == fragile


def test_another_draw_changes_the_noise_only() -> None:
    """Reference and load are the same; the noise has the same size."""
    loop = one("friction", 2, seed=8)
    (r, w, noise), (r_other, w_other, other) = loop.tables, replace(loop, draw=1).tables
    assert np.array_equal(r, r_other)
    assert np.array_equal(w, w_other)
    assert abs(np.corrcoef(noise, other)[0, 1]) < 0.1
    assert np.std(other) == pytest.approx(np.std(noise), rel=0.1)


@pytest.mark.trial
@pytest.mark.usefixtures("short_runs")
def test_other_noise_moves_the_ratios_of_mf_eso_a_little() -> None:
    """In a loop without friction."""
    found = general.run_one(8, 1, "Kalman", None, honest=True)
    assert 0.0 < abs(found.chance.rms - 1.0) < 0.05


def outcome(**fields: Any) -> GeneralOutcome:
    """Return an outcome with all ratios one, but for the given fields and ratios."""
    ratios = {name: fields.pop(name) for name in Measures._fields if name in fields}
    usual: dict[str, Any] = {
        **{"kind": "constant", "honest": False, "index": 0, "learner": "", "loop": ""},
        **{"family": "stable", "order": 2, "load": "sine", "reference": "steps", "level": 0.0},
        **{"margin": 0.5, "fragile": False},
        "guarded": Measures(1.0, 1.0, 1.0, 1.0)._replace(**ratios),
        "chance": Measures(1.0, 1.0, 1.0, 1.0),
    }
    return GeneralOutcome(**(usual | fields))


def test_bars_count_healthy_loops_only() -> None:
    """And name what is not met."""
    runs = [outcome(), outcome(rms=9.0, margin=0.3), outcome(window=3.0)]
    runs += [outcome(rms=math.inf, fragile=True), outcome(rms=math.nan)]
    runs += [outcome(kind="Kalman", honest=True, rms=1.1, peak=1.2)]
    cases = [Case("level 30, sine", "Kalman", "late RMS", 1.0, 0.5, 0.6, 0.55)]
    cases += [Case("slow process, ramp", "Kalman", "overshoot", 0.0, 0.1, 0.0, math.nan, 0.06)]
    result = GeneralResult({"seed": 0}, runs, cases)
    missed = {(bar.over, bar.measure) for bar in result.bars() if not bar.met}
    assert missed == {
        ("hostile", "worst window, 99 %"),
        ("hostile", "worst window, largest"),
        ("honest", "share worse by more than 5 %"),
        ("honest", "largest error, 99 %"),
        ("level", "late RMS, guarded over unguarded"),
    }
    found = result.to_json()
    assert json.loads(json.dumps(found)) == found
    assert found["hostile"]["loops"] == found["hostile_other_noise"]["loops"] == 2
    assert found["worst"][0]["chance"]["peak"] == 1.0
    assert found["left_out"] == {"low_margin": 1, "plain_lost": 1, "fragile": 1, "lost": 1}
    assert [bar.other_noise for bar in result.bars()[-2:]] == [pytest.approx(1.1), None]
    assert {bar.other_noise for bar in result.bars()[:-2]} == {0.0, 1.0}
    assert not GeneralResult({}, [outcome(rms=math.inf)], []).bars()[0].met


def test_a_figure_beyond_its_bar_is_not_printed_as_equal_to_it() -> None:
    """With four digits; with eight where these would hide it."""
    shown = [_figure(Bar("", "", figure, 1.0)) for figure in (1.0000015, 1.0, 1.23456, None)]
    assert shown == ["1.0000015", "1", "1.235", "–"]


@pytest.mark.trial
@pytest.mark.usefixtures("short_runs")
def test_the_command_runs_all_loops(quell: Callable[..., Any], tmp_path: Path) -> None:
    """With its own table and its own JSON."""
    counts = ("--runs", "1", "--honest", "0", "--seed", "36")
    shown = quell("stress", "--loops", "all", *counts, "--no-guard", "--json", "out.json")
    assert shown.code == 0, shown.err
    assert "WITHOUT guard" in shown.out
    assert "worst window" in shown.out
    found = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert found["settings"]["seed"] == 36
    assert found["cases"] == []
    wrong = quell("stress", "--loops", "some")
    assert wrong.code == 2


def test_a_run_repeats(monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of a run and the seed say all."""
    drawn: list[Any] = []

    def no_run(loop: GeneralLoop, learner: Any, guard: Any) -> Measures:
        drawn.append((loop.describe(), repr(learner), loop.draw))
        return Measures(*[math.inf] * 4)

    monkeypatch.setattr(general, "error_of", no_run)
    found = [general.run_one(5, index, "delay", None) for index in (3, 3, 4)]
    assert drawn[:12] == drawn[12:24] != drawn[24:]
    assert [draw for _, _, draw in drawn[:12]] == [0, 1, 2, 3, 0, 1, 2, 3, 4, 5, 6, 7]
    assert all(each.plain_lost and not each.lost for each in found)
