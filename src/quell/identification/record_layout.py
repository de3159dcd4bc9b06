"""Layout of a record in a text file: columns, separators, dates.

Columns of a record: which of the names in a file are time, input and output.

Layout of a record in a text file: where its table begins, and what separates its cells.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import date
from typing import NamedTuple

import numpy as np

from quell.files import csv_rows, words_of
from quell.quantities import Quantity, is_known_unit
from quell.types import Vector

# ---- Columns of a record ----

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


def quantity_of(text: str, below: str, role: str) -> Quantity:
    """Return name and unit of a column; no name where it is that of a role, such as u or output.

    Words in round brackets that are no known unit, as in ``speed (left)``, are none.
    """
    text, (base, unit) = " ".join(text.split()), name_of(text, below)
    name = text
    found = _BRACKETS.fullmatch(text) or _BEHIND.fullmatch(text)
    if found is not None and found[2] == unit:
        if "[" not in text and not is_unit(unit) and not is_known_unit(unit):
            return Quantity()
        name = found[1]
    if not unit or base in _SYNONYMS[role] or "[" in name or "]" in name:
        name = ""
    return Quantity(name, unit)


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


# ---- Times of a record that are dates or times of day ----

_DATE = (
    r"(?P<iso>(?P<Y>\d{4})(?P<a>[-/.])(?P<M>\d{1,2})(?P=a)(?P<D>\d{1,2}))"
    r"|(?P<mixed>(?P<p>\d{1,2})(?P<b>[-/.])(?P<q>\d{1,2})(?P=b)(?P<z>\d{4}|\d{2}))"
    r"|(?P<named>(?P<d>\d{1,2})[- ](?P<m>[A-Za-z]{3})[- ](?P<y>\d{4}))"
)
_CLOCK = (
    r"(?P<first>\d{1,3}):(?P<second>\d{2})(?::(?P<third>\d{2}))?(?:[.,:](?P<part>\d+))?"
    r"(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?"
)
_ZONE = r"(?:\s*(?:(?P<utc>Z|UTC|GMT)|(?P<sign>[+-])(?P<zh>\d{2}):?(?P<zm>\d{2})))?"
_STAMP = re.compile(rf"(?:{_DATE})?(?:(?:^|[T ,]\s*){_CLOCK}{_ZONE})?")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DAY = 86400.0


def is_stamp(text: str) -> bool:
    """Return whether a text is a date, a time of day, or both."""
    return bool(text) and _STAMP.fullmatch(text) is not None


class Stamps:
    """Reader of one column of stamps: seconds since the midnight before its first one.

    A stamp is an ISO 8601 date and time, day.month.year, day-Mon-year, a date with slashes, a time
    of day, or a date or a time alone; fractions of seconds have a point or a comma. Which part of a
    date with slashes or dashes is the day is taken from the column's first lines, ``cells``.
    """

    def __init__(self, cells: Sequence[str]) -> None:
        self.day_first = _day_first(cells)
        self.start: int | None = None  # the first day
        self.seen: str | None = None  # a date of which day and month are not told apart
        self.dated = False

    def seconds(self, text: str) -> float:
        """Return a stamp in seconds; raise a ``ValueError`` with the rule that it breaks."""
        found = _STAMP.fullmatch(text)
        if found is None or not text:
            raise ValueError("must be a date or a time of day, as the first ones are")
        day = self._day(found)
        if self.start is None:
            self.start, self.dated = day or 0, day is not None
        if (day is not None) != self.dated:
            raise ValueError("must have a date, as the first one" if self.dated else "has a date")
        return _DAY * ((day or 0) - self.start) + _second_of_day(found, self.dated)

    def _day(self, found: re.Match[str]) -> int | None:
        if found["iso"]:
            parts = int(found["Y"]), int(found["M"]), int(found["D"])
        elif found["named"]:
            if found["m"].lower() not in _MONTHS:
                raise ValueError("has no month in English, Jan to Dec")
            parts = int(found["y"]), _MONTHS.index(found["m"].lower()) + 1, int(found["d"])
        elif found["mixed"]:
            year = int(found["z"]) + (2000 if len(found["z"]) == 2 else 0)
            pair = int(found["p"]), int(found["q"])
            first = True if found["b"] == "." else self.day_first
            if first is None:
                if self.seen not in (None, found["mixed"]):
                    raise ValueError("day and month can't be told apart; write 2024-05-31")
                self.seen = found["mixed"]
            parts = year, *(pair if first is False else pair[::-1])
        else:
            return None
        try:
            return date(*parts).toordinal()
        except ValueError:
            raise ValueError("is no date") from None


def unwrapped(seconds: Vector) -> Vector:
    """Return times of day that rise over midnight."""
    days = np.cumsum(np.diff(seconds, prepend=seconds[:1]) < -0.5 * _DAY)
    return np.asarray(seconds + _DAY * days)


def _day_first(cells: Sequence[str]) -> bool | None:
    """Return whether dates begin with the day, or with the month; None if nothing tells."""
    pairs = [
        (int(found["p"]), int(found["q"]))
        for found in map(_STAMP.fullmatch, cells)
        if found is not None and found["mixed"]
    ]
    if any(p > 12 for p, _ in pairs):
        return True
    if any(q > 12 for _, q in pairs):
        return False
    return None


def _second_of_day(found: re.Match[str], dated: bool) -> float:
    """Return the time of day [s], in the zone UTC if a zone is given."""
    if found["first"] is None:
        return 0.0
    first, second = int(found["first"]), int(found["second"])
    part = float(f"0.{found['part'] or 0}")
    if found["third"] is not None:
        hours, minutes, seconds = first, second, int(found["third"])
    elif found["part"] is not None and not dated:  # as spreadsheets write minutes
        hours, minutes, seconds = 0, first, second
    elif dated or found["half"]:
        hours, minutes, seconds = first, second, 0
    else:
        raise ValueError("may be hours:minutes or minutes:seconds; write hours:minutes:seconds")
    if found["half"]:
        if not 1 <= hours <= 12:
            raise ValueError("is no time of day")
        hours = hours % 12 + (12 if found["half"].lower() == "p" else 0)
    if (minutes > 59 and found["third"] is not None) or seconds > 60 or (dated and hours > 24):
        raise ValueError("is no time of day")
    offset = 0
    if found["sign"]:
        offset = int(f"{found['sign']}1") * (3600 * int(found["zh"]) + 60 * int(found["zm"]))
    return 3600.0 * hours + 60.0 * minutes + seconds + part - offset


# ---- Layout of a record in a text file ----

# Separators of cells, the likeliest one first where several are possible; None is white space.
_SEPARATORS = ("\t", ";", ",", None)
# Last lines of the file's begin that tell the separator. Chosen by hand.
_TOLD_BY = 64
# Text lines above the numbers among which the line of names is: names, units, types and
# descriptions. Chosen by hand.
_MOST_TEXT = 8
# Rows of numbers that make a text a record rather than a setup. Chosen by hand.
_TABLE = 3
_COMMENTS = ("#", "%", "//")
# What spreadsheets write for a number that they do not have: no comments.
_SHEET_ERRORS = ("#n/a", "#na", "#ref!", "#div/0!", "#value!", "#num!", "#name?", "#null!")
MISSING = {
    *("", "-", "--", "---", "nan", "-nan", "+nan", "na", "n/a", "null", "none", "nil", "?", "*"),
    *("inf", "-inf", "+inf", "infinity", "missing", "ol", "overload", "***", "****", "1.#qnan"),
    *("1.#ind", "-1.#ind", "1.#inf", "-1.#inf", "<null>", "\N{EN DASH}", "\N{EM DASH}"),
    *_SHEET_ERRORS,
}
"""Texts in lower case that stand for a number that is not there."""
_BEYOND = {"inf", "infinity", "ol", "overload", "***", "****", "1.#inf"}
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:(?:,\d{3})+(?:\.\d*)?|(?:\.\d{3})+(?:,\d*)?)")
_WITH_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_SETUP = re.compile(r"\s*(?:\[{1,2}[\w.\"' -]+\]{1,2}\s*(?:#.*)?|[\w.-]+\s*=\s*\S.*)\s*")


class Layout(NamedTuple):
    """How the table in a file is written."""

    separator: str | None  #: between cells; None for white space
    names: list[str] | None  #: of the columns, None without a line of names
    named_at: int  #: number of that line
    units: list[str]  #: of each column, from a line below the names; empty ones without it
    width: int  #: number of columns
    before: int  #: lines in front of the first line of numbers
    numeric: list[int]  #: columns that have numbers


class _Line(NamedTuple):
    at: int  # index among the lines of the file
    comment: bool
    text: str  # without mark of a comment


def layout_of(where: str, head: Sequence[str], columns: Sequence[str], timed: bool) -> Layout:
    """Return the layout of a file that begins with the lines ``head``.

    The numbers begin at the first line that has a number in each column that has one in most of
    the last lines of ``head``. The names are in a line above with as many cells: the one that has
    all ``columns``, or the nearest that is no line of units.

    Raises
    ------
    ValueError
        if there is no table of numbers, or its lines have not as many cells as its names.
    """
    lines = [*_lines(head)]
    if not lines:
        raise ValueError(f"{where}: is empty; give a table of time, input and output")
    separator, width, numeric = _separator(where, [line for line in lines if not line.comment])
    roles = ROLES[0 if timed else 1 :]
    asked = [*zip(columns, roles, strict=False)]
    plain = [line for line in lines if not line.comment]
    cells = {line.at: without_empty_end(cells_of(line.text, separator)) for line in plain}
    first = next((i for i, line in enumerate(plain) if _fits(cells[line.at], width, numeric)), 0)
    start = plain[first].at
    above = [line for line in lines if line.at < start][::-1]
    _check_decimal_commas(f"{where}, line {start + 1}", separator, [*cells.values()][first:])
    # A column that is empty in all lines may have a name, too.
    padded = len(cells_of(plain[first].text, separator))
    named = _named(above[:_MOST_TEXT], {width, padded}, separator, asked)
    if named is None:
        _check_count(where, above, width, separator, asked, cells[start])
        for line in plain[:first][::-1]:  # a line of numbers that lacks some
            row = cells[line.at]
            if sum(map(is_value, row)) < 2 or not all(is_value(c) or is_missing(c) for c in row):
                break
            start = line.at
        return Layout(separator, None, 0, [""] * width, width, start, numeric)
    at, names = named
    width = len(names)
    units = [""] * width
    for line in plain:
        if at < line.at <= start:
            row = cells[line.at]
            if line.at == start or not _is_text(row, numeric, width):
                start = line.at
                break
            if not any(units) and any(c.isalpha() for c in "".join(row)):
                units = [*row, ""][:width]
    return Layout(separator, names, at + 1, units, width, start, numeric)


def cells_of(line: str, separator: str | None) -> list[str]:
    """Return the cells of a single line."""
    try:
        return next(csv_rows([line], "", separator), (0, [""]))[1]
    except ValueError:
        return [line]


def without_empty_end(row: list[str]) -> list[str]:
    """Return a row without the empty cell behind a delimiter at the end of its line."""
    return row[:-1] if row and not row[-1] else row


def is_comment(text: str) -> bool:
    """Return whether a line, or its first cell, begins a comment."""
    return text.startswith(_COMMENTS) and not text.lower().startswith(_SHEET_ERRORS)


def is_number(text: str) -> bool:
    """Return whether a text is a number with a decimal point; Python alone accepts 1_000."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


def has_decimal_comma(text: str) -> bool:
    """Return whether a text is a number with a decimal comma."""
    return "," in text and _WITH_COMMA.fullmatch(text) is not None


def has_thousands(text: str) -> bool:
    """Return whether a text seems to be a number with marks between thousands."""
    return _THOUSANDS.fullmatch(text) is not None


def is_missing(text: str) -> bool:
    """Return whether a cell stands for a number that is not there."""
    return text.lower() in MISSING


def is_beyond(text: str) -> bool:
    """Return whether a cell stands for a number that is too large, as one of an instrument."""
    return text.lower().strip("+-") in _BEYOND


def is_value(text: str) -> bool:
    """Return whether a cell is a number, a date or a time."""
    number = is_number(text) and not is_missing(text)
    return number or has_decimal_comma(text) or is_stamp(text)


def seems_setup(lines: Sequence[str]) -> bool:
    """Return whether the first lines of a text are those of a setup in TOML."""
    told = [line for line in lines if line.strip() and not line.lstrip().startswith("#")][:4]
    return bool(told) and all(_SETUP.fullmatch(line) for line in told)


def seems_record(lines: Sequence[str]) -> bool:
    """Return whether the first lines of a text are those of a record: some are rows of numbers."""
    plain = [line for line in _lines(lines) if not line.comment][-_TOLD_BY:]
    return any(
        sum(sum(map(is_value, cells_of(line.text, mark))) >= 2 for line in plain) >= _TABLE
        for mark in _SEPARATORS
    )


def _lines(head: Sequence[str]) -> Iterator[_Line]:
    for index, line in enumerate(head):
        text = line.strip(" \r\n\f\v")
        if not text.strip():
            continue
        comment = is_comment(text.lstrip('"'))
        yield _Line(index, comment, text.lstrip("#%/ ") if comment else text)


def _separator(where: str, lines: list[_Line]) -> tuple[str | None, int, list[int]]:
    """Return the separator, the number of columns, and the columns that have numbers."""
    best, most = None, 0
    for separator in _SEPARATORS:
        rows = [without_empty_end(cells_of(line.text, separator)) for line in lines[-_TOLD_BY:]]
        values = [[is_value(cell) for cell in row] for row in rows]
        widths = Counter(len(row) for row in values if sum(row) >= 2)
        if not widths:
            continue
        width, count = max(widths.items(), key=lambda item: (item[1], item[0]))
        if count > most:
            full = [row for row in values if len(row) == width and sum(row) >= 2]
            numeric = [i for i in range(width) if 2 * sum(row[i] for row in full) > len(full)]
            best, most = (separator, width, numeric), count
    if best is None:
        texts = [line.text for line in lines]
        if seems_setup(texts):
            raise ValueError(
                f"{where}: is a setup, not a record: quell run, quell sweep and quell tune take a "
                "setup, in a file that ends in .toml; a record is a table of time, input and output"
            )
        raise ValueError(
            f"{where}: has no table of numbers: no line with two numbers or more; give a text file "
            "with the columns of time, input and output, such as t,u,y"
        )
    return best


def _fits(row: list[str], width: int, numeric: list[int]) -> bool:
    """Return whether a row has numbers where the table has some; some may be missing."""
    if len(row) != width:
        return False
    values = sum(is_value(row[i]) for i in numeric)
    return 2 * values > len(numeric) and all(
        is_value(row[i]) or is_missing(row[i]) for i in numeric
    )


def _is_text(row: list[str], numeric: list[int], width: int) -> bool:
    """Return whether a row below the names has units or such, or is a line of dashes."""
    if not any(c.isalnum() for cell in row for c in cell):
        return True
    told = [row[i] for i in numeric if i < len(row)]
    full = width - 1 <= len(row) <= width
    return full and not any(map(is_value, told)) and not all(map(is_missing, told))


def _named(
    above: list[_Line], widths: set[int], separator: str | None, asked: Sequence[tuple[str, str]]
) -> tuple[int, list[str]] | None:
    """Return index and cells of the line of names among those above the numbers, nearest first."""
    full: list[tuple[_Line, list[str]]] = []
    for line in above:
        for each in (separator, *(other for other in _SEPARATORS if other != separator)):
            row = without_empty_end(_header(line.text, each))
            if len(row) in widths and not all(map(is_value, row)):
                full.append((line, row))
                break
    hits = [sum(_has(row, *pair) for pair in asked) for _, row in full]
    for (line, row), count in zip(full, hits, strict=True):
        if count == len(asked):
            return line.at, row
    for line, row in full:
        distinct = len({*row}) == len(row) or len(row) > 8
        if not line.comment and not all(map(is_unit, row)) and distinct:
            return line.at, row
    for (line, row), count in zip(full, hits, strict=True):
        if count > 0 or not line.comment:  # a comment without any of them is no line of names
            return line.at, row
    return None


def _header(line: str, separator: str | None) -> list[str]:
    return words_of(line) if separator is None else cells_of(line, separator)


def _has(row: list[str], asked: str, role: str) -> bool:
    return bool(found_in(row, [""] * len(row), asked, role))


def _check_count(
    where: str,
    above: list[_Line],
    width: int,
    separator: str | None,
    asked: Sequence[tuple[str, str]],
    first: list[str],
) -> None:
    """Check that the line above the numbers is no line of names with another number of cells."""
    near = [line for line in above if not line.comment][:1]
    for line in near:
        row = without_empty_end(cells_of(line.text, separator))
        lacks = [name for name, role in asked if not _has(row, name, role)]
        if len(lacks) == len(asked):
            continue
        hint = hint_of_commas(separator, first)
        line_ = "the first line" if line.at == 0 else f"line {line.at + 1}"
        fault = f"column {lacks[0]} is missing; " if lacks else ""
        raise ValueError(
            f"{where}: {fault}{line_} names {listed(row)}, but the numbers below it have {width} "
            f"cells in a line{hint}"
        )


def _check_decimal_commas(where: str, separator: str | None, rows: list[list[str]]) -> None:
    """Check that no number is cut in two at a decimal comma: that leaves digits such as 05."""
    count = Counter(map(len, rows)).most_common(1)[0][0]
    rows = [row for row in rows if len(row) == count]
    if separator != "," or count % 2 or any("." in cell for row in rows for cell in row):
        return
    behind = [cell for row in rows for cell in row[1::2]]
    if all(map(str.isdecimal, behind)) and any(c[0] == "0" and len(c) > 1 for c in behind):
        raise ValueError(
            f"{where}: has {count} cells, and no decimal points, but digits such as "
            f"{next(c for c in behind if c[0] == '0' and len(c) > 1)}, as behind decimal commas"
            f"{hint_of_commas(separator, rows[0])}"
        )


def hint_of_commas(separator: str | None, row: Sequence[str]) -> str:
    """Return the remedy for lines with too many cells."""
    if separator == "," and not any("." in cell for cell in row):
        return (
            "; if the commas are decimal ones, write points in their place, or put semicolons "
            "between the cells"
        )
    return "; give each column a name, and each line as many cells"
