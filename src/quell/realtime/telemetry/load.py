"""Recordings as trajectories."""

from __future__ import annotations

import functools
import operator
import os
from pathlib import Path

import numpy as np

from quell.reading import MAX_SIZE, TooLargeError, bytes_of, check_regular, check_size
from quell.realtime.telemetry.channels import EVENTS, LATENESS, STEP_TIME, Y_MEASURED, Event, K
from quell.realtime.telemetry.csv_file import read_csv
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.mcap_file import MAGIC
from quell.realtime.telemetry.mcap_reader import read_mcap
from quell.records.channels import columns_of
from quell.records.sample_times import check_times
from quell.records.trajectory import Trajectory
from quell.types import Matrix, Status, Vector

# Up to here whole numbers are exact in a row of floats.
_LAST = 2.0**53


def load(path: str | os.PathLike[str], max_size: float = MAX_SIZE) -> Trajectory:
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

    Raises
    ------
    ValueError
        if there is no such file, it is not a recording by quell, or it unpacks to more than
        ``max_size``.
    ImportError
        if an MCAP file can't be read because the package mcap is missing.
    """
    file, most = Path(path), bytes_of(max_size)
    where = f"path = {os.fspath(path)!r}"
    try:
        check_regular(file, where)
    except FileNotFoundError as error:
        raise ValueError(str(error)) from None
    try:
        with file.open("rb") as opened:
            read = read_mcap if opened.read(len(MAGIC)) == MAGIC else read_csv
        return trajectory_of(*read(file, most), most)
    except OSError as error:
        raise ValueError(f"{where}: can't be read ({error.strerror})") from None
    except TooLargeError as error:
        raise ValueError(f"{where}: {error}") from None
    except ValueError as error:
        raise ValueError(f"{where}: must be a recording by quell, CSV or MCAP: {error}") from None


def trajectory_of(header: Header, rows: Matrix, most: int = round(1e6 * MAX_SIZE)) -> Trajectory:
    """Return rows (rows, width) as a trajectory with gaps filled in, see ``load``.

    It may take ``most`` bytes.
    """
    if rows.shape[0] == 0:
        raise ValueError("it has no row")
    log, status = _filled(rows, most), 0
    check_times(log.shape[0], header.dt)
    if any(name == "status" for name, _ in header.channels):
        status = _all_flags(rows[:, columns_of(header.channels, "status").start])
    return Trajectory(
        log=log,
        channels=header.channels,
        dt=header.dt,
        status=Status(status),
        ended=(log.shape[0] - 1) * header.dt,
        plant=header.device,
        features=header.features,
        signals=header.signals,
    )


def _all_flags(column: Vector) -> int:
    """Return the flags that any row has; a number that is no sum of flags counts as none."""
    known = functools.reduce(operator.or_, Status)
    valid = np.where((column >= 0.0) & (column <= known), column, 0.0)
    return int(np.bitwise_or.reduce(valid.astype(np.int64)))


def _filled(rows: Matrix, most: int) -> Matrix:
    """Return rows whose k increases by one, of at most ``most`` bytes."""
    k = rows[:, K]
    if not (np.all(np.abs(k) <= _LAST) and np.all(k == np.rint(k)) and np.all(np.diff(k) >= 1.0)):
        raise ValueError("the indices of its deadlines are not whole numbers that increase")
    recorded = (k - k[0]).astype(np.int64)
    check_size(8 * rows.shape[1] * (int(recorded[-1]) + 1), most)
    every = np.arange(recorded[-1] + 1)
    if every.size == recorded.size:
        return rows
    filled = rows[np.searchsorted(recorded, every, side="right") - 1]
    gaps = np.ones(every.size, dtype=bool)
    gaps[recorded] = False
    filled[:, K] = k[0] + every
    for column in (Y_MEASURED, LATENESS, STEP_TIME):
        filled[gaps, column] = np.nan
    filled[gaps, EVENTS] = Event.GAP
    return filled
