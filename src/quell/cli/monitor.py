"""``quell rank``: what the logs of running machines say."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from quell.cli.options import READ_OPTIONS, Overwrite, ReadOptions
from quell.cli.output import Console, number, print_line, table

if TYPE_CHECKING:
    from quell.identification import Measured
    from quell.monitoring import Ranking

# ---- quell rank ----

# A part of a log behind its name: day.csv@600:1200, in seconds from its begin.
_PART = re.compile(r"(.+)@(\d*\.?\d*):(\d*\.?\d*)")


class _Named(NamedTuple):
    """A log as it is given: NAME=FILE@FROM:TO."""

    name: str
    path: Path
    begin: float  # [s]
    end: float | None  # [s]


def rank(
    logs: list[str],
    *,
    criterion: str = "rms",
    confidence: float = 0.95,
    dt: float | None = None,
    read: ReadOptions = READ_OPTIONS,
    json: Path | None = None,
    overwrite: Overwrite = False,
) -> None:
    """Say which of several tunings was best, from logs of the running machine.

    A verdict that the logs do not allow is a line that begins with NOT, with what to do.

    Parameters
    ----------
    logs
        Files of records: tables of t,u,y,r in text, recordings of `quell run-rig`, saved runs
        (.nc). NAME=FILE gives the name of the tuning, that of the file by default; several logs of
        one name belong to one tuning. FILE@600:1200 is the part from 600 to 1200 s. Alternate the
        tunings (A, B, A, B), so that what drifts is in both.
    criterion
        What is to be low: rms or iae of the error r − y, or effort, the mean of |du/dt|.
    confidence
        Probability with which all verdicts hold.
    dt
        Sample time [s] of tables without times; columns are then u,y,r by default.
    json
        Write the results to this file, for programs.
    """
    from quell.commissioning import measured
    from quell.files import check_writable, write_json
    from quell.monitoring import rank as rank_logs

    if json is not None:
        check_writable(json, overwrite)
    given = [_named(text) for text in logs]
    tunings: dict[str, list[Measured]] = {}
    for one in given:
        how = read.columns, dt, read.time_unit, read.max_size
        record = measured(one.path, *how, reference=True)
        tunings.setdefault(one.name, []).append(_part(record, one))
    found = rank_logs(tunings, criterion=criterion, confidence=confidence)
    console = Console()
    _print_scores(console, found)
    print_line(console, found.describe())
    if json is not None:
        write_json(json, found.to_json(), overwrite)
        print_line(console, f"Results: {json}")


def _named(text: str) -> _Named:
    """Return a log from its text."""
    name, sign, rest = text.partition("=")
    if not sign or Path(text).exists():
        name, rest = "", text
    part = _PART.fullmatch(rest)
    if part is None or Path(rest).exists():
        path, begin, end = Path(rest), 0.0, None
    else:
        path = Path(part[1])
        begin = float(part[2]) if part[2] not in ("", ".") else 0.0
        end = float(part[3]) if part[3] not in ("", ".") else None
    return _Named(name or path.stem, path, begin, end)


def _part(record: Measured, one: _Named) -> Measured:
    """Return the part of a record that is asked for."""
    begin = round(one.begin / record.dt)
    end = record.y.size if one.end is None else round(one.end / record.dt)
    if not begin < end <= record.y.size:
        duration = record.y.size * record.dt
        text = f"{one.begin:g}:{'' if one.end is None else f'{one.end:g}'}"
        raise ValueError(f"{one.path}@{text}: must be a part of the {duration:g} s of the log")
    r = None if record.reference is None else record.reference[begin:end]
    return record._replace(u=record.u[begin:end], y=record.y[begin:end], reference=r)


def _print_scores(console: Console, found: Ranking) -> None:
    headings = (
        "RMS error",
        "mean |error|",
        "mean |du/dt|",
        "overshoot [%]",
        "logged [s]",
        "batches",
    )
    rows = table("Tunings, the lowest criterion first", "", *headings)
    for name, scores in found.scores.items():
        beyond = None if scores.overshoot != scores.overshoot else scores.overshoot
        cells = [number(value, ".4g") for value in (scores.rms, scores.iae, scores.effort)]
        cells += [number(beyond, ".3g", 100.0), number(scores.duration, ".4g"), str(scores.batches)]
        rows.add_row(name, *cells)
    console.print(rows)
