"""Tuned schedules and compensators, small: what their numbers must be, and what they say."""

from __future__ import annotations

import json
import math
import tomllib
from functools import cache
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.tuning import Constraints, TunedSchedule, tune_compensator
from quell.tuning.compensator import Measures, TunedCompensator
from quell.tuning.schedules import PointResult

DT = 0.05
HOW: dict[str, Any] = {"constraints": Constraints(m_ks=3.0), "objective": "load"}


def integrator(b: float) -> Any:
    """Return b/s."""
    return [b], [1.0, 0.0]


@cache
def scheduled() -> TunedSchedule:
    """Return a schedule for b of 1 and 4, judged at 2.5, too."""
    return ql.tune_schedule(integrator, DT, points=(1.0, 4.0), **HOW)


@cache
def point_by_point() -> TunedSchedule:
    """Return a schedule for the same plants, given at the points, with tables of all."""
    plants = {1.0: integrator(1.0), 4.0: integrator(4.0)}
    return ql.tune_schedule(plants, DT, tables="all", signal="y", **HOW)


@pytest.mark.trial
def test_a_table_of_b0_is_in_proportion_to_the_gain_and_leaves_one_loop() -> None:
    """L is the same at both points, so y after a load is as large as the gain."""
    found = scheduled()
    assert found.schedule.b0[1] == pytest.approx(4.0 * found.schedule.b0[0], rel=1e-12)
    first, middle, last = found.results
    assert [each.signals for each in found.results] == [(1.0,), (2.5,), (4.0,)]
    assert [each.of_table for each in found.results] == [True, False, True]
    assert last.m_s == pytest.approx(first.m_s, rel=1e-6)
    assert last.m_t == pytest.approx(first.m_t, rel=1e-6)
    assert last.iae == pytest.approx(4.0 * first.iae, rel=1e-6)
    # 1/b0 is interpolated.
    assert 1.0 / middle.b0 == pytest.approx(0.5 / first.b0 + 0.5 / last.b0, rel=1e-12)
    assert [first.b0, last.b0] == pytest.approx(found.schedule.b0, rel=1e-12)
    own = ql.tune(integrator(1.0), DT, structure="bandwidths", order=1, compare=(), **HOW)
    assert first.own_iae == pytest.approx(own.design.measures["iae"], rel=1e-4)
    assert first.ratio == pytest.approx(1.0, rel=1e-3)


def test_frozen_loops_are_those_of_a_controller_for_that_plant() -> None:
    """Between the points, with the interpolated b0: M_s and the area after a load by ``analyse``."""
    found = scheduled()
    middle, design = found.results[1], found.controller
    observer = ql.ESO.model_free(1, middle.b0, design.observer.omega_o, DT)
    loop = analyse(integrator(2.5), ql.ADRC(observer, design.omega_c))
    assert middle.m_s == pytest.approx(1.0 / loop.margins.modulus, rel=1e-9)
    y = loop.closed_loop("d", "y")
    A, x, area = np.eye(y.N.shape[0]) + y.N, np.zeros(y.B.size), 0.0
    for _ in range(2000):
        area += DT * abs(float(y.C @ x))
        x = A @ x + y.B
    assert middle.iae == pytest.approx(area, rel=1e-6)
    assert found.worst_ratio == max(each.iae / each.own_iae for each in found.results)
    assert found.m_s == max(each.m_s for each in found.results)


def test_tables_of_all_are_the_tuning_of_each_point() -> None:
    """What is the same at all points, omega_o at its limit, is no table; nothing is known between."""
    found = point_by_point()
    schedule = found.schedule
    for i, (at, own) in enumerate(found.own.items()):
        assert at == ((1.0,), (4.0,))[i]
        assert schedule.b0[i] == own.controller.observer.b0
        assert schedule.omega_c[i] == own.controller.omega_c
        assert found.results[i].ratio == pytest.approx(1.0, rel=1e-9)
        assert found.results[i].m_s == pytest.approx(own.design.measures["M_s"], rel=1e-3)
    assert schedule.omega_o is None
    assert found.controller.observer.omega_o == pytest.approx(0.5 / DT)
    assert found.controller.observer.b0 == schedule.b0[1]
    assert found.joint is None
    assert (found.knows_between, scheduled().knows_between) == (False, True)
    lines = found.verdicts()
    assert lines[0] == f"largest M_s {found.m_s:.3f}, largest ratio of ∫|y| 1.000"
    assert lines[1].startswith("NOT known between the points: the plant is given there only")
    assert lines[2].startswith("NOT proved for signals that change quickly")
    assert len(lines) == 3


def test_a_schedule_says_where_it_is_worse_and_where_it_leaves_its_bounds() -> None:
    """One pair of bandwidths costs up to 11 times; a frozen loop beyond M_s is named with its place."""
    found = scheduled()
    assert found.worst_ratio > 2.0
    assert [line.split(":")[0] for line in found.verdicts()[1:]] == [
        "NOT as good as the own tuning at each point, which needs other bandwidths there, too",
        "NOT proved for signals that change quickly",
    ]
    loops = (
        PointResult((0.0,), True, 1.0, 1.60, 1.2, 2.0, 2.0),
        PointResult((0.5,), False, 1.5, 1.69, 1.2, 2.0, math.nan),
        PointResult((1.0,), True, 2.0, 1.67, 1.2, 2.0, 2.0),
    )
    other = TunedSchedule(found.controller, loops, found.own, found.joint, True)
    assert (other.m_s, other.worst_ratio) == (1.69, 1.0)
    (line,) = [each for each in other.verdicts() if each.startswith("NOT within")]
    assert line.startswith("NOT within M_s = 1.6: 1.690 at 0.5, where the plant is not that of")
    assert not any(each.startswith("NOT as good") for each in other.verdicts())
    slow = tuple(each._replace(iae=3.0) for each in loops)
    alone = TunedSchedule(found.controller, slow, found.own, None, True)
    assert alone.worst_ratio == 1.5
    assert not any(each.startswith("NOT as good") for each in alone.verdicts())
    rows = other.rows()
    assert rows[0] == ("at 0", "1", "1.600", "1.200", "2", "1.000")
    assert rows[1] == ("between, at 0.5", "1.5", "1.690", "1.200", "2", "nan")
    text = found.summary().splitlines()
    assert text[1].startswith("at 1: b0 ")
    assert text[2].startswith("between, at 2.5: b0 ")
    assert text[-1] == found.verdicts()[-1]


def test_the_files_of_a_schedule_have_its_tables_and_a_signal_for_the_run() -> None:
    """TOML of the middle point with an external signal there; JSON with each loop."""
    found = scheduled()
    tables = tomllib.loads(found.toml())
    assert tables["controller"]["schedule"] == {
        "signal": "external",
        "points": [1.0, 4.0],
        "b0": list(found.schedule.b0),
    }
    assert tables["controller"]["omega_c"] == found.controller.omega_c
    assert tables["observer"]["b0"] == found.schedule.b0[1]
    assert tables["observer"]["omega_o"] == found.controller.observer.omega_o
    assert tables["scenario"]["schedule"] == [4.0]
    assert tables["plant"]["B"] == [4.0]
    other = tomllib.loads(point_by_point().toml())
    assert "schedule" not in other["scenario"]
    assert other["controller"]["schedule"]["omega_c"] == list(point_by_point().schedule.omega_c)
    assert other["controller"]["schedule"]["signal"] == "y"
    shown = json.loads(json.dumps(found.to_json()))
    assert [each["signals"] for each in shown["loops"]] == [[1.0], [2.5], [4.0]]
    assert [each["ratio"] for each in shown["loops"]] == [each.ratio for each in found.results]
    assert shown["schedule"]["points"] == [1.0, 4.0]
    assert shown["schedule"]["omega_c"] is None
    assert shown["structure"] == "bandwidths of order 1"
    assert (shown["m_s"], shown["worst_ratio"]) == (found.m_s, found.worst_ratio)
    assert [each["signals"] for each in shown["own"]] == [[1.0], [4.0]]
    assert shown["dt"] == DT
    assert shown["knows_between"] is True


def test_the_plot_of_a_schedule_has_a_line_of_each_quantity_and_filled_points() -> None:
    """b0, M_s with its bound, and the ratio over the signal."""
    figure, given = plt.subplots(3)
    found = scheduled()
    axes = found.plot(given)
    for ax, name in zip(axes, ("b0", "m_s", "ratio"), strict=True):
        x, y = ax.lines[0].get_data()
        assert list(x) == [1.0, 2.5, 4.0]
        assert list(y) == [getattr(each, name) for each in found.results]
        assert list(ax.lines[1].get_xdata()) == [1.0, 4.0]
    assert axes[1].lines[2].get_ydata()[0] == 1.6
    assert axes[2].get_xlabel() == "external signal"
    plt.close(figure)


# ---- compensators


@cache
def compensated() -> TunedCompensator:
    """Return the compensator for an integrator with a PI controller."""
    pid = ql.baselines.PID(kp=2.0, ki=0.5, dt=DT)
    return tune_compensator(integrator(1.0), pid)


def test_the_figures_of_the_controller_alone_are_those_of_closed_forms() -> None:
    """As y after a load has one sign: ∫|y| is 1/k_i; M_ks is asked for three times."""
    before = compensated().before
    assert before.iae == pytest.approx(1.0 / 0.5, rel=1e-6)
    omega = np.geomspace(1e-3, math.pi / DT * 0.9999, 4000)
    s = 2j / DT * np.tan(0.5 * omega * DT)
    C, P = 2.0 + 0.5 / s, DT / (np.exp(1j * omega * DT) - 1.0)
    S = 1.0 / (1.0 + P * C)
    assert before.m_s == pytest.approx(float(np.max(np.abs(S))), rel=1e-3)
    assert before.m_t == pytest.approx(float(np.max(np.abs(1.0 - S))), rel=1e-3)
    assert before.m_ks == pytest.approx(float(np.max(np.abs(C * S))), rel=1e-3)
    assert compensated().constraints.m_ks == pytest.approx(3.0 * before.m_ks)
    assert (compensated().constraints.m_s, compensated().constraints.m_t) == (2.0, 2.0)
    # At other speeds b/s has 0.88 and 1.2 times the gain.
    fast = 1.0 / (1.0 + 1.2 * P * C)
    assert before.m_s_elsewhere == pytest.approx(float(np.max(np.abs(fast))), rel=1e-3)


def test_with_the_compensator_the_loop_keeps_its_bounds_and_leaves_a_tenth_of_a_load() -> None:
    """Figures by ``analyse``; the bound of noise is used up; the responses shown have these areas."""
    found = compensated()
    loop = analyse(integrator(1.0), found.controller)
    assert found.after.m_s == pytest.approx(1.0 / loop.margins.modulus, rel=1e-3)
    assert found.after.m_ks == pytest.approx(loop.noise_to_control_peak, rel=1e-3)
    assert 0.95 <= found.after.m_ks / found.constraints.m_ks <= 1.0
    for y, measures in zip(found.loads, (found.before, found.after), strict=True):
        assert found.loads_dt * np.sum(np.abs(y)) == pytest.approx(measures.iae, rel=2e-3)
    assert found.worth
    assert found.after.iae < 0.1 * found.before.iae
    lines = str(found).splitlines()
    assert lines[0].startswith("Compensator with a model-free (order 1) observer, omega_o = ")
    assert lines[1].startswith("controller alone: M_s 1.05 (1.06 at other speeds of the plant)")
    assert lines[3].startswith(f"a load leaves {found.after.iae / found.before.iae:.3g} of what")
    assert lines[4].startswith("conditionally stable: it bears ")
    assert len(lines) == 5
    tables = tomllib.loads(found.toml)
    observer = found.compensator.observer
    assert tables["observer"]["kind"] == "model-free"
    assert tables["observer"]["b0"] == pytest.approx(observer.b0)
    assert tables["observer"]["omega_o"] == pytest.approx(observer.omega_o)
    assert tables["compensator"] == {}
    shown = found.to_json()
    assert shown["worth"] is True
    assert shown["before"]["iae"] == found.before.iae
    assert shown["observer"] == "model-free (order 1)"


def test_a_compensator_that_removes_less_than_a_twentieth_is_not_worth_it() -> None:
    """96 % left is not, 95 % is; an error that stays has no end."""
    one = compensated()
    parts = {name: getattr(one, name) for name in one.__dataclass_fields__}
    for left, worth in ((0.96, False), (0.95, True), (0.5, True)):
        after = Measures(1.5, 1.2, 4.0, left, 1.6)
        found = TunedCompensator(
            **{**parts, "before": one.before._replace(iae=1.0), "after": after}
        )
        assert found.worth is worth
        assert ("NOT worth a compensator" in str(found)) is not worth
    stays = one.before._replace(iae=math.inf)
    found = TunedCompensator(**{**parts, "before": stays})
    assert "∫|y| without end: y stays off under a load" in str(found)
    assert "a load leaves no constant error, which the controller alone leaves" in str(found)
    assert found.to_json()["before"]["iae"] is None


def test_the_plot_of_a_compensator_ends_where_y_has_come_to_rest() -> None:
    """Two lines over time, up to one sample after the last beyond 2 % of the largest."""
    figure, ax = plt.subplots()
    found = compensated()
    lines = found.plot(ax).lines
    for line, y in zip(lines, found.loads, strict=True):
        shown = line.get_ydata()
        assert np.array_equal(shown, y[: shown.size])
        top = np.max(np.abs(y))
        assert np.all(np.abs(y[shown.size :]) <= 0.02 * top)
        assert abs(shown[-2]) > 0.02 * top
        assert line.get_xdata()[1] == found.loads_dt
    plt.close(figure)


@pytest.mark.parametrize(
    ("controller", "options", "message"),
    [
        ({"kp": -1.0}, {}, "its loop with the plant is unstable"),
        ({"kp": 2.0}, {"speeds": (0.9, 0.95)}, "must be a factor up to 1 and one from 1 on"),
        ({"kp": 2.0}, {"load": 0.0}, "load = 0.0"),
        ({"kp": 2.0}, {"constraints": Constraints(m_s=1.04, damping=None)}, "can not give margin"),
        ({"kp": 2.0}, {"constraints": Constraints(u_max=1.0, damping=None)}, "constraints.u_max"),
    ],
)
def test_a_compensator_that_can_not_be_tuned_is_refused(
    controller: Any, options: Any, message: str
) -> None:
    """An unstable loop, speeds on one side, no load, bounds that the controller itself exceeds."""
    pid = ql.baselines.PID(**controller, dt=DT)
    with pytest.raises(ValueError, match=message):
        tune_compensator(integrator(1.0), pid, **options)
