"""Tuning by simulation: statistics, problems, the search, its journal file and its Pareto front."""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

import quell as ql
from quell.cli.app import app
from quell.setup import controllers_of, load, varied
from quell.sweeping.sweep import share_interval
from quell.tuning.simulated import (
    FailureRate,
    Mean,
    Objective,
    Problem,
    Quantile,
    Search,
    SearchRange,
    Worst,
    search,
)
from quell.tuning.simulated.problem import Statistic
from quell.types import Matrix

from .cases import cases

pytestmark = pytest.mark.skipif(find_spec("optuna") is None, reason="optuna is missing")

SPACE = {"a": SearchRange(0.1, 10.0), "b": SearchRange(-3.0, 3.0)}
SAMPLES = np.linspace(-0.5, 0.5, 16).tolist()


def build(values: Mapping[str, float]) -> Any:
    """Return the values themselves: the bowl needs no controller."""
    return dict(values)


def bowl(values: Any, samples: Sequence[float]) -> Matrix:
    """Return scores with their least mean at a = 2, b = −1."""
    at = math.log(values["a"] / 2.0) ** 2 + (values["b"] + 1.0) ** 2
    return np.array([[at + x for x in samples]])


BOWL = Problem(SAMPLES, bowl, {"bowl": Mean()})


def two_bowls(values: Any, samples: Sequence[float]) -> Matrix:
    """Return two scores, of which one is least at b = −1 and the other at b = 1."""
    at = math.log(values["a"]) ** 2
    return np.array([[at + (values["b"] + s) ** 2 + x for x in samples] for s in (1.0, -1.0)])


@cases(
    ("statistic", "scores", "value"),
    [
        (Mean(), [1.0, 2.0, 6.0], 3.0),
        (Quantile(0.9), list(range(1, 11)), 9.0),
        (Quantile(0.5), [3.0, 1.0, 2.0], 2.0),
        (Worst(), [1.0, math.nan], math.inf),
        (FailureRate(), [True, False, False, math.nan], 0.5),
        (FailureRate(limit=2.0), [1.0, 2.0, 3.0, 4.0], 0.5),
    ],
)
def test_a_statistic_has_the_value_of_its_definition(
    statistic: Statistic, scores: list[float], value: float
) -> None:
    """And a score that is not a number counts as infinite."""
    assert statistic.value(np.array(scores, dtype=float)) == value


@pytest.mark.trial
@pytest.mark.parametrize(
    ("statistic", "truth"),
    [(Mean(), 0.5), (Quantile(0.8), 0.8), (FailureRate(limit=0.7), 0.3)],
)
def test_a_confidence_interval_covers_the_truth_as_often_as_it_says(
    statistic: Statistic, truth: float
) -> None:
    """In at least 95 %, less what 200 draws of 80 uniform numbers leave to chance."""
    draws = np.random.default_rng(3).uniform(size=(200, 80))
    ends = np.array([statistic.interval(row) for row in draws])
    covered = np.mean((ends[:, 0] <= truth) & (truth <= ends[:, 1]))
    assert covered > 0.91
    assert np.all(np.diff(ends) < 0.35)


def test_the_interval_of_a_share_is_that_of_clopper_and_pearson() -> None:
    """At each end so many or so few are found in 2.5 % of all cases; of nothing it is all."""
    for found, count in ((0, 20), (3, 20), (20, 20), (411, 4000)):
        low, high = share_interval(found, count)
        least = binom.sf(found - 1, count, low) if found else 0.025
        most = binom.cdf(found, count, high) if found < count else 0.025
        assert (least, most) == pytest.approx((0.025, 0.025), rel=1e-6)
    assert share_interval(0, 20)[0] == 0.0
    assert share_interval(0, 0) == (0.0, 1.0)


def test_too_few_samples_bound_a_quantile_on_one_side_only() -> None:
    """Ten scores say nothing about the largest value of the 99 % quantile."""
    assert Quantile(0.99).interval(np.arange(10.0))[1] == math.inf
    assert Worst().interval(np.arange(10.0)) == (9.0, math.inf)


@pytest.mark.parametrize("sampler", ["cma", "tpe", "nsga2", "qmc", "random"])
def test_a_search_finds_the_minimum_whatever_the_sampler_and_the_workers(sampler: str) -> None:
    """Near it, and with the same candidates on one thread and on three."""
    options: dict[str, Any] = {"trials": 48, "sampler": sampler, "pruner": "none", "seed": 1}
    found = search(build, SPACE, BOWL, **options, workers=1)
    assert found.best.values["bowl"] < 0.6
    assert found.best.values["bowl"] == min(c.values["bowl"] for c in found.candidates)
    assert search(build, SPACE, BOWL, **options, workers=3) == found


@pytest.mark.trial
def test_cma_finds_a_valley_that_is_not_along_an_axis() -> None:
    """Rosenbrock's, in three parameters: after 300 candidates far below what random ones find."""

    def rosenbrock(values: Any, samples: Sequence[float]) -> Matrix:
        x = np.array([*values.values()])
        return np.full((1, 1), np.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2))

    space = {f"x{i}": SearchRange(-2.0, 2.0) for i in range(3)}
    problem = Problem([0.0], rosenbrock, {"f": Mean()})
    best = {
        sampler: search(build, space, problem, trials=300, sampler=sampler, workers=1).best
        for sampler in ("cma", "random")
    }
    assert best["cma"].values["f"] < 0.2 * best["random"].values["f"]


class InterruptedSearchError(Exception):
    """A search ends here."""


@pytest.mark.parametrize(("calls", "sampler"), [(1, "tpe"), (21, "tpe"), (21, "cma"), (40, "cma")])
def test_an_interrupted_search_continues_as_if_nothing_had_happened(
    calls: int, sampler: str, tmp_path: Path
) -> None:
    """With the same candidates, even if the last line of its file is incomplete."""
    starts = [{"a": 1.0, "b": 2.5}]
    whole = search(build, SPACE, BOWL, trials=20, seed=2, starts=starts, sampler=sampler)
    assert whole.candidates[0].parameters == starts[0]
    count, file = 0, tmp_path / "journal.log"

    def interrupted(values: Mapping[str, float]) -> Any:
        nonlocal count
        count += 1
        if count > calls:
            raise InterruptedSearchError
        return build(values)

    options: dict[str, Any] = {"trials": 20, "seed": 2, "starts": starts, "sampler": sampler}
    options["storage"] = file
    with pytest.raises(InterruptedSearchError):
        search(interrupted, SPACE, BOWL, **options, workers=1)
    with file.open("a") as journal:
        journal.write('{"op_code": 4, "tri')
    assert search(build, SPACE, BOWL, **options) == whole


def test_a_file_of_another_search_or_of_none_is_refused_and_left_alone(tmp_path: Path) -> None:
    """With what differs; a text file is not a journal."""
    file, text = tmp_path / "journal.log", tmp_path / "notes.txt"
    search(build, SPACE, BOWL, trials=2, storage=file)
    before = file.read_bytes()
    other = SPACE | {"a": SearchRange(0.1, 20.0)}
    with pytest.raises(ValueError, match="holds another search, with other ranges: give another"):
        search(build, other, BOWL, trials=2, storage=file)
    with pytest.raises(ValueError, match="holds another search, with other seed"):
        search(build, SPACE, BOWL, trials=2, storage=file, seed=1)
    assert file.read_bytes() == before
    for content in ("no journal\n", "[1]\n", '{"a": 1}\n', '{"op_code": 99}'):
        text.write_text(content)
        with pytest.raises(ValueError, match="must be a journal file of Optuna"):
            search(build, SPACE, BOWL, trials=2, storage=text)
        assert text.read_text() == content
    with pytest.raises(ValueError, match="the folder does not exist"):
        search(build, SPACE, BOWL, trials=2, storage=tmp_path / "none" / "journal.log")


def test_the_front_has_the_candidates_that_no_other_one_dominates() -> None:
    """By comparison with all of them; along b the front goes from one minimum to the other."""
    problem = Problem(SAMPLES, two_bowls, {"left": Mean(), "right": Worst()})
    found = search(build, SPACE, problem, trials=64, sampler="nsga2", seed=4)
    points = np.array([list(c.values.values()) for c in found.candidates])
    best = [
        c.number
        for c, p in zip(found.candidates, points, strict=True)
        if not np.any(np.all(points <= p, axis=1) & np.any(points < p, axis=1))
    ]
    assert sorted(c.number for c in found.front) == best
    left, right = np.array([list(c.values.values()) for c in found.front]).T
    assert np.all(np.diff(left) > 0.0)
    assert np.all(np.diff(right) < 0.0)
    assert found.to_json()["front"] == [c.number for c in found.front]
    with pytest.raises(ValueError, match="several objectives \\(left, right\\); choose from front"):
        _ = found.best


def test_poor_candidates_are_given_up_early() -> None:
    """They are not scored on all samples, and the best one is."""
    seen: dict[float, int] = {}

    def counted(values: Any, samples: Sequence[float]) -> Matrix:
        seen[values["b"]] = seen.get(values["b"], 0) + len(samples)
        return bowl(values, samples)

    problem = Problem(SAMPLES, counted, {"bowl": Mean()})
    found = search(build, SPACE, problem, trials=40, seed=5, workers=1)
    given_up = [c for c in found.candidates if not c.finished]
    assert given_up
    assert all(seen[c.parameters["b"]] < len(SAMPLES) for c in given_up)
    assert all(seen[c.parameters["b"]] == len(SAMPLES) for c in found.candidates if c.finished)
    assert not any(c.values for c in given_up)


def test_what_violates_constraints_is_not_simulated() -> None:
    """The best one meets them; if none does, the error says by how much."""

    def positive(values: Any, samples: Sequence[float]) -> Matrix:
        assert values["b"] >= 0.5
        return bowl(values, samples)

    problem = Problem(SAMPLES, positive, {"bowl": Mean()})
    options: dict[str, Any] = {"trials": 32, "seed": 6}
    found = search(build, SPACE, problem, **options, violation=lambda c: 0.5 - c["b"])
    assert found.best.parameters["b"] >= 0.5
    assert any(c.violation > 0.0 for c in found.candidates)
    none = search(build, SPACE, problem, trials=4, violation=lambda c: 7.0 + c["b"] ** 2)
    with pytest.raises(ValueError, match=r"all violate the constraints, the best one by [789].*;"):
        _ = none.best


LEARNING = """dt = 0.05
plant = { kind = "linear", num = [1.0], den = [1.0, 0.4] }
observer = { kind = "model-free", order = 1, b0 = 1.0, omega_o = 4.0 }
controller = { omega_c = 1.0 }
learner = { kind = "nlms", rate = 0.1 }
guard = { bound = 0.5 }
scenario = { duration = 6.0, reference = 1.0, noise = { kind = "noise", power = 1e-6, sample_time = 0.05 } }
"""


def test_numbers_of_a_learner_and_its_guard_are_searched_by_their_paths(tmp_path: Path) -> None:
    """Each candidate is the setup's controller with these values, in other processes too; it is no worse than the file's own."""
    file = tmp_path / "learning.toml"
    file.write_text(LEARNING)
    setup = load(file)
    make = pickle.loads(pickle.dumps(controllers_of(setup)))
    problem = Problem.of_runs([setup.plant], setup.scenario, "iae")
    own = {"learner.rate": 0.1, "guard.bound": 0.5, "observer.omega_o": 4.0}
    space = {name: SearchRange(0.5 * value, 2.0 * value) for name, value in own.items()}
    found = search(make, space, problem, trials=6, starts=[own])
    best = varied(setup, found.best.parameters)
    assert best.controller.learner.rate == found.best.parameters["learner.rate"]
    assert best.controller.guard.bound == found.best.parameters["guard.bound"]
    run = ql.simulate(setup.plant, best.controller, setup.scenario)
    assert run.metrics()["iae"] == found.best.values["iae"] < found.candidates[0].values["iae"]
    none = search(make, {"learner.speed": SearchRange(0.1, 1.0)}, problem, trials=2)
    with pytest.raises(ValueError, match=r"values are rejected.*learner.speed: unknown"):
        _ = none.best


DOUBLE = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
STEP = ql.Scenario(
    reference=1.0, duration=2.0, noise=ql.signals.BandLimitedNoise(1e-6, 0.01), seed=40
)


def adrc(values: Mapping[str, float]) -> ql.ADRC:
    """Return a controller for DOUBLE, with u limited to 3."""
    observer = ql.ESO.model_free(2, b0=1.0, omega_o=values["omega_o"], dt=0.01)
    return ql.ADRC(observer, values["omega_c"], u_min=-3.0, u_max=3.0)


def test_scores_of_runs_are_those_of_single_runs_with_seeds_of_their_own() -> None:
    """Names of metrics, and functions of a run; the seeds count up from the scenario's."""
    objectives = {
        "iae": Objective("iae"),
        "late": Objective(lambda run: float(abs(run["y"][-1] - 1.0)), Worst()),
    }
    problem = Problem.of_runs([DOUBLE] * 3, STEP, objectives)
    controller = adrc({"omega_c": 4.0, "omega_o": 20.0})
    scores = problem.scores(controller)
    for i in range(3):
        alone = ql.Scenario(**{**STEP.__dict__, "seed": 40 + i})
        run = ql.simulate(DOUBLE, controller, alone)
        assert scores[0, i] == run.metrics()["iae"]
        assert scores[1, i] == abs(run["y"][-1] - 1.0)
    assert len({*scores[0]}) == 3
    assert problem.values(scores) == [np.mean(scores[0]), np.max(scores[1])]
    assert np.array_equal(problem.scores(controller, 1, 3), scores[:, 1:3])


def test_a_run_that_diverges_has_an_infinite_score() -> None:
    """Whatever is scored."""
    unstable = ql.plants.LinearPlant([[1.0, 1.0], [0.0, 1.0]], [0.0, -1.0], [1.0, 0.0])
    problem = Problem.of_runs([DOUBLE, unstable], STEP, "iae", limit=2.0)
    scores = problem.scores(adrc({"omega_c": 4.0, "omega_o": 20.0}))
    assert math.isfinite(scores[0, 0])
    assert scores[0, 1] == math.inf


@pytest.mark.trial
def test_a_search_beats_its_start_on_fresh_samples_too() -> None:
    """The IAE of a limited loop on plants of uncertain gain, checked on plants that were not used."""

    def problem(seed: int) -> Problem:
        gains = np.random.default_rng(seed).uniform(0.7, 1.4, 6)
        plants = [ql.plants.LinearPlant(DOUBLE.A, [0.0, g], [1.0, 0.0]) for g in gains.tolist()]
        return Problem.of_runs(plants, ql.Scenario(reference=1.0, duration=1.5), "iae")

    space = {"omega_c": SearchRange(1.0, 8.0), "omega_o": SearchRange(8.0, 40.0)}
    start = {"omega_c": 2.0, "omega_o": 20.0}
    found = search(adrc, space, problem(1), trials=16, starts=[start], seed=1).best
    before = problem(1000).check(adrc(start))["iae"]
    after = problem(1000).check(adrc(found.parameters), found.values)["iae"]
    assert after.low < after.value < after.high < before.low
    assert after.low < found.values["iae"] < after.high
    share, low, high = after.exceeds
    assert low < share < high
    assert after.samples == 6


@cases(
    ("change", "message"),
    [
        ({"space": {}}, "at least one SearchRange, by name"),
        ({"space": {"a": 3.0}}, r"space\['a'\] = 3.0: must be a SearchRange"),
        ({"trials": 0}, "trials = 0: must be"),
        ({"sampler": "best"}, "sampler = 'best': must be one of"),
        ({"pruner": "all"}, "pruner = 'all': must be one of"),
        ({"starts": [{"a": 1.0}]}, "each start must have a value for a, b"),
        ({"starts": [{"a": 0.01, "b": 0.0}]}, r"a = 0.01: must lie within 0.1 … 10"),
        ({"executor": "processes", "violation": lambda c: 0.0}, "must be functions of a module"),
    ],
)
def test_bad_arguments_are_named(change: dict[str, Any], message: str) -> None:
    """With their values and the rule."""
    arguments: dict[str, Any] = {"space": SPACE, "trials": 2} | change
    with pytest.raises(ValueError, match=message):
        search(build, problem=BOWL, **arguments)


def test_bad_problems_and_ranges_are_named() -> None:
    """Before anything runs."""
    for make, message in (
        (lambda: SearchRange(2.0, 1.0), "low must be below high"),
        (lambda: SearchRange(-1.0, 1.0, log=True), "must be above zero in a logarithmic range"),
        (lambda: SearchRange(0.5, 2.0, whole=True), "must be whole numbers"),
        (lambda: Quantile(1.0), "level = 1.0: must be between 0 and 1"),
        (lambda: Problem([], bowl, {"bowl": Mean()}), "samples is empty"),
        (
            lambda: Problem.of_runs([DOUBLE], [STEP, STEP], "iae"),
            "scenario has 2 entries, plants 1",
        ),
        (lambda: Problem.of_runs(DOUBLE, STEP, {"iae": "iae"}), "must be an Objective"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    with pytest.raises(ValueError, match="score = 'speed': must be a function of a run, or one of"):
        Problem.of_runs(DOUBLE, STEP, "speed").scores(adrc({"omega_c": 4.0, "omega_o": 20.0}))


def test_whole_numbers_stay_whole() -> None:
    """As a parameter of a design that counts."""
    space = {"a": SearchRange(1.0, 9.0, whole=True), "b": SearchRange(-3.0, 3.0)}
    found = search(build, space, BOWL, trials=8)
    assert isinstance(found, Search)
    assert all(float(c.parameters["a"]).is_integer() for c in found.candidates)


def integrator(gain: float = 1.0) -> Any:
    """Return a plant of order 1."""
    return ql.plants.LinearPlant([[0.0]], [gain], [1.0])


BOUNDS = ql.tuning.Constraints(m_s=1.6, m_t=1.6, m_ks=20.0, omega_o_dt=0.4)
REST = ql.Scenario(duration=2.0, disturbances=(ql.signals.Step(height=0.8),))


@pytest.mark.trial
def test_tune_goes_on_by_simulation_within_the_bounds_of_the_linear_loop() -> None:
    """With limited u and a criterion of the user's it beats the optimum of the linear loop, on fresh plants too."""

    def effort(run: ql.Trajectory) -> float:
        # The error, and what u moves.
        return float(np.sum(np.abs(1.0 - run["y"])) + np.sum(np.abs(np.diff(run["u"]))))

    tuned = ql.tune(
        integrator,
        dt=0.05,
        structure="bandwidths",
        order=1,
        compare=("pi",),
        constraints=BOUNDS,
        uncertain={"gain": (0.8, 1.2)},
        samples=4,
        check_samples=20,
        scenario=ql.Scenario(reference=1.0, duration=3.0),
        objective=Objective(effort, Worst()),
        search={"trials": 16, "factor": 4.0},
        u_min=-1.0,
        u_max=1.0,
    )
    assert tuned.search is not None
    start, best = tuned.search.candidates[0], tuned.search.best
    assert tuned.objective == "effort"
    assert tuned.design.objective == best.values["effort"] < start.values["effort"]
    assert dict(tuned.design.values) == best.parameters
    for name, limit in (("M_s", 1.6), ("M_t", 1.6), ("M_ks", 20.0)):
        assert tuned.design.measures[name] < 1.002 * limit
    assert tuned.controller.parameters.limits.high == 1.0
    assert tuned.simulated_check is not None
    check = tuned.simulated_check["effort"]
    assert check.samples == 20
    assert check.value == pytest.approx(best.values["effort"], rel=0.05)
    assert "effort on 20 fresh samples" in tuned.summary()
    assert "of the optimal PI controller under the same constraints" in tuned.summary()
    assert tuned.to_json()["search"]["front"] == [best.number]
    assert "u_max = 1.0" in tuned.toml()


def test_tune_by_simulation_takes_plants_that_are_not_linear() -> None:
    """An encoder and a delay: the start is the optimum of what is linear, the runs have all of it."""
    coarse = ql.plants.encoded(ql.plants.delayed(integrator(), 0.1, 0.05), 300)
    tuned = ql.tune(
        coarse,
        dt=0.05,
        structure="pi",
        compare=(),
        constraints=BOUNDS,
        scenario=REST,
        objective={"iae": Objective("iae"), "moves": Objective("total_variation")},
        search={"trials": 20},
    )
    assert tuned.search is not None
    front = tuned.search.front
    run = ql.simulate(coarse, tuned.controller, REST)
    assert front[0].values["iae"] == run.metrics()["iae"] == tuned.design.objective
    assert len(front) > 1


@cases(
    ("change", "message"),
    [
        ({"objective": "rms"}, "objective = 'rms': must be load, load-iae or tracking; any other"),
        ({"search": {"trials": 3}}, "is for a tuning by simulation; give a scenario"),
        ({"scenario": REST, "objective": "fast", "search": {"trials": 1}}, "score = 'fast': must"),
        (
            {"scenario": REST, "objective": "iae", "search": {"factor": 1.0}},
            "factor = 1.0: must be above 1",
        ),
    ],
)
def test_what_tune_by_simulation_lacks_is_named(change: dict[str, Any], message: str) -> None:
    """Before a search begins."""
    options: dict[str, Any] = {"structure": "pi", "compare": (), "constraints": BOUNDS}
    with pytest.raises(ValueError, match=message):
        ql.tune(integrator(), 0.05, **(options | change))


MOTOR = """dt = 0.01
plant = { kind = "dc-motor" }
controller = { omega_c = 3.0 }
observer = { kind = "model-free", order = 2, b0 = 250.0, omega_o = 20.0 }
scenario = { duration = 0.5, reference = { kind = "step" } }
[tune]
structure = "pid"
compare = []
m_ks = 10.0
"""


@pytest.mark.trial
def test_a_setup_is_tuned_by_simulation_with_its_friction_and_encoder(tmp_path: Path) -> None:
    """``quell tune --trials``: the result is a setup, and its journal another search's start."""
    file, out, told = (tmp_path / name for name in ("motor.toml", "out.toml", "out.json"))
    file.write_text(MOTOR + f'storage = "{tmp_path}/journal.log"\n')
    where = ["--out", str(out), "--json", str(told), "--no-figures"]
    with pytest.raises(SystemExit, match="0"):
        app(["tune", str(file), "--trials", "6", *where])
    found = json.loads(told.read_text())
    assert found["objective"] == "iae"
    assert len(found["search"]["candidates"]) == 6
    best = min(c["values"]["iae"] for c in found["search"]["candidates"] if c["finished"])
    given = load(out)
    run = ql.simulate(given.plant, given.controller, given.scenario)
    assert run.metrics()["iae"] == pytest.approx(best, rel=1e-9)
    assert found["design"]["objective"] == best
    assert (tmp_path / "journal.log").exists()
    with pytest.raises(ValueError, match="--trials = 3: needs a setup file with a scenario"):
        app(["tune", "--num", "1", "--den", "1,1", "--dt", "0.01", "--trials", "3"])
