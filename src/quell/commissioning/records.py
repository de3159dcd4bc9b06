"""Records from files: tables in text, recordings of ``quell run-rig``, and saved runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from quell.reading import MAX_SIZE

if TYPE_CHECKING:
    from quell.identification import Measured
    from quell.records.trajectory import Trajectory


# Sample times of records that are one experiment's may differ by this share: by a clock's drift and
# the rounding of times. Over 1000 samples that is one sample. Chosen by hand.
_SAME = 1e-3


def is_record(path: Path) -> bool:
    """Return whether a file is a record by its name: any that is no setup, in .toml."""
    return path.suffix.lower() != ".toml"


def measured(
    path: Path,
    columns: str = "",
    dt: float | None = None,
    time_unit: str | None = None,
    max_size: float = MAX_SIZE,
) -> Measured:
    """Read input and output from a file of any kind that quell knows.

    A NetCDF file is a run that ``Trajectory.save`` wrote; a MCAP file, or a CSV file with the
    header of a recording beside it, is a recording of ``quell run-rig``; another file is a table
    in text, for which ``columns``, ``dt`` and ``time_unit`` are those of ``read_record``.

    Raises
    ------
    ValueError
        as ``read_record``; and if the file is a setup.
    """
    from quell.identification import read_record
    from quell.realtime import load
    from quell.records.trajectory import Trajectory

    plain = bool(columns) or dt is not None or time_unit is not None
    if path.suffix.lower() == ".nc" and not plain:
        return _of_run(Trajectory.load(path, max_size))
    header = path.with_name(path.name + ".json")
    if not plain and (path.suffix.lower() == ".mcap" or header.is_file()):
        return _of_run(load(path, max_size))
    default = ("u", "y") if dt is not None else ("t", "u", "y")
    names = tuple(name.strip() for name in columns.split(",")) if columns else default
    return read_record(path, names, dt, time_unit=time_unit, max_size=max_size)


def measured_records(
    paths: Sequence[Path],
    columns: str = "",
    dt: float | None = None,
    time_unit: str | None = None,
    max_size: float = MAX_SIZE,
) -> list[Measured]:
    """Read several records of one plant, as ``measured`` does; all have the same sample time.

    Sample times that differ by rounding or drift are replaced by their mean, by samples.

    Raises
    ------
    ValueError
        as ``measured``; and if there is no file, or two files have different sample times.
    """
    if not paths:
        raise ValueError("data: missing; give a file of a record")
    records = [measured(path, columns, dt, time_unit, max_size) for path in paths]
    first = records[0]
    for path, record in zip(paths, records, strict=True):
        if abs(record.dt - first.dt) > _SAME * first.dt:
            raise ValueError(
                f"data = {str(path)!r}: dt = {record.dt:g} s: must be that of {str(paths[0])!r}, "
                f"{first.dt:g} s; identify them one by one, or resample one of them"
            )
    if len({record.dt for record in records}) == 1:
        return records
    total = sum(record.y.size for record in records)
    mean = sum(record.dt * record.y.size for record in records) / total
    return [record._replace(dt=mean) for record in records]


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
