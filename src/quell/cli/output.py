"""Output of commands: tables, progress bars, result files."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import rich.console
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from quell.cli.options import FIGURES, Outputs, ResultOutputs, RunOutputs

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

    from quell.controllers import Controller
    from quell.plants import Plant
    from quell.records.trajectory import Trajectory
    from quell.types import Progress as ProgressCallback

T = TypeVar("T", bound=ResultOutputs)

COMPILING = "simulating (the first run compiles for some seconds)"
"""Label of a progress bar until the first samples are done."""


class Console(rich.console.Console):
    """The standard output; when its reader ends, as ``| head`` does, the work goes on silently."""

    def on_broken_pipe(self) -> None:
        """Print nothing any more: without this, rich ends the process."""
        self.quiet = True
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


class Column(NamedTuple):
    """A column of a table of scores."""

    key: str  # key of the score
    heading: str  # heading of the column, with the unit
    factor: float  # factor from the score's unit to the column's
    form: str  # format of the number

    def cell(self, scores: Mapping[str, Any]) -> str:
        """Return the score as text, a dash where it is missing."""
        return number(scores.get(self.key), self.form, self.factor)


def number(value: float | None, form: str, factor: float = 1.0) -> str:
    """Return ``factor * value`` in a format, a dash for None."""
    return "–" if value is None else format(factor * value, form)


def table(title: str, *headings: str, left: int = 1, **options: Any) -> Table:
    """Return an empty table whose first ``left`` columns are text and whose others are numbers."""
    made = Table(title=escape(title), title_justify="left", box=SIMPLE_HEAD, **options)
    for i, heading in enumerate(headings):
        made.add_column(escape(heading), justify="left" if i < left else "right", no_wrap=i >= left)
    return made


def yes_or_no(holds: bool) -> str:
    """Return a cell that shows whether a claim holds."""
    return "[green]yes[/]" if holds else "[red]no[/]"


def print_diverged(console: Console, runs: Mapping[str, Trajectory]) -> None:
    """Print the message of each run that diverged, or whose y ran away."""
    for name, run in runs.items():
        if run.lost:
            print_line(console, f"{name}: {run.message}")


def print_line(console: Console, text: str) -> None:
    """Print text as it is: without markup, and without line breaks at the console's width."""
    console.print(escape(text), soft_wrap=True)


def check_outputs(outputs: T, figures: Sequence[str] = (), recordings: Sequence[Path] = ()) -> T:
    """Check, before the work is done, that the results can be written; create the figures' folder.

    Return the outputs with the folder for the figures, whose names are given. ``recordings`` are
    further files, which somebody else checks.

    Raises
    ------
    ValueError
        for a record whose name ends neither in .nc nor in .csv; for a file that exists, unless
        ``outputs.overwrite``; that cannot be written; or that two outputs have in common; or a
        folder that cannot be created.
    """
    from quell.experiments.common import figure_files, make_folder
    from quell.files import check_writable, new_folder

    if isinstance(outputs, RunOutputs):
        _check_record(outputs.save)
    named = (outputs.json, outputs.save if isinstance(outputs, RunOutputs) else None)
    files = [file for file in named if file is not None]
    folder = outputs.figures if isinstance(outputs, Outputs) else None
    if folder is not None and folder is not FIGURES:
        files += figure_files(make_folder(folder), figures)
    for file in files:
        check_writable(file, outputs.overwrite)
    places = [file.absolute() for file in (*files, *recordings)]
    for file in places:
        if places.count(file) > 1:
            raise ValueError(f"path = {str(file)!r}: must be a file for one output, is for two")
    if isinstance(outputs, Outputs) and folder is FIGURES:
        return replace(outputs, figures=new_folder(FIGURES))
    return outputs


# Endings of a record's file, and what writes each.
_RECORDS = (".nc", ".csv")


def _check_record(path: Path | None) -> None:
    if path is not None and path.suffix.lower() not in _RECORDS:
        rule = "must end in .nc, for NetCDF, or in .csv, for text with names and units"
        raise ValueError(f"--save = {str(path)!r}: {rule}")


def compile_loops(console: Console, loops: Sequence[tuple[Plant, Controller]]) -> None:
    """Compile the loops of a study, or load them from the cache; print how long compiling took."""
    from quell.kernels.cache import compile_time
    from quell.simulation.simulate import precompile

    began = time.perf_counter()
    with console.status("Compiling what is not in the cache: some ten seconds, once."):
        compiled = precompile(loops)
    if compiled:
        took = time.perf_counter() - began
        console.print(f"Compiled {compiled} loops in {took:.1f} s; later runs use them.")
        compile_time.seconds = compile_time.told = 0.0


# Time between two lines of progress where nobody sees a bar [s].
_EVERY = 5.0


@contextmanager
def progress_bar(
    console: Console, first: str = "simulating", *more: ProgressColumn, width: int = 0
) -> Iterator[ProgressCallback]:
    """Show a progress bar while the work goes on, and return the callback that moves it.

    In a pipe there is a line on stderr every 5 s instead, from the tenth second on with the time
    that is left at the present pace.

    ``first`` is the label until the first call, of at least ``width`` characters; ``more`` are
    further columns of the bar.
    """
    from rich.progress import BarColumn, Progress, TextColumn

    if not console.is_terminal:
        yield from _lines_of_progress(first)
        return
    label = TextColumn(f"{{task.description:<{width}}}")
    with Progress(label, BarColumn(), *more, console=console, transient=True) as bar:
        task = bar.add_task(first, total=1.0)
        yield lambda what, share: bar.update(task, description=what, completed=share)


def _lines_of_progress(first: str) -> Iterator[ProgressCallback]:
    """Print a line every few seconds, from a thread; yield the callback that changes it."""
    began, ended, now = time.monotonic(), threading.Event(), [(first, 0.0)]

    def print_lines() -> None:
        while not ended.wait(_EVERY):
            (what, share), passed = now[0], time.monotonic() - began
            text = f"{what}, {100.0 * share:.0f} %, {passed:.0f} s"
            if passed >= 2.0 * _EVERY and 0.1 < share < 1.0:
                text += f", about {passed * (1.0 - share) / share:.0f} s left"
            print(text, file=sys.stderr, flush=True)

    def report(what: str, share: float) -> None:
        now[0] = what, share

    thread = threading.Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield report
    finally:
        ended.set()
        thread.join()


def write_record(console: Console, run: Trajectory, outputs: RunOutputs, name: str) -> None:
    """Write a record where that is asked for, and print where it is."""
    if outputs.save is not None and len(run):
        is_text = outputs.save.suffix.lower() == ".csv"
        (run.to_csv if is_text else run.save)(outputs.save, outputs.overwrite)
        print_line(console, f"{name}: {outputs.save}")


def write_results(
    console: Console, results: dict[str, Any], outputs: ResultOutputs, figures: Sequence[Path] = ()
) -> None:
    """Write the results to the JSON file, if any; print where they and the figures are."""
    from quell.files import write_json

    if figures and isinstance(outputs, Outputs):
        names = sorted({path.stem for path in figures})
        noun = "Figures" if len(names) > 1 else "Figure"
        print_line(console, f"{noun}: {', '.join(names)} (PNG, SVG, PDF) in {outputs.figures}/")
    if outputs.json is not None:
        write_json(outputs.json, results, outputs.overwrite)
        print_line(console, f"Results: {outputs.json}")
