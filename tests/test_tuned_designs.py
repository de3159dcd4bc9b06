"""Which designs tune makes, and why there is none: damping that is given up, contradictions, trade-offs."""

from __future__ import annotations

import importlib
import itertools
import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import quell as ql
from quell.tuning import Constraints, acceptance, compensator, designs, report
from quell.tuning.designs import Task
from quell.tuning.optimiser.loops import load_step
from quell.tuning.optimiser.requirements import Active
from quell.tuning.optimiser.search import Solution
from quell.tuning.plants import given_plants, model_of, plant_set
from quell.tuning.report import Design
from quell.tuning.structures.registry import make_structure

from .cases import cases

tune_module: Any = importlib.import_module("quell.tuning.tune")
simulated: Any = importlib.import_module("quell.tuning.simulated.search")

DT = 0.05
LAG = ([1.0], [1.0, 1.0])


def task(objective: str = "load", **constraints: Any) -> Task:
    """Return the task of a lag."""
    given = given_plants(LAG, DT)
    plants = plant_set(given, DT)
    bounds = Constraints(**{"m_ks": 3.0, **constraints})
    return Task(
        plants, model_of(given, plants, bounds), bounds, objective, load_step(plants), 1.0, None, {}
    )


@cache
def tuned() -> ql.Tuned:
    """Return a lag with a PI controller."""
    return ql.tune(LAG, DT, structure="pi", compare=(), written=False, objective="load",
                   constraints=Constraints(m_ks=3.0))  # fmt: skip


def solution(
    cost: float, violation: float = 0.0, name: str = "pi", values: Any = (1.5, 0.8, 0.2)
) -> Solution:
    """Return a solution of a structure for the lag."""
    whole = task()
    return Solution(make_structure(name, whole.model, 0), np.array(values), cost, violation)


# ---- with and without damping


def made(results: Any, **constraints: Any) -> tuple[dict[str, Design], list[Any], list[Any]]:
    """Return the designs of ``pi`` for what ``_solutions`` returns, its calls, and the progress."""
    asked, told, own = [], [], tuned().design

    def solutions(name: str, given: Task, known: Any) -> list[Solution]:
        asked.append((name, given.constraints.damping, sorted(known)))
        return results(name, given.constraints.damping)

    with ExitStack() as stack:
        stack.enter_context(patch.object(designs, "_solutions", solutions))
        stack.enter_context(patch.object(designs, "contradiction", lambda *_: "they contradict"))
        stack.enter_context(
            patch.object(
                designs, "design_of",
                lambda name, problem, best, bounds, options: replace(
                    own, name=name, objective=best.cost, undamped=False),
            )
        )  # fmt: skip
        found = designs.tuned_designs(
            ["pid", "pi"], task(**constraints), lambda name, share: told.append((name, share))
        )
    return found, asked, told


def test_a_bound_of_damping_that_none_keeps_is_given_up_and_said() -> None:
    """Where a design without it keeps all others; else the contradiction is told."""
    found, asked, told = made(lambda name, damping: [solution(1.0, 0.2 if damping else 0.0)])
    assert [*found] == ["pid", "pi"]
    assert all(each.undamped for each in found.values())
    assert asked == [
        ("pi", 0.4, []), ("pi", None, []), ("pid", 0.4, ["pi"]), ("pid", None, ["pi"]),
    ]  # fmt: skip
    assert told == [("pi", 0.0), ("pid", 0.5)]
    found, asked, _ = made(lambda name, damping: [solution(1.0, 0.0)])
    assert not any(each.undamped for each in found.values())
    assert [each[1] for each in asked] == [0.4, 0.4]
    found, _, _ = made(lambda name, damping: [solution(1.0, 0.2)])
    assert [each.reason for each in found.values()] == ["they contradict"] * 2
    found, asked, _ = made(lambda name, damping: [solution(1.0, 0.2)], damping=None)
    assert [each[1] for each in asked] == [None, None]


def test_of_several_orders_the_best_that_keeps_its_bounds_is_taken() -> None:
    """The least cost; one that keeps none loses; without any solution the plant is not stabilised."""
    several = [solution(0.5, 0.1), solution(2.0), solution(1.0), solution(3.0)]
    found, _, _ = made(lambda name, damping: several)
    assert [each.objective for each in found.values()] == [1.0, 1.0]
    found, _, _ = made(lambda name, damping: [])
    assert found["pi"].controller is None
    assert found["pi"].reason == (
        "no controller of this structure was found that stabilises the plant"
    )

    def refuse(name: str, damping: Any) -> Any:
        raise ValueError(f"{name} has no model")

    found, _, _ = made(refuse)
    assert [each.reason for each in found.values()] == ["pid has no model", "pi has no model"]


def test_an_infinite_gain_is_no_objective() -> None:
    """Two integrators go with the integral of |y|."""
    with pytest.raises(
        ValueError, match="k_i is infinite with 2 integrators: after a step of the load"
    ):
        designs._solutions("bandwidths-2", task(), {})


# ---- limits that are moved


def test_limits_are_relaxed_by_one_factor() -> None:
    """All bounds and extras; the damping by what is left to one."""
    problem = task().problem()
    found = designs.relaxed(problem, 1.5)
    assert [bound.limit for bound in found.bounds] == pytest.approx(
        [1.5 * bound.limit for bound in problem.bounds]
    )
    assert [extra.limit for extra in found.extras] == pytest.approx(
        [1.5 * extra.limit for extra in problem.extras]
    )
    one, values = make_structure("model-based", task().model, 0), np.array([[1.0, 2.0, 5.0]])
    for before, after in zip(problem.extras, found.extras, strict=True):
        np.testing.assert_allclose(after.ratio(one, values), before.ratio(one, values) / 1.5)
    assert found.damping == pytest.approx(1.0 - 1.5 * 0.6)
    assert designs.relaxed(problem, 1.7).damping is None
    assert designs.relaxed(replace(problem, damping=None), 1.1).damping is None


def test_constraints_that_contradict_are_told_with_the_least_excess() -> None:
    """By bisection, to what the search reaches; or that none was found with all relaxed."""
    problem, best = task(m_s=1.6, m_ks=3.0).problem(), solution(1.0, 0.3)
    edge = 1.23

    def search(near: Any, structure: Any, values: Any, rounds: int) -> Any:
        factor = near.bounds[0].limit / problem.bounds[0].limit
        return solution(1.0, 0.0 if factor >= edge else 0.1)

    active = (Active("M_s", 1.9, 1.9, 1.0, 0), Active("|p| dt", 0.5, 0.5, math.nan, 0))
    with (
        patch.object(designs, "search", search),
        patch.object(designs, "measured", lambda *_: ({}, active, None)),
    ):
        text = designs.contradiction(problem, best, task().constraints)
    before, share = text.rsplit(" is ", 1)
    assert before == (
        "the constraints contradict each other for this structure: M_s 1.6, |p| dt 0.5; the least "
        "excess that was found"
    )
    assert float(share.split(" %")[0]) == pytest.approx(23.0, abs=1.0)
    assert share.endswith(" % for each")
    with patch.object(designs, "search", lambda *_: None):
        text = designs.contradiction(problem, best, task().constraints)
    assert text == (
        "the constraints contradict each other for this structure: no controller was found even "
        f"with all limits relaxed by a factor of {designs._RELAXED[-1]:g}"
    )


def test_a_limit_over_time_is_told_with_the_least_that_was_found() -> None:
    """Raised, or a smaller load."""
    problem, best = task(u_max=0.5).problem(), solution(1.0, 0.3)
    active = (Active("u_max", 0.6, 0.5, math.nan, 0),)
    factor = designs._RELAXED[0]

    def search(near: Any, *_: Any) -> Any:
        return solution(
            1.0, 0.0 if near.bounds[0].limit >= factor * problem.bounds[0].limit else 0.1
        )

    with (
        patch.object(designs, "search", search),
        patch.object(designs, "measured", lambda *_: ({}, active, None)),
    ):
        text = designs.contradiction(problem, best, task().constraints)
    assert text.startswith(
        "the constraints contradict each other for this structure: u_max 0.5; the least"
    )
    least = factor * 0.5
    assert text.endswith(
        f"; u_max bounds the response to the load or the reference, and the least that was found is "
        f"{least:.3g}, with the other bounds relaxed as much: raise it, or give a smaller load or "
        "reference"
    )


@cases("objective", ["load", "load-iae"])
def test_a_tradeoff_moves_each_active_limit_by_a_tenth(objective: str) -> None:
    """The objective with 0.9 and 1.1 times of it; no M_s of one or less; what fails is left out."""
    asked = []

    def search(near: Any, structure: Any, values: Any, rounds: int) -> Any:
        limits = {bound.kind: bound.limit for bound in near.bounds} | {"damping": near.damping}
        asked.append(limits)
        return solution(math.log(2.0), 0.1 if limits["M_ks"] > 3.0 else 0.0)

    active = (
        Active("M_s", 1.05, 1.05, 1.0, 0), Active("M_ks", 3.0, 3.0, 1.0, 0),
        Active("damping", 0.4, 0.4, 1.0, 0), Active("|p| dt", 0.5, 0.5, math.nan, 0),
    )  # fmt: skip
    design = replace(tuned().design, active=active)
    with patch.object(designs, "search", search):
        found = designs.tradeoff(task(objective, m_s=1.05), design)
    size = 0.5 if objective == "load" else 2.0
    assert found == [
        ("M_s", pytest.approx(1.155), pytest.approx(size)),
        ("M_ks", pytest.approx(2.7), pytest.approx(size)),
        ("damping", pytest.approx(0.36), pytest.approx(size)),
        ("damping", pytest.approx(0.44), pytest.approx(size)),
    ]
    assert [each["M_s"] for each in asked] == pytest.approx([1.155, 1.05, 1.05, 1.05, 1.05])
    assert [each["damping"] for each in asked] == pytest.approx([0.4, 0.4, 0.4, 0.36, 0.44])


def test_the_curve_of_the_noise_goes_from_its_bound_up_and_down() -> None:
    """By factors of two, each search from the one before.

    One that exceeds a limit goes on; the curve ends where there is no design then.
    """
    starts: list[Any] = []

    def search(near: Any, structure: Any, values: Any, rounds: int) -> Any:
        (limit,) = [bound.limit for bound in near.bounds if bound.kind == "M_ks"]
        starts.append((limit, float(values[0])))
        return solution(-math.log(limit), 0.1 if limit < 1.0 else 0.0, values=(limit, 0.8, 0.2))

    own = replace(solution(-math.log(3.0)), values=np.array([9.0, 0.8, 0.2]))
    design = replace(tuned().design, solution=own)
    with patch.object(designs, "search", search):
        found = designs.noise_curve(task(), design)
    assert found == [pytest.approx((x, x)) for x in (1.5, 3.0, 6.0, 12.0)]
    assert starts == [(6.0, 9.0), (12.0, 6.0), (1.5, 9.0), (0.75, 1.5), (0.75, 0.75)]


# ---- the best of a structure


def ran(
    whole: Task, gains: list[Solution], known: Any = (), each_of: Any = None, end: Any = None
) -> tuple[Any, list[Any]]:
    """Return the result of ``_best`` with stand-ins for its searches, and where these began."""
    begun: list[Any] = []
    structure = make_structure("pi", whole.model, 0)

    def at(problem: Any, structure: Any, row: Any) -> Any:
        return solution(float(row[0]), 0.0, values=row)

    def search(problem: Any, structure: Any, values: Any, rounds: int) -> Any:
        begun.append(float(values[0]))
        return None if end is None else end(values)

    with (
        patch.object(designs, "_best_gains", lambda *_: gains),
        patch.object(designs, "solution_at", at),
        patch.object(designs, "search", search),
    ):
        rows = np.array([*known]).reshape(-1, 3)
        return designs._best(whole, structure, rows), begun


def test_of_optima_for_the_gain_the_best_is_the_result_where_nothing_is_slow() -> None:
    """None without any; for other objectives it is where a search starts, with those known."""
    gains = [solution(3.0, 0.0, values=(3.0, 1.0, 1.0)), solution(2.0, 0.0, values=(2.0, 1.0, 1.0)),
             solution(1.0, 0.2, values=(1.0, 1.0, 1.0))]  # fmt: skip
    found, begun = ran(task(), gains)
    assert (found.cost, begun) == (2.0, [])
    assert ran(task(), [])[0] is None
    slow = task("load-iae")

    def better(values: Any) -> Solution:
        return solution(float(values[0]) - 0.5, 0.0, values=values)

    found, begun = ran(slow, gains, [(0.7, 1.0, 1.0)], end=better)
    assert begun == [0.7]
    assert found.cost == pytest.approx(0.2)
    worse, begun = ran(slow, gains, end=lambda values: solution(9.0, 0.0))
    assert (worse.cost, begun) == (1.0, [1.0])
    none, _ = ran(slow, gains)
    assert none.cost == 1.0


def members(scores: list[list[float]]) -> Iterator[Any]:
    """Return scores of a set in turn."""
    return iter([np.array(each) for each in scores])


def test_of_a_large_set_the_worst_plants_are_searched_for_until_no_other_is_worse() -> None:
    """Those of each round are added; the cost is that of all."""
    count = designs._MEMBERS + 3
    plants = [([1.0 + 0.01 * i], [1.0, 1.0]) for i in range(count)]
    given = given_plants(plants, DT)
    whole = replace(task("load-iae"), plants=plant_set(given, DT))
    flat = [1.0] * count
    first, second = [*flat], [*flat]
    for i in range(designs._MEMBERS):
        first[i] = 5.0 + i
    second[count - 1] = 9.0
    turns = members([first, second, flat])
    asked: list[Any] = []
    problem = Task.problem

    def noted(self: Task, of: Any = None) -> Any:
        asked.append(None if of is None else sorted(of))
        return problem(self) if of is None else problem(self, of)

    with (
        patch.object(designs, "scores", lambda *_: next(turns)),
        patch.object(Task, "problem", noted),
        patch.object(Solution, "feasible", True),
    ):
        found, begun = ran(whole, [solution(1.0)], end=lambda values: solution(0.5, values=values))
    rounds = [each for each in asked if each is not None]
    assert rounds[0] == [*range(designs._MEMBERS)]
    assert count - 1 in rounds[1]
    assert set(rounds[1]) > set(rounds[0])
    assert len(rounds) == 2
    assert found is not None
    assert len(begun) == 2


# ---- in place of one that fails


def test_designs_that_are_not_much_worse_may_take_the_place_of_one_that_fails() -> None:
    """Named by default, not undamped, with a controller, the best first; none of a named structure."""
    own = tuned().design
    first = replace(own, name="first", objective=3.0)
    designs_of = {
        "pi": first,
        "pid": replace(own, name="pid", objective=2.5),
        "bandwidths": replace(own, name="bandwidths", objective=2.9),
        "poles": replace(own, name="poles", objective=2.99, undamped=True),
        "half-gain": replace(own, name="half-gain", objective=1.9),
        "lqg": replace(own, name="lqg", objective=2.95, controller=None),
    }
    asked: list[Any] = []

    def accepted(one: Design, others: Any, judged: Any, name: str) -> Any:
        asked.append(([each.name for each in others], name, judged(one)))
        return one, SimpleNamespace(prefilter=None), ""

    with (
        patch.object(acceptance, "accepted", accepted),
        patch.object(acceptance, "judge", lambda loop, controller, analysis: (loop, analysis)),
        patch.object(tune_module, "_analysis", lambda given, plants, design: design.name),
    ):
        for structure, expected in ((tune_module.SIMPLEST, ["bandwidths", "pid"]), ("pi", [])):
            tune_module._accepted(first, designs_of, structure, task(), None, "loop")  # type: ignore[arg-type]
            names = [name for name in asked[-1][0] if name in ("pid", "bandwidths")]
            assert names == expected
            assert not {"poles", "half-gain", "lqg", "first"} & set(asked[-1][0])
            assert asked[-1][1:] == ("first", ("loop", "first"))


def test_a_process_that_needs_no_prefilter_may_leave_less_of_the_error() -> None:
    """Less than 95 % of that of the chosen one, without failures; the least, and a line says so."""
    own = tuned().design
    names = ("pi", "pid", "bandwidths", "half-gain", "poles")
    designs_of = {name: replace(own, name=name, controller=name) for name in names}  # type: ignore[arg-type]
    errors = {"pi": 4.0, "pid": 3.0, "bandwidths": 2.0, "half-gain": 1.5, "poles": 3.9}
    file = SimpleNamespace(error=errors.__getitem__)

    def judge(_: Any, controller: Any, analysis: Any) -> Any:
        failures = ("NOT",) if controller == "bandwidths" else ()
        prefilter = "model" if controller == shaped else None
        return SimpleNamespace(controller=controller, failures=failures, prefilter=prefilter)

    with (
        patch.object(acceptance, "judge", judge),
        patch.object(tune_module, "_analysis", lambda *_: None),
        patch.object(
            acceptance, "quick_without", lambda loop, controller, analysis: controller in quick
        ),
    ):

        def chosen(structure: str = tune_module.SIMPLEST) -> tuple[str, str]:
            loop: Any = SimpleNamespace(written=file)
            found, _, why = tune_module._accepted(
                designs_of["pi"], designs_of, structure, task(), None, loop  # type: ignore[arg-type]
            )  # fmt: skip
            return found.name, why

        shaped, quick = "pi", ("pid", "bandwidths", "poles")
        assert chosen() == (
            "pid",
            "pi is left out: at the limits of u its step needs a prefilter, with which ∫|r − y| in "
            "the scenario is 4; pid needs none and has 3",
        )
        quick = ("pid", "half-gain")
        assert chosen()[0] == "half-gain"
        quick = ("poles",)
        assert chosen() == ("pi", "")
        quick = ("pid",)
        assert chosen("pi") == ("pi", "")
        shaped = ""
        assert chosen() == ("pi", "")


def test_noise_that_a_controller_in_use_brings_is_its_largest_gain_to_u() -> None:
    """Of a stable loop with the first plant and its delay; None without one, or an unstable one."""
    plant, dt = ([2.0], [1.0, 1.0]), 0.05
    given = given_plants(plant, dt, delay=0.1)
    calm, wild = (ql.baselines.PID(kp=kp, ki=1.0, dt=dt) for kp in (1.0, 50.0))
    expected = ql.analysis.analyse(plant, calm, delay=0.1).noise_to_control_peak
    assert tune_module._m_ks_of(calm, given) == pytest.approx(expected)
    assert tune_module._m_ks_of(wild, given) is None
    assert tune_module._m_ks_of(None, given) is None


def test_several_integrators_that_bring_nothing_are_said() -> None:
    """One integrator is at least as good; for a load or a reference."""
    own = tuned().design
    with patch.object(report, "_integrators", lambda design: 2 if design.name == "two" else 1):
        two, one = replace(own, name="two", objective=3.0), replace(own, name="one", objective=3.0)
        (line,) = report._integrators_line(two, {"one": one}, "load")
        assert line == (
            "NOT better with 2 integrators: one has one, and is at least as good for a step of the "
            "load; take it, unless the load is a ramp or a slow sinusoid"
        )
        assert "for this reference;" in report._integrators_line(two, {"one": one}, "tracking")[0]
        worse = replace(one, objective=2.9)
        assert report._integrators_line(two, {"one": worse}, "load") == []
        assert report._integrators_line(two, {}, "load") == []
        assert report._integrators_line(one, {"one": one}, "load") == []
    assert report._integrators(own) == 1


def test_candidates_behind_the_best_are_the_slowest_of_each_part() -> None:
    """Of integrals up to 1.5 times the best one."""

    def candidate(iae: float, omega_o: float) -> Any:
        return SimpleNamespace(
            measures=SimpleNamespace(iae=iae), observer=SimpleNamespace(omega_o=omega_o)
        )

    count = compensator._MOST_OTHERS
    ends = np.geomspace(1.0, 1.5, count + 1)
    best = candidate(2.0, 9.0)
    parts = []
    for low, high in itertools.pairwise(ends.tolist()):
        middle = 2.0 * math.sqrt(low * high)
        parts.append((candidate(middle, 5.0), candidate(middle * 1.001, 4.0)))
    far = candidate(3.1, 1.0)
    found = compensator._less_and_less([best, *(each for pair in parts for each in pair), far])
    assert found == [slow for _, slow in parts]
    assert compensator._less_and_less([best, candidate(2.0, 1.0)]) == []


def test_bandwidths_beside_an_infinite_gain_lie_on_its_positive_side() -> None:
    """A tenth beyond the observer's bandwidth at which 1/k_i is zero."""
    based = make_structure("model-based", model_of(
        given_plants(([1.0], [1.0, 0.02, 1.0]), DT), plant_set(given_plants(([1.0], [1.0, 0.02, 1.0]), DT), DT),
        Constraints()), 0)  # fmt: skip

    def gain(values: np.ndarray) -> np.ndarray:
        return 1.0 / np.log(values[:, 2] / 0.5)

    with patch.object(type(based), "integral_gain", lambda self, values: gain(values)):
        rows = based.beside(np.array([1.0, 2.0, 3.0]))
    assert rows[:, 1].tolist() == pytest.approx([1.0, 2.0, 4.0])
    assert rows[:, 2].tolist() == pytest.approx([0.55] * 3, rel=1e-3)
    with patch.object(type(based), "integral_gain", lambda self, values: -gain(values)):
        rows = based.beside(np.array([1.0, 2.0, 3.0]))
    assert rows[:, 2].tolist() == pytest.approx([0.5 / 1.1] * 3, rel=1e-3)


def test_the_simplest_of_those_that_can_do_what_is_asked_is_chosen() -> None:
    """With a feedforward of those that feed forward; a named one, or the reason why there is none."""
    own = tuned().design
    named = {name: replace(own, name=name, objective=3.0) for name in ("pi", "poles", "lqg")}
    assert tune_module._chosen(named, tune_module.SIMPLEST, task()).name == "pi"
    assert tune_module._chosen(named, "lqg", task()).name == "lqg"
    feeding = replace(task(), feedforward=ql.Feedforward.rigid(1.0))
    assert (
        tune_module._chosen(named, tune_module.SIMPLEST, feeding).name
        in tune_module.FEEDING_FORWARD
    )
    none = {"pi": report.impossible("pi", "it rings")}
    with pytest.raises(ValueError) as caught:
        tune_module._chosen(none, "pi", task())
    assert str(caught.value) == f"structure = 'pi': it rings ({task().constraints})"
    with pytest.raises(ValueError, match="it rings"):
        tune_module._chosen(none, tune_module.SIMPLEST, task())


def test_a_strategy_goes_on_after_the_finished_trials_of_a_study() -> None:
    """In generations; a trial that was given up comes last, unfinished ones and others not at all."""
    told: list[Any] = []

    class Strategy:
        population_size = 2

        def __init__(self, **options: Any) -> None:
            told.append(options)

        def tell(self, generation: Any) -> None:
            told.append([(point.tolist(), value) for point, value in generation])

    def trial(x: float, value: Any, name: str = "COMPLETE", **more: Any) -> Any:
        state = SimpleNamespace(is_finished=lambda: name != "RUNNING", name=name)
        return SimpleNamespace(state=state, params={"x": x, **more} if x else more, value=value)

    with patch.object(simulated, "import_extra", lambda *_: SimpleNamespace(CMA=Strategy)):
        sampler = simulated.Generations({"x": simulated.SearchRange(0.0, 10.0)}, {"x": 2.5})
        trials = [trial(1.0, 3.0), trial(2.0, None, "RUNNING"), trial(4.0, None, "PRUNED"),
                  trial(0.0, 1.0, other=2.0), trial(6.0, 5.0), trial(8.0, 2.0), trial(9.0, 1.0)]  # fmt: skip
        sampler.after(SimpleNamespace(get_trials=lambda deepcopy: trials))
    assert told[0]["mean"].tolist() == [0.25]
    assert told[0]["bounds"].tolist() == [[0.0, 1.0]]
    assert told[1][0] == ([pytest.approx(0.1)], 3.0)
    assert told[1][1] == ([pytest.approx(0.4)], simulated._LARGEST)
    assert told[2] == [([pytest.approx(0.6)], 5.0), ([pytest.approx(0.8)], 2.0)]
    assert len(told) == 3
