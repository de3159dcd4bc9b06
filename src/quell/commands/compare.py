"""``quell compare``: run chosen controllers on one plant, print, write."""

from __future__ import annotations

from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from quell.experiments import compare, compare_figure
from quell.experiments.compare import BAND, END, FORCE, FORCE_AT, Benchmark, Comparison
from quell.experiments.figures import made
from quell.files import check_writable, write_json

_COLUMNS = (
    ("overshoot", "overshoot\n[%]", 100.0, ".2f"),
    ("settling_time", "settling\n[s]", 1.0, ".2f"),
    ("disturbance_peak", "peak\n[m]", 1.0, ".4f"),
    ("rms", "RMS\n[m]", 1.0, ".4f"),
    ("control_variation", "variation\n[N]", 1.0, ".2f"),
)


def run_compare(*, controllers: str, settings: Benchmark, json_file: Path | None, figures: Path | None) -> None:
    """Run the comparison, print its table, write what was asked for.

    Raises
    ------
    ValueError
        for an unknown controller, or a place that can't be written to.
    """
    names = list(dict.fromkeys(name.strip() for name in controllers.split(",") if name.strip()))
    if not names:
        raise ValueError(f"controllers = {controllers!r}: must be names with commas between, of {', '.join(compare.NAMES)}")
    # What can't be designed or written is said before the work is done.
    for name in names:
        compare.controller(name, settings.dt, settings.u_max)
    if json_file is not None:
        check_writable(json_file)
    if figures is not None:
        made(figures)
    console = Console()
    with Progress(TextColumn("{task.description}"), BarColumn(), console=console, transient=True) as bar:
        task = bar.add_task("simulating (the first run compiles for some seconds)", total=1.0)
        result = compare.two_mass(settings, names, lambda share: bar.update(task, completed=share))
    _print(console, result, settings)
    if figures is not None:
        compare_figure.save(result, figures)
        console.print(f"Figure: compare (PNG and SVG) in {escape(str(figures))}/", soft_wrap=True)
    if json_file is not None:
        about = {"m1": settings.m1, "m2": settings.m2, "k": settings.k, "dt": settings.dt, "seed": settings.seed}
        limit = {} if settings.u_max == float("inf") else {"u_max": settings.u_max}
        write_json(json_file, {"settings": about | limit, **result.to_json()})
        console.print(f"Results: {escape(str(json_file))}", soft_wrap=True)


def _print(console: Console, result: Comparison, settings: Benchmark) -> None:
    title = f"Designed for m1 = m2 = k = 1, run on {settings.m1:g}, {settings.m2:g}, {settings.k:g}"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("controller", no_wrap=True)
    for _, heading, _, _ in _COLUMNS:
        table.add_column(heading, justify="right")
    table.add_column("status", no_wrap=True)
    for name, score in result.scores.items():
        values = [(score[key], factor, form) for key, _, factor, form in _COLUMNS]
        cells = ["–" if value is None else _short(factor * value, form) for value, factor, form in values]
        run = result.runs[name]
        status = f"[red]diverged at {run.ended:.1f} s[/]" if run.diverged else (run.status.name or "OK").lower().replace("_", " ")
        table.add_row(escape(name), *cells, status)
    console.print(table)
    limit = "u not limited" if settings.u_max == float("inf") else f"|u| up to {settings.u_max:g} N"
    console.print(
        f"Unit step from rest, judged until {FORCE_AT:g} s (settling ±{100.0 * BAND:g} %); {FORCE:g} N on m2 from then on (peak). "
        f"RMS and variation: all {END:g} s. dt = {settings.dt:g} s, {limit}. –: not reached.",
        soft_wrap=True,
    )


def _short(value: float, form: str) -> str:
    """Keep columns narrow where a loop is unstable."""
    return format(value, form if abs(value) < 1000.0 else ".1e")
