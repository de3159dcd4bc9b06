"""Generic functions, compiled and interpreted."""

from __future__ import annotations

import os
import time
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba.core import event
from numba.core.errors import NumbaError

from quell.controllers.base import control
from quell.controllers.stateful import PackedController, entry_point, step_packed
from quell.kernels import dispatch, numba_internals
from quell.kernels.cache import compile_time

from .commands import run_python

pytestmark = pytest.mark.compiled


class Circle(NamedTuple):
    """A shape."""

    radius: float


class Square(NamedTuple):
    """Another shape."""

    side: float


@dispatch.generic
def area(shape: Any, factor: float) -> float:
    """Return the area times ``factor``."""
    raise TypeError


@area.register(Circle)
def _circle(shape: Circle, factor: float) -> float:
    return 3.0 * shape.radius**2 * factor


@area.register(Square)
def _square(shape: Square, factor: float) -> float:
    return shape.side**2 * factor


@dispatch.compiled
def total(one: Any, other: Any) -> float:
    """Add areas of any shapes."""
    return area(one, 1.0) + area(other, 2.0)


def test_the_time_of_compiling_counts_once_for_an_entry_point_and_not_for_calls() -> None:
    """What an entry point calls is compiled within it; a second call compiles nothing."""

    @dispatch.compiled
    def with_cache(one: Any) -> float:
        return 2.0 * total(one, one)

    doubled = with_cache.uncached  # type: ignore[attr-defined]
    before, began = compile_time.seconds, time.perf_counter()
    assert doubled(Circle(1.0)) == 18.0
    took = compile_time.seconds - before
    assert 0.0 < took < time.perf_counter() - began
    doubled(Circle(2.0))
    assert compile_time.seconds == before + took


class MixedLaw(NamedTuple):
    """Parameters of all kinds."""

    shape: Square
    weights: np.ndarray  # not contiguous
    shift: int
    negative: bool
    step: np.float32
    mask: np.uint64
    nothing: None


class MixedState(NamedTuple):
    """A state that counts."""

    calls: np.ndarray


@control.register(MixedLaw)
def _control(law: MixedLaw, state: MixedState, r: float, y: float) -> float:
    state.calls[0] += law.shift
    total = law.shape.side * r + float(law.step) * y + float(law.mask >> np.uint64(40))
    for i in range(law.weights.shape[0]):
        for j in range(law.weights.shape[1]):
            total += law.weights[i, j] * (y + 10.0 * i + 100.0 * j)
    return -total if law.negative else total


@dispatch.compiled
def allocates(values: np.ndarray) -> float:
    """Take memory for a sum."""
    return (values + values)[0]


def test_the_type_of_the_first_argument_chooses_the_implementation() -> None:
    """Interpreted, a generic function calls what was registered for the type."""
    assert area(Circle(2.0), 1.0) == 12.0
    assert area(Square(2.0), 1.0) == 4.0


def test_compiled_and_interpreted_code_agree() -> None:
    """The same functions give the same numbers both ways."""
    assert (
        total(Circle(1.0), Square(3.0))
        == dispatch.interpreted(total)(Circle(1.0), Square(3.0))
        == 21.0
    )


def test_a_type_without_implementation_is_named_in_the_error() -> None:
    """The message says which function, which type, and what to do."""
    with pytest.raises(TypeError, match=r"area\(\) has no implementation for float; register one"):
        area(1.0, 1.0)


@dispatch.generic
def corners(shape: Any) -> int:
    """Return the number of corners."""
    raise TypeError


@corners.register(Square)
def _square_corners(shape: Square) -> int:
    return 4


@corners.register(object)
def _no_corners(shape: Any) -> int:
    return 0


@dispatch.compiled
def count_corners(one: Any, other: Any) -> int:
    """Add corners of any shapes."""
    return corners(one) + corners(other)


def test_what_is_registered_for_object_serves_all_types_without_their_own() -> None:
    """Compiled and interpreted alike."""
    assert (
        count_corners(Circle(1.0), Square(1.0))
        == dispatch.interpreted(count_corners)(Circle(1.0), Square(1.0))
        == 4
    )


def add_area(shape: Any, sides: Any, i: int, sum_so_far: float, factor: float) -> float:
    """Return the sum with the area of one more shape, weighted by its place."""
    sides[0] += 10.0 * i
    return 2.0 * sum_so_far + area(shape, factor)


def set_side(shape: Any, sides: Any, i: int, factor: float) -> None:
    """Write the place of a shape, times a factor."""
    sides[0] = i * factor


add_areas = dispatch.for_each("add_areas", add_area)
set_sides = dispatch.for_each("set_sides", set_side)


@dispatch.compiled
def total_of_all(shapes: Any, sides: Any) -> float:
    """Return the weighted sum of shapes of any types."""
    found = add_areas(shapes, sides, 1.0, 0.5)
    set_sides(shapes, sides, 4.0)
    return float(found)


def test_what_is_done_for_each_entry_of_a_tuple_hands_its_value_on() -> None:
    """1 → 2·1 + 6 = 8 → 2·8 + 4.5 = 20.5, with the places 0 and 1, compiled and interpreted."""
    for call in (total_of_all, dispatch.interpreted(total_of_all)):
        sides = (np.zeros(1), np.zeros(1))
        assert call((Circle(2.0), Square(3.0)), sides) == 20.5
        assert [float(each[0]) for each in sides] == [0.0, 4.0]
    assert add_areas((), (), 1.0, 0.5) == 1.0
    assert add_areas.__doc__ == add_area.__doc__


def test_a_second_call_with_the_same_types_does_not_compile_again() -> None:
    """One compilation serves all values of the same types."""
    total(Circle(1.0), Circle(2.0))
    before = len(total.signatures)
    total(Circle(5.0), Circle(6.0))
    assert len(total.signatures) == before


def test_compiled_code_cannot_allocate() -> None:
    """Without reference counting Numba refuses whatever takes memory, which proves that kernels take none."""
    with pytest.raises(NumbaError, match="NRT required"):
        allocates(np.ones(3))


@pytest.mark.trial
def test_code_of_ones_own_is_not_taken_from_the_disk_cache(tmp_path: Path) -> None:
    """A plant in the user's module is compiled anew in each process: the cache would not notice that it was edited."""
    module = """
from typing import NamedTuple
import numpy as np
import quell as ql
from quell.plants.base import advance, measure

class Decay(NamedTuple):
    rate: float

@measure.register(Decay)
def _measure(plant, x):
    return x[0]

@advance.register(Decay)
def _advance(plant, x, scratch, t, u, w):
    x[0] += 0.01 * (u - RATE * x[0])

class Mine:
    name, order, disturbances, compiled = "mine", 1, 1, True
    def sampled(self, dt, interpret=False):
        return Decay(1.0)
"""
    script = """
import quell as ql, mine
controller = ql.baselines.PID(1.0, dt=0.01)
runs = [ql.simulate(mine.Mine(), controller, ql.Scenario(1.0, 1.0), interpret=i) for i in (False, True)]
print(abs(runs[0]["y"] - runs[1]["y"]).max() < 1e-9, runs[0]["y"][-1])
"""
    shown = []
    for rate in ("1.0", "30.0"):
        (tmp_path / "mine.py").write_text(module.replace("RATE", rate))
        environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
        shown.append(run_python(script, cwd=tmp_path, env=environment).stdout.split())
    assert [agree for agree, _ in shown] == ["True", "True"]
    assert shown[0][1] != shown[1][1]


@pytest.mark.trial
def test_without_numbas_compiler_a_controller_steps_and_simulates_as_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With ``NUMBA_DISABLE_JIT=1``: a step, a run and a batch of it, with the bits of an interpreted run."""
    script = """
import quell as ql
controller = ql.baselines.PID(1.0, 0.5, dt=0.01)
plant = ql.plants.LinearPlant([[-1.0]], [1.5], [1.0])
run = ql.simulate(plant, controller, ql.Scenario(1.0, 0.5))
assert (ql.simulate([plant], controller, ql.Scenario(1.0, 0.5))["y"][0] == run["y"]).all()
found = float(run["y"][-1]), controller.step(1.0, 0.25)
"""
    given: dict[str, Any] = {}
    with monkeypatch.context() as patch:
        patch.setattr(dispatch, "interpret_all", True)
        exec(script, given)
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    shown = run_python(script + "print(*found)", cwd=tmp_path, env=environment).stdout
    assert tuple(map(float, shown.split())) == given["found"]


@dispatch.kernel
def _checked(value: float) -> float:
    print("it was", value)
    if value > 2.0:
        raise ValueError("too much")
    return value


@dispatch.compiled
def prints(value: float) -> float:
    """Call a kernel that prints and may raise."""
    return _checked(value) + 1.0


def test_a_kernel_prints_and_raises_in_what_it_is_inlined_into(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Who looks for a mistake in a learner of their own prints from it: what Numba needs for that is there."""
    assert prints.uncached(1.0) == 2.0
    assert capsys.readouterr().out == "it was 1.0\n"
    with pytest.raises(ValueError, match="too much"):
        prints.uncached(3.0)


@dispatch.kernel
def _tripled(value: float) -> float:
    return 3.0 * value


@dispatch.compiled
def triple(value: float) -> float:
    """Run without the interpreter lock."""
    return _tripled(value)


@dispatch.compiled_call
def triple_in_a_short_call(value: float) -> float:
    """Keep the interpreter lock."""
    return _tripled(value)


def test_all_kinds_of_entry_points_share_a_compiled_kernel() -> None:
    """What a simulation compiled of a controller is there for its ``step``."""
    with event.install_recorder("numba:compile") as recorder:
        assert triple.uncached(1.0) == triple_in_a_short_call.uncached(1.0) == 3.0
    compiled = [what.data["dispatcher"].py_func for _, what in recorder.buffer if what.is_start]
    assert compiled.count(_tripled) == 1
    assert len(compiled) == 3


def test_in_a_block_as_python_nothing_is_compiled() -> None:
    """Neither called at once nor kept for later calls; after the block it is."""
    with dispatch.as_python():
        assert dispatch.is_available(triple, 1.0)
        assert dispatch.specialised(triple, 1.0) is triple.plain
        assert dispatch.call_specialised(triple, 2.0) == 6.0
    assert dispatch.specialised(triple, 1.0) is not triple.plain


def test_a_packed_controller_has_the_parameters_and_the_state_of_the_interpreted_one() -> None:
    """Nested, negative, true and strided ones; new parameters of the same types need no other code."""
    table = np.arange(24.0).reshape(4, 6)
    weights = table[::2, ::3]
    scalars = (-7, True, np.float32(0.75), np.uint64(2**64 - 5), None)
    law, state = MixedLaw(Square(3.0), weights, *scalars), MixedState(np.zeros(1, np.int64))
    packed = PackedController(law, state)
    step = entry_point(step_packed.uncached, packed)
    assert step(packed, 2.0, 0.5) == control(law, state, 2.0, 0.5)
    other = law._replace(
        shape=Square(-1.0), weights=(table + 1.0)[::2, ::3], shift=2, negative=False
    )
    with pytest.raises(TypeError, match="contain 'three': must be numbers, arrays, or tuples"):
        PackedController(law._replace(shift="three"), state)
    packed = PackedController(other, state, before=packed)
    assert step(packed, 2.0, 0.5) == control(other, state, 2.0, 0.5)
    assert state.calls[0] == 2 * (2 - 7)


def test_an_older_numba_is_refused_and_a_newer_one_is_warned_about() -> None:
    """Both say which version is tested and how to install it; the tested ones are silent."""
    remedy = r"tested with Numba 0\.68, and this is {}.*pip install 'numba==0\.68\.\*'"
    for version in ("0.61.2", "0.67.0", "0.9"):
        with pytest.raises(ImportError, match=remedy.format(version)):
            numba_internals.check_version(version)
    for version in ("0.69.0", "0.100.0rc1", "1.0.0", "unknown"):
        with pytest.warns(RuntimeWarning, match=remedy.format(version)):
            numba_internals.check_version(version)
        assert not numba_internals.is_tested(version)
    for version in ("0.68.0", "0.68.1", "0.68.2dev0+3.gabc"):
        numba_internals.check_version(version)
        assert numba_internals.is_tested(version)


@pytest.mark.trial
def test_a_numba_that_lacks_what_kernels_need_is_named_at_the_import() -> None:
    """One of another version, whose private modules have moved, is no riddle of a missing name."""
    program = (
        "import sys, numba\n"
        "sys.modules['numba.core.targetconfig'] = None\n"
        "numba.__version__ = '0.75.0'\n"
        "import quell.kernels.linking\n"
    )
    failed = run_python(program, check=False)
    assert failed.returncode != 0
    assert "0.75.0 lacks what it needs" in failed.stderr
    assert "pip install 'numba==0.68.*'" in failed.stderr


def test_the_oldest_numba_that_can_be_installed_is_the_oldest_that_is_tested() -> None:
    """In the requirements of the package."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))
    needs = [need for need in project["project"]["dependencies"] if need.startswith("numba")]
    assert needs == ["numba>={}.{}".format(*numba_internals.OLDEST)]
