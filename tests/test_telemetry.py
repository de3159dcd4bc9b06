"""From the loop's rows to files and viewers, and back to trajectories."""

from __future__ import annotations

import resource
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Event as ThreadEvent
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.realtime import CsvSink, McapSink
from quell.realtime.mcap_reader import whole_part
from quell.realtime.recordings import (
    EVENTS,
    LOOP_WIDTH,
    Y_MEASURED,
    Event,
    Header,
    K,
    MemorySink,
    file_sink,
    header_path,
    is_recording,
    load,
    row_channels,
    trajectory_of,
)
from quell.realtime.telemetry import Delivery, TelemetryWriter, push
from quell.types import Matrix
from tests.recordings import DT, controller, header_of, rows_of, simulated

from .cases import cases

NARROW = Header(row_channels((("status", 1),)), dt=DT)


@pytest.fixture(scope="module")
def run() -> ql.Trajectory:
    """A simulated run in place of a loop's."""
    return simulated()


@pytest.fixture(scope="module")
def rows(run: ql.Trajectory) -> Matrix:
    """Its rows."""
    return rows_of(run, controller())


@pytest.fixture(scope="module")
def header(run: ql.Trajectory) -> Header:
    """Its header."""
    return header_of(run, controller())


def recorded(header: Header, rows: Matrix, *sinks: Any) -> TelemetryWriter:
    """Send rows through a ring to sinks."""
    with TelemetryWriter(header, sinks) as telemetry:
        offer(telemetry, rows)
    assert telemetry.rows == len(rows)
    assert not telemetry.problems
    return telemetry


def offer(telemetry: TelemetryWriter, rows: Matrix) -> None:
    """Push rows; wait while the ring is full."""
    for row in rows:
        while not push(telemetry.ring, row):
            time.sleep(0.01)


def counted(count: int, width: int = LOOP_WIDTH + 1) -> Matrix:
    """Return rows of zeros with k."""
    rows = np.zeros((count, width))
    rows[:, K] = np.arange(count)
    return rows


@pytest.mark.parametrize("suffix", ["csv", "mcap"])
def test_a_run_comes_back_to_the_last_bit(
    run: ql.Trajectory, header: Header, rows: Matrix, suffix: str, tmp_path: Path
) -> None:
    """Simulate, record, load: channels, bits, features, sample time, metrics."""
    path = tmp_path / f"run.{suffix}"
    recorded(header, rows, file_sink(path))
    again = load(path)
    np.testing.assert_array_equal(again.log, rows)
    assert again.channels == header.channels
    assert (again.dt, again.features, again.plant) == (DT, run.features, "a lift")
    assert again.status == run.status
    assert again.metrics(1.0) == run.metrics(1.0)
    np.testing.assert_array_equal(again["theta"], run["theta"])
    again.plot()


@pytest.mark.parametrize("suffix", ["csv", "mcap"])
def test_numbers_at_the_ends_of_the_range_come_back(suffix: str, tmp_path: Path) -> None:
    """Extreme values, infinities, −0 and NaN, also in the first row (in CSV without exponents)."""
    rows = counted(8)
    rows[:, Y_MEASURED] = [
        5e-324,
        1.7976931348623157e308,
        -np.inf,
        np.inf,
        np.nan,
        -0.0,
        0.1 + 0.2,
        -1e-5,
    ]
    rows[:, Y_MEASURED + 1] = rows[::-1, Y_MEASURED]
    path = tmp_path / f"run.{suffix}"
    recorded(NARROW, rows, file_sink(path))
    assert load(path).log.tobytes() == rows.tobytes()


def test_a_trajectory_of_a_recording_is_saved_as_any_other(
    header: Header, rows: Matrix, tmp_path: Path
) -> None:
    """NetCDF has the loop's channels too, with their units."""
    run = trajectory_of(header, rows)
    run.save(tmp_path / "run.nc")
    np.testing.assert_array_equal(ql.Trajectory.load(tmp_path / "run.nc").log, run.log)
    assert run.to_xarray()["lateness"].attrs["units"] == "s"


def test_skipped_deadlines_are_filled_in() -> None:
    """Known channels stay, unmeasured ones are NaN, and an event marks the sample."""
    rows = counted(6)
    rows[:, 1:EVENTS] = rows[:, EVENTS + 1 :] = np.arange(6.0)[:, None]
    rows[:, EVENTS] = 3.0
    run = trajectory_of(NARROW, np.delete(rows, [2, 3], axis=0))
    np.testing.assert_array_equal(run["k"], np.arange(6.0))
    for name in ("r", "y", "u", "mode", "status"):
        np.testing.assert_array_equal(run[name], [0, 1, 1, 1, 4, 5])
    for name in ("y_measured", "lateness", "step_time"):
        np.testing.assert_array_equal(run[name], [0, 1, np.nan, np.nan, 4, 5])
    np.testing.assert_array_equal(run["events"], [3, 3, Event.GAP, Event.GAP, 3, 3])
    assert run.ended == pytest.approx(5 * DT)


def test_a_csv_file_is_a_line_of_names_and_lines_of_numbers(
    header: Header, rows: Matrix, tmp_path: Path
) -> None:
    """Time comes first; the first line has no exponents, which some readers take for text."""
    recorded(header, rows, CsvSink(tmp_path / "run.csv"))
    names, first, *_ = (tmp_path / "run.csv").read_text().splitlines()
    assert names.startswith(
        "time,k,lateness,step_time,mode,events,r,y,y_measured,u,x_hat[0],x_hat[1],f_residual,"
    )
    assert "e" not in first
    table = np.loadtxt(tmp_path / "run.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:, 0], np.arange(len(rows)) * DT)


@cases("dt", [1e-3, 1.0 / 3.0, 0.1, 1.0 / 44100.0, 2.2675736961451248e-05 * (1 + 2**-52)])
def test_a_csv_file_without_its_header_still_knows_its_sample_time(
    dt: float, tmp_path: Path
) -> None:
    """To the last bit, from the column of times."""
    rows = counted(1000)
    recorded(Header(NARROW.channels, dt=dt), rows, CsvSink(tmp_path / "run.csv"))
    (tmp_path / "run.csv.json").unlink()
    run = load(tmp_path / "run.csv")
    np.testing.assert_array_equal(run.log, rows)
    np.testing.assert_array_equal(run["k"] * run.dt, rows[:, K] * dt)
    assert run.dt == pytest.approx(dt, rel=1e-15)


@cases(
    ("change", "rule"),
    [
        (
            lambda time: 10.0 * time,
            "column time goes on by 0.1 s, by dt = 0.01 s in run.csv.json it is 0.01 s",
        ),
        (
            lambda time: 0.1 * time,
            "column time goes on by 0.002 s, by dt = 0.01 s in run.csv.json it is 0.02 s",
        ),
        (lambda time: np.nan if time else 0.0, "k = 0 to k = 1 the column time goes on by nan s"),
        (lambda time: 1.01 * time, "k = 0 to k = 112 the column time goes on by 1.1312 s"),
    ],
)
def test_times_that_contradict_the_header_are_refused(
    change: Callable[[float], float], rule: str, tmp_path: Path
) -> None:
    """Nobody can tell which of both is right; both are named."""
    path = tmp_path / "run.csv"
    recorded(NARROW, counted(200), CsvSink(path))
    with_times(path, lambda time: repr(change(time)))
    with pytest.raises(ValueError, match="its times contradict each other: .*" + rule):
        load(path)


def test_rounded_times_and_those_of_a_part_agree_with_the_header(tmp_path: Path) -> None:
    """A spreadsheet writes six digits; k counts on from the first row of a part."""
    path, rows = tmp_path / "run.csv", counted(200)
    recorded(NARROW, rows, CsvSink(path))
    with_times(path, lambda time: f"{time + 1000.0:.6g}")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], *lines[50:]]) + "\n")
    np.testing.assert_array_equal(load(path).log, rows[49:])


def test_times_of_a_table_alone_that_jump_are_refused(tmp_path: Path) -> None:
    """Its dt is that of the last row; it has no other."""
    path = tmp_path / "run.csv"
    recorded(NARROW, counted(200), CsvSink(path))
    header_path(path).unlink()
    with_times(path, lambda time: repr(time if time < 1.0 else time + 1.0))
    with pytest.raises(ValueError, match="by dt = 0.01502.* s of its last row it is 0.04"):
        load(path)


def with_times(path: Path, change: Callable[[float], str]) -> None:
    """Change the first column of a CSV file."""
    first, *lines = path.read_text().splitlines()
    cells = [line.partition(",") for line in lines]
    changed = [f"{change(float(time))},{rest}" for time, _, rest in cells]
    path.write_text("\n".join([first, *changed]) + "\n")


@cases(
    ("change", "expected"),
    [
        (lambda text: text, True),
        (lambda text: text.replace(b"\n", b"\r\n"), True),
        (lambda text: b"\xef\xbb\xbf" + text, True),
        (lambda text: text.replace(b"time,k,lateness", b"time,k,late"), False),
        (lambda text: b"t,u,y\n0,1,2\n", False),
        (lambda text: bytes(100), False),
        (lambda text: b"", False),
    ],
)
def test_a_table_is_a_recording_by_its_first_line(
    change: Callable[[bytes], bytes], expected: bool, tmp_path: Path
) -> None:
    """Also with the ends of lines and the mark of another system; no header is beside it."""
    path, rows = tmp_path / "run.txt", counted(200)
    recorded(NARROW, rows, CsvSink(tmp_path / "run.csv"))
    path.write_bytes(change((tmp_path / "run.csv").read_bytes()))
    assert is_recording(path) is expected
    if expected:
        np.testing.assert_array_equal(load(path).log, rows)
    assert is_recording(tmp_path / "run.csv")
    assert not is_recording(tmp_path)
    assert not is_recording(tmp_path / "nothing.csv")


def test_a_csv_file_without_its_header_is_of_one_axis_if_no_axis_has_an_estimate(
    run: ql.Trajectory, rows: Matrix, tmp_path: Path
) -> None:
    """A dot in the name of a channel makes no axes."""
    before, path = header_of(run, controller()), tmp_path / "run.csv"
    channels = (*before.channels, ("motor.temp", 1))
    more = np.column_stack([rows, np.arange(rows.shape[0])])
    recorded(replace(before, channels=channels), more, CsvSink(path))
    header_path(path).unlink()
    again = load(path)
    assert isinstance(again, ql.Trajectory)
    np.testing.assert_array_equal(again["motor.temp"], more[:, -1])
    np.testing.assert_array_equal(again["y"], run["y"])


def test_a_message_is_what_its_definition_says(
    header: Header, rows: Matrix, tmp_path: Path
) -> None:
    """A message is read field by field with nothing but the definition in the file."""
    from mcap.reader import make_reader

    recorded(header, rows, McapSink(tmp_path / "run.mcap"))
    with (tmp_path / "run.mcap").open("rb") as file:
        found = list(make_reader(file).iter_messages(topics=["/loop"]))
    assert len(found) == len(rows)
    schema, channel, message = found[17]
    assert (schema.name, schema.encoding, channel.message_encoding) == (
        "quell/msg/Cycle",
        "ros2msg",
        "cdr",
    )
    assert message.log_time == header.started + round(17 * DT * 1e9)
    fields, at = {}, 4
    for line in schema.data.decode().splitlines():
        kind, name = line.split("#")[0].split()
        count = int(kind.removeprefix("float64").strip("[]") or 1)
        fields[name] = struct.unpack_from(f"<{count}d", message.data, at)
        at += 8 * count
    assert at == len(message.data)
    assert fields["x_hat"] == tuple(rows[17, LOOP_WIDTH : LOOP_WIDTH + 2])
    assert fields["y"] == (rows[17, 6],)
    assert b"float64 y  # output [m]" in schema.data


@pytest.mark.parametrize("suffix", ["csv", "mcap"])
def test_a_file_cut_short_anywhere_is_readable_up_to_there(
    suffix: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    """The first rows are read, or a one-line message says that there is none."""
    sink, rows = file_sink(tmp_path / f"run.{suffix}"), counted(400)
    sink.open(NARROW)
    for first in range(0, 400, 40):
        sink.write(rows[first : first + 40])
        sink._flushed = -np.inf  # type: ignore[attr-defined]  # as if half a second had passed
        sink.flush()
    sink.close()
    whole = (tmp_path / f"run.{suffix}").read_bytes()
    cut = tmp_path / f"cut.{suffix}"
    (tmp_path / "cut.csv.json").write_text(NARROW.to_json())
    lengths = []
    for size in sorted(rng.integers(0, len(whole), 60)):
        cut.write_bytes(whole[:size])
        lengths.append(whole_rows(cut, rows))
    assert lengths == sorted(lengths)
    assert lengths[-1] > 350


def whole_rows(path: Path, rows: Matrix) -> int:
    """Return how many of the rows are in a file; check the message if there are none."""
    try:
        run = load(path)
    except ValueError as error:
        message = str(error)
    else:
        np.testing.assert_array_equal(run.log, rows[: len(run)])
        return len(run)
    assert "\n" not in message
    return 0


KILLED = """
import sys, time, os, signal
import numpy as np
from quell.realtime.recordings import Header
from quell.realtime.recordings import row_channels
from quell.realtime.telemetry import push
from quell.realtime.recordings import file_sink
from quell.realtime.telemetry import TelemetryWriter

def begin(dt, count):
    sinks = [file_sink(f"{sys.argv[1]}/{count}.{suffix}") for suffix in ("csv", "mcap")]
    telemetry = TelemetryWriter(Header(row_channels((("status", 1),)), dt=dt), sinks)
    telemetry.start()
    go_on(telemetry, 0, count)
    return telemetry


def go_on(telemetry, first, last):
    row = np.zeros(telemetry.header.width)
    for k in range(first, last):
        row[0] = k
        push(telemetry.ring, row)


quick, slow = begin(1e-3, 2000), begin(0.1, 3)
time.sleep(1.0)
go_on(quick, 2000, 2003), go_on(slow, 3, 4)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.trial
def test_what_is_a_second_old_survives_the_end_of_the_process(tmp_path: Path) -> None:
    """At 1 kHz and 10 Hz: no buffer waits until it is full."""
    ended = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], timeout=120)
    assert ended.returncode == -9
    for count in (2000, 3):
        for suffix in ("csv", "mcap"):
            run = load(tmp_path / f"{count}.{suffix}")
            assert len(run) >= count
            np.testing.assert_array_equal(run["k"], np.arange(float(len(run))))


class Broken(MemorySink):
    """A sink that fails at its third write, and again when it is closed."""

    name = "broken"
    pieces = 0

    def write(self, rows: Matrix) -> None:
        """Fail late."""
        self.pieces += 1
        if self.pieces == 3:
            raise OSError(28, "No space left on device")
        super().write(rows)

    def close(self) -> None:
        """Fail again."""
        raise OSError(28, "No space left on device")


def test_a_sink_that_fails_is_closed_and_reported_and_the_others_go_on(
    header: Header, rows: Matrix
) -> None:
    """One line names the sink and the reason."""
    broken, kept = Broken(), MemorySink()
    with TelemetryWriter(header, [broken, kept]) as telemetry:
        offer(telemetry, rows)
    assert broken.pieces == 3
    assert len(telemetry.problems) == 1
    assert telemetry.problems[0].startswith("broken: No space left on device; closed after ")
    np.testing.assert_array_equal(kept.trajectory().log, rows)


@pytest.mark.parametrize("suffix", ["csv", "mcap"])
def test_a_full_disk_ends_a_recording_and_nothing_else(
    header: Header, rows: Matrix, suffix: str, tmp_path: Path
) -> None:
    """A limit on the file size acts as a full disk; what was written before can be read."""
    sink, kept = file_sink(tmp_path / f"run.{suffix}"), MemorySink()
    telemetry = TelemetryWriter(header, [sink, kept])
    telemetry.start()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (110_000, before[1]))
    try:
        offer(telemetry, np.concatenate([rows, rows]))
        telemetry.stop()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(telemetry.problems) == 1
    assert telemetry.problems[0].startswith(f"{tmp_path / f'run.{suffix}'}: ")
    assert sum(map(len, kept._rows)) == 2 * len(rows)
    read = load(tmp_path / f"run.{suffix}").log
    assert 300 < len(read) < len(rows)
    np.testing.assert_array_equal(read, rows[: len(read)])
    assert telemetry.problems[0].endswith(f"File too large; closed after {len(read)} rows")
    assert telemetry.lost - telemetry.dropped == 2 * len(rows) - len(read)
    whole = (tmp_path / f"run.{suffix}").read_bytes()
    if suffix == "csv":
        assert whole.endswith(b"\n")  # no half line
        assert whole.count(b"\n") == 1 + len(read)
    else:
        assert whole_part(tmp_path / "run.mcap") == (len(whole), len(read))


@pytest.mark.parametrize("suffix", ["csv", "mcap"])
def test_no_recording_begins_on_a_full_disk(header: Header, suffix: str, tmp_path: Path) -> None:
    """The start fails, so no machine moves without its record; other sinks are closed."""
    telemetry = TelemetryWriter(header, [MemorySink(), file_sink(tmp_path / f"run.{suffix}")])
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40, before[1]))
    try:
        with pytest.raises(ValueError, match=r"can't be written \(File too large"):
            telemetry.start()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [*tmp_path.iterdir()] == []
    again = TelemetryWriter(header, [file_sink(tmp_path / f"run.{suffix}", overwrite=True)])
    again.start()
    again.stop()
    assert again.problems == []


class Stuck(MemorySink):
    """A sink that blocks until it is freed."""

    name = "stuck"

    def __init__(self) -> None:
        super().__init__()
        self.freed = ThreadEvent()

    def write(self, rows: Matrix) -> None:
        """Wait."""
        self.freed.wait(60.0)
        super().write(rows)


def test_a_disk_that_hangs_for_long_costs_its_own_rows_and_no_memory() -> None:
    """What finds no room is counted once; the recording has a gap in its place."""
    stuck, problems = Stuck(), list[str]()
    stuck.open(NARROW)
    delivery = Delivery(stuck, 1000, False, problems.append)
    offered = counted(3001)
    for first in range(0, 3000, 50):
        delivery.put(offered[first : first + 50])
    stuck.freed.set()
    while delivery.rows < 1000:
        time.sleep(0.01)
    delivery.put(offered[3000:])
    delivery.end()
    delivery.join(time.monotonic() + 60.0, 60.0)
    assert problems == ["stuck: 2000 rows are missing: it was too slow"]
    run = stuck.trajectory()
    np.testing.assert_array_equal(run["k"], np.arange(3001.0))
    assert np.sum(run["events"] == Event.GAP) == 2000
    assert run["events"][-1] == 0


def test_a_sink_that_does_not_end_is_given_up_and_the_others_are_complete(tmp_path: Path) -> None:
    """The process is not blocked; the result says where rows may be missing."""
    stuck, file = Stuck(), McapSink(tmp_path / "run.mcap")
    telemetry = TelemetryWriter(NARROW, [stuck, file])
    telemetry.start()
    offer(telemetry, counted(300))
    telemetry.stop(timeout=0.5)
    assert telemetry.problems == [
        "stuck: writing did not end within 0.5 s; the last rows may be missing"
    ]
    assert (tmp_path / "run.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")
    assert len(load(tmp_path / "run.mcap")) == 300
    stuck.freed.set()


@cases(
    ("make", "rule"),
    [
        (lambda folder: CsvSink(folder / "no" / "run.csv"), "folder .* must exist"),
        (lambda folder: McapSink(folder / "no" / "run.mcap"), "folder .* must exist"),
        (lambda folder: CsvSink(folder / "old.csv"), "the file exists; choose another name"),
        (lambda folder: McapSink(folder / "old.mcap"), "the file exists; choose another name"),
        (lambda folder: CsvSink(folder / "new.csv"), "new.csv.json': the file exists"),
        (lambda folder: McapSink(folder), "must be a file"),
    ],
)
def test_what_can_not_be_written_is_refused_before_the_loop_starts(
    make: Any, rule: str, tmp_path: Path
) -> None:
    """One line says why; sinks that were open already are closed."""
    for suffix in ("csv", "mcap"):
        (tmp_path / f"old.{suffix}").write_text("precious")
    (tmp_path / "new.csv.json").write_text("precious")
    first = CsvSink(tmp_path / "first.csv")
    telemetry = TelemetryWriter(NARROW, [first, make(tmp_path)])
    with pytest.raises(ValueError, match=rule) as refused:
        telemetry.start()
    assert "\n" not in str(refused.value)
    assert first._file is None
    for name in ("old.csv", "old.mcap", "new.csv.json"):
        assert (tmp_path / name).read_text() == "precious"


def test_a_recording_is_replaced_where_asked_for_and_never_what_a_link_points_to(
    tmp_path: Path,
) -> None:
    """The link itself becomes the file."""
    (tmp_path / "precious").write_text("precious")
    for suffix in ("csv", "mcap"):
        path = tmp_path / f"run.{suffix}"
        path.symlink_to("precious")
        for count in (300, 200):
            recorded(NARROW, counted(count), file_sink(path, overwrite=True))
            assert len(load(path)) == count
    assert (tmp_path / "precious").read_text() == "precious"


def test_other_suffixes_and_long_periods_are_refused() -> None:
    """The message says what to do."""
    with pytest.raises(ValueError, match=r"path = 'run.txt': must end in .csv or .mcap"):
        file_sink("run.txt")
    with pytest.raises(ValueError, match="period = 2 s: must be at most 0.25 s"):
        TelemetryWriter(NARROW, period=2)
    with pytest.raises(ValueError, match="channels = .* must begin with k, lateness"):
        Header((("y", 1),), dt=0.1)


@pytest.mark.parametrize("module", ["foxglove", "mcap"])
def test_a_missing_package_is_named_with_the_extra_that_brings_it(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line, before the loop starts."""
    recorded(NARROW, counted(3), McapSink(tmp_path / "run.mcap"))
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"pip install 'quell-control\[telemetry\]'"):
        load(tmp_path / "run.mcap") if module == "mcap" else McapSink(tmp_path / "other.mcap").open(
            NARROW
        )


def test_files_that_are_no_recordings_are_refused_in_one_line(
    run: ql.Trajectory, tmp_path: Path
) -> None:
    """Text, other tables, NetCDF, an empty file, a folder, no file, foreign MCAP, broken rows."""
    import foxglove

    (tmp_path / "empty.csv").touch()
    (tmp_path / "text.csv").write_text("time flies\nlike an arrow\n")
    (tmp_path / "table.csv").write_text("time,a,b\n0,1,2\n")
    (tmp_path / "names.csv").write_text("time," + ",".join(NARROW.columns) + "\n")
    line = ",".join(["0.0"] * (NARROW.width + 1))
    (tmp_path / "short.csv").write_text(
        (tmp_path / "names.csv").read_text() + f"{line}\n0,1\n{line}\n"
    )
    (tmp_path / "twice.csv").write_text(
        (tmp_path / "names.csv").read_text() + f"0.01,1.0{line[7:]}\n" * 2
    )
    (tmp_path / "noise.mcap").write_bytes(b"\x89MCAP0\r\n" + np.random.default_rng(1).bytes(5000))
    run.save(tmp_path / "run.nc")
    context = foxglove.Context()
    with foxglove.open_mcap(tmp_path / "others.mcap", context=context):
        foxglove.Channel("/loop", message_encoding="json", context=context).log({"y": 1.0})
    paths = [*sorted(tmp_path.iterdir()), tmp_path, tmp_path / "nothing.csv"]
    for path in paths:
        with pytest.raises(ValueError, match="path = ") as refused:
            load(path)
        assert "\n" not in str(refused.value), path
        assert path.name in str(refused.value)


@cases("permitted", [True, False])
@cases("urgent", [True, False])
def test_the_writer_has_the_priority_that_it_should(
    urgent: bool, permitted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lowest real-time priority for an interpreted loop if permitted, else an ordinary one."""
    from quell.realtime import system as module

    now = [module.os.SCHED_RR]

    def ask(thread: int, policy: int, parameters: Any) -> None:
        if policy != module.os.SCHED_OTHER:
            if not permitted:
                raise PermissionError(1, "Operation not permitted")
            assert parameters.sched_priority == 1
        now[0] = policy

    monkeypatch.setattr(module.os, "sched_getscheduler", lambda thread: now[0])
    monkeypatch.setattr(module.os, "sched_setscheduler", ask)
    with TelemetryWriter(NARROW, [MemorySink()], urgent=urgent) as writer:
        offer(writer, counted(3))
    assert now[0] == (module.os.SCHED_FIFO if urgent and permitted else module.os.SCHED_OTHER)


def test_a_table_of_times_alone_is_no_recording(tmp_path: Path) -> None:
    """It is refused in one line, as any other table is."""
    (tmp_path / "run.csv").write_text("time\n0.0\n1.0\n")
    with pytest.raises(
        ValueError,
        match="must be a recording by quell, CSV or MCAP: its first line is not the names",
    ):
        load(tmp_path / "run.csv")
