"""``quell compare``: run chosen controllers on one plant, print, write."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quell.analysis import analyse
from quell.cli.output import check_places, progress_bar, write_results
from quell.experiments.compare import figures as compare_figure
from quell.experiments.compare import study as compare
from quell.experiments.compare.study import BAND, END, FORCE, FORCE_AT, Benchmark, Comparison
from quell.plants import two_mass_spring

_COLUMNS = (
    ("overshoot", "over-\nshoot\n[%]", 100.0, 2),
    ("settling_time", "settling\n[s]", 1.0, 2),
    ("disturbance_peak", "peak\n[m]", 1.0, 4),
    ("rms", "RMS\n[m]", 1.0, 4),
    ("control_variation", "vari-\nation\n[N]", 1.0, 2),
)
# A number may take so many places, for the table to fit into 80.
_PLACES = 6


def run_compare(
    *, controllers: str, settings: Benchmark, json_file: Path | None, figures: Path | None
) -> None:
    """Run the comparison, print its table, write what was asked for.

    Raises
    ------
    ValueError
        for an unknown controller, or a place that can't be written to.
    """
    names = list(dict.fromkeys(name.strip() for name in controllers.split(",") if name.strip()))
    if not names:
        raise ValueError(
            f"controllers = {controllers!r}: must be names with commas between, of {', '.join(compare.NAMES)}"
        )
    # What can't be designed or written is said before the work is done.
    stable = {
        name: _stable(compare.controller(name, settings.dt, settings.u_max), settings)
        for name in names
    }
    check_places(json_file, figures)
    console = Console()
    what = "simulating (the first run compiles for some seconds)"
    with progress_bar(console, what) as progress:
        result = compare.two_mass(settings, names, partial(progress, what))
    _print(console, result, settings, stable)
    paths = compare_figure.save(result, figures) if figures is not None else []
    about = {
        "m1": settings.m1,
        "m2": settings.m2,
        "k": settings.k,
        "dt": settings.dt,
        "seed": settings.seed,
    }
    limit = {} if settings.u_max == float("inf") else {"u_max": settings.u_max}
    found = result.to_json()
    for name, told in found["controllers"].items():
        told["stable"] = stable[name]
    write_results(console, {"settings": about | limit, **found}, json_file, paths, figures)


def _stable(controller: Any, settings: Benchmark) -> bool | None:
    """Return whether the linear loop is stable; None for a controller that learns, whose loop is not one."""
    inner = getattr(controller, "controller", controller)  # a prefilter is outside of the loop
    if inner.features:
        return None
    return bool(analyse(two_mass_spring(settings.m1, settings.m2, settings.k), inner).stable)


def _print(
    console: Console, result: Comparison, settings: Benchmark, stable: dict[str, bool | None]
) -> None:
    title = f"Designed for m1 = m2 = k = 1, run on {settings.m1:g}, {settings.m2:g}, {settings.k:g}"
    table = Table(
        title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    table.add_column("controller", no_wrap=True)
    for _, heading, _, _ in _COLUMNS:
        table.add_column(escape(heading), justify="right", no_wrap=True)
    table.add_column("status")
    for name, score in result.scores.items():
        values = [(score[key], factor, decimals) for key, _, factor, decimals in _COLUMNS]
        cells = [
            "–" if value is None else _short(factor * value, decimals)
            for value, factor, decimals in values
        ]
        run = result.runs[name]
        status = (run.status.name or "OK").lower().replace("_", " ").replace("|", ", ")
        if run.diverged:
            status = f"[red]diverged {run.ended:.0f} s[/]"
        elif stable[name] is False:
            status = "[red]unstable[/]"
        table.add_row(escape(name), *cells, status)
    console.print(table)
    limit = "u not limited" if settings.u_max == float("inf") else f"|u| up to {settings.u_max:g} N"
    console.print(
        f"Unit step from rest, judged until {FORCE_AT:g} s (settling ±{100.0 * BAND:g} %); {FORCE:g} N on m2 from then on (peak). "
        f"RMS and variation: all {END:g} s. dt = {settings.dt:g} s, {limit}. –: not reached. "
        "Unstable: the linear loop has a pole that grows, be it slowly.",
        soft_wrap=True,
    )


def _short(value: float, decimals: int) -> str:
    """Return a number in few places: with as many of the decimals as there is room for, where a loop is unstable as 4.9e4."""
    for left in range(decimals, -1, -1):
        text = f"{value:.{left}f}"
        if len(text) <= _PLACES:
            return text
    digits, _, power = f"{value:.1e}".partition("e")
    return f"{digits}e{int(power)}"
