"""``quell run-rig``: close a setup's controller around its device, tell what happens, print how it went."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quell.cli.interrupt import ended_at_once
from quell.cli.output import check_places, write_results
from quell.cli.report import figure_of, judge, print_judgement, print_outcome
from quell.experiments.common.figures import save_figure
from quell.files import nonfinite_to_none
from quell.realtime.devices.registry import open_device
from quell.realtime.loop.modes import Ending
from quell.realtime.loop.result import ModeChange, RigRun
from quell.realtime.loop.run import run_rig
from quell.realtime.telemetry import csv_file
from quell.realtime.telemetry.sinks import LiveSink, file_sink
from quell.setup import EXAMPLES, Setup, made, read
from quell.setup.errors import refused

DONE, TRIPPED, INTERRUPTED = 0, 3, 130
"""Exit codes: the scenario was run to its end; a limit or a fault ended it, safely; it was asked to stop."""


def run_setup(
    *,
    path: Path | None,
    changes: Mapping[tuple[str, str], Any],
    telemetry: tuple[Path, ...],
    live: int | None,
    json_file: Path | None,
    figures: Path | None,
    save: Path | None,
) -> int:
    """Run it, print, write what was asked for; return the exit code.

    ``changes`` are values, by table and key, that take the place of the file's; those that are None are none.

    Raises
    ------
    ValueError
        for a mistake in the file, with a line for each, a place that can't be written to, or a device that is none.
    OSError
        where the device can't be reached.
    """
    name, data = read(EXAMPLES / "torsional_rig.toml" if path is None else path)
    setup = made(name, changed(data, changes))
    scenario, arguments = setup.needed("scenario"), dict(setup.needed("rig"))
    check_places(json_file, figures, save)
    files = [*map(Path, arguments.pop("telemetry", ())), *telemetry]
    for file in files:
        check_new(file)
    port = arguments.pop("live") if live is None else live
    console = Console()
    what = f"{setup.title}: {arguments['device']}, dt = {setup.controller.dt:g} s, for {scenario.duration:g} s. Ctrl-C ramps u to zero."
    console.print(escape(what), soft_wrap=True)
    run = _closed(console, setup, arguments, files, None if port is None else LiveSink(port))
    if run is None:
        return TRIPPED
    scores = judge(run.trajectory, setup)
    _print(console, run)
    print_judgement(console, f"{setup.title}: the scenario", scores)
    learned = print_outcome(console, run.trajectory)
    paths = []
    if figures is not None and len(run.trajectory):
        paths = [
            *figure_of(run.trajectory, setup.title, figures, Path(name).stem),
            *_timing_figure(run, setup, figures),
        ]
    if save is not None and len(run.trajectory):
        run.trajectory.save(save)
        console.print(f"Record: {escape(str(save))}", soft_wrap=True)
    code = exit_code(run)
    about = {
        "title": setup.title,
        "device": arguments["device"],
        "dt": setup.controller.dt,
        "verdict": run.verdict,
        "exit_code": code,
    }
    write_results(
        console,
        about | _as_json(run) | {"metrics": scores, "learned": learned, "setup": setup.as_json()},
        json_file,
        paths,
        figures,
    )
    return code


def _closed(
    console: Console,
    setup: Setup,
    arguments: dict[str, Any],
    files: list[Path],
    live: LiveSink | None,
) -> RigRun | None:
    """Close the loop and tell of each change of mode; None where the device's driver hung in the middle of it."""
    url, options = (
        arguments["device"],
        {key: value for key, value in arguments.items() if key not in ("device", "live")},
    )
    began = False

    def tell(change: ModeChange) -> None:
        nonlocal began
        if live is not None and not began:
            console.print(f"Live: {live.url}")
        began = True
        console.print(escape(str(change)), soft_wrap=True)

    # The port first: where it is taken no file is begun.
    sinks: list[Any] = [*([] if live is None else [live]), *files]
    try:
        device = open_device(url, setup.controller.dt)
        with ended_at_once(device.close):
            return run_rig(
                device, setup.controller, setup.scenario, telemetry=sinks, on_change=tell, **options
            )
    except ValueError as error:
        raise refused(setup.file, "rig", error, [*arguments]) from None
    except ConnectionError as error:
        if not began:
            raise
        print(f"quell: {error}", file=sys.stderr)
        return None


def changed(data: Mapping[str, Any], changes: Mapping[tuple[str, str], Any]) -> dict[str, Any]:
    """Return a file's tables with other values for some keys."""
    tables = {
        key: dict(value) if isinstance(value, Mapping) else value for key, value in data.items()
    }
    for (table, key), value in changes.items():
        if value is not None and isinstance(tables.setdefault(table, {}), dict):
            tables[table][key] = value
    return tables


def check_new(file: Path) -> None:
    """Say that a recording can't be made, before the device is woken.

    Raises
    ------
    ValueError
        for another suffix than ``.mcap`` and ``.csv``, a file that is there, and a place that can't be written to.
    """
    file_sink(file)
    csv_file.check_new(file)


def exit_code(run: RigRun) -> int:
    """Return 0 where a run came to its end, 130 where it was asked to stop, 3 where a limit or a fault ended it."""
    if run.completed:
        return DONE
    asked = any(change.cause.ending is Ending.REQUESTED for change in run.changes)
    return INTERRUPTED if asked else TRIPPED


def _print(console: Console, run: RigRun) -> None:
    table = Table(title="Punctuality", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("[µs]")
    for heading in ("p50", "p99", "p99.9", "max"):
        table.add_column(heading, justify="right")
    for label, histogram in (("lateness", run.timing.lateness), ("step time", run.timing.step)):
        cells = [
            "–" if math.isnan(value) else f"{1e6 * value:.1f}"
            for value in histogram.summary().values()
        ]
        table.add_row(label, *cells)
    console.print(table)
    for label, histogram in (("Lateness", run.timing.lateness), ("Step time", run.timing.step)):
        bars = "\n".join(histogram.text().splitlines()[1:])
        console.print(f"{label}, cycles (bars are logarithmic):\n{bars}\n", highlight=False)
    console.print(f"Loop: {_counted(run.tally._asdict())}", soft_wrap=True)
    if run.counters:
        console.print(f"Device: {_counted(run.counters)}", soft_wrap=True)
    for note in run.notes:
        console.print(escape(f"Note: {note}"), soft_wrap=True)


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in counts.items())


def _timing_figure(run: RigRun, setup: Setup, folder: Path) -> list[Path]:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8.0, 4.0), layout="constrained")
    run.timing.plot(axes)
    axes.axvline(1e6 * setup.controller.dt, color="0.3", linestyle="--", linewidth=1.0, label="dt")
    axes.legend()
    axes.set_title(f"{setup.title}: {run.tally.cycles} cycles, {run.overruns} overruns")
    try:
        return save_figure(figure, folder, "timing")
    finally:
        plt.close(figure)


def _as_json(run: RigRun) -> dict[str, Any]:
    found: dict[str, Any] = nonfinite_to_none(
        {
            "completed": run.completed,
            "timing": {
                "lateness": run.timing.lateness.summary(),
                "step": run.timing.step.summary(),
            },
            "tally": run.tally._asdict(),
            "counters": run.counters,
            "changes": [
                {"t": change.t, "mode": change.mode.name, "cause": change.cause.text}
                for change in run.changes
            ],
            "notes": list(run.notes),
        }
    )
    return found
