"""``quell reproduce``: published experiments."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from quell.cli.exit_codes import exit_if_diverged
from quell.cli.options import OUTPUTS, MaxSize, Outputs, Switch, Whole, WholeOrNone
from quell.cli.output import (
    Column,
    Console,
    check_outputs,
    compile_loops,
    number,
    print_diverged,
    progress_bar,
    table,
    write_results,
    yes_or_no,
)
from quell.files import MAX_SIZE

if TYPE_CHECKING:
    from quell.experiments.acc.loops import CaseResult
    from quell.experiments.acc.study import Result as AccResult
    from quell.experiments.torsional import Case
    from quell.experiments.torsional import Result as TorsionalResult
    from quell.experiments.two_mass_spring import Range, Result

# ---- quell reproduce two-mass ----

_COLUMNS = (
    Column("overshoot", "overshoot\n[‰]", 1e3, ".2f"),
    Column("settling_time", "settling\n[s]", 1.0, ".2f"),
    Column("disturbance_peak", "peak\n[m]", 1.0, ".4f"),
    Column("disturbance_rms", "RMS\n[m]", 1.0, ".4f"),
    Column("control_variation", "variation\n[N]", 1.0, ".1f"),
    Column("m_s", "M_s", 1.0, ".2f"),
    Column("m_ks", "M_ks\n[N/m]", 1.0, ".0f"),
)
# Of the table over seeds; the three peaks are under forces of 0.1, 0.1π and 0.8 rad/s.
_RANGES = (
    Column("overshoot", "over-\nshoot\n[‰]", 1e3, ".2f"),
    Column("settling_time", "settl.\n\n[s]", 1.0, ".2f"),
    Column("peak_at_0.1", "peak\n0.1\n[m]", 1.0, ".4f"),
    Column("peak_at_0.314", "peak\n0.314\n[m]", 1.0, ".4f"),
    Column("peak_at_0.8", "peak\n0.8\n[m]", 1.0, ".4f"),
    Column("control_variation", "varia-\ntion\n[N]", 1.0, ".1f"),
    Column("m_s", "M_s", 1.0, ".2f"),
    Column("m_ks", "M_ks\n\n[N/m]", 1.0, ".0f"),
)


def two_mass(
    *,
    dt: float = 1e-3,
    seed: Whole = 0,
    omega_o: float = 10.0,
    reset: bool = True,
    seeds: Whole = 1,
    outputs: Outputs = OUTPUTS,
) -> None:
    """Run the two-mass-spring study: MF-ESO, MB-ESO and L-ESO, with every claim judged.

    Three rows are not in the paper: observers that estimate f and f', without a learner, and L-ESO
    with a guard. With --seeds a table follows that has parts of learners, Harmonic, Algorithm 1
    without u and observers that estimate f'', too.

    Parameters
    ----------
    dt
        Sample time [s].
    seed
        Seed of the measurement noise.
    omega_o
        Observer bandwidth [rad/s].
    reset
        Start the loop from rest at 110 s, before the step.
    seeds
        With more than 1: means and 95 % intervals over so many seeds, from --seed on, under forces
        of three frequencies. 10 seeds take about half a minute, and more to compile once.
    """
    from quell.experiments import two_mass_spring as study
    from quell.plants import two_mass_spring

    settings = study.Settings(dt=dt, seed=seed, omega_o=omega_o, reset=reset, seeds=seeds)
    try:
        controllers = study.controllers(settings)
        if seeds > 1:
            controllers = study.all_controllers(settings)
    except ValueError as error:
        raise ValueError(f"{error} (the study goes up to 3 times omega_o)") from None
    outputs = check_outputs(outputs, study.FIGURE_NAMES)
    console = Console()
    compile_loops(console, [(two_mass_spring(), each) for each in controllers.values()])
    with progress_bar(console, width=15) as report:
        result = study.run(settings, report)
        paths = []
        if outputs.figures:
            paths = study.save(result, outputs.figures, report, outputs.overwrite)
    _print_claims(console, result)
    _print_scores(console, result)
    if result.ranges is not None:
        _print_ranges(console, result)
    write_results(console, result.to_json(), outputs, paths)
    exit_if_diverged(result.runs.values())


def _print_claims(console: Console, result: Result) -> None:
    title = "Claims of section IV of the paper, and what is measured here"
    claims = table(title, "claim", "paper", "holds when", "measured", "holds")
    for claim in result.claims:
        paper = claim.paper if isinstance(claim.paper, str) else f"{claim.paper:g}"
        measured = "not reached" if claim.measured is None else _short(claim.measured)
        name = f"{claim.claim} \\[{claim.unit}]" if claim.unit else claim.claim
        claims.add_row(name, paper, claim.rule, measured, yes_or_no(claim.holds))
    console.print(claims)
    console.print("docs/claims explains each no.\n")


def _print_scores(console: Console, result: Result) -> None:
    from quell.experiments.two_mass_spring import TWO_STATES

    settings = result.settings
    reset = "with" if settings.reset else "without"
    about = f"dt = {settings.dt:g} s, seed {settings.seed}, omega_o = {settings.omega_o:g} rad/s"
    headings = ("controller", *(column.heading for column in _COLUMNS))
    # With so little white space 80 columns hold all names.
    tight: dict[str, Any] = {"padding": (0, 1, 0, 0), "pad_edge": False}
    scores = table(f"All controllers ({about}, {reset} reset)", *headings, **tight)
    for name, score in result.scores.items():
        scores.add_row(name, *(column.cell(score) for column in _COLUMNS))
    console.print(scores)
    console.print(
        "Overshoot, settling (±0.2 %) and variation: step, 110–150 s. Peak and RMS of y − 1: force "
        "on m2, 170–250 s. M_s and M_ks at the end, with the learner's adaptation. –: not settled, "
        "diverged before, or not stable at rest. m = 2: observers without learner that estimate f "
        f"and f', at {TWO_STATES:g} omega_o.\n"
    )
    print_diverged(console, result.runs)


def _print_ranges(console: Console, result: Result) -> None:
    from quell.experiments.two_mass_spring import LOADS, THREE_STATES, TWO_STATES

    settings = result.settings
    last = settings.seed + settings.seeds - 1
    tight: dict[str, Any] = {"padding": (0, 1, 0, 0), "pad_edge": False}
    headings = ("controller", *(column.heading for column in _RANGES))
    about = f"Means over the seeds {settings.seed} to {last}"
    shown = table(f"{about}, ± the half width of their 95 % interval", *headings, **tight)
    for name, found in (result.ranges or {}).items():
        shown.add_row(name, *(_range_cell(column, found[column.key]) for column in _RANGES))
    console.print(shown)
    loads = ", ".join(f"{load:.3g}" for load in LOADS)
    console.print(
        f"Peaks of y − 1 under forces of {loads} rad/s, 170–250 s. ±: where it shows in the "
        f"digits. –: not in every run. m = 2 and 3: at {TWO_STATES:g} and {THREE_STATES:g} "
        "omega_o.\n"
    )


def _range_cell(column: Column, found: Range) -> str:
    """Return the mean, and below it the half width of its interval where it shows."""
    mean = number(found.mean, column.form, column.factor)
    half = number(found.half_width or 0.0, column.form, column.factor)
    return f"{mean}\n±{half}" if float(half) > 0.0 else mean


def _short(value: float) -> str:
    return f"{value:.4f}" if abs(value) < 10.0 else f"{value:.2f}"


# ---- quell reproduce torsional ----

_COLUMNS_TORSIONAL = (
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
    from quell.experiments import torsional as study

    settings = study.Settings(dt=dt, seed=seed)
    outputs = check_outputs(outputs, study.FIGURE_NAMES)
    console = Console()
    controllers = study.controllers(settings, *study.CASES[0]).values()
    plants = [study.plant(kind) for kind in study.PLANTS]
    compile_loops(console, list(product(plants, controllers)))
    with progress_bar(console, width=15) as report:
        result = study.run(settings, report)
        paths = []
        if outputs.figures:
            paths = study.save(result, outputs.figures, report, outputs.overwrite)
    about = f"dt = {dt:g} s, medians of {study.STARTS} starts, seed {seed}"
    for case in result.cases:
        _print_scores_torsional(console, case, about)
    console.print(
        "Profile to π in 2 s, after 40 s of training; settling (±0.2 %) from its start.\n"
        "friction: the twin with Coulomb friction; linear: as the paper identified it. The encoder "
        "has 16000 counts. –: not settled from each start, or diverged before.\n"
    )
    _print_claims_torsional(console, result)
    for case in result.cases:
        for kind, outcome in case.outcomes.items():
            runs = {f"{case.label}, {kind}, {name}": run for name, run in outcome.records.items()}
            print_diverged(console, runs)
    write_results(console, result.to_json(), outputs, paths)
    outcomes = [outcome for case in result.cases for outcome in case.outcomes.values()]
    exit_if_diverged(run for outcome in outcomes for run in outcome.records.values())


def _print_scores_torsional(console: Console, case: Case, about: str) -> None:
    headings = ("plant", "controller", *(column.heading for column in _COLUMNS_TORSIONAL))
    rows = table(f"omega_c/omega_o = {case.label} rad/s ({about})", *headings, left=2)
    for kind, outcome in case.outcomes.items():
        for name, scores in outcome.scores.items():
            rows.add_row(kind, name, *(column.cell(scores) for column in _COLUMNS_TORSIONAL))
        rows.add_section()
    console.print(rows)


def _print_claims_torsional(console: Console, result: TorsionalResult) -> None:
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
        "different. docs/claims explains each no.\n"
    )


# ---- quell reproduce acc ----


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
    from quell.experiments.acc import loops as plant_samples
    from quell.experiments.acc import study
    from quell.experiments.acc.loops import DT, designs

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
    outputs = check_outputs(outputs, study.NAMES)
    console = Console()
    first = [plant_samples.plant(plants[0], cubic) for cubic in (False, True)]
    compile_loops(console, list(product(first, designs(DT).values())))
    with progress_bar(console, width=28) as report:
        result = study.run(plants, source, report)
        paths = []
        if outputs.figures:
            paths = study.save(result, outputs.figures, report, outputs.overwrite)
    _print_rates(console, result, DT)
    _print_cases(console, result)
    write_results(console, result.to_json(), outputs, paths)


def _print_rates(console: Console, result: AccResult, dt: float) -> None:
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


def _print_cases(console: Console, result: AccResult) -> None:
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
