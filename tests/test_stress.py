"""The guard's trial as an instrument: it can fail, it repeats, it says what it did.

Without guard most kinds wreck some loop: ``.ci/run`` has ten of them, one test the others.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import quell as ql
from quell.experiments import stress
from quell.experiments.stress.adversaries import FEATURES
from quell.kernels.sized import layout_of


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


@pytest.mark.compiled
def test_the_same_seed_gives_the_same_trial() -> None:
    """All that is random is drawn from it."""
    one, again, other = (stress.run(2, 1, seed, guard=ql.Guard()) for seed in (1, 1, 2))
    assert [o.ratio for o in one.outcomes] == [o.ratio for o in again.outcomes]
    assert [o.ratio for o in one.outcomes] != [o.ratio for o in other.outcomes]


@pytest.mark.compiled
def test_results_are_plain_data() -> None:
    """For ``json.dump``, with counts for each kind and quantiles of the ratios."""
    shares: list[float] = []
    result = stress.run(12, 1, seed=5, guard=ql.Guard(), progress=shares.append)
    assert result.kinds == [*stress.KINDS, stress.HONEST]
    found = result.to_json()
    assert json.loads(json.dumps(found)) == found
    assert set(found) == {"settings", "adversarial", "honest", "kinds", "worst"}
    assert found["adversarial"]["runs"] == 12
    assert list(found["kinds"]) == list(stress.KINDS)
    assert set(found["honest"]["load_ratio"]) == {"median", "p90", "p99", "max"}
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


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


@pytest.mark.parametrize(
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
