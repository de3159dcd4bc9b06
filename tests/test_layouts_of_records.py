"""How a file of a record is laid out: names and units of columns, dates, separators, lines above the numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from quell.identification.record_layout import (
    Layout,
    Name,
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
    is_unit,
    is_value,
    layout_of,
    listed,
    name_of,
    quantity_of,
    seems_record,
    seems_setup,
    time_unit_of,
    unwrapped,
    without_empty_end,
)
from quell.quantities import Quantity

from .cases import cases

DAY = 86400.0


# ---- columns


@cases(
    ("text", "below", "name", "time"),
    [
        ("t [ms]", "", ("t", "ms"), "ms"),
        ("time_ms", "", ("time", "ms"), "ms"),
        ("Time (s)", "", ("time", "s"), "s"),
        ("Zeit/µs", "", ("zeit", "µs"), "us"),
        ("msec", "", ("time", "msec"), "ms"),
        ("min", "", ("min", ""), None),
        ("t", "[s]", ("t", "s"), "s"),
        ("t", " (Sekunden) ", ("t", "Sekunden"), "s"),
        ("y_h", "", ("y_h", ""), None),
        ("y [h]", "", ("y", "h"), "h"),
        ("speed_rpm", "", ("speed", "rpm"), None),
        ("speed (ref)", "", ("speed (ref)", ""), None),
        ("speed (left)", "", ("speed", "left"), None),
        ("speed (leftmost)", "", ("speed", "leftmost"), None),
        ("speed (leftmosts)", "", ("speed (leftmosts)", ""), None),
        ("y {12}", "", ("y {12}", ""), None),
        ("y [%]", "", ("y", "%"), None),
        ("  motor   speed [rad/s]", "", ("motor speed", "rad/s"), None),
        ("n [Samples]", "", ("n", "Samples"), None),
        ("Y", "", ("y", ""), None),
    ],
)
def test_a_column_has_a_name_and_a_unit(text: str, below: str, name: Any, time: Any) -> None:
    """In brackets, behind _, a space or a slash, or from a line below; words are no units."""
    found = name_of(text, below)
    assert found == Name(*name)
    assert time_unit_of(found) == time
    assert counts_samples(found) == (name[1] == "Samples")


@cases(
    ("text", "below", "role", "quantity"),
    [
        ("angle [rad]", "", "y", ("angle", "rad")),
        ("y [rad]", "", "y", ("", "rad")),
        ("y [rad]", "", "u", ("y", "rad")),
        ("angle_rad", "", "y", ("angle", "rad")),
        ("speed (left)", "", "y", ("", "")),
        ("speed [left]", "", "y", ("speed", "left")),
        ("angle", "deg", "y", ("angle", "deg")),
        ("angle", "", "y", ("", "")),
        ("output", "V", "y", ("", "V")),
        ("a[2] [m]", "", "y", ("", "m")),
    ],
)
def test_a_quantity_has_the_name_of_its_column_where_that_is_not_its_role(
    text: str, below: str, role: str, quantity: Any
) -> None:
    """And its unit; words in round brackets that are no unit are none."""
    assert quantity_of(text, below, role) == Quantity(*quantity)


@cases(
    ("names", "asked", "role", "places"),
    [
        (["t", "u", "y"], "u", "u", [1]),
        (["t", "U [V]", "y"], "u", "u", [1]),
        (["t", "Input", "Output"], "u", "u", [1]),
        (["t", "Input", "Output"], "y", "y", [2]),
        (["t", "Input", "Output", "Setpoint"], "u", "u", []),
        (["t", "Input", "Output", "y", "Setpoint"], "u", "u", [1]),
        (["t", "u", "input"], "u", "u", [1]),
        (["t", "u [V]", "U [A]"], "u", "u", [1, 2]),
        (["t", "current_A", "current_V"], "current", "u", [1, 2]),
        (["t", "current_A", "current_V"], "current [a]", "u", [1]),
        (["t", "CURRENT"], "current", "u", [1]),
        (["Time", "T", "u"], "t", "t", [0]),
        (["Time", "T [s]", "u"], "t", "t", [0]),
        (["T", "u"], "t", "t", [0]),
        (["T [°C]", "u"], "t", "t", []),
        (["t [sample]", "u"], "t", "t", [0]),
        (["x", "z"], "t", "t", []),
        (["t", "ref", "r"], "r", "r", [2]),
    ],
)
def test_columns_are_found_by_their_names_or_common_other_ones(
    names: Any, asked: str, role: str, places: Any
) -> None:
    """The same name first; input and output are those of a controller beside a setpoint."""
    assert found_in(names, [""] * len(names), asked, role) == places


def test_long_lists_of_names_are_cut() -> None:
    """40 names of 40 letters."""
    assert listed(["a", "b"]) == "a, b"
    assert listed(["x" * 40]) == "x" * 40
    assert listed(["x" * 41]) == "x" * 37 + "..."
    names = [f"n{i}" for i in range(43)]
    assert listed(names) == ", ".join(names[:40]) + " and 3 more"
    assert listed(names[:40]) == ", ".join(names[:40])


# ---- dates and times


@cases(
    ("texts", "seconds"),
    [
        (["2024-05-31 12:00:00", "2024-06-01 00:00:00.5"], [43200.0, DAY + 0.5]),
        (
            ["2024/2/28T23:59:59", "2024/2/29T00:00:00", "2024/3/1T00:00:00"],
            [86399.0, DAY, 2 * DAY],
        ),
        (["31.05.2024 01:02", "01.06.24 01:03"], [3720.0, DAY + 3780.0]),
        (["13/1/2024", "14/1/2024"], [0.0, DAY]),
        (["1/13/2024", "2/1/2024"], [0.0, 19 * DAY]),
        (["5-Jan-2024 10:00:00", "5 feb 2024 10:00:00"], [36000.0, 36000.0 + 31 * DAY]),
        (["12:00:01", "12:00:02,25"], [43201.0, 43202.25]),
        (["05:30.5", "06:00.0"], [330.5, 360.0]),
        (["1:30:00 PM", "12:00:00 am", "12:00:00 p.m."], [48600.0, 0.0, 43200.0]),
        (["11:59:59 PM", "1:00 pm"], [86399.0, 46800.0]),
        (["2024-05-31T12:00:00Z", "2024-05-31T12:00:00+02:00"], [43200.0, 36000.0]),
        (["2024-05-31 12:00:00 -0130", "2024-05-31 12:00:00 UTC"], [48600.0, 43200.0]),
        (["2024-05-31 23:59:60", "2024-05-31 24:00"], [86400.0, 86400.0]),
        (["100:00:00", "100:00:01"], [360000.0, 360001.0]),
    ],
)
def test_stamps_are_seconds_since_the_midnight_before_the_first(texts: Any, seconds: Any) -> None:
    """ISO, day.month.year, slashes, names of months, halves of days, zones, minutes of spreadsheets."""
    read = Stamps(texts)
    assert all(map(is_stamp, texts))
    assert [read.seconds(text) for text in texts] == pytest.approx(seconds)


@cases(
    ("texts", "message"),
    [
        (["12:00:00", "noon"], "must be a date or a time of day, as the first ones are"),
        (["12:00:00", ""], "must be a date or a time of day, as the first ones are"),
        (["2024-05-31 12:00:00", "12:00:01"], "must have a date, as the first one"),
        (["12:00:00", "2024-05-31 12:00:00"], "has a date"),
        (["31-May-2024", "31-Mai-2024"], "has no month in English, Jan to Dec"),
        (["1/2/2024", "1/3/2024"], "day and month can't be told apart; write 2024-05-31"),
        (["2024-02-30"], "is no date"),
        (["12:30"], "may be hours:minutes or minutes:seconds; write hours:minutes:seconds"),
        (["13:00:00 PM"], "is no time of day"),
        (["0:30:00 AM"], "is no time of day"),
        (["12:60:00"], "is no time of day"),
        (["12:00:61"], "is no time of day"),
        (["2024-05-31 25:00:00"], "is no time of day"),
    ],
)
def test_what_is_no_stamp_is_said_with_the_rule(texts: Any, message: str) -> None:
    """The last of the texts breaks it."""
    read = Stamps(texts)
    for text in texts[:-1]:
        read.seconds(text)
    with pytest.raises(ValueError) as caught:
        read.seconds(texts[-1])
    assert str(caught.value) == message


def test_a_date_of_which_day_and_month_are_not_told_apart_may_stay_the_same() -> None:
    """As all samples of a day have it; 12 of a half is the first hour."""
    read = Stamps(["1/2/2024 10:00:00"])
    assert [read.seconds(f"1/2/2024 10:00:0{k}") for k in range(3)] == [36000.0, 36001.0, 36002.0]
    assert Stamps(["1/2/24"]).day_first is None
    assert Stamps(["13/2/24"]).day_first is True
    assert Stamps(["12/13/24"]).day_first is False
    assert not is_stamp("")
    assert not is_stamp("1.5")


def test_times_of_day_rise_over_midnight() -> None:
    """Where they fall by more than half a day."""
    t = np.array([86398.0, 86399.0, 0.0, 1.0, 50000.0, 49000.0, 80000.0, 10.0])
    assert unwrapped(t).tolist() == [
        86398.0, 86399.0, DAY, DAY + 1.0, DAY + 50000.0, DAY + 49000.0, DAY + 80000.0, 2 * DAY + 10.0,
    ]  # fmt: skip
    assert unwrapped(np.array([43200.0, 0.0])).tolist() == [43200.0, 0.0]
    assert unwrapped(np.array([43201.0, 0.0])).tolist() == [43201.0, DAY]


# ---- cells


@cases(
    ("text", "number", "comma", "thousands", "missing", "beyond", "value"),
    [
        ("1.5", True, False, False, False, False, True),
        ("-1e-3", True, False, False, False, False, True),
        ("1_000", False, False, False, False, False, False),
        ("1,5", False, True, False, False, False, True),
        ("-,5e3", False, True, False, False, False, True),
        ("1,234", False, True, True, False, False, True),
        ("1.234,5", False, False, True, False, False, False),
        ("1,234,567.8", False, False, True, False, False, False),
        ("nan", True, False, False, True, False, False),
        ("NaN", True, False, False, True, False, False),
        ("-inf", True, False, False, True, True, False),
        ("OL", False, False, False, True, True, False),
        ("#N/A", False, False, False, True, False, False),
        ("", False, False, False, True, False, False),
        ("12:00:00", False, False, False, False, False, True),
        ("abc", False, False, False, False, False, False),
    ],
)
def test_a_cell_is_a_number_or_stands_for_one_that_is_missing(
    text: str, number: bool, comma: bool, thousands: bool, missing: bool, beyond: bool, value: bool
) -> None:
    """With points, commas, marks between thousands; what instruments and spreadsheets write."""
    found = (is_number(text), has_decimal_comma(text), has_thousands(text))
    assert found == (number, comma, thousands)
    assert (is_missing(text), is_beyond(text), is_value(text)) == (missing, beyond, value)


def test_lines_are_split_and_their_ends_and_comments_known() -> None:
    """Quotes hold a separator; what a spreadsheet lacks is no comment."""
    assert cells_of("1, 2,3", ",") == ["1", "2", "3"]
    assert cells_of('"a,b",2', ",") == ["a,b", "2"]
    assert cells_of("1  2\t3", None) == ["1", "2", "3"]
    assert without_empty_end(["1", "2", ""]) == ["1", "2"]
    assert without_empty_end(["1", "2"]) == ["1", "2"]
    assert without_empty_end([]) == []
    assert [is_comment(text) for text in ("# a", "% a", "// a", "#N/A,1", "1,2")] == [
        True, True, True, False, False,
    ]  # fmt: skip
    assert [is_unit(text) for text in ("[V]", "rad/s", "-", "", "bool", "speed", "#", "Sec")] == [
        True, True, True, True, True, False, True, True,
    ]  # fmt: skip
    more = "; if the commas are decimal ones, write points in their place, or put semicolons between the cells"
    each = "; give each column a name, and each line as many cells"
    assert hint_of_commas(",", ["1", "2"]) == more
    assert hint_of_commas(",", ["1.5", "2"]) == each
    assert hint_of_commas(";", ["1", "2"]) == each


def test_a_text_is_a_setup_or_a_record() -> None:
    """By its first lines; three rows of numbers make a record."""
    setup = ["# a", "", "[plant]", 'kind = "linear"', "num = [1.0]"]
    assert seems_setup(setup)
    assert not seems_record(setup)
    rows = ["t,u,y", "0,1,2", "1,2,3", "2,3,4"]
    assert seems_record(rows)
    assert not seems_record(rows[:3])
    assert not seems_setup(rows)
    assert not seems_setup([])


# ---- layouts


def laid(text: str, columns: Any = ("t", "u", "y"), timed: bool = True) -> Layout:
    """Return the layout of a text."""
    return layout_of("f.csv", text.split("\n"), columns, timed)


@cases(
    ("text", "layout"),
    [
        ("t,u,y\n0,1,2\n1,2,3\n2,3,4", (",", ["t", "u", "y"], 1, ["", "", ""], 3, 1)),
        ("t;u;y\n0,5;1;2\n1;2,5;3\n2;3;4", (";", ["t", "u", "y"], 1, ["", "", ""], 3, 1)),
        ("t\tu\ty\n0\t1\t2\n1\t2\t3", ("\t", ["t", "u", "y"], 1, ["", "", ""], 3, 1)),
        ("t u y\n0 1 2\n1 2 3", (None, ["t", "u", "y"], 1, ["", "", ""], 3, 1)),
        ("0,1,2\n1,2,3\n2,3,4", (",", None, 0, ["", "", ""], 3, 0)),
        ("t,u,y\ns,V,rad\n0,1,2\n1,2,3", (",", ["t", "u", "y"], 1, ["s", "V", "rad"], 3, 2)),
        ("# t,u,y\n0,1,2\n1,2,3", (",", ["t", "u", "y"], 1, ["", "", ""], 3, 1)),
        ("made by x\n\nt,u,y\n-,-,-\n0,1,2\n1,2,3", (",", ["t", "u", "y"], 3, ["", "", ""], 3, 4)),
        ("t,u,y,\n0,1,2,\n1,2,3,", (",", ["t", "u", "y"], 1, ["", "", ""], 3, 1)),
        ("t,u,y\n0,,2\n1,2,3\n2,3,4", (",", ["t", "u", "y"], 1, ["", "", ""], 3, 1)),
        ("0,,2\n1,2,3\n2,3,4\n3,4,5", (",", None, 0, ["", "", ""], 3, 0)),
        ("a;b\nt,u,y\n0,1,2\n1,2,3", (",", ["t", "u", "y"], 2, ["", "", ""], 3, 2)),
        ("t,u,y\nfloat,float,float\n0,1,2\n1,2,3", (",", ["t", "u", "y"], 1, ["float"] * 3, 3, 2)),
    ],
)
def test_a_table_begins_below_its_names_and_units(text: str, layout: Any) -> None:
    """Separator, names and their line, units, number of columns, lines before the numbers."""
    assert laid(text) == Layout(*layout, laid(text).numeric)


@cases(
    ("text", "message"),
    [
        ("\n\n", "f.csv: is empty; give a table of time, input and output"),
        (
            "a\nb\nc",
            "f.csv: has no table of numbers: no line with two numbers or more; give a text file",
        ),
        (
            "[plant]\nnum = [1]",
            "f.csv: is a setup, not a record: quell run, quell sweep and quell tune take a setup, in a",
        ),
        (
            "t,u,y\n0,05,1,02,2,03\n0,06,1,03,2,04\n0,07,1,04,2,05",
            "f.csv, line 2: has 6 cells, and no decimal points, but digits such as 05, as behind decimal "
            "commas; if the commas are decimal ones, write points in their place, or put semicolons",
        ),
        (
            "t,u\n0.5,1,2\n1.5,2,3\n2.5,3,4",
            "f.csv: column y is missing; the first line names t, u, but the numbers below it have 3 "
            "cells in a line; give each column a name, and each line as many cells",
        ),
        (
            "x\nt,u,y,z\n0.5,1,2\n1.5,2,3\n2.5,3,4",
            "f.csv: line 2 names t, u, y, z, but the numbers below it have 3 cells in a line; give each",
        ),
    ],
)
def test_what_is_no_table_is_refused_with_what_to_do(text: str, message: str) -> None:
    """Empty, a text, a setup, decimal commas, another number of names."""
    with pytest.raises(ValueError) as caught:
        laid(text)
    assert str(caught.value).startswith(message)
