"""``quell stress``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from rich.markup import escape

from quell.cli.options import OUTPUTS, Outputs, Whole, WholeOrNone
from quell.cli.output import (
    Console,
    check_outputs,
    number,
    progress_bar,
    table,
    write_results,
    yes_or_no,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from quell.experiments.stress.axes import AxesResult
    from quell.experiments.stress.general import GeneralResult
    from quell.experiments.stress.study import Bar, Judged, Result

_HEADINGS = (
    *("learner", "lost of\nloops"),
    *("whole\n50 %", "\n99 %", "\nmost"),
    *("load\n50 %", "\n99 %", "\nmost", "late\n50 %"),
)
_GENERAL_HEADINGS = (
    *("learner", "lost of\nloops"),
    *("RMS\n50 %", "\n99 %", "\nmost"),
    *("window\n99 %", "\nmost", "peak\n99 %", "\nmost", "worse\nby 5%"),
)
_AXES_HEADINGS = (
    *("observer", "lost of\nloops"),
    *("RMS\n50 %", "\nmost", "late\n50 %", "\nmost"),
    *("over unguarded\n50 %", "late\n50 %"),
)


def stress(
    *,
    runs: WholeOrNone = None,
    honest: Whole = 25,
    seed: Whole = 0,
    guard: bool = True,
    loops: Literal["two-mass", "all", "axes"] = "two-mass",
    outputs: Outputs = OUTPUTS,
) -> None:
    """Test the guard: hostile learners and an honest one in random loops, each beside plain MF-ESO.

    Each loop runs with four draws of the noise with the learner, and with the same four and four
    others without; judged are the means over four draws.

    Parameters
    ----------
    runs
        How many loops with hostile learners, all kinds in turn; 150 by default, and none on axes.
    honest
        How many loops with honest learners.
    seed
        Seed of all that is random.
    guard
        With the guard, or without it, for comparison.
    loops
        The loops: two masses on a spring, all alike; all kinds of plants, orders, references and
        loads, with named cases and the bars that a guard has to meet; or flexible axes, arms with
        two coupled joints and settling near rest, with honest learners only. For the last two,
        seeds below 10000 are for tuning, and seeds from 1000000 on for judging: look at each of
        them once.
    """
    from rich.progress import TextColumn, TimeRemainingColumn

    from quell.experiments.stress import axes, figures, general, study
    from quell.guard import Guard

    if loops == "axes" and runs:
        raise ValueError(f"runs = {runs}: the trial on axes has no hostile learners; leave it out")
    hostile = 150 if runs is None else runs

    outputs = check_outputs(outputs, ["stress"])
    console = Console()
    minutes = "half a minute" if loops == "two-mass" else "some minutes"
    first = f"simulating (the first run compiles for {minutes})"
    columns = (TextColumn("{task.percentage:>3.0f} %"), TimeRemainingColumn())
    with progress_bar(console, first, *columns) as report:
        used, progress = Guard() if guard else None, partial(report, "simulating")
        result: Any
        if loops == "axes":
            result = axes.run(honest, seed, guard=used, progress=progress)
        else:
            trial: Any = study if loops == "two-mass" else general
            result = trial.run(hostile, honest, seed, guard=used, progress=progress)
    printed: dict[str, Any] = {"two-mass": _print, "all": _print_general, "axes": _print_axes}
    printed[loops](console, result, guard)
    paths = figures.save(result, outputs.figures, outputs.overwrite) if outputs.figures else []
    write_results(console, result.to_json(), outputs, paths)


def _print(console: Console, result: Result, guarded: bool) -> None:
    from quell.experiments.stress.study import HONEST, Errors, summary

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
        found = summary(outcomes, Errors)
        keys = ("median", "p99", "max")
        ratios = [found[name][key] for name in ("whole", "load") for key in keys]
        cells = [number(ratio, ".3f") for ratio in (*ratios, found["late"]["median"])]
        rows.add_row(escape(label), _lost(found), *cells)
    console.print(rows)
    _print_bars(console, result.bars())
    labels = {"whole": "whole run", "load": "minute of load"}
    _print_honest(console, result.of(HONEST), Errors, labels)
    without = sum(outcome.plain_lost for outcome in result.outcomes)
    console.print(
        f"{_means('MF-ESO')} Whole run: 150 s. Load: from 90 s on. Late: from 140 s on. Errors are "
        f"against the response the design asks for. Lost with MF-ESO, too: {without}.\n"
    )


def _lost(found: Mapping[str, Any]) -> str:
    """Return the numbers of lost and of all loops as a cell."""
    lost = f"[red]{found['lost']}[/]" if found["lost"] else "0"
    return f"{lost} of {found['loops']}"


def _means(plain: str) -> str:
    """Return what the figures are means of, beside the plain loop."""
    from quell.experiments.stress.study import DRAWS

    return (
        f"Errors of a loop are means over {DRAWS} draws of the noise. Other noise: {plain} with "
        f"{DRAWS} other draws, over {plain}: what chance alone does to a figure."
    )


def _print_honest(
    console: Console, outcomes: Sequence[Judged], kind: Any, labels: Mapping[str, str]
) -> None:
    """Print how many of the honest loops are worse, beyond chance, and their mean logarithm."""
    from quell.experiments.stress.study import WORSE, summary

    found, chance = summary(outcomes, kind), summary(outcomes, kind, "chance")
    if found["loops"] == found["plain_lost"]:
        return
    for name, label in labels.items():
        one, other = found[name], chance[name]
        shares = one["worse"], other["worse"], one["worse"] - other["worse"]
        worse, by_chance, more = (f"{100.0 * share:.2f} %" for share in shares)
        console.print(
            f"Honest loops, {label}: {worse} have a mean ratio above {WORSE:g}, {by_chance} by "
            f"chance, difference {more}; mean logarithm of the ratio "
            f"{number(one['mean_log'], '.3f')}, by chance {number(other['mean_log'], '.4f')}."
        )


def _figure(bar: Bar) -> str:
    """Return a figure with four digits; with eight, if four hide that it exceeds the bar."""
    exceeds = bar.figure is not None and bar.figure > bar.bar >= float(f"{bar.figure:.4g}")
    return number(bar.figure, ".8g" if exceeds else ".4g")


def _print_general(console: Console, result: GeneralResult, guarded: bool) -> None:
    from quell.experiments.stress.general import HEALTHY, Measures
    from quell.experiments.stress.study import summary

    how = "with guard" if guarded else "WITHOUT guard"
    title = f"Over MF-ESO in the same loop, {how}; loops with a modulus margin of {HEALTHY}"
    rows = table(title, *_GENERAL_HEADINGS, padding=(0, 1, 0, 0), pad_edge=False)
    kinds = result.grouped(result.healthy, "kind")
    totals = {"all adversaries": result.hostile, "all honest": result.honest}
    for label, outcomes in {**kinds, **totals}.items():
        if label == "all adversaries":
            rows.add_section()
        found = summary(outcomes, Measures)
        keys = (("rms", "median"), ("rms", "p99"), ("rms", "max"), ("window", "p99"))
        more = (("window", "max"), ("peak", "p99"), ("peak", "max"))
        cells = [number(found[name][key], ".2f") for name, key in (*keys, *more)]
        worse = number(found["rms"]["worse"], ".3f")
        rows.add_row(escape(label), _lost(found), *cells, worse)
    console.print(rows)
    _print_bars(console, result.bars())
    _print_honest(console, result.honest, Measures, {"rms": "RMS error"})
    why = result.left_out
    console.print(
        f"{_means('MF-ESO')}\n"
        f"Not counted: {why['low_margin']} loops with a lower margin, {why['plain_lost']} in which "
        f"MF-ESO is lost, {why['fragile']} in which it hardly holds within the limits of u; "
        f"{why['lost']} of these are lost.\n"
    )


def _print_bars(console: Console, found: Sequence[Bar]) -> None:
    bars = table("Bars", "over", "measure", "figure", "bar", "met", "other\nnoise", left=2)
    for bar in found:
        cells = [_figure(bar), f"{bar.bar:g}", yes_or_no(bar.met), number(bar.other_noise, ".4g")]
        bars.add_row(escape(bar.over), escape(bar.measure), *cells)
    console.print(bars)


def _print_axes(console: Console, result: AxesResult, guarded: bool) -> None:
    from quell.experiments.stress.axes import AxisErrors
    from quell.experiments.stress.study import summary

    how = "with guard" if guarded else "WITHOUT guard"
    title = f"RMS error over that without learner on the same axis, {how}"
    rows = table(title, *_AXES_HEADINGS, padding=(0, 1, 0, 0), pad_edge=False)
    for label, outcomes in {**result.by_structure, "all but arms": result.outcomes}.items():
        if label == "all but arms":
            rows.add_section()
        found = summary(outcomes, AxisErrors)
        unguarded = summary(outcomes, AxisErrors, "over_unguarded")
        figures = [found[name][key] for name in ("rms", "late") for key in ("median", "max")]
        figures += [unguarded[name]["median"] for name in ("rms", "late")]
        cells = [number(figure, ".3f") for figure in figures]
        rows.add_row(escape(label), _lost(found), *cells)
    console.print(rows)
    _print_bars(console, result.bars())
    _print_honest(console, result.outcomes, AxisErrors, {"rms": "RMS error"})
    console.print(f"{_means('the loop without learner')}\n")
