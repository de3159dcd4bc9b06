"""``quell stress``: run the guard's trial, print, write."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import TextColumn, TimeRemainingColumn
from rich.table import Table

from quell.cli.output import check_places, progress_bar, write_results
from quell.experiments.stress import figures as stress_figure
from quell.experiments.stress import study as stress
from quell.experiments.stress.study import HONEST, Outcome
from quell.guard import Guard


def run_stress(
    *,
    runs: int,
    honest: int,
    seed: int,
    guarded: bool,
    json_file: Path | None,
    figures: Path | None,
) -> None:
    """Run the trial, print its table, write what was asked for.

    Raises
    ------
    ValueError
        for settings out of range, or a place that can't be written to.
    """
    check_places(json_file, figures)
    console = Console()
    first = "simulating (the first run compiles for half a minute)"
    with progress_bar(
        console, first, TextColumn("{task.percentage:>3.0f} %"), TimeRemainingColumn()
    ) as progress:
        result = stress.run(
            runs,
            honest,
            seed,
            guard=Guard() if guarded else None,
            progress=partial(progress, "simulating"),
        )
    _print(console, result, guarded)
    paths = stress_figure.save(result, figures) if figures is not None else []
    write_results(console, result.to_json(), json_file, paths, figures)


def _print(console: Console, result: stress.Result, guarded: bool) -> None:
    how = "with guard" if guarded else "WITHOUT guard"
    table = Table(
        title=f"RMS error over that of MF-ESO in the same random loop, {how}",
        title_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    table.add_column("learner", no_wrap=True)
    for heading in (
        "runs",
        "lost",
        "whole\n50 %",
        "\n99 %",
        "\nmost",
        "load\n50 %",
        "\n99 %",
        "\nmost",
        "late\n50 %",
    ):
        table.add_column(heading, justify="right")
    for kind in result.kinds:
        if kind != HONEST:
            _row(table, kind, result.of(kind))
    if result.hostile:
        table.add_section()
        _row(table, "all adversaries", result.hostile)
    if result.of(HONEST):
        _row(table, "honest", result.of(HONEST))
    console.print(table)
    found = stress.summary(result.outcomes)
    console.print(
        f"Unstable loops: {found['unstable']}; with MF-ESO {found['plain_unstable']}; "
        f"lost, that is unstable where MF-ESO is stable: {found['unstable_where_plain_is_stable']}."
    )
    console.print(
        "Whole run: 150 s. Load: from 90 s on. Late: from 140 s on. Errors are against the response the design asks for.\n"
    )


def _row(table: Table, label: str, outcomes: list[Outcome]) -> None:
    found = stress.summary(outcomes)
    cells = [
        found[name][key] for name in ("ratio", "load_ratio") for key in ("median", "p99", "max")
    ] + [found["late_ratio"]["median"]]
    lost = found["unstable_where_plain_is_stable"]
    table.add_row(
        *(escape(label), str(found["runs"]), f"[red]{lost}[/]" if lost else "0"),
        *("–" if cell is None else f"{cell:.3f}" for cell in cells),
    )
