"""``ros2``: a controller as a package of ROS 2, with a chainable controller of ros2_control.

The package has the C code of ``quell.export.c``, a class in C++ that connects it to the interfaces
of the controller manager (those of ROS 2 Jazzy), and the golden vectors as a test of the package.
"""

from __future__ import annotations

import os
import re
from importlib import resources
from pathlib import Path
from typing import Any

from quell import checks
from quell.controllers.base import check_controller
from quell.controllers.state_space import StateFeedback
from quell.export.c_files import CSource
from quell.export.controller_source import c_source, in_double_precision, is_in_single, limits_path
from quell.export.library.vectors import fill, golden_vectors, test_program
from quell.export.translate.text import TranslationError, checked_name
from quell.files import check_folder, write_folder

# The files of the package, by template; NAME becomes the name.
_FILES = {
    "package.xml": "package.xml",
    "CMakeLists.txt": "CMakeLists.txt",
    "NAME.xml": "plugin.xml",
    "README.md": "README.md",
    "config/controller.yaml": "config.yaml",
    "src/NAME_controller.hpp": "controller.hpp",
    "src/NAME_controller.cpp": "controller.cpp",
}

# A rate that differs by more from a whole number is another rate.
_ROUNDING = 1e-9


def ros2(
    controller: Any,
    folder: str | os.PathLike[str],
    *,
    name: str = "controller",
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write a controller as a package of ROS 2 Jazzy: a chainable controller of ros2_control.

    The references are reference interfaces, which another controller may write, or numbers in
    ``~/reference``; y are state interfaces and u command interfaces, by parameters. The C code
    within has the bits of the interpreted kernels, in double precision.

    Parameters
    ----------
    controller
        any controller that does not call Python or C, or several axes (``quell.Axes``); with what
        it has learned.
    folder
        where to write; must be new or empty.
    name
        of the package, which begins all names in C; for ROS in lower case.
    overwrite
        whether files of the same names in the folder may be replaced.

    Returns
    -------
    tuple of Path
        the files.

    Raises
    ------
    ValueError
        for a name that ROS, C or C++ does not take, a folder with files, a sample time of which no
        whole number makes a second, a controller in single precision, and one with parts in Python
        or C (``TranslationError``). Nothing is written then.
    """
    check_controller(controller, several=True)
    if isinstance(in_double_precision(controller), StateFeedback):
        raise TranslationError(
            "controller is StateFeedback: a package is of one u and y, or of axes; write its C "
            "with quell.export.c and call it in a controller of your own"
        )
    checked_name(name, "CMake", "ROS 2")
    if not re.fullmatch(r"[a-z](_?[a-z0-9])+", name):
        rule = "a package of ROS has lower-case letters, digits and single _; choose another name"
        raise TranslationError(f"name = {name!r}: {rule}")
    check_folder(folder, checks.flag("overwrite", overwrite))
    if is_in_single(controller):
        raise TranslationError(
            "controller is in single precision: the interfaces of ros2_control are in double; "
            "export the controller itself, without in_single_precision"
        )
    rate = _rate(float(controller.dt))
    source = c_source(controller, name)
    test = test_program(source, golden_vectors(controller, source))
    if source.externals:
        raise TranslationError(
            f"controller calls {', '.join(source.externals)} in C: a package needs the file, too; "
            'write it with --to c and add both to "add_library" of a package'
        )
    values = _values(controller, source, rate)
    templates = resources.files("quell.export") / "templates" / "ros2"
    texts = {
        path.replace("NAME", name): fill((templates / template).read_text("utf-8"), values)
        for path, template in _FILES.items()
    }
    own = {
        f"src/{name}.h": source.header,
        f"src/{name}.c": source.source,
        f"test/test_{name}.c": test,
        "LICENSE": (resources.files("quell.export.library") / "templates/LICENSE").read_text(),
    }
    return write_folder(folder, texts | own, overwrite)


def _rate(dt: float) -> int:
    """Return the update rate [Hz], which controller managers have as a whole number."""
    rate = round(1.0 / dt)
    if rate < 1 or abs(rate * dt - 1.0) > _ROUNDING:
        raise TranslationError(
            f"dt = {dt!r}: the update rate of ros2_control is a whole number of Hz, and 1/dt is "
            f"{1.0 / dt:.6g}; design the controller for dt = {1.0 / max(rate, 1):.6g}, for instance"
        )
    return rate


def _values(controller: Any, source: CSource, rate: int) -> dict[str, object]:
    """Return the values of the templates."""
    name, several = source.name, bool(source.axes)
    axes, actuators = (len(source.axes), source.sizes[2]) if source.sizes else (1, 1)
    given, own = source.given, source.sizes[0] if source.sizes else 1
    references = own * (1 + len(source.further))
    owner = " of each actuator" if given == "u_0" else " of each axis"
    meaning = ", ".join(f"{each}{owner * several}" for each in (given, *source.further))
    step = _step_of_axes(source) if several else _step(source)
    limits = "limits" if several else limits_path(controller)
    low, high = (f"parameters_.{limits}.{each}{'[k]' * several}" for each in ("low", "high"))
    places = [f"estimate.{member}" for member in source.axes] if several else ["estimate"]
    has_f = [_has_f(source, i) for i in range(axes)]
    exported = [i for i in range(axes) if has_f[i]]
    title = f"Controller {type(in_double_precision(controller)).__name__}"
    if several:
        title = f"Controller of {axes} axes with {actuators} actuators"
    joints = source.axes if several else ("joint",)
    commands = joints if axes == actuators else [f"actuator{k + 1}" for k in range(actuators)]
    return {
        "name": name, "NAME": name.upper(), "class": _class_name(name), "title": title,
        "dt": repr(float(controller.dt)), "rate": rate, "axes": axes, "actuators": actuators,
        "references": references, "reference_meaning": meaning,
        "reference_names": "command_names_" if given == "u_0" else "state_names_",
        "further_names": ", ".join(f'"{each}"' for each in _interface_names(source)),
        "step": step, "applied": "applied.data()" if several else "applied[0]",
        "low": low, "high": high,
        "export_disturbances": "".join(
            "  exported.push_back(std::make_shared<hardware_interface::StateInterface>(\n"
            f'      prefix + "/" + joint_of(state_names_[{i}]),\n'
            f'      interface_of(state_names_[{i}]) + "_disturbance"));\n' for i in exported),
        "write_disturbances": "".join(
            f"  (void)ordered_exported_state_interfaces_[{k + 1}]->set_value({places[i]}.f);\n"
            for k, i in enumerate(exported)),
        "disturbance_text": ", `@/joint/position_disturbance` the estimated f"
            .replace("@", name) if exported else "",
        "before_reference": "Until the first one u_0 is 0." if given == "u_0" else
            "Until the first one\nr is the measured y, so that nothing is asked for.",
        "example_commands": ", ".join(f"{each}/effort" for each in commands),
        "example_states": ", ".join(f"{each}/position" for each in joints),
        "example_lows": ", ".join(["-1.0"] * actuators),
        "example_highs": ", ".join(["1.0"] * actuators),
    }  # fmt: skip


def _class_name(name: str) -> str:
    """Return ``ServoAxisController`` for ``servo_axis`` and for ``servo_axis_controller``."""
    words = name.removesuffix("_controller").split("_")
    return "".join(word.capitalize() for word in words) + "Controller"


def _interface_names(source: CSource) -> list[str]:
    """Return what the names of further reference interfaces end in."""
    derivatives = [f"derivative_{i + 1}" for i in range(source.derivatives)]
    return derivatives + [f"signal_{i + 1}" for i in range(source.signals)]


def _has_f(source: CSource, axis: int) -> bool:
    """Return whether the estimate of an axis has the total disturbance."""
    prefix = f"{source.axes[axis]}." if source.axes else ""
    names = {channel for channel, _ in source.channels}
    return {f"{prefix}f_residual", f"{prefix}f_learned"} <= names


def _step(source: CSource) -> str:
    """Return the call of a step of one u and y."""
    further = "".join(f", r[{i + 1}]" for i in range(len(source.further)))
    return f"u[0] = {source.name}_step(&state_, r[0], y[0]{further})"


def _step_of_axes(source: CSource) -> str:
    """Return the call of a step of several axes."""
    further = "".join(f", r.data() + {i + 1} * AXES" for i in range(len(source.further)))
    return f"{source.name}_step(&state_, r.data(), y.data(){further}, u.data())"
