"""The guard's trial as an instrument: it can fail, it repeats, it says what it did.

Without guard most kinds wreck some loop: ``.ci/run`` has ten of them, one test the others.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.experiments import stress
from quell.experiments.stress import study
from quell.experiments.stress.adversaries import FEATURES
from quell.kernels.sized import layout_of

from .cases import cases


@pytest.mark.trial
@pytest.mark.lost
@pytest.mark.parametrize("kind", stress.KINDS[10:])
def test_without_a_guard_the_other_kinds_wreck_a_loop_too(kind: str) -> None:
    """A turncoat, once it has turned, and random features; as Python: the loop does not last."""
    hostile = {
        "turncoat": stress.Turncoat(ql.learners.Kalman(), 20.0, 10.0),
        "random features": stress.Adversary(FEATURES, weights=(0.0, 0.0, 0.0, -5.0)),
    }
    loop = stress.Loop(0.8, 1.3, 1.4, gain_error=1.2, dt=0.01, omega=0.5, amplitude=1.0, seed=4)
    run = ql.simulate(loop.plant, loop.controller(hostile[kind]), loop.scenario)
    assert run.diverged
    assert run.ended > 20.0 or kind != "turncoat"
    plain = ql.simulate(loop.plant, loop.controller(), replace(loop.scenario, duration=40.0))
    assert not plain.diverged


@pytest.mark.trial
@pytest.mark.compiled
def test_the_same_seed_gives_the_same_trial() -> None:
    """All that is random is drawn from it."""
    one, again, other = (stress.run(1, 1, seed, guard=ql.Guard()) for seed in (1, 1, 2))
    assert [o.guarded for o in one.outcomes] == [o.guarded for o in again.outcomes]
    assert [o.guarded for o in one.outcomes] != [o.guarded for o in other.outcomes]


@pytest.mark.trial
@pytest.mark.compiled
def test_results_are_plain_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """For ``json.dump``, with counts for each kind, quantiles of the ratios and of what chance does; here with one draw of the noise."""
    monkeypatch.setattr(study, "USUAL", range(1))
    monkeypatch.setattr(study, "OTHERS", range(1, 2))
    shares: list[float] = []
    result = stress.run(12, 1, seed=5, guard=ql.Guard(), progress=shares.append)
    assert result.kinds == [*stress.KINDS, stress.HONEST]
    found = result.to_json()
    assert json.loads(json.dumps(found)) == found
    groups = {"hostile", "honest", "hostile_other_noise", "honest_other_noise"}
    assert set(found) == {"settings", "bars", "kinds", "worst", *groups}
    assert found["hostile"]["loops"] == 12
    assert list(found["kinds"]) == list(stress.KINDS)
    quantiles = {"median", "p90", "p99", "max"}
    assert set(found["honest"]["load"]) == {*quantiles, "worse", "mean_log"}
    assert abs(found["honest_other_noise"]["whole"]["mean_log"]) < 0.01
    assert [bar["other_noise"] is None for bar in found["bars"]] == [False] * 8
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def judged(guarded: float, chance: float = 1.0) -> stress.Outcome:
    """An outcome with these ratios."""
    loop = stress.draw_loops(1, np.random.default_rng(0))[0]
    ratios = (stress.Errors(ratio, ratio, ratio) for ratio in (guarded, chance))
    return stress.Outcome(stress.HONEST, loop, "", *ratios)


def test_loops_are_judged_by_means_over_draws_of_the_noise() -> None:
    """The mean error with the learner over the mean without, with the same draws; chance from as many other draws."""
    asked: list[tuple[bool, tuple[int, ...]]] = []

    def errors(learner: Any, guard: Any, draws: range) -> stress.Errors:
        asked.append((learner is None, tuple(draws)))
        size = 1.0 if learner is None else 0.5

        def one(draw: int) -> stress.Errors:
            return stress.Errors(size * (1.0 + draw), size, math.inf if draw == 5 else size)

        return study.mean_errors(one, draws)

    plain, guarded, chance = study.compare(errors, ql.learners.Kalman(), None)
    assert plain == stress.Errors(2.5, 1.0, 1.0)
    assert guarded == [0.5, 0.5, 0.5]
    assert chance == [6.5 / 2.5, 1.0, math.inf]
    assert asked == [(True, (0, 1, 2, 3)), (False, (0, 1, 2, 3)), (True, (4, 5, 6, 7))]
    assert stress.DRAWS == 4


def test_a_ratio_says_which_of_the_two_loops_is_lost() -> None:
    """Infinite with the learner, NaN without; of two joints the worse counts."""
    lost, held = [math.inf, math.inf], [0.5, 2.0]
    assert study.ratios(lost, held) == lost
    assert all(math.isnan(ratio) for ratio in study.ratios(held, lost))
    assert study.ratios([np.array([1.0, 3.0])], [np.array([1.0, 2.0])]) == [1.5]
    assert judged(math.inf).lost
    assert judged(math.nan).plain_lost
    assert not judged(math.nan).lost


def test_a_summary_has_the_share_of_worse_loops_and_the_mean_logarithm() -> None:
    """A lost loop counts as worse; one that is lost without learner does not count."""
    outcomes = [judged(0.5), judged(1.2, 1.1), judged(math.inf), judged(2.0), judged(math.nan)]
    found = stress.summary(outcomes, stress.Errors)
    assert (found["loops"], found["lost"], found["plain_lost"]) == (5, 1, 1)
    assert found["whole"]["worse"] == 0.75
    assert found["whole"]["mean_log"] == pytest.approx(math.log(0.5 * 1.2 * 2.0) / 3.0)
    assert stress.summary(outcomes, stress.Errors, "chance")["whole"]["worse"] == 0.25
    assert stress.summary([], stress.Errors)["late"]["worse"] is None


def test_bars_have_what_chance_does_beside_them() -> None:
    """Of the two masses; groups without loops have none, and a group whose loops are all lost meets none."""
    bars = {bar.measure: bar for bar in stress.Result({}, [judged(0.3, 1.1)]).bars()}
    assert len(bars) == 5
    median = bars["minute of load, median"]
    assert (median.figure, median.met, median.other_noise) == (0.3, False, 1.1)
    assert bars["minute of load, largest"].met
    assert not any(bar.met for bar in stress.Result({}, [judged(math.inf)]).bars())
    assert stress.Result({}, [judged(math.nan)]).bars() == []


def test_another_draw_is_another_noise_in_the_same_loop(rng: np.random.Generator) -> None:
    """Reference, load and plant stay."""
    loop = stress.draw_loops(1, rng)[0]
    one, other = loop.scenario, replace(loop, draw=3).scenario
    assert (one.reference, one.disturbances) == (other.reference, other.disturbances)
    assert one.seed != other.seed


def test_loops_are_drawn_within_their_ranges(rng: np.random.Generator) -> None:
    """And b0 is off by as much as it says."""
    for loop in stress.draw_loops(50, rng):
        assert 0.5 <= loop.m1 <= 2.0
        assert 0.3 <= loop.k <= 3.0
        assert loop.dt in (1e-3, 2e-3, 5e-3)
        b = ql.canonical(loop.plant).b
        assert loop.controller().parameters.b0 == pytest.approx(loop.gain_error * b)


@pytest.mark.parametrize("kind", stress.KINDS)
def test_every_kind_of_adversary_runs_as_it_was_drawn(kind: str, rng: np.random.Generator) -> None:
    """Each draw is another learner, with a short run to show."""
    loop = replace(stress.draw_loops(1, rng)[0], dt=1e-2)
    one, other = (stress.draw_adversary(kind, rng) for _ in range(2))
    assert repr(one) != repr(other)
    run = ql.simulate(
        loop.plant, loop.controller(one, ql.Guard()), ql.Scenario(ql.signals.Sinusoid(), 2.0)
    )
    assert not run.diverged


@cases(
    ("arguments", "message"),
    [
        ((-1, 0, 0), "runs = -1"),
        ((0, 0, 0), "at least one must be positive"),
        ((1, 0, -1), "seed = -1"),
        ((1, 0.5, 0), "honest = 0.5"),
    ],
)
def test_mistakes_are_named(arguments: tuple[int, int, int], message: str) -> None:
    """Argument, value, rule."""
    with pytest.raises(ValueError, match=message):
        stress.run(*arguments, guard=None)


def test_delays_of_all_lengths_run_the_same_code() -> None:
    """Else the trial compiles for each of them; and features of a lower order are the first ones."""
    observer = ql.ESO.model_free(order=1, b0=1.0, omega_o=10.0, dt=0.01)
    delayed = [stress.Adversary(kind=4, delay=delay) for delay in (3, 7)]
    memories = [learner.memory(learner.design(observer, 1.0)) for learner in delayed]
    assert [memory.past.size for memory in memories] == [4, 8]
    assert layout_of(memories[0]) == layout_of(memories[1])
    features = stress.Adversary(kind=9, weights=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    assert features.design(observer, 1.0).weights.tolist() == [1.0, 2.0, 3.0]


def test_an_unknown_kind_is_refused(rng: np.random.Generator) -> None:
    """With the list of those there are."""
    with pytest.raises(ValueError, match="kind"):
        stress.draw_adversary("bad mood", rng)
