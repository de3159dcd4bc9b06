"""Recordings as trajectories."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from quell.realtime.telemetry.channels import EVENTS, LATENESS, STEP_TIME, Y_MEASURED, Event, K
from quell.realtime.telemetry.csv_file import read_csv
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.mcap_file import MAGIC, read_mcap
from quell.records.channels import columns_of
from quell.records.trajectory import Trajectory
from quell.types import Matrix, Status

# A larger jump of k means a damaged file: 28 hours at 1 kHz; 20 channels would fill 16 GB.
_MOST_ROWS = 100_000_000


def load(path: str | os.PathLike[str]) -> Trajectory:
    """Read a recorded run, CSV or MCAP, also if its process was killed.

    A sample of the trajectory is a deadline; time counts from the first one in the file. If
    deadlines were skipped or rows lost, samples are filled in: r, y, u and the controller's
    channels stay as they were; ``y_measured``, ``lateness`` and ``step_time`` are NaN, and
    ``events`` is ``Event.GAP``.

    Raises
    ------
    ValueError
        if there is no such file, or it is not a recording by quell.
    ImportError
        if an MCAP file can't be read because the package mcap is missing.
    """
    file = Path(path)
    try:
        with file.open("rb") as opened:
            read = read_mcap if opened.read(len(MAGIC)) == MAGIC else read_csv
        return trajectory_of(*read(file))
    except OSError as error:
        raise ValueError(f"path = {os.fspath(path)!r}: can't be read ({error.strerror})") from None
    except ValueError as error:
        raise ValueError(
            f"path = {os.fspath(path)!r}: must be a recording by quell, CSV or MCAP: {error}"
        ) from None


def trajectory_of(header: Header, rows: Matrix) -> Trajectory:
    """Return rows (rows, width) as a trajectory with gaps filled in, see ``load``."""
    if rows.shape[0] == 0:
        raise ValueError("it has no row")
    log, status = _filled(rows), 0
    if any(name == "status" for name, _ in header.channels):
        seen = np.nan_to_num(rows[:, columns_of(header.channels, "status").start]).astype(np.int64)
        status = int(np.bitwise_or.reduce(seen))
    return Trajectory(
        log=log,
        channels=header.channels,
        dt=header.dt,
        status=Status(status),
        ended=(log.shape[0] - 1) * header.dt,
        plant=header.device,
        features=header.features,
    )


def _filled(rows: Matrix) -> Matrix:
    """Return rows whose k increases by one."""
    k = rows[:, K]
    whole = np.all(np.isfinite(k)) and np.all(k == np.rint(k))
    if not whole or np.any(np.diff(k) < 1.0) or k[-1] - k[0] > _MOST_ROWS:
        raise ValueError("the indices of its deadlines are not whole numbers that increase")
    recorded = (k - k[0]).astype(np.int64)
    every = np.arange(recorded[-1] + 1)
    filled = rows[np.searchsorted(recorded, every, side="right") - 1]
    gaps = np.ones(every.size, dtype=bool)
    gaps[recorded] = False
    filled[:, K] = k[0] + every
    for column in (Y_MEASURED, LATENESS, STEP_TIME):
        filled[gaps, column] = np.nan
    filled[gaps, EVENTS] = Event.GAP
    return filled
