"""``quell reproduce acc``: run, print, write."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quell.cli.output import check_places, progress_bar, write_results
from quell.experiments.acc import figures as acc_figures
from quell.experiments.acc import samples as acc_samples
from quell.experiments.acc import study as acc
from quell.experiments.acc.cases import CaseResult
from quell.experiments.acc.controllers import DT, designs


def reproduce_acc(
    *,
    samples: Path | None,
    count: int | None,
    spread: float | None,
    seed: int | None,
    json_file: Path | None,
    figures: Path | None,
) -> None:
    """Run the benchmark, print its tables, write what was asked for.

    Raises
    ------
    ValueError
        for samples that can't be read or drawn, or are to be both, or a place that can't be written to.
    """
    if samples is None:
        spread, seed = 1.0 if spread is None else spread, seed or 0
        plants, source = (
            acc_samples.generated(1000 if count is None else count, spread, seed),
            f"generated, spread {spread:g}, seed {seed}",
        )
    elif not (count is None and spread is None and seed is None):
        raise ValueError(
            "--samples reads plants, --count, --spread and --seed are for drawing them: give one or the other"
        )
    else:
        plants, source = acc_samples.read(samples), samples.name
    check_places(json_file, figures)
    console = Console()
    with console.status(
        "Compiling what is not in the cache: about 20 seconds, once for this version."
    ):
        for controller in designs(DT).values():
            for cubic in (False, True):
                acc.judge_sampled(controller, plants[:1], cubic)
    with progress_bar(console, width=28) as progress:
        result = acc.run(plants, source, progress)
        paths = acc_figures.save(result, figures, progress) if figures is not None else []
    _print_rates(console, result)
    _print_cases(console, result)
    write_results(console, result.to_json(), json_file, paths, figures)


def _print_rates(console: Console, result: acc.Result) -> None:
    table = Table(
        title=f"Plants that fail, of {len(result.samples)} ({escape(result.source)})",
        title_justify="left",
        box=SIMPLE_HEAD,
    )
    table.add_column("controller", no_wrap=True)
    for spring in result.judged:
        for heading in (f"{spring}\n[%]", "95 % interval\n[%]"):
            table.add_column(heading, justify="right", no_wrap=True)
    for name in next(iter(result.judged.values())):
        cells = []
        for judged in result.judged.values():
            row = judged[name].to_json()
            low, high = row["ci95"]
            cells += [f"{100.0 * row['failure_rate']:.1f}", f"{100.0 * low:.2f}–{100.0 * high:.2f}"]
        table.add_row(name, *cells)
    console.print(table)
    console.print(
        "Fails: unstable, |y| > 0.1 m at any time from 15 s on, or |u| > 0.5 N at any time; 30 s after a unit impulse on m2.\n"
        f"Ours are sampled at {1e3 * DT:g} ms and limited to 0.5 N; the published are in continuous time, without limit. "
        f"{result.runs_per_second:.0f} runs of 30 s a second on all cores, {result.runs_per_second_one_core:.0f} on one.\n"
    )


def _print_cases(console: Console, result: acc.Result) -> None:
    table = Table(
        title="The original problem's design cases (m1 = m2 = 1 kg, no lag)",
        title_justify="left",
        box=SIMPLE_HEAD,
    )
    table.add_column("")
    for name in result.cases:
        table.add_column(name, justify="right", no_wrap=True)
    rows: tuple[tuple[str, Callable[[CaseResult], str]], ...] = (
        ("gain margin", lambda case: "{:.2f}–{:.2f}".format(*case.margins.gain)),
        ("phase margin [°]", lambda case: f"{case.margins.phase:.0f}"),
        ("modulus margin", lambda case: f"{case.margins.modulus:.2f}"),
        ("1: stable for k [N/m]", lambda case: f"{case.stable_from:.2f}–{case.stable_to:.2f}"),
        ("1: settled after impulse, k = 1 [s]", lambda case: _number(case.settled_at, ".1f")),
        (
            "1: the same, worst k from 0.5 to 2 [s]",
            lambda case: _number(case.settled_at_worst, ".1f"),
        ),
        (
            "2: stable for m1, m2, k, all within [%]",
            lambda case: f"±{100.0 * case.parameter_bound:.1f}",
        ),
        (
            "3: |y| under the load, from 20 s on [m]",
            lambda case: _number(case.load_peak, ".4f", "unstable"),
        ),
        (
            "3: the same, last period of 80 s [m]",
            lambda case: _number(case.load_remains, ".5f", "unstable"),
        ),
    )
    for label, cell in rows:
        table.add_row(escape(label), *map(cell, result.cases.values()))
    console.print(table)
    console.print(
        "Settled: |y| ≤ 0.1 m for good. Load: sin(0.5 t) N on m2, two phases, u not limited; worst k and phase."
    )


def _number(value: float, form: str, otherwise: str = "never") -> str:
    return format(value, form) if np.isfinite(value) else otherwise
