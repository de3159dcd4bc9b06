"""Frames: what is accepted, and by which rule all else is refused."""

from __future__ import annotations

import math
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quell.kernels.dispatch import compiled, interpreted
from quell.realtime import wire
from quell.realtime.wire import (
    COMMAND,
    GOODBYE,
    MEASUREMENT,
    buffer,
    counts_by_name,
    crc32,
    endpoint,
    write_next_numbers,
)

from .cases import cases
from .rig_bench import TIME, packed

SESSION = 0x5EED0001
PAGE = Path(__file__).parents[1] / "docs" / "wire.md"


@compiled
def _accept(frame: Any, size: int, own: Any) -> bool:
    return wire.is_well_formed(frame, size, own.counters) and wire.accept(frame, own)


@compiled
def _write_next(out: Any, own: Any, kind: int, time: int, values: Any, state: int) -> None:
    write_next_numbers(out, own, kind, time, values, state)


@compiled
def _crc32(data: Any, size: int) -> int:
    return crc32(data, size)


def offered(own: Any, data: bytes, entry: Any = None) -> bool:
    """Offer what was received to ``own``, as a link would put it into its buffer."""
    frame = buffer()
    frame.bytes[: len(data)] = np.frombuffer(data[: frame.bytes.size], dtype=np.uint8)
    return bool((entry or interpreted(_accept))(frame, min(len(data), frame.bytes.size), own))


def refused_as(own: Any) -> str:
    """Return by which rule the only frame that was offered has been refused."""
    (rule,) = [name for name in wire.REFUSALS if counts_by_name(own.counters)[name]]
    return rule


@given(st.binary(max_size=48))
def test_the_checksum_is_that_of_zlib(data: bytes) -> None:
    """Interpreted and compiled."""
    room = np.frombuffer(data + b"\0", dtype=np.uint8).copy()
    assert crc32(room, len(data)) == _crc32(room, len(data)) == zlib.crc32(data)


@pytest.mark.parametrize("entry", [_write_next, interpreted(_write_next)])
def test_a_frame_is_what_the_table_says(entry: Any) -> None:
    """Byte by byte the one that ``struct`` and ``zlib`` make."""
    own, out = endpoint(COMMAND, SESSION, 20), buffer()
    own.numbers[wire.SENT], own.numbers[wire.RECEIVED] = 2**32 + 6, 41
    entry(out, own, MEASUREMENT, TIME, np.array([-1.5]), 1)
    assert out.bytes[:40].tobytes() == packed(MEASUREMENT, 7, 41, -1.5, state=1)


@pytest.mark.skipif(
    not PAGE.exists(), reason="the pages are in the repository, not in what is built of it"
)
def test_the_frame_on_the_page_is_one() -> None:
    """The example in hexadecimal is accepted as what the page says it is."""
    (block,) = re.findall(r"```text\n((?:[0-9a-f]{2}[ \n])+)```", PAGE.read_text(encoding="utf-8"))
    data = bytes.fromhex(block)
    assert data == packed(COMMAND, 7, 41, 2.5)
    own = endpoint(COMMAND, SESSION, 20)
    own.numbers[wire.SENT] = 41
    assert offered(own, data)


@pytest.mark.parametrize("entry", [_accept, interpreted(_accept)])
def test_news_is_accepted_once_and_in_order(entry: Any) -> None:
    """What is lost in between is counted."""
    own = endpoint(MEASUREMENT, SESSION, 20)
    assert offered(own, packed(MEASUREMENT, 1, 0, 0.1), entry)
    assert offered(own, packed(MEASUREMENT, 5, 0, 0.2), entry)
    assert not offered(own, packed(MEASUREMENT, 5, 0, 0.2), entry)
    assert not offered(own, packed(MEASUREMENT, 4, 0, 0.2), entry)
    assert {name: n for name, n in counts_by_name(own.counters).items() if n} == {
        "accepted": 2,
        "skipped": 3,
        "duplicated": 1,
        "reordered": 1,
    }


def test_numbers_go_on_behind_the_largest() -> None:
    """From 2^32 − 1 to 0, as RFC 1982 has it."""
    own = endpoint(COMMAND, SESSION, 20)
    own.numbers[wire.SENT] = 2**32 + 3
    own.numbers[wire.RECEIVED] = 2**32 - 2
    for number in (2**32 - 1, 2**32, 2**32 + 1):
        assert offered(own, packed(COMMAND, number, number, 0.0))
    assert not offered(own, packed(COMMAND, 2**32 - 1, 2**32, 0.0))
    assert own.numbers[wire.RECEIVED] == 2**32 + 1
    assert counts_by_name(own.counters)["reordered"] == 1


@cases(
    ("data", "rule"),
    [
        (b"", "malformed"),
        (packed(COMMAND, 1, 100, 0.0)[:-1], "malformed"),
        (packed(COMMAND, 1, 100, 0.0) + b"\0", "malformed"),
        (packed(COMMAND, 1, 100, 0.0) * 2, "malformed"),
        (b"XL" + packed(COMMAND, 1, 100, 0.0)[2:], "malformed"),
        (
            packed(COMMAND, 1, 100, 0.0)[:24] + bytes(8) + packed(COMMAND, 1, 100, 1.0)[32:],
            "malformed",
        ),
        (packed(COMMAND, 1, 100, 0.0, version=2), "version"),
        (packed(MEASUREMENT, 1, 100, 0.0), "kind"),
        (packed(77, 1, 100, 0.0), "kind"),
        (packed(COMMAND, 1, 100, 0.0, session=SESSION + 1), "session"),
        (packed(COMMAND, 1, 79, 0.0), "stale"),
        (packed(COMMAND, 1, 0, 0.0), "stale"),
        (packed(COMMAND, 1, 101, 0.0), "stale"),
    ],
)
def test_what_breaks_a_rule_is_counted_by_it(data: bytes, rule: str) -> None:
    """And changes nothing else. Of a hundred frames sent the last twenty may be answered."""
    own = endpoint(COMMAND, SESSION, 20)
    own.numbers[wire.SENT] = 100
    before = own.numbers.copy()
    assert not offered(own, data)
    assert refused_as(own) == rule
    assert sum(counts_by_name(own.counters).values()) == 1
    assert np.array_equal(own.numbers, before)
    assert offered(own, packed(COMMAND, 1, 80, 0.0))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_no_number_is_news_and_counted(value: float) -> None:
    """That the other side is alive is known; whoever uses the value has to look at it."""
    own = endpoint(MEASUREMENT, SESSION, 20)
    assert offered(own, packed(MEASUREMENT, 1, 0, value))
    assert counts_by_name(own.counters)["not_finite"] == 1


@given(st.binary(max_size=60), st.booleans())
def test_no_bytes_are_accepted_but_frames(data: bytes, magic: bool) -> None:
    """Whatever comes is counted, never an error; interpreted and compiled do the same."""
    data = b"QL\x01\x02" + data if magic else data
    first, second = endpoint(COMMAND, SESSION, 20), endpoint(COMMAND, SESSION, 20)
    assert not offered(first, data, interpreted(_accept))
    assert not offered(second, data, _accept)
    assert counts_by_name(first.counters) == counts_by_name(second.counters)
    assert refused_as(first) == "malformed"


@given(st.integers(0, 39), st.integers(1, 255))
def test_a_wrong_byte_is_found(place: int, wrong: int) -> None:
    """Wherever it is."""
    data = bytearray(packed(COMMAND, 1, 0, 3.25))
    data[place] ^= wrong
    own = endpoint(COMMAND, SESSION, 20)
    assert not offered(own, bytes(data))
    assert refused_as(own) == "malformed"


@given(
    kind=st.integers(0, 255),
    version=st.integers(0, 255),
    session=st.sampled_from([0, SESSION, SESSION + 1]),
    number=st.integers(0, 2**32 - 1),
    answers=st.integers(0, 2**32 - 1),
    value=st.floats(),
)
def test_what_is_accepted_obeys_all_rules(
    kind: int, version: int, session: int, number: int, answers: int, value: float
) -> None:
    """Well-formed frames of any content, against the rules written down a second time."""
    own = endpoint(COMMAND, SESSION, 20)
    own.numbers[wire.SENT], own.numbers[wire.RECEIVED] = 1000, 2**31
    taken = offered(
        own, packed(kind, number, answers, value, session=session, version=version), _accept
    )
    assert taken == (
        kind == COMMAND
        and version == 1
        and session == SESSION
        and number > 2**31
        and 980 <= answers <= 1000
    )
    assert sum(counts_by_name(own.counters)[name] for name in ("accepted", *wire.REFUSALS)) == 1


def test_a_session_begins_with_nothing_heard() -> None:
    """What was counted stays."""
    own = endpoint(COMMAND, SESSION, 20)
    assert offered(own, packed(COMMAND, 9, 0, 0.0))
    assert not offered(own, packed(GOODBYE, 0, 0, 0.0))
    wire.start_session(own, 5)
    assert own.numbers.tolist() == [5, 0, 0, 0, 0]
    assert counts_by_name(own.counters)["accepted"] == 1
