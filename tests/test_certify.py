"""Certificates of guarded loops: gains beside brute force, bounds beside hostile learners."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse, certify, observer_error
from quell.guard.guard import is_invertible
from quell.lti.models import System, peak_gain
from quell.observers.forms import observe
from tests.injected import Injected

from .benchmark_module import benchmark
from .cases import cases

DT = 0.02
spending = benchmark("spender")
RAMPING = ([1.3], [1.0, 0.0, 0.0])


def observed(form: str) -> tuple[ql.ESO, Any, dict[str, float]]:
    """Return an observer, a plant and the options of ``certify``, for each structure."""
    chain = {"order": 2, "b0": 1.0, "omega_o": 10.0, "dt": DT}
    if form == "delay":
        return ql.ESO.model_free(**chain, delay=0.06), RAMPING, {"delay": 0.06}
    if form == "lag":
        return ql.ESO.model_free(**chain), RAMPING, {"actuator_lag": 0.02}
    if form == "kalman":
        return (
            ql.ESO.kalman(2, 1.0, DT, noise_variance=1e-6, drift=1.0, jitter=1e-3), RAMPING, {},
        )  # fmt: skip
    if form == "half gain":
        return ql.ESO.model_free(**chain, half_gain=True), RAMPING, {}
    if form == "model":
        model = ql.ESO.model_based(([1.0], [1.0, 0.5, 1.0]), 10.0, DT)
        return model, ([1.4], [1.0, 0.2, 2.0]), {}
    if form == "input of its own":
        model = ql.ESO.model_based(
            ([[0.0, 1.0], [0.0, 0.0]], [1.0, 1.0], [0.0, 1.0], [1.0, 0.0]), 10.0, DT
        )
        return model, ([1.2, 1.2], [1.0, 0.3, 0.0]), {}
    if form == "order 4":
        return ql.ESO.model_free(4, 1.0, 10.0, DT), ql.plants.two_mass_spring(k=0.9), {}
    return ql.ESO.model_free(**chain, form=form), RAMPING, {}


FORMS = [
    "current", "predictor", "reduced", "half gain", "kalman", "model", "input of its own",
    "delay", "lag", "order 4",
]  # fmt: skip


def correcting(
    observer: ql.ESO, plant: Any, sequence: Any, delay: float = 0.0, actuator_lag: float = 0.0
) -> ql.Trajectory:
    """Return the run, from rest, of a loop whose learner has the correction ``sequence``."""
    model = ql.plants.LinearPlant.of(plant)
    if actuator_lag:
        n = model.order
        A = np.zeros((n + 1, n + 1))
        A[:n, :n], A[:n, n], A[n, n] = model.A, model.B[:, 0], -1.0 / actuator_lag
        model = ql.plants.LinearPlant(A, -A[n], np.append(model.C[0], 0.0))
    controller = ql.ADRC(observer, omega_c=1.0, learner=Injected(sequence))
    scenario = ql.Scenario(duration=len(sequence) * DT)
    delayed = ql.plants.delayed(model, delay, DT) if delay else model
    return ql.simulate(delayed, controller, scenario, interpret=True)


@pytest.mark.parametrize("form", FORMS)
def test_the_gains_are_those_of_the_simulated_loop(form: str) -> None:
    """Σ |q| and Σ |y| after a pulse of e_L in quell's own loop, with every form of the observer, delay and lag."""
    observer, plant, options = observed(form)
    duration = 40.0 if form == "order 4" else 20.0
    run = correcting(observer, plant, [1.0] + [0.0] * round(duration / DT), **options)
    found = certify(plant, ql.ADRC(observer, omega_c=1.0), **options)
    assert np.sum(np.abs(run["theta"][:, 0])) == pytest.approx(found.gain, rel=1e-5)
    assert np.sum(np.abs(run["y"])) == pytest.approx(found.output_gain, rel=1e-5)


@pytest.mark.parametrize("form", ["predictor", "delay", "order 4"])
def test_the_error_of_a_record_is_the_one_that_the_controller_knows(form: str) -> None:
    """Computed from y and u alone, whatever the learner did."""
    observer, plant, options = observed(form)
    push = np.random.default_rng(0).normal(size=400)
    run = correcting(observer, plant, push, **options)
    q = observer_error(ql.ADRC(observer, omega_c=1.0), run)
    np.testing.assert_allclose(q, run["theta"][:, 0], atol=1e-9 * np.max(np.abs(q)))
    thin = dataclasses.replace(run, every=2)
    with pytest.raises(ValueError, match="run has every = 2: all samples must be recorded"):
        observer_error(ql.ADRC(observer, omega_c=1.0), thin)


def test_the_worst_correction_attains_the_gain() -> None:
    """The sign of the pulse response, backwards, makes q as large as Γ; nothing else can make it larger."""
    observer, plant, _ = observed("current")
    pulse = correcting(observer, plant, [1.0] + [0.0] * 1000)["theta"][1:, 0]
    run = correcting(observer, plant, np.sign(pulse[::-1]))
    gain = certify(plant, ql.ADRC(observer, omega_c=1.0)).gain
    assert run["theta"][-1, 0] == pytest.approx(gain, rel=1e-5)
    assert np.max(np.abs(run["theta"][:, 0])) <= gain


def staged(pulse: Any, length: int, stages: int) -> Any:
    """Return the signs that are worst for q at the end of each stage, of ``length`` samples."""
    return np.tile(np.sign(pulse[:length][::-1]), stages)


def attacked(
    order: int, plant: Any, kappa: float, *, length: int, stages: int
) -> tuple[ql.Trajectory, ql.Trajectory]:
    """Return the run of the worst learner under a load that grows steadily, and that without."""
    observer = ql.ESO.model_free(order, 1.0, 10.0, DT)
    pulse = correcting(observer, plant, [1.0] + [0.0] * length)["theta"][1:, 0]
    load = ql.Scenario(duration=length * stages * DT, disturbances=(ql.signals.Ramp(1.0),))
    runs = [
        ql.simulate(
            ql.plants.LinearPlant.of(plant),
            ql.ADRC(observer, omega_c=1.0, learner=Injected(signs, kappa)),
            load,
            interpret=True,
            limit=1e30,
        )
        for signs in ([0.0], staged(pulse, length, stages))
    ]
    return runs[1], runs[0]


def largest_q(run: ql.Trajectory) -> float:
    """Return sup |q|."""
    return float(np.max(np.abs(run["theta"][:, 0])))


@pytest.mark.trial
def test_the_worst_learner_attains_the_bound_and_none_exceeds_it() -> None:
    """Whatever stays within κ e: with a constant q_0 it comes within 5 % of the bound on q, so no smaller one holds."""
    plant = ([1.6], [1.0, 0.0, 0.0])
    found = certify(plant, ql.ADRC(ql.ESO.model_free(2, 1.0, 10.0, DT), omega_c=1.0))
    kappa = 0.7 / found.gain
    run, plain = attacked(2, plant, kappa, length=300, stages=10)
    bound = largest_q(plain) / 0.3
    assert 0.95 * bound < largest_q(run) <= bound
    deviation = np.max(np.abs(run["y"] - plain["y"]))
    assert 0.5 * found.output_gain * kappa * bound < deviation
    assert deviation <= found.output_gain * kappa * bound


@pytest.mark.trial
@pytest.mark.lost
def test_a_loop_without_certificate_can_be_lost() -> None:
    """At order 4 with b 60 % too large κΓ is 2 for κ = 1.2: the error grows without end."""
    plant = ([1.6], [1.0, 0.0, 0.0, 0.0, 0.0])
    found = certify(plant, ql.ADRC(ql.ESO.model_free(4, 1.0, 10.0, DT), omega_c=1.0))
    assert not found.certified
    run, plain = attacked(4, plant, 1.2, length=300, stages=12)
    assert largest_q(run) > 100.0 * largest_q(plain)
    assert np.max(np.abs(run["y"])) > 20.0 * np.max(np.abs(plain["y"]))


@pytest.mark.trial
def test_no_learner_that_a_search_finds_exceeds_the_bound_of_its_guard() -> None:
    """It knows plant and load, earns trust with f under a load that grows steadily, and then pushes as is worst for q."""
    plant = ([1.6], [1.0, 0.0, 0.0])
    observer, guard = ql.ESO.model_free(2, 1.0, 10.0, DT), ql.Guard()
    load = ql.signals.Ramp(1.0)
    scenario = ql.Scenario(duration=40.0, disturbances=(load,))
    pulse = correcting(observer, plant, [1.0] + [0.0] * 600)["theta"][1:, 0]
    lag, samples = observer.lag_time / DT, round(40.0 / DT) + 1
    without = ql.ADRC(observer, omega_c=1.0)
    plain = ql.simulate(plant, without, scenario)
    alone = np.max(np.abs(observer_error(without, plain)))
    learner = ql.learners.Kalman()
    found = certify(plant, ql.ADRC(observer, omega_c=1.0, learner=learner, guard=guard))
    trusted = 0
    for seed in range(4):
        push = spending.draw_push(np.random.default_rng(seed), pulse, samples, lag)
        spender = spending.Spender(1.6 * load.evaluate(DT * np.arange(samples)), push, 0.6)
        hostile = ql.ADRC(observer, omega_c=1.0, learner=spender, guard=guard)
        run = ql.simulate(plant, hostile, scenario)
        trusted += np.max(run["authority"]) > 0.5
        assert np.max(np.abs(observer_error(hostile, run))) <= found.error_bound(alone)
        assert np.max(np.abs(run["y"] - plain["y"])) <= found.output_bound(alone)
    assert trusted >= 3


def test_the_peak_gain_of_first_and_second_order_is_the_closed_form() -> None:
    """``Σ |b a^k|`` of one pole, and of two complex ones, where the sign changes; never less, and more by 2e-6 at most."""
    for pole in (0.9, -0.5, 0.999999):
        one = System(np.array([[pole - 1.0]]), np.array([2.0]), np.array([1.0]), -3.0)
        exact = 3.0 + 2.0 / (1.0 - abs(pole))
        assert exact * (1.0 - 1e-9) <= peak_gain(one) <= exact * (1.0 + 2e-6)
    radius, quarter = 0.99, np.array([[0.0, 1.0], [-1.0, 0.0]])  # h = r^k times 1, 0, −1, 0, …
    turning = System(radius * quarter - np.eye(2), np.array([1.0, 0.0]), np.array([1.0, 0.0]), 0.0)
    assert peak_gain(turning) == pytest.approx(1.0 / (1.0 - radius**2), rel=2e-6)


def test_a_response_that_does_not_decay_has_no_peak_gain() -> None:
    """It is refused, and not summed for hours."""
    for pole in (1.0, 1.01, 1.0 - 1e-9):
        with pytest.raises(ValueError, match="does not decay within 16777216 samples"):
            peak_gain(System(np.array([[pole - 1.0]]), np.ones(1), np.ones(1), 0.0))


def controller(order: int = 2, **options: Any) -> ql.ADRC:
    """Return a controller with omega_o = 10, omega_c = 1; a guard gets a learner."""
    if "guard" in options:
        options.setdefault("learner", ql.learners.Kalman())
    return ql.ADRC(ql.ESO.model_free(order, 1.0, 10.0, 0.005), omega_c=1.0, **options)


def test_the_bounds_are_those_of_the_theorem_and_of_the_worst_plant() -> None:
    """1/(1 − κΓ) and Γ_y κ/(1 − κΓ); infinite where κΓ is not below 1."""
    plants = {f"b = {b}": ([b], [1.0, 0.0, 0.0]) for b in (0.7, 1.0, 1.6)}
    found = certify(plants, controller(guard=ql.Guard(bound=1.2)))
    alone = [certify(plant, controller(guard=ql.Guard(bound=1.2))) for plant in plants.values()]
    assert found.worst == "b = 1.6"
    assert found.gain == max(one.gain for one in alone)
    assert found.output_factor == max(one.output_factor for one in alone)
    assert found.error_factor == pytest.approx(1.0 / (1.0 - 1.2 * found.gain))
    assert found.error_bound(2.0) == 2.0 * found.error_factor
    assert found.output_bound(2.0) == 2.0 * found.output_factor
    assert found.largest_kappa == 1.0 / found.gain
    loud = certify(plants, controller(guard=ql.Guard(bound=2.0)))
    assert found.certified
    assert not loud.certified
    assert loud.error_factor == loud.output_factor == math.inf
    assert loud.to_json()["error_factor"] is None


def test_a_certified_guard_takes_its_bound_from_the_plants() -> None:
    """κ is 0.9/Γ where 3 is too much, and 3 elsewhere; a new omega_c gives a new one."""
    weak, strong = ([0.7], [1.0, *4 * [0.0]]), ([1.1], [1.0, *4 * [0.0]])
    both = controller(4, guard=ql.Guard(certified_for=[weak, strong]))
    found = certify([weak, strong], both)
    assert found.kappa == pytest.approx(0.9 / found.gain)
    assert found.certified
    assert certify(strong, controller(4, guard=ql.Guard(certified_for=strong))).kappa == 3.0
    both.retune(omega_c=0.7)
    slower = certify([weak, strong], both)
    assert slower.kappa * slower.gain == pytest.approx(0.9)
    assert slower.kappa > found.kappa


def test_what_is_not_covered_is_said() -> None:
    """Limits of u, the steps of an encoder, large motions."""
    pendulum = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u - np.sin(x[0])), order=2)
    rough = ql.plants.encoded(ql.plants.delayed(pendulum, 0.01, 0.005), 1000)
    limited = controller(learner=ql.learners.Kalman(), guard=ql.Guard(), u_max=3.0)
    found = certify(rough, limited, operating_point=([0.0, 0.0], 0.0))
    assert [text.partition(" (")[0] for text in found.excluded] == [
        "times when u is limited",
        "the encoder's steps",
        "large motions",
    ]
    assert "not covered: times when u is limited; the encoder's steps" in str(found)
    whole = analyse(rough, limited, operating_point=([0.0, 0.0], 0.0))
    assert str(found) in whole.summary()
    assert whole.certificate == found


def test_the_verdict_says_first_that_the_controller_is_not_guarded() -> None:
    """For an oven with a free learner, and without one, the bounds are those of Guard()."""
    oven = ql.plants.LinearPlant.of(([2.2], [300.0, 1.0]))
    chain = ql.ESO.model_free(order=1, b0=0.0095, omega_o=0.1, dt=1.0)

    def found(**parts: Any) -> Any:
        return certify(oven, ql.ADRC(chain, omega_c=0.025, **parts))

    learner = ql.learners.Kalman()
    free, plain = found(learner=learner), found()
    guarded = found(learner=learner, guard=ql.Guard())
    first, second = str(free).splitlines()[:2]
    assert first == "NOT guarded: holds with guard=Guard()"
    assert second.startswith("certified: κΓ = 3")
    assert str(plain).startswith("no learner: nothing to certify; this holds with a learner and")
    assert str(guarded).startswith("certified: κΓ = 3")
    assert free.to_json()["condition"] == first
    assert guarded.to_json()["condition"] == ""


def test_an_analysis_has_a_certificate_where_a_guarded_learner_is() -> None:
    """Not without learner or guard; where there is none, the summary says why."""
    plant, learner = ([1.3], [1.0, 0.0, 0.0]), ql.learners.Kalman()
    assert analyse(plant, controller()).certificate is None
    assert analyse(plant, controller(learner=learner)).certificate is None
    free = controller(learner=learner, guard=ql.Guard())
    assert "not certified: κΓ = 3 · 0.374" in analyse(plant, free).summary()
    guarded = controller(learner=learner, guard=ql.Guard(certified_for=plant))
    assert "\ncertified: κΓ = 2.41 · 0.374 = 0.9" in analyse(plant, guarded).summary()
    curved = controller(
        learner=learner,
        guard=ql.Guard(),
        feedback=ql.controllers.NonlinearFeedback((0.75, 1.25), delta=0.1),
    )
    assert "no certificate: controller" in analyse(plant, curved).summary()


@pytest.mark.trial
@cases(
    ("observer", "invertible"),
    [
        (ql.ESO.model_free(8, 1.0, 10.0, 1e-2), True),
        (ql.ESO.model_free(4, 1.0, 10.0, 0.1, form="predictor"), True),
        (ql.ESO.model_free(3, 1.0, 10.0, 0.02, half_gain=True), True),
        (ql.ESO.model_free(5, 1.0, 10.0, 0.1, half_gain=True), False),
        (ql.ESO.cascade(2, 1.0, 10.0, 1e-2), False),
        (ql.ESO.model_based(([2.0, 2.0], [1.0, 0.9, 1.5]), 10.0, 5e-3), False),
        (ql.ESO.model_based(([2.0, 2.0], [1.0, 0.9, 1.5]), 10.0, 5e-3, keep_zeros=True), True),
    ],
)
def test_which_observers_answer_a_bounded_correction_with_bounded_states(
    observer: ql.ESO, invertible: bool
) -> None:
    """Simulated: with e_L = 1 for 60 lags the estimates stay bounded, or grow without end."""
    assert is_invertible(observer) is invertible
    z, seen = np.zeros(observer.states), np.zeros(observer.order + 1)
    largest = []
    for _ in range(2):
        for _ in range(round(30.0 * observer.lag_time / observer.dt)):
            observe(observer.model, z, seen, 0.0, 0.0, 1.0 - seen[-1])
        largest.append(float(np.max(np.abs(seen[:-1]))))
    assert (largest[1] < 1.5 * largest[0]) is invertible


@pytest.mark.trial
def test_a_clipped_learner_does_not_run_away_where_the_states_would() -> None:
    """An observer that does not keep the plant's zero: a learner that was trusted, then pushes to both sides, moves y by little."""
    plant = ([2.0, 2.0], [1.0, 0.9, 1.5])
    observer, load = ql.ESO.model_based(plant, 10.0, DT), ql.signals.Sinusoid(1.0, 1.0)
    assert not is_invertible(observer)
    scenario = ql.Scenario(duration=40.0, disturbances=(load,))
    t = DT * np.arange(2001)
    push = np.where(t < 25.0, np.nan, np.sign(np.sin(5.0 * t)))
    learner = spending.Spender(2.0 * load.evaluate(t), push, 0.0)
    alone = ql.simulate(plant, ql.ADRC(observer, omega_c=1.0), scenario)
    hostile = ql.ADRC(observer, omega_c=1.0, learner=learner, guard=ql.Guard())
    run = ql.simulate(plant, hostile, scenario, limit=1e6)
    assert np.max(run["authority"]) > 0.5
    assert np.max(np.abs(run["y"])) < 10.0 * np.max(np.abs(alone["y"]))


UNSTABLE = ([3.0], [1.0, 0.0, 0.0, 0.0, 0.0])


@cases(
    ("wrong", "message"),
    [
        (lambda: certify({"heavy": UNSTABLE}, controller(4)), "heavy: the loop without learner is"),
        (lambda: certify(UNSTABLE, controller(4)), "is unstable, with a pole at .z. = 1.0"),
        (lambda: controller(4, guard=ql.Guard(certified_for=UNSTABLE)), "without learner is unst"),
        (lambda: certify([], controller()), "plants = .*: must have at least one"),
        (lambda: certify(([1.0], [1.0, 0.0]), ql.baselines.PID(1.0, 1.0, dt=0.1)), "be an ADRC"),
        (
            lambda: certify(
                RAMPING, ql.ADRC(ql.ESO.nonlinear(2, 1.0, 10.0, 0.01, delta=0.1), omega_c=1.0)
            ),
            "observer is nonlinear",
        ),
        (
            lambda: certify(RAMPING, ql.ADRC(ql.ESO.cascade(2, 1.0, 10.0, 0.01), omega_c=1.0)),
            "answer to a correction is unstable",
        ),
        (
            lambda: certify(
                RAMPING, ql.ADRC(ql.ESO.model_free(2, 1.0, 10.0, 0.001, delay=0.25), omega_c=1.0)
            ),
            "observer has 253 states with its delay: must have at most 250",
        ),
        (lambda: certify(RAMPING, controller()).error_bound(-1.0), "q_0 = -1.0"),
        (lambda: ql.Guard(certified_for=RAMPING).design(controller().observer), "law = None"),
    ],
)
def test_a_loop_that_cannot_be_certified_is_refused(wrong: Any, message: str) -> None:
    """With the plant's name and the reason."""
    with pytest.raises(ValueError, match=message):
        wrong()
