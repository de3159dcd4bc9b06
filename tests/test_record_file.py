"""Records of input and output from CSV files: ends of lines, units of times."""

from __future__ import annotations

import json
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from quell.cli.app import main
from quell.commissioning import measured_records
from quell.identification import Measured, read_record

from .cases import cases
from .commands import Shown


def record_of(path: Path, lines: list[str], **options: object) -> Measured:
    """Write lines to a file, and read it."""
    path.write_text("\n".join(lines) + "\n")
    return read_record(path, **options)  # type: ignore[arg-type]


def timed(step: float, start: float = 0.0, count: int = 12, end: str = "") -> list[str]:
    """Return lines of a record with times ``step`` apart."""
    return [f"{start + k * step:.15g},{k % 3},{k % 5}{end}" for k in range(count)]


@cases("names", [[], ["t,u,y,"], ["t,u,y"]])
@cases("mark", [",", ";", "\t"])
def test_a_delimiter_at_the_end_of_lines_costs_no_sample(
    names: list[str], mark: str, tmp_path: Path
) -> None:
    """With and without names; as spreadsheets and loggers write it."""
    lines = [line.replace(",", mark) for line in [*names, *timed(0.1, end=",")]]
    record = record_of(tmp_path / "data.csv", lines)
    np.testing.assert_array_equal(record.u, np.arange(12) % 3)
    assert record.dt == pytest.approx(0.1)


def test_a_first_line_that_lacks_a_number_is_no_line_of_names(tmp_path: Path) -> None:
    """It is a line without u, and the record begins with the next one."""
    lines = timed(0.1, 0.1)
    record = record_of(tmp_path / "data.csv", ["0.0,,1.0", *lines])
    assert record.y.tolist() == record_of(tmp_path / "same.csv", lines).y.tolist()


@cases(
    ("name", "unit"),
    [("t [ms]", "ms"), ("time_ms", "ms"), ("Time (us)", "us"), ("t/ns", "ns"), ("time [µs]", "us")],
)
def test_a_column_of_times_in_another_unit_is_not_taken_for_seconds(
    name: str, unit: str, tmp_path: Path
) -> None:
    """Its name tells; with the unit it is read."""
    lines, columns = [f"{name},u,y", *timed(5.0)], (name, "u", "y")
    with pytest.raises(ValueError, match=f"give time_unit = '{unit}' .--time-unit {unit}."):
        record_of(tmp_path / "data.csv", lines, columns=columns)
    record = record_of(tmp_path / "data.csv", lines, columns=columns, time_unit=unit)
    assert record.dt == pytest.approx(5.0 * {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit])


@cases(
    ("step", "start", "message"),
    [
        (2.5, 1.7e12, "as seconds since 1970 is after the year 2286"),
        (1e-8, 0.0, "more than a million samples per second"),
    ],
)
def test_times_that_are_hardly_seconds_give_a_warning(
    step: float, start: float, message: str, tmp_path: Path
) -> None:
    """Whoever says that they are seconds hears no more of it."""
    with pytest.warns(UserWarning, match=message):
        record = record_of(tmp_path / "data.csv", timed(step, start))
    assert record.dt == pytest.approx(step)
    assert record_of(tmp_path / "data.csv", timed(step, start), time_unit="s").dt == record.dt


def test_a_sample_time_that_contradicts_the_times_in_the_file_gives_a_warning(
    tmp_path: Path,
) -> None:
    """Milliseconds in place of seconds, for instance; dates and times that agree are left alone."""
    columns, lines = ("u", "y"), ["t,u,y", *timed(0.005)]
    with pytest.warns(UserWarning, match="dt = 5 s is given, but column 't' rises by 0.005"):
        record_of(tmp_path / "data.csv", lines, columns=columns, dt=5.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert record_of(tmp_path / "data.csv", lines, columns=columns, dt=0.005).dt == 0.005
        in_ms = ["t [ms],u,y", *timed(5.0)]
        assert record_of(tmp_path / "data.csv", in_ms, columns=columns, dt=0.005).dt == 0.005
        dated = ["time,u,y", *("12:00:01" + line[line.index(",") :] for line in timed(5.0))]
        assert record_of(tmp_path / "data.csv", dated, columns=columns, dt=0.1).u.size == 12
    with pytest.raises(ValueError, match="time_unit = 'ms': there are no times, as dt is given"):
        record_of(tmp_path / "data.csv", lines, columns=columns, dt=0.1, time_unit="ms")
    with pytest.raises(ValueError, match="time_unit = 'week': must be one of s, ms, us, ns, min"):
        record_of(tmp_path / "data.csv", lines, time_unit="week")


def test_a_text_of_names_is_no_list_of_them(tmp_path: Path) -> None:
    """As it is on the command line; the message shows what was given."""
    with pytest.raises(ValueError, match="columns = 't,u,y': must be t,u,y or .*, as a list"):
        record_of(tmp_path / "data.csv", timed(0.1), columns="t,u,y")


def test_a_warning_of_a_command_is_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the place in quell's own code where it came up."""

    def warn() -> None:
        sys.stderr.write(warnings.formatwarning("the times\n are odd", UserWarning, "file", 1))

    before = warnings.formatwarning
    monkeypatch.setattr("quell.cli.app.app", warn)
    main()
    assert capsys.readouterr().err == "quell: warning: the times are odd\n"
    assert warnings.formatwarning is before


# ---- A file for each channel ----

COUNT = 400
OF_U = np.where(np.repeat(np.random.default_rng(3).random(COUNT // 20) < 0.5, 20), -1.5, 0.5)
OF_Y = np.round(np.convolve([0.0, *OF_U[:-1]], 0.1 * 0.9 ** np.arange(90))[:COUNT], 4)
TIMES = 2e-4 * np.arange(COUNT) - 8e-3
SETTINGS = (
    "Record Length,4.000000e+02", "Sample Interval,2.000000e-04", "Trigger Point,4.000000e+01",
    ",", ",", ",", "Source,{channel}", "Vertical Units,{unit}", "Vertical Scale,5.000000e-01",
    "Vertical Offset,0.000000e+00", "Horizontal Units,s", "Pt Fmt,Y", "Probe Atten,1.000000e+01",
    "Model Number,TDS2014B", "Firmware Version,FV:v22.01",
)  # fmt: skip


def tektronix(channel: str, unit: str, values: np.ndarray, quoted: bool = False) -> str:
    """Return the file of a channel: settings in columns 1 and 2, times and values in 4 and 5."""
    lines = []
    for k, value in enumerate(values):
        setting = SETTINGS[k] if k < len(SETTINGS) else ","
        if quoted and setting != ",":
            setting = '"{}",{}'.format(*setting.split(","))
        setting = setting.format(channel=channel, unit=unit)
        lines.append(f"{setting},,{TIMES[k]:.12f},{value:9.5f},")
    return "\n".join(lines) + "\n"


def named(channel: str, unit: str, values: np.ndarray) -> str:
    """Return the file of a channel as other oscilloscopes write it: two columns with names."""
    head = f"Model,MSO24\nSample Interval,2e-4\n\nTIME,{channel} [{unit}]\n"
    return head + "".join(f"{t:.6e},{value}\n" for t, value in zip(TIMES, values, strict=True))


def plain(channel: str, unit: str, values: np.ndarray) -> str:
    """Return the numbers alone."""
    return "".join(f"{t:.6e},{value}\n" for t, value in zip(TIMES, values, strict=True))


@cases("form", [tektronix, named, plain])
def test_two_files_of_a_channel_each_are_a_record(
    form: Callable[[str, str, np.ndarray], str], tmp_path: Path, quell: Callable[..., Shown]
) -> None:
    """The first is u, the second y; with names, with the settings of a Tektronix TDS, and without both. `quell identify` takes them."""
    u, y = tmp_path / "CH1.CSV", tmp_path / "CH2.CSV"
    u.write_text(form("CH1", "V", OF_U))
    y.write_text(form("CH2", "A", OF_Y))
    record = read_record((u, y))
    np.testing.assert_array_equal(record.u, OF_U)
    np.testing.assert_array_equal(record.y, OF_Y)
    assert record.dt == pytest.approx(2e-4, rel=1e-6)
    units = ("", "") if form is plain else ("V", "A")
    assert (record.signals.u.unit, record.signals.y.unit) == units
    assert [one.y.size for one in measured_records([u, y])] == [COUNT]
    options = (
        "--order",
        "1",
        "--no-alternatives",
        "--no-figures",
        "--json",
        str(tmp_path / "m.json"),
    )
    shown = quell("identify", str(u), str(y), *options)
    assert "CH1.CSV, CH2.CSV: 400 samples, dt = 0.0002 s" in shown.out
    (pole,) = json.loads((tmp_path / "m.json").read_text())["poles"]
    assert pole["real"] == pytest.approx(np.log(0.9) / 2e-4, rel=0.01)
    alone = quell("identify", str(u))
    assert alone.code == 2
    assert re.search("is missing; there are times and one channel; give two .*, u first", alone.err)


def test_settings_in_quotation_marks_are_settings_too(tmp_path: Path) -> None:
    """As older oscilloscopes write them."""
    u, y = tmp_path / "CH1.CSV", tmp_path / "CH2.CSV"
    u.write_text(tektronix("CH1", "V", OF_U, quoted=True))
    y.write_text(tektronix("CH2", "mA", OF_Y, quoted=True))
    record = read_record([u, y])
    np.testing.assert_array_equal(record.u, OF_U)
    assert record.signals.y.unit == "mA"


def test_channels_of_different_acquisitions_are_refused(tmp_path: Path) -> None:
    """Other times, another number of samples, a file with more columns, options of a single table."""
    u, y = tmp_path / "CH1.CSV", tmp_path / "CH2.CSV"
    u.write_text(plain("", "", OF_U))
    text = plain("", "", OF_Y)
    for wrong, said in (
        (text[: text.rindex("\n", 0, -1) + 1], "has 399 samples, .* 400; give two channels of one"),
        (text.replace("7.180000e-02", "7.190000e-02"), "up to 0.0001 s from those of"),
        ("t,u,y\n" + "\n".join(timed(0.1)), "must have times and one other column .* has 3"),
    ):
        y.write_text(wrong)
        assert wrong != text
        with pytest.raises(ValueError, match=said):
            read_record((u, y))
    y.write_text(text)
    with pytest.raises(ValueError, match="have none; leave them out"):
        read_record((u, y), dt=0.1)
    with pytest.raises(ValueError, match="must be a file, or two, of u and of y"):
        read_record((u, y, y))
