"""Tuned schedules and compensators, small: what their numbers must be, and what they say."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import replace
from functools import cache
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.tuning import Constraints, OnTop, Tuned, tune_compensator
from quell.tuning.compensator import Measures

DT = 0.05
HOW: dict[str, Any] = {"constraints": Constraints(m_ks=3.0), "objective": "load"}


def integrator(b: float) -> Any:
    """Return b/s."""
    return [b], [1.0, 0.0]


@cache
def scheduled() -> Tuned:
    """Return a schedule for b of 1 and 4, judged at 2.5, too."""
    return ql.tune_schedule(integrator, DT, points=(1.0, 4.0), **HOW)


@cache
def point_by_point() -> Tuned:
    """Return a schedule for the same plants, given at the points, with tables of all."""
    plants = {1.0: integrator(1.0), 4.0: integrator(4.0)}
    return ql.tune_schedule(plants, DT, tables="all", signal="y", **HOW)


@pytest.mark.trial
def test_a_table_of_b0_is_in_proportion_to_the_gain_and_leaves_one_loop() -> None:
    """L is the same at both points, so y after a load is as large as the gain."""
    found = scheduled()
    points = found.details
    assert points.schedule.b0[1] == pytest.approx(4.0 * points.schedule.b0[0], rel=1e-12)
    first, middle, last = (each.measures for each in found.designs.values())
    assert [*points.loops] == [(1.0,), (2.5,), (4.0,)]
    assert [*points.own] == [(1.0,), (4.0,)]
    assert last["M_s"] == pytest.approx(first["M_s"], rel=1e-6)
    assert last["M_t"] == pytest.approx(first["M_t"], rel=1e-6)
    assert last["iae"] == pytest.approx(4.0 * first["iae"], rel=1e-6)
    # 1/b0 is interpolated.
    assert 1.0 / middle["b0"] == pytest.approx(0.5 / first["b0"] + 0.5 / last["b0"], rel=1e-12)
    assert [first["b0"], last["b0"]] == pytest.approx(points.schedule.b0, rel=1e-12)
    own = ql.tune(integrator(1.0), DT, structure="bandwidths", order=1, compare=(), **HOW)
    assert first["alone"] == pytest.approx(own.design.measures["iae"], rel=1e-4)
    assert points.ratios[1.0,] == pytest.approx(1.0, rel=1e-3)


def test_frozen_loops_are_those_of_a_controller_for_that_plant() -> None:
    """Between the points, with the interpolated b0: M_s and the area after a load by ``analyse``."""
    found = scheduled()
    points, design = found.details, found.controller
    middle = points.loops[2.5,].measures
    observer = ql.ESO.model_free(1, middle["b0"], design.observer.omega_o, DT)
    loop = analyse(integrator(2.5), ql.ADRC(observer, design.omega_c))
    assert middle["M_s"] == pytest.approx(1.0 / loop.margins.modulus, rel=1e-9)
    y = loop.closed_loop("d", "y")
    A, x, area = np.eye(y.N.shape[0]) + y.N, np.zeros(y.B.size), 0.0
    for _ in range(2000):
        area += DT * abs(float(y.C @ x))
        x = A @ x + y.B
    assert middle["iae"] == pytest.approx(area, rel=1e-6)
    every = [each.measures for each in points.loops.values()]
    assert points.worst_ratio == max(each["iae"] / each["alone"] for each in every)
    assert points.m_s == max(each["M_s"] for each in every)


def test_tables_of_all_are_the_tuning_of_each_point() -> None:
    """What is the same at all points, omega_o at its limit, is no table; nothing is known between."""
    found = point_by_point()
    points = found.details
    schedule = points.schedule
    for i, (at, own) in enumerate(points.own.items()):
        assert at == ((1.0,), (4.0,))[i]
        assert schedule.b0[i] == own.controller.observer.b0
        assert schedule.omega_c[i] == own.controller.omega_c
        assert points.ratios[at] == pytest.approx(1.0, rel=1e-9)
        assert points.loops[at].measures["M_s"] == pytest.approx(
            own.design.measures["M_s"], rel=1e-3
        )
    assert schedule.omega_o is None
    assert found.controller.observer.omega_o == pytest.approx(0.5 / DT)
    assert found.controller.observer.b0 == schedule.b0[1]
    assert points.joint is None
    assert (points.knows_between, scheduled().details.knows_between) == (False, True)
    lines = found.verdicts()
    assert lines.pop(0).startswith("active: M_ks at 1 = 3 (limit 3), ")
    assert lines[0] == f"largest M_s {points.m_s:.3f}, largest ratio of ∫|y| 1.000"
    assert lines[1].startswith("NOT known between the points: the plant is given there only")
    assert lines[2].startswith("NOT proved for signals that change quickly")
    assert len(lines) == 3


def test_a_schedule_says_where_it_is_worse_and_where_it_leaves_its_bounds() -> None:
    """One pair of bandwidths costs up to 11 times; a frozen loop beyond M_s is named with its place."""
    found = scheduled()
    assert found.details.worst_ratio > 2.0
    assert [line.split(":")[0] for line in found.verdicts()[2:]] == [
        "NOT as good as the own tuning at each point, which needs other bandwidths there, too",
        "NOT proved for signals that change quickly",
    ]

    def with_loops(*figures: tuple[float, float, float, float]) -> Tuned:
        """Return the result with loops of other M_s, integrals, those alone and b0."""
        loops = {}
        for at, values in zip((0.0, 0.5, 1.0), figures, strict=True):
            names = ("M_s", "iae", "alone", "b0")
            measures = {"M_t": 1.2, **dict(zip(names, values, strict=True))}
            name = f"{'between, ' * (at == 0.5)}at {at:g}"
            loops[at,] = replace(found.design, name=name, objective=math.nan, measures=measures)
        points = replace(found.details, loops=loops)
        return replace(found, details=points, designs={each.name: each for each in loops.values()})

    other = with_loops((1.6, 2.0, 2.0, 1.0), (1.69, 2.0, math.nan, 1.5), (1.67, 2.0, 2.0, 2.0))
    assert (other.details.m_s, other.details.worst_ratio) == (1.69, 1.0)
    (line,) = [each for each in other.verdicts() if each.startswith("NOT within")]
    assert line.startswith("NOT within M_s = 1.6: 1.690 at 0.5, where the plant is not that of")
    assert not any(each.startswith("NOT as good") for each in other.verdicts())
    alone = with_loops(*((1.6, 3.0, 2.0, 1.0) for _ in range(3)))
    alone = replace(alone, details=replace(alone.details, joint=None))
    assert alone.details.worst_ratio == 1.5
    assert not any(each.startswith("NOT as good") for each in alone.verdicts())
    headings, rows = replace(other, objective="load-iae").rows()
    assert headings[-4:] == ["M_s", "M_t", "over that alone", "b0"]
    assert rows[0][-5:] == ["1.600", "1.200", "1.000", "1", ""]
    assert rows[1][-5:] == ["1.690", "1.200", "–", "1.5", ""]
    text = found.summary().splitlines()
    assert text[1].startswith("at 1: IAE ")
    assert text[2].startswith("between, at 2.5: IAE ")
    assert text[-1] == found.verdicts()[-1]


def test_the_files_of_a_schedule_have_its_tables_and_a_signal_for_the_run() -> None:
    """TOML of the middle point with an external signal there; JSON with each loop."""
    found = scheduled()
    tables = tomllib.loads(found.toml())
    assert tables["controller"]["schedule"] == {
        "signal": "external",
        "points": [1.0, 4.0],
        "b0": list(found.details.schedule.b0),
    }
    assert tables["controller"]["omega_c"] == found.controller.omega_c
    assert tables["observer"]["b0"] == found.details.schedule.b0[1]
    assert tables["observer"]["omega_o"] == found.controller.observer.omega_o
    assert tables["scenario"]["schedule"] == [4.0]
    assert tables["plant"]["B"] == [4.0]
    other = tomllib.loads(point_by_point().toml())
    assert "schedule" not in other["scenario"]
    assert other["controller"]["schedule"]["omega_c"] == list(
        point_by_point().details.schedule.omega_c
    )
    assert other["controller"]["schedule"]["signal"] == "y"
    shown = json.loads(json.dumps(found.to_json()))
    assert [*shown["designs"]] == ["at 1", "between, at 2.5", "at 4"]
    for name, each in found.designs.items():
        assert shown["designs"][name]["measures"] == each.measures
    assert shown["schedule"]["points"] == [1.0, 4.0]
    assert shown["schedule"]["omega_c"] is None
    assert shown["structure"] == "bandwidths of order 1 with a schedule"
    points = found.details
    assert (shown["m_s"], shown["worst_ratio"]) == (points.m_s, points.worst_ratio)
    assert [each["signals"] for each in shown["own"]] == [[1.0], [4.0]]
    assert shown["dt"] == DT
    assert shown["knows_between"] is True


def test_the_plot_of_a_schedule_has_a_line_of_each_quantity_and_filled_points() -> None:
    """b0, M_s with its bound, and the ratio over the signal."""
    figure, given = plt.subplots(3)
    found = scheduled()
    axes = found.plot(given)
    figures = [[each.measures[name] for each in found.designs.values()] for name in ("b0", "M_s")]
    for ax, values in zip(axes, [*figures, [*found.details.ratios.values()]], strict=True):
        x, y = ax.lines[0].get_data()
        assert list(x) == [1.0, 2.5, 4.0]
        assert list(y) == values
        assert list(ax.lines[1].get_xdata()) == [1.0, 4.0]
    assert axes[1].lines[2].get_ydata()[0] == 1.6
    assert axes[2].get_xlabel() == "external signal"
    plt.close(figure)


# ---- compensators


@cache
def compensated() -> Tuned:
    """Return the compensator for an integrator with a PI controller."""
    pid = ql.baselines.PID(kp=2.0, ki=0.5, dt=DT)
    return tune_compensator(integrator(1.0), pid)


def test_the_figures_of_the_controller_alone_are_those_of_closed_forms() -> None:
    """As y after a load has one sign: ∫|y| is 1/k_i; M_ks is asked for three times."""
    before = compensated().details.before
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
    assert found.details.after.m_s == pytest.approx(1.0 / loop.margins.modulus, rel=1e-3)
    assert found.details.after.m_ks == pytest.approx(loop.noise_to_control_peak, rel=1e-3)
    assert 0.95 <= found.details.after.m_ks / found.constraints.m_ks <= 1.0
    for y, measures in zip(
        found.details.loads, (found.details.before, found.details.after), strict=True
    ):
        assert found.details.loads_dt * np.sum(np.abs(y)) == pytest.approx(measures.iae, rel=2e-3)
    assert found.details.worth
    assert found.details.after.iae < 0.1 * found.details.before.iae
    lines = str(found).splitlines()
    assert lines[0] == "Tuned with compensator:"
    assert lines[2].startswith("controller alone: ∫|y| 2, M_s 1.053, at other speeds 1.064, ")
    assert lines[3].startswith("with compensator: ∫|y| ")
    left = found.details.after.iae / found.details.before.iae
    assert lines[5].startswith(f"model-free (order 1) observer: a load leaves {left:.3g} of what")
    assert lines[6].startswith("conditionally stable: it bears ")
    assert len(lines) == 7
    tables = tomllib.loads(found.toml())
    observer = found.controller.compensator.observer
    assert tables["observer"]["kind"] == "model-free"
    assert tables["observer"]["b0"] == pytest.approx(observer.b0)
    assert tables["observer"]["omega_o"] == pytest.approx(observer.omega_o)
    assert tables["compensator"] == {}
    shown = found.to_json()
    assert shown["worth"] is True
    assert shown["before"]["iae"] == found.details.before.iae
    assert shown["observer"] == "model-free (order 1)"


def test_a_compensator_that_removes_less_than_a_twentieth_is_not_worth_it() -> None:
    """96 % left is not, 95 % is; an error that stays has no end."""
    one: OnTop = compensated().details
    for left, worth in ((0.96, False), (0.95, True), (0.5, True)):
        after = Measures(1.5, 1.2, 4.0, left, 1.6)
        found = replace(one, before=one.before._replace(iae=1.0), after=after)
        assert found.worth is worth
        told = found.lines(compensated())
        assert any("NOT worth a compensator" in line for line in told) is not worth
    found = replace(one, before=one.before._replace(iae=math.inf))
    (told,) = found.lines(compensated())
    assert "a load leaves no constant error, which the controller alone leaves" in told
    shown = replace(compensated(), details=found).to_json()
    assert shown["before"]["iae"] is None


def test_the_plot_of_a_compensator_ends_where_y_has_come_to_rest() -> None:
    """Two lines over time, up to one sample after the last beyond 2 % of the largest."""
    figure, ax = plt.subplots()
    found = compensated()
    lines = found.plot(ax)[0].lines
    for line, y in zip(lines, found.details.loads, strict=True):
        shown = line.get_ydata()
        assert np.array_equal(shown, y[: shown.size])
        top = np.max(np.abs(y))
        assert np.all(np.abs(y[shown.size :]) <= 0.02 * top)
        assert abs(shown[-2]) > 0.02 * top
        assert line.get_xdata()[1] == found.details.loads_dt
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
