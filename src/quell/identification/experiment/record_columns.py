"""Columns of a record: which of the names in a file are time, input and output."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

UNITS = {
    **{"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    **{"min": 60.0, "h": 3600.0, "d": 86400.0},
}
"""Units of times, in seconds."""

ROLES = ("t", "u", "y", "r")
"""Meanings of a record's columns, in the order in which they are given."""

# Names of units of times, in lower case.
_TIMES = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sekunde", "sekunden"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "micros", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), "h"),
    **dict.fromkeys(("d", "day", "days"), "d"),
}
# Units in which a column counts samples.
_COUNTS = ("sequence", "sample", "samples", "index", "count", "counts", "#")
# Other common units, in lower case: behind a name after _ or a space they are units, other words
# are part of the name. The lists of names and words in this file were made by hand from exports of
# oscilloscopes, loggers and flight controllers.
_OTHERS = {
    *("v", "mv", "kv", "uv", "volt", "volts", "a", "ma", "ampere", "n", "nm", "n·m", "n*m", "mn"),
    *("w", "kw", "mw", "%", "pct", "percent", "m", "mm", "cm", "um", "µm", "km", "rad", "mrad"),
    *("deg", "°", "°c", "°f", "degc", "degf", "celsius", "k", "kelvin", "rad_s", "rad/s"),
    *("deg/s", "rpm", "1/min", "hz", "khz", "bar", "mbar", "pa", "kpa", "mpa", "kg", "g", "l"),
    *("l/min", "lpm", "m/s", "mm/s", "m_s", "m/s²", "m/s^2", "ohm", "h", "t", "nmm", "db"),
}
# Letters that are units in brackets only: y_h is an estimate rather than hours.
_LETTERS = {*"htdkgnwl"}
# Words that are often in brackets and are no units.
_NO_UNITS = {
    *("ref", "set", "sp", "cmd", "est", "hat", "raw", "old", "new", "avg", "mean", "min", "max"),
    *("err", "filt", "sat", "sim", "model"),
}
_BRACKETS = re.compile(r"(.*?)[\s_]*[\[({]\s*([^\[\](){}]{1,12}?)\s*[\])}]")
_BEHIND = re.compile(r"(.+?)(?:[\s_]+|\s*/\s*)(\S+)")
# Names that stand for a role, in lower case and without unit.
_SYNONYMS = {
    "t": {
        *("t", "time", "times", "timestamp", "zeit", "zeitstempel", "temps", "tiempo", "elapsed"),
        *("elapsed_time", "time_elapsed", "sampling_time", "sample_time", "time_stamp"),
        *("datetime", "date_time", "x_value", "x-axis"),
    },
    "u": {"u", "input", "control input", "control_input", "plant input", "plant_input"},
    "y": {"y", "output", "plant output", "plant_output", "y_measured"},
    "r": {"r", "ref", "reference", "setpoint", "set_point", "set point"},
}
# Where one of these is there, too, "input" and "output" may be those of the controller.
_SETPOINTS = _SYNONYMS["r"] | {"sp", "error", "e", "target", "soll", "sollwert", "command"}
_CONTROLLERS = {"input", "output"}
# Names that are listed in a message.
_MOST_LISTED = 40


class Name(NamedTuple):
    """The name of a column, in lower case, and its unit; both may be empty."""

    base: str
    unit: str


def name_of(text: str, below: str = "") -> Name:
    """Return name and unit of a column, as of "t [ms]", "time_ms" and "Time (s)".

    ``below`` is what a line of units has for the column.
    """
    text, below = " ".join(text.split()), below.strip().strip("[](){}").strip()
    if (found := _BRACKETS.fullmatch(text)) and _may_be_unit(found[2]):
        return Name(found[1].lower(), found[2])
    behind = (_OTHERS | _TIMES.keys()) - _LETTERS
    if (found := _BEHIND.fullmatch(text)) and found[2].lower() in behind:
        return Name(found[1].lower(), found[2])
    if text.lower() in _TIMES and text.lower() not in ("s", "h", "d", "min"):
        return Name("time", text)
    return Name(text.lower(), below)


def time_unit_of(name: Name) -> str | None:
    """Return the unit of a column of times, None if it has none that is known."""
    return _TIMES.get(name.unit.lower())


def counts_samples(name: Name) -> bool:
    """Return whether a column counts samples, by its unit."""
    return name.unit.lower() in _COUNTS


def is_unit(text: str) -> bool:
    """Return whether a cell of a table may be a unit that stands below a name."""
    plain = text.strip().strip("[](){}").strip().lower()
    return not text.strip("- ") or plain in _OTHERS | _TIMES.keys() | {*_COUNTS, "bool", "-"}


def found_in(names: Sequence[str], units: Sequence[str], asked: str, role: str) -> list[int]:
    """Return the places of the columns that ``asked`` may mean, the name for a role.

    A name that is the same is taken; else names that differ by case or a unit, and, where ``asked``
    is the name of the role, common other names.
    """
    if same := [place for place, name in enumerate(names) if name == asked]:
        return same
    known = [name_of(*pair) for pair in zip(names, units, strict=True)]
    wanted = name_of(asked)
    if asked != role:
        unit = wanted.unit.lower()
        return [
            place
            for place, name in enumerate(known)
            if name.base == wanted.base and unit in ("", name.unit.lower())
        ]
    bases = {name.base for name in known}
    accepted = _SYNONYMS[role]
    if bases & _SETPOINTS and not bases & ({"u", "y"} - {role}):
        accepted = accepted - _CONTROLLERS
    found = [place for place, name in enumerate(known) if name.base in accepted]
    if role == "t":
        found = [place for place in found if _may_be_time(known[place])]
        # T is a temperature beside a column of times.
        if len(found) > 1:
            found = [place for place in found if not names[place].startswith("T ")] or found
            found = [place for place in found if names[place] != "T"] or found
    if len(found) > 1 and role != "t":
        own = [place for place in found if known[place].base == role]
        found = own or found
    return found


def listed(names: Sequence[str]) -> str:
    """Return names for a message."""
    shown = [name if len(name) <= 40 else f"{name[:37]}..." for name in names[:_MOST_LISTED]]
    more = len(names) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")


def _may_be_unit(text: str) -> bool:
    plain = text.lower()
    if plain in _OTHERS or plain in _TIMES or plain in _COUNTS:
        return True
    return len(text) <= 8 and plain not in _NO_UNITS and any(c.isalpha() or c in "%°" for c in text)


def _may_be_time(name: Name) -> bool:
    """Return whether a column may be times: it has no other unit, as T [°C] has."""
    return not name.unit or time_unit_of(name) is not None or counts_samples(name)
