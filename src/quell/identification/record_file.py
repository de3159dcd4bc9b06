"""Records of input and output."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, islice
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.controllers.linear import LinearController, LinearLaw
from quell.files import MAX_SIZE, bytes_of, check_size, csv_rows, text_lines
from quell.identification.excitation import Excitation
from quell.identification.record_layout import (
    ROLES,
    UNITS,
    Layout,
    Stamps,
    cells_of,
    counts_samples,
    found_in,
    has_decimal_comma,
    has_thousands,
    hint_of_commas,
    is_beyond,
    is_comment,
    is_missing,
    is_number,
    is_stamp,
    layout_of,
    listed,
    name_of,
    quantity_of,
    time_unit_of,
    unwrapped,
)
from quell.identification.record_times import (
    check_unit,
    on_even_grid,
    warn_of_another_step,
    warn_of_another_unit,
)
from quell.plants import Plant
from quell.quantities import UNKNOWN, Conversion, Quantity, Signals, in_one_unit
from quell.simulation import Scenario, simulate
from quell.types import Matrix, Vector


class Measured(NamedTuple):
    """An evenly sampled record."""

    u: Vector
    y: Vector
    dt: float  #: [s]
    reference: Vector | None
    signals: Signals = UNKNOWN  #: names and units of u and y
    r: Quantity = Quantity()  #: name and unit of the reference; without a unit it is that of y


def excited(plant: Plant, design: Excitation) -> Measured:
    """Return the simulated record of a plant at rest that gets a designed excitation as u.

    Raises
    ------
    ValueError
        as ``simulate``.
    """
    none = np.zeros(0)
    law = LinearLaw(np.zeros((0, 0)), none, none, none, none, 1.0, 0.0)  # u = r
    scenario = Scenario(reference=design.signal, duration=(design.u.size - 1) * design.dt)
    run = simulate(plant, LinearController(law, design.dt), scenario)
    return Measured(run["u"], run["y_measured"], design.dt, None, run.signals)


# Least number of samples: chosen by hand, ``identify`` asks for more.
_FEWEST = 8
# Lines that are converted to an array at once; chosen by hand, not tuned further.
_BLOCK = 4096
# Begin of a file that tells its layout: more lines than the metadata of exports have (a flight
# controller's some 200), and as many characters as one line may have. Chosen by hand.
_HEAD_LINES, _HEAD_SIZE = 1000, 1_000_000

_Row = tuple[int, list[str]]  # line number and cells


def read_record(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    columns: Sequence[str] = ("t", "u", "y"),
    dt: float | None = None,
    *,
    time_unit: str | None = None,
    max_size: float = MAX_SIZE,
) -> Measured:
    """Read a record from a text file, of any name.

    The file is a table in UTF-8, UTF-16 or Windows-1252, with tabs, semicolons, commas or white
    space between the cells, perhaps below lines of other text, of names, and of units. Numbers have
    decimal points or decimal commas. Lines that begin with # or % are comments. A line without all
    values (empty cells, NaN) counts as missing; with ``dt`` it is an error, as is any other cell
    without a number.

    Times may be anything that rises: numbers, dates in ISO 8601 or as spreadsheets write them, or
    times of day. If they lie within half a sample, or half their own resolution, of an even grid,
    and no step is as long as if a sample were missing, the record is taken as it is, with the mean
    sample time: rounded times and jitter do that. Otherwise the samples are put on an even grid,
    and a ``UserWarning`` says so: u (and r) keep their value until the next sample, y is
    interpolated linearly. That is done for up to five missing samples in a row, and up to 5 % of
    missing or repeated samples; beyond it, and where times fall, the record is refused. With ``dt``
    the samples are taken as evenly spaced, whatever the times are.

    Parameters
    ----------
    path
        the file; or two files with a channel each, the one of u first, as oscilloscopes write them:
        times and values in two columns, or beside a list of settings (Tektronix TDS), whose unit is
        taken. Both must have the same times; there are neither ``columns`` nor ``dt`` then.
    columns
        columns of time, input and output, and optionally of the external signal of a closed loop:
        names if the file has them, or numbers from 1 on. With ``dt`` there is no time. Names may
        differ by case or by a unit behind them: u is also "U [V]". t, u, y and r are also the
        only column called time, input, output or reference.
    dt
        sample time [s] of a file without times, or in place of them.
    time_unit
        unit of the times: ``s``, ``ms``, ``us``, ``ns``, ``min``, ``h`` or ``d``. By default they
        are seconds, and a ``UserWarning`` says where they hardly can be.
    max_size
        limit of what the file may unpack to [MB].

    Raises
    ------
    ValueError
        names line and column of a fault in the file, and what to do; and if the name of the column
        of times has another unit than s, and ``time_unit`` is not given.
    """
    if not isinstance(path, str | os.PathLike):
        if dt is not None or tuple(columns) != ROLES[:3]:
            raise ValueError("columns, dt: two files of a channel each have none; leave them out")
        return _read_channels(path, time_unit, max_size)
    if dt is not None:
        checks.positive("dt", dt, "s")
    if time_unit is not None:
        checks.one_of("time_unit", time_unit, tuple(UNITS))
        if dt is not None:
            raise ValueError(f"time_unit = {time_unit!r}: there are no times, as dt is given")
    timed = dt is None
    _check_columns(columns, timed)
    opened = open_table(path, columns, timed, max_size)
    where, layout = opened.where, opened.layout
    places = [
        _place(where, layout, name, role, timed)
        for role, name in enumerate(columns, start=0 if timed else 1)
    ]
    table, first, numbers, values = _numbers(opened, places, columns, timed)
    if dt is None:
        name = "" if layout.names is None else layout.names[places[0]]
        t = _times(where, table, name, layout.units[places[0]], values[:, 0], numbers, time_unit)
        dt, values = on_even_grid(where, t, numbers, values[:, 1:])
    elif layout.names is not None:
        begin = [row for _, row in first[:_FEWEST]]
        warn_of_another_step(where, layout.names, layout.units, begin, dt)
    u, y, *reference = (column.copy() for column in values.T)
    found = Measured(u, y, dt, reference[0] if reference else None)
    if layout.names is None:
        return found
    roles = ROLES[int(not timed) :]
    known = {
        role: quantity_of(layout.names[place], layout.units[place], role)
        for role, place in zip(roles, places, strict=False)
    }
    return found._replace(signals=Signals(known["y"], known["u"]), r=known.get("r", Quantity()))


# ---- Files of one channel each ----

# Lines that begin with one of these have the unit of a channel, as Tektronix writes it.
_UNIT_OF_CHANNEL = ("vertical units", "vertical unit")
# Times of two channels of one acquisition differ by less than this share of a sample: by rounding.
_SAME_TIMES = 0.1


def is_one_channel(path: str | os.PathLike[str], max_size: float = MAX_SIZE) -> bool:
    """Return whether a file is a table of times and of one other column of numbers."""
    try:
        layout = open_table(path, max_size=max_size).layout
    except ValueError:
        return False
    return _has_one_channel(layout)


def _has_one_channel(layout: Layout) -> bool:
    names, places = layout.names, layout.numeric
    if len(places) != 2:
        return False
    return names is None or places[0] in found_in(names, layout.units, ROLES[0], ROLES[0])


class _Channel(NamedTuple):
    """A channel of a file."""

    where: str
    t: Vector  # [s]
    lines: Vector  # numbers of its lines in the file
    values: Vector
    known: Quantity  # name and unit


def _read_channels(
    paths: Sequence[str | os.PathLike[str]], time_unit: str | None, max_size: float
) -> Measured:
    """Return the record of two files, of u and of y."""
    if not checks.is_sequence(paths) or len(paths) != 2:
        raise ValueError(f"path = {paths!r:.60}: must be a file, or two, of u and of y")
    u, y = (_channel(one, role, time_unit, max_size) for one, role in zip(paths, "uy", strict=True))
    rule = "give two channels of one acquisition"
    if u.t.size != y.t.size:
        raise ValueError(f"{y.where}: has {y.t.size} samples, {u.where} {u.t.size}; {rule}")
    apart = float(np.max(np.abs(y.t - u.t)))
    if not apart <= _SAME_TIMES * abs(float(u.t[-1] - u.t[0])) / (u.t.size - 1):
        fault = f"its times are up to {apart:.3g} s from those of {u.where}"
        raise ValueError(f"{y.where}: {fault}; {rule}")
    dt, values = on_even_grid(u.where, u.t, u.lines, np.column_stack((u.values, y.values)))
    signals = Signals(y.known, u.known)
    return Measured(values[:, 0].copy(), values[:, 1].copy(), dt, None, signals)


def _channel(
    path: str | os.PathLike[str], role: str, time_unit: str | None, max_size: float
) -> _Channel:
    """Return the channel of a file, for a role."""
    opened = open_table(path, max_size=max_size)
    where, layout = opened.where, opened.layout
    if not _has_one_channel(layout):
        raise ValueError(
            f"{where}: must have times and one other column of numbers, and has "
            f"{len(layout.numeric)} columns of numbers; give a table of t, u and y as one file"
        )
    time, place = layout.numeric
    table, _, lines, values = _numbers(opened, layout.numeric, (ROLES[0], role), True)
    name, known = "", Quantity("", _unit_of_channel(opened))
    if layout.names is not None:
        name = layout.names[time]
        known = quantity_of(layout.names[place], layout.units[place], role)
    t = _times(where, table, name, layout.units[time], values[:, 0], lines, time_unit)
    return _Channel(where, t, lines, values[:, 1], known)


def _unit_of_channel(opened: OpenTable) -> str:
    """Return the unit that a line of the file's settings has for its channel; empty without one."""
    for line in opened.head:
        title, unit, *_ = (*cells_of(line.strip(), opened.layout.separator), "", "")
        if title.strip().lower() in _UNIT_OF_CHANNEL:
            return unit.strip()
    return ""


class OpenTable(NamedTuple):
    """A table in text, of which the layout is known and the numbers are not read yet."""

    where: str
    head: list[str]  #: lines that it begins with
    lines: Iterator[str]  #: the others
    layout: Layout
    most: int  #: limit of what the file may unpack to [bytes]


def open_table(
    path: str | os.PathLike[str],
    columns: Sequence[str] = (),
    timed: bool = True,
    max_size: float = MAX_SIZE,
) -> OpenTable:
    """Return a table in text, whose line of names has ``columns``.

    Raises
    ------
    ValueError
        as ``read_record``.
    """
    where, most = f"data = {os.fspath(path)!r}", bytes_of(max_size)
    if Path(path).suffix.lower() == ".toml":
        raise ValueError(
            f"{where}: is a setup by its name, not a record: quell run, quell sweep and quell tune "
            "take a setup; a record is a table of time, input and output"
        )
    lines = text_lines(path, where, most)
    head = _head(lines)
    return OpenTable(where, head, lines, layout_of(where, head, columns, timed), most)


def numbers_of(opened: OpenTable, places: list[int], names: Sequence[str]) -> Matrix:
    """Return the numbers of some columns; a line that lacks one, but not the first, is left out.

    Raises
    ------
    ValueError
        as ``read_record``.
    """
    return _numbers(opened, places, names, True)[-1]


def _numbers(
    opened: OpenTable, places: list[int], columns: Sequence[str], timed: bool
) -> tuple[_Table, list[_Row], Vector, Matrix]:
    """Return the table, its first rows, and number and values of all lines."""
    where, head, lines, layout, most = opened
    rows = _rows(where, chain(head[layout.before :], lines), layout)
    first = list(islice(rows, _HEAD_LINES))
    if len(first) < _FEWEST:
        remedy = "record more, or give a table with a line for each sample"
        if sum(bool(line.strip()) for line in head[layout.before :]) > len(first) + _FEWEST:
            remedy = "is there a quotation mark without a second one? Mend it"
        raise ValueError(
            f"{where}: has {len(first)} samples; must have at least {_FEWEST}: {remedy}"
        )
    table = _Table(where, layout, places, columns, first, timed)
    return table, first, *table.values(chain(first, rows), most)


def in_common_units(
    given: Mapping[str, Measured], error: bool = False
) -> tuple[dict[str, Measured], list[str]]:
    """Return records, by their names, with all y and r in one unit and all u in one.

    Units are those of the first record that has one. The second result says what was converted.

    Parameters
    ----------
    given
        the records.
    error
        whether r − y is used: then r must be in a unit that converts to that of y.

    Raises
    ------
    ValueError
        for units that do not convert, with the names of columns and units.
    """
    of_y, y, notes = in_one_unit({name: one.signals.y for name, one in given.items()}, "y")
    of_u, u, more = in_one_unit({name: one.signals.u for name, one in given.items()}, "u")
    found = {}
    for name, one in given.items():
        r, of_r = one.reference, of_y[name]
        if r is not None and one.r.unit and y.unit and one.r.unit != one.signals.y.unit:
            try:
                pair, _, said = in_one_unit({"y": y, name: one.r}, "r")
            except ValueError:
                if error:
                    raise
                pair, said = {name: Conversion()}, []
            of_r, notes = pair[name], [*notes, *said]
        found[name] = one._replace(
            u=of_u[name].of(one.u),
            y=of_y[name].of(one.y),
            reference=None if r is None else of_r.of(r),
            signals=one.signals._replace(y=y, u=u),
            r=one.r if r is None else y,
        )
    return found, [*notes, *more]


def _check_columns(columns: Sequence[str], timed: bool) -> None:
    listed_ = checks.is_sequence(columns) and all(isinstance(name, str) for name in columns)
    counts = (3, 4) if timed else (2, 3)
    if not listed_ or len(set(columns)) != len(columns) or len(columns) not in counts:
        names = ",".join(columns) if listed_ else columns
        rule = "t,u,y or t,u,y,r" if timed else "u,y or u,y,r, as dt is given"
        listed_as = "" if listed_ else ", as a list"
        raise ValueError(f"columns = {names!r}: must be {rule}, by names or numbers{listed_as}")


def _head(lines: Iterator[str]) -> list[str]:
    """Return the lines that the file begins with."""
    head, size = [], 0
    for line in lines:
        head.append(line)
        size += len(line)
        if len(head) == _HEAD_LINES or size > _HEAD_SIZE:
            break
    return head


def _rows(where: str, lines: Iterator[str], layout: Layout) -> Iterator[_Row]:
    """Return number and cells of the lines that are not comments."""
    rows = csv_rows(lines, where, layout.separator, layout.before)
    return (each for each in rows if not (each[1][0][:1] in "#%/" and is_comment(each[1][0])))


def _times(
    where: str,
    table: _Table,
    name: str,
    below: str,
    t: Vector,
    lines: Vector,
    unit: str | None,
) -> Vector:
    """Return times in seconds; warn where they hardly are."""
    if table.stamps is not None:
        if unit is not None:
            raise ValueError(
                f"time_unit = {unit!r}: {where} has dates or times of day, which have no unit; "
                "leave it out"
            )
        return t if table.stamps.dated else unwrapped(t)
    known = name_of(name, below)
    if counts_samples(known):
        raise ValueError(
            f"{where}: column {name!r} counts samples ({known.unit}), and has no times; give the "
            "sample time in its place (--dt), with the columns u,y"
        )
    check_unit(where, name, time_unit_of(known), unit)
    if unit is None and time_unit_of(known) is None:
        warn_of_another_unit(where, t, bool(name))
    with np.errstate(over="ignore"):  # a damaged file may hold any numbers
        return np.asarray(t * UNITS[unit or "s"])


def _place(where: str, layout: Layout, name: str, role: int, timed: bool) -> int:
    """Return the index of a column; in a file without names the first are time, input, output."""
    names, width = layout.names, layout.width
    found = [] if names is None else found_in(names, layout.units, name, ROLES[role])
    if len(found) == 1:
        return found[0]
    if names is not None and len(found) > 1:
        if names.count(name) > 1:
            rule = "rename one, or give its number (--columns 1,2,3)"
            raise ValueError(f"{where}: column {name} is there {names.count(name)} times; {rule}")
        several = listed([names[place] for place in found])
        raise ValueError(f"{where}: column {name} may be {several}; say which with --columns")
    if name.isdecimal():
        if not 1 <= int(name) <= width:
            rule = f"there are {width}, counted from 1"
            raise ValueError(f"{where}: column {name} is missing; {rule}")
        return int(name) - 1
    if names is None and name == ROLES[role]:
        place = role - (not timed and width < 3)
        if place < width and (place in layout.numeric or not _has_one_channel(layout)):
            return place
    has = f"no line names columns, there are {width}"
    if names is not None:
        line = "the first line" if layout.named_at == 1 else f"line {layout.named_at}"
        has = f"{line} names {listed(names)}"
    remedy = "say which with --columns"
    if name == ROLES[role] and _has_one_channel(layout):
        rule = "there are times and one channel; give two such files to quell identify, u first"
        raise ValueError(f"{where}: column {name} is missing; {rule}")
    if role == 0 and name == ROLES[0]:
        remedy += ", or give the sample time in its place (--dt)"
    raise ValueError(f"{where}: column {name} is missing; {has}; {remedy}")


class _Table:
    """The rows of a file, as numbers."""

    def __init__(
        self,
        where: str,
        layout: Layout,
        places: list[int],
        names: Sequence[str],
        first: list[_Row],
        timed: bool,
    ) -> None:
        self.where, self.layout, self.places, self.names = where, layout, places, names
        self.timed = timed
        begin = [[row[place] for place in places if place < len(row)] for _, row in first]
        self.stamps: Stamps | None = None
        told = [row[0] for row in begin if timed and row and is_stamp(row[0])]
        if 2 * len(told) > len(begin):
            self.stamps = Stamps(told)
        self.marks: set[str] = set()  # decimal ones
        numbers = [cell for row in begin for cell in row[int(self.stamps is not None) :]]
        if any(map(has_decimal_comma, numbers)):
            self._check_commas(numbers, first[0][0])
            self.marks.add(",")
        elif any("." in cell and is_number(cell) for cell in numbers):
            self.marks.add(".")

    def values(self, rows: Iterator[_Row], most: int) -> tuple[Vector, Matrix]:
        """Return the numbers of the lines, and their values (samples, columns)."""
        numbers: list[Vector] = []
        blocks: list[Matrix] = []
        size = 0
        while block := list(islice(rows, _BLOCK)):
            size += 8 * len(block) * (len(self.places) + 1)
            check_size(size, most, self.where)
            of_block, values = self._block(block)
            numbers.append(np.array(of_block, dtype=np.float64))
            blocks.append(values)
        return np.concatenate(numbers), np.concatenate(blocks)

    def _check_commas(self, cells: list[str], line: int) -> None:
        """Check that commas in numbers are decimal ones."""
        commas = [cell for cell in cells if has_decimal_comma(cell)]
        told = any(
            len(cell.partition(",")[2]) != 3 or cell.lstrip("+-")[:2] in ("0,", ",")
            for cell in commas
        )
        if self.layout.separator != ";" and not told:
            raise ValueError(
                f"{self.where}, line {line} and below: {commas[0]!r} may be a number with a comma "
                "between thousands, or a decimal one; write decimal points, and nothing between "
                "thousands"
            )

    def _block(self, rows: list[_Row]) -> tuple[list[int], Matrix]:
        """Return the numbers of some lines, and their values (rows, columns)."""
        table = [row for _, row in rows]
        widths, width = {*map(len, table)}, self.layout.width
        even = widths == {width} or (
            widths <= {width, width + 1} and not any(row[width:] > [""] for row in table)
        )
        if even:
            try:
                values = self._whole(table)
                if np.all(np.isfinite(values)):
                    return [number for number, _ in rows], values
            except ValueError:
                pass
        # One at a time, to name the faulty one, and to leave out those without all values.
        kept = [(number, row) for number, row in rows if not (self.timed and self._lacks(row))]
        found = [self._row(number, row) for number, row in kept]
        return [number for number, _ in kept], np.array(found).reshape(-1, len(self.places))

    def _lacks(self, row: list[str]) -> bool:
        """Return whether a row has a time, but not all of the other values: none is too large."""
        if len(row) != self.layout.width:
            return False
        time, *others = (row[place] for place in self.places)
        gone = [cell for cell in others if is_missing(cell)]
        return bool(gone) and not is_missing(time) and not any(map(is_beyond, gone))

    def _whole(self, table: list[list[str]]) -> Matrix:
        """Return the values of rows without faults; raise a ``ValueError`` if there are some."""
        cells = [*map(itemgetter(*self.places), table)]
        times: list[float] = []
        if self.stamps is not None:
            times = [self.stamps.seconds(row[0]) for row in cells]
            cells = [row[1:] for row in cells]
        text = "".join(chain.from_iterable(cells))
        if "_" in text or ("," in self.marks and "." in text):  # Python alone accepts 1_000
            raise ValueError
        if "," in self.marks:
            cells = [tuple(cell.replace(",", ".", 1) for cell in row) for row in cells]
        values = np.array(cells, dtype=np.float64)
        return np.column_stack((times, values)) if times else values

    def _row(self, number: int, row: list[str]) -> list[float]:
        width, where = self.layout.width, f"{self.where}, line {number}"
        values = [
            self._value(where, row[place] if place < len(row) else "", name, k == 0)
            for k, (place, name) in enumerate(zip(self.places, self.names, strict=True))
        ]
        if len(row) < width or any(row[width:]):
            hint = hint_of_commas(self.layout.separator, row)
            raise ValueError(f"{where}: has {len(row)} cells, and other lines have {width}{hint}")
        return values

    def _value(self, where: str, text: str, name: str, first: bool) -> float:
        shown = text if len(repr(text)) <= 42 else f"{text[: 37 if text.isprintable() else 9]}..."
        if first and self.stamps is not None:
            try:
                return self.stamps.seconds(text)
            except ValueError as error:
                remedy = "mend it, or give the sample time in place of the times (--dt)"
                raise ValueError(f"{where}: {name} = {shown!r}: {error}; {remedy}") from None
        if is_missing(text):
            number = is_number(text)
            rule = "must be finite" if number else "must be a number"
            remedy = "fill it in if you know it, or cut the record there"
            shown = shown if number else repr(shown)
            raise ValueError(f"{where}: {name} = {shown}: {rule}; {remedy}")
        where = f"{where}: {name} = {shown!r}"
        pointed = text
        if has_decimal_comma(text):
            self._mark(where, ",")
            pointed = text.replace(",", ".", 1)
        elif "." in text and is_number(text):
            self._mark(where, ".")
        if not is_number(pointed):
            raise ValueError(f"{where}: must be a number; {self._remedy(text, first)}")
        if not np.isfinite(value := float(pointed)):
            raise ValueError(f"{where}: must be finite; mend the record or cut it there")
        return value

    def _mark(self, where: str, mark: str) -> None:
        self.marks.add(mark)
        if len(self.marks) > 1:
            raise ValueError(
                f"{where}: the file has decimal points and decimal commas; write points only, and "
                "nothing between thousands"
            )

    def _remedy(self, text: str, time: bool) -> str:
        if self.layout.names is not None and text in self.layout.names:
            return "the names are there again, where another record begins; cut it there"
        if "\0" in text:
            return "cut the record there, where its text ends"
        if is_stamp(text):
            if time:
                return "most others are no dates; mend it, or give the sample time (--dt)"
            return (
                "dates and times are read as t only; say which columns are t, u and y (--columns)"
            )
        if has_thousands(text):
            return "write nothing between thousands, and decimal points"
        if time:
            return (
                "a time is a number, a date or hours:minutes:seconds; mend it, cut the record "
                "there, or give the sample time in place of the times (--dt)"
            )
        return "mend the record, cut it there, or take another column (--columns)"
