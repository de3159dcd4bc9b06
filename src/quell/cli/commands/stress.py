"""``quell stress``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

from quell.cli.options import OUTPUTS, Outputs, Whole
from quell.cli.output import check_outputs, number, progress_bar, table, write_results

if TYPE_CHECKING:
    from quell.experiments.stress.study import Result

_HEADINGS = (
    *("learner", "runs", "lost"),
    *("whole\n50 %", "\n99 %", "\nmost"),
    *("load\n50 %", "\n99 %", "\nmost", "late\n50 %"),
)


def stress(
    *,
    runs: Whole = 600,
    honest: Whole = 100,
    seed: Whole = 0,
    guard: bool = True,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Test the guard: hostile learners and an honest one in random loops, each beside plain MF-ESO.

    Parameters
    ----------
    runs
        How many runs with hostile learners, all kinds in turn.
    honest
        How many runs with the honest learner.
    seed
        Seed of all that is random.
    guard
        With the guard, or without it, for comparison.
    """
    from rich.progress import TextColumn, TimeRemainingColumn

    from quell.experiments.stress import figures, study
    from quell.guard import Guard

    outputs = check_outputs(outputs, ["stress"])
    console = Console()
    first = "simulating (the first run compiles for half a minute)"
    columns = (TextColumn("{task.percentage:>3.0f} %"), TimeRemainingColumn())
    with progress_bar(console, first, *columns) as report:
        used, progress = Guard() if guard else None, partial(report, "simulating")
        result = study.run(runs, honest, seed, guard=used, progress=progress)
    _print(console, result, guard)
    paths = figures.save(result, outputs.figures, outputs.overwrite) if outputs.figures else []
    write_results(console, result.to_json(), outputs, paths)


def _print(console: Console, result: Result, guarded: bool) -> None:
    from quell.experiments.stress.study import HONEST, summary

    how = "with guard" if guarded else "WITHOUT guard"
    title = f"RMS error over that of MF-ESO in the same random loop, {how}"
    rows = table(title, *_HEADINGS, padding=(0, 1, 0, 0), pad_edge=False)
    groups = [(kind, result.of(kind)) for kind in result.kinds if kind != HONEST]
    totals = [("all adversaries", result.hostile), ("honest", result.of(HONEST))]
    for label, outcomes in (*groups, *totals):
        if not outcomes:
            continue
        if label == totals[0][0]:
            rows.add_section()
        found = summary(outcomes)
        keys = ("median", "p99", "max")
        ratios = [found[name][key] for name in ("ratio", "load_ratio") for key in keys]
        cells = [number(ratio, ".3f") for ratio in (*ratios, found["late_ratio"]["median"])]
        lost = found["unstable_where_plain_is_stable"]
        lost_cell = f"[red]{lost}[/]" if lost else "0"
        rows.add_row(escape(label), str(found["runs"]), lost_cell, *cells)
    console.print(rows)
    found = summary(result.outcomes)
    console.print(
        f"Unstable loops: {found['unstable']}; with MF-ESO {found['plain_unstable']}; "
        f"lost, that is unstable where MF-ESO is stable: {found['unstable_where_plain_is_stable']}."
    )
    console.print(
        "Whole run: 150 s. Load: from 90 s on. Late: from 140 s on. Errors are against the "
        "response the design asks for.\n"
    )
