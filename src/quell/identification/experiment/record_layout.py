"""Layout of a record in a text file: where its table begins, and what separates its cells."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from quell.identification.experiment.record_columns import ROLES, found_in, is_unit, listed
from quell.identification.experiment.record_stamps import is_stamp
from quell.reading import csv_rows, words_of

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
        return Layout(separator, None, 0, [""] * width, width, start)
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
    return Layout(separator, names, at + 1, units, width, start)


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
