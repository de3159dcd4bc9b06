"""Records of input and output from CSV files: ends of lines, units of times."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from quell.cli.app import main
from quell.identification import Measured, read_record

from .cases import cases


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
