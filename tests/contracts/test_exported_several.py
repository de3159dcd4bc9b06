"""Every example controller of several signals is written, or refused by name, in each form.

C and FMU of them are compared with the kernels in ``test_exported_options``, ``test_axes_export``
and ``test_fmu_export``; here are ROS 2 and Structured Text, whose texts are made of the same C.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

import quell as ql
from quell.controllers import in_single_precision
from quell.export import TranslationError, c_source, ros2, st
from quell.setup import EXAMPLES, load, read
from quell.setup.description import is_of_axes
from tests.test_axes_export import ROWS

from .test_controllers import SEVERAL

FILES = [
    file
    for folder in (EXAMPLES, Path(__file__).parents[2] / "examples")
    for file in sorted(folder.glob("*.toml"))
    if is_of_axes(read(file)[1])
]
EVERY: dict[str, Any] = {
    **{name: lambda given=given: given for name, given in SEVERAL.items()},
    **{f"axes, {name}": make for name, make in ROWS.items()},
    **{file.name: lambda file=file: load(file).controller for file in FILES},
}
# What a form does not have, and what its message says to do instead.
REFUSED = {
    "ros2": ("StateFeedback",),
    "st": (*EVERY,),
}
INSTEAD = {"ros2": "quell.export.c", "st": "export each axis by itself as an ADRC|use --to c"}


@pytest.mark.trial
def test_there_are_examples_of_all_kinds() -> None:
    """Axes, state feedback, compensators, functions of B0, and files."""
    kinds = {type(make()).__name__ for make in EVERY.values()}
    assert kinds == {"Axes", "StateFeedback"}
    assert len(FILES) >= 1


@pytest.mark.trial(cases="ros2|M-st|actuators-st")
@pytest.mark.parametrize("form", ["ros2", "st"])
@pytest.mark.parametrize("name", EVERY)
def test_a_controller_of_several_signals_is_written_or_refused_by_name(
    name: str, form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A package has its C code, with as many signals; what is refused leaves no file behind."""
    controller, out = EVERY[name](), tmp_path / "out"
    write = {"ros2": ros2, "st": st}[form]
    # The golden vectors of the same C code are run in other tests, and take long to make.
    module = sys.modules[ros2.__module__]
    monkeypatch.setattr(module, "golden_vectors", lambda *_: None)
    monkeypatch.setattr(module, "test_program", lambda *_: "")
    sources: list[Any] = []
    monkeypatch.setattr(module, "c_source", lambda *a: sources.append(c_source(*a)) or sources[-1])
    if name in REFUSED[form]:
        with pytest.raises(TranslationError, match=INSTEAD[form]) as told:
            write(controller, out, name="robot")
        what = "axes" if isinstance(controller, ql.Axes) else type(controller).__name__
        assert str(told.value).startswith("controller ")
        assert what in str(told.value)
        assert not out.exists()
        return
    files = {
        path.relative_to(out).as_posix(): path for path in write(controller, out, name="robot")
    }
    assert files["src/robot.c"].read_text() == sources[0].source
    assert len(sources[0].axes) == controller.outputs
    code = files["src/robot_controller.cpp"].read_text()
    assert "robot_step(&state_, r.data(), y.data()" in code
    header = files["src/robot_controller.hpp"].read_text()
    assert f"AXES = {controller.outputs};" in header
    assert f"ACTUATORS = {controller.inputs};" in header


@pytest.mark.parametrize("write", [ros2, st])
def test_axes_in_single_precision_are_refused_by_name(write: Any, tmp_path: Path) -> None:
    """The interfaces of ros2_control are in double; a function block is of one u and one y."""
    single = in_single_precision(SEVERAL["Axes"])
    with pytest.raises(TranslationError, match="single precision|2 axes"):
        write(single, tmp_path / "out", name="robot")
    assert not (tmp_path / "out").exists()
