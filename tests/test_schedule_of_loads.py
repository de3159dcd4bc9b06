"""A table of b0 beside parts that know a load: learner, guard, safe set, held plant, feedforward of a model."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest

import quell as ql

DT = 1e-3
B0 = (5000.0, 1000.0, 500.0)
POINTS = (0.0, 0.4, 1.0)
TABLE = ql.Schedule(POINTS, b0=B0)
LEARNERS: dict[str, Any] = {
    "Kalman": ql.learners.Kalman(state=False),
    "Harmonic": ql.learners.Harmonic(omegas=(25.0,), state=False),
    "Repetitive": ql.learners.Repetitive(period=0.25),
    "BatchGradient": ql.learners.BatchGradient(rate=1e-5, u=False),
}


def free(b0: float = 2000.0, **options: Any) -> ql.ESO:
    """Return a model-free observer of an axis."""
    return ql.ESO.model_free(2, b0, 200.0, DT, **options)


def _turns(t: float, x: Any, u: float, w: Any) -> Any:
    """An axis of inertia w[1] under the load w[0], with the friction w[2]."""
    return x[1], (u + w[0] - w[2] * x[1]) / (w[1] + 1e-12)


AXIS = ql.plants.NonlinearPlant(_turns, order=2, disturbances=3, substeps=1, name="axis")


def inertia(signal: Any) -> Any:
    """Return the J of the table at a signal."""
    return np.interp(signal, POINTS, 1.0 / np.array(B0))


def run(
    law: Any, signal: Any, load: Any, duration: float, reference: Any = 0.0, friction: float = 0.0
) -> ql.Trajectory:
    """Return a run of the axis whose inertia is that of the table at every time."""
    t = np.arange(0.0, duration + DT, DT)
    e = ql.signals.as_signal(signal)(t)
    w = (load, ql.signals.Samples(t, inertia(e)), friction)
    follows = (ql.signals.Samples(t, e),) if getattr(law, "external_signals", 0) else ()
    return ql.simulate(AXIS, law, ql.Scenario(reference, duration, w, schedule=follows))


# ---- At a fixed signal ----


@pytest.mark.trial
@pytest.mark.parametrize(
    ("name", "guarded"),
    [*((name, False) for name in LEARNERS), ("Kalman", True), ("Harmonic", True)],
)
def test_a_learner_at_a_fixed_signal_is_the_one_for_the_b0_there(name: str, guarded: bool) -> None:
    """The loop, its f_L and its guard: f/b0 is learned, so it does not matter which b0 the observer has."""
    parts: dict[str, Any] = {"learner": LEARNERS[name], "guard": ql.Guard() if guarded else None}
    law = ql.ADRC(free(), 40.0, schedule=TABLE, **parts)
    load = ql.signals.Sinusoid(amplitude=0.2, omega=25.0) + ql.signals.Constant(0.1)
    found, own = (run(each, 0.7, load, 2.0) for each in (law, law.at(0.7)))
    assert float(np.max(np.abs(own["f_learned"]))) > 1.0
    for channel in ("u", "f_learned", "f_residual"):
        size = float(np.max(np.abs(own[channel])))
        np.testing.assert_allclose(found[channel], own[channel], rtol=0.0, atol=1e-6 * size)
    if guarded:
        np.testing.assert_allclose(found["authority"], own["authority"], atol=1e-6)


@pytest.mark.parametrize("delay", [0.0, 2 * DT])
def test_a_model_s_feedforward_at_a_fixed_signal_has_the_inertia_there(delay: float) -> None:
    """And the same friction and the same weight; ``at`` has them, too."""
    model = ql.Feedforward.rigid(1 / 2000.0, viscous=2e-3, coulomb=0.05, constant=0.02)
    there = ql.Feedforward.rigid(float(inertia(0.7)), viscous=2e-3, coulomb=0.05, constant=0.02)
    b0 = 1.0 / float(inertia(0.7))
    law = ql.ADRC(free(delay=delay), 40.0, feedforward=model, schedule=TABLE)
    own = ql.ADRC(free(b0, delay=delay), 40.0, feedforward=there)
    r = ql.signals.Sinusoid(amplitude=0.4, omega=9.0)
    expected = run(own, 0.7, 0.1, 0.6, r)
    for each in (law, law.at(0.7)):
        found = run(each, 0.7, 0.1, 0.6, r)
        for channel in ("u", "u_feedforward", "f_residual"):
            size = float(np.max(np.abs(expected[channel])))
            np.testing.assert_allclose(found[channel], expected[channel], atol=1e-9 * size)


@pytest.mark.trial
def test_a_safe_set_at_a_fixed_signal_is_the_one_for_the_b0_there() -> None:
    """With bounds for b0(σ) u; the margin is that of the largest b0, in units of an acceleration."""
    safe = ql.SafeSet(y_max=0.5, alpha=15.0, f_rate=60.0, noise=1e-6)
    law = ql.ADRC(free(), 40.0, safe_set=safe, schedule=TABLE)
    r = ql.signals.Step(at=0.05, height=0.7)
    load = ql.signals.Sinusoid(amplitude=0.004, omega=6.0)  # |b0 d'| ≤ 48
    lightest = run(law, 0.0, load, 0.8, r)
    assert lightest.status & ql.Status.SAFE_SET_ACTED
    np.testing.assert_allclose(
        lightest["u"], run(law.at(0.0), 0.0, load, 0.8, r)["u"], rtol=1e-7, atol=1e-9
    )
    for signal in (0.0, 0.7, 1.0):
        found = run(law, signal, load, 0.8, r)
        assert found.status & ql.Status.SAFE_SET_ACTED
        assert not found.status & ql.Status.UNSAFE
        assert 0.45 < float(np.max(found["y"])) <= 0.5


def _held(law: Any, signals: Any, brake: tuple[int, int], load: float, samples: int) -> Any:
    """Return u and y of an axis with a brake between two samples, integrated exactly."""
    x, v, rows, u = 0.0, 0.0, [], 0.0
    for k in range(samples):
        J = float(inertia(signals(k)))
        if law.schedule is not None:
            law.set_signals(signals(k))
        u = law.step(0.05 if k >= 100 else 0.0, round(x / 1e-6) * 1e-6)
        rows.append((u, x, int(law.estimate.status)))
        if brake[0] <= k < brake[1]:
            v = 0.0
            continue
        a = (u + load) / J
        x, v = x + v * DT + 0.5 * a * DT**2, v + a * DT
    return np.array(rows)


@pytest.mark.trial(cases=r"0\.0")
@pytest.mark.parametrize("delay", [0.0, DT])
def test_a_detection_of_holds_at_a_fixed_signal_is_the_one_for_the_b0_there(delay: float) -> None:
    """It sees the brake, and its release, in the same samples; u is the same."""
    if delay:
        law = ql.ADRC(free(delay=delay), 40.0, held=ql.HeldPlant(), schedule=TABLE)
    else:
        law = ql.ADRC(
            free(), 40.0, held=ql.HeldPlant(), learner=ql.learners.Kalman(state=False),
            schedule=TABLE,
        )  # fmt: skip
    found = _held(law, lambda k: 0.7, (90, 500), 0.1, 900)
    own = _held(law.at(0.7), lambda k: 0.7, (90, 500), 0.1, 900)
    assert np.any(own[:, 2].astype(int) & int(ql.Status.HELD))
    np.testing.assert_array_equal(found[:, 2], own[:, 2])
    np.testing.assert_allclose(found[:, :2], own[:, :2], rtol=1e-6, atol=1e-8)


# ---- While the signal moves ----


@pytest.mark.trial
@pytest.mark.parametrize("guarded", [True, False])
def test_at_rest_under_a_load_that_is_learned_u_does_not_jump(guarded: bool) -> None:
    """When signal and inertia jump by 10 the learner's share of f jumps with b0, and u stays."""
    law = ql.ADRC(
        free(), 40.0, learner=ql.learners.Kalman(state=False), schedule=TABLE,
        guard=ql.Guard() if guarded else None,
    )  # fmt: skip
    jump = ql.signals.Step(at=3.0, height=1.0)
    found = run(law, jump, ql.signals.Step(at=0.1, height=0.5), 3.02)
    late, before = found.t > 2.99, found.t < 3.0 - 0.5 * DT
    np.testing.assert_allclose(found["u"][late], -0.5, atol=5e-7)
    total = found["f_learned"] + found["f_residual"]
    assert total[before][-1] == pytest.approx(0.5 * 5000.0, rel=1e-5)
    assert total[-1] == pytest.approx(0.5 * 500.0, rel=1e-4)


@pytest.mark.trial
def test_what_was_learned_at_one_inertia_is_right_at_another() -> None:
    """A periodic load, learned at the smallest inertia: the jump to the largest leaves no error."""
    load = ql.signals.Sinusoid(amplitude=0.2, omega=25.0)
    law = ql.ADRC(free(), 40.0, learner=LEARNERS["Harmonic"], guard=ql.Guard(), schedule=TABLE)
    found = run(law, ql.signals.Step(at=5.0, height=1.0), load, 5.5)
    period = 2 * math.pi / 25.0

    def rms(start: float) -> float:
        part = (found.t >= start) & (found.t < start + period)
        return float(np.sqrt(np.mean(found["y"][part] ** 2)))

    plain = run(ql.ADRC(free(), 40.0, schedule=TABLE), 1.0, load, 2.0)
    assert rms(5.0) < 1e-6 * float(np.sqrt(np.mean(plain["y"][plain.t > 1.0] ** 2)))


@pytest.mark.trial
def test_a_learner_that_knows_the_load_stays_right_while_the_inertia_moves() -> None:
    """By a factor of 10 in a tenth of a second, to and fro: the error is a hundredth of that without learner."""
    signal = ql.signals.Constant(0.5) + ql.signals.Sinusoid(amplitude=0.5, omega=30.0)
    load = ql.signals.Sinusoid(amplitude=0.2, omega=25.0)
    errors = []
    for learner in (None, LEARNERS["Harmonic"]):
        law = ql.ADRC(free(), 40.0, learner=learner, schedule=TABLE)
        found = run(law, signal, load, 5.0)
        errors.append(float(np.sqrt(np.mean(found["y"][found.t > 4.0] ** 2))))
    assert errors[1] < 0.01 * errors[0]


@pytest.mark.trial
def test_a_gain_that_is_wrong_by_one_factor_is_one_coefficient_at_all_inertias() -> None:
    """θ_u of ``Kalman(u=True)`` is (b/b0(σ) − 1) b0, that of the observer, while b0(σ) moves by 10."""
    law = ql.ADRC(
        free(), 40.0, feedforward=True, learner=ql.learners.Kalman(state=False, u=True),
        schedule=ql.Schedule(POINTS, b0=tuple(b / 1.3 for b in B0)),
    )  # fmt: skip
    signal = ql.signals.Constant(0.5) + ql.signals.Sinusoid(amplitude=0.5, omega=5.0)
    found = run(law, signal, 0.0, 6.0, ql.signals.Sinusoid(amplitude=0.5, omega=11.0))
    assert found["theta"][-1, -1] == pytest.approx(0.3 * 2000.0, rel=0.05)


def test_the_law_solves_for_u_with_the_learner_s_coefficient_at_any_b0() -> None:
    """``b0(σ) u = u_0 − Δf̂ − f_L`` with the f_L of this very u, in each sample."""
    law = ql.ADRC(free(), 40.0, learner=ql.learners.Kalman(u=True), schedule=TABLE)
    random = np.random.default_rng(2)
    y = 0.0
    for k in range(400):
        law.set_signals(0.5 + 0.5 * math.sin(0.05 * k))
        y += 0.01 * random.standard_normal()
        u = law.step(0.3, y)
        state, found = law._state, law.estimate
        u_0 = law.gains[0] * (0.3 - found.x[0]) - law.gains[1] * found.x[1]
        b0 = float(state.schedule.loop[0].b0)
        assert b0 * u == pytest.approx(u_0 - found.f, rel=1e-9, abs=1e-6)
    assert abs(float(state.loop[0].slope)) > 1.0


@pytest.mark.trial
def test_an_inertia_that_jumps_in_a_move_leaves_no_error_where_a_model_is_fed_forward() -> None:
    """Nor does its friction: what is left are the errors of a load, with which it begins."""
    model = ql.Feedforward.rigid(1 / 2000.0, viscous=2e-3)
    law = ql.ADRC(free(), 40.0, feedforward=model, schedule=TABLE)
    r = ql.signals.Sinusoid(amplitude=1.0, omega=10.0)
    jump = ql.signals.Step(at=1.07, height=1.0)  # in an acceleration
    found = run(law, jump, 0.0, 1.5, r, friction=2e-3)
    error = np.abs(found["r"] - found["y"])
    before = float(np.max(error[(found.t > 0.9) & (found.t < 1.07)]))
    assert float(np.max(error[found.t > 1.07])) < 2.0 * before
    plain = run(ql.ADRC(free(5000.0), 40.0, feedforward=True), jump, 0.0, 1.5, r, friction=2e-3)
    assert float(np.max(np.abs(plain["r"] - plain["y"])[plain.t > 1.07])) > 50.0 * before


def test_at_rest_on_a_spring_that_the_model_knows_u_does_not_jump() -> None:
    """The force of the spring stays as the other loads do, although it is a·x̂ and not in f̂."""
    spring = ql.plants.LinearPlant([[0.0, 1.0], [-800.0, -3.0]], [0.0, 2000.0], [1.0, 0.0])
    law = ql.ADRC(ql.ESO.model_based(spring, 200.0, DT), 40.0, schedule=TABLE)
    law.set_signals(0.0)
    law.start(0.5, 0.3)
    assert law.step(0.5, 0.5) == pytest.approx(0.3, abs=1e-9)
    law.set_signals(1.0)
    u = [law.step(0.5, 0.5) for _ in range(20)]
    np.testing.assert_allclose(u, 0.3, atol=1e-9)


@pytest.mark.trial
def test_y_stays_in_its_band_while_the_inertia_moves() -> None:
    """Under loads within the bound that the safe set was given, for b0 that moves by 10 in 0.2 s."""
    safe = ql.SafeSet(y_min=-0.5, y_max=0.5, alpha=15.0, f_rate=130.0, noise=1e-6)
    for seed in range(6):
        random = np.random.default_rng(seed)
        law = ql.ADRC(free(), 40.0, safe_set=safe, schedule=TABLE)
        signal = ql.signals.Constant(0.5) + ql.signals.Sinusoid(
            amplitude=0.5, omega=15.0, phase=float(random.uniform(0, 6.28))
        )
        omega = float(random.uniform(2.0, 8.0))  # |b0 d'| ≤ 120
        load = ql.signals.Sinusoid(
            amplitude=0.06 / omega, omega=omega, phase=float(random.uniform(0, 6.28))
        )
        steps = ql.signals.Samples(
            np.arange(0.0, 3.0, 0.25), random.uniform(-0.8, 0.8, 12), hold="previous"
        )
        found = run(law, signal, load + ql.signals.Constant(0.3), 3.0, steps)
        assert found.status & ql.Status.SAFE_SET_ACTED
        assert not found.status & ql.Status.UNSAFE
        assert float(np.max(np.abs(found["y"]))) <= 0.5


@pytest.mark.trial
def test_a_load_from_before_a_hold_is_right_after_it_at_another_inertia() -> None:
    """Seen by itself or said: y does not move further than it does where the inertia stays."""
    for said in (False, True):
        furthest = []
        for end in (0.0, 1.0):
            law = ql.ADRC(free(), 40.0, held=None if said else ql.HeldPlant(), schedule=TABLE)
            law.set_signals(0.0)
            law.start(0.0, -0.3)
            x, v, far = 0.0, 0.0, 0.0
            for k in range(900):
                braked = 100 <= k < 500
                if said:
                    law.set_held(braked)
                s = end * min(max((k - 200) / 200.0, 0.0), 1.0)
                law.set_signals(s)
                u = law.step(0.02 if 100 <= k < 450 else 0.0, round(x / 1e-6) * 1e-6)
                if braked:
                    v = 0.0
                    continue
                a = (u + 0.3) / float(inertia(s))
                x, v = x + v * DT + 0.5 * a * DT**2, v + a * DT
                far = max(far, abs(x))
            furthest.append(far)
        assert furthest[1] < 1.1 * furthest[0] + 1e-5
        if not said:
            assert furthest[0] < 0.01


# ---- Setup, export, memory ----

SETUP = """
dt = 0.001
plant = { kind = "linear", A = [[0.0, 1.0], [0.0, 0.0]], B = [0.0, 1000.0], C = [1.0, 0.0] }
observer = { kind = "model-free", order = 2, b0 = 1000.0, omega_o = 200.0 }
scenario = { duration = 0.3, reference = 0.1, schedule = [0.3] }
guard = {}
learner = { kind = "harmonic", omegas = [25.0] }
[controller]
omega_c = 40.0
held = {}
safe_set = { y_max = 0.5, alpha = 15.0 }
feedforward = { kind = "rigid", inertia = 1e-3, coulomb = 0.01 }
schedule = { points = [0.0, 1.0], b0 = [500.0, 2000.0] }
"""


def test_all_parts_together_are_written_to_a_setup_file_and_read_again(tmp_path: Any) -> None:
    """What was read is what was written, and the loops are the same to the last bit."""
    from quell.setup import load

    file = tmp_path / "setup.toml"
    file.write_text(SETUP)
    setup = load(file)
    law = setup.controller
    made = ql.ADRC(
        ql.ESO.model_free(2, 1000.0, 200.0, DT), 40.0,
        learner=ql.learners.Harmonic(omegas=(25.0,)), guard=ql.Guard(), held=ql.HeldPlant(),
        safe_set=ql.SafeSet(y_max=0.5, alpha=15.0),
        feedforward=ql.Feedforward.rigid(1e-3, coulomb=0.01),
        schedule=ql.Schedule((0.0, 1.0), b0=(500.0, 2000.0)),
    )  # fmt: skip
    found, other = (ql.simulate(setup.plant, each, setup.scenario) for each in (law, made))
    np.testing.assert_array_equal(found["u"], other["u"])


def test_what_was_learned_is_continued_at_another_inertia() -> None:
    """A state that was saved at one signal and restored goes on as the loop that it was taken from."""
    law = ql.ADRC(free(), 40.0, learner=ql.learners.Kalman(), guard=ql.Guard(), schedule=TABLE)
    for k in range(300):
        law.set_signals(0.2)
        law.step(0.1, 0.1 * math.sin(0.03 * k))
    other = ql.ADRC(free(), 40.0, learner=ql.learners.Kalman(), guard=ql.Guard(), schedule=TABLE)
    other.state = copy.deepcopy(law.state)
    for each in (law, other):
        each.set_signals(0.9)
    for k in range(50):
        assert law.step(0.1, 0.01 * k) == other.step(0.1, 0.01 * k)
