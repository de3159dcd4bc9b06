"""A compensator on top of any controller: what it adds, what it leaves alone, how it is tuned."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis.linearise import linear_law
from quell.controllers.law import law_gains
from quell.setup import load
from quell.types import Status

from .cases import cases
from .commands import Shown

DT = 0.01
PLANT = ([2.0], [1.0, 1.0, 0.0])
PID = ql.baselines.PID(4.0, 2.0, 1.0, tf=0.05, dt=DT)
OBSERVER = ql.ESO.model_free(order=2, b0=2.0, omega_o=30.0, dt=DT)


def rms_under_load(controller: Any, omega: float = 2.0, duration: float = 20.0) -> float:
    """Return the late RMS error under a sinusoidal load at the plant's input."""
    load = ql.signals.Sinusoid(1.0, omega)
    run = ql.simulate(PLANT, controller, ql.Scenario(duration=duration, disturbances=[load]))
    return float(np.sqrt(np.mean(run["y"][len(run) // 2 :] ** 2)))


def test_an_adrc_is_a_compensator_with_a_law() -> None:
    """u_0 from the law of the same estimates, given from outside, makes the same u, sample by sample."""
    adrc = ql.ADRC(OBSERVER, omega_c=3.0, u_min=-4.0, u_max=4.0)
    compensator = ql.Compensator(OBSERVER, u_min=-4.0, u_max=4.0)
    twin = ql.Compensator(OBSERVER, u_min=-4.0, u_max=4.0)
    k, y, rate = law_gains(2, 3.0), 0.0, 0.0
    for _ in range(400):
        u = adrc.step(1.0, y)
        twin.step(0.0, y)  # the estimates of this sample
        x = twin.estimate.x
        assert compensator.step(float(k @ (np.array([1.0, 0.0]) - x)) / 2.0, y) == pytest.approx(
            u, abs=1e-9
        )
        twin.applied(u)
        rate += DT * (2.0 * u - rate + 0.7)
        y += DT * rate
    assert adrc.estimate.f == pytest.approx(compensator.estimate.f, rel=1e-9)


def test_without_a_disturbance_it_adds_nothing_to_a_plant_that_its_model_describes() -> None:
    """A drive that takes commands keeps its dynamics: u is u_0 to rounding."""
    drive = ([25.0], [1.0, 8.0, 25.0])
    compensator = ql.Compensator(ql.ESO.model_based(drive, omega_o=60.0, dt=DT))
    command = ql.signals.Step(1.0) + ql.signals.Sinusoid(0.5, 3.0)
    run = ql.simulate(drive, compensator, ql.Scenario(reference=command, duration=5.0))
    np.testing.assert_allclose(run["u"], run["r"], atol=1e-8)


@pytest.mark.trial
def test_it_rejects_a_load_that_the_controller_leaves_and_with_a_guarded_learner_nearly_all() -> (
    None
):
    """On a PID controller under a sinusoidal load."""
    alone = rms_under_load(PID)
    compensator = ql.Compensator(OBSERVER)
    assert rms_under_load(ql.Compensated(PID, compensator)) < 0.3 * alone
    learner: dict[str, Any] = {"learner": ql.learners.Harmonic(bias=False), "guard": ql.Guard()}
    learning = ql.Compensated(PID, ql.Compensator(OBSERVER, omega_c=3.0, **learner))
    assert rms_under_load(learning, duration=60.0) < 0.02 * alone


def test_its_loop_is_the_one_that_analyse_has() -> None:
    """The closed loop's poles of a PID controller with compensator are those of its simulated step."""
    both = ql.Compensated(PID, ql.Compensator(OBSERVER))
    loop = ql.analysis.analyse(PLANT, both)
    run = ql.simulate(PLANT, both, ql.Scenario(reference=ql.signals.Step(1e-3), duration=3.0))
    law, sampled = linear_law(both), loop.plant
    x, state, y = np.zeros(sampled.N.shape[0]), np.zeros(law.C.size), []
    for r in run["r"]:
        y.append(float(sampled.C @ x))
        u = float(law.C @ state + law.D_r * r + law.D_y * y[-1])
        state = law.A @ state + law.B_r * r + law.B_y * y[-1] + law.B_u * u
        x = x + sampled.N @ x + sampled.B * u
    np.testing.assert_allclose(run["y"], y, atol=1e-9)


def test_limits_are_those_of_the_sum_and_the_controller_does_not_wind_up() -> None:
    """Held at its limit for ten seconds, a PI controller returns as one that was just told; its own limits are taken over."""
    pi = ql.baselines.PID(2.0, 3.0, dt=DT, u_min=-1.0, u_max=1.0)
    both = ql.Compensated(pi, ql.Compensator(ql.ESO.model_free(1, 1.0, 20.0, DT)))
    assert (both.limits.low, both.limits.high) == (-1.0, 1.0)
    for _ in range(1000):
        assert both.step(5.0, 0.0) == 1.0
    assert both.estimate.status & Status.SATURATED
    # The plant did not move, which is a load of −1 for the observer; but u_0 has not wound up.
    assert abs(both.controller._state.loop[0].u) < 1.0 + 2.0 * 5.0
    before = [both.step(-1.0, 0.0) for _ in range(30)]
    assert min(before) == -1.0


def test_manual_operation_and_hand_over_are_bumpless() -> None:
    """Tracked at u = 0.4 by hand, both parts follow; the next u is 0.4, too."""
    both = ql.Compensated(PID, ql.Compensator(OBSERVER))
    for _ in range(500):
        both.track(0.5, 0.5, 0.4)
    both.hand_over()
    assert both.step(0.5, 0.5) == pytest.approx(0.4, abs=1e-9)
    fresh = ql.Compensated(PID, ql.Compensator(OBSERVER))
    fresh.start(0.5, u=0.4)
    assert fresh.step(0.5, 0.5) == pytest.approx(0.4, abs=1e-6)


def test_a_missing_u_0_is_the_last_one_and_zero_before_the_first() -> None:
    """Not the last y, which has another unit."""
    compensator = ql.Compensator(OBSERVER)
    assert compensator.step(math.nan, 7.0) == 0.0
    assert compensator.estimate.status == Status.REFERENCE_HELD
    told = ql.Compensator(OBSERVER)
    told.step(0.0, 7.0)
    for each in (compensator, told):
        each.step(0.5, 7.0)
    assert compensator.step(math.nan, 7.0) == told.step(0.5, 7.0)
    compensator.reset()
    assert compensator.step(math.inf, -3.0) == 0.0


@cases(
    ("make", "message"),
    [
        (lambda: ql.Compensator(PID), "must be an ESO"),
        (lambda: ql.Compensator(OBSERVER, learner=ql.learners.Kalman()), "omega_c = None"),
        (
            lambda: ql.Compensator(
                OBSERVER,
                omega_c=1.0,
                learner=ql.learners.Kalman(),
                guard=ql.Guard(certified_for=PLANT),
            ),
            "certified_for bounds the loop of an ADRC",
        ),
        (
            lambda: ql.Compensator(
                ql.ESO.model_based(
                    ql.plants.LinearPlant([[0.0, 1.0], [0.0, -1.0]], [1.0, 4.0], [1.0, 0.0]),
                    omega_o=10.0,
                    dt=DT,
                    E=[0.0, 1.0],
                )
            ),
            "does not enter the plant where u does",
        ),
        (
            lambda: ql.Compensated(ql.ADRC(OBSERVER, 3.0), ql.Compensator(OBSERVER)),
            "has an observer",
        ),
        (
            lambda: ql.Compensated(PID, ql.Compensator(ql.ESO.model_free(2, 2.0, 30.0, 0.02))),
            "must be the same",
        ),
        (lambda: ql.Compensated(PID, ql.ADRC(OBSERVER, 3.0)), "must be a quell.Compensator"),
        (
            lambda: ql.Compensated(
                ql.controllers.Prefiltered(PID, ql.baselines.ZV(3.0)), ql.Compensator(OBSERVER)
            ),
            "put the prefilter in front of both",
        ),
        (
            lambda: ql.controllers.Prefiltered(ql.Compensator(OBSERVER), ql.baselines.ZV(3.0)),
            "takes u_0",
        ),
    ],
)
def test_what_does_not_go_together_is_refused_with_the_reason(make: Any, message: str) -> None:
    """And with what to do."""
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.trial
def test_a_tuned_compensator_keeps_the_bounds_of_the_whole_loop() -> None:
    """M_s, M_t and M_ks by ``analyse`` are those of the report, at the plant and where all its poles are elsewhere."""
    tuned = ql.tuning.tune_compensator(PLANT, PID)
    loop = ql.analysis.analyse(PLANT, tuned.controller)
    assert 1.0 / loop.margins.modulus == pytest.approx(tuned.details.after.m_s, rel=0.01)
    assert tuned.details.after.m_s <= 2.0
    assert loop.noise_to_control_peak <= 1.01 * 3.0 * tuned.details.before.m_ks
    assert tuned.details.after.iae < 0.3 * tuned.details.before.iae
    assert tuned.details.worth
    assert "NOT" not in str(tuned)
    for factor in (0.88, 1.2):
        den = [1.0, factor, 0.0]
        elsewhere = ql.analysis.analyse(([2.0 * factor**2], den), tuned.controller)
        assert 1.0 / elsewhere.margins.modulus <= 1.01 * tuned.details.after.m_s_elsewhere


@pytest.mark.trial
def test_a_tuned_compensator_is_judged_in_its_file(
    quell: Callable[..., Shown], tmp_path: Path
) -> None:
    """Its step is that of the written file, which has the delay of the command; overloads and NOT are in the report."""
    file = tmp_path / "axis.toml"
    file.write_text(
        """dt = 0.01
plant = { kind = "linear", num = [1.0], den = [1.0, 1.0, 0.0] }
observer = { kind = "model-free", order = 2, b0 = 1.0, omega_o = 10.0 }
controller = { kind = "pid", kp = 4.0, ki = 1.0, kd = 3.0, tf = 0.05, u_min = -2.0, u_max = 2.0 }
compensator = {}
scenario = { duration = 20.0, reference = { kind = "step", height = 0.3, at = 1.0 } }
""",
        encoding="utf-8",
    )
    out = tmp_path / "t.toml"
    shown = quell("tune", str(file), "--delay", "0.02", "--out", str(out), "--no-figures")
    assert shown.code == 0
    setup = load(out)
    assert setup.plant.order == 4
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    over = 100.0 * run.metrics(1.0)["overshoot"]
    assert f"step of the reference by 0.3 at 1 s: overshoots by {over:.1f} %" in shown.out
    assert "overload, a load of 1.4 times what u can hold" in shown.out
    assert "overload, a load" in out.read_text(encoding="utf-8")


@pytest.mark.trial
def test_the_integral_of_the_error_beside_a_gentle_controller_has_its_end() -> None:
    """A loop far slower than its plant: the report has what the simulation has, until y is at rest."""
    lags = ([1.0], [1.0, 3.0, 3.0, 1.0])
    gentle = ql.baselines.PID(kp=0.05, ki=0.05 / 3.0, kd=0.0, tf=0.2, dt=0.1)
    tuned = ql.tuning.tune_compensator(lags, gentle, speeds=(1.0, 1.0))
    scenario = ql.Scenario(disturbances=(1.0,), duration=1000.0)
    for law, iae in (
        (gentle, tuned.details.before.iae),
        (tuned.controller, tuned.details.after.iae),
    ):
        run = ql.simulate(ql.plants.LinearPlant.of(lags), law, scenario)
        assert iae == pytest.approx(0.1 * np.sum(np.abs(run["y"])), rel=1e-6)


@pytest.mark.trial
def test_the_integral_of_an_error_that_stays_is_without_end() -> None:
    """A PD controller leaves a constant error under a load, which no time ends; the compensator removes it."""
    pd = ql.baselines.PID(kp=4.0, ki=0.0, kd=3.0, tf=0.05, dt=0.01)
    tuned = ql.tuning.tune_compensator(([1.0], [1.0, 1.0, 0.0]), pd, speeds=(1.0, 1.0))
    assert tuned.details.before.iae == np.inf
    assert np.isfinite(tuned.details.after.iae)
    assert tuned.details.worth
    told = " ".join(str(tuned).split())
    assert "controller alone: ∫|y| inf, M_s" in told
    assert "leaves no constant error, which the controller alone leaves" in told
    assert tuned.to_json()["before"]["iae"] is None
    run = ql.simulate(
        ql.plants.LinearPlant.of(([1.0], [1.0, 1.0, 0.0])), tuned.controller,
        ql.Scenario(disturbances=(1.0,), duration=100.0),
    )  # fmt: skip
    assert tuned.details.after.iae == pytest.approx(0.01 * np.sum(np.abs(run["y"])), rel=1e-6)


@cases(
    ("controller", "options", "message"),
    [
        (
            PID,
            {"constraints": ql.tuning.Constraints(m_s=2.0, noise_std=1e-3)},
            "noise_std = 0.001: does not hold",
        ),
        (PID, {"constraints": ql.tuning.Constraints(damping=0.7)}, "constraints.damping = 0.7"),
        (PID, {"constraints": ql.tuning.Constraints(u_max=2.0)}, "constraints.u_max = 2.0"),
        (ql.ADRC(OBSERVER, 3.0), {}, "has an observer"),
        (None, {}, "must be a controller"),
        (PID, {"speeds": 0.9}, "speeds"),
        (PID, {"constraints": 3}, "constraints = 3: must be quell.tuning.Constraints"),
        (PID, {"speeds": (0.9, 1.0, 1.1)}, "speeds"),
        (PID, {"speeds": (0.0, 1.2)}, "must be a factor up to 1"),
    ],
)
def test_tuning_names_the_argument_that_is_wrong(
    controller: Any, options: dict[str, Any], message: str
) -> None:
    """A controller that can have no compensator is not one without margin."""
    with pytest.raises(ValueError, match=message):
        ql.tuning.tune_compensator(PLANT, controller, **options)


@pytest.mark.trial
def test_where_the_controller_uses_the_margin_itself_no_compensator_is_sold() -> None:
    """Below its own peak tuning refuses; a noise bound that leaves nothing makes the report say NOT."""
    peak = 1.0 / ql.analysis.analyse(PLANT, PID).margins.modulus
    below = ql.tuning.Constraints(m_s=0.99 * peak, m_t=None, damping=None)
    with pytest.raises(ValueError, match="can not give margin back"):
        ql.tuning.tune_compensator(PLANT, PID, constraints=below)
    noise = ql.analysis.analyse(PLANT, PID).noise_to_control_peak
    quiet = ql.tuning.Constraints(m_s=2.0, m_t=2.0, m_ks=1.001 * noise, damping=None)
    found = ql.tuning.tune_compensator(PLANT, PID, constraints=quiet)
    assert not found.details.worth
    assert "NOT worth a compensator" in str(found)
