"""The Kalman learner against closed forms and limit cases."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

import quell as ql
from quell.learners.base import adapt, commit, predict, restart
from quell.observers.eso import ESO

from .cases import cases

pytestmark = pytest.mark.compiled


def chain(order: int, stiffness: float) -> ql.plants.LinearPlant:
    """Return ``y⁽ⁿ⁾ = stiffness y + u + w``; of order four with the code of the two-mass plant, which has two loads."""
    A = np.diag(np.ones(order - 1), 1)
    A[-1, 0] = stiffness
    B = np.eye(order)[-1]
    E = np.column_stack([B, 0.0 * B]) if order == 4 else None
    return ql.plants.LinearPlant(A, B, np.eye(order)[0], E)


def kalman_memory(learner: ql.learners.Kalman, observer: ESO) -> tuple[object, object]:
    """Return a Kalman learner past its start, to which every feature teaches."""
    design = learner.design(observer, 1.0)
    design = design._replace(threshold=1e-9 * design.threshold)
    memory = learner.memory(design)
    memory.averages.view(float)[:] = 1.0, 1.0, 1.0, 1e9
    memory.variance[:] = 1.0
    return design._replace(forget=0.0, fastest=1e9, f_noise=0.0), memory


def test_without_a_walk_the_kalman_learner_is_ridge_regression(rng: np.random.Generator) -> None:
    """The closed form, for fixed noise R: θ = (P0⁻¹ + Σ φφᵀ dt/R)⁻¹ Σ φ y dt/R."""
    observer = ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-2)
    design, memory = kalman_memory(ql.learners.Kalman(bias=False), observer)
    memory.covariance[:] = 9.0 * np.eye(4)
    features, targets = rng.normal(size=(300, 4)), rng.normal(size=300)
    for row, target in zip(features, targets, strict=True):
        memory.filtered[:] = row
        adapt(design, memory, np.zeros(5), 1.0, 0.0, target)
    weight = observer.dt / design.lag_time  # R = τ E[ε²], with E[ε²] held at 1
    ridge = np.linalg.solve(
        np.eye(4) / 9.0 + weight * features.T @ features, weight * features.T @ targets
    )
    np.testing.assert_allclose(memory.theta, ridge, atol=1e-10)


@pytest.mark.parametrize("dt", [1e-3, 1e-2])
def test_the_bias_follows_with_its_bandwidth_whatever_the_sample_time(dt: float) -> None:
    """A step in what the bias must explain is learned with the time constant 1/λ."""
    bandwidth = 2.0
    learner = ql.learners.Kalman(state=False, bias_bandwidth=bandwidth)
    design, memory = kalman_memory(learner, ESO.model_free(order=1, b0=1.0, omega_o=50.0, dt=dt))
    memory.filtered[0] = 1.0
    for _ in range(round(10.0 / dt)):  # let P settle
        adapt(design, memory, np.zeros(2), 1.0, 0.0, 0.0)
    for _ in range(round(1.0 / bandwidth / dt)):
        adapt(design, memory, np.zeros(2), 1.0, 0.0, 1.0)
    assert memory.theta[0] == pytest.approx(1.0 - math.exp(-1.0), rel=0.02)


@pytest.mark.trial
def test_the_kalman_learner_finds_the_plant(two_mass_scenario: ql.Scenario) -> None:
    """After 20 s of sin t it knows f = −2 y'' of the benchmark, from noisy y alone, and the prior does not matter."""
    for prior in (3.0, 100.0):
        controller = ql.ADRC(
            ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=2e-3),
            omega_c=1.0,
            learner=ql.learners.Kalman(prior=prior),
        )
        run = ql.simulate(ql.plants.two_mass_spring(), controller, two_mass_scenario)
        learned = run["theta"][run.window(19.0, 20.0)][-1]
        # For y = sin t, x3 = −x1 and x4 = −x2: two sums are certain at once, the rest only through
        # the transient.
        np.testing.assert_allclose(
            [learned[2] - learned[0], learned[3] - learned[1], learned[4]],
            [-2.0, 0.0, 0.0],
            atol=0.05,
        )
        np.testing.assert_allclose(learned, [0.0, 0.0, -2.0, 0.0, 0.0], atol=0.4)


@pytest.mark.trial
def test_the_kalman_learner_finds_a_wrong_gain() -> None:
    """With u among its features and enough excitation, b0 + θ_u is the plant's gain, though b0 was half of it."""
    s = ql.signals
    excitation = s.Chirp(omega_start=0.2, omega_end=3.0, duration=30.0) + 0.5 * s.Sinusoid(
        omega=1.7
    )
    plant = ql.plants.LinearPlant([[0.0, 1.0], [-3.0, -0.5]], [0.0, 2.0], [1.0, 0.0])
    controller = ql.ADRC(
        ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=1e-2),
        omega_c=4.0,
        learner=ql.learners.Kalman(
            u=True, bias=True, bias_bandwidth=0.05, gain_interval=(0.3, 3.0)
        ),
    )
    scenario = ql.Scenario(excitation, 30.0, noise=s.BandLimitedNoise(1e-10, 0.01))
    run = ql.simulate(plant, controller, scenario, interpret=True)
    theta = controller.read(run.final_state).theta
    assert 1.0 + theta["u"] == pytest.approx(2.0, rel=0.05)
    assert theta["x1"] == pytest.approx(-3.0, rel=0.1)


def test_the_effective_gain_stays_in_its_interval(rng: np.random.Generator) -> None:
    """Whatever the data say, b0 + θ_u is kept away from zero, for either sign of b0."""
    for b0 in (2.0, -2.0):
        learner = ql.learners.Kalman(u=True, gain_interval=(0.4, 1.5))
        observer = ESO.model_free(order=2, b0=b0, omega_o=10.0, dt=1e-2)
        design = learner.design(observer, 1.0)
        memory = learner.memory(design)
        for _ in range(2000):
            seen, u = 10.0 * rng.normal(size=3), rng.normal()
            adapt(design, memory, seen, seen[0] + 1e-9, u, -5.0 * b0 * u)
            slope = predict(design, memory, seen, u)[1]
            assert 0.4 - 1e-12 <= (b0 + slope) / b0 <= 1.5 + 1e-12
            commit(design, memory, seen, u, 0.0)


@cases("b0", [2.0, -2.0])
@cases(("sign", "edge"), [(1.0, 1.5), (-1.0, 0.4)])
def test_data_that_ask_for_more_leave_the_effective_gain_at_its_edge(
    b0: float, sign: float, edge: float
) -> None:
    """The target is ±5 b0 u: θ_u ends at the limit itself, and what the clamp takes is not learned."""
    learner = ql.learners.Kalman(state=False, bias=False, u=True, gain_interval=(0.4, 1.5))
    observer = ESO.model_free(order=2, b0=b0, omega_o=10.0, dt=1e-2)
    design, memory = kalman_memory(learner, observer)
    for k in range(600):
        memory.filtered[0] = b0 * math.sin(0.1 * k)
        adapt(design, memory, np.zeros(3), 1.0, 0.0, 5.0 * sign * memory.filtered[0])
    assert memory.theta[0] == edge - 1.0
    constant, slope = predict(design, memory, np.zeros(3), 0.3)
    assert constant == 0.0
    assert (b0 + slope) / b0 == pytest.approx(edge, rel=1e-12)


@pytest.mark.trial
def test_rounding_is_not_data() -> None:
    """At rest and without noise the learner stays where it is: nothing winds up."""
    controller = ql.ADRC(
        ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-2),
        omega_c=1.0,
        learner=ql.learners.Kalman(),
    )
    scenario = ql.Scenario(reference=1.0, x0=[1.0, 1.0, 0.0, 0.0], duration=1000.0)
    run = ql.simulate(ql.plants.two_mass_spring(), controller, scenario, record_every=100)
    assert np.max(np.abs(run["theta"])) < 1e-3
    assert np.max(np.abs(run["y"] - 1.0)) < 1e-9


@pytest.mark.trial
def test_what_was_learned_is_kept_through_hours_of_rest() -> None:
    """At rest the features are noise and teach nothing: after three hours the next step is what it was."""
    s = ql.signals
    controller = ql.ADRC(
        ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=2e-2),
        omega_c=1.0,
        learner=ql.learners.Kalman(),
    )
    reference = s.Sinusoid().until(110.0, then=s.Step(at=110.0) + s.Step(at=10_000.0))
    scenario = ql.Scenario(
        reference, duration=10_040.0, noise=s.BandLimitedNoise(power=1e-12, sample_time=0.02)
    )
    run = ql.simulate(ql.plants.two_mass_spring(), controller, scenario, record_every=10)
    np.testing.assert_allclose(run["theta"][-1][:4], [0.0, 0.0, -2.0, 0.0], atol=0.1)
    assert run.metrics(10_000.0, target=2.0)["overshoot"] < 1e-3


@pytest.mark.trial
def test_at_rest_a_learner_is_as_quiet_as_no_learner() -> None:
    """Its gain does not follow the noise, which would fold the noise's high frequencies down to where the loop is sensitive."""
    plant = chain(4, -0.5)
    observer = ESO.model_free(order=4, b0=1.0, omega_o=30.0, dt=2e-3)
    scenario = ql.Scenario(1.0, duration=300.0, noise=ql.signals.BandLimitedNoise(1e-12, 0.01))
    plain, learned = (
        ql.simulate(
            plant, ql.ADRC(observer, omega_c=1.0, learner=learner), scenario, record_every=5
        )
        for learner in (None, ql.learners.Kalman())
    )
    late = plain.window(200.0, 300.0)
    assert np.std(learned["y"][late]) < 3.0 * np.std(plain["y"][late])


@pytest.mark.trial
@pytest.mark.parametrize(("order", "u"), [(2, True), (4, False), (6, False)])
def test_where_nothing_is_left_to_learn_nothing_is_learned(order: int, u: bool) -> None:
    """A chain of integrators without noise: what is left is rounding, P stays positive, the loop goes on.

    Of order 2 and 6 as Python, in fewer samples: compiled, nobody else runs that loop.
    """
    plant, python = chain(order, 0.0), order != 4
    s, half = ql.signals, 30.0 if python else 60.0
    scenario = ql.Scenario(
        s.Sinusoid().until(half, then=s.Sinusoid(omega=0.5)).until(2.0 * half, then=2.0),
        2.0 * half + 40.0,
        (s.Step(at=2.0 * half + 20.0),),
    )
    controller = ql.ADRC(
        ESO.model_free(order, 1.0, 10.0, 2e-2 if python else 5e-3),
        omega_c=1.0,
        learner=ql.learners.Kalman(u=u),
    )
    run = ql.simulate(plant, controller, scenario, interpret=python)
    assert not run.diverged
    assert np.max(np.abs(run["theta"][run.t < 2.0 * half + 20.0])) < 0.1
    covariance = run.final_state.learner.covariance
    assert np.min(np.linalg.eigvalsh(0.5 * (covariance + covariance.T))) > -1e-9 * np.max(
        np.abs(covariance)
    )


@cache
def learned_in(unit: float) -> np.ndarray:
    """Return θ of the state that is learned in 8 s, with y in this unit; as Python, as no compiled test runs that loop."""
    scenario = ql.Scenario(
        unit * ql.signals.Sinusoid(),
        8.0,
        noise=ql.signals.BandLimitedNoise(1e-12 * unit**2, 0.01),
    )
    controller = ql.ADRC(
        ESO.model_free(order=4, b0=unit, omega_o=10.0, dt=5e-3),
        omega_c=1.0,
        learner=ql.learners.Kalman(),
    )
    plant = ql.plants.two_mass_spring(c2=unit)
    return ql.simulate(plant, controller, scenario, limit=1e9, interpret=True)["theta"][-1][:4]


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_unit_of_y_does_not_matter(unit: float) -> None:
    """In micrometres or megametres the same thing is learned."""
    assert np.all(np.abs(learned_in(1.0)) > 1e-2)
    np.testing.assert_allclose(learned_in(1.0), learned_in(unit), atol=1e-4)


def test_a_load_that_comes_before_anything_was_learned_is_taken_by_the_bias() -> None:
    """A step of force on a loop at rest: better than without a learner, though position and bias can't be told apart."""
    load = ql.signals.Step(at=1.0)
    scenario = ql.Scenario(1.0, 12.0, disturbances=(0.0, load), x0=(1.0, 1.0, 0.0, 0.0))
    plain, learned = (
        ql.simulate(
            ql.plants.two_mass_spring(),
            ql.ADRC(ESO.model_free(4, 1.0, 10.0, 1e-2), omega_c=1.0, learner=learner),
            scenario,
            interpret=True,
        ).metrics(1.0, target=1.0)
        for learner in (None, ql.learners.Kalman())
    )
    assert learned["peak_error"] < plain["peak_error"]
    assert learned["iae"] < plain["iae"]


@pytest.mark.trial
@pytest.mark.parametrize("scale", [0.01, 0.1])
def test_a_first_motion_out_of_friction_does_not_settle_what_is_learned(scale: float) -> None:
    """Near standstill Coulomb friction looks like strong damping; later, larger motions outweigh what was learned there."""

    def pendulum(t: float, x: np.ndarray, u: float, w: np.ndarray) -> tuple[float, float]:
        return x[1], 8.0 * u + w[0] - 9.81 * np.sin(x[0]) - 0.4 * np.tanh(x[1] / scale)

    plant = ql.plants.NonlinearPlant(pendulum, order=2, substeps=2)
    scenario = ql.Scenario(ql.signals.Trapezoid(distance=2.0, duration=1.5, start=0.5), 5.0)
    plain, learned = (
        ql.simulate(
            plant,
            ql.ADRC(ESO.model_free(2, 8.0, 40.0, 4e-3), omega_c=10.0, learner=learner),
            scenario,
            interpret=True,
        ).metrics()
        for learner in (None, ql.learners.Kalman())
    )
    assert learned["rms"] <= plain["rms"]
    assert learned["peak_error"] <= plain["peak_error"]


def test_the_learner_watches_before_it_learns() -> None:
    """From rest it does not learn from the observer's own transient."""
    observer = ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=1e-2)
    learner = ql.learners.Kalman()
    design = learner.design(observer, 1.0)
    memory = learner.memory(design)
    for k in range(100):
        adapt(design, memory, np.array([1.0, 2.0, 3.0]), 1.0 + 1e-6, 0.0, 3.0)
        commit(design, memory, np.array([1.0, 2.0, 3.0]), 0.0, 0.0)
        if abs(k - 2 * 3 / 10.0 / 1e-2) > 1:
            assert np.any(memory.theta != 0.0) == (k > 2 * 3 / 10.0 / 1e-2), k
    restart(design, memory)
    before = memory.theta.copy()
    adapt(design, memory, np.array([1.0, 2.0, 3.0]), 1.0 + 1e-6, 0.0, 3.0)
    np.testing.assert_array_equal(memory.theta, before)


def test_a_learner_that_left_the_range_of_numbers_begins_anew() -> None:
    """Restarting keeps what was learned, but not where it is no number."""
    learner = ql.learners.Kalman(u=True)
    design = learner.design(ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=1e-2), 1.0)
    memory = learner.memory(design)
    memory.theta[:] = 0.25
    restart(design, memory)
    assert np.all(memory.theta == 0.25)
    for lost in ("theta", "covariance", "mean", "variance"):
        getattr(memory, lost).flat[-1] = np.inf
        restart(design, memory)
        for array, fresh in zip(memory, learner.memory(design), strict=True):
            np.testing.assert_array_equal(array, fresh)


def test_with_what_is_no_covariance_nothing_is_learned() -> None:
    """Rounding may make φ·Pφ negative: θ and P stay, and the learner goes on when it is positive."""
    learner = ql.learners.Kalman(bias=False)
    design, memory = kalman_memory(learner, ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=1e-2))
    memory.filtered[:] = 0.3, -0.4
    for sign in (-1.0, 1.0):
        memory.covariance[:] = before = sign * np.eye(2)
        adapt(design, memory, np.zeros(3), 1.0, 0.0, 1.0)
        assert np.all(memory.theta == 0.0) == (sign < 0.0)
        assert np.array_equal(memory.covariance, before) == (sign < 0.0)


def test_a_sample_whose_square_overflows_leaves_a_learner_as_before_the_first() -> None:
    """Its averages would stay infinite, and nothing would be learned any more."""
    learner = ql.learners.Kalman(u=True)
    design = learner.design(ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=1e-2), 1.0)
    memory = learner.memory(design)
    for huge in (1e200, -1e300):
        commit(design, memory, np.array([1.0, 2.0, 3.0]), 0.4, 0.0)
        with np.errstate(over="ignore"):
            adapt(design, memory, np.zeros(3), huge, 0.0, huge)
        for array, fresh in zip(memory, learner.memory(design), strict=True):
            np.testing.assert_array_equal(array, fresh)


@cases(
    ("make", "message"),
    [
        (lambda: ql.learners.Kalman(state=False, bias=False), "keep at least one feature"),
        (
            lambda: ql.learners.Kalman(bias_bandwidth=-1.0),
            "bias_bandwidth = -1.0: must be finite and not negative",
        ),
        (lambda: ql.learners.Kalman(state=2), "state = 2: must be True or False"),
        (
            lambda: ql.learners.Kalman(state_bandwidth=[0.1, 0.2]).design(
                ESO.model_free(3, 1.0, 10.0, 0.01), 1.0
            ),
            r"state_bandwidth has shape \(2,\): must be a vector of 3",
        ),
        (
            lambda: ql.learners.Kalman(frequency=0.0),
            "frequency = 0.0: must be finite and greater than zero",
        ),
        (
            lambda: ql.learners.Kalman(prior=math.inf),
            "prior = inf: must be finite and greater than zero",
        ),
        (
            lambda: ql.learners.Kalman(gain_interval=(1.2, 2.0)),
            r"gain_interval = \(1.2, 2.0\): must be \(low, high\) with 0 < low <= 1 <= high",
        ),
    ],
)
def test_a_mistake_is_named(make: object, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]
