"""Records from files: CSV tables, recordings of ``quell run-rig``, and saved runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from quell.reading import MAX_SIZE

if TYPE_CHECKING:
    from quell.identification import Measured
    from quell.records.trajectory import Trajectory


def measured(
    path: Path,
    columns: str = "",
    dt: float | None = None,
    time_unit: str | None = None,
    max_size: float = MAX_SIZE,
) -> Measured:
    """Read input and output from a file of any kind that quell knows.

    A NetCDF file is a run that ``Trajectory.save`` wrote; a MCAP file, or a CSV file with the
    header of a recording beside it, is a recording of ``quell run-rig``; another file is a CSV
    table, for which ``columns``, ``dt`` and ``time_unit`` are those of ``read_record``.
    """
    from quell.identification import read_record
    from quell.realtime import load
    from quell.records.trajectory import Trajectory

    plain = bool(columns) or dt is not None or time_unit is not None
    if path.suffix == ".nc" and not plain:
        return _of_run(Trajectory.load(path, max_size))
    header = path.with_name(path.name + ".json")
    if not plain and (path.suffix == ".mcap" or header.is_file()):
        return _of_run(load(path, max_size))
    default = ("u", "y") if dt is not None else ("t", "u", "y")
    names = tuple(name.strip() for name in columns.split(",")) if columns else default
    return read_record(path, names, dt, time_unit=time_unit, max_size=max_size)


def _of_run(run: Trajectory) -> Measured:
    """Return the samples of a run under control, with held measurements where one is missing."""
    import numpy as np

    from quell.identification import Measured
    from quell.realtime.loop.modes import Mode

    u, r = run["u"], run["r"]
    y = np.where(np.isfinite(run["y_measured"]), run["y_measured"], run["y"])
    part = slice(0, len(run))
    if "mode" in run.names and np.any(run["mode"] == Mode.RUN):
        running = np.flatnonzero(run["mode"] == Mode.RUN)
        part = slice(int(running[0]), int(running[-1]) + 1)
    known = run.every * run.dt, r[part].copy(), run.signals
    return Measured(u[part].copy(), y[part].copy(), *known)
