"""Drawn messages, setups and texts: each is taken, or refused with a documented error.

Hypothesis draws a few dozen examples in every run of the tests. ``QUELL_FUZZ=5000 pytest
tests/test_fuzzed.py tests/test_frames.py tests/test_cobs.py`` draws as many of each kind, other
ones in each run, and keeps those that failed in ``.hypothesis``. Changed files have a trial of
their own, ``benchmarks/mutated_files.py``, and so have attacks on a running session,
``benchmarks/hostile_wire.py``.
"""

from __future__ import annotations

import json
import os
import tomllib
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from quell.setup import EXAMPLES, SetupError, made
from quell.setup.description import describe, parsed
from quell.studio import messages
from quell.studio.records import MOST_FILE, PageRecord
from quell.tuning.report import toml_text

from .setups import GANTRY
from .studio_server import TABLES

FUZZ = int(os.environ.get("QUELL_FUZZ", "0"))
fuzzed = settings(
    max_examples=FUZZ or 60,
    derandomize=not FUZZ,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)

PLAIN = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.text(max_size=20),
    st.sampled_from(["none", "step", "linear", "1e999", "\x00", "../x"]),
)
VALUES = st.recursive(
    PLAIN,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the path of each part of nested tables and lists."""
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()  # fmt: skip
    return [path, *(each for key, part in parts for each in places(part, (*path, key)))]


def put(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """Return nested tables with another part at a path."""
    if not path:
        return new
    made = list(value) if isinstance(value, list) else dict(value)
    made[path[0]] = put(value[path[0]], path[1:], new)
    return made


MESSAGE = {"do": "run", "id": 7, "setup": TABLES, "columns": 300, "percent": 10.0}


@pytest.mark.trial
@fuzzed
@given(st.sampled_from(places(MESSAGE)), VALUES, st.sampled_from(messages.TASKS))
def test_a_changed_message_to_the_studio_is_taken_or_refused(
    path: tuple[Any, ...], value: Any, task: str
) -> None:
    """What is taken has an id, a known task, and a setup within the limits."""
    message = put(MESSAGE | {"do": task}, path, value)
    try:
        text = json.dumps(message)
        found = messages.parsed(text)
        tables = messages.setup_tables(found, messages.Granted())
        messages.columns(found)
    except ValueError:
        return
    assert found["do"] in messages.TASKS
    assert type(found["id"]) is int
    scenario = tables.get("scenario")
    duration = scenario.get("duration") if isinstance(scenario, dict) else None
    if isinstance(duration, int | float):
        assert duration <= 200_000 * tables["dt"]


@fuzzed
@given(st.one_of(st.text(max_size=200), st.binary(max_size=200)))
def test_any_text_to_the_studio_is_refused_or_has_what_a_message_needs(text: str | bytes) -> None:
    """Not only what is nearly a message."""
    try:
        found = messages.parsed(text)
    except ValueError:
        assert messages.identity(text) is None or isinstance(messages.identity(text), int)
        return
    assert found["do"] in messages.TASKS


@fuzzed
@given(
    st.lists(
        st.fixed_dictionaries({"at": PLAIN, "data": st.one_of(PLAIN, st.just("QUJD"))}), max_size=5
    )
)
def test_parts_of_a_record_are_put_together_in_order_or_refused(
    parts: list[dict[str, Any]],
) -> None:
    """A page can't make the server keep more than one file of the largest size."""
    record = PageRecord()
    for part in parts:
        try:
            record.take_part(part)
        except ValueError:
            continue
    with pytest.raises(ValueError, match="bytes of the file have come"):
        record.content(-1)
    assert len(record._parts) <= MOST_FILE


@fuzzed
@given(st.sampled_from(places(TABLES)), VALUES)
def test_a_changed_setup_is_described_or_refused(path: tuple[Any, ...], value: Any) -> None:
    """A ``SetupError`` names what is wrong, a line for each mistake."""
    tables = put(TABLES, path, value)
    if not isinstance(tables, dict):
        return
    mistakes: tuple[str, ...] = ()
    try:
        describe("setup.toml", tables)
    except SetupError as error:
        mistakes = tuple(error.mistakes)
    assert all(line.startswith("setup.toml: ") for line in mistakes)


AXES = tomllib.loads(GANTRY)


@fuzzed
@pytest.mark.filterwarnings("ignore")  # of designs that are taken, but warned of
@given(st.sampled_from(places(AXES)), VALUES)
def test_a_changed_setup_of_several_axes_is_made_or_refused(
    path: tuple[Any, ...], value: Any
) -> None:
    """The objects, too: each mistake is a line that begins with the file."""
    tables = put(AXES, path, value)
    if not isinstance(tables, dict):
        return
    mistakes: tuple[str, ...] = ()
    try:
        made("setup.toml", tables)
    except SetupError as error:
        mistakes = tuple(error.mistakes)
    assert all(line.startswith("setup.toml: ") for line in mistakes)


SETUPS = [path.read_text(encoding="utf-8") for path in sorted(EXAMPLES.glob("*.toml"))]


@fuzzed
@given(st.sampled_from(SETUPS), st.data())
def test_a_changed_setup_file_is_read_or_refused(text: str, data: st.DataObject) -> None:
    """Characters are inserted, left out and repeated."""
    at = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(at, min(len(text), at + 40)))
    new = data.draw(st.one_of(st.text(max_size=10), st.just(text[at:end] * 3)))
    try:
        found = parsed("setup.toml", text[:at] + new + text[end:])
    except SetupError:
        return
    assert isinstance(found, dict)


TOML = st.recursive(
    st.one_of(
        st.booleans(),
        st.integers(-(2**63), 2**63 - 1),
        st.floats(allow_nan=False),
        st.text(max_size=20),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=6), inner, max_size=4)
    ),
    max_leaves=10,
)


@fuzzed
@given(st.dictionaries(st.text(max_size=6), TOML, max_size=5), st.text(max_size=60))
def test_what_is_written_as_toml_is_read_as_it_was(tables: dict[str, Any], comment: str) -> None:
    """Any keys, texts and numbers; a comment with any characters ends with its line."""
    found = tomllib.loads(toml_text(tables, comment))
    assert found == tables
