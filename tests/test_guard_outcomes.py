"""The guard's account of outcomes: trials of authority, what fails them, and how seldom they fail."""

from __future__ import annotations

import math

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.analysis.loop import about_learning
from quell.guard.kernels import authority_of, keep_outcomes

from .benchmark_module import benchmark
from .guarded_samples import GUARD

coupled_arms = benchmark("coupled_arms")

LAG = 4  # samples in a lag of the observer
OBSERVER = ql.ESO.model_free(order=2, b0=1.0, omega_o=3.0 / LAG, dt=1.0)


def _guard() -> tuple[object, object]:
    """Return a guard that trusts a learner whose corrections may have caused all of q."""
    design = GUARD.design(OBSERVER)
    memory = GUARD.memory(design)
    memory.sample[0].credit = memory.sample[0].authority = 1.0
    memory.averages[0].missed = memory.averages[0].gained = 1.0
    memory.sample[0].outside = memory.sample[0].peak = 1e9  # nothing is withheld for other reasons
    memory.sample[0].own_peak = memory.trial[0].own = memory.trial[0].own_lately = 1e9
    memory.trial[0].outside = memory.suspect[0].outside = 1.0
    memory.sample[0].samples = 1e6
    return design, memory


def _sample(design: object, memory: object, F: float) -> float:
    """Return the authority after a sample with this mean of q², none of which is explained."""
    memory.averages[0].newest_error = memory.averages[0].newest_left = F
    keep_outcomes(design, memory, F)
    memory.sample[0].authority = authority_of(design, memory, 1.0)[0]
    return float(memory.sample[0].authority)


def test_failed_trials_are_at_most_three_and_the_logarithm_of_the_time() -> None:
    """A learner that makes q large whenever it is heard has 3 + log2(t/D_1) failed trials at most."""
    design, memory = _guard()
    waits, samples = [], 700 * LAG
    authority = 1.0
    for k in range(samples):
        authority = _sample(design, memory, 1e3 if authority > 0.0 else 0.1)
        if not waits or memory.trial[0].wait > waits[-1][1]:
            waits.append((k, float(memory.trial[0].wait)))
    failed = [each for each in waits if each[1] > 0.0]
    assert 3 <= len(failed) <= 3 + math.log2(700.0 / 100.0)
    assert [wait / (100.0 * LAG) for _, wait in failed] == pytest.approx(
        [2.0**i for i in range(len(failed))]
    )


def test_a_first_failed_trial_gives_authority_back_at_once_and_a_second_does_not() -> None:
    """Half of the authority after 20 lags; after the second trial none for 200 lags, then a quarter, then half, then all."""
    design, memory = _guard()
    seen = [_sample(design, memory, 1e3)]
    seen += [_sample(design, memory, 0.1) for _ in range(20 * LAG)]
    assert seen[:-1] == [0.0] * (20 * LAG)
    assert seen[-1] == 0.5
    _sample(design, memory, 1e3)
    seen = [_sample(design, memory, 0.1) for _ in range(20 * LAG + 600 * LAG)][20 * LAG :]
    parts = [set(seen[i * 200 * LAG + 2 : (i + 1) * 200 * LAG - 2]) for i in range(3)]
    assert parts == [{0.0}, {0.25}, {0.5}]
    assert _sample(design, memory, 0.1) == 1.0


def test_an_error_that_lasts_without_authority_is_no_failure() -> None:
    """After the trial authority is whole, and B has followed F, four times at most."""
    design, memory = _guard()
    for _ in range(20 * LAG + 1):
        authority = _sample(design, memory, 3.5)
    assert authority == 1.0
    assert memory.trial[0].outside == pytest.approx(3.5)
    assert memory.trial[0].wait == 0.0


def test_a_load_that_jumps_after_a_calm_is_no_reason_for_a_trial() -> None:
    """q² that earlier corrections are too small to have caused raises B at once."""
    design, memory = _guard()
    memory.sample[0].own_peak = memory.trial[0].own = memory.trial[0].own_lately = 0.1
    for k in range(3 * LAG):
        memory.sample[0].own_peak = 1e3  # the learner answers in the same sample
        assert _sample(design, memory, 1e6 if k < LAG else 1e3) == 1.0
    assert memory.trial[0].outside > 0.5e6


def test_growth_as_quick_as_a_jump_is_suspect_where_it_lasts() -> None:
    """|q| of ten times earlier corrections is a load for 8 lags; if it lasts longer, authority is on trial."""
    design, memory = _guard()
    seen = []
    for _ in range(9 * LAG):
        # The learner's corrections grow with q, so that those of before are always too small.
        memory.sample[0].own_peak = memory.trial[0].own = memory.trial[0].own_lately = 1.0
        seen.append(_sample(design, memory, 1e2))
    assert seen[: 8 * LAG] == [1.0] * (8 * LAG)
    assert seen[8 * LAG] == 0.0
    assert memory.trial[0].outside == pytest.approx(1e2)


def test_an_image_of_before_has_nothing_against_a_learner() -> None:
    """A B_s of zero is one that is not known: no trial begins by it."""
    design, memory = _guard()
    memory.trial[0].outside, memory.suspect[0].outside = 1e2, 0.0
    assert [_sample(design, memory, 1e2) for _ in range(30 * LAG)] == [1.0] * (30 * LAG)


@pytest.mark.parametrize("axes", [(), ("shoulder", "elbow")])
def test_a_run_says_where_trials_failed_and_what_to_do(axes: tuple[str, ...]) -> None:
    """Its message has the share of the samples, for each axis, and names b0; one without has none."""
    names = [f"{axis}.reason" for axis in axes] or ["reason"]
    log = np.zeros((40, len(names)))
    record = ql.Trajectory(log, tuple((name, 1) for name in names), 0.1, axis_names=axes)
    assert record.message == "No step reported a problem."
    log[:10, -1] = ql.Reason.FAILED
    where = f"{axes[-1]}: " if axes else ""
    assert record.message == f"{where}25 % of the samples: {ql.Reason.FAILED.message}"
    assert "quell b0" in record.message


def test_an_analysis_says_that_b0_is_too_small_to_learn_with() -> None:
    """Beyond b/b0 = 2 a learner explains what it drives; of joints with an inertia between them an eigenvalue counts."""
    joint = ql.ADRC(ql.ESO.model_free(2, 1.0, 50.0, 2e-3), 10.0, learner=ql.learners.Harmonic())
    plain = ql.ADRC(joint.observer, 10.0)
    assert "NOT for learning: b/b0 is 2.1," in analyse(([2.1], [1.0, 0.0, 0.0]), joint).summary()
    assert about_learning([joint.learner], [1.9]) == []
    A, C = np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]]), np.eye(4)[[0, 2]]
    for axis, b, said in ((joint, 1.2, "B B0⁻¹ is 2.1,"), (joint, 1.0, ""), (plain, 1.2, "")):
        B = np.kron([[b, 0.9], [0.9, b]], [[0.0], [1.0]])
        remark = analyse((A, B, C), ql.Axes([axis, axis])).remark
        assert said in remark
        assert bool(said) == ("NOT for learning" in remark)


@pytest.mark.trial
@pytest.mark.parametrize("learner", ["Kalman", "RLS"])
def test_joints_that_move_each_other_are_told_from_loads(learner: str) -> None:
    """An arm in which both learners keep up a motion, without the account 26 and 70 times worse than without learner."""
    arm, shares = coupled_arms.draw(3018)
    plain = coupled_arms.errors(arm, shares, None, None, 60.0, False)
    chosen = coupled_arms.LEARNERS[learner]
    guarded = coupled_arms.errors(arm, shares, chosen, ql.Guard(), 60.0, False)
    assert np.max(guarded / plain) < 1.5
