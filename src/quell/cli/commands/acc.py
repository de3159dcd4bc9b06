"""``quell reproduce acc``."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from quell.cli.options import OUTPUTS, MaxSize, Outputs, Switch, WholeOrNone
from quell.cli.output import (
    Console,
    check_outputs,
    compile_loops,
    progress_bar,
    table,
    write_results,
)
from quell.reading import MAX_SIZE

if TYPE_CHECKING:
    from quell.experiments.acc.cases import CaseResult
    from quell.experiments.acc.study import Result


def acc(
    *,
    samples: Path | None = None,
    count: WholeOrNone = None,
    spread: float | None = None,
    seed: WholeOrNone = None,
    box: Switch = False,
    max_size: MaxSize = MAX_SIZE,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Run the ACC robust-control benchmark: one fixed controller for many uncertain plants.

    Parameters
    ----------
    samples
        Read the plants from this CSV file (columns m1, m2, k_lin, k_nonlin, lambda, tau) instead of
        drawing them.
    count
        How many plants are drawn: 1000 by default.
    spread
        How uncertain those are: 1, the default, is the published small uncertainty; at 3 the best
        published design fails about half of them.
    seed
        Seed of the plants: 0 by default.
    box
        Draw m1 and m2 from 0.6 to 1.4 kg and k from 0.5 to 2 N/m, the rest with a spread of 3.
    """
    from quell.experiments.acc import figures, study
    from quell.experiments.acc import samples as plant_samples
    from quell.experiments.acc.controllers import DT, designs

    if box and not (samples is None and spread is None):
        raise ValueError(
            "--box draws the plants with a spread of its own: --samples and --spread exclude it"
        )
    if box:
        plants = plant_samples.boxed(1000 if count is None else count, seed or 0)
        source = f"box, seed {seed or 0}"
    elif samples is None:
        spread, seed = 1.0 if spread is None else spread, seed or 0
        plants = plant_samples.generated(1000 if count is None else count, spread, seed)
        source = f"generated, spread {spread:g}, seed {seed}"
    elif not (count is None and spread is None and seed is None):
        others = "--count, --spread and --seed are for drawing them"
        raise ValueError(f"--samples reads plants, {others}: give one or the other")
    else:
        plants, source = plant_samples.read(samples, max_size), samples.name
    outputs = check_outputs(outputs, figures.NAMES)
    console = Console()
    first = [plant_samples.plant(plants[0], cubic) for cubic in (False, True)]
    compile_loops(console, list(product(first, designs(DT).values())))
    with progress_bar(console, width=28) as report:
        result = study.run(plants, source, report)
        paths = []
        if outputs.figures:
            paths = figures.save(result, outputs.figures, report, outputs.overwrite)
    _print_rates(console, result, DT)
    _print_cases(console, result)
    write_results(console, result.to_json(), outputs, paths)


def _print_rates(console: Console, result: Result, dt: float) -> None:
    units = ("[%]", "95 % interval [%]")
    headings = [f"{spring}\n{unit}" for spring in result.judged for unit in units]
    title = f"Plants that fail, of {len(result.samples)} ({result.source})"
    rows = table(title, "controller", *headings)
    for name in next(iter(result.judged.values())):
        cells = []
        for judged in result.judged.values():
            row = judged[name].to_json()
            low, high = row["ci95"]
            cells += [f"{100.0 * row['failure_rate']:.1f}", f"{100.0 * low:.2f}–{100.0 * high:.2f}"]
        rows.add_row(name, *cells)
    console.print(rows)
    console.print(
        "A plant fails where the loop is unstable, |y| > 0.1 m at any time from 15 s on, or |u| > "
        "0.5 N at any time; 30 s after a unit impulse on m2.\n"
        f"Ours are sampled at {1e3 * dt:g} ms and limited to 0.5 N; the published are in "
        f"continuous time, without limit. {result.runs_per_second:.0f} runs of 30 s a second on "
        f"all cores, {result.runs_per_second_one_core:.0f} on one.\n"
    )


def _print_cases(console: Console, result: Result) -> None:
    lost = "unstable"
    lines: tuple[tuple[str, Callable[[CaseResult], str]], ...] = (
        ("gain margin", lambda c: "{:.2f}–{:.2f}".format(*c.margins.gain)),
        ("phase margin [°]", lambda c: f"{c.margins.phase:.0f}"),
        ("modulus margin", lambda c: f"{c.margins.modulus:.2f}"),
        ("1: stable for k [N/m]", lambda c: f"{c.stable_from:.2f}–{c.stable_to:.2f}"),
        ("1: settled after impulse, k = 1 [s]", lambda c: _number(c.settled_at, ".1f")),
        ("1: the same, worst k from 0.5 to 2 [s]", lambda c: _number(c.settled_at_worst, ".1f")),
        ("2: stable for m1, m2, k, all within [%]", lambda c: f"±{100.0 * c.parameter_bound:.1f}"),
        ("3: |y| under the load, from 20 s on [m]", lambda c: _number(c.load_peak, ".4f", lost)),
        ("3: the same, last period of 80 s [m]", lambda c: _number(c.load_remains, ".5f", lost)),
    )
    title = "The original problem's design cases (m1 = m2 = 1 kg, no lag)"
    rows = table(title, "", *result.cases)
    for label, cell in lines:
        rows.add_row(escape(label), *map(cell, result.cases.values()))
    console.print(rows)
    console.print(
        "Settled: |y| ≤ 0.1 m for good. Load: sin(0.5 t) N on m2, two phases, u not limited; worst "
        "k and phase."
    )


def _number(value: float, form: str, otherwise: str = "never") -> str:
    return format(value, form) if math.isfinite(value) else otherwise
