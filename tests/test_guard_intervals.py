"""The guard's account in each m-th sample: what it sees of the samples between, and what it cannot see."""

from __future__ import annotations

import math

import numpy as np
import pytest

import quell as ql
from quell.guard import assess, limit, record_output
from quell.guard.guard import lag_between_samples
from quell.guard.kernels import CORRECTED, PARTS
from quell.learners.base import lag_memory, lag_of, lag_push
from quell.observers.eso import ESO

from .cases import cases
from .guarded_samples import bounds, decide

OBSERVER = ESO.model_free(2, b0=1.0, omega_o=10.0, dt=5e-3)  # a lag of 60 samples


@cases("options", [{}, {"form": "predictor"}])
@cases("every", [1, 2, 7])
def test_the_filter_of_each_mth_sample_is_exact_for_what_is_constant_between(
    every: int, options: dict[str, str], rng: np.random.Generator
) -> None:
    """Its output is that of the loop's filter, and so is what a certificate takes for it in each sample, whichever is the first."""
    observer = ESO.model_free(2, b0=1.0, omega_o=10.0, dt=5e-3, **options)
    each, of_some = lag_of(observer), lag_of(observer, every)
    M, g, c, d = lag_between_samples(observer, every)
    quick, slow, state = lag_memory(each, 1), lag_memory(of_some, every), np.zeros(g.size)
    shown, between = [0.0] * every, 0.0
    for _ in range(40):
        value = rng.normal()
        for i in range(every):
            assert between == pytest.approx(shown[i], abs=1e-12)
            exact = lag_push(each, quick, 0, value)
            phi = value if i == 0 else rng.normal()
            shown[i] = lag_push(of_some, slow, i, phi)
            between, state = c @ state + d * phi, M @ state + g * phi
        assert shown[0] == pytest.approx(exact, abs=1e-12)


def _run(design: object, memory: object, f: np.ndarray, g: np.ndarray) -> None:
    """Samples in which f_plain is what the observer shows of f, and the learner's output is g."""
    every, chain = int(design.every), lag_memory(design.lag, 2)
    f_plain = f_shown = 0.0
    for k, (disturbance, output) in enumerate(zip(f, g, strict=True)):
        f_learned, _, _ = limit(design, memory, f_plain, f_shown, output, 0.0, 0.0)
        record_output(design, memory, f_learned)
        if k % every == every - 1:
            f_plain = lag_push(design.lag, chain, 0, disturbance)
            f_shown = lag_push(design.lag, chain, 1, f_learned)
        assess(design, memory, f_plain)


def test_the_account_is_that_of_a_loop_with_longer_samples() -> None:
    """With f and g constant over m samples averages, credits and P are those of a guard that has one of m, until authority begins."""
    rng = np.random.default_rng(5)
    every, blocks = 8, 120
    f = np.sin(0.15 * np.arange(blocks)) + 0.1 * rng.normal(size=blocks)
    g = -f + 0.3 * rng.normal(size=blocks)
    found = []
    for repeated in (every, 1):
        guard = ql.Guard(every=every)
        design, memory = guard.design(OBSERVER), guard.memory(guard.design(OBSERVER))
        if repeated == 1:
            counts = {name: getattr(design, name) / every for name in ("settling", "taking_back")}
            design = design._replace(every=1.0, spread=False, **counts)
        _run(design, memory, np.repeat(f, repeated), np.repeat(g, repeated))
        for _ in range(0 if repeated == 1 else PARTS):  # the last account comes to its end
            assess(design, memory, 0.0)
        sample = memory.sample[0]
        assert sample.authority == 0.0
        values = (sample.credit, sample.credit_at_y, sample.peak, sample.outside)
        found.append(np.append(memory.averages.view(float), values))
    np.testing.assert_allclose(*found, rtol=1e-9)


@cases("at", [0, 3, 7])
def test_what_a_learner_does_in_one_of_m_samples_is_in_the_account(at: int) -> None:
    """The mean of the corrections, and the largest, whichever sample they are in."""
    guard = ql.Guard(every=8)
    design, memory = guard.design(OBSERVER), guard.memory(guard.design(OBSERVER))
    for k in range(8):
        record_output(design, memory, 4.0 if k == at else 0.0)
        assess(design, memory, 0.0)
    assert memory.effects[CORRECTED, 0] == pytest.approx(design.respond * 0.5)
    assert memory.sample[0].own_peak == 4.0


@cases(("every", "most"), [(1, PARTS), (3, 3), (7, 1), (16, 1)])
def test_the_parts_of_the_account_take_turns(every: int, most: int) -> None:
    """No sample does more than a share of them, and each account comes to a decision before the next begins."""
    guard = ql.Guard(every=every)
    design, memory = guard.design(OBSERVER), guard.memory(guard.design(OBSERVER))
    interval, decided, before = memory.interval[0], 0, 0.0
    limit(design, memory, 0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(20 * every):
        record_output(design, memory, 0.0)
        assess(design, memory, math.sin(0.1 * k) + 1.0)
        assert (interval.part - before) % PARTS <= most or every == 1
        decided += interval.part == PARTS
        limit(design, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
        before = interval.part
    assert decided >= 19


def test_the_interval_follows_from_the_lag() -> None:
    """An eighth of a lag, or of T/15 where that is less, from 1 to 16 samples."""
    for omega_o, time, every in (
        (10.0, None, 7),
        (1.0, None, 16),
        (100.0, None, 1),
        (10.0, 1.5, 2),
    ):
        observer = ESO.model_free(2, b0=1.0, omega_o=omega_o, dt=5e-3)
        assert ql.Guard(time=time, every=None).design(observer).every == every
    assert ql.Guard(every=5).design(OBSERVER).every == 5
    with pytest.raises(ValueError, match="every = 40: must be at most 30, the samples in half"):
        ql.Guard(every=40).design(OBSERVER)


def test_a_correction_is_bounded_in_each_sample_between_two_accounts() -> None:
    """What was decided holds for each output and each u until the next decision."""
    guard = ql.Guard(every=8)
    design, memory = guard.design(OBSERVER), guard.memory(guard.design(OBSERVER))
    sample, averages = memory.sample[0], memory.averages[0]
    sample.credit = sample.share = 1.0
    sample.typical_error = sample.peak = sample.outside = 1.0
    averages.missed, averages.gained = 1.0, 0.5
    averages.newest_error = averages.newest_left = 1.0
    decide(design, memory, 1.0, 0.0, 0.0, 0.0, 0.0)
    assert bounds(design, memory) == pytest.approx((-1.2, 1.2))
    for output in (0.3, 40.0, -40.0, 1.1, 90.0):
        found = limit(design, memory, 1.0, 0.0, output, 0.0, 0.0)[0]
        assert abs(found) <= 1.2


@cases("shape", [1, 2])
def test_what_m_hides_is_bounded(shape: int) -> None:
    """Corrections of any sign in the samples between move ℓ e_L by at most ω_c m dt κe/2 more than the account says."""
    every, rate, rng = 16, 0.004, np.random.default_rng(shape)
    pushes = {1: np.where(np.arange(every) < every // 2, 1.0, -1.0), 2: None}[shape]
    each = mean = worst = 0.0
    slow = -math.expm1(every * math.log1p(-rate))
    for _ in range(2000):
        block = pushes if pushes is not None else rng.choice([-1.0, 1.0], every)
        for e_L in block:
            each += rate * (e_L - each)
        mean += slow * (np.mean(block) - mean)
        worst = max(worst, abs(each - mean))
    omega_c_dt = -math.log1p(-rate)
    assert worst <= omega_c_dt * every / 2.0
    assert shape == 2 or worst > 0.4 * omega_c_dt * every / 2.0
