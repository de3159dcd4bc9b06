"""``ql.export.ros2``: a package of ROS 2, compiled against stand-ins of the headers of ROS 2 Jazzy."""

from __future__ import annotations

import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

import quell as ql

from .cases import cases
from .commands import in_this_process
from .setups import GANTRY, TWO_MASS

DT = 1e-3
STANDIN = Path(__file__).parent / "ros2_standin"
needs_gpp = pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is missing")


def joint(b0: float = 1.0, **parts: Any) -> ql.ADRC:
    """Return an ADRC of a joint."""
    return ql.ADRC(ql.ESO.model_free(order=2, b0=b0, omega_o=60.0, dt=DT), 8.0, **parts)


LIMITS = {"u_min": -2.0, "u_max": 3.0}
SERVO = joint(1.5, **LIMITS)
LEARNING = joint(1.5, learner=ql.learners.Kalman(), guard=ql.Guard(), feedforward=True, **LIMITS)
PID = ql.baselines.PID(4.0, 2.0, 1.0, tf=0.05, dt=DT, **LIMITS)
COMPENSATOR = ql.Compensator(ql.ESO.model_free(order=2, b0=1.5, omega_o=60.0, dt=DT), **LIMITS)
ROBOT = ql.Axes(
    {"shoulder": joint(feedforward=True), "elbow": joint()},
    [[1.0, 0.2], [0.1, 2.0]],
    u_min=-5.0,
    u_max=5.0,
)


ADDING = {"shoulder": ql.Compensator(joint().observer), "elbow": ql.Compensator(joint().observer)}
ADDING_WIDE = ql.Axes(ADDING, [[1.0, 0.2, 0.5], [0.1, 2.0, 0.3]], u_min=-5.0, u_max=5.0)


def exported(folder: Path, controller: Any = SERVO, name: str = "servo", **options: Any) -> Path:
    """Export a package; return its folder."""
    ql.export.ros2(controller, folder / name, name=name, **options)
    return folder / name


def ran(folder: Path, program: str, name: str = "servo") -> None:
    """Compile the package with a test program, without a warning; run it, which must end with 0."""
    source = folder.parent / "program.cpp"
    source.write_text(f'#include "loop.hpp"\n#include "{name}.h"\n' + program)
    code = folder.parent / "code.o"
    exact = ("-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror")
    for command in (
        ["gcc", "-std=c99", *exact, "-c", folder / f"src/{name}.c", "-o", code],
        ["g++", "-std=c++17", *exact, "-O0", "-I", STANDIN, "-I", folder / "src", source,
         folder / f"src/{name}_controller.cpp", code, "-o", folder.parent / "program"],
        [folder.parent / "program"],
    ):  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


_BITS = """
int bits()
{
  Loop loop(1000, {"axis/effort"}, {"axis/position"});
  servo_state own;
  double y = 0.1, v = 0.0;

  if (!loop.start() || loop.controller->references().size() != NUMBERS) return 2;
  if (loop.controller->references()[0]->get_name() != "FIRST") return 3;
  servo_init(&own);
  for (int k = 0; k < 3000; k++) {
    const double measured = k % 701 == 700 ? NOTHING : y + 1e-3 * noise();
    const double r = k < 500 ? NOTHING : k < 2000 ? 1.0 : -5.0;
    const bool locked = k % 811 == 810;

    loop.states[0]->locked = locked;
    (void)loop.states[0]->set_value(measured);
    if (k == 500 || k == 2000) loop.send({r FURTHER});
    loop.update();
    const double u = servo_step(&own, r, locked ? NOTHING : measured ARGUMENTS);
    const double found = loop.command(0);
    if (!same(found, u)) { std::printf("sample %d: %.17g, must be %.17g\\n", k, found, u); return 1; }
    if (*loop.controller->states()[0]->get_optional() != servo_status(&own)) return 4;
    v += 1e-3 * (1.5 * u - 3.0 * y - 0.5 * v);
    y += 1e-3 * v;
  }
  return 0;
}
"""

# A joint limit cuts u, a command can't be written, and the limits are those of the parameters.
_ACTING = """
int acting()
{
  Loop loop(1000, {"axis/effort"}, {"axis/position"});
  servo_state own;
  servo_parameters limited = servo_default_parameters;
  double y = 0.0, v = 0.0, before = 0.0;

  limited.limits.low = -1.0;
  limited.limits.high = 1.5;
  loop.set("u_min", {-1.0});
  loop.set("u_max", {1.5});
  if (!loop.start()) return 2;
  servo_init(&own);
  servo_retune(&own, &limited);
  loop.send({1.0});
  loop.commands[0]->most = 0.7;
  for (int k = 0; k < 2000; k++) {
    loop.commands[0]->locked = k % 50 == 49;
    (void)loop.states[0]->set_value(y);
    loop.update();
    const bool locked = loop.commands[0]->locked;
    loop.commands[0]->locked = false;
    const double u = servo_step(&own, 1.0, y);
    const double applied = locked ? before : u > 0.7 ? 0.7 : u;
    if (applied != u) servo_applied(&own, applied);
    if (!same(loop.command(0), applied)) return 1;
    before = loop.command(0);
    v += 1e-3 * (1.5 * before - 3.0 * y);
    y += 1e-3 * v;
  }
  (void)loop.controller->on_deactivate({});
  return loop.command(0) == 0.0 ? 0 : 3;
}
"""

# A reference of before the activation does not act, whoever has the lock meanwhile; a later one does.
_ACTIVATED = """
int activated()
{
  Loop loop(1000, {"axis/effort"}, {"axis/position"});

  if (!loop.start()) return 1;
  (void)loop.states[0]->set_value(0.0);
  const auto reference = [&loop] { return *loop.controller->references()[0]->get_optional(); };
  loop.update();
  if (!std::isnan(reference())) return 2;
  loop.send({5.0});
  loop.update();
  if (reference() != 5.0) return 3;
  (void)loop.controller->on_deactivate({});
  realtime_tools::held = true;
  if (loop.controller->on_activate({}) != CallbackReturn::SUCCESS) return 4;
  realtime_tools::held = false;
  loop.update();
  if (!std::isnan(reference()) || loop.command(0) != 0.0) return 5;
  loop.send({6.0});
  loop.update();
  return reference() == 6.0 ? 0 : 6;
}
"""

# Another rate, names without a joint, too many names, limits of which the lower is not below.
_REFUSED = """
int refused()
{
  Loop rate(500, {"axis/effort"}, {"axis/position"});
  Loop slash(1000, {"axis/effort"}, {"position"});
  Loop many(1000, {"axis/effort", "other/effort"}, {"axis/position"});
  Loop limits(1000, {"axis/effort"}, {"axis/position"});
  Loop nan(1000, {"axis/effort"}, {"axis/position"});
  Loop lengths(1000, {"axis/effort"}, {"axis/position"});
  Loop good(1000, {"axis/effort"}, {"axis/position"});

  limits.set("u_min", {4.0});
  nan.set("u_max", {NOTHING});
  lengths.set("u_max", {1.0, 2.0});
  for (Loop * each : {&rate, &slash, &many, &limits, &nan, &lengths}) {
    rclcpp::errors = 0;
    if (each->configure() || rclcpp::errors != 1) return 1;
  }
  rclcpp::errors = 0;
  if (!good.start() || rclcpp::errors != 0) return 2;
  good.send({1.0, 2.0});
  return rclcpp::errors == 1 ? 0 : 3;
}
"""


def bits(further: int, first: str) -> str:
    """Return the program that compares the bits of a controller with ``further`` derivatives."""
    program = _BITS.replace("NUMBERS", str(1 + further)).replace("FIRST", first)
    program = program.replace("FURTHER", ", 0.0" * further)
    return program.replace("ARGUMENTS", ", k < 500 ? NOTHING : 0.0" * further)


@pytest.mark.trial
@needs_gpp
def test_the_commands_have_the_bits_of_the_c_code(tmp_path: Path) -> None:
    """3000 samples with noise, NaN, a locked interface, and references before and after they come.

    What really acts is told to the controller: a joint limit cuts u, and a command that can't be
    written leaves the one before. Wrong parameters are refused at configuration, with one message.
    """
    main = "int main() { return bits() + 10 * acting() + 30 * refused() + 40 * activated(); }\n"
    programs = bits(0, "loop/axis/position") + _ACTING + _REFUSED + _ACTIVATED
    ran(exported(tmp_path), programs + main)


@needs_gpp
@pytest.mark.trial
@pytest.mark.parametrize(
    ("controller", "further", "first"),
    [
        pytest.param(PID, 0, "loop/axis/position", id="PID"),
        pytest.param(LEARNING, 2, "loop/axis/position", id="learner, guard, feedforward"),
        pytest.param(COMPENSATOR, 0, "loop/axis/effort", id="compensator"),
    ],
)
def test_other_controllers_have_the_bits_of_their_c_code(
    tmp_path: Path, controller: Any, further: int, first: str
) -> None:
    """A linear law, a learner with derivatives of the reference, and u_0 of another controller."""
    main = "int main() { return bits(); }\n"
    ran(exported(tmp_path, controller), bits(further, first) + main)


@needs_gpp
@pytest.mark.trial
def test_several_axes_have_the_bits_of_the_c_code_in_chained_mode(tmp_path: Path) -> None:
    """Two axes, one with derivatives of its reference, which another controller writes."""
    program = """
int main()
{
  Loop loop(1000, {"a/effort", "b/effort"}, {"a/position", "b/position"});
  robot_state own;
  double y[2] = {0.1, -0.2}, v[2] = {0.0, 0.0}, u[2];

  if (!loop.start() || loop.controller->references().size() != 6) return 2;
  if (loop.controller->references()[3]->get_name() != "loop/b/position_derivative_1") return 3;
  if (loop.controller->states().size() != 3) return 4;
  loop.controller->chained = true;
  loop.send({9, 9, 9, 9, 9, 9});  /* is not read in chained mode */
  robot_init(&own);
  for (int k = 0; k < 3000; k++) {
    const double r[2] = {std::sin(2e-3 * k), 1.0}, r1[2] = {2.0 * std::cos(2e-3 * k), 0.0};
    const double r2[2] = {-4.0 * std::sin(2e-3 * k), 0.0}, measured[2] = {y[0] + 1e-4 * noise(), y[1]};

    for (std::size_t i = 0; i < 2; i++) {
      (void)loop.states[i]->set_value(measured[i]);
      (void)loop.controller->references()[i]->set_value(r[i]);
      (void)loop.controller->references()[2 + i]->set_value(r1[i]);
      (void)loop.controller->references()[4 + i]->set_value(r2[i]);
    }
    loop.update();
    robot_step(&own, r, measured, r1, r2, u);
    const robot_estimate known = robot_get_estimate(&own);
    if (*loop.controller->states()[2]->get_optional() != known.elbow.f) return 5;
    for (std::size_t i = 0; i < 2; i++) {
      if (!same(loop.command(i), u[i])) return 1;
      v[i] += 1e-3 * (u[0] + 0.5 * u[i] - y[i]);
      y[i] += 1e-3 * v[i];
    }
  }
  return 0;
}
"""
    ran(exported(tmp_path, ROBOT, "robot"), program, "robot")


@pytest.mark.trial
@pytest.mark.parametrize("actuators", [2, 3])
def test_compensators_of_axes_have_a_reference_for_each_actuator(
    tmp_path: Path, actuators: int
) -> None:
    """It is u_0, with the names of the commands; in code, parameters and README."""
    controller = ADDING_WIDE if actuators == 3 else ql.Axes(ADDING, [[1.0, 0.2], [0.1, 2.0]])
    folder = exported(tmp_path, controller, "robot")
    header = (folder / "src/robot_controller.hpp").read_text()
    assert f"constexpr std::size_t REFERENCES = {actuators};" in header
    assert "// Numbers in ~/reference: u_0 of each actuator." in header
    code = (folder / "src/robot_controller.cpp").read_text()
    assert "for (const auto & name : command_names_) {\n    add(" in code
    assert "u_0 of each actuator. Until the first one u_0 is 0." in (
        folder / "README.md"
    ).read_text().replace("\n", " ")


@needs_gpp
@pytest.mark.trial
def test_compensators_of_axes_have_the_bits_of_the_c_code(tmp_path: Path) -> None:
    """Two axes with three actuators, whose u_0 come as a message."""
    program = """
int main()
{
  Loop loop(1000, {"a/effort", "b/effort", "c/effort"}, {"a/position", "b/position"});
  robot_state own;
  double y[2] = {0.1, -0.2}, u[3];

  if (!loop.start() || loop.controller->references().size() != 3) return 2;
  if (loop.controller->references()[2]->get_name() != "loop/c/effort") return 3;
  robot_init(&own);
  for (int k = 0; k < 500; k++) {
    const double u_0[3] = {std::sin(2e-3 * k), 1.0, -0.5};

    for (std::size_t i = 0; i < 2; i++) {
      y[i] += 1e-3 * noise();
      (void)loop.states[i]->set_value(y[i]);
    }
    loop.send({u_0[0], u_0[1], u_0[2]});
    loop.update();
    robot_step(&own, u_0, y, u);
    for (std::size_t i = 0; i < 3; i++) {
      if (!same(loop.command(i), u[i])) return 1;
    }
  }
  return 0;
}
"""
    ran(exported(tmp_path, ADDING_WIDE, "robot"), program, "robot")


@pytest.mark.trial
@needs_gpp
def test_the_package_has_the_golden_vectors(tmp_path: Path) -> None:
    """They pass with 0 ulp."""
    folder = exported(tmp_path)
    program = tmp_path / "golden"
    command = ["gcc", "-std=c99", "-O1", "-ffp-contract=off", "-I", folder / "src",
               folder / "test/test_servo.c", folder / "src/servo.c", "-o", program, "-lm"]  # fmt: skip
    subprocess.run(command, check=True)
    done = subprocess.run([program, "0"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.trial
def test_the_descriptions_name_the_class_that_the_code_exports(tmp_path: Path) -> None:
    """package.xml, the description for pluginlib, CMakeLists.txt and the parameters fit each other."""
    folder = exported(tmp_path, ROBOT, "two_arms")
    package = ET.parse(folder / "package.xml").getroot()
    assert package.attrib == {"format": "3"}
    assert [each.tag for each in package][:5] == [
        "name", "version", "description", "maintainer", "license",
    ]  # fmt: skip
    assert package.findtext("name") == "two_arms"
    assert package.findtext("export/build_type") == "ament_cmake"
    needed = {each.text for each in package.findall("depend")}
    build = (folder / "CMakeLists.txt").read_text()
    assert set(re.search(r"set\(dependencies\n(.*?)\)", build, re.S)[1].split()) == needed
    library = ET.parse(folder / "two_arms.xml").getroot()
    (plugin,) = library.findall("class")
    assert library.attrib == {"path": "two_arms"}
    assert plugin.attrib == {
        "name": "two_arms/TwoArmsController",
        "type": "two_arms_ros2::TwoArmsController",
        "base_class_type": "controller_interface::ChainableControllerInterface",
    }
    code = (folder / "src/two_arms_controller.cpp").read_text()
    assert "two_arms_ros2::TwoArmsController, controller_interface::Chainable" in code
    assert "type: two_arms/TwoArmsController" in (folder / "config/controller.yaml").read_text()
    for path in folder.rglob("*"):
        assert path.is_dir() or not re.search(r"@\w+@", path.read_text()), path


_PACKAGES = """
set(std_msgs_TARGETS std_msgs::std_msgs)
if(NOT TARGET ${CMAKE_FIND_PACKAGE_NAME}::${CMAKE_FIND_PACKAGE_NAME})
  add_library(${CMAKE_FIND_PACKAGE_NAME}::${CMAKE_FIND_PACKAGE_NAME} INTERFACE IMPORTED)
endif()
function(pluginlib_export_plugin_description_file category file)
  if(NOT EXISTS ${PROJECT_SOURCE_DIR}/${file})
    message(FATAL_ERROR "${file} is missing")
  endif()
endfunction()
function(ament_export_targets)
endfunction()
function(ament_export_dependencies)
endfunction()
function(ament_package)
endfunction()
set(${CMAKE_FIND_PACKAGE_NAME}_FOUND TRUE)
"""


@pytest.mark.trial
@pytest.mark.skipif(shutil.which("cmake") is None, reason="cmake is missing")
def test_cmake_builds_the_golden_vectors_of_the_package(tmp_path: Path) -> None:
    """With stand-ins for the packages of ROS; the test of the package passes."""
    folder, modules = exported(tmp_path), tmp_path / "modules"
    modules.mkdir()
    packages = re.search(
        r"set\(dependencies\n(.*?)\)", (folder / "CMakeLists.txt").read_text(), re.S
    )
    for package in (*packages[1].split(), "ament_cmake"):
        (modules / f"Find{package}.cmake").write_text(_PACKAGES)
    for command in (
        ["cmake", "-B", "build", f"-DCMAKE_MODULE_PATH={modules}", "-DBUILD_TESTING=ON"],
        ["cmake", "--build", "build", "--target", "test_servo"],
        ["build/test_servo"],
    ):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


@cases(
    ("controller", "name", "rule"),
    [
        (SERVO, "Servo", "lower-case letters"),
        (SERVO, "servo__axis", "lower-case letters"),
        (SERVO, "s", "lower-case letters"),
        (SERVO, "rclcpp", "is a package that this one needs"),
        (SERVO, "2servo", "C identifier"),
        (42, "servo", "controller = 42"),
        (
            ql.ADRC(ql.ESO.model_free(2, 1.0, 20.0, 0.003), 4.0),
            "servo",
            "1/dt is 333.333; design the controller for dt = 0.003003",
        ),
        (ql.controllers.in_single_precision(SERVO), "servo", "without in_single_precision"),
    ],
)
def test_what_ros_does_not_take_is_refused_and_nothing_is_written(
    tmp_path: Path, controller: Any, name: str, rule: str
) -> None:
    """The message says what to do."""
    with pytest.raises(ValueError, match=re.escape(rule)):
        ql.export.ros2(controller, tmp_path / "out", name=name)
    assert not any(tmp_path.iterdir())


@pytest.mark.trial
def test_the_command_writes_the_package_of_one_axis_and_of_several(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It says NOT, because there is no ROS; options of the C files are refused."""
    monkeypatch.chdir(tmp_path)
    for name, setup in (("servo", TWO_MASS), ("gantry", GANTRY)):
        Path(f"{name}.toml").write_text(setup)
        arguments = ("export", f"{name}.toml", "--to", "ros2", "--out", name, "--name", name)
        shown = in_this_process(arguments, monkeypatch, capsys)
        assert shown.code == 0, shown
        assert "NOT built with ROS here: run colcon build and colcon test" in shown.out
        assert Path(name, "package.xml").is_file()
    for option in (("--precision", "single"), ("--prove",), ("--what", "loop")):
        arguments = ("export", "servo.toml", "--to", "ros2", "--out", "other", *option)
        shown = in_this_process(arguments, monkeypatch, capsys)
        assert shown.code != 0
        assert option[0] in shown.err
        assert not Path("other").exists()
