"""Records as real programs write them: each is read right, or refused with cause and remedy."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quell.cli.app import app
from quell.commissioning import is_record, measured, measured_records
from quell.identification import Measured, read_record
from quell.setup import SetupError
from quell.setup import load as load_setup
from quell.types import Vector

COUNT, DT = 64, 0.01
U = np.where(np.random.default_rng(3).random(COUNT) < 0.5, -0.5, 1.5)
_Y = [0.0]
for _u in U[:-1]:
    _Y.append(0.8 * _Y[-1] + 0.2 * _u)
Y = np.round(_Y, 4)
K = np.arange(COUNT)
T = DT * K


def table(
    t: Sequence[Any] | Vector = T,
    names: str = "t,u,y",
    mark: str = ",",
    *,
    keep: Sequence[int] | Vector = K,
    decimal: str = ".",
    digits: str = ".10g",
    end: str = "",
) -> str:
    """Return the text of the true record with times ``t``, or texts, of the samples ``keep``."""
    lines = [names.replace(",", mark)] if names else []
    for time, k in zip(t, keep, strict=True):
        cells = [time if isinstance(time, str) else format(time, digits)]
        cells += [format(U[k], digits), format(Y[k], digits)]
        if not isinstance(time, str):
            cells[0] = cells[0].replace(".", decimal)
        lines.append(mark.join([cells[0], *(c.replace(".", decimal) for c in cells[1:])]) + end)
    return "\n".join(lines) + "\n"


def rows(pattern: Callable[[int], str]) -> str:
    """Return a line for each sample."""
    return "".join(f"{pattern(k)}\n" for k in range(COUNT))


def swapped(text: str, old: str, new: str) -> str:
    """Return a text in which one thing was replaced; it must be there."""
    assert old in text
    return text.replace(old, new, 1)


@dataclass(frozen=True)
class Read:
    """A file that is read right."""

    content: str | bytes
    dt: float = DT
    warned: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    rtol: float = 1e-9  # of dt
    name: str = "data.csv"
    y_off: float = 1e-9  # where a sample is made of its neighbours


@dataclass(frozen=True)
class Refused:
    """A file that is refused."""

    content: str | bytes
    cause: str
    remedy: str
    options: dict[str, Any] = field(default_factory=dict)
    name: str = "data.csv"


def columns(*names: str, **more: Any) -> dict[str, Any]:
    """Return options of ``read_record``."""
    return {"columns": names, **more}


def jittered(size: float) -> Vector:
    """Return times with uniform jitter of ``size`` samples."""
    return T + size * DT * np.random.default_rng(5).uniform(-1.0, 1.0, COUNT)


def without(*samples: int) -> dict[str, Any]:
    """Return the arguments of ``table`` for a record that lacks samples."""
    keep = np.delete(K, samples)
    return {"t": T[keep], "keep": keep}


LATE = np.where(K == 30, T[31] - 1e-5, T)
TWICE = np.sort(np.append(K, 30))
GAP = T[1] * np.where(K < 40, K, K + 30)
CLOCK = [f"12:{k // 60:02d}:{k % 60:02d}" for k in range(COUNT)]
MIDNIGHT = [
    f"{(86390 + k) // 3600 % 24}:{(86390 + k) // 60 % 60:02d}:{(86390 + k) % 60:02d}" for k in K
]
SECONDS = {"dt": 1.0}
BODY = table(names="")

TIMES: dict[str, Read | Refused] = {
    "3 kHz written with microseconds": Read(table(np.round(K / 3000, 6)), 1 / 3000, rtol=1e-4),
    "60 Hz written with milliseconds": Read(table(np.round(K / 60, 3)), 1 / 60, rtol=1e-3),
    "60 Hz cut off to milliseconds": Read(table(np.floor(1e3 * K / 60) / 1e3), 1 / 60, rtol=1e-3),
    "400 Hz written with milliseconds": Read(table(np.round(K / 400, 3)), 1 / 400, rtol=1e-3),
    "700 Hz written with milliseconds": Read(table(np.round(K / 700, 3)), 1 / 700, rtol=3e-3),
    "1 Hz written with tenths": Read(table(K * 1.02 // 0.1 * 0.1), 1.02, rtol=2e-3),
    "10 Hz written with whole seconds": Read(
        table(np.floor(K / 10 + 0.03)), 0.1, "resolution of 1 s only.*--dt", rtol=1e-2
    ),
    "2 kHz written with milliseconds": Read(
        table(np.floor(K / 2 + 0.2) / 1e3), 5e-4, "resolution of 0.001 s", rtol=1e-2
    ),
    "an odd sample time": Read(table(K * 1.00024), 1.00024),
    "jitter of a fifth of a sample": Read(table(jittered(0.2)), rtol=4e-3),
    "jitter of a third of a sample": Read(table(jittered(0.33)), rtol=6e-3),
    "a late time": Read(table(LATE), DT, "line 32: t rises by .*as evenly spaced", rtol=2e-3),
    "a time that is there twice": Read(
        table(np.where(K == 30, T[29], T)), DT, "line 32: t rises by 0 s.*evenly", rtol=2e-3
    ),
    "a sample that is there twice": Read(
        table(T[TWICE], keep=TWICE), DT, "line 33: .*1 repeated of 64.*--dt"
    ),
    "a missing sample": Read(
        table(**without(30)),
        DT,
        "line 32: t rises by 0.02 s .*1 missing of 64.*u keeps its value.*y is interpolated.*--dt",
        y_off=0.25,
    ),
    "two missing samples in a row": Read(
        table(**without(30, 31)), DT, "2 missing of 64", y_off=0.5
    ),
    "three single missing samples": Read(
        table(**without(10, 30, 45)), DT, "one of 3 odd steps .3 missing", y_off=0.3
    ),
    "a missing sample between rounded times": Read(
        table(np.delete(np.round(K / 400, 3), 30), keep=np.delete(K, 30)),
        1 / 400,
        "1 missing of 64",
        rtol=1e-3,
        y_off=0.25,
    ),
    "seconds since 1970": Read(table(1.7e9 + T, digits=".15g"), rtol=1e-6),
    "seconds since 1970 with milliseconds at 400 Hz": Read(
        table([f"{1.7e9 + k / 400:.3f}" for k in K]), 1 / 400, rtol=1e-3
    ),
    "whole seconds since 1970, each five": Read(table(1.7e9 + 5.0 * K, digits=".12g"), 5.0),
    "milliseconds since 1970": Read(
        table(1.7e12 + 10 * K, digits=".15g"), 10.0, "after the year 2286.*--time-unit ms"
    ),
    "times that begin before the trigger": Read(table(T - 0.2)),
    "times that begin late": Read(table(T + 1234.5)),
    "a heater's whole seconds": Read(table(1.0 * K), 1.0),
    "a heater's whole minutes in seconds": Read(table(60.0 * K), 60.0),
    "whole numbers, ten apart": Read(table(10.0 * K), 10.0),
    "whole numbers without a name": Read(
        table(1.0 * K, ""), 1.0, "if they count samples, give the sample time"
    ),
    "whole numbers with their unit in the name": Read(table(10.0 * K, "time_s,u,y"), 10.0),
    "whole numbers with their unit in brackets": Read(table(5.0 * K, "t [s],u,y"), 5.0),
    "days of a spreadsheet": Read(
        table([f"{45413.5 + k / 86400:.9f}" for k in K]), 1 / 86400, "--time-unit d", rtol=1e-5
    ),
    "days of a spreadsheet with their unit": Read(
        table([f"{45413.5 + k / 86400:.9f}" for k in K]),
        1.0,
        options={"time_unit": "d"},
        rtol=1e-5,
    ),
    "minutes with their unit": Read(
        table(K / 60, "t [min],u,y"), 1.0, options={"time_unit": "min"}, rtol=1e-6
    ),
    "a clock that adds up in single precision": Read(
        table(np.cumsum(np.full(COUNT, 0.01, np.float32)).astype(float)), rtol=1e-5
    ),
    "times that dt replaces": Read(table(GAP), options=columns("u", "y", dt=DT)),
    "a long gap": Refused(
        table(GAP), r"line 42: t rises by 0.31 s .*a gap of 30 samples", "cut the record.*--dt 0.01"
    ),
    "many missing samples": Refused(
        table(**without(*range(5, 60, 4))), "14 of 49 steps are odd", "interpolate.*--dt"
    ),
    "times that fall": Refused(
        table(np.where(K < 40, T, T - 0.4)), "line 42: t falls from 0.39 to 0", "cut the.*--dt"
    ),
    "times that stand still": Refused(
        table(0.0 * K), "t does not rise, it is 0", "--columns.*--dt"
    ),
    "times with two digits": Refused(
        table([f"{x:.2g}" for x in 100.0 + T * 30]), "t does not rise|resolution", "--dt"
    ),
    "steps of a solver": Refused(
        table(np.logspace(-3.0, 2.0, COUNT)), "does not rise, or hardly, at 16", "--dt"
    ),
    "milliseconds by the name": Refused(
        table(10.0 * K, "t [ms],u,y"), "'t .ms.' is not in seconds", "--time-unit ms"
    ),
    "milliseconds by a line of units": Refused(
        swapped(table(10.0 * K), "t,u,y\n", "t,u,y\n(ms),(V),(V)\n\n"), "not in seconds", "unit ms"
    ),
    "hours by the name": Refused(table(T, "time (h),u,y"), "not in seconds", "--time-unit h"),
}

STAMPS: dict[str, Read | Refused] = {
    "ISO 8601 with a space": Read(table([f"2024-05-01 12:00:{x:06.3f}" for x in T])),
    "ISO 8601 with T and Z": Read(
        table([f"2024-05-01T12:00:{x:06.3f}Z" for x in T], "Timestamp,u,y")
    ),
    "ISO 8601 with decimal commas": Read(
        table([f"2024-05-01 12:00:{x:06.3f}".replace(".", ",") for x in T], mark=";", decimal=",")
    ),
    "times of day": Read(table(CLOCK), 1.0),
    "times of day over midnight": Read(table(MIDNIGHT), 1.0),
    "minutes, seconds and tenths": Read(table([f"00:{x:04.1f}" for x in 10 * T]), 0.1),
    "German dates": Read(
        table(
            [f"01.05.2024 12:{k % 60:02d}" if k < 60 else f"01.05.2024 13:{k - 60:02d}" for k in K],
            mark=";",
            decimal=",",
        ),
        60.0,
    ),
    "American dates": Read(
        table([f"5/31/2024 1{1 + k // 60}:{k % 60:02d}:00 AM" for k in K][:60], keep=K[:60]), 60.0
    ),
    "a column of dates beside times of day": Read(
        "Date,Time,u,y\n" + rows(lambda k: f"2024-05-01,{CLOCK[k]},{U[k]},{Y[k]}"), 1.0
    ),
    "dates that dt replaces": Read(table(CLOCK), options=columns("u", "y", dt=DT)),
    "day or month": Refused(
        table([f"0{1 + k // 32}/02/2024 {k % 24}:00:00" for k in range(COUNT)]),
        "line 34: t = .* can't be told apart",
        "2024-05-31.*--dt",
    ),
    "hours or minutes": Refused(
        table([f"12:{k:02d}" for k in range(60)], keep=K[:60]),
        "'12:00': may be hours:minutes",
        "write hours:minutes:seconds.*--dt",
    ),
    "the words of a date": Refused(
        table([f"Wed May 1 12:00:{k:02d} 2024" for k in K]), "line 2: t = 'Wed May", "--dt"
    ),
    "a time that is none": Refused(
        swapped(table(CLOCK), "12:00:07", "12:00:7x"), "line 9: t = '12:00:7x'", "mend it.*--dt"
    ),
    "a unit of dates": Refused(
        table(CLOCK),
        "dates or times of day, which have no unit",
        "leave it out",
        {"time_unit": "ms"},
    ),
    "dates and times between white space": Refused(
        rows(lambda k: f"2024-05-01 {CLOCK[k]} {U[k]} {Y[k]}"), "u = '12:00:00'", "--columns"
    ),
}

BLACKBOX = (
    '"Product","Blackbox flight data recorder"\n"firmware","4.4"\n"rollPID","45,80,40"\n'
    '"looptime","125"\n"rates","70,70,70"\n"loopIteration","time","u","y","flags"\n'
)
RIGOL = "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,-6.0e-02,1.0e-02,\n" + rows(
    lambda k: f"{k},{U[k]},{Y[k]},,,"
)
SHUNT = columns("TIME", "CH1", "CH2")

FILES: dict[str, Read | Refused] = {
    "a flight controller's export": Read(
        BLACKBOX + rows(lambda k: f"{k},{10000 * k},{U[k]},{Y[k]},ANGLE|ARM"),
        options={"time_unit": "us"},
    ),
    "an oscilloscope's export": Read(
        "Model,MSO24\nFirmware Version,1.1\n\nWaveform Type,ANALOG\nHorizontal Units,s\n"
        "Sample Interval,1e-2\nRecord Length,64\nLabels,,\nTIME,CH1,CH2\n" + BODY,
        options=SHUNT,
    ),
    "an oscilloscope's export with lines of the same length": Read(
        "Model,MSO24,\nFirmware,1.1,\n,,\nTIME,CH1,CH2\n" + BODY, options=SHUNT
    ),
    "an oscilloscope's export with units below the names": Read(
        "Record Length,Analog:64\nSource,CH1,CH2\nSecond,Volt,Volt\n" + BODY,
        options=columns("Source", "CH1", "CH2"),
    ),
    "names that are numbers": Read(
        "x-axis,1,2\nsecond,Volt,Volt\n" + BODY, options=columns("x-axis", "1", "2")
    ),
    "a column that counts samples": Refused(
        RIGOL, "column 'X' counts samples", "--dt", columns("X", "CH1", "CH2")
    ),
    "a column that counts samples, with dt": Read(RIGOL, options=columns("CH1", "CH2", dt=DT)),
    "LabVIEW's measurement file": Read(
        "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\t\nChannels\t2\n"
        "Samples\t64\t64\nX_Value\tu\ty\tComment\n" + table(names="", mark="\t", end="\t"),
        name="data.lvm",
    ),
    "a spreadsheet's mark of the separator": Read("sep=;\n" + table(mark=";", decimal=",")),
    "units below the names": Read(swapped(table(), "t,u,y\n", "t,u,y\ns,V,mm\n")),
    "a line of dashes below the names": Read(
        swapped(table(mark="\t"), "t\tu\ty\n", "t\tu\ty\n---\t---\t---\n")
    ),
    "white space in a .dat": Read(table(names="", mark="    "), name="data.dat"),
    "white space below names": Read("   " + table(mark="   "), name="data.txt"),
    "white space below names with units": Read(
        table(names="t [s],u [V],y [mm]", mark="  "), name="data.log"
    ),
    "names in a comment": Read(
        "# y,u,t\n" + rows(lambda k: f"{Y[k]} {U[k]} {T[k]:.2f}"), name="data.txt"
    ),
    "a remark in a comment": Read("% me, at home, today\n" + BODY),
    "tabs at the end of lines": Read(table(mark="\t", end="\t"), name="data.tsv"),
    "UTF-16": Read(table().encode("utf-16")),
    "UTF-16 without a mark": Read(table().encode("utf-16-le")),
    "UTF-16 of the other order": Read(b"\xfe\xff" + table().encode("utf-16-be")),
    "UTF-8 with a mark": Read(table().encode("utf-8-sig")),
    "Windows-1252": Read(("Wärme in °C\n" + table(names="t [s],u [µA],y [°C]")).encode("cp1252")),
    "ends of lines of old Macs": Read(table().replace("\n", "\r")),
    "ends of lines written twice": Read(table().replace("\n", "\r\r\n").encode()),
    "decimal commas between semicolons": Read(table(mark=";", decimal=",")),
    "decimal commas between white space": Read(table(mark=" ", decimal=","), name="data.txt"),
    "decimal commas in quotation marks": Read(
        "t,u,y\n" + rows(lambda k: f'"{T[k]:.2f}","{U[k]}","{Y[k]}"'.replace(".", ","))
    ),
    "numbers and names in quotation marks behind spaces": Read(
        't, "u", "y"\n' + rows(lambda k: f'{T[k]:.2f}, "{U[k]}", "{Y[k]}"')
    ),
    "decimal commas between commas": Refused(
        table(decimal=",", digits=".2f"), "names t, u, y, but .* 6 cells|has 6 cells", "semicolons"
    ),
    "decimal commas between commas without names": Refused(
        table(names="", decimal=",", digits=".2f"),
        "line 1: has 6 cells, and no decimal points",
        "semicolons",
        columns("u", "y", dt=DT),
    ),
    "decimal commas between some commas": Refused(
        table(decimal=","), r"line \d+: has \d cells", "write points|semicolons"
    ),
    "commas between thousands": Refused(
        "t,u,y\n" + rows(lambda k: f'{T[k]:.2f},"{1000 + k:,}",{Y[k]}'),
        "'1,000' may be .* thousands|points and decimal commas",
        "write",
    ),
    "points between thousands": Refused(
        swapped(table(mark=";", decimal=","), ";1,5;", ";1.234,5;"),
        "'1.234,5'",
        "between thousands",
    ),
    "points and commas": Refused(
        swapped(table(mark=";"), ";1.5;", ";1,5;"), "points and decimal commas", "write points"
    ),
    "a last line that was cut": Refused(table()[:-9], "line 65: y = '': must be a num", "cut the"),
    "a line with a cell too many": Refused(
        swapped(table(), "0.05,", "0.05,7,"), "line 7: has 4 cells, and other lines have 3", "cells"
    ),
    "text at the end": Refused(
        table() + "End of file\n", "line 66: t = 'End of file'", "cut the record there"
    ),
    "zeros at the end": Refused(table().encode() + bytes(40), "line 66: t =", "cut the record"),
    "names that are there again": Refused(
        table() + table(), "line 66: t = 't': .* names are there again", "cut it there"
    ),
    "a switch in words": Refused(
        table().replace("-0.5", "OFF"), "line .*: u = 'OFF': must be a num", "mend the record"
    ),
    "a quotation mark without another": Refused(
        swapped(table(), "\n0,", '\n"0,'), "has . samples", "quotation mark"
    ),
    "lines with names": Refused(
        "t u y\n" + rows(lambda k: f'"{k}" {T[k]} {U[k]} {Y[k]}'),
        "have 4 cells",
        "each column a name",
    ),
    "an index without a name": Read(",t,u,y\n" + rows(lambda k: f"{k},{T[k]},{U[k]},{Y[k]}")),
    "a column of words": Read("t,u,y,mode\n" + rows(lambda k: f"{T[k]},{U[k]},{Y[k]},RUN")),
}
for _text in ("nan", "NaN", "-", "", "#N/A", "null"):
    FILES[f"the text {_text!r} in place of a number"] = Read(
        swapped(table(), f",{Y[5]}\n", f",{_text}\n"), warned="1 missing of", y_off=0.2
    )
    FILES[f"the text {_text!r} in place of a number, without times"] = Refused(
        swapped(table(), f",{Y[5]}\n", f",{_text}\n"),
        f"line 7: y = '?{_text}'?: must be (finite|a number)",
        "fill it in if you know it, or cut the record there",
        {"columns": ("u", "y"), "dt": DT},
    )
for _text in ("inf", "OL"):
    FILES[f"the text {_text!r} in place of a number"] = Refused(
        swapped(table(), f",{Y[5]}\n", f",{_text}\n"),
        f"line 7: y = '?{_text}'?: must be (finite|a number)",
        "fill it in if you know it, or cut the record there",
    )

NAMES: dict[str, Read | Refused] = {
    "capitals": Read(table(names="T,U,Y")),
    "units behind": Read(table(names="Time (s),u [V],y_mm")),
    "input and output": Read(table(names="time,Input,Output")),
    "a temperature beside times": Read(table(names="time,u,T"), options=columns("t", "u", "T")),
    "another column of the same letter": Read(
        "t,u,y,y_ref,u_max\n" + rows(lambda k: f"{T[k]},{U[k]},{Y[k]},0,9")
    ),
    "the input of a controller": Refused(
        "Time,Setpoint,Input,Output\n" + rows(lambda k: f"{T[k]},1,{Y[k]},{U[k]}"),
        "column u is missing; the first line names Time, Setpoint, Input, Output",
        "--columns",
    ),
    "other names": Refused(
        table(names="time,current,angle"), "column u is missing; .* time, current, a", "--columns"
    ),
    "two columns of times": Refused(
        "time,timestamp,u,y\n" + rows(lambda k: f"{T[k]},{T[k]},{U[k]},{Y[k]}"),
        "column t may be time, timestamp",
        "--columns",
    ),
    "no times": Refused(
        "u,y\n" + rows(lambda k: f"{U[k]},{Y[k]}"), "column t is missing", "sample time .*--dt"
    ),
    "names twice": Refused(
        "t,u,y,y\n" + rows(lambda k: f"{T[k]},{U[k]},{Y[k]},0"), "y is there 2 times", "--columns"
    ),
}

OTHERS: dict[str, Read | Refused] = {
    "a setup": Refused("dt = 0.01\n", "is a setup by its name", "quell run", name="rig.toml"),
    "a setup by another name": Refused(
        "dt = 0.01\n[plant]\nkind = 'motor'\n", "is a setup, not a record", "quell tune"
    ),
    "a spreadsheet": Refused(
        b"PK\x03\x04" + bytes(99), "is a spreadsheet", "save its sheet as CSV"
    ),
    "an old spreadsheet": Refused(
        b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(99), "a spreadsheet", "as CSV", name="a.xls"
    ),
    "a MATLAB file": Refused(b"MATLAB 5.0 MAT-file" + bytes(99), "a MATLAB file", "writematrix"),
    "an image": Refused(b"\x89PNG\r\n\x1a\n" + bytes(99), "an image .PNG.", "give the numbers"),
    "an MCAP file with columns": Refused(
        b"\x89MCAP0\r\n" + bytes(9), "an MCAP file", "without --col"
    ),
    "a JSON file": Refused('{"t": [0, 1, 2], "u": [1, 2, 3]}', "a JSON file", "export the columns"),
    "other bytes": Refused(bytes(range(256)) * 9, "is a binary file", "export the columns"),
    "zeros": Refused(bytes(500), "a file of zero bytes", "another copy"),
    "a letter": Refused("Dear all,\nplease find it.\n", "no table of numbers", "give a text file"),
    "nothing": Refused("", "is empty", "give a table"),
    "three samples": Refused("t,u,y\n0,1,2\n1,2,3\n2,3,4\n", "has 3 samples", "record more"),
}

ALL = {
    f"{kind}: {name}": case
    for kind, cases in (
        ("times", TIMES),
        ("dates", STAMPS),
        ("file", FILES),
        ("names", NAMES),
        ("other", OTHERS),
    )
    for name, case in cases.items()
}


def written(folder: Path, case: Read | Refused) -> Path:
    """Write the file of a case."""
    path = folder / case.name
    content = case.content
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("case", [pytest.param(case, id=name) for name, case in ALL.items()])
def test_an_awkward_file_is_read_right_or_refused_with_cause_and_remedy(
    case: Read | Refused, tmp_path: Path
) -> None:
    """Read right: u, y and dt are those of the record, with no other warning than the one expected."""
    path = written(tmp_path, case)
    if isinstance(case, Refused):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            with pytest.raises(ValueError, match=case.cause) as refused:
                read_record(path, **case.options)
        message = str(refused.value)
        assert re.search(case.remedy, message), message
        assert "\n" not in message
        return
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        record = read_record(path, **case.options)
    messages = [str(one.message) for one in heard]
    assert len(messages) == bool(case.warned), messages
    if case.warned:
        assert re.search(case.warned, messages[0]), messages[0]
    assert record.dt == pytest.approx(case.dt, rel=case.rtol)
    count = record.u.size
    assert count in (COUNT, 60)
    made = np.abs(record.y - Y[:count]) > 1e-6
    assert np.count_nonzero(made) <= (4 if case.y_off > 1e-6 else 0)
    np.testing.assert_allclose(record.y, Y[:count], atol=case.y_off)
    held = np.where(made, record.u, U[:count])
    np.testing.assert_allclose(record.u, held, atol=1e-9)


def test_a_missing_sample_keeps_u_and_has_y_between_its_neighbours(tmp_path: Path) -> None:
    """The external signal of a closed loop is kept as u is."""
    lines = [f"{T[k]},{U[k]},{Y[k]},{k}" for k in K if k != 30]
    path = tmp_path / "data.csv"
    path.write_text("t,u,y,r\n" + "\n".join(lines))
    with pytest.warns(UserWarning, match="1 missing"):
        record = read_record(path, ("t", "u", "y", "r"))
    assert record.reference is not None
    assert (record.u[30], record.reference[30]) == (U[29], 29.0)
    assert record.y[30] == pytest.approx(0.5 * (Y[29] + Y[31]))
    np.testing.assert_array_equal(np.delete(record.y, 30), np.delete(Y, 30))


def test_times_of_uneven_samples_are_believed(tmp_path: Path) -> None:
    """A rate that changes by a third: y is that of the even times, but for the interpolation."""
    t = np.cumsum(np.linspace(0.010, 0.013, 150))
    path = tmp_path / "data.csv"
    path.write_text("t,u,y\n" + "".join(f"{x},{np.sign(x - 1)},{np.sin(5 * x)}\n" for x in t))
    with pytest.warns(UserWarning, match="uneven steps.: resampled 0.0115 s apart"):
        record = read_record(path)
    even = t[0] + record.dt * np.arange(record.y.size)
    np.testing.assert_allclose(record.y, np.sin(5.0 * even), atol=1e-3)
    late = np.abs(even - 1.0) > 0.5 * record.dt
    np.testing.assert_array_equal(record.u[late], np.sign(even - 1.0)[late])


@pytest.mark.parametrize("size", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("kind", ["jitter", "rounding"])
def test_the_mean_rate_is_right_within_a_part_of_a_sample(
    kind: str, size: float, tmp_path: Path
) -> None:
    """Over the whole record, for twenty draws of 1000 samples, all of which are there."""
    path = tmp_path / "data.csv"
    for seed in range(20):
        random = np.random.default_rng(seed)
        dt = round(float(random.uniform(0.001, 0.1)), 6)
        t = dt * np.arange(1000) + random.uniform()
        if kind == "jitter":
            t += size * dt * random.uniform(-1.0, 1.0, t.size)
        else:
            t = np.round(t / (2.0 * size * dt)) * (2.0 * size * dt)
        path.write_text("t,u,y\n" + "".join(f"{x:.12g},{k % 3},{k}\n" for k, x in enumerate(t)))
        record = read_record(path)
        np.testing.assert_array_equal(record.y, np.arange(1000.0))
        assert abs(record.dt / dt - 1.0) * t.size < 0.1


@pytest.mark.parametrize("seed", range(40))
def test_random_bytes_give_nothing_but_a_value_error(seed: int, tmp_path: Path) -> None:
    """Bytes of all values, of printable ones, and of those in tables; spliced into a record, too."""
    random = np.random.default_rng(seed)
    alphabets = [
        np.arange(256),
        np.frombuffer(bytes(range(32, 127)) + b"\n\n\n", np.uint8),
        np.frombuffer(b'0123456789.,;:-+eE \t\n"#%/nau', np.uint8),
    ]
    noise = random.choice(alphabets[seed % 3], 3000).astype(np.uint8).tobytes()
    text, at = table().encode(), int(random.integers(0, 800))
    path = tmp_path / "data.csv"
    for content in (
        noise,
        text[:at] + noise[:20] + text[at:],
        text[:at] + noise[:1] + text[at + 1 :],
    ):
        for options in ({}, {"columns": ("1", "2"), "dt": 0.1}):
            path.write_bytes(content)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                warnings.simplefilter("error", RuntimeWarning)
                with suppress(ValueError):
                    read_record(path, **options)  # type: ignore[arg-type]


def test_a_command_says_which_one_takes_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A setup command for a record, a record command for a setup."""
    monkeypatch.chdir(tmp_path)
    Path("log.txt").write_text(table(mark="\t"))
    Path("run.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(30))
    Path("rig.toml").write_text("dt = 0.01\n")
    Path("photo.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(30))
    for name in ("log.txt", "run.mcap"):
        for command in ("run", "sweep", "run-rig"):
            with pytest.raises(
                SetupError, match=f"{name}: is a record, not a setup: quell identify"
            ):
                app([command, name], result_action="return_value")
    with pytest.raises(SetupError, match="quell tune log.txt --out tuned.toml a controller"):
        load_setup("log.txt")
    with pytest.raises(SetupError, match="photo.png: is an image .PNG., not a setup"):
        load_setup("photo.png")
    for command in (["identify", "rig.toml"], ["b0", "rig.toml", "--order", "1"]):
        with pytest.raises(ValueError, match="is a setup by its name, not a record: quell run"):
            app(command, result_action="return_value")


def test_a_file_is_a_record_unless_it_is_called_a_setup() -> None:
    """Whatever loggers call their files."""
    records = ("a.csv", "a.TXT", "a.dat", "a.tsv", "a.log", "a.mcap", "a.nc", "a.lvm", "a")
    assert all(is_record(Path(name)) for name in records)
    assert not is_record(Path("rig.toml"))
    assert not is_record(Path("rig.TOML"))


def test_records_of_one_plant_have_one_sample_time(tmp_path: Path) -> None:
    """Small differences are averaged, others refused with both files."""
    paths = [tmp_path / name for name in ("a.csv", "b.csv", "c.csv")]
    for path, dt in zip(paths, (0.01, 0.010001, 0.02), strict=True):
        path.write_text(table(dt * K))
    records: list[Measured] = measured_records(paths[:2])
    assert [record.dt for record in records] == [pytest.approx(0.0100005)] * 2
    np.testing.assert_array_equal(records[1].y, Y)
    with pytest.raises(ValueError, match=r"c.csv': dt = 0.02 s: must be that of .*a.csv', 0.01 s"):
        measured_records(paths)
    with pytest.warns(UserWarning, match="dt = 0.5 s is given"):
        assert [record.dt for record in measured_records(paths, "2,3", 0.5)] == [0.5] * 3
    with pytest.raises(ValueError, match="data: missing"):
        measured_records([])
    assert measured(paths[2]).dt == pytest.approx(0.02)
