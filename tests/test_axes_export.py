"""Several axes as C: the bits of the kernels, memory images, and what is refused."""

from __future__ import annotations

import ctypes
import re
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.prefilters import Prefiltered, ReferenceModel
from quell.controllers.several import control_all
from quell.controllers.shaping import ProfileGenerator
from quell.export import TranslationError, c_source
from quell.export.axes_source import names_in_c
from quell.export.controller_source import parts_of
from quell.export.library.vectors import golden_vectors
from quell.kernels.dispatch import as_python

from . import gain_functions
from .cases import cases
from .contracts.python_models import python_learners
from .in_c import InC, built, needs_gcc

DT = 1e-3
SQUARE = np.array([[1.0, 0.3, 0.1], [0.2, 2.0, 0.1], [0.0, 0.3, 0.5]])
WIDE = np.hstack([SQUARE, [[0.5], [0.2], [0.4]]])
LIMITS = {"u_min": -20.0, "u_max": 20.0}


def joint(order: int = 2, **parts: Any) -> ql.ADRC:
    """Return a controller of an axis."""
    observer = ql.ESO.model_free(order=order, b0=1.0, omega_o=60.0, dt=DT)
    return ql.ADRC(observer, 8.0, **parts)


def three() -> dict[str, ql.ADRC]:
    """Return axes with three learners and guards, one with feedforward."""
    return {
        "shoulder": joint(learner=ql.learners.Kalman(), guard=ql.Guard(), feedforward=True),
        "elbow": joint(learner=ql.learners.Harmonic(), guard=ql.Guard()),
        "wrist": joint(learner=ql.learners.RLS(), guard=ql.Guard()),
    }


def plain() -> dict[str, ql.ADRC]:
    """Return the same axes without learners, whose runs are short."""
    return {"shoulder": joint(feedforward=True), "elbow": joint(), "wrist": joint()}


def guarded() -> list[ql.ADRC]:
    """Return axes with bands, so that y leaves those of the first two, and one without."""
    wide, narrow = (ql.SafeSet(-y, y, -3.0 * y, 3.0 * y, alpha=8.0, f_rate=1.0) for y in (1.0, 0.3))
    return [joint(safe_set=wide), joint(1, safe_set=narrow), joint()]


def stated() -> ql.SafeSet:
    """Return a band with the largest v that errors of B0 are a share of."""
    return ql.SafeSet(-1.0, 1.0, alpha=8.0, f_rate=1.0, gain_error=0.02, largest_u=24.0)


def adding() -> list[ql.Compensator]:
    """Return compensators of axes, with a learner and with a safe set."""
    first, second = (ql.ESO.model_free(order, 1.0, 60.0, DT) for order in (2, 1))
    return [
        ql.Compensator(first, omega_c=8.0, learner=ql.learners.Kalman(), guard=ql.Guard()),
        ql.Compensator(second),
        ql.Compensator(first, safe_set=ql.SafeSet(-1.0, 1.0, -3.0, 3.0, alpha=8.0, f_rate=1.0)),
    ]


def drives() -> list[Any]:
    """Return controllers of u_0."""
    pid = ql.baselines.PID(kp=100.0, ki=50.0, kd=20.0, tf=0.005, dt=DT)
    return [pid, ql.baselines.PPI(kv=5.0, kp=1.0, tn=0.1, dt=DT), pid]


def shaped() -> list[Any]:
    """Return axes with a profile generator, without a prefilter, and with a reference model."""
    generator = ProfileGenerator(v_max=2.0, a_max=10.0, j_max=400.0)
    model = ReferenceModel(20.0, rate_limit=3.0)
    moved = Prefiltered(joint(feedforward=True), generator)
    return [moved, joint(), Prefiltered(joint(), model)]


def two() -> list[ql.ADRC]:
    """Return two axes with learners and guards."""
    learners = (ql.learners.Kalman(), ql.learners.Harmonic())
    return [joint(learner=learner, guard=ql.Guard()) for learner in learners]


def parametric(inertia: float) -> Any:
    """Return a function M with its parameters."""
    coupling = np.array([[9.0, 0.2], [0.15, 0.1]])
    return partial(gain_functions.parametric, inertia=inertia, arms=(0.3, 0.2), coupling=coupling)


ARM = ql.plants.arm(lengths=(0.4, 0.3), masses=(2.0, 1.0), gravity=0.0)
RANKED = ["wrist", "elbow", "shoulder"]
ROWS: dict[str, Any] = {
    "each, with rates": lambda: ql.Axes(three(), SQUARE, rate_limit=8000.0, **LIMITS),
    "direction": lambda: ql.Axes(plain(), SQUARE, saturation="direction", **LIMITS),
    "priority": lambda: ql.Axes(plain(), SQUARE, saturation=RANKED, **LIMITS),
    "more actuators, least squares": lambda: ql.Axes(
        three(), WIDE, weights=[1, 2, 3, 4], wished=[1, 0, 0, -1], **LIMITS
    ),
    "more actuators, direction": lambda: ql.Axes(
        plain(), WIDE, saturation="direction", rate_limit=5000.0, **LIMITS
    ),
    "more actuators, priority": lambda: ql.Axes(plain(), WIDE, saturation=RANKED, **LIMITS),
    "safe sets, rates": lambda: ql.Axes(guarded(), SQUARE, rate_limit=8000.0, **LIMITS),
    "safe sets, more actuators, direction": lambda: ql.Axes(
        guarded(), WIDE, saturation="direction", weights=[1, 2, 3, 4], **LIMITS
    ),
    "compensators": lambda: ql.Axes(adding(), SQUARE, rate_limit=8000.0, **LIMITS),
    "compensators, more actuators": lambda: ql.Axes(adding(), WIDE, weights=[1, 2, 3, 4], **LIMITS),
    "drives, direction": lambda: ql.Axes(
        adding(), SQUARE, saturation="direction", drives=drives(), **LIMITS
    ),
    "orders 1, 3 and 2": lambda: ql.Axes([joint(1), joint(3), joint(2)], SQUARE, u_max=5.0),
    "one axis": lambda: ql.Axes([joint()]),
    "prefilters": lambda: ql.Axes(shaped(), SQUARE, rate_limit=8000.0, **LIMITS),
    "nested tuples": lambda: ql.Axes([joint(), joint()], gain_functions.nested_tuples, **LIMITS),
    "an array as M": lambda: ql.Axes([joint(), joint()], M=gain_functions.array, **LIMITS),
    "a function, whose v may be larger than stated": lambda: ql.Axes(
        [joint(safe_set=stated()), joint()], gain_functions.nested_tuples, **LIMITS
    ),
    "a function, more actuators": lambda: ql.Axes(
        [joint(), joint()], gain_functions.wide, weights=[1, 2, 1], **LIMITS
    ),
    "sometimes singular": lambda: ql.Axes(
        [joint(), joint()], gain_functions.sometimes_singular, **LIMITS
    ),
    "a function with parameters as M": lambda: ql.Axes(
        [joint(), joint()], M=parametric(0.8), **LIMITS
    ),
    "a function with parameters, more actuators": lambda: ql.Axes(
        [joint(), joint()],
        partial(gain_functions.with_default, K=[[1.0, 0.2, 0.3], [0.1, 0.5, -0.3]]),
        **LIMITS,
    ),
    "mass matrix of the arm": lambda: ql.Axes([joint(), joint()], M=ARM.inertia, **LIMITS),
}
SINGLE = (
    "each, with rates",
    "safe sets, rates",
    "drives, direction",
    "more actuators, least squares",
    "more actuators, direction",
    "more actuators, priority",
    "priority",
    "orders 1, 3 and 2",
    "prefilters",
)


def outcome(folder: Path, *arguments: str) -> tuple[int, str]:
    """Compile and run the golden vectors; return exit code and output."""
    sources = (folder / "test_robot.c", folder / "src/robot.c")
    program = built(folder / "test", sources, "-O2", "-I", folder / "src")
    done = subprocess.run([program, *arguments], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize(
    ("name", "precision"),
    [*((name, "double") for name in ROWS), *((name, "single") for name in SINGLE)],
)
def test_the_c_code_repeats_the_kernels_bit_for_bit(
    tmp_path: Path, name: str, precision: str
) -> None:
    """With noise, NaN in r and y, saturation, manual operation, restarts, and a loop that learns."""
    ql.export.c(ROWS[name](), tmp_path / "out", name="robot", precision=precision, accept=True)
    code, text = outcome(tmp_path / "out", "0")
    assert code == 0, text
    assert "largest difference 0 ulp" in text


@pytest.mark.trial
def test_the_run_of_the_golden_vectors_has_what_can_happen() -> None:
    """Held values, limits of magnitude and rate, a brake, and learners that learn."""
    axes = ROWS["each, with rates"]()
    found = golden_vectors(axes, c_source(axes))
    flags = ql.Status(int(np.bitwise_or.reduce([row.status for row in found.rows])))
    held = ql.Status.MEASUREMENT_HELD | ql.Status.REFERENCE_HELD | ql.Status.CONTROL_HELD
    assert held | ql.Status.SATURATED | ql.Status.RATE_LIMITED | ql.Status.HELD in flags
    at = axes.outputs + 1  # behind v and status
    for axis in axes.axes:
        width = sum(size for _, size in axis.channels)
        theta = found.estimate[at : at + width][-len(axis.features) :]
        assert np.any(theta != 0.0)
        at += width


@pytest.mark.trial
def test_the_run_of_the_golden_vectors_has_bands_that_are_kept_and_left() -> None:
    """Samples in which the safe sets act and all is well, and some where the limits are too narrow."""
    axes = ROWS["safe sets, more actuators, direction"]()
    rows = golden_vectors(axes, c_source(axes)).rows
    flags = [ql.Status(row.status) for row in rows]
    acted = [each for each in flags if ql.Status.SAFE_SET_ACTED in each]
    assert any(ql.Status.UNSAFE in each for each in acted)
    assert any(ql.Status.UNSAFE not in each for each in acted)


@pytest.mark.trial
@needs_gcc
def test_golden_vectors_find_a_wrong_number(tmp_path: Path) -> None:
    """Another entry of B0's inverse is a difference; so is a wrong flag of one axis."""
    ql.export.c(ROWS["direction"](), tmp_path / "out", name="robot")
    source = tmp_path / "out/src/robot.c"
    text = source.read_text()
    changed = re.sub(
        r"(u\[k\] \+= memory->inverse\[k\]\[i\] \* rest\[i\]);", r"\1 * 1.0000001;", text
    )
    assert changed != text
    source.write_text(changed)
    code, said = outcome(tmp_path / "out", "64")
    assert code == 1
    assert "FAILED" in said


class RobotInC(InC):
    """Exported axes; arrays are handed over."""

    def step(self, r: Any, y: Any, actuators: int) -> np.ndarray:
        """Take one sample; return u."""
        u = np.zeros(actuators)
        self.call("step", None, np.array(r, float), np.array(y, float), u)
        return u

    def call(self, operation: str, result: Any, *arguments: Any) -> Any:
        """Call an operation that returns a number of a type of C."""
        function = getattr(self.library, f"{self.name}_{operation}")
        function.restype = result
        given = [
            each.ctypes.data_as(ctypes.c_void_p) if isinstance(each, np.ndarray) else each
            for each in arguments
        ]
        return function(self.state, *given)

    def image(self, size: int) -> bytes:
        """Return the memory image."""
        buffer = ctypes.create_string_buffer(size)
        self.call("save", None, buffer)
        return buffer.raw


def learning() -> ql.Axes:
    """Return axes that learn."""
    return ql.Axes(two(), [[1.0, 0.3], [0.2, 1.0]], **LIMITS)


def taught(axes: ql.Axes, samples: int = 150) -> ql.Axes:
    """Return axes after some samples with the interpreted kernels."""
    with np.errstate(all="ignore"), as_python():
        for k in range(samples):
            r = np.array([0.5 * np.sin(0.01 * k), 0.2])
            y = r - 0.01 * np.cos(0.05 * k)
            control_all(axes.parameters, axes._state, r, y, np.zeros(axes.inputs))
    return axes


class TestMemory:
    """What axes have learned outlives the process and the target."""

    @pytest.mark.trial
    @needs_gcc
    def test_images_of_python_and_c_are_the_same_bytes(self, tmp_path: Path) -> None:
        """And each continues the loop of the other, bit by bit."""
        axes = learning()
        robot = RobotInC(c_source(axes, "robot"), tmp_path)
        for k in range(100):
            r, y = np.array([0.3, 0.1 * np.sin(0.1 * k)]), np.array([1e-3 * k, 0.05])
            u = np.zeros(2)
            with np.errstate(all="ignore"), as_python():
                control_all(axes.parameters, axes._state, r, y, u)
            assert np.array_equal(robot.step(r, y, 2), u)
        image = axes.memory()
        assert robot.image(len(image)) == image
        other, twin = RobotInC(c_source(learning(), "robot"), tmp_path), learning()
        length = ctypes.c_size_t(len(image))
        assert other.call("load", ctypes.c_bool, image, length, ctypes.c_bool(True))
        twin.restore(image, running=True)
        expected = robot.step([0.3, 0.2], [0.31, 0.06], 2)
        assert np.array_equal(other.step([0.3, 0.2], [0.31, 0.06], 2), expected)
        u = np.zeros(2)
        with np.errstate(all="ignore"), as_python():
            control_all(
                twin.parameters, twin._state, np.array([0.3, 0.2]), np.array([0.31, 0.06]), u
            )
        assert np.array_equal(u, expected)

    def test_a_start_from_rest_keeps_what_was_learned(self) -> None:
        """The coefficients stay, the estimates are those of rest."""
        axes, other = taught(learning()), learning()
        other.restore(axes.memory())
        for one, two_ in zip(axes.axes, other.axes, strict=True):
            assert np.array_equal(one._state.learner.theta, two_._state.learner.theta)
            assert two_._state.loop[0].started == 0.0
        assert other._state.loop[0].started == 0.0

    def test_exports_begin_with_what_was_learned(self) -> None:
        """The coefficients are in the state before the first sample."""
        axes = taught(learning())
        state = parts_of(axes).state
        assert np.array_equal(state.axes[0].learner.theta, axes.axes[0]._state.learner.theta)
        assert np.any(state.axes[0].learner.theta != 0.0)

    def test_limits_may_be_others(self) -> None:
        """A running loop continues with other limits, not with another law."""
        image = taught(learning()).memory()
        narrow = learning()
        narrow.set_limits(u_max=3.0)
        narrow.restore(image, running=True)
        other = learning()
        other.retune(0, omega_c=9.0)
        with pytest.raises(ValueError, match="other parameters"):
            other.restore(image, running=True)
        other.restore(image)

    @cases(
        "other",
        [
            lambda: ql.Axes(two(), [[1.0, 0.3], [0.3, 1.0]], **LIMITS),
            lambda: ql.Axes(two()[::-1], [[1.0, 0.3], [0.2, 1.0]], **LIMITS),
            lambda: ql.Axes(two(), gain_functions.nested_tuples, **LIMITS),
            lambda: ql.Axes([*two(), joint()], SQUARE, **LIMITS),
            lambda: ql.Axes(
                dict(zip("ab", two(), strict=True)), [[1.0, 0.3], [0.2, 1.0]], **LIMITS
            ),
        ],
        ids=["another B0", "another order of axes", "a function", "another axis", "other names"],
    )
    def test_images_of_other_axes_are_refused(self, other: Any) -> None:
        """What is learned of an axis is relative to B0."""
        with pytest.raises(ValueError, match="of another controller"):
            other().restore(taught(learning(), 10).memory())

    @pytest.mark.trial
    @needs_gcc
    def test_an_image_of_equal_axes_in_another_order_is_refused(self, tmp_path: Path) -> None:
        """In Python as in C: only their names say which is which."""
        parts = [joint(learner=ql.learners.Kalman(), guard=ql.Guard()) for _ in range(2)]
        axes = ql.Axes(dict(zip("xz", parts, strict=True)), **LIMITS)
        image = taught(axes).memory()
        ql.Axes(dict(zip("xz", parts, strict=True)), **LIMITS).restore(image)
        exchanged = ql.Axes(dict(zip("zx", parts, strict=True)), **LIMITS)
        with pytest.raises(ValueError, match="names and order of axes must be those"):
            exchanged.restore(image)
        robot = RobotInC(c_source(exchanged, "robot"), tmp_path)
        length = ctypes.c_size_t(len(image))
        assert not robot.call("load", ctypes.c_bool, image, length, ctypes.c_bool(False))

    def test_an_image_of_a_robot_with_other_links_is_refused(self) -> None:
        """The parameters of a function are compared, as a constant B0 is; limits are not."""
        robot = ql.Axes(two(), M=parametric(0.8), **LIMITS)
        image = taught(robot, 10).memory()
        ql.Axes(two(), M=parametric(0.8), u_max=3.0, u_min=-3.0).restore(image)
        with pytest.raises(ValueError, match="of another controller"):
            ql.Axes(two(), M=parametric(0.81), **LIMITS).restore(image)

    def test_flags_of_manual_operation_are_none_in_an_image(self) -> None:
        """An image that was made in the middle of ``track`` is refused."""
        axes = learning()
        places = axes._images().zeros
        assert len(places) == 3  # of each axis, and of all
        for loop in (axes._state.loop, axes.axes[1]._state.loop):
            loop[0].manual = 1.0
            with pytest.raises(ValueError, match="in the middle of a sample"):
                learning().restore(axes.memory())
            loop[0].manual = 0.0

    def test_a_learner_in_python_is_named_with_its_axis(self) -> None:
        """Its memory is not made of numbers."""
        learner = next(iter(python_learners().values()))
        axes = ql.Axes({"x": joint(), "tool": joint(learner=learner, guard=ql.Guard())})
        with pytest.raises(ValueError, match="axis tool: .*learner is a Python object"):
            axes.memory()
        with pytest.raises(TranslationError, match="calls Python at each sample"):
            c_source(axes)


class TestOperationsInC:
    """Operations besides a step."""

    @pytest.mark.trial
    @needs_gcc
    def test_a_start_holds_the_machine(self, tmp_path: Path) -> None:
        """The next u is that of the start, as in Python; what is no number changes nothing."""
        robot = RobotInC(c_source(ql.Axes([joint(), joint()], [[1, 0.3], [0.2, 1]])), tmp_path)
        y, u = np.array([0.3, -0.2]), np.array([1.5, 0.7])
        robot.call("start", None, y, u, y)
        np.testing.assert_allclose(robot.step(y, y, 2), u, rtol=1e-9)
        robot.call("start", None, np.array([0.3, np.nan]), u, y)
        assert robot.call("status", ctypes.c_int) & int(ql.Status.CONTROL_HELD)
        np.testing.assert_allclose(robot.step(y, y, 2), u, rtol=1e-6)

    @pytest.mark.trial
    @needs_gcc
    def test_manual_operation_ends_without_a_bump(self, tmp_path: Path) -> None:
        """``hand_over`` needs a sample, and then u continues."""
        robot = RobotInC(c_source(ql.Axes([joint(), joint()], [[1, 0.3], [0.2, 1]])), tmp_path)
        assert not robot.call("hand_over", ctypes.c_bool)
        r, y, u = np.zeros(2), np.array([0.2, 0.1]), np.array([0.7, -0.3])
        for _ in range(50):
            robot.call("track", None, r, y, u)
        assert robot.call("hand_over", ctypes.c_bool)
        np.testing.assert_allclose(robot.step(r, y, 2), u, atol=1e-9)

    @pytest.mark.trial
    @needs_gcc
    def test_one_axis_is_held_by_its_place(self, tmp_path: Path) -> None:
        """A place that no axis has changes nothing."""
        robot = RobotInC(c_source(ql.Axes([joint(), joint()])), tmp_path)
        for place, flag in ((5, 0), (1, int(ql.Status.HELD))):
            robot.call("set_held", None, ctypes.c_int(place), ctypes.c_bool(True))
            robot.step([0.1, 0.1], [0.0, 0.0], 2)
            assert robot.call("status", ctypes.c_int) & int(ql.Status.HELD) == flag

    @pytest.mark.trial
    @needs_gcc
    def test_the_estimate_has_each_axis_by_name(self, tmp_path: Path) -> None:
        """Members of the struct are those of the estimates in Python."""
        axes = ql.Axes({"x": joint(), "y-2": joint()}, [[1, 0.3], [0.2, 1]])
        source = c_source(axes, "robot")
        more = (
            "double shown(robot_state *state, int i);\n"
            "double shown(robot_state *state, int i)\n{\n"
            "    const robot_estimate found = robot_get_estimate(state);\n"
            "    const double all[] = {found.x.x_hat[0], found.y_2.x_hat[1], found.y_2.f, found.v[1]};\n"
            "    return all[i];\n}\n"
        )
        robot = RobotInC(source, tmp_path, more)
        for k in range(20):
            r, y = np.array([0.1, 0.2]), np.array([1e-3 * k, 2e-3 * k])
            robot.step(r, y, 2)
            with np.errstate(all="ignore"), as_python():
                control_all(axes.parameters, axes._state, r, y, np.zeros(2))
        show = robot.library.shown
        show.restype = ctypes.c_double
        found = [show(robot.state, ctypes.c_int(i)) for i in range(4)]
        known = axes.estimates
        assert found == [known["x"].x[0], known["y-2"].x[1], known["y-2"].f, axes._state.v[1]]


def test_names_of_axes_become_names_in_c() -> None:
    """Signs that C does not know go; keywords, doubles and members of the struct get another name."""
    names = ("x", "x", "Achse 2", "2", "v", "int", "φ")
    assert names_in_c(names) == ("x", "x_2", "Achse_2", "axis4", "v_2", "int_", "phi")
    assert names_in_c(("x", "X", "Status")) == ("x", "X_2", "Status_2")  # enum robot_axis


REFUSED: tuple[tuple[dict[str, Any], str], ...] = (
    ({"resolution": 1e-4}, "several axes take y in its unit"),
    ({"precision": "single"}, "needs plant and scenario, to compare it with double"),
)


@pytest.mark.parametrize(("options", "message"), REFUSED, ids=[*map(str, range(len(REFUSED)))])
def test_what_is_for_one_u_is_refused(tmp_path: Path, options: Any, message: str) -> None:
    """And nothing is written."""
    with pytest.raises(ValueError, match=message):
        ql.export.c(ql.Axes([joint(), joint()]), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.trial(cases="made_by_a_library")
@pytest.mark.parametrize(
    ("make", "precision", "message"),
    [
        (lambda: ql.Axes(two(), gain_functions.made_by_a_library), "double",
         "made_by_a_library: must return a matrix written as nested tuples"),
        (lambda: ql.Axes(two(), gain_functions.nested_tuples), "single", "B0 or M is a function"),
    ],
)  # fmt: skip
def test_what_has_no_counterpart_is_named(
    tmp_path: Path, make: Any, precision: str, message: str
) -> None:
    """The message says what to do instead."""
    with pytest.raises(ValueError, match=message):
        ql.export.c(make(), tmp_path / "out", precision=precision, accept=True)
    assert not (tmp_path / "out").exists()


@pytest.mark.trial
@needs_gcc
def test_files_have_no_placeholder_and_compile_as_cpp(tmp_path: Path) -> None:
    """Also the loop in the description."""
    done = ql.export.c(ROWS["direction"](), tmp_path / "out", name="robot")
    for file in done.files:
        assert not re.search(r"@\w+@", file.read_text()), file
    readme = (tmp_path / "out/README.md").read_text()
    assert "0 `shoulder`, 1 `elbow`, 2 `wrist`" in readme
    loop = readme.partition("#include <math.h>")[2].partition("```")[0]
    (tmp_path / "loop.c").write_text("#include <math.h>\n" + loop)
    flags = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-c", f"-I{tmp_path / 'out/src'}")
    subprocess.run(["gcc", *flags, tmp_path / "loop.c", "-o", tmp_path / "loop.o"], check=True)
    command = ["g++", "-std=c++11", "-x", "c++", *flags[1:], tmp_path / "out/src/robot.c"]
    subprocess.run([*command, "-o", tmp_path / "cpp.o"], check=True)
    assert "enum robot_axis { ROBOT_AXIS_SHOULDER = 0" in done.source.header
    assert done.source.axes == ("shoulder", "elbow", "wrist")
