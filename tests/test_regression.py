"""Learners that are linear in θ: their rules against closed forms, their scales, their gain."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.features import RBF, Bias, Friction, Input, Polynomial, State
from quell.learners.base import adapt, coefficients, commit, predict, restart
from quell.learners.regression import NlmsRule, keep_within, reset_uncertainty, update_theta
from quell.learners.rls import (
    RelearningLoop,
    RelearningMemory,
    RlsMemory,
    RlsRule,
    SelectionRule,
    relearning_rule,
    selection_memory,
)

from .cases import cases

OBSERVER = ql.ESO.model_free(order=2, b0=1.5, omega_o=20.0, dt=5e-3)


def rls(
    size: int, noise: float = 2.0, forget: float = 0.0, prior: float = 9.0
) -> tuple[RlsRule, RlsMemory]:
    """A rule and its state."""
    return RlsRule(noise, forget, prior), RlsMemory(prior * np.eye(size), np.zeros(size))


def taught(rule: Any, memory: Any, features: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """θ after all pairs."""
    theta = np.zeros(features.shape[1])
    for row, target in zip(features, targets, strict=True):
        update_theta(rule, memory, theta, row, target - theta @ row, 1.0)
    return theta


def test_rls_without_forgetting_is_ridge_regression(rng: np.random.Generator) -> None:
    """θ = (I/prior + ΦᵀΦ/R)⁻¹ Φᵀy/R, and P is the inverse."""
    features, targets = rng.normal(size=(200, 4)), rng.normal(size=200)
    rule, memory = rls(4)
    theta = taught(rule, memory, features, targets)
    information = np.eye(4) / rule.prior + features.T @ features / rule.noise
    np.testing.assert_allclose(
        theta, np.linalg.solve(information, features.T @ targets / rule.noise), atol=1e-11
    )
    np.testing.assert_allclose(memory.covariance, np.linalg.inv(information), atol=1e-11)


@pytest.mark.parametrize("kind", ["rls", "selection", "relearning"])
def test_a_coefficient_at_its_limit_is_that_of_ridge_regression_with_this_limit(
    kind: str, rng: np.random.Generator
) -> None:
    """The others are then those of the regression in which it is known, of all active features."""
    features, targets = rng.normal(size=(200, 4)), rng.normal(size=200)
    features[:, 1] += features[:, 3]
    inner, inner_memory = rls(4)
    rule, memory, active = inner, inner_memory, [0, 1, 2, 3]
    if kind == "selection":
        rule, active = SelectionRule(inner, 0.0, 10**6), [0, 1, 3]
        memory = selection_memory(rule, 3, 4)
        memory.active[:] = active
        memory.inactive[:] = 0.0, 0.0, 1.0, 0.0
    elif kind == "relearning":
        rule = relearning_rule(inner, 1e9, dt=0.1, lag_time=2.0, omega_c=50.0)
        memory = RelearningMemory(inner_memory, RelearningLoop.zeros())
    theta = taught(rule, memory, features, targets)
    keep_within(rule, memory, theta, 3, theta[3] - 1.0, theta[3] + 1.0)
    np.testing.assert_array_equal(theta, free := theta.copy())
    keep_within(rule, memory, theta, 3, free[3] + 0.3, free[3] + 0.8)
    assert theta[3] == free[3] + 0.3
    rest = active[:-1]
    Phi, known = features[:, rest], targets - theta[3] * features[:, 3]
    information = np.eye(len(rest)) / inner.prior + Phi.T @ Phi / inner.noise
    expected = np.linalg.solve(information, Phi.T @ known / inner.noise)
    np.testing.assert_allclose(theta[rest], expected, atol=1e-11)
    if kind == "selection":  # an inactive coefficient moves alone
        keep_within(rule, memory, theta, 2, 5.0, 6.0)
        assert theta[2] == 5.0
        np.testing.assert_allclose(theta[rest], expected, atol=1e-11)


def test_a_coefficient_without_a_covariance_is_cut_off_alone() -> None:
    """``NLMS`` has none, and RLS can have lost it by rounding."""
    for rule, memory in ((NlmsRule(1.0, 1e-2), np.zeros(0)), rls(2)):
        if isinstance(memory, RlsMemory):
            memory.covariance[:] = -np.eye(2)
        theta = np.array([0.5, 2.0])
        keep_within(rule, memory, theta, 1, -1.0, 1.5)
        assert theta.tolist() == [0.5, 1.5]


def test_rls_learns_less_from_what_is_less_sure(rng: np.random.Generator) -> None:
    """A confidence c is the noise R/c: ridge regression with these weights; for ``NLMS`` a step c."""
    features, targets = rng.normal(size=(60, 3)), rng.normal(size=60)
    sure = rng.uniform(0.1, 1.0, 60)
    rule, memory = rls(3)
    theta, slow = np.zeros(3), np.zeros(3)
    for row, target, share in zip(features, targets, sure, strict=True):
        update_theta(rule, memory, theta, row, target - theta @ row, share)
    weights = sure / rule.noise
    information = np.eye(3) / rule.prior + features.T * weights @ features
    expected = np.linalg.solve(information, features.T @ (weights * targets))
    np.testing.assert_allclose(theta, expected, atol=1e-11)
    update_theta(NlmsRule(0.5, 0.0), np.zeros(0), slow, features[0], 2.0, 0.3)
    np.testing.assert_allclose(slow @ features[0], 0.5 * 0.3 * 2.0, rtol=1e-12)


def test_the_rules_take_their_times_from_the_controllers_bandwidth() -> None:
    """``RLS`` remembers 100/omega_c, its noise is correlated over the observer's lag; ``NLMS`` learns at omega_c."""
    rule = ql.learners.RLS().rule(OBSERVER, 4.0, 3)
    assert -math.log1p(-rule.forget) == pytest.approx(5e-3 * 4.0 / 100.0, rel=1e-9)
    assert rule.noise == pytest.approx(3 / 20.0 / 5e-3, rel=1e-12)
    assert rule.prior == 100.0
    assert ql.learners.RLS(memory_time=2.0).rule(OBSERVER, 4.0, 3).forget == pytest.approx(
        -math.expm1(-5e-3 / 2.0), rel=1e-12
    )
    assert ql.learners.NLMS().rule(OBSERVER, 4.0, 3).gain == pytest.approx(5e-3 * 4.0, rel=1e-12)


@pytest.mark.trial
def test_the_strongest_features_are_found_and_the_others_have_no_coefficient() -> None:
    """Four of 60 waves in position, at a speed that changes; later one is gone and one is new."""
    rule = SelectionRule(RlsRule(2.0, 1e-2, 9.0), 0.1, 50)
    theta, memory = np.zeros(60), selection_memory(rule, 6, 60)
    angle = np.cumsum(0.01 + 0.005 * np.sin(np.arange(12_000) / 3000.0))
    orders = np.arange(1, 31)
    for k, position in enumerate(angle):
        features = np.concatenate([np.sin(orders * position), np.cos(orders * position)])
        target = 0.9 * features[6] - 0.5 * features[27] + 0.3 * features[35]
        target += 0.4 * (features[50] if k < 6000 else features[11])
        update_theta(rule, memory, theta, features, target - theta @ features, 1.0)
        if k in (5999, 11_999):
            last = 50 if k < 6000 else 11
            expected = np.zeros(60)
            expected[[6, 27, 35, last]] = 0.9, -0.5, 0.3, 0.4
            np.testing.assert_allclose(theta, expected, atol=0.02)
            assert np.count_nonzero(theta) <= 6
            assert {6.0, 27.0, 35.0, float(last)} <= set(memory.active.tolist())
    reset_uncertainty(rule, memory)
    np.testing.assert_array_equal(memory.covariance, 9.0 * np.eye(6))
    assert not np.any(memory.weak)


def test_what_has_changed_abruptly_is_learned_again_at_once(rng: np.random.Generator) -> None:
    """After the change the error is gone in as few samples as at the start; noise restarts nothing."""
    left = {}
    for relearn in (False, True):
        inner, memory = rls(8, noise=2.0, forget=1e-4)
        rule: Any = inner
        if relearn:
            rule = relearning_rule(inner, 4.0, dt=1.0, lag_time=2.0, omega_c=2.0)
            state: Any = RelearningMemory(memory, RelearningLoop.zeros())
        theta, truth, starts = np.zeros(8), rng.normal(size=8), 0
        for k in range(1500):
            features = rng.normal(size=8)
            if k == 1000:
                truth = -truth
            before = memory.covariance[0, 0]
            error = (truth - theta) @ features + 0.05 * rng.normal()
            update_theta(rule, state if relearn else memory, theta, features, error, 1.0)
            starts += k > 50 and memory.covariance[0, 0] > 10.0 * before
            if k == 1150:
                left[relearn] = float(np.linalg.norm(theta - truth) / np.linalg.norm(truth))
        assert starts == relearn
    assert left[True] < 0.1 < 0.5 < left[False]
    with pytest.raises(ValueError, match="relearn = 1.0: must be greater than 1"):
        ql.learners.RLS(relearn=1.0)
    rule = ql.learners.RLS(strongest=2, relearn=3.0).rule(OBSERVER, 4.0, 5)
    memory = ql.learners.RLS(strongest=2, relearn=3.0).rule_memory(rule, 5)
    memory.inner.weak[:] = memory.loop[0].usual = 1.0
    reset_uncertainty(rule, memory)
    assert not np.any(memory.inner.weak)
    assert memory.loop[0].usual == 0.0


def test_a_change_is_judged_by_mean_squares_over_two_times() -> None:
    """Five lags of the observer; the usual one follows a larger one in 50 lags, else in 1000/omega_c."""
    rule = relearning_rule(NlmsRule(1.0, 1e-2), 4.0, dt=0.1, lag_time=2.0, omega_c=50.0)
    assert rule[1:] == pytest.approx(
        (16.0, -math.expm1(-0.01), -math.expm1(-0.001), -math.expm1(-0.005)), rel=1e-12
    )
    memory, short, usual = RelearningMemory(np.zeros(0), RelearningLoop.zeros()), 0.0, 0.0
    for error in (3.0, -4.0, 0.0, 0.0, 0.0, 0.0):
        update_theta(rule, memory, np.zeros(1), np.ones(1), error, 1.0)
        short += rule.short * (error * error - short)
        usual += (rule.rise if short > usual else rule.decay) * (short - usual)
        assert memory.loop[0].tolist() == pytest.approx((short, usual), rel=1e-12)
    memory.loop[0].error, memory.loop[0].usual = 0.0, 1.0
    update_theta(rule, memory, np.zeros(1), np.ones(1), 0.5, 1.0)
    assert memory.loop[0].usual == pytest.approx(1.0 - rule.decay * (1.0 - 0.25 * rule.short))
    inner, state = rls(1)
    relearning = relearning_rule(inner, 4.0, dt=0.1, lag_time=2.0, omega_c=50.0)
    memory = RelearningMemory(state, RelearningLoop.zeros())
    for error in (0.0, 1.0):  # the first error is no change
        update_theta(relearning, memory, np.zeros(1), np.ones(1), error, 1.0)
    assert state.covariance[0, 0] == pytest.approx(1.0 / (1.0 / 9.0 + 1.0))


def test_a_selection_of_all_features_is_refused() -> None:
    """``strongest`` that is not below the number of features would change nothing."""
    for strongest in (3, 50):
        with pytest.raises(ValueError, match=f"strongest = {strongest}: has no effect, as there"):
            ql.learners.RLS(strongest=strongest).rule(OBSERVER, 4.0, 3)
    assert isinstance(ql.learners.RLS(strongest=2).rule(OBSERVER, 4.0, 3), SelectionRule)
    with pytest.raises(ValueError, match="strongest = 0: must be a whole number of at least 1"):
        ql.learners.RLS(strongest=0)


def test_rls_forgets_along_what_it_sees_and_nowhere_else() -> None:
    """After a sample the uncertainty along φ is ζ/(λ(1+ζ)); across, nothing has changed."""
    rule, memory = rls(2, forget=0.01)
    direction, across = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    for _ in range(5):
        before = direction @ memory.covariance @ direction / rule.noise
        update_theta(rule, memory, np.zeros(2), direction, 0.0, 1.0)
        after = direction @ memory.covariance @ direction / rule.noise
        assert after == pytest.approx(before / (0.99 * (1.0 + before)), rel=1e-12)
        assert across @ memory.covariance @ across == pytest.approx(9.0, rel=1e-12)
    for _ in range(5000):
        update_theta(rule, memory, np.zeros(2), direction, 0.0, 1.0)
    assert direction @ memory.covariance @ direction / rule.noise == pytest.approx(
        0.01 / 0.99, rel=1e-6
    )


def test_the_uncertainty_of_rls_does_not_grow_beyond_that_of_the_prior() -> None:
    """Forgetting along a feature ends where the trace is that of the prior, and not before."""
    rule, memory = rls(2, forget=0.01)
    small = np.array([1e-3, 0.0])
    update_theta(rule, memory, np.zeros(2), small, 0.0, 1.0)
    np.testing.assert_array_equal(memory.covariance, 9.0 * np.eye(2))
    update_theta(rule, memory, np.zeros(2), np.array([0.0, 2.0]), 0.0, 1.0)
    update_theta(rule, memory, np.zeros(2), small, 0.0, 1.0)
    assert memory.covariance[0, 0] == pytest.approx(9.0 / 0.99, rel=1e-4)


@cases("covariance", [-9.0, -0.01, 0.0, 1e100, math.nan])
def test_rls_learns_nothing_with_what_is_no_covariance(covariance: float) -> None:
    """θ and P stay as they are; without features, too."""
    rule, memory = rls(2, forget=0.01)
    theta = np.array([0.5, -0.25])
    update_theta(rule, memory, theta, np.zeros(2), 3.0, 1.0)
    np.testing.assert_array_equal(memory.covariance, 9.0 * np.eye(2))
    memory.covariance[:] = before = covariance * np.eye(2)
    update_theta(rule, memory, theta, np.array([1.0, 2.0]), 3.0, 1.0)
    np.testing.assert_array_equal(memory.covariance, before)
    assert theta.tolist() == [0.5, -0.25]


def test_rls_follows_what_drifts_in_its_memory_time(rng: np.random.Generator) -> None:
    """A step of a coefficient is learned with the time constant 1/forget samples."""
    rule, memory = rls(1, forget=0.01)
    theta = np.zeros(1)
    for _ in range(2000):
        update_theta(rule, memory, theta, np.ones(1), -theta[0], 1.0)
    for _ in range(100):
        update_theta(rule, memory, theta, np.ones(1), 1.0 - theta[0], 1.0)
    assert theta[0] == pytest.approx(1.0 - math.exp(-1.0), abs=0.01)


def test_the_uncertainty_of_rls_is_bounded_without_excitation(rng: np.random.Generator) -> None:
    """However small or alike the features are, P stays a covariance, no larger than the prior in all."""
    rule, memory = rls(3, forget=0.01)
    theta = np.zeros(3)
    for k in range(6_000):
        features = np.ones(3) + (1e-3 if k % 2 else 1e-6) * rng.normal(size=3)
        update_theta(rule, memory, theta, features * (1e-4 if k % 3 else 1.0), rng.normal(), 1.0)
    assert np.trace(memory.covariance) <= 3 * rule.prior * (1.0 + 1e-9)
    assert np.min(np.linalg.eigvalsh(memory.covariance)) > 0.0
    assert np.all(np.abs(theta) < 1e3)


def test_nlms_projects_on_what_it_sees(rng: np.random.Generator) -> None:
    """With the step 1 and no regularisation the new θ explains the sample, and is the nearest that does (Haykin, section 7.1)."""
    features, theta = rng.normal(size=5), rng.normal(size=5)
    before = theta.copy()
    update_theta(NlmsRule(1.0, 0.0), np.zeros(0), theta, features, 2.0 - theta @ features, 1.0)
    assert theta @ features == pytest.approx(2.0, rel=1e-12)
    np.testing.assert_allclose(
        theta - before, features * ((theta - before) @ features) / (features @ features), atol=1e-12
    )


def test_nlms_learns_at_its_rate_whatever_the_sample_time() -> None:
    """Where the features stay, an error decays as exp(−rate t), and their size does not matter."""
    for dt, size in ((1e-3, 1.0), (1e-2, 30.0)):
        observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=dt)
        rule = ql.learners.NLMS(rate=2.0, regularisation=1e-6).rule(observer, 1.0, 2)
        count = round(0.5 / dt)
        theta = taught(rule, np.zeros(0), np.full((count, 2), size), np.ones(count))
        assert 1.0 - theta @ [size, size] == pytest.approx(math.exp(-1.0), rel=0.02)


def loop(
    learner: Any, duration: float = 9.0, unit: float = 1.0
) -> tuple[ql.Trajectory, dict[str, float]]:
    """A run with a mass on a spring that stiffens, with friction and a weight: f = −2 y − 0.5 y³ − tanh(y'/0.3) + 0.7, b = 1.5."""

    def mass(t: float, x: np.ndarray, u: float, w: np.ndarray) -> tuple[float, float]:
        y, v = x[0] / unit, x[1] / unit
        return x[1], 1.5 * u + unit * (-2.0 * y - 0.5 * y**3 - np.tanh(v / 0.3) + 0.7)

    s = ql.signals
    plant = ql.plants.NonlinearPlant(mass, order=2)
    reference = unit * (s.Sinusoid(0.8) + s.Sinusoid(0.5, omega=2.3))
    controller = ql.ADRC(OBSERVER, omega_c=4.0, learner=learner)
    run = ql.simulate(
        plant,
        controller,
        ql.Scenario(reference, duration, noise=s.BandLimitedNoise(1e-12 * unit**2, 0.01)),
        limit=1e12,
    )
    return run, controller.read(run.final_state).theta


@pytest.mark.trial
@pytest.mark.parametrize("unit", [2.0**-17, 2.0**17])  # scales are powers of two
def test_coefficients_are_in_the_plants_units(unit: float) -> None:
    """What is learned is the plant, whatever the unit of y."""
    _, theta = loop(
        ql.learners.RLS(
            State() + Polynomial(3, states=(1,)) + Friction(width=0.15) + Bias(), frequency=1.0
        ),
        unit=unit,
    )
    assert theta["x1"] == pytest.approx(-2.0, abs=0.15)
    assert theta["x1^3"] * unit**2 == pytest.approx(-0.5, abs=0.1)
    assert theta["tanh(x2/0.15)"] / unit == pytest.approx(-1.0, abs=0.15)
    assert theta["bias"] / unit == pytest.approx(0.7, abs=0.05)


@pytest.mark.trial
@pytest.mark.parametrize("make", [ql.learners.RLS, ql.learners.NLMS])
def test_the_effective_gain_stays_in_its_interval(make: Any, rng: np.random.Generator) -> None:
    """Whatever the data say, for either sign of b0."""
    for b0 in (2.0, -2.0):
        learner = make(features=State() + Bias() + Input(), gain_interval=(0.4, 1.5))
        design = learner.design(ql.ESO.model_free(order=2, b0=b0, omega_o=10.0, dt=1e-2), 1.0)
        memory = learner.memory(design)
        for k in range(2500):
            seen, u = 10.0 * rng.normal(size=3), math.sin(0.01 * k)
            adapt(design, memory, seen, seen[0] + 1e-9, u, -5.0 * b0 * u)
            slope = predict(design, memory, seen, u)[1]
            assert 0.4 - 1e-12 <= (b0 + slope) / b0 <= 1.5 + 1e-12
            commit(design, memory, seen, u, 0.0)
        assert (b0 + slope) / b0 < 0.6


@pytest.mark.trial
def test_a_wrong_gain_is_found() -> None:
    """With u among the features and enough excitation, b0 + θ_u is the plant's gain."""
    s = ql.signals
    excitation = s.Chirp(omega_start=0.2, omega_end=3.0, duration=15.0) + 0.5 * s.Sinusoid(
        omega=1.7
    )
    plant = ql.plants.LinearPlant([[0.0, 1.0], [-3.0, -0.5]], [0.0, 2.0], [1.0, 0.0])
    learner = ql.learners.RLS(State() + Bias() + Input(), gain_interval=(0.3, 3.0))
    controller = ql.ADRC(
        ql.ESO.model_free(order=2, b0=1.2, omega_o=20.0, dt=1e-2), omega_c=4.0, learner=learner
    )
    run = ql.simulate(
        plant,
        controller,
        ql.Scenario(excitation, 15.0, noise=s.BandLimitedNoise(1e-12, 0.01)),
        interpret=True,  # compiled, a learner with u among its features runs in the contracts
    )
    assert 1.2 + controller.read(run.final_state).theta["u"] == pytest.approx(2.0, rel=0.05)


def test_a_scale_that_grows_changes_no_prediction(rng: np.random.Generator) -> None:
    """For features that are products, θ and filters are converted exactly."""
    learner = ql.learners.NLMS(features=State() + Polynomial(3) + Bias() + Input())
    design = learner.design(OBSERVER, 1.0)
    memory = learner.memory(design)
    for _ in range(400):
        seen, u = rng.uniform(-1.0, 1.0, 3), rng.uniform(-1.0, 1.0)
        adapt(design, memory, seen, seen[0] + 1e-9, u, seen[0] + seen[1] ** 2 + 0.3)
        commit(design, memory, seen, u, 0.0)
    before, theta = predict(design, memory, np.array([0.3, -0.4, 0.0]), 0.2), np.zeros(10)
    coefficients(design, memory, theta)
    shown, scale = memory.filtered / memory.units, memory.scale.copy()
    design = design._replace(rule=NlmsRule(0.0, 1.0), inputs=design.inputs._replace(bias_gain=0.0))
    adapt(design, memory, np.array([50.0, 900.0, 0.0]), 50.0, 70.0, 300.0)
    assert np.all(memory.scale > 8.0 * scale)
    again = np.zeros(10)
    coefficients(design, memory, again)
    np.testing.assert_allclose(again, theta, rtol=1e-12)
    np.testing.assert_allclose(memory.filtered / memory.units, shown, rtol=1e-12)
    np.testing.assert_allclose(
        predict(design, memory, np.array([0.3, -0.4, 0.0]), 0.2), before, rtol=1e-12
    )


def test_a_learner_that_left_the_range_of_numbers_begins_anew() -> None:
    """Restarting keeps what was learned, but not where it is no number."""
    learner = ql.learners.RLS()
    design = learner.design(OBSERVER, 1.0)
    memory = learner.memory(design)
    memory.theta[:], memory.filtered[:], memory.rule.covariance[0, 0] = 0.25, 1.0, 3.0
    loop, memory.chain[:], memory.gate.mean[:], memory.gate.noise[:] = memory.loop[0], 2.0, 3.0, 4.0
    loop.samples, loop.bias, loop.learn_after, loop.has_scale = 9.0, 5.0, 12.0, 1.0
    restart(design, memory)
    assert (loop.samples, loop.bias, loop.learn_after, loop.has_scale) == (0.0, 0.0, 0.0, 1.0)
    for filters in (memory.chain, *memory.gate):
        assert not np.any(filters)
    assert np.all(memory.theta == 0.25)
    assert np.all(memory.filtered == 0.0)
    assert memory.rule.covariance[0, 0] == 3.0
    memory.theta[1] = math.nan
    restart(design, memory)
    np.testing.assert_array_equal(memory.theta, np.zeros(3))
    np.testing.assert_array_equal(memory.rule.covariance, learner.memory(design).rule.covariance)
    reset_uncertainty(NlmsRule(1.0, 1.0), np.zeros(0))


@cases(
    ("make", "message"),
    [
        (lambda: ql.learners.NLMS(rate=0.0), "rate = 0.0: must be finite and greater than zero"),
        (
            lambda: ql.learners.NLMS(regularisation=0.0),
            "regularisation = 0.0: must be finite and greater than zero",
        ),
        (
            lambda: ql.learners.NLMS(features="x1"),
            "features = 'x1': must be made of blocks from quell.features",
        ),
        (
            lambda: ql.learners.RLS(memory_time=-1.0),
            "memory_time = -1.0: must be greater than zero",
        ),
        (
            lambda: ql.learners.RLS(prior=math.inf),
            "prior = inf: must be finite and greater than zero",
        ),
        (lambda: ql.learners.RLS(scale=[1.0, 0.0]), r"scale = \[1.0, 0.0\]: must be positive"),
        (
            lambda: ql.learners.RLS(scale=[1.0, 2.0]).design(OBSERVER, 1.0),
            r"scale has shape \(2,\): must be a vector of 4",
        ),
        (
            lambda: ql.learners.RLS(gain_interval=(1.2, 2.0)),
            r"gain_interval = \(1.2, 2.0\): must be \(low, high\) with 0 < low <= 1",
        ),
        (
            lambda: ql.learners.RLS(RBF(states=(4,))).design(OBSERVER, 1.0),
            r"states = \(4,\): a plant of order 2 has no state 4",
        ),
    ],
)
def test_a_mistake_is_named(make: Any, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        make()


@cases(
    ("make", "message"),
    [
        (lambda: ql.learners.Kalman(bias=False, bias_bandwidth=1.0), "bias_bandwidth = 1.0: has"),
        (
            lambda: ql.learners.Kalman(state=False, state_bandwidth=0.5),
            "state_bandwidth = 0.5: has",
        ),
        (lambda: ql.learners.Kalman(state=False, prior=3.0), "prior = 3.0: has no effect"),
        (lambda: ql.learners.Kalman(state=False, frequency=3.0), "frequency = 3.0: has no effect"),
        (lambda: ql.learners.Kalman(gain_interval=(0.9, 1.1)), "with u = False; leave it out, or"),
        (
            lambda: ql.learners.Harmonic(bias=False, bias_bandwidth=1.0, pair_bandwidth=2.0),
            "bias_bandwidth = 1.0: has no effect",
        ),
        (lambda: ql.learners.RLS(gain_interval=(0.9, 1.1)), "or add Input() to features"),
        (lambda: ql.learners.NLMS(gain_interval=(0.9, 1.1)), "or add Input() to features"),
    ],
)
def test_options_of_features_that_are_not_there_are_refused(make: Any, message: str) -> None:
    """With what to do; the sinusoids of Harmonic take their bandwidth from that of the bias."""
    with pytest.raises(ValueError, match=re.escape(message)):
        make()
    ql.learners.Harmonic(bias=False, bias_bandwidth=1.0)
    ql.learners.Kalman(u=True, gain_interval=(0.9, 1.1))
