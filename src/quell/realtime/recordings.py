"""Recordings: sinks, headers, CSV and MCAP files, and their way back to trajectories.

Sinks, which take the rows of a loop: their protocol, memory, and files by their suffix.

Recordings as CSV: a line of names, then a line for each row; the header is in ``<name>.json``.

The first column is ``time`` [s]; the others are those of the row, ``x_hat[0]`` the first entry of a
vector channel. Numbers have the digits that it takes to read the same bits back; NaN is ``nan``.

Recordings as MCAP: a message for each row, and the header as metadata.

The topic is ``/loop``, the metadata record ``quell``. The file is written by foxglove-sdk, in
chunks. A finished chunk is on disk; here chunks are finished twice a second. They are not
compressed: the values of a loop are mostly noise, of which compression saves about a tenth
for milliseconds of work. The log time of a message is its deadline.

Rows as ROS 2 messages, which PlotJuggler and Foxglove read without configuration.

The definition (``ros2msg``) has a line for each channel. The message in plain CDR, little endian
(OMG DDSI-RTPS 2.5, section 10.2), is a mark of four bytes and then the values: all have 64 bits, so
nothing is padded, and arrays of fixed length have no count.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from enum import IntFlag
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from quell import checks, files
from quell.checks import import_extra
from quell.quantities import OF_AXES, AxesSignals, signals_from
from quell.realtime.mcap_reader import MAGIC, MARK, RECORD, SCHEMA, TOPIC, read_mcap, whole_part
from quell.records import record
from quell.records.trajectory import Trajectory
from quell.types import Channels, Matrix, Status, Vector

# ---- Channels of a row, which the loop writes each cycle, and its event flags ----

LOOP_CHANNELS = (
    ("k", 1),  # index of the deadline, its time is k dt; it jumps where deadlines were skipped
    ("lateness", 1),  # time from the deadline until the loop woke [s]
    ("step_time", 1),  # time from then until u was written [s]
    ("mode", 1),  # state of the supervisor
    ("events", 1),  # Event flags of this cycle
    ("r", 1),
    ("y", 1),  # last good measurement
    ("y_measured", 1),  # as received; NaN if nothing was
    ("u", 1),  # applied from this cycle to the next
)
"""Names and widths of the first channels of every row; ``controller.channels`` follow. Of several
axes r, y and y_measured have a number for each axis, u one for each actuator."""

K, LATENESS, STEP_TIME, MODE, EVENTS, R, Y, Y_MEASURED, U = range(len(LOOP_CHANNELS))
LOOP_WIDTH = len(LOOP_CHANNELS)


class Event(IntFlag):
    """Events of a cycle; flags add up. The low sixteen bits are the loop's."""

    MISSED = 1  #: no finite measurement came in time
    OVERRUN = 2  #: the loop woke, or ended its cycle, after the next deadline and skipped it
    CLIPPED = 4  #: the supervisor's limits changed the controller's u
    UNSENT = 8  #: the command could not be sent
    CHANGED = 16  #: the mode changed
    CHANNEL = 32  #: a channel that the controller uses was missing, and its last value was held
    GAP = 1 << 16  #: no recorded cycle: deadline skipped, or row lost; ``load`` filled it in


def loop_channels(outputs: int, inputs: int) -> Channels:
    """Return the first channels of a row of a loop with so many signals."""
    widths = {"r": outputs, "y": outputs, "y_measured": outputs, "u": inputs}
    return tuple((name, widths.get(name, 1)) for name, _ in LOOP_CHANNELS)


def row_channels(
    controller_channels: Channels,
    device_channels: Sequence[str] = (),
    outputs: int = 1,
    inputs: int = 1,
) -> Channels:
    """Return the channels of a row for a controller and a device with these channels."""
    own = tuple((name, 1) for name in device_channels)
    return (*loop_channels(outputs, inputs), *controller_channels, *own)


# ---- Header of a recording ----

# Numbers in a row, far above those of any controller: chosen by hand.
_MOST_COLUMNS = 10_000
VERSION = 1  # version of the recording's layout; a reader refuses others


@dataclass(frozen=True)
class Header:
    """Description of a recording.

    Parameters
    ----------
    channels : tuple of pairs
        names and widths in a row, in order; the first ones are those of ``loop_channels``.
    dt
        sample time [s]: row k belongs to the time ``k dt``.
    features
        factors of the entries of ``theta``.
    device, controller
        names of the device and the controller.
    units
        of ``y`` and ``u``, such as ``{"y": "rad", "u": "A"}``; by default ``y-unit``, ``u-unit``.
    notes
        anything else that JSON can represent.
    started
        deadline of the row with k = 0, in nanoseconds since 1970, UTC.
    """

    channels: Channels
    dt: float
    features: tuple[str, ...] = ()
    device: str = ""
    controller: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)
    started: int = field(default_factory=time.time_ns)

    def __post_init__(self) -> None:
        checks.positive("dt", self.dt, "s")
        if any(width < 0 for _, width in self.channels) or self.width > _MOST_COLUMNS:
            raise ValueError(
                f"channels: a row of {self.width} numbers; must be at most {_MOST_COLUMNS}"
            )
        widths = dict(self.channels)
        outputs, inputs = (max(widths.get(name, 1), 1) for name in ("y", "u"))
        if tuple(self.channels[: len(LOOP_CHANNELS)]) != loop_channels(outputs, inputs):
            first = ", ".join(name for name, _ in LOOP_CHANNELS)
            raise ValueError(f"channels = {self.channels!r}: must begin with {first}")
        if self.axis_names and len(self.axis_names) != outputs:
            raise ValueError(f"axes = {self.axis_names!r}: must be {outputs}, as many as y has")

    @property
    def signals(self) -> Any:
        """Names and units of y and u, which ``notes`` may have."""
        return signals_from(self.notes.get("signals"))

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names of several axes, which ``notes`` have as ``axes``; none for one y and one u."""
        axes = self.notes.get("axes")
        return tuple(axes) if isinstance(axes, Mapping) else ()

    @property
    def axis_features(self) -> tuple[tuple[str, ...], ...]:
        """Names of the features of each axis."""
        axes = self.notes.get("axes", {})
        return tuple(tuple(map(str, axes[name])) for name in self.axis_names)

    @property
    def width(self) -> int:
        """Number of values in a row."""
        return sum(width for _, width in self.channels)

    @property
    def columns(self) -> tuple[str, ...]:
        """Name of each value in a row; ``x_hat[0]`` is the first entry of a vector channel."""
        names: list[str] = []
        for name, width in self.channels:
            own, labels = in_column(name), self.labels(name, width)
            vector = record.is_vector(name, width)
            names += [f"{own}[{each}]" for each in labels] if vector else [own] * width
        return tuple(names)

    def labels(self, name: str, width: int) -> list[str]:
        """Return what the entries of a channel are called: axes by name, others by number."""
        if not self.axis_names:
            return [str(i) for i in range(width)]
        of_axes = AxesSignals(self.axis_names, (), ())
        known = self.signals if isinstance(self.signals, AxesSignals) else of_axes
        return [in_column(each) for each in known.labels(name, width)]

    def to_json(self) -> str:
        """Return the header as JSON."""
        return json.dumps({"quell_recording": VERSION, **asdict(self)}, ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str) -> Header:
        """Return the header that ``to_json`` wrote."""
        try:
            fields = json.loads(text)
            version = fields.pop("quell_recording")
            fields["channels"] = tuple(_channel(*entry) for entry in fields["channels"])
            fields["features"] = tuple(map(str, fields["features"]))
            fields["device"] = str(fields["device"])
            if version != VERSION:
                raise ValueError(f"its layout has version {version!r}, this quell reads {VERSION}")
            if not isinstance(fields.get("notes", {}), dict):
                raise TypeError("notes")
            axes = fields.get("notes", {}).get("axes", {})
            if not isinstance(axes, dict) or not all(isinstance(v, list) for v in axes.values()):
                raise TypeError("axes")
            return cls(**fields)
        except RecursionError:
            raise ValueError("its header is nested too deeply") from None
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"its header is not that of a quell recording ({error!r})") from None


def in_column(name: str) -> str:
    """Return a name as it stands in the first line of a CSV file, where some signs separate."""
    return name.translate(_NOT_IN_COLUMNS)


_NOT_IN_COLUMNS = str.maketrans(dict.fromkeys(',"[]\r\n', "_"))


def _channel(name: Any, width: Any) -> tuple[str, int]:
    return str(name), checks.whole("width", width, 0)


# ---- Recordings as CSV ----

# Numbers that are converted to an array at once when reading; chosen by hand, not tuned further.
_BLOCK = 100_000


class CsvSink:
    """Write rows to a CSV file ``path``, which grows as they come, and a header beside it.

    Files that exist are refused, or replaced if ``overwrite`` is True.
    """

    def __init__(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        self.path, self.overwrite = Path(path), overwrite
        self.name = str(self.path)
        self.stored = 0  #: rows that are in the file; after a failure it ends with the last one
        self._file: files.GrowingFile | None = None
        self._dt = 0.0
        self._first = True

    def check(self) -> None:
        """Raise a ``ValueError`` if a file can't be written or may not be replaced."""
        for path in (self.path, header_path(self.path)):
            files.check_writable(path, self.overwrite)

    def open(self, header: Header) -> None:
        """Write the line of names, and the header beside the file."""
        self.check()
        self.path.unlink(missing_ok=True)
        with files.written_atomically(header_path(self.path), self.overwrite) as part:
            part.write_text(header.to_json() + "\n", encoding="utf-8")
        self._dt, self._first, self.stored = header.dt, True, 0
        self._file = files.GrowingFile(self.path)
        try:
            self._file.add(",".join(("time", *header.columns)) + "\n")
        except OSError:
            self.close()
            self.path.unlink(missing_ok=True)
            header_path(self.path).unlink(missing_ok=True)
            raise

    def write(self, rows: Matrix) -> None:
        """Add a line for each row."""
        assert self._file is not None
        lines = []
        for row in rows.tolist():
            numbers = [row[K] * self._dt, *row]
            # Some readers (PlotJuggler 3.15) take the type of a column from the first line, and
            # 1e-05 for text.
            text = partial(np.format_float_positional, trim="0") if self._first else repr
            lines.append(",".join(map(text, numbers)))
            self._first = False
        try:
            self._file.add("\n".join(lines) + "\n")
        finally:
            self.stored = self._file.lines - 1

    def flush(self) -> None:
        """Do nothing: the file has no buffer."""

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            file, self._file = self._file, None
            file.close()


def header_path(path: Path) -> Path:
    """Return the path of the header of a CSV file."""
    return path.with_name(path.name + ".json")


def is_recording(path: Path) -> bool:
    """Return whether a file is a recording: MCAP, or CSV by its first line or the header beside it.

    A table that begins with the columns of a loop is one, as a copy without its header is.
    """
    if path.suffix.lower() == ".mcap" or header_path(path).is_file():
        return True
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                return True
        names = _names_in(next(files.byte_lines(path), b""))
    except (OSError, ValueError):  # whatever reads the file tells why it can't be read
        return False
    return names[: R + 1] == ["time", *(name for name, _ in LOOP_CHANNELS[:R])]


def _names_in(line: bytes) -> list[str]:
    """Return the names of columns in a first line, also behind the mark that Excel puts there."""
    return line.decode("utf-8-sig", errors="replace").strip().split(",")


def read_csv(path: Path, most: int) -> tuple[Header, Matrix]:
    """Return header and rows of a ``CsvSink``'s file, without a last line that was cut short.

    Without the header beside it, dt comes from the column ``time``; ``features`` are unknown. The
    rows may take ``most`` bytes. Times that contradict the header are refused.
    """
    lines = files.byte_lines(path)
    names = _names_in(next(lines, b""))
    if names[:2] != ["time", "k"]:
        raise ValueError("its first line is not the names of a recording's columns: time, k, …")
    beside = header_path(path)
    header = Header.from_json(files.whole_text(beside)) if beside.is_file() else None
    channels = _channels(names[1:]) if header is None else header.channels
    table = _table(lines, len(names), most)
    time, rows = table[:, 0], np.ascontiguousarray(table[:, 1:])
    if header is None:
        dt = _sample_time(time, rows[:, K])
        header = Header(channels, dt, notes=_axes_in(names[1:], channels), started=0)
    if header.columns != tuple(names[1:]):
        others = f"those in {beside.name}" if beside.is_file() else "those of a recording"
        raise ValueError(f"its columns differ from {others}")
    place = f"in {beside.name}" if beside.is_file() else "of its last row"
    record.check_steps(time, rows[:, K], header.dt, f"dt = {header.dt:g} s {place}")
    return header, rows


def _table(lines: Iterator[bytes], width: int, most: int) -> Matrix:
    """Return lines of ``width`` numbers as a matrix of at most ``most`` bytes."""
    filled = ((number, line) for number, line in enumerate(lines, 2) if line.strip())
    blocks, size = [np.empty((0, width))], 0
    while block := list(islice(filled, max(1, _BLOCK // width))):
        size += 8 * width * len(block)
        files.check_size(size, most)
        rows = _numbers([line for _, line in block])
        if rows is None or rows.shape[1] != width:
            numbers = (number for number, line in block if not _is_row(line, width))
            raise ValueError(f"line {next(numbers)} is not {width} numbers")
        blocks.append(rows)
    return np.concatenate(blocks)


def _numbers(lines: list[bytes]) -> Matrix | None:
    """Return lines as a matrix; None if they are not equally many numbers each."""
    try:
        return np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
    except ValueError:
        return None


def _is_row(line: bytes, width: int) -> bool:
    row = _numbers([line])
    return row is not None and row.shape[1] == width


def _channels(columns: list[str]) -> Channels:
    """Return the channels with these columns."""
    widths: dict[str, int] = {}
    for column in columns:
        name = column.partition("[")[0]
        widths[name] = widths.get(name, 0) + 1
    return tuple(widths.items())


def _axes_in(columns: list[str], channels: Channels) -> dict[str, Any]:
    """Return the names of several axes and actuators in columns, as ``Header.notes`` has them.

    Features and units are unknown. Each axis has its estimate; another channel may have a dot, too.
    """
    estimated = [name.removesuffix(".x_hat") for name, _ in channels if name.endswith(".x_hat")]
    if not estimated:
        return {}
    labels, actuators = (
        [each[2:].rstrip("]") for each in columns if each.startswith(begin)]
        for begin in ("y[", "u[")
    )
    notes: dict[str, Any] = {"axes": {name: [] for name in labels or estimated}}
    if not all(map(str.isdigit, actuators)):
        names = [*notes["axes"]]
        notes["signals"] = {"axes": names, "y": [""] * len(names), "u": actuators}
    return notes


def _sample_time(time: Vector, k: Vector) -> float:
    """Return the dt with the fewest digits for which all rows have exactly ``time = k dt``."""
    later = np.flatnonzero(k > 0)
    if later.size == 0:
        raise ValueError(
            "its sample time is unknown: it has no row after the first and no header beside it"
        )
    last = later[-1]
    about = float(time[last] / k[last])
    rounded = [float(f"{about:.{digits}g}") for digits in (3, 6, 9, 12, 15)]
    with np.errstate(all="ignore"):  # a damaged file may hold any numbers
        candidates = [*rounded, about, *np.nextafter(about, [0.0, 2.0 * about]).tolist()]
        return next((dt for dt in candidates if np.array_equal(k * dt, time)), about)


# ---- Rows as ROS 2 messages, which PlotJuggler and Foxglove read without configuration ----


def definition(header: Header) -> str:
    """Return the definition of a row's message, with meanings and units as comments."""
    lines, taken = list[str](), set[str]()

    def field_of(name: str) -> str:
        """Return a field that no other channel has: of axes ``A`` and ``a`` the second has a 2."""
        plain, number = _field_name(name), 2
        found = plain
        while found in taken:
            found, number = f"{plain}_{number}", number + 1
        taken.add(found)
        return found

    for name, width in header.channels:
        if not width:
            continue
        text, unit = record.describe(name, header.signals)
        units = record.units_of(name, width, header.signals)
        unit = header.units.get(name, unit)
        if header.axis_names and width > 1 and name in (*OF_AXES, "u"):
            # A field for each signal, with its name: the same bytes as an array.
            for label, of_it in zip(header.labels(name, width), units, strict=True):
                own = field_of(f"{name}_{label}")
                lines.append(f"float64 {own}  # {text}, {label} [{of_it}]")
        else:
            kind = f"float64[{width}]" if record.is_vector(name, width) else "float64"
            lines.append(f"{kind} {field_of(name)}  # {text} [{unit}]")
    return "\n".join(lines) + "\n"


def _field_name(name: str) -> str:
    """Return a name as a field of a ROS message may have it."""
    return re.sub(r"\W|_+(?=_)", "_", name, flags=re.ASCII).strip("_").lower() or "signal"


def advertised(header: Header) -> dict[str, Any]:
    """Return the channel for rows as a Foxglove server advertises it."""
    names = {"id": 1, "topic": TOPIC, "encoding": "cdr", "schemaName": SCHEMA}
    return {**names, "schemaEncoding": "ros2msg", "schema": definition(header)}


def message(row: Vector) -> bytes:
    """Return a row as a message."""
    return MARK + row.astype("<f8", copy=False).tobytes()


def row_time(header: Header, k: float) -> int:
    """Return the time of the deadline k, in nanoseconds since 1970."""
    return header.started + round(k * header.dt * 1e9)


def open_topic(foxglove: Any, header: Header, context: Any) -> Any:
    """Return a Foxglove channel for rows in a context."""
    schema = foxglove.Schema(name=SCHEMA, encoding="ros2msg", data=definition(header).encode())
    return foxglove.Channel(TOPIC, schema=schema, message_encoding="cdr", context=context)


def log_rows(topic: Any, header: Header, rows: Matrix) -> None:
    """Log a message for each row, at the time of its deadline."""
    for row, k in zip(rows, rows[:, K].tolist(), strict=True):
        topic.log(message(row), log_time=row_time(header, k))


# ---- Recordings as MCAP ----


# Time between two chunks [s]: with the writer's 0.25 s a killed process loses less than 1 s.
_CHUNK_TIME = 0.5
# A chunk is finished at this size, too [bytes]; a full disk costs the rows of the last one. Chosen
# by hand: a third of a second at 1 kHz and 24 values a row.
_CHUNK_SIZE = 65_536


class _File:
    """File for foxglove's writer that keeps the first error instead of raising it.

    The writer would hide the reason of a failure and log each later message. It is told that all
    went well; ``error`` holds the failure.
    """

    def __init__(self, path: Path) -> None:
        self._raw = path.open("xb", buffering=0)
        self._position = self._end = 0
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        """Write all of ``data``, or keep the error."""
        rest = memoryview(data)
        try:
            while rest and self.error is None:
                rest = rest[self._raw.write(rest) :]
        except OSError as error:
            self.error = error
        self._position += len(data)
        self._end = max(self._end, self._position)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to a position: the length of a finished chunk is written before it."""
        self._position = offset + (0, self._position, self._end)[whence]
        if self.error is None:
            self._raw.seek(self._position)
        return self._position

    def flush(self) -> None:
        """Do nothing: the file has no buffer."""

    def close(self) -> None:
        """Close the file."""
        self._raw.close()


class McapSink:
    """Write rows to an MCAP file ``path``, which grows as they come.

    A file that exists is refused, or replaced if ``overwrite`` is True.
    """

    def __init__(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        self.path, self.overwrite = Path(path), overwrite
        self.name = str(self.path)
        self.stored = 0  #: number of rows in the file, once it is closed
        self._writer: Any = None
        self._flushed = 0.0

    def check(self) -> None:
        """Raise a ``ValueError`` if the file can't be written or may not be replaced."""
        files.check_writable(self.path, self.overwrite)

    def open(self, header: Header) -> None:
        """Begin the file; the header is on disk at once, or an ``OSError`` says why it is not."""
        foxglove = import_extra("foxglove", "telemetry", "an MCAP file")
        mcap = import_extra("foxglove.mcap", "telemetry", "an MCAP file")
        self.check()
        self.path.unlink(missing_ok=True)
        self._header = header
        self._context = foxglove.Context()  # kept: a topic is closed with it
        self._file = _File(self.path)
        options = mcap.MCAPWriteOptions(compression=None, chunk_size=_CHUNK_SIZE)
        self._writer = foxglove.open_mcap(self._file, context=self._context, writer_options=options)
        self._writer.write_metadata(RECORD, {"header": header.to_json()})
        self._topic = open_topic(foxglove, header, self._context)
        self._writer.flush()
        self._flushed = time.monotonic()
        if self._file.error is not None:  # a full disk: nothing must move unrecorded
            with suppress(OSError):
                self.close()
            self.path.unlink(missing_ok=True)
            raise self._file.error

    def write(self, rows: Matrix) -> None:
        """Add a message for each row."""
        log_rows(self._topic, self._header, rows)
        self._check()
        self.stored += rows.shape[0]

    def flush(self) -> None:
        """Finish the chunk if it is half a second old."""
        if time.monotonic() - self._flushed >= _CHUNK_TIME:
            self._writer.flush()
            self._flushed = time.monotonic()
        self._check()

    def close(self) -> None:
        """Finish the file; after a failure, make it end with its last whole chunk."""
        if self._writer is not None:
            writer, self._writer = self._writer, None
            self._topic.close()
            writer.close()
            self._file.close()
            if self._file.error is not None:
                size, self.stored = whole_part(self.path)
                os.truncate(self.path, size)
            self._check()

    def _check(self) -> None:
        """Raise the error that the file kept."""
        if self._file.error is not None:
            raise self._file.error


# ---- Recordings as trajectories ----

# Up to here whole numbers are exact in a row of floats.
_LAST = 2.0**53


def load(path: str | os.PathLike[str], max_size: float = files.MAX_SIZE) -> Any:
    """Read a recorded run, CSV or MCAP, also if its process was killed.

    A sample of the trajectory is a deadline; time counts from the first one in the file. If
    deadlines were skipped or rows lost, samples are filled in: r, y, u and the controller's
    channels stay as they were; ``y_measured``, ``lateness`` and ``step_time`` are NaN, and
    ``events`` is ``Event.GAP``.

    Parameters
    ----------
    path
        the file.
    max_size
        limit of what the file may unpack to, gaps filled in [MB].

    Returns
    -------
    Trajectory
        the run.

    Raises
    ------
    ValueError
        if there is no such file, it is not a recording by quell, or it unpacks to more than
        ``max_size``.
    ImportError
        if an MCAP file can't be read because the package mcap is missing.
    """
    file, most = Path(path), files.bytes_of(max_size)
    where = f"path = {os.fspath(path)!r}"
    try:
        files.check_regular(file, where)
    except FileNotFoundError as error:
        raise ValueError(str(error)) from None
    try:
        with file.open("rb") as opened:
            is_mcap = opened.read(len(MAGIC)) == MAGIC
        if not is_mcap:
            return trajectory_of(*read_csv(file, most), most)
        text, rows = read_mcap(file, most)
        header = Header.from_json(text)
        if rows.size and rows.shape[1] != header.width:
            raise ValueError(f"a message on {TOPIC} is not a row of {header.width} numbers")
        return trajectory_of(header, rows.reshape(-1, header.width), most)
    except OSError as error:
        raise ValueError(f"{where}: can't be read ({error.strerror})") from None
    except files.TooLargeError as error:
        raise ValueError(f"{where}: {error}") from None
    except ValueError as error:
        raise ValueError(f"{where}: must be a recording by quell, CSV or MCAP: {error}") from None


def check_one(run: Any, where: str) -> Trajectory:
    """Return a record of one y and one u; a ``ValueError`` says what to do with several axes."""
    if run.several:
        names = f" ({', '.join(run.axis_names)})" if run.axis_names else ""
        raise ValueError(
            f"{where}: has several axes{names}: NOT possible here, it must "
            "be of one y and one u; .axis(name) of the record is one axis, and quell "
            "replay and quell b0 --axes take several"
        )
    return run


def trajectory_of(header: Header, rows: Matrix, most: int = round(1e6 * files.MAX_SIZE)) -> Any:
    """Return rows (rows, width) as a trajectory with gaps filled in, see ``load``.

    It may take ``most`` bytes.
    """
    if rows.shape[0] == 0:
        raise ValueError("it has no row")
    log, status = _filled(header.channels, rows, most), 0
    record.check_times(log.shape[0], header.dt)
    if any(name == "status" for name, _ in header.channels):
        column = rows[:, record.columns_of(header.channels, "status").start]
        status = int(np.bitwise_or.reduce(record.flags_of(column)))
    common: dict[str, Any] = {
        "log": log,
        "channels": header.channels,
        "dt": header.dt,
        "status": Status(status),
        "ended": (log.shape[0] - 1) * header.dt,
        "plant": header.device,
        "features": header.features,
        "signals": header.signals,
        "axis_names": header.axis_names,
        "axis_features": header.axis_features,
    }
    return Trajectory(**common)


def _filled(channels: Channels, rows: Matrix, most: int) -> Matrix:
    """Return rows whose k increases by one, of at most ``most`` bytes."""
    k = rows[:, K]
    if not (np.all(np.abs(k) <= _LAST) and np.all(k == np.rint(k)) and np.all(np.diff(k) >= 1.0)):
        raise ValueError("the indices of its deadlines are not whole numbers that increase")
    recorded = (k - k[0]).astype(np.int64)
    files.check_size(8 * rows.shape[1] * (int(recorded[-1]) + 1), most)
    every = np.arange(recorded[-1] + 1)
    if every.size == recorded.size:
        return rows
    filled = rows[np.searchsorted(recorded, every, side="right") - 1]
    gaps = np.ones(every.size, dtype=bool)
    gaps[recorded] = False
    filled[:, K] = k[0] + every
    for name in ("y_measured", "lateness", "step_time"):
        filled[gaps, record.columns_of(channels, name)] = np.nan
    filled[gaps, EVENTS] = Event.GAP
    return filled


# ---- Sinks, which take the rows of a loop ----


class Sink(Protocol):
    """A receiver of rows; all methods except ``open`` are called on the writer's thread.

    One that can lose rows which it has taken says with ``stored`` how many are safe.
    """

    name: str  #: name in messages

    def open(self, header: Header) -> None:
        """Begin a recording; raise a ``ValueError`` with the reason if that is impossible."""

    def write(self, rows: Matrix) -> None:
        """Take the next rows (rows, width), in order."""

    def flush(self) -> None:
        """Store what was taken where it outlives this process; called after each round of rows."""

    def close(self) -> None:
        """End the recording."""


class MemorySink:
    """Keep rows in memory: about 20 values a cycle, which is 10 MB a minute at 1 kHz."""

    name = "memory"

    def __init__(self) -> None:
        self._header: Header | None = None
        self._rows: list[Matrix] = []

    def open(self, header: Header) -> None:
        """Begin a new recording."""
        self._header, self._rows = header, []

    def write(self, rows: Matrix) -> None:
        """Keep the rows."""
        self._rows.append(rows)

    def flush(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def trajectory(self) -> Any:
        """Return the recording as ``load`` does for a file."""
        if self._header is None:
            raise ValueError("nothing was recorded yet")
        rows = np.concatenate(self._rows) if self._rows else np.empty((0, self._header.width))
        return trajectory_of(self._header, rows)


def file_sink(path: str | os.PathLike[str], overwrite: bool = False) -> CsvSink | McapSink:
    """Return the sink for a file by its suffix, ``.csv`` or ``.mcap``."""
    kinds: dict[str, type[CsvSink | McapSink]] = {".csv": CsvSink, ".mcap": McapSink}
    suffix = Path(path).suffix.lower()
    if suffix not in kinds:
        raise ValueError(f"path = {os.fspath(path)!r}: must end in {' or '.join(kinds)}")
    return kinds[suffix](path, overwrite)
