"""When a learner has to start again: hostile samples, and what is only large, at rest or decaying."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.base import control
from quell.learners.base import (
    LearnerWatch,
    does_harm,
    has_escaped,
    has_lost_range,
    is_excessive,
    is_in_proportion,
    window_samples,
)

from .benchmark_module import BENCHMARKS, benchmark

WINDOW = 20


def verdicts(
    y: Callable[[int], float],
    f: Callable[[int], float],
    output: Callable[[int], float] = lambda k: 0.0,
    excess: Callable[[int], float] = lambda k: 1.0,
    limited: Callable[[int], bool] = lambda k: False,
    samples: int = 200,
) -> list[int]:
    """Return the samples at which a learner that saw these has lost its range."""
    watch = LearnerWatch.zeros()[0]
    return [
        k
        for k in range(samples)
        if has_lost_range(watch, WINDOW, y(k), f(k), output(k), beyond(excess(k)), limited(k))
    ]


def beyond(excess: float) -> bool:
    """Whether the law asks for too much, at so many times the u that is applied."""
    return is_excessive(-2.0 * excess, 2.0, 1e-200)


def wave(k: int) -> float:
    """A motion."""
    return math.sin(0.7 * k)


def test_after_one_sample_beyond_its_range_a_learner_starts_again_once() -> None:
    """At the end of the first window that does not follow a larger one."""
    assert verdicts(wave, lambda k: 1e13 if k == 30 else wave(k)) == [79]
    assert verdicts(wave, lambda k: -1e13 if k == 30 else wave(k)) == [79]
    assert verdicts(wave, lambda k: 1e12 if k == 30 else wave(k)) == []  # 2⁴⁰ is 1.1e12


def test_a_loop_at_rest_forgets_nothing() -> None:
    """Neither where f is rounding, nor where all decays to zero; a motion of 1e-7 of y counts."""

    def at_rest(move: float) -> list[int]:
        return verdicts(
            lambda k: 1.0 + move * wave(k), lambda k: 1e13 if k == 0 else wave(k), samples=100
        )

    assert at_rest(1e-16) == []
    assert at_rest(2e-9) == []
    assert at_rest(1e-7) == [59]
    decay = 0.5 ** (1.0 / 15.0)  # a half in less than a window
    assert verdicts(lambda k: decay**k, lambda k: decay**k, samples=2000) == []


def test_a_learner_whose_output_keeps_u_at_its_limits_starts_again() -> None:
    """In most samples of a window far beyond f, while the law asks for far more than is applied."""

    def excessive(output: float, excess: float, share: int = 10) -> list[int]:
        return verdicts(
            wave,
            wave,
            lambda k: output if k % 20 >= 20 - share else 0.0,
            lambda k: excess,
            samples=40,
        )

    assert excessive(1100.0, 2000.0, 11) == [19, 39]
    assert excessive(-1100.0, 2000.0, 11) == [19, 39]
    assert excessive(1100.0, 2000.0, 10) == []
    assert excessive(900.0, 2000.0, 20) == []
    assert excessive(1100.0, 1000.0, 20) == []


def test_the_f_of_the_window_before_counts_for_the_output_too() -> None:
    """Else a quiet moment would condemn an output that fitted just before."""
    assert (
        verdicts(
            wave, lambda k: 1.0 if k < 20 else 1e-3, lambda k: 100.0, lambda k: 1e9, samples=40
        )
        == []
    )
    assert verdicts(
        wave, lambda k: 1.0 if k < 20 else 1e-3, lambda k: 100.0, lambda k: 1e9, samples=60
    ) == [59]


def test_at_the_limits_of_u_a_smaller_range_is_enough() -> None:
    """2⁻¹⁰ of the largest f, with u at its limits in most samples of the window."""

    def at_limits(shock: float, share: int) -> list[int]:
        return verdicts(
            wave,
            lambda k: shock if k == 30 else wave(k),
            limited=lambda k: k % 20 >= 20 - share,
            samples=100,
        )

    assert at_limits(1100.0, 11) == [79]
    assert at_limits(1100.0, 10) == []
    assert at_limits(1000.0, 20) == []


def test_an_output_that_grows_without_bound_is_found_in_the_sample() -> None:
    """Beyond 2⁴⁰ of all f before this window, and the law asks for 2¹⁰ of u; f now does not count."""

    def watched(peak: float) -> LearnerWatch:
        watch = LearnerWatch.zeros()[0]
        watch.peak, watch.most, watch.most_before = peak, 1e20, 1.5
        watch.samples = watch.excessive = watch.limited = 7.0
        return watch

    watch = watched(1.0)
    assert has_escaped(watch, -1.2e12, beyond(2000.0))
    assert (watch.most, watch.samples, watch.excessive, watch.limited) == (0.0, 0.0, 0.0, 0.0)
    assert (watch.peak, watch.most_before) == (1.0, 1.0)
    assert not has_escaped(watched(1.0), 1e12, beyond(2000.0))
    assert not has_escaped(watched(1.0), 1.2e12, beyond(1000.0))
    assert not has_escaped(watched(0.0), 1.2e12, beyond(2000.0))  # the first window
    assert not has_escaped(watched(1.0), 2.0**40, beyond(2000.0))
    assert not has_escaped(watched(1.0), 1.2e12, beyond(1024.0))
    assert has_escaped(watched(0.5), 1.2e12, beyond(1025.0))


def test_an_output_that_adds_to_the_disturbance_is_found() -> None:
    """In most samples of ten windows Δf̂ is more than four times the f that it is a part of."""

    def found(ratio: float, share: int, samples: int = 450) -> list[int]:
        watch = LearnerWatch.zeros()[0]
        ratios = [ratio if k % 20 >= 20 - share else 0.0 for k in range(samples)]
        return [
            k for k in range(samples) if does_harm(watch, WINDOW, -ratios[k] * wave(k), wave(k))
        ]

    assert found(4.1, 11) == [199, 399]
    assert found(4.1, 10) == []
    assert found(4.0, 20) == []
    watch = LearnerWatch.zeros()[0]
    assert not any(does_harm(watch, WINDOW, 0.0, 0.0) for _ in range(200))


@pytest.mark.parametrize(
    ("learner", "guard", "forgets"),
    [
        (ql.learners.BatchGradient(rate=0.0, batch=1), None, True),
        (ql.learners.BatchGradient(rate=0.0, batch=1), ql.Guard(), False),
        (ql.envs.Policy(), None, False),
    ],
    ids=["alone", "with a guard", "from outside"],
)
def test_a_learner_that_adds_to_the_disturbance_starts_again(
    learner: Any, guard: Any, forgets: bool
) -> None:
    """Without a jump, once, and θ is zero then; a guard sees to it, and a policy has nothing to forget."""
    observer = ql.ESO.model_free(1, 1.0, 100.0, 0.01)
    loop = ql.ADRC(observer, 10.0, learner=learner, guard=guard)
    memory, y, lost, controls = loop._state.learner, 0.0, [], []
    for k in range(25 * window_samples(observer)):
        if k == 20:
            memory[0][-1] = 5.0  # θ of the bias, or the output of the policy
        controls.append(control(loop.parameters, loop._state, 1.0, y))
        y += 0.01 * controls[-1]
        if int(loop._state.loop[0].status) & ql.Status.OVERFLOWED:
            lost.append(k)
    assert len(lost) == forgets
    assert abs(y - 1.0) < 1e-3
    if forgets:
        assert memory.theta.tolist() == [0.0, 0.0, 0.0]
        assert max(abs(u) for u in controls[lost[0] - 1 :]) < 1e-3


def test_at_the_very_limits_nothing_is_lost() -> None:
    """Each comparison is strict; powers of two are exact."""

    def ones(k: int) -> float:
        return 1.0

    assert verdicts(wave, ones, lambda k: 1024.0, lambda k: 2000.0) == []
    assert verdicts(wave, ones, lambda k: 1025.0, lambda k: 1024.0) == []
    assert verdicts(wave, ones, lambda k: 1025.0, lambda k: 1025.0, samples=21) == [19]
    # 2⁻⁴⁰ of the largest f, and half of the f of the window before.
    for shock, found in ((2.0**40, []), (2.0**40 + 4096.0, [79])):
        assert verdicts(wave, lambda k, shock=shock: shock if k == 30 else 1.0, samples=99) == found
    for later, found in ((0.5, [59]), (0.499, [79])):
        jump = {0: 2.0**41}

        def fading(k: int, later: float = later, jump: dict[int, float] = jump) -> float:
            return jump.get(k, 1.0 if k < 40 else later)

        assert verdicts(wave, fading, samples=80)[-1:] == found
    # y moves by 1e-8 of its size, or by a little more.
    for step, found in ((1.0, []), (1.25, [59])):
        assert (
            verdicts(
                lambda k, step=step: 1e8 - step * (k % 2),
                lambda k: 1e13 if k == 0 else 1.0,
                samples=60,
            )
            == found
        )


def test_coefficients_that_overflow_are_forgotten() -> None:
    """They are finite: kept, they would overflow again in each sample."""
    observer = ql.ESO.model_free(2, 1.0, 20.0, 0.01)
    loop = ql.ADRC(observer, 3.0, learner=ql.learners.NLMS(), u_min=-5.0, u_max=5.0)
    flags = []
    with np.errstate(all="ignore"):
        for k in range(240):
            if k == 200:
                loop._state.learner.theta[0] = loop._state.learner.scale[3] = 1e300
            control(loop.parameters, loop._state, wave(k), 0.5 * wave(k - 1))  # interpreted
            flags.append(bool(int(loop._state.loop[0].status) & ql.Status.OVERFLOWED))
    assert np.flatnonzero(flags).tolist() == [200]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_none_does_not_blind_the_watch(bad: float) -> None:
    """Nor does it hold up the verdict on what comes later."""
    found = verdicts(wave, lambda k: bad if k == 30 else 1e13 if k == 110 else wave(k))
    assert found[-1] == 159


def test_a_window_is_ten_lags_of_the_observer() -> None:
    """At least a sample; an output is in proportion up to 2¹⁰ of the f of the last window."""
    assert window_samples(ql.ESO.model_free(2, 1.0, 20.0, 0.01)) == 150
    assert window_samples(ql.ESO.model_free(1, 1.0, 1e4, 0.01)) == 1
    watch = LearnerWatch.zeros()[0]
    watch.most_before = 2.0
    assert is_in_proportion(watch, -2048.0)
    assert not is_in_proportion(watch, 2049.0)


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The script of the full trial, as a module."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    return benchmark("hostile_steps")


@pytest.mark.trial
@pytest.mark.parametrize("name", ["NLMS", "Kalman, guarded", "order 1", "PID"])
def test_after_hostile_samples_a_loop_settles_as_a_new_one_does(name: str, trial: Any) -> None:
    """U is a number within its limits all the time; see benchmarks/hostile_steps.py for the rest."""
    make, plant = trial.configurations()[name]
    with np.errstate(all="ignore"):
        rounds = trial.Trial(make, plant, interpret=True, hostile=400, good=1500).rounds(seed=3)
        for _ in range(2):
            bad, error = next(rounds)
            assert bad == 0
            assert error <= 1.0
