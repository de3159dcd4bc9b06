"""``quell sweep``."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from quell.cli.exit_codes import exit_if_diverged
from quell.cli.options import (
    RUN_OUTPUTS,
    RunOutputs,
    Trust,
    Whole,
    WholeOrNone,
    refuse,
)
from quell.cli.output import (
    COMPILING,
    Console,
    check_outputs,
    print_line,
    progress_bar,
    write_record,
    write_results,
)
from quell.cli.report import print_metrics, print_outcome, save_run_figure, windowed_metrics
from quell.cli.sweep_report import print_summary, stored_alike, summary

if TYPE_CHECKING:
    from quell.setup import Setup
    from quell.sweeping import Sweep

_WORST = 5
_LABEL = "simulating (the first runs compile for some seconds)"


def sweep(
    setup: Path,
    *,
    folder: Path | None = None,
    dask: Annotated[str | None, Parameter(show_default=False)] = None,
    workers: WholeOrNone = None,
    repeat: WholeOrNone = None,
    worst: Whole = _WORST,
    trust: Trust = False,
    outputs: RunOutputs = RUN_OUTPUTS,
) -> None:
    """Do the runs of a setup's table [sweep], and store their measures.

    A sweep that was interrupted or killed goes on where it stopped when the command is given again.
    Failing runs are recorded and do not stop it.

    Parameters
    ----------
    setup
        The file, in TOML; docs/setup has all keys, docs/scale an example.
    folder
        Where the results are; by default the setup's name with -sweep.
    dask
        Address tcp://HOST:PORT of a Dask scheduler, whose workers do the runs; docs/scale.
    workers
        Number of processes on this machine; the number of cores by default.
    repeat
        Only repeat the run of this number, with its table of metrics and figure.
    worst
        Number of worst runs to print.
    """
    from quell.setup import load
    from quell.setup.sweep import sweep_of

    given = load(setup, trust)
    plan = sweep_of(given)
    where = Path(f"{setup.stem}-sweep") if folder is None else folder
    console = Console()
    if repeat is not None:
        many = {"dask": (dask, None), "workers": (workers, None), "worst": (worst, _WORST)}
        refuse(many, "is for many runs; --repeat does one")
        _repeat(console, given, plan, repeat, where, outputs)
        return
    if outputs.save is not None:
        raise ValueError("--save is for the record of one run; give its number with --repeat")
    from quell.sweeping import sweep as run_sweep

    varied = [name for name, each in plan["parameters"].items() if _varies(each)]
    figures = {name: f"{setup.stem}-{_slug(name)}" for name in varied}
    outputs = check_outputs(outputs, list(figures.values()))
    # One process does no more than one thread of this one, and takes longer to start.
    if dask is not None and "://" not in dask:
        raise ValueError(f"dask = {dask!r}: must be the address of a scheduler, tcp://HOST:PORT")
    if dask is not None:
        refuse({"workers": (workers, None)}, "is for this machine; --dask names other workers")
    executor = dask or ("threads" if workers == 1 else "processes")
    with _progress(console) as report:
        try:
            found = run_sweep(
                **plan, folder=where, executor=executor, workers=workers, progress=report
            )
        except KeyboardInterrupt:
            print_line(console, f"The same command goes on with what is done, in {where}/.")
            raise
    results = summary(found, worst)
    where_option = "" if folder is None else f" --folder {folder}"
    print_summary(console, given.title, found, results, f"quell sweep {setup}{where_option}")
    paths = _save_figures(found, figures, outputs)
    write_results(console, {**results, "setup": given.as_json()}, outputs, paths)


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[float], None]]:
    """Show a progress bar with the time that remains; return the callback for the share done."""
    from rich.progress import TaskProgressColumn, TimeRemainingColumn

    with progress_bar(console, _LABEL, TaskProgressColumn(), TimeRemainingColumn()) as report:
        yield partial(report, _LABEL)


def _varies(given: Any) -> bool:
    from quell.sweeping.values import as_values

    values = as_values("", given)
    return not isinstance(values, tuple) or len(values) > 1


def _slug(name: str) -> str:
    return re.sub(r"[^\w]+", "-", name).strip("-")


def _save_figures(found: Sweep, figures: dict[str, str], outputs: RunOutputs) -> list[Path]:
    """Save the figure of each parameter; return the paths of the files."""
    from quell.experiments.common.figures import save_figure

    if outputs.figures is None:
        return []
    paths = []
    for parameter, name in figures.items():
        paths += save_figure(found.plot(parameter), outputs.figures, name, outputs.overwrite)
    return paths


def _repeat(
    console: Console,
    given: Setup,
    arguments: dict[str, Any],
    number: int,
    folder: Path,
    outputs: RunOutputs,
) -> None:
    """Repeat a run alone, print and draw it, and compare it with the stored measures."""
    from quell.simulation import simulate
    from quell.sweeping.sweep import parts_of

    name = f"{given.file.removesuffix('.toml')}-run-{number}"
    text, parts = parts_of(number, arguments)
    outputs = check_outputs(outputs, [name])
    with progress_bar(console, COMPILING) as report:
        run = simulate(*parts, progress=partial(report, COMPILING))
    scores = windowed_metrics(run, replace(given, scenario=parts.scenario, plant=parts.plant))
    print_metrics(console, f"{given.title}, {text}", scores)
    learned = print_outcome(console, run)
    same = stored_alike(folder, number, text, run, arguments["metrics"])
    if same is not None:
        print_line(console, f"In {folder}/: {'the same, bit for bit' if same else 'other values'}.")
    paths = save_run_figure(run, f"{given.title}, run {number}", outputs, name)
    write_record(console, run, outputs, "Record")
    results = {"run": text, "status": run.status.name or "OK", "metrics": scores}
    write_results(console, {**results, "as_stored": same, "learned": learned}, outputs, paths)
    exit_if_diverged([run])
