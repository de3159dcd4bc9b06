"""``quell rank`` and ``quell watch``: what the records of running machines say."""

from __future__ import annotations

import hashlib
import re
import statistics
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from quell.cli.exit_codes import ExitCode
from quell.cli.options import READ_OPTIONS, RESULT_OUTPUTS, ReadOptions, ResultOutputs, WholeOrNone
from quell.cli.output import Console, check_outputs, number, print_line, table, write_results

if TYPE_CHECKING:
    from quell.identification import Measured
    from quell.monitoring import Machine, Ranking

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
    outputs: ResultOutputs = RESULT_OUTPUTS,
) -> None:
    """Decide which of several tunings was best, from logs of the running machine.

    A verdict that the logs do not allow is a line that begins with NOT, with what to do. Logs of
    several axes are judged for each of them, with v = B0 u in the place of u, and one B0 for all
    logs, that of the first one.

    Parameters
    ----------
    logs
        Files of records: tables of t,u,y,r in text, recordings of `quell run-rig`, saved runs
        (.nc), of one axis or of several. NAME=FILE gives the name of the tuning, that of the file
        by default; several logs of one name belong to one tuning. FILE@600:1200 is the part from
        600 to 1200 s. Alternate the tunings (A, B, A, B), so that what drifts is in both.
    criterion
        What is to be low: rms or iae of the error r − y, or effort, the mean of |du/dt|.
    confidence
        Probability with which all verdicts hold.
    dt
        Sample time [s] of tables without times; columns are then u,y,r by default.
    """
    from quell.commissioning import by_axis, measured, measured_run, run_in, with_one_gain
    from quell.monitoring import rank as rank_logs

    outputs = check_outputs(outputs)
    given = [_named(text) for text in logs]
    axes: dict[str, dict[str, list[Measured]]] = {}
    how = read.columns, dt, read.time_unit, read.max_size
    runs = {f"{one.path}": run_in(one.path, *how) for one in given}
    known, gain = with_one_gain({name: run for name, run in runs.items() if run is not None})
    for one in given:
        if (run := known.get(f"{one.path}")) is None:
            records = {"": measured(one.path, *how, reference=True)}
        else:
            records = {axis: measured_run(each) for axis, each in by_axis(run).items()}
        if axes and [*axes] != [*records]:
            theirs, ours = (", ".join(filter(None, each)) or "one y" for each in (records, axes))
            raise ValueError(f"{one.path}: has {theirs}, the logs before {ours}: must be the same")
        for axis, record in records.items():
            axes.setdefault(axis, {}).setdefault(one.name, []).append(_part(record, one))
    if not axes:
        axes[""] = {}
    # The level is shared by the axes.
    level = confidence if len(axes) == 1 else 1.0 - (1.0 - confidence) / len(axes)
    found = {
        axis: rank_logs(tunings, criterion=criterion, confidence=level)
        for axis, tunings in axes.items()
    }
    console = Console()
    for axis, ranking in found.items():
        _print_scores(console, ranking, axis)
        print_line(console, ranking.describe())
    if len(found) == 1:
        write_results(console, next(iter(found.values())).to_json(), outputs)
        return
    verdict = _together({axis: ranking.best for axis, ranking in found.items()}, confidence)
    print_line(console, verdict)
    results: dict[str, Any] = {"axes": {axis: each.to_json() for axis, each in found.items()}}
    results |= {
        "verdict": verdict,
        "B": None if gain.B is None else gain.B.tolist(),
        "notes": gain.describe(),
    }
    for note in gain.describe():
        print_line(console, note)
    write_results(console, results, outputs)


def _together(best: dict[str, str | None], confidence: float) -> str:
    """Return the verdict on the tunings of several axes, of which each has its best one or none."""
    level = f"at {100.0 * confidence:g} % for all axes together"
    names = set(best.values())
    if None in names:
        open_ = ", ".join(axis for axis, name in best.items() if name is None)
        return f"NOT decided for {open_}, {level}: axes that act on each other have one tuning"
    if len(names) > 1:
        each = ", ".join(f"{name} for {axis}" for axis, name in best.items())
        return (
            f"NOT one best tuning, {level}: {each}; axes that act on each other have one tuning: "
            "weigh their errors, or combine the settings of each and log again"
        )
    return f"best for all axes: {names.pop()}, {level}"


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


def _print_scores(console: Console, found: Ranking, axis: str) -> None:
    headings = (
        "RMS\nerror",
        "mean\n|error|",
        "mean\n|du/dt|",
        "overshoot\n[%]",
        "logged\n[s]",
        "batches",
    )
    title = "Tunings, the lowest criterion first"
    name = f"{axis}: {title}" if axis else title
    rows = table(name, "", *headings, padding=(0, 1, 0, 0), pad_edge=False)
    for tuning, scores in found.scores.items():
        beyond = None if scores.overshoot != scores.overshoot else scores.overshoot
        cells = [number(value, ".4g") for value in (scores.rms, scores.iae, scores.effort)]
        cells += [number(beyond, ".3g", 100.0), number(scores.duration, ".4g"), str(scores.batches)]
        rows.add_row(tuning, *cells)
    console.print(rows)


# ---- quell watch ----

# Settings of a new state.
_WINDOW, _ORDER, _ALPHA = 60.0, 2, 0.01


def watch(
    records: list[Path],
    *,
    state: Path | None = None,
    window: float | None = None,
    order: WholeOrNone = None,
    band: float | None = None,
    alpha: float | None = None,
    dt: float | None = None,
    read: ReadOptions = READ_OPTIONS,
    outputs: ResultOutputs = RESULT_OUTPUTS,
) -> None:
    """Watch the numbers of a machine over its records, and raise an alarm when one has changed.

    b0, friction, stiffness, a resonance, noise, load, and f of recorded runs, in each window; of a
    run of several axes for each of them, with v = B0 u in the place of u. The
    probability of a false alarm, over all time, is --alpha at most, as long as windows differ by
    chance only. The exit code is 6 where there is an alarm.

    Parameters
    ----------
    records
        Records in the order of time: recordings of `quell run-rig`, saved runs (.nc), both of one
        axis or of several, or tables of t,u,y in text; with --columns t,u,y,r the error is watched,
        too.
    state
        File, in JSON, that is continued, or begun: run the command each day on the day's records.
        Records that are in it already are left out.
    window
        Length of a window [s], 60 by default: an hour, a shift or a day where minutes are alike.
    order
        1 or 2, by default 2: u acts on this derivative of y.
    band
        Band [rad/s] of the regression for b0 and friction, above that of the moves; 0.03/dt by
        default.
    alpha
        Probability of a false alarm over all time and all numbers, 0.01 by default.
    dt
        Sample time [s] of tables without times; columns are then u,y by default.
    """
    from quell.files import check_writable
    from quell.monitoring import Machine
    from quell.monitoring.windows import signals_of

    outputs = check_outputs(outputs)
    settings = {"window": window, "order": order, "band": band, "alpha": alpha}
    given = {name: value for name, value in settings.items() if value is not None}
    console = Console()
    if state is not None and state.exists():
        machine = Machine.load(state, read.max_size)
        _check_settings(state, machine, given)
    else:
        new: dict[str, Any] = {"window": _WINDOW, "order": _ORDER, "alpha": _ALPHA} | given
        machine = Machine(**new)
        if state is not None:
            check_writable(state)
    for path in records:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        if digest in machine.records:
            print_line(console, f"{path.name}: is in the state already, left out")
            continue
        signals = signals_of(path, read.columns, dt, read.time_unit, read.max_size)
        before = len(machine.watch.labels)
        machine.take(signals, path.name)
        machine.records.append(digest)
        print_line(console, f"{path.name}: {len(machine.watch.labels) - before} windows")
    _print_features(console, machine)
    print_line(console, machine.describe())
    if state is not None:
        machine.save(state)
        print_line(console, f"State: {state}")
    write_results(console, _results(machine), outputs)
    if machine.watch.alarms:
        sys.exit(ExitCode.ALARM)


def _check_settings(state: Path, machine: Machine, given: dict[str, Any]) -> None:
    """Check that a state has the settings that are asked for."""
    for name, value in given.items():
        if machine.settings[name] != value:
            raise ValueError(
                f"--{name} {value:g}: the state {str(state)!r} has {machine.settings[name]!r}, and "
                "its windows can be compared with no others; leave it, or begin a new state"
            )


def _print_features(console: Console, machine: Machine) -> None:
    rows = table("Numbers of the machine", "", "windows", "median", "latest", "evidence\n[%]")
    for name in machine.watch.features:
        values, evidence = machine.watch.values(name), machine.watch.evidence(name)
        share = 100.0 * max(evidence, 0.0) / machine.watch.threshold
        middle, last = (
            (statistics.median(values), float(values[-1])) if values.size else (None, None)
        )
        cells = number(middle, ".4g"), number(last, ".4g"), number(share, ".0f")
        rows.add_row(name, str(values.size), *cells)
    console.print(rows)


def _results(machine: Machine) -> dict[str, Any]:
    from quell.files import nonfinite_to_none

    watched = machine.watch
    found = {
        "settings": machine.settings,
        "windows": len(watched.labels),
        "alarms": [alarm._asdict() for alarm in watched.alarms],
        "evidence": {name: watched.evidence(name) for name in watched.features},
        "threshold": watched.threshold,
        "report": machine.describe().splitlines(),
    }
    return dict(nonfinite_to_none(found))
