"""``quell reproduce torsional``."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

from rich.markup import escape

from quell.cli.exit_codes import exit_if_diverged
from quell.cli.options import OUTPUTS, Outputs, Whole
from quell.cli.output import (
    Column,
    Console,
    check_outputs,
    compile_loops,
    print_diverged,
    progress_bar,
    table,
    write_results,
    yes_or_no,
)

if TYPE_CHECKING:
    from quell.experiments.torsional.study import Case, Result

_COLUMNS = (
    Column("overshoot", "overshoot [%]", 100.0, ".3f"),
    Column("settling_time", "settling [s]", 1.0, ".3f"),
    Column("control_variation", "variation [V]", 1.0, ".0f"),
)


def torsional(*, dt: float = 1e-3, seed: Whole = 0, outputs: Outputs = OUTPUTS) -> None:
    """Run the torsional testbed's experiment on its twin, with every claim judged.

    Parameters
    ----------
    dt
        Sample time [s].
    seed
        Seed of the positions between two edges of the encoder in which the runs start.
    """
    from quell.experiments.torsional import figures, setup, study

    settings = setup.Settings(dt=dt, seed=seed)
    outputs = check_outputs(outputs, figures.NAMES)
    console = Console()
    controllers = setup.controllers(settings, *setup.CASES[0]).values()
    plants = [setup.plant(kind) for kind in setup.PLANTS]
    compile_loops(console, list(product(plants, controllers)))
    with progress_bar(console, width=15) as report:
        result = study.run(settings, report)
        paths = []
        if outputs.figures:
            paths = figures.save(result, outputs.figures, report, outputs.overwrite)
    about = f"dt = {dt:g} s, medians of {setup.STARTS} starts, seed {seed}"
    for case in result.cases:
        _print_scores(console, case, about)
    console.print(
        "Profile to π in 2 s, after 40 s of training; settling (±0.2 %) from its start.\n"
        "friction: the twin with Coulomb friction; linear: as the paper identified it. The encoder "
        "has 16000 counts. –: not settled from each start, or diverged before.\n"
    )
    _print_claims(console, result)
    for case in result.cases:
        for kind, outcome in case.outcomes.items():
            runs = {f"{case.label}, {kind}, {name}": run for name, run in outcome.records.items()}
            print_diverged(console, runs)
    write_results(console, result.to_json(), outputs, paths)
    outcomes = [outcome for case in result.cases for outcome in case.outcomes.values()]
    exit_if_diverged(run for outcome in outcomes for run in outcome.records.values())


def _print_scores(console: Console, case: Case, about: str) -> None:
    headings = ("plant", "controller", *(column.heading for column in _COLUMNS))
    rows = table(f"omega_c/omega_o = {case.label} rad/s ({about})", *headings, left=2)
    for kind, outcome in case.outcomes.items():
        for name, scores in outcome.scores.items():
            rows.add_row(kind, name, *(column.cell(scores) for column in _COLUMNS))
        rows.add_section()
    console.print(rows)


def _print_claims(console: Console, result: Result) -> None:
    labels = [case.label for case in result.cases]
    rows = table("Claims of section V: do they hold, with friction / linear?", "claim", *labels)
    kinds = [outcome.claims for case in result.cases for outcome in case.outcomes.values()]
    count = len(kinds) // len(labels)
    for claims in zip(*kinds, strict=True):
        answers = [yes_or_no(claim.holds) for claim in claims]
        cells = [" / ".join(answers[i : i + count]) for i in range(0, len(answers), count)]
        rows.add_row(escape(claims[0].claim), *cells)
    console.print(rows)
    console.print(
        "Overshoots that differ by a count, and settling times that differ by a sample, are "
        "different. docs/theory explains each no.\n"
    )
