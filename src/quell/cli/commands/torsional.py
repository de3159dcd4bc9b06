"""``quell reproduce torsional``: run, print, write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quell.cli.output import check_places, compile_loops, progress_bar, write_results
from quell.experiments.torsional import figures as torsional_figures
from quell.experiments.torsional import setup as torsional
from quell.experiments.torsional import study as torsional_study
from quell.experiments.torsional.setup import PLANTS, Settings
from quell.experiments.torsional.study import Result

_COLUMNS = (
    ("overshoot", "overshoot [%]", 100.0, ".3f"),
    ("settling_time", "settling [s]", 1.0, ".3f"),
    ("control_variation", "variation [V]", 1.0, ".0f"),
)


def reproduce_torsional(
    *, dt: float, seed: int, json_file: Path | None, figures: Path | None
) -> None:
    """Run the experiment, print its tables, write what was asked for.

    Raises
    ------
    ValueError
        for settings out of range, or a place that can't be written to.
    """
    settings = Settings(dt=dt, seed=seed)
    check_places(json_file, figures)
    console = Console()
    loops = [
        (torsional.plant(kind), law)
        for kind in PLANTS
        for law in torsional.controllers(settings, *torsional.CASES[0]).values()
    ]
    compile_loops(console, loops)
    with progress_bar(console, width=15) as progress:
        result = torsional_study.run(settings, progress)
        paths = torsional_figures.save(result, figures, progress) if figures is not None else []
    _print(console, result)
    write_results(console, result.to_json(), json_file, paths, figures)


def _print(console: Console, result: Result) -> None:
    about = f"dt = {result.settings.dt:g} s, medians of {torsional.STARTS} starts, seed {result.settings.seed}"
    for case in result.cases:
        table = Table(
            title=f"omega_c/omega_o = {case.label} rad/s ({about})",
            title_justify="left",
            box=SIMPLE_HEAD,
        )
        table.add_column("plant", no_wrap=True)
        table.add_column("controller", no_wrap=True)
        for _, heading, _, _ in _COLUMNS:
            table.add_column(escape(heading), justify="right")
        for kind in PLANTS:
            for name, scores in case.outcomes[kind].scores.items():
                values = [_cell(scores[key], factor, form) for key, _, factor, form in _COLUMNS]
                table.add_row(kind, name, *values, end_section=name == torsional.NAMES[-1])
        console.print(table)
    console.print(
        "Profile to π in 2 s, after 40 s of training; settling (±0.2 %) from its start.\n"
        "friction: the twin with Coulomb friction; linear: as the paper identified it. The encoder has 16000 counts.\n"
    )
    _print_claims(console, result)
    for case in result.cases:
        for kind, outcome in case.outcomes.items():
            for name, run in outcome.records.items():
                if run.diverged:
                    console.print(f"{case.label}, {kind}, {name}: {run.message}")


def _print_claims(console: Console, result: Result) -> None:
    title = "Section V's claims: do they hold, with friction / linear?"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("claim")
    for case in result.cases:
        table.add_column(case.label, justify="right", no_wrap=True)
    judged = [
        tuple(zip(*(case.outcomes[kind].claims for kind in PLANTS), strict=True))
        for case in result.cases
    ]
    for row in zip(*judged, strict=True):
        cells = [
            " / ".join("[green]yes[/]" if claim.holds else "[red]no[/]" for claim in pair)
            for pair in row
        ]
        table.add_row(escape(row[0][0].claim), *cells)
    console.print(table)
    console.print(
        "Overshoots are told apart by a count, settling times by a sample. docs/theory explains each no.\n"
    )


def _cell(value: Any, factor: float, form: str) -> str:
    return "–" if value is None else format(factor * value, form)
