"""Loops of several axes at a set of operating points: the worst is told, and what was not looked at."""

from __future__ import annotations

import json

import numpy as np
import pytest

import quell as ql
from quell.analysis import LoopsAtPoints, analyse, analyse_points
from quell.plants.linearise import held_at

from .cases import cases

POSES = [[0.2, q, 0.0, 0.0] for q in (0.3, 1.5, 3.0)]


def axes(robot: ql.plants.Arm, constant: bool = False) -> ql.Axes:
    """Return the axes of an arm, with M(q) or that of the second pose."""
    joint = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3), omega_c=8.0)
    return ql.Axes([joint, joint], M=robot.mass_matrix([0.2, 1.5]) if constant else robot.inertia)


def analysed(constant: bool, points: list[list[float]]) -> LoopsAtPoints:
    """Return the loops of an arm without gravity."""
    robot = ql.plants.arm(gravity=0.0, viscous=0.1)
    return analyse_points(robot, axes(robot, constant), points)


@pytest.mark.trial
def test_the_worst_point_is_that_of_single_analyses() -> None:
    """With a constant M the pose in which it is wrong is the worst one, by disk margin and by M_s of a channel."""
    robot = ql.plants.arm(gravity=0.0, viscous=0.1)
    found = analysed(True, POSES)
    singles = [
        analyse(robot, axes(robot, True), (pose, [0.0, 0.0])).disk_margin("outputs").alpha
        for pose in POSES
    ]
    assert found.disk_margin("outputs") == pytest.approx((min(singles), int(np.argmin(singles))))
    value, name, point = found.channel_m_s()
    assert value == pytest.approx(1.0 / found.loops[point].channel_margins(name).modulus)
    assert point in (0, 2)
    assert f"worst of 3 points: M_s {value:.3f} of {name}" in found.summary()


@pytest.mark.trial
def test_b0_as_a_function_keeps_the_margins_at_all_points() -> None:
    """M(q) decouples each pose, so that the worst is hardly worse than the best; a constant M loses half."""
    margins = [analysed(constant, POSES).disk_margin("inputs")[0] for constant in (False, True)]
    assert margins[0] > 0.8
    assert margins[1] < 0.5


@pytest.mark.trial
def test_what_was_not_looked_at_is_told() -> None:
    """One point of a B0 that is a function begins with NOT, several do not; a constant B0 has no such line."""
    robot = ql.plants.arm(gravity=0.0, viscous=0.1)
    line = "NOT judged away from this point, where B0 is another: give several points"
    assert line in analysed(False, POSES[:1]).verdicts()
    assert line not in analysed(False, POSES).verdicts()
    assert "NOT proved between the points and in fast motion" in analysed(False, POSES).summary()
    assert not any(each.startswith("NOT") for each in analysed(True, POSES[1:2]).verdicts())
    one = analyse(robot, axes(robot), (POSES[0], [0.0, 0.0]))
    assert one.summary().splitlines()[-1].startswith("NOT judged at other operating points")
    constant = analyse(robot, axes(robot, True), (POSES[0], [0.0, 0.0]))
    assert "NOT" not in constant.summary()


def test_an_unstable_point_is_named() -> None:
    """The number of the point, from 1; margins of it are zero."""
    robot = ql.plants.arm(gravity=0.0, viscous=0.1)
    joint = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3), omega_c=8.0)
    wrong = ql.Axes([joint, joint], M=8.0 * robot.mass_matrix([0.2, 0.3]))
    found = analyse_points(robot, wrong, [POSES[0]])
    assert not found.stable
    assert found.disk_margin("inputs") == (0.0, 0)
    assert "NOT stable at point 1" in found.summary()
    assert json.loads(json.dumps(found.to_json()))["points"][0]["m_s"] is None


@pytest.mark.trial
def test_a_load_that_is_held_is_told_where_it_moves_the_margins() -> None:
    """Slow axes of an arm that gravity pulls: B0 changes under the load. Without gravity nothing is held."""
    robot = ql.plants.arm(viscous=0.1)
    slow = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=25.0, dt=1e-3), omega_c=8.0)
    found = analyse_points(robot, ql.Axes([slow, slow], M=robot.inertia), POSES)
    assert np.max(found.stiffness) > 0.1
    assert "NOT in these margins: B0 changes with the estimates under the load" in found.summary()
    assert np.max(analysed(False, POSES).stiffness) == pytest.approx(0.0, abs=1e-9)


def test_the_input_that_holds_a_pose_is_found() -> None:
    """It is the torque of gravity, for one given pair it is the one given, and a moving state has none."""
    robot = ql.plants.arm(lengths=(0.4, 0.3), masses=(2.0, 1.0))
    x, u = held_at(ql.plants.delayed_inputs(robot, 2e-3, 1e-3), [0.0, 0.0, 0.0, 0.0])
    model = robot.sampled(1e-3, interpret=True)
    np.testing.assert_allclose(model.rate(0.0, x, u, np.zeros(robot.disturbances)), 0.0, atol=1e-9)
    assert held_at(robot, (x, [1.0, 2.0]))[1].tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match="no u holds it at rest"):
        held_at(robot, [0.0, 0.0, 1.0, 0.0])
    with pytest.raises(ValueError, match="a linear one is the same at all points"):
        held_at(ql.plants.LinearPlant(np.eye(1), np.eye(1), np.eye(1)), [0.0])
    with pytest.raises(ValueError, match=r"points = \[\]"):
        analyse_points(robot, axes(robot), [])


@cases(
    ("points", "message"),
    [
        (5, "points = 5: must be a list of operating points"),
        ("here", "points = 'here': must be a list of operating points"),
        ({"x": [0.0] * 4}, "must be a list of operating points"),
        ([3], r"points = \[3\]: must be a list of operating points.* write \[\[…\]\]"),
        ([0.0, 0.1, 0.0, 0.0], r"of one state write \[\[…\]\]"),
        (np.zeros(4), r"of one state write \[\[…\]\]"),
        ([[0.0] * 4, 3.0], r"points\[1\]: operating point 3.0: must be a state of 4 entries"),
        ([[0.0] * 4, None], r"points\[1\]: operating point None: must be a state of 4 entries"),
        (
            [[0.0] * 3],
            r"points\[0\]: operating point .*: must be a state of 4 entries, or \(x, u\)",
        ),
        (
            ([0.0] * 4, [1.0, 2.0]),
            r"points\[1\]: operating point \[1.0, 2.0\]: must be a state of 4",
        ),
        ([([0.0] * 4, [1.0])], r"points\[0\]: u has shape"),
    ],
)
def test_what_is_no_list_of_points_is_refused(points: object, message: str) -> None:
    """By the name of the argument and the number of the point; a single state is the likely slip."""
    robot = ql.plants.arm(gravity=0.0, viscous=0.1)
    with pytest.raises(ValueError, match=message):
        analyse_points(robot, axes(robot), points)  # type: ignore[arg-type]


@pytest.mark.trial
def test_points_may_be_the_rows_of_an_array() -> None:
    """As they come from a grid."""
    robot = ql.plants.arm(gravity=0.0, viscous=0.1)
    rows = analyse_points(robot, axes(robot), np.array(POSES))  # type: ignore[arg-type]
    assert rows.summary() == analysed(False, POSES).summary()


def test_what_margins_do_not_have_is_told_of_points_too() -> None:
    """The loop that u_0 closes over compensators, for instance."""
    robot = ql.plants.arm(gravity=0.0, viscous=0.1)
    on_top = ql.Compensator(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3))
    found = analyse_points(robot, ql.Axes([on_top, on_top], M=robot.inertia), POSES)
    (told,) = [line for line in found.verdicts() if "u_0" in line]
    assert told.startswith("NOT in these margins: the loop that u_0 closes")
