"""Gains that follow signals, b0 that follows an estimate, and what they are certified for."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse, certify_online
from quell.controllers import LinearController, in_single_precision
from quell.controllers.baselines import PID, ZV
from quell.controllers.law import law_gains
from quell.setup import load
from quell.tuning.schedules import _points

from .cases import cases

DT = 1e-3
OBSERVER = ql.ESO.model_free(order=2, b0=2000.0, omega_o=200.0, dt=DT)
B0 = (5000.0, 1000.0, 500.0)
POINTS = (0.0, 0.4, 1.0)


def axis(inertia: float, viscous: float = 0.0) -> ql.plants.LinearPlant:
    """Return a rigid axis."""
    A = [[0.0, 1.0], [0.0, -viscous / inertia]]
    return ql.plants.LinearPlant(A, [0.0, 1.0 / inertia], [1.0, 0.0])


def controller(**tables: Any) -> ql.ADRC:
    """Return an ADRC with a schedule of an external signal."""
    return ql.ADRC(OBSERVER, 40.0, schedule=ql.Schedule(POINTS, **tables))


def run(law: Any, signals: Any = (), duration: float = 0.3, load: float = 0.2) -> ql.Trajectory:
    """Return a step of the reference and of the load on an axis."""
    w = (ql.signals.Step(at=0.5 * duration, height=load),)
    return ql.simulate(axis(1e-3), law, ql.Scenario(1.0, duration, w, schedule=signals))


@pytest.mark.parametrize("delay", [0.0, 2 * DT])
@pytest.mark.parametrize("form", ["current", "predictor"])
def test_at_a_fixed_signal_the_loop_is_that_of_the_gains_there(form: str, delay: float) -> None:
    """With b0, omega_c and omega_o from tables, at a point: as an ADRC that was designed with them."""
    observer = ql.ESO.model_free(2, 2000.0, 200.0, DT, form=form, delay=delay)
    tables = {"b0": B0, "omega_c": (30.0, 40.0, 50.0), "omega_o": (150.0, 200.0, 260.0)}
    law = ql.ADRC(observer, 40.0, schedule=ql.Schedule(POINTS, **tables))
    designed = ql.ESO.model_free(2, 1000.0, 200.0, DT, form=form, delay=delay)
    expected = run(ql.ADRC(designed, 40.0))
    for found in (run(law, (0.4,)), run(law.at(0.4))):
        np.testing.assert_allclose(found["u"], expected["u"], rtol=1e-7, atol=1e-9)
    ends = run(ql.ADRC(ql.ESO.model_free(2, 500.0, 260.0, DT, form=form, delay=delay), 50.0))
    for outside in (1.0, 7.0):
        np.testing.assert_allclose(run(law, (outside,))["u"], ends["u"], rtol=1e-7, atol=1e-9)


def test_b0_is_interpolated_as_an_inertia() -> None:
    """Between two points 1/b0 is linear, in ``at`` and in the running loop."""
    law = controller(b0=B0)
    assert 1.0 / law.at(0.2).observer.b0 == pytest.approx(0.5 * (1 / 5000.0 + 1 / 1000.0))
    np.testing.assert_allclose(run(law, (0.2,))["u"], run(law.at(0.2))["u"], rtol=1e-9, atol=1e-9)


def test_between_points_the_gains_are_those_of_a_bandwidth_within_two_percent() -> None:
    """Cells are divided where a bandwidth changes by more than a quarter: law and observer alike."""
    schedule = ql.Schedule((0.0, 1.0), omega_c=(20.0, 120.0), omega_o=(60.0, 300.0))
    law = ql.ADRC(OBSERVER, 40.0, schedule=schedule)
    design, state = law.parameters.schedule, law._state.schedule
    own = law_gains(2, 40.0)
    for signal in np.linspace(0.0, 1.0, 41):
        law.reset()
        law.set_signals(float(signal))
        law.step(0.0, 0.0)
        point = schedule.at((float(signal),), _point())
        np.testing.assert_allclose(
            own + state.values[: design.law], law_gains(2, point.omega_c), rtol=0.02
        )
        share = 1.0 - OBSERVER.model.gain[0]
        gain = OBSERVER.model.gain + share * state.values[design.law :]
        exact = ql.ESO.model_free(2, 1.0, point.omega_o, DT).model.gain
        np.testing.assert_allclose(gain, exact, rtol=0.03)


def _point() -> Any:
    from quell.controllers.schedule import Point

    return Point(OBSERVER.b0, 40.0, OBSERVER.omega_o)


@pytest.mark.trial
def test_u_does_not_jump_when_the_signal_jumps_at_rest_under_a_load() -> None:
    """A jump over all cells, of b0 by 10 and of the bandwidths, changes u by less than 1e-6 of the load's share."""
    tables = {"b0": B0, "omega_c": (30.0, 40.0, 60.0), "omega_o": (150.0, 200.0, 300.0)}
    law = controller(**tables)
    jump = ql.signals.Step(at=3.0, height=1.0)
    w = (ql.signals.Step(at=0.1, height=0.5),)
    found = ql.simulate(axis(5e-4), law, ql.Scenario(0.0, 3.02, w, schedule=(jump,)))
    late = found.t > 2.99
    assert law.at(0.0).observer.b0 == 5000.0
    assert found.final_state.schedule.loop[0].b0 == pytest.approx(500.0)
    np.testing.assert_allclose(found["u"][late], -0.5, atol=5e-7)


def test_in_an_acceleration_u_changes_by_the_torque_of_the_other_inertia() -> None:
    """What a jump of the signal adds is u_0, the wanted acceleration, times the change of 1/b0; the load adds nothing."""
    law = ql.ADRC(OBSERVER, 40.0, feedforward=True, schedule=ql.Schedule(POINTS, b0=B0))
    law.set_signals(0.4)
    for k in range(200):
        law.step(0.0, 0.5 * math.sin(0.02 * k), 0.0, 0.0)
    other = copy.deepcopy(law)
    other.set_signals(0.9)
    r, y = 0.3, 0.5 * math.sin(4.0)
    u, u_other = law.step(r, y, 2.0, 70.0), other.step(r, y, 2.0, 70.0)
    x, k = law.estimate.x, law.gains
    wanted = k[0] * (r - x[0]) + k[1] * (2.0 - x[1]) + 70.0
    more = 1.0 / other._state.schedule.loop[0].b0 - 1.0 / 1000.0
    assert abs(law.estimate.f) > 0.3 * abs(wanted)
    assert u_other - u == pytest.approx(wanted * more, rel=1e-9)


def test_before_its_first_signal_the_gains_are_those_of_the_controller() -> None:
    """And a signal that is no number is held; the status says both."""
    law, plain = controller(b0=B0), ql.ADRC(OBSERVER, 40.0)
    for k in range(20):
        assert law.step(1.0, 0.01 * k) == pytest.approx(plain.step(1.0, 0.01 * k), rel=1e-12)
        assert ql.Status.SCHEDULE_HELD in law.estimate.status
    law.set_signals(1.0)
    before = law.step(1.0, 0.2)
    assert ql.Status.SCHEDULE_HELD not in law.estimate.status
    other = copy.deepcopy(law)
    law.set_signals(math.nan)
    assert law.step(1.0, 0.2) == other.step(1.0, 0.2) != before
    assert ql.Status.SCHEDULE_HELD in law.estimate.status


def test_after_a_jump_the_cell_moves_by_one_in_a_sample() -> None:
    """So the time of a sample does not depend on the jump, and it arrives."""
    schedule = ql.Schedule(
        np.linspace(0.0, 1.0, 11).tolist(), b0=np.linspace(500, 1500, 11).tolist()
    )
    law = ql.ADRC(OBSERVER, 40.0, schedule=schedule)
    law.set_signals(0.0)
    law.step(0.0, 0.0)
    law.set_signals(0.95)
    cells = []
    for _ in range(12):
        law.step(0.0, 0.0)
        cells.append(int(law._state.schedule.first[0].cell))
    assert cells == [1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 9]
    assert law._state.schedule.loop[0].b0 == pytest.approx(law.at(0.95).observer.b0)


def test_two_signals_make_a_bilinear_table() -> None:
    """Of 1/b0, in ``at`` and in the running loop; one signal may be the loop's own."""
    points = ((0.0, 1.0), (-1.0, 0.0, 2.0))
    tables = {"b0": ((500.0, 800.0, 1000.0), (2000.0, 3000.0, 5000.0))}
    law = ql.ADRC(OBSERVER, 40.0, schedule=ql.Schedule(points, ("external", "y"), **tables))
    inverse = 1.0 / np.array(tables["b0"])
    expected = 0.75 * (0.5 * inverse[0, 1] + 0.5 * inverse[0, 2])
    expected += 0.25 * (0.5 * inverse[1, 1] + 0.5 * inverse[1, 2])
    assert 1.0 / law.at(0.25, 1.0).observer.b0 == pytest.approx(expected)
    law.set_signals(0.25)
    for _ in range(3):
        law.step(1.0, 1.0)
    assert 1.0 / law._state.schedule.loop[0].b0 == pytest.approx(expected)


def test_a_schedule_may_follow_the_loop_itself() -> None:
    """The reference, y and the estimated speed."""
    for signal, value in (("reference", 0.4), ("y", 0.4), ("speed", 0.0)):
        law = ql.ADRC(OBSERVER, 40.0, schedule=ql.Schedule((-1.0, 1.0), signal, (500.0, 2000.0)))
        for _ in range(5):
            law.step(0.4, 0.4)
        assert law._state.schedule.loop[0].b0 == pytest.approx(law.at(value).observer.b0)


@pytest.mark.parametrize("wrap", ["prefiltered", "compensated", "single"])
def test_wrappers_pass_the_signals_on(wrap: str) -> None:
    """At a fixed signal each is the same wrapper of the controller at this signal."""
    law: Any = controller(b0=B0)
    if wrap == "prefiltered":
        law = ql.controllers.Prefiltered(law, ZV(omega=60.0))
    elif wrap == "compensated":
        part = ql.Compensator(OBSERVER, schedule=ql.Schedule(POINTS, b0=B0))
        law = ql.Compensated(PID(kp=2.0, kd=0.05, tf=0.005, dt=DT), part)
    else:
        law = in_single_precision(law)
    tolerance = 1e-4 if wrap == "single" else 1e-9
    found, frozen = run(law, (0.2,)), run(law.at(0.2))
    np.testing.assert_allclose(found["u"], frozen["u"], rtol=tolerance, atol=50 * tolerance)


def test_a_compensator_with_another_b0_lets_u_0_through() -> None:
    """With no disturbance the control signal given is the one applied, at any b0 of the table."""
    part = ql.Compensator(OBSERVER, schedule=ql.Schedule(POINTS, b0=B0))
    part.set_signals(0.9)
    assert part.step(0.7, 0.0) == pytest.approx(0.7)


def test_feedforward_of_derivatives_follows_b0() -> None:
    """It feeds the torque of the inertia, r''/b0(σ)."""
    law = ql.ADRC(OBSERVER, 40.0, feedforward=True, schedule=ql.Schedule(POINTS, b0=B0))
    law.set_signals(1.0)
    assert law.step(0.0, 0.0, 0.0, 100.0) == pytest.approx(100.0 / 500.0)


@cases(
    "make",
    [
        lambda: ql.Schedule((0.0, 1.0)),
        lambda: ql.Schedule((0.0, 0.0), b0=(1.0, 2.0)),
        lambda: ql.Schedule((0.0, 1.0), b0=(1.0, -2.0)),
        lambda: ql.Schedule((0.0, 1.0), b0=(1.0, 2.0, 3.0)),
        lambda: ql.Schedule((0.0, 1.0), omega_c=(-1.0, -2.0)),
        lambda: ql.Schedule((0.0, 1.0), "torque", b0=(1.0, 2.0)),
        lambda: ql.Schedule((0.0, 1.0), ("y", "speed"), b0=(1.0, 2.0)),
        lambda: controller(b0=(-1.0, -2.0, -3.0)),
        lambda: ql.ADRC(OBSERVER, 40.0, held=ql.HeldPlant(), schedule=ql.OnlineGain(1e3, 3e3)),
        lambda: ql.ADRC(OBSERVER, 40.0, schedule=0.5),  # type: ignore[arg-type]
        lambda: ql.ADRC(
            OBSERVER, 40.0, learner=ql.learners.Kalman(), schedule=ql.OnlineGain(1e3, 3e3)
        ),
        lambda: ql.ADRC(
            ql.ESO.model_based(axis(5e-4, 1e-3), 200.0, DT), 40.0, learner=ql.learners.Kalman(),
            schedule=ql.Schedule(POINTS, b0=B0),
        ),
        lambda: ql.ADRC(
            OBSERVER, 40.0, learner=ql.learners.Kalman(), guard=ql.Guard(certified_for=axis(5e-4)),
            schedule=ql.Schedule(POINTS, b0=B0),
        ),
        lambda: ql.ADRC(
            OBSERVER, 40.0, learner=ql.learners.Kalman(), schedule=ql.Schedule(POINTS, omega_o=B0)
        ),
        lambda: ql.ADRC(
            OBSERVER, 40.0, feedforward=ql.Feedforward.rigid(1e-3), schedule=ql.OnlineGain(1e3, 3e3)
        ),
        lambda: ql.ADRC(
            ql.ESO.cascade(2, 1.0, 100.0, DT), 40.0, schedule=ql.Schedule(POINTS, omega_o=(50, 60, 70))
        ),
        lambda: ql.ADRC(
            ql.ESO.model_free(2, 1.0, 100.0, DT, form="reduced"),
            40.0,
            schedule=ql.Schedule(POINTS, omega_o=(50.0, 60.0, 70.0)),
        ),
        lambda: ql.ADRC(
            ql.ESO.model_free(1, 1.0, 100.0, DT), 40.0, schedule=ql.Schedule(POINTS, "speed", b0=B0)
        ),
        lambda: ql.Compensator(OBSERVER, schedule=ql.Schedule(POINTS, omega_c=B0)),
        lambda: run(controller(b0=B0)),
        lambda: run(ql.ADRC(OBSERVER, 40.0), (0.2,)),
        lambda: controller(b0=B0).set_signals(),
        lambda: controller(b0=B0).at(),
        lambda: ql.ADRC(OBSERVER, 40.0).at(0.2),
        lambda: analyse(axis(1e-3), controller(b0=B0)),
        lambda: controller(omega_c=(20.0, 30.0, 40.0)).retune(omega_c=20.0),
        lambda: controller(b0=B0).retune(observer=ql.ESO.model_free(2, 900.0, 200.0, DT)),
        lambda: ql.OnlineGain(2.0, 1.0),
        lambda: ql.OnlineGain(-1.0, 1.0),
        lambda: ql.OnlineGain(1.0, 2.0, tolerance=2.0),
        lambda: ql.ADRC(OBSERVER, 40.0, schedule=ql.OnlineGain(10.0, 20.0)),
        lambda: ql.Compensator(OBSERVER, schedule=ql.OnlineGain(1000.0, 3000.0)),
        lambda: ql.ADRC(OBSERVER, 40.0, schedule=ql.OnlineGain(1e3, 3e3, memory_time=1.0)),
        lambda: ql.ADRC(OBSERVER, 40.0).gain_estimate,
        lambda: certify_online(axis(1e-3), ql.ADRC(OBSERVER, 40.0)),
        lambda: ql.tune_schedule(lambda e: axis(1e-3 + e), DT),
        lambda: ql.tune_schedule({0.0: axis(1e-3), 1.0: axis(2e-3)}, DT, points=(0.0, 1.0)),
        lambda: ql.tune_schedule(lambda e: axis(1e-3), DT, points=(0.0, 1.0), structure="pid"),
        lambda: ql.tune_schedule(lambda e: axis(1e-3), DT, points=(0.0, 1.0), compare=("pi",)),
    ],
)  # fmt: skip
def test_what_can_not_be_scheduled_is_refused(make: Any) -> None:
    """With an error that says what to do."""
    with pytest.raises(
        ValueError, match=r"must|give|take|schedule|lower|needs|has no|follow|leave"
    ):
        make()


@pytest.mark.parametrize("signal", ["external", "y"])
def test_a_start_under_load_continues_from_u_at_any_b0(signal: str) -> None:
    """The observer settles with its own b0, and the first sample converts its estimate to that of the table."""
    tables = {"b0": B0, "omega_c": (30.0, 40.0, 60.0), "omega_o": (150.0, 200.0, 300.0)}
    law = ql.ADRC(OBSERVER, 40.0, schedule=ql.Schedule(POINTS, signal, **tables))
    if signal == "external":
        law.set_signals(0.9)
    law.start(y=0.9, u=0.4)
    u = [law.step(0.9, 0.9) for _ in range(100)]
    np.testing.assert_allclose(u, 0.4, atol=1e-9)
    assert law.estimate.f == pytest.approx(-0.4 * law.at(0.9).observer.b0)


def test_wrong_bits_of_a_restored_state_stay_within_the_table() -> None:
    """A cell far outside, as a broken file may have it, is the last one."""
    law = controller(b0=B0)
    law.set_signals(0.5)
    law.step(0.0, 0.0)
    state = law.state
    for cell in (-1e9, 1e9):
        state["schedule.first"] = np.array([0.5, cell])
        law.state = state
        for _ in range(3):
            assert math.isfinite(law.step(0.1, 0.0))
        assert law._state.schedule.loop[0].b0 == pytest.approx(law.at(0.5).observer.b0)


def test_other_bandwidths_than_those_of_the_tables_may_be_retuned_while_running() -> None:
    """Without a jump of u."""
    law = controller(b0=B0)
    law.set_signals(0.7)
    u = 0.0
    for _ in range(50):
        u = law.step(0.3, 0.3)
    law.retune(omega_c=60.0)
    assert law.step(0.3, 0.3) == pytest.approx(u, abs=1e-12)


def test_a_schedule_is_part_of_a_setup_file(tmp_path: Any) -> None:
    """Of a table over a signal and of an estimate; a misspelt key is an error."""
    text = """
dt = 0.001
plant = {{ kind = "linear", A = [[0.0, 1.0], [0.0, 0.0]], B = [0.0, 1000.0], C = [1.0, 0.0] }}
observer = {{ kind = "model-free", order = 2, b0 = 1000.0, omega_o = 200.0 }}
scenario = {{ duration = 0.4, reference = 1.0{signals} }}
[controller]
omega_c = 40.0
schedule = {schedule}
"""
    tables = {
        "{ points = [0.0, 1.0], b0 = [500.0, 2000.0] }": ", schedule = [0.3]",
        '{ points = [[0.0, 1.0], [0.0, 2.0]], signal = ["y", "speed"], omega_c = [[20.0, 30.0], [40.0, 50.0]] }': "",
        '{ kind = "online-gain", low = 500.0, high = 2000.0 }': "",
    }
    for table, signals in tables.items():
        file = tmp_path / "setup.toml"
        file.write_text(text.format(schedule=table, signals=signals))
        setup = load(file)
        found = ql.simulate(setup.plant, setup.controller, setup.scenario)
        assert abs(found["y"][-1] - 1.0) < 0.2
    file.write_text(text.format(schedule="{ point = [0.0, 1.0] }", signals=""))
    with pytest.raises(ValueError, match="point"):
        load(file)


@pytest.mark.trial
def test_the_exported_library_hands_its_signals_over(tmp_path: Any) -> None:
    """As the last arguments of a step, in the header and in both examples."""
    law = ql.ADRC(OBSERVER, 40.0, schedule=ql.Schedule(POINTS, b0=B0), u_min=-1.0, u_max=1.0)
    ql.export.c(law, tmp_path, name="arm", precision="single", accept=True)
    header = (tmp_path / "src" / "arm.h").read_text()
    assert "float arm_step(arm_state *state, float r, float y, float signal_1);" in header
    for example in ("README.md", "examples/arm/arm.ino"):
        text = (tmp_path / example).read_text()
        assert "reference, y, signal_1);" in text
        assert "float signal_1" in text


# ---- Tuning ----


@pytest.mark.trial
def test_a_quantile_is_that_of_all_points_together() -> None:
    """Of one table of b0; three tables have a tuning for each point, where it has no effect."""
    how = {"points": (1e-3, 2e-3), "between": 0, "quantile": 0.5}
    one = ql.tune_schedule(axis, DT, **how)
    assert one.details.joint.task.quantile == 0.5
    with pytest.raises(ValueError, match="quantile = 0.5: has no effect: there is one plant"):
        ql.tune_schedule(axis, DT, tables="all", **how)


@pytest.mark.trial
def test_a_tuned_schedule_keeps_the_constraints_at_and_between_its_points(tmp_path: Any) -> None:
    """On an axis with friction whose inertia changes by 5; the file that it writes runs."""
    bounds = ql.tuning.Constraints(resolution=6e-6)
    how = {"constraints": bounds, "u_min": -2.0, "u_max": 2.0, "delay": DT}
    tuned = ql.tune_schedule(lambda J: axis(J, 2e-4), DT, points=(4e-4, 2e-3), **how)
    points = tuned.details
    assert [at in points.own for at in points.loops] == [True, False, True]
    assert points.m_s <= 1.61
    assert max(each.measures["M_t"] for each in points.loops.values()) <= 1.61
    assert points.worst_ratio <= 1.15
    ratio = points.schedule.b0[0] / points.schedule.b0[1]
    assert ratio == pytest.approx(5.0, rel=1e-6)
    middle = analyse(axis(1.2e-3, 2e-4), tuned.design.controller.at(1.2e-3), delay=DT)
    _, between, _ = points.loops.values()
    assert 1.0 / middle.margins.modulus == pytest.approx(between.measures["M_s"])
    assert "NOT proved" in tuned.summary()
    tuned.save(tmp_path / "axis.toml")
    setup = load(tmp_path / "axis.toml")
    assert list(setup.controller.controller.schedule.b0) == points.schedule.b0
    assert setup.controller.prefilter == tuned.judged.prefilter
    assert not tuned.judged.failures
    found = ql.simulate(setup.plant, setup.controller, setup.scenario)
    assert ql.Status.DIVERGED not in found.status


@pytest.mark.trial
def test_of_plants_that_are_known_at_points_only_the_summary_says_so() -> None:
    """They are given as a mapping. Where they are a function, it tells where M_s is above its bound between them."""
    tuned = ql.tune_schedule({0.0: axis(1e-3), 1.0: axis(2e-3)}, DT)
    assert "NOT known between the points" in tuned.summary()
    assert len(tuned.designs) == 2
    few = ql.tune_schedule(lambda e: axis(2e-4 + 1.8e-3 * e**2), DT, points=(0.0, 1.0))
    m_s = few.details.loops[0.5,].measures["M_s"]
    assert m_s > 1.9
    assert f"NOT within M_s = 1.6: {m_s:.3f} at 0.5" in few.summary()


# ---- b0 online ----

MOVES = ql.signals.Repeated(
    ql.signals.SmoothMove(duration=0.1, distance=1.0)
    - 1.0 * ql.signals.SmoothMove(start=0.25, duration=0.1, distance=1.0),
    0.5,
)
ONLINE = ql.OnlineGain(500.0, 2000.0, memory_time=3.0)


def _online(b: float, load: Any, reference: Any = MOVES, duration: float = 8.0) -> Any:
    observer = ql.ESO.model_free(order=2, b0=1000.0, omega_o=200.0, dt=DT)
    law = ql.ADRC(observer, 40.0, schedule=ONLINE)
    found = ql.simulate(axis(1.0 / b, 2e-4), law, ql.Scenario(reference, duration, (load,)))
    return ONLINE.read(found.final_state.schedule)


@pytest.mark.trial
@pytest.mark.parametrize("b", [600.0, 1000.0, 1800.0])
def test_b0_follows_the_inertia_where_the_reference_moves(b: float) -> None:
    """Within 5 %, with friction and a constant load that a regression would take for the plant's."""
    found = _online(b, 0.02)
    assert found.is_excited
    assert found.b0 == pytest.approx(b, rel=0.05)
    assert abs(found.estimate - b) <= 3.0 * found.deviation


@pytest.mark.trial
def test_b0_stays_where_the_data_do_not_decide() -> None:
    """At rest under loads, however large, and where loads drown the motion."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 8.0, 0.05)
    loads = ql.signals.Samples(t, rng.uniform(-2.0, 2.0, t.size), hold="previous")
    for reference in (0.0, 0.02 * MOVES):
        found = _online(1800.0, loads, reference)
        assert not found.is_excited
        assert found.b0 == 1000.0


@pytest.mark.trial
def test_b0_stays_within_its_limits() -> None:
    """A plant outside of them leaves b0 at the end; the estimate tells."""
    found = _online(4000.0, 0.0)
    assert found.b0 == 2000.0
    assert found.estimate == pytest.approx(4000.0, rel=0.1)


@pytest.mark.trial
def test_the_certificate_is_that_of_the_loops_at_the_ends() -> None:
    """Stability and M_s of each b and b0 in the limits, found by ``analyse`` for plants of this b."""
    observer = ql.ESO.model_free(order=2, b0=1000.0, omega_o=200.0, dt=DT)
    law = ql.ADRC(observer, 40.0, schedule=ql.OnlineGain(700.0, 1400.0))
    certificate = certify_online(axis(1e-3), law)
    assert certificate.holds
    peaks = []
    for b in np.geomspace(700.0, 1400.0, 7):
        for b0 in np.geomspace(700.0, 1400.0, 7):
            loop = analyse(axis(1.0 / b), law.at(float(b0)))
            assert loop.stable
            peaks.append(1.0 / loop.margins.modulus)
    assert max(peaks) == pytest.approx(certificate.m_s, rel=1e-3)
    assert "certified" in str(certificate)


def test_limits_that_are_too_wide_are_not_certified() -> None:
    """And the ratio that is named is where a loop becomes unstable."""
    observer = ql.ESO.model_free(order=2, b0=1000.0, omega_o=200.0, dt=DT)
    law = ql.ADRC(observer, 40.0, schedule=ql.OnlineGain(100.0, 10000.0))
    certificate = certify_online(axis(1e-3), law)
    assert not certificate.holds
    assert str(certificate).startswith("NOT certified")
    plant = axis(1e-3)
    for factor, stable in ((1.02, False), (0.98, True)):
        low, high = certificate.stable
        ratio = high * factor if certificate.most == high else low / factor
        assert analyse(plant, law.at(1000.0 / ratio)).stable is stable


def test_a_linear_controller_has_no_schedule() -> None:
    """Only controllers with an observer have one: others take no such argument."""
    with pytest.raises(TypeError):
        LinearController(PID(kp=1.0, dt=DT).law, schedule=ONLINE)  # type: ignore[call-arg]


def test_plants_at_points_are_not_known_between_them_and_a_function_is() -> None:
    """The axes are sorted; keys may be numbers or pairs."""
    plants = {3.0: axis(3e-3), 1.0: axis(1e-3)}
    axes, at, between = _points(plants, None)
    assert (axes, at((3.0,)), between) == ([[1.0, 3.0]], plants[3.0], False)
    axes, at, between = _points(lambda e, m: (e, m), [[0.0, 1.0], [2.0, 5.0]])
    assert (axes, at((1.0, 5.0)), between) == ([[0.0, 1.0], [2.0, 5.0]], (1.0, 5.0), True)
