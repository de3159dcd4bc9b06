"""Rules of setup files: schemas of single tables, tasks of tuning, memory files and viewers of a run."""

from __future__ import annotations

import json
import math
import signal
import tempfile
import tomllib
from email.message import Message
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pytest

import quell as ql
from quell import checks
from quell.realtime.memory_file import MemoryFile, memory_file
from quell.realtime.viewers import Viewers, is_local
from quell.setup import SetupError, made, registry
from quell.setup import json_schema as rules
from quell.setup.axes import _markov, axes_task
from quell.setup.loading import _type, tuning_task
from quell.setup.points import _merged, schedule_task

from .cases import cases
from .setups import GANTRY, TWO_MASS


def schema_of(table: Any) -> dict[str, Any]:
    """Return the schema of a table."""
    found: dict[str, Any] = table.model_json_schema(
        schema_generator=rules._Generator, ref_template="#/$defs/{model}"
    )
    return found


def judge(table: Any) -> Any:
    """Return whether the schema of a table takes values of its keys."""
    validator = jsonschema.Draft7Validator(schema_of(table))
    return lambda **values: validator.is_valid(values)


# ---- the schema of a table


def test_the_schema_of_an_observer_takes_what_its_class_takes() -> None:
    """Ranges, choices, whole numbers, finite ones; each against the class itself."""
    taken = judge(registry.OBSERVERS["model-free"])
    good = {"kind": "model-free", "order": 2, "b0": 1.5, "omega_o": 20.0}
    assert taken(**good)
    for changed in (
        {"order": 0}, {"order": 9}, {"order": 1.5}, {"b0": 0.0}, {"omega_o": 0.0}, {"omega_o": -1.0},
        {"form": "curent"}, {"half_gain": 1}, {"delay": -1.0}, {"disturbance_order": 4},
        {"omega_o": "fast"}, {"b0": None}, {"omega_o": None}, {"poles": [[-1.0]]}, {"poles": -1.0},
    ):  # fmt: skip
        assert not taken(**{**good, **changed}), changed
        if isinstance(next(iter(changed.values())), int | float) and "half_gain" not in changed:
            with pytest.raises((ValueError, TypeError)):
                ql.ESO.model_free(
                    dt=1e-3, **{k: v for k, v in {**good, **changed}.items() if k != "kind"}
                )
    for changed in (
        {"order": 8}, {"b0": -1.0}, {"form": "reduced"}, {"delay": 0.0}, {"disturbance_order": 3},
        {"poles": "none"}, {"poles": [-1.0, -2.0, [-1.0, 0.5]]},
    ):  # fmt: skip
        assert taken(**{**good, **changed}), changed
    for missing in ("order", "b0", "omega_o"):
        assert not taken(**{key: value for key, value in good.items() if key != missing})
    assert not taken(**good, omega_0=3.0)


def test_limits_may_be_infinite_and_gains_may_not() -> None:
    """Some editors hand on null for inf; text ``none`` where the default is none."""
    taken = judge(registry.CONTROLLERS["pid"])
    assert taken(kind="pid", kp=1.0)
    assert taken(kind="pid", kp=1.0, u_max=None, u_min=-1.0, rate_limit=None)
    assert not taken(kind="pid", kp=None)
    assert not taken(kind="pid", kp=1.0, rate_limit=0.0)
    assert not taken(kind="pid", kp=1.0, tt=-1.0)
    assert taken(kind="pid", kp=1.0, tt="none")
    assert not taken(kind="pid", kp=1.0, tt="nothing")


def test_each_signal_has_its_kind_and_no_other_keys() -> None:
    """A const with a description; JSON without infinite numbers."""
    for kind in ("step", "ramp", "sinusoid", "noise"):
        found = schema_of(registry.SIGNALS[kind])
        found = found if "properties" in found else found["$defs"][kind]
        assert found["properties"]["kind"]["const"] == kind
        assert found["properties"]["kind"]["description"]
        assert found["additionalProperties"] is False
        json.dumps(found, allow_nan=False)


def test_the_rules_of_a_class_are_those_of_its_checks() -> None:
    """As JSON Schema has them."""
    found = rules._rules(registry.CONTROLLERS["pid"])
    assert found["kp"] == {"minimum": -math.inf, "maximum": math.inf} or "maximum" in found["kp"]
    assert found["rate_limit"] == {"exclusiveMinimum": 0}
    assert found["tf"]["minimum"] == 0
    assert found["tt"]["exclusiveMinimum"] == 0
    assert "u_min" not in found  # its rule depends on u_max
    assert rules._told(lambda: checks.positive("dt", math.nan), "dt")["exclusiveMinimum"] == 0
    assert rules._told(lambda: checks.positive("dt", math.nan), "other") == {}
    assert rules._told(lambda: None, "dt") == {}
    entry = rules._told(lambda: checks.vector("x", [math.nan]), "x")
    assert entry == {} or "items" in entry


def test_values_that_every_check_refuses_follow_from_a_type() -> None:
    """NaN and zero of a number, a half of a whole one, negative entries, a text that nothing is."""
    assert rules._refused(int) == (0.5,)
    assert rules._refused(str) == ("\x00",)
    assert rules._refused(tuple[float, ...])[0] == (-1.0,)
    values = rules._refused(float)
    assert math.isnan(values[0])
    assert values[1] == 0.0
    assert rules._refused(float | tuple[float, ...])[2] == (-1.0,)
    assert rules._kinds(float | None) == {float, type(None)}
    assert rules._kinds(tuple[float, ...]) == {tuple}
    assert rules._kinds(int | tuple[int, int] | None) == {int, tuple, type(None)}


def test_an_allowed_value_is_known_where_the_rule_tells_it() -> None:
    """A choice, the least whole number, a pair of numbers; else none."""
    assert rules._allowed({"enum": ["a", "b"]}, 3) == "a"
    assert rules._allowed({"type": "integer", "minimum": 1}, 3.5) == 1
    assert rules._allowed({"type": ["number", "array"]}, "x") == [1.0, 2.0]
    assert rules._allowed({"exclusiveMinimum": 0}, -1.0) is None

    def form(form: str, count: Any) -> None:
        checks.one_of("form", form, ("a", "b"))
        checks.whole("count", count, 2)

    assert rules._settled(form, {"form": "\x00", "count": 0.5}) == {"form": "a", "count": 2}
    assert rules.plant(0).A.tolist() == [[0.0, 1.0], [0.0, 0.0]]
    assert rules.plant(1).order == 3
    assert (rules.observer(0).order, rules.observer(1).order) == (2, 3)


def test_a_rule_joins_what_the_type_says() -> None:
    """Finite numbers are no null, choices replace a text, rules of items stay beside lists."""
    number = {"type": ["number", "null"], "description": "d"}
    assert rules._joined(number, {}, False) == number
    finite = rules._joined(number, {"minimum": 0, "maximum": 9.0}, False)
    assert finite == {"type": "number", "description": "d", "minimum": 0, "maximum": 9.0}
    half = rules._joined(number, {"exclusiveMinimum": 0}, False)
    assert half == {"type": ["number", "null"], "description": "d", "exclusiveMinimum": 0}
    text = {"type": "string", "not": rules.NONE, "default": "a"}
    assert rules._joined(text, {"enum": ["a", "b"]}, False) == {"default": "a", "enum": ["a", "b"]}
    assert rules._joined(text, {"enum": ["a"]}, True)["enum"] == ["a", "none"]
    lists = {"anyOf": [{"type": "string"}, {"type": "array"}]}
    assert rules._joined(lists, {"enum": ["a"]}, False) == {
        "anyOf": [{"type": "array"}, {"enum": ["a"]}]
    }
    items = {"type": "array"}
    assert rules._joined(items, {"type": "array", "items": {"minimum": 0}}, False) == {
        "type": "array",
        "allOf": [{"items": {"minimum": 0}}],
    }
    assert rules._joined({}, {"type": checks.NUMBERS["type"]}, True) == {
        "anyOf": [{"type": checks.NUMBERS["type"]}, rules.NONE]
    }
    assert rules._joined(items, {"type": checks.NUMBERS["type"]}, True) == items


def test_unions_of_tables_have_one_definition_each() -> None:
    """The same union at two keys is one; another one at a key of that name gets a number."""
    union = {"if": 1, "then": 2, "else": 3, "anyOf": [4]}
    names = rules._Names(["plant"])
    schema = {"properties": {"load": {**union, "description": "d"}, "w": {"items": union}}}
    found = names.shortened(schema)
    first = {"$ref": "#/definitions/load-of-any-kind"}
    assert found["properties"]["load"] == {"description": "d", "allOf": [first]}
    assert found["properties"]["w"] == {"items": {"allOf": [first]}}
    other = names.shortened({"properties": {"load": {**union, "else": 5}}})
    assert other["properties"]["load"] == {"allOf": [{"$ref": "#/definitions/load-of-any-kind-2"}]}
    assert names.added["load-of-any-kind"] == union
    assert len(names.added) == 2
    either = rules._if({"x": 1}, {"a": 1}, {"b": 1})
    assert either == {
        "if": {"x": 1},
        "then": {"a": 1},
        "else": {"b": 1},
        "anyOf": [{}, {"a": 1}, {"b": 1}],
    }


# ---- tasks of tuning


def written(folder: Path, text: str) -> Path:
    """Return a setup file."""
    path = folder / "setup.toml"
    path.write_text(text, encoding="utf-8")
    return path


PLANT = """
dt = 0.05
[plant]
kind = "linear"
A = [[-1.0]]
B = [2.0]
C = [1.0]
"""


def test_a_task_of_tuning_has_the_plant_and_the_limits_of_the_file(tmp_path: Path) -> None:
    """Limits of the controller unless the command has others; bounds are those of [tune]."""
    path = written(
        tmp_path,
        PLANT + "[controller]\nkind = 'pid'\nkp = 1.0\nu_min = -1.0\nu_max = 2.0\n"
        "[tune]\nstructure = 'pi'\nu_max = 1.5\n",
    )
    task = tuning_task(path)
    assert task.dt == 0.05
    assert task.plant.A.tolist() == [[-1.0]]
    assert task.plant.B.tolist() == [[2.0]]
    assert (task.options["u_min"], task.options["u_max"]) == (-1.0, 2.0)
    assert task.options["constraints"].u_max == 1.5  # of [tune]: a bound of the response
    assert task.options["structure"] == "pi"
    assert task.options["constraints"].noise == 0.0
    assert "uncertain" not in task.options
    asked = tuning_task(path, {"structure": "pid"}, limits={"u_max": 1.2})
    assert asked.options["structure"] == "pid"
    assert asked.options["u_max"] == 1.2
    tables = task.options["setup"]
    assert tables["plant"]["B"] == [2.0]
    assert "controller" not in tables


def test_delay_and_lag_of_a_task_become_those_of_the_plant(tmp_path: Path) -> None:
    """In the tables of the file that is written, and not twice."""
    text = PLANT + "[tune]\nstructure = 'pi'\ndelay = 0.1\nactuator_lag = 0.3\n"
    task = tuning_task(written(tmp_path, text))
    assert (task.options["delay"], task.options["actuator_lag"]) == (0.1, 0.3)
    plant = task.options["setup"]["plant"]
    assert (plant["kind"], plant["delay"], plant["plant"]["lag"]) == ("delayed", 0.1, 0.3)
    assert plant["plant"]["plant"]["A"] == [[-1.0]]
    assert task.options["setup"]["tune"] == {"structure": "pi"}
    assert task.options["written"].plant.order == 1 + 1 + 2


def test_ranges_of_a_plant_make_a_task_for_all_of_them(tmp_path: Path) -> None:
    """A function of the ranges' keys; none is an error, an unknown one, too."""
    text = TWO_MASS.replace(
        'kind = "two-mass"\n', 'kind = "two-mass"\nuncertain = { m1 = [0.6, 1.4] }\n'
    )
    task = tuning_task(written(tmp_path, text), {"structure": "pi"})
    assert task.options["uncertain"] == {"m1": (0.6, 1.4)}
    light, heavy = task.plant(m1=0.6), task.plant(m1=1.4)
    ratio = np.max(np.abs(light.B)) / np.max(np.abs(heavy.B))
    assert ratio == pytest.approx(1.4 / 0.6)
    empty = text.replace("{ m1 = [0.6, 1.4] }", "{ }")
    with pytest.raises(
        SetupError, match=r"plant.uncertain: is empty; give a range, m1 = \[0.6, 1.4\]"
    ):
        tuning_task(written(tmp_path, empty))
    with pytest.raises(SetupError, match="mass"):
        tuning_task(written(tmp_path, text.replace("m1 =", "mass =")))
    with pytest.raises(SetupError, match="tune.storage = 'x': has no effect without trials"):
        tuning_task(written(tmp_path, TWO_MASS), {"storage": "x"})


def test_a_feedforward_of_the_controller_is_kept_where_the_structure_can_have_it(
    tmp_path: Path,
) -> None:
    """The inertia of a cascade is a rigid model; a PID controller has none."""
    given = (
        "[controller]\nkind = 'p-pi'\nkv = 2.0\nkp = 3.0\ntn = 1.0\ninertia = 0.5\nviscous = 0.1\n"
    )
    path = written(tmp_path, PLANT + given)
    options = tuning_task(path, {"structure": "simplest"}).options
    assert options["feedforward"].coefficients[1:] == pytest.approx((0.1, 0.5))
    assert "feedforward" not in tuning_task(path, {"structure": "pid"}).options


def test_a_task_of_axes_has_the_file_and_its_changes(tmp_path: Path) -> None:
    """Constraints of [tune] and of the command; a linear plant has no operating points."""
    setup, options = axes_task(written(tmp_path, GANTRY + "[tune]\nB0_off = 0.1\n"))
    assert options["B0_off"] == 0.1
    assert "operating_points" not in options
    assert options["setup"]["axis"][0]["name"] == "x"
    assert setup.needed("plant").order == 4
    _, options = axes_task(written(tmp_path, GANTRY), {"B0_off": 0.3, "objective": "load"})
    assert (options["B0_off"], options["objective"]) == (0.3, "load")
    _, options = axes_task(written(tmp_path, GANTRY))
    assert options.keys() == {"setup"}


def test_the_b0_of_a_plant_is_the_gain_of_the_highest_derivative() -> None:
    """C A^(n − 1) B of each output: (5, 0.5) and (0.4, 6) of the gantry; not beside M."""
    found = load_text_of_axes(GANTRY)
    np.testing.assert_allclose(found.controller.B0, [[5.0, 0.5], [0.4, 6.0]])
    assert found.controller.names == ("x", "y")
    assert found.controller.limits.high.tolist() == [20.0, 30.0]
    assert found.controller.limits.low.tolist() == [-25.0, -25.0]
    with pytest.raises(SetupError, match='B0 = "plant" and M: are two of the same'):
        load_text_of_axes(
            GANTRY.replace('B0 = "plant",', 'B0 = "plant", M = [[1.0, 0.0], [0.0, 1.0]],')
        )
    with pytest.raises(SetupError, match="B0"):
        load_text_of_axes(GANTRY.replace('B0 = "plant"', 'B0 = "model"'))
    one = np.zeros((2, 4))
    one[0, 0] = one[1, 2] = 1.0
    plant = ql.plants.LinearPlant(np.eye(4, k=1), np.eye(4)[:, [1, 3]], one)
    np.testing.assert_allclose(_markov(plant, [2, 2]), one @ np.eye(4, k=1) @ np.eye(4)[:, [1, 3]])
    with pytest.raises(
        ValueError, match="the plant has 2 outputs, there are 1 axes: must be as many"
    ):
        _markov(plant, [2])


def load_text_of_axes(text: str) -> Any:
    """Return a setup of axes."""
    return made("setup.toml", tomllib.loads(text))


# ---- schedules

SCHEDULE = """
dt = 0.05
[plant]
kind = "linear"
A = [[-1.0]]
B = [2.0]
C = [1.0]
[controller]
u_min = -1.0
u_max = 1.5
[tune]
structure = "bandwidths"
[[tune.schedule.points]]
at = 1.0
plant = { B = [4.0] }
[[tune.schedule.points]]
at = 0.0
plant = { A = [[-3.0]] }
"""


def test_points_of_a_schedule_change_the_plant_of_the_file(tmp_path: Path) -> None:
    """In their order; limits are those of the controller, the file's plant that of the middle."""
    task = schedule_task(written(tmp_path, SCHEDULE))
    assert list(task.plant) == [(0.0,), (1.0,)]
    assert task.plant[(0.0,)].A.tolist() == [[-3.0]]
    assert task.plant[(0.0,)].B.tolist() == [[2.0]]
    assert task.plant[(1.0,)].A.tolist() == [[-1.0]]
    assert task.plant[(1.0,)].B.tolist() == [[4.0]]
    assert task.dt == 0.05
    assert (task.options["u_min"], task.options["u_max"]) == (-1.0, 1.5)
    assert task.options["structure"] == "bandwidths"
    assert "between" not in task.options
    assert task.options["setup"]["plant"]["B"] == [4.0]
    limited = schedule_task(
        written(tmp_path, SCHEDULE), {"structure": "half-gain"}, False, {"u_max": 0.5}
    )
    assert (limited.options["structure"], limited.options["u_max"]) == ("half-gain", 0.5)


def test_values_of_a_parameter_are_points_and_more_between(tmp_path: Path) -> None:
    """A function of the value, and the points as they are."""
    text = TWO_MASS + "[tune.schedule]\nparameter = 'plant.m1'\npoints = [0.5, 2.0]\n"
    task = schedule_task(written(tmp_path, text))
    light, heavy = task.plant(0.5), task.plant(2.0)
    assert np.max(np.abs(light.B)) == pytest.approx(4.0 * np.max(np.abs(heavy.B)))
    assert task.options["points"] == [0.5, 2.0]
    wrong = text.replace("[0.5, 2.0]", "[[0.5, 2.0], [1.0, 2.0]]")
    with pytest.raises(
        SetupError, match="must be a list of numbers for parameter, two lists for two"
    ):
        schedule_task(written(tmp_path, wrong))
    with pytest.raises(SetupError, match=r"is a key of \[plant\], which is missing"):
        schedule_task(written(tmp_path, "dt = 0.01\n" + text[text.index("[tune") :]))


@cases(
    ("old", "new", "message"),
    [
        (
            "at = 0.0",
            "at = 1.0",
            r"tune.schedule.points\[1\].at = 1.0: is the value of another point, too",
        ),
        ("A = [[-3.0]]", "A = [[-3.0, 1.0]]", r"tune.schedule.points\[1\]: plant"),
        (
            "[controller]",
            "[compensator]\n[controller]",
            "compensator: is not tuned with a schedule",
        ),
    ],
)
def test_points_that_make_no_plant_are_named(old: str, new: str, message: str) -> None:
    """With their number and key."""
    with tempfile.TemporaryDirectory() as folder, pytest.raises(SetupError, match=message):
        schedule_task(written(Path(folder), SCHEDULE.replace(old, new)))
    with (
        tempfile.TemporaryDirectory() as folder,
        pytest.raises(SetupError, match="needs the kind of the plant"),
    ):
        schedule_task(
            written(Path(folder), "dt = 0.05\n" + SCHEDULE[SCHEDULE.index("[controller]") :])
        )


def test_a_table_is_changed_by_its_keys_and_replaced_by_a_kind() -> None:
    """Inner tables as well."""
    base = {"kind": "a", "x": 1, "inner": {"p": 1, "q": 2}}
    assert _merged(base, {"x": 2, "inner": {"q": 3}}) == {
        "kind": "a",
        "x": 2,
        "inner": {"p": 1, "q": 3},
    }
    assert _merged(base, {"kind": "b"}) == {"kind": "b"}
    assert _merged("a", {"x": 2}) == {"kind": "a", "x": 2}
    assert base["inner"] == {"p": 1, "q": 2}


# ---- memory of a run


def controller() -> ql.ADRC:
    """Return an ADRC, whose memory is that of its observer."""
    return ql.ADRC(ql.ESO.model_free(1, 2.0, 10.0, 0.01), 2.0)


def test_a_memory_file_is_written_between_steps_and_read_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not in a step, whose count is odd; a note says what was done."""
    monkeypatch.setattr("quell.realtime.memory_file.load_acquire", lambda array, i: int(array[i]))
    path = tmp_path / "memory.bin"
    memory = MemoryFile(path)
    state, note = memory.start(controller())
    assert note == f"memory: {path} does not exist yet: nothing is learned"
    assert state is not None
    steps = np.array([4], dtype=np.int64)
    assert memory.save_if_asked(steps) == ""
    memory.save()
    size = len(controller().memory())
    assert memory.save_if_asked(steps) == f"memory: saved to {path}, {size} bytes"
    assert path.stat().st_size == size
    assert memory.saved == 1
    assert memory.save_if_asked(steps) == ""
    again = MemoryFile(path)
    assert again.start(controller())[1] == f"memory: it begins with what is in {path}"
    busy = again.write(np.array([5], dtype=np.int64))
    assert busy == f"memory: NOT saved, {path} is as before: the loop was never at rest"
    assert again.saved == 0
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"nothing has moved; another file, or none"):
        MemoryFile(path).start(controller())
    with pytest.raises(ValueError, match="object has no memory image; leave memory out"):
        MemoryFile(path).start(object())
    gone = MemoryFile(tmp_path / "none" / "memory.bin")
    gone._controller = controller()
    assert gone.write(steps).startswith(f"memory: NOT saved, {gone.path} is as before: ")
    assert memory_file(None) is None
    assert memory_file(memory) is memory
    assert memory_file(str(path)).path == path  # type: ignore[union-attr]
    with pytest.raises(ValueError, match="memory = 3: must be the path of a file"):
        memory_file(3)  # type: ignore[arg-type]


@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="the system has no SIGUSR1")
def test_a_signal_asks_for_a_memory_and_what_it_did_before_comes_back(tmp_path: Path) -> None:
    """SIGUSR1 in the main thread."""
    memory, before = MemoryFile(tmp_path / "memory.bin"), signal.getsignal(signal.SIGUSR1)
    with memory.saved_by_signal():
        assert not memory._asked.is_set()
        signal.raise_signal(signal.SIGUSR1)
        assert memory._asked.is_set()
    assert signal.getsignal(signal.SIGUSR1) == before


# ---- viewers


@cases(
    ("origin", "local"),
    [
        (None, True),
        ("file://", True),
        ("http://localhost:8080", True),
        ("https://127.0.0.1", True),
        ("http://[::1]:3000", True),
        ("null", False),
        ("https://example.com", False),
        ("ftp://localhost", False),
        ("http://localhost.example.com", False),
        ("http://[", False),
    ],
)
def test_pages_of_this_computer_may_watch(origin: Any, local: bool) -> None:
    """And programs; ``null`` is no origin of this computer."""
    assert is_local(origin) is local


def test_a_request_from_another_origin_and_one_too_many_are_refused() -> None:
    """With a reason; origins that were given may watch, two origins in one request only if both may."""
    answers: list[Any] = []
    connection = SimpleNamespace(
        respond=lambda status, reason: answers.append((int(status), reason)) or "no"
    )
    viewers = Viewers({"info": {}, "channel": {"id": 1}, "origins": ["https://given.example"]})

    def asked(*origins: str) -> Any:
        headers = Message()
        for origin in origins:
            headers["Origin"] = origin
        request = SimpleNamespace(
            headers=SimpleNamespace(get_all=lambda name: headers.get_all(name) or [])
        )
        return viewers.refuse(connection, request)

    assert asked() is None
    assert asked("http://localhost") is None
    assert asked("https://given.example") is None
    assert asked("https://other.example") == "no"
    assert answers[-1] == (403, "The origin https://other.example may not watch.\n")
    assert asked("https://given.example", "https://given.example") == "no"
    many = [object() for _ in range(200)]
    viewers._all = set(many)  # type: ignore[arg-type]
    assert asked() == "no"
    assert answers[-1] == (503, "Too many viewers.\n")


@cases(
    ("annotation", "name"),
    [
        (float, "number"),
        (float | None, "number"),
        (float | str, "number, text"),
        (tuple[float, ...], "list"),
        (tuple[float, ...] | float, "list, number"),
        (dict[str, float], "table"),
        (dict[str, float] | None, "table"),
        (dict[str, float] | str, "table, text"),
        (int | bool, "whole number, true or false"),
    ],
)
def test_the_types_of_keys_are_those_of_toml(annotation: Any, name: str) -> None:
    """Of several each once; None is a key that is left out."""
    assert _type(annotation) == name
