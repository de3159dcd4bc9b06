"""Prefilters of the references of several axes: bits of a single axis, memory, setups, tuning."""

from __future__ import annotations

import copy
import pickle
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import quell as ql
from quell.controllers import Prefiltered
from quell.controllers.baselines import ZV
from quell.controllers.prefilters import ReferenceModel
from quell.controllers.shaping import ProfileGenerator
from quell.export import c_source
from quell.setup import made
from quell.setup.schema import SetupError
from quell.tuning import reference
from quell.tuning.axes_at_limits import held_loads, needs_along, with_prefilters
from quell.tuning.written import Written

from .in_c import needs_gcc
from .test_axes_export import RobotInC

DT = 1e-3
GENERATOR = ProfileGenerator(v_max=2.0, a_max=10.0, j_max=400.0)


def joint(order: int = 2, feedforward: bool = False) -> ql.ADRC:
    """Return a controller of an axis, with b0 = 1."""
    observer = ql.ESO.model_free(order=order, b0=1.0, omega_o=60.0, dt=DT)
    return ql.ADRC(observer, 8.0, feedforward=feedforward)


def mixed() -> ql.Axes:
    """Return axes with a profile generator, without a prefilter, and with a reference model."""
    axes = {
        "x": Prefiltered(joint(feedforward=True), GENERATOR),
        "y": joint(),
        "z": Prefiltered(joint(), ReferenceModel(20.0)),
    }
    return ql.Axes(axes, [[2.0, 0.5, 0.0], [0.5, 3.0, 0.0], [0.0, 0.1, 1.0]])


def signals(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return references that jump and are missing at times, and measurements with noise."""
    rng = np.random.default_rng(7)
    r = np.repeat(rng.uniform(-1.0, 1.0, (samples // 50 + 1, 3)), 50, axis=0)[:samples]
    r[::37] = np.nan
    y = np.cumsum(1e-3 * rng.standard_normal((samples, 3)), axis=0)
    y[5::41] = np.nan
    return r, y


def test_axes_of_one_prefiltered_adrc_have_its_bits() -> None:
    """With feedforward of the generated derivatives, missing signals, a start and an applied u."""
    alone = Prefiltered(joint(feedforward=True), GENERATOR)
    axes = ql.Axes([Prefiltered(joint(feedforward=True), GENERATOR)])
    assert axes.derivatives == (0,)
    r, y = signals(300)
    for k in range(300):
        if k == 120:
            alone.start(0.4, 0.2, 0.5)
            axes.start([0.4], [0.2], [0.5])
        u = alone.step(float(r[k, 0]), float(y[k, 0]))
        assert axes.step([r[k, 0]], [y[k, 0]])[0] == u
        assert axes.status == alone.status
        if k % 7 == 0:
            alone.applied(0.5 * u)
            axes.applied([0.5 * u])
    assert axes.stopping_point[0] == alone.stopping_point


def test_each_axis_follows_its_own_shaped_reference() -> None:
    """The channel has them: of the axis without a prefilter it is r; u is that of the plain axes for these references."""
    shaped, plain = mixed(), ql.Axes([joint(feedforward=True), joint(), joint()], mixed().B0)
    alone = [Prefiltered(joint(), GENERATOR), None, Prefiltered(joint(), ReferenceModel(20.0))]
    y = np.zeros(3)
    for k in range(60):
        r = np.array([1.0, -0.5, 0.3]) * (k > 2)
        u, row = shaped.step(r, y), np.zeros(sum(width for _, width in shaped.channels))
        ql.controllers.base.write_row(shaped.parameters, shaped._state, row)
        goals = r.copy()
        for i, each in enumerate(alone):
            if each is not None:
                each.step(r[i], y[i])
                goals[i] = each._state.loop[0].r_shaped
        np.testing.assert_array_equal(row[-3:], goals)
        given = alone[0].parameters.prefilter
        derivatives = np.zeros(3)
        ql.controllers.prefilters.write_derivatives(given, alone[0]._state.prefilter, derivatives)
        zero = np.zeros((2, 3))
        zero[:, 0] = derivatives[:2]
        np.testing.assert_array_equal(u, plain.step(goals, y, *zero))


@pytest.mark.trial
def test_compiled_and_interpreted_runs_agree_and_record_the_shaped_references() -> None:
    """On a machine of double integrators."""
    A, B = np.kron(np.eye(3), [[0, 1], [0, 0]]), np.kron(mixed().B0, [[0.0], [1.0]])
    plant = ql.plants.LinearPlant(A, B, np.eye(6)[::2])
    scenario = ql.Scenario([0.5, -0.3, 0.2], duration=0.4)
    runs = [ql.simulate(plant, mixed(), scenario, interpret=each) for each in (True, False)]
    np.testing.assert_allclose(runs[0].log, runs[1].log, atol=1e-9)
    assert runs[0]["r_shaped"].shape == (len(runs[0]), 3)
    assert np.all(np.diff(runs[0]["r_shaped"][:, 0]) >= 0.0)


def test_a_move_stops_at_the_stopping_point() -> None:
    """As r of the next steps the reference of the generator comes to rest there; others stay where they are."""
    axes, y = mixed(), np.zeros(3)
    for _ in range(150):
        axes.step([1.0, 0.2, 0.5], y)
    at = axes.stopping_point
    assert at[1] == 0.2
    shown = []
    for _ in range(400):
        axes.step(at, y)
        shown.append(float(axes._state.given.r[0]))
    assert max(shown) == pytest.approx(at[0], abs=1e-9)
    assert shown[-1] == pytest.approx(at[0], abs=1e-9)
    with pytest.raises(ValueError, match="no axis plans a stop"):
        _ = ql.Axes([joint()]).stopping_point


def test_copies_and_images_keep_where_the_prefilters_are() -> None:
    """A copy, a pickled one, and an image in new axes continue with the same bits; another prefilter refuses the image."""
    axes = mixed()
    r, y = signals(200)
    for k in range(100):
        axes.step(r[k], y[k])
    image = axes.memory()
    others = [copy.copy(axes), pickle.loads(pickle.dumps(axes)), mixed()]
    others[2].restore(image, running=True)
    for k in range(100, 200):
        u = axes.step(r[k], y[k])
        for each in others:
            np.testing.assert_array_equal(each.step(r[k], y[k]), u)
    bounded = ql.Axes(
        {
            "x": Prefiltered(joint(feedforward=True), GENERATOR),
            "y": joint(),
            "z": Prefiltered(joint(), ReferenceModel(20.0, rate_limit=1.0)),
        },
        mixed().B0,
    )
    with pytest.raises(ValueError, match="another controller"):
        bounded.restore(image)


def test_a_retuned_axis_keeps_its_prefilter() -> None:
    """And the text of axes is the call that makes them."""
    axes = mixed()
    axes.retune("x", omega_c=12.0)
    assert axes.prefilters == mixed().prefilters
    assert axes.axes[0].omega_c == 12.0
    assert "'x': Prefiltered(controller=ADRC(" in repr(axes)
    assert "prefilter=ProfileGenerator(v_max=2.0" in repr(axes)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Prefiltered(Prefiltered(joint(), GENERATOR), GENERATOR), "may have one prefilter"),
        (lambda: Prefiltered(joint(feedforward=True), ZV(5.0)), "no derivatives"),
        (lambda: Prefiltered(ql.Compensator(joint().observer), GENERATOR), "takes u_0"),
    ],
)
def test_what_is_no_prefiltered_axis_is_refused(make: Any, message: str) -> None:
    """Two prefilters, one without the derivatives that are fed forward, and one before u_0."""
    with pytest.raises(ValueError, match=message):
        ql.Axes([make()])


@pytest.mark.trial
@needs_gcc
def test_the_c_code_has_the_bits_and_the_stopping_point(tmp_path: Path) -> None:
    """``NAME_stopping_point`` writes that of Python, and ``NAME_save`` the image."""
    axes = mixed()
    robot = RobotInC(c_source(axes, "robot"), tmp_path)
    r, y = signals(150)
    for k in range(150):
        np.testing.assert_array_equal(robot.step(r[k], y[k], 3), axes.step(r[k], y[k]))
    at = np.zeros(3)
    robot.call("stopping_point", None, at)
    np.testing.assert_array_equal(at, axes.stopping_point)
    image = axes.memory()
    assert robot.image(len(image)) == image


TABLES: dict[str, Any] = {
    "dt": DT,
    "axes": {"u_min": -1.0, "u_max": 1.0},
    "axis": [
        {
            "observer": {"kind": "model-free", "order": 2, "omega_o": 60.0},
            "controller": {"omega_c": 8.0, "feedforward": True},
            "prefilter": {"kind": "profile-generator", "v_max": 2.0, "a_max": 1.0, "j_max": 9.0},
        },
        {
            "observer": {"kind": "model-free", "order": 2, "omega_o": 60.0},
            "controller": {"omega_c": 8.0},
        },
    ],
}


def test_a_setup_has_the_prefilter_of_each_axis() -> None:
    """In its table; one for all at the top of the file is refused with the place where it belongs."""
    axes = made("a", TABLES).controller
    assert axes.prefilters == (ProfileGenerator(2.0, 1.0, 9.0), None)
    with pytest.raises(SetupError, match=r"prefilter: belongs into each \[\[axis\]\]"):
        made("a", TABLES | {"prefilter": {"kind": "zv", "omega": 3.0}})
    first = TABLES["axis"][0] | {"prefilter": {"kind": "zv", "omega": 3.0}}
    with pytest.raises(SetupError, match=r"axis\[0\].prefilter: .*no derivatives"):
        made("a", TABLES | {"axis": [first, TABLES["axis"][1]]})


# ---- Tuning ----

M = np.array([[1.2e-3, 0.3e-3], [0.3e-3, 0.8e-3]])  # [kg m²]
FRICTION = np.array([[4e-3, 0.0], [0.0, 1e-3]])  # [N m s]


def machine() -> ql.plants.LinearPlant:
    """Return two coupled inertias with friction: M q'' + D q' = u."""
    inverse, zero = np.linalg.inv(M), np.zeros((2, 2))
    A = np.block([[zero, np.eye(2)], [zero, -inverse @ FRICTION]])
    return ql.plants.LinearPlant(A, np.vstack([zero, inverse]), np.eye(4)[:2])


def test_what_an_axis_needs_is_that_of_its_inertia_and_friction() -> None:
    """Columns of M and D; a spring at the load adds its stiffness at rest."""
    axes = ql.Axes([joint(), joint()], M=M)
    at_rest, viscous, inertia = needs_along(machine(), axes, None)
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-12)
    np.testing.assert_allclose(viscous, FRICTION, atol=1e-12)
    np.testing.assert_allclose(inertia, M, atol=1e-12)
    plant = machine()
    A = plant.A.copy()
    A[2:, :2] -= np.linalg.inv(M) @ np.diag([0.5, 0.2])
    at_rest, viscous, inertia = needs_along(ql.plants.LinearPlant(A, plant.B, plant.C), axes, None)
    np.testing.assert_allclose(at_rest, np.diag([0.5, 0.2]), atol=1e-9)
    np.testing.assert_allclose(inertia, M, atol=1e-9)


@pytest.mark.trial
def test_steps_at_the_limits_get_moves_that_are_near_the_quickest() -> None:
    """Both overshoot by 5 % at most, settle within 1.5 times the quickest move of half the torque each, and do so in the file that is written."""
    axes = ql.Axes({"a": joint(), "b": joint()}, M=M, u_min=-0.3, u_max=0.3)
    r = [ql.signals.Step(1.5, 0.1), ql.signals.Step(-1.0, 0.1)]
    tables = {**TABLES, "axes": {"M": M.tolist(), "u_min": -0.3, "u_max": 0.3}}
    tables["axis"] = [{**TABLES["axis"][1], "name": name} for name in "ab"]
    scenario = ql.Scenario(r, duration=2.0)
    file = Written(machine(), scenario, DT)
    bounds = ql.tuning.Constraints(m_ks=8000.0)
    found = ql.tune(machine(), controller=axes, constraints=bounds, written=file, setup=tables)
    assert found.judged is not None
    assert not found.judged.failures
    for each, height, row in zip(found.judged.others, (1.5, 1.0), M, strict=True):
        assert each.step is not None
        assert isinstance(each.prefilter, ProfileGenerator)
        quickest = 2.0 * np.sqrt(height * np.max(row) / 0.15)
        assert each.step.overshoot < 0.05
        assert each.step.settling < 1.5 * quickest
    written = made("a", tomllib.loads(found.toml())).controller
    run = ql.simulate(machine(), written, scenario)
    for i, each in enumerate(found.judged.others):
        assert run.axis(i).metrics(start=0.1)["settling_time"] == pytest.approx(
            each.step.settling, abs=2 * DT
        )
    assert 'behind the prefilter kind = "profile-generator"' in found.summary()


@pytest.mark.trial
def test_axes_that_friction_brakes_speed_up_at_their_limits() -> None:
    """Quicker than moves within them, with 15 % less of u as well; another axis stays within."""
    A = np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]])
    A[1, 1] = -10.0
    plant = ql.plants.LinearPlant(A, np.kron(np.eye(2), [[0.0], [1.0]]), np.eye(4)[::2])
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=200.0, dt=DT)
    parts = {name: ql.ADRC(observer, 40.0) for name in "ab"}
    axes = ql.Axes(parts, u_min=[-3.0, -3.0], u_max=[3.0, 3.0])
    file = Written(plant, ql.Scenario([ql.signals.Step(0.05, 0.1)] * 2, duration=1.5), DT)
    files = [replace(file, axis=i) for i in range(2)]

    def found() -> tuple[ql.Axes, list[float]]:
        made = with_prefilters(plant, axes, held_loads(plant, axes, None), None, files)
        assert made is not None
        run = file.run(made)
        steps = [each.figures(made, run) for each in files]
        assert all(step is not None and step.overshoot <= 0.05 for step in steps)
        return made, [step.settling for step in steps if step is not None]

    quick, times = found()
    with patch.object(reference, "BEYOND", ()):
        within, slower = found()
    assert times[0] < 0.9 * slower[0]
    (a, b), (before, _) = quick.prefilters, within.prefilters
    # Both step at once, so each has half of the room.
    assert 10.0 * a.v_max + a.a_max > 1.5
    assert max(10.0 * a.v_max, a.a_max, b.a_max) <= 1.5
    assert 10.0 * before.v_max + before.a_max <= 1.5


def test_no_prefilter_is_added_where_no_step_is_left() -> None:
    """Without a step of the reference, and where each axis has one."""
    axes = ql.Axes([joint(), joint()], M=M, u_min=-0.3, u_max=0.3)
    file = Written(machine(), ql.Scenario([0.0, 0.0], duration=0.5), DT)
    files = [replace(file, axis=i) for i in range(2)]
    assert with_prefilters(machine(), axes, np.zeros((2, 2)), None, files) is None


@pytest.mark.trial
def test_an_axis_whose_actuator_has_no_limits_gets_no_prefilter() -> None:
    """Of two independent axes only the limited one is slowed down; nor is there a load that the other can't hold."""
    one = ql.plants.LinearPlant(
        np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]]),
        np.kron(np.eye(2), [[0.0], [1.0]]),
        np.eye(4)[::2],
    )
    axes = ql.Axes({"a": joint(), "b": joint()}, u_min=[-3.0, -np.inf], u_max=[3.0, np.inf])
    steps = [ql.signals.Step(0.5, 0.1), ql.signals.Step(0.5, 0.1)]
    file = Written(one, ql.Scenario(steps, duration=1.5), DT)
    files = [replace(file, axis=i) for i in range(2)]
    held = held_loads(one, axes, None)
    np.testing.assert_array_equal(held, -np.eye(2))
    found = with_prefilters(one, axes, held, None, files)
    assert found is not None
    assert isinstance(found.prefilters[0], ProfileGenerator)
    assert found.prefilters[1] is None
