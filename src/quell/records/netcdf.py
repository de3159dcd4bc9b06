"""Records from NetCDF files, which a process with limits of time and memory reads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Timer
from typing import IO, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.files import TooLargeError, bytes_of, check_regular, check_size
from quell.quantities import UNKNOWN, Signals, signals_from
from quell.records import netcdf_reader
from quell.records.record import check_steps, check_times

R = TypeVar("R")
# Samples from one recorded sample to the next: as many as a scenario may have.
_MOST_EVERY = 10**12
# Time that the process may take as a multiple of its processor time: it may have to wait for a disk
# or a busy machine. A file that hangs ends within 20 s for the ``max_size`` that is the default.
_PATIENCE = 2.5


class Stored(NamedTuple):
    """The contents of a file."""

    attributes: Mapping[str, Any]
    dims: Mapping[str, tuple[str, ...]]  # of each variable
    values: Mapping[str, NDArray[Any]]  # numbers, or labels as texts
    parameters: Mapping[str, str]  # variables that are parameters of the plants, by variable


def load_record(
    path: str | os.PathLike[str],
    writer: str,
    axes: tuple[str, ...],
    attributes: set[str],
    variables: set[str],
    max_size: float,
    make: Callable[[Stored, dict[str, Any]], R],
) -> R:
    """Return the record that ``make`` makes of a NetCDF file by ``writer``.

    The file must have channels over ``axes``, and the ``attributes`` and ``variables`` besides
    these. ``make`` gets its contents and the fields of ``Record``.

    Raises
    ------
    FileNotFoundError
        if there is no such file.
    ValueError
        if it is not such a file, unpacks to more than ``max_size`` [MB], or takes too long.
    """
    where, most = f"path = {os.fspath(path)!r}", bytes_of(max_size)
    check_regular(path, where)
    lists = (",".join(names) for names in (axes, sorted(attributes), sorted(variables)))
    arguments = [str(Path(path).absolute()), str(most), *lists]
    try:
        with _reader(arguments, most) as answer:
            stored = _received(answer, most)
        return make(stored, _record_fields(stored, axes, variables))
    except TooLargeError as error:
        raise ValueError(f"{where}: {error}") from None
    except netcdf_reader.Fault as error:
        raise ValueError(f"{where}: {error}: it was not written by {writer}") from None
    except (ValueError, TypeError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{where}: must be a NetCDF file written by {writer} ({reason})") from None


@contextmanager
def _reader(arguments: Sequence[str], most: int) -> Iterator[IO[bytes]]:
    """Start the process that reads a file, and yield its output."""
    if not sys.executable:
        raise ValueError("there is no Python interpreter to read it with: sys.executable is empty")
    # -P and absolute folders: no module is imported from the current folder, where the file may be.
    folders = [folder for folder in sys.path if Path(folder).is_absolute()]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}
    environment["OPENBLAS_NUM_THREADS"] = "1"  # others would only take memory
    command = [sys.executable, "-P", "-m", netcdf_reader.__name__, *arguments]
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=environment,
    ) as process:
        allowed = netcdf_reader.processor_time(most)
        timer = Timer(_PATIENCE * allowed, process.kill)
        timer.start()
        try:
            assert process.stdout is not None
            yield process.stdout
            if process.wait():
                raise ValueError(f"reading it failed, exit code {process.returncode}")
        except EOFError:
            if process.wait() in (-9, -24):  # SIGKILL, SIGXCPU
                limits = f"{allowed:.3g} s of processor time, or {_PATIENCE * allowed:.3g} s"
                raise ValueError(f"reading it took more than {limits} by the clock") from None
            code = process.returncode
            raise ValueError(f"reading it failed, exit code {code}") from None
        finally:
            timer.cancel()
            process.kill()


def _received(answer: IO[bytes], most: int) -> Stored:
    """Return the contents that the process sends; ``EOFError`` if it ends early."""
    line = answer.readline()
    if not line.endswith(b"\n"):
        raise EOFError
    told = json.loads(line)
    if "too large" in told:
        check_size(most + 1, most)
    if "fault" in told:
        raise netcdf_reader.Fault(told["fault"])
    if "error" in told:
        raise ValueError(told["error"])
    dims, values, parameters = {}, {}, {}
    for variable in told["variables"]:
        name, shape = variable["name"], tuple(variable["shape"])
        dims[name] = tuple(variable["dims"])
        if "labels" in variable:
            values[name] = np.array(variable["labels"], dtype=str)
        else:
            values[name] = np.empty(shape, dtype=variable["dtype"])
            bytes_ = values[name].reshape(-1).view(np.uint8)
            if bytes_.size and answer.readinto(bytes_.data) != bytes_.size:  # type: ignore[attr-defined]
                raise EOFError
        if "parameter" in variable:
            parameters[name] = variable["parameter"]
    return Stored(told["attributes"], dims, values, parameters)


def _signals(text: Any) -> Signals:
    """Return the names and units that a file tells; none for a text that is not theirs."""
    try:
        return signals_from(json.loads(text)) if isinstance(text, str) else UNKNOWN
    except (ValueError, RecursionError):
        return UNKNOWN


def _record_fields(stored: Stored, axes: tuple[str, ...], besides: set[str]) -> dict[str, Any]:
    """Return the fields of ``Record``; all variables but these ``besides`` are channels."""
    named = {name for over in stored.dims.values() for name in over}
    channels = [
        name
        for name in stored.values
        if name not in named | besides and name not in stored.parameters
    ]
    if not channels or any(stored.dims[name][: len(axes)] != axes for name in channels):
        raise netcdf_reader.Fault(f"has channels that are not over {' and '.join(axes)}")
    values = [stored.values[name] for name in channels]
    columns = [each[..., None] if each.ndim == len(axes) else each for each in values]
    widths = [column.shape[-1] for column in columns]
    log = np.empty((*columns[0].shape[:-1], sum(widths)))
    for i, column in enumerate(columns):
        log[..., sum(widths[:i]) : sum(widths[: i + 1])] = column
    dt = checks.positive("dt", stored.attributes["dt"], "s")
    every = checks.whole("every", stored.attributes["every"], 1)
    if every > _MOST_EVERY:
        raise ValueError(f"every = {every}: must be at most {_MOST_EVERY}")
    samples, step = log.shape[-2], every * dt
    check_times(samples, step)
    time = stored.values.get("time")
    if time is not None and time.shape == (samples,) and time.dtype.kind in "fiu":
        known = f"its attributes, dt = {dt:g} s and every = {every},"
        check_steps(time.astype(np.float64), np.arange(float(samples)), step, known)
    return {
        "log": log,
        "channels": tuple(zip(channels, widths, strict=True)),
        "dt": dt,
        "every": every,
        "plant": str(stored.attributes["plant"]),
        "features": tuple(map(str, stored.values.get("theta_index", ()))),
        "signals": _signals(stored.attributes.get("signals")),
        "axis_names": tuple(map(str, json.loads(stored.attributes.get("axis_names", "[]")))),
        "axis_features": tuple(
            tuple(map(str, each))
            for each in json.loads(stored.attributes.get("axis_features", "[]"))
        ),
    }
