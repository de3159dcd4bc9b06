"""Report of a run: metrics, figure, learned coefficients.

Report of a sweep: failures, quantiles of the measures, worst runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from quell.cli.options import Outputs
from quell.cli.output import Column, Console, print_line, table

if TYPE_CHECKING:
    from quell.quantities import Signals
    from quell.records.trajectory import Trajectory
    from quell.setup import Setup
    from quell.sweeping import Measure, Sweep

COLUMNS = (
    Column("overshoot", "overshoot\n[%]", 100.0, ".2f"),
    Column("settling_time", "settling\n[s]", 1.0, ".2f"),
    Column("rise_time", "rise\n[s]", 1.0, ".2f"),
    Column("peak_error", "peak of\nr − y", 1.0, ".4g"),
    Column("rms", "RMS of\nr − y", 1.0, ".4g"),
    Column("control_variation", "variation\nof u", 1.0, ".4g"),
    Column("total_variation", "with first\njump", 1.0, ".4g"),
)
# Units of columns that depend on those of y and u.
_UNITS = {
    **dict.fromkeys(("peak_error", "rms"), "y-unit"),
    **dict.fromkeys(("control_variation", "total_variation"), "u-unit"),
}


def windowed_metrics(run: Trajectory, setup: Setup) -> list[dict[str, Any]]:
    """Return the metrics of each window of a setup; by default after the last start from rest.

    Each also has ``start`` and ``stop`` [s], ``settling_band`` and ``missing``, the reason for each
    metric that does not exist. Such a metric is None, or not there if the window has no sample or
    no step. Windows after the end of the scenario are left out.
    """
    end = run.ended if setup.scenario is None else setup.scenario.duration
    rests = () if setup.scenario is None else setup.scenario.rest_at
    windows = [window for window in setup.windows if window.get("start", 0.0) < end]
    windows = windows or [{"start": float(rests[-1]) if len(rests) else 0.0}]
    return [_judged(run, window, end) for window in windows]


def _judged(run: Trajectory, window: dict[str, Any], end: float) -> dict[str, Any]:
    """Return the metrics of a window in a run that should go on until ``end`` [s]."""
    from quell.records.metrics import MEASURES, SETTLING_BAND

    start, stop = window.get("start", 0.0), window.get("stop")
    stop = end if stop is None else min(stop, end)
    band = window.get("band", SETTLING_BAND)
    # The last sample of a run to its end may be up to a sample before ``end``.
    ended_early = run.diverged or run.ended < end - 1.5 * run.dt
    cut_off = ended_early and stop > run.ended
    if reason := _nothing_to_judge(run, start, window.get("stop", math.inf), cut_off):
        missing = dict.fromkeys(MEASURES, reason)
        return {"start": start, "stop": stop, "settling_band": band, "missing": missing}
    found = run.metrics(**window)
    if cut_off:
        stop = run.ended
        found = found.without_step(f"the run ended at {run.ended:.6g} s, in the window")
    numbers = {name: value if math.isfinite(value) else None for name, value in found.items()}
    about = {"settling_band": band, "missing": found.missing}
    return {"start": start, "stop": stop} | numbers | about


def _nothing_to_judge(run: Trajectory, start: float, stop: float, cut_off: bool) -> str:
    """Return why a window has no metrics at all; empty if it has some.

    ``cut_off`` tells that the run ended before the window's end.
    """
    part, before = run.window(start, stop), start > run.ended
    if cut_off and (run.diverged or before or not len(run)):
        what, where = "diverged" if run.diverged else "ended", "before" if before else "in"
        return f"the run {what} at {run.ended:.6g} s, {where} the window"
    if part.start >= min(part.stop, len(run)):
        return f"no sample is in the window, they are {run.every * run.dt:g} s apart"
    return ""


def _heading(column: Column, units: dict[str, str]) -> str:
    """Return the heading of a column with the unit of its signal, if that is known."""
    unit = _UNITS.get(column.key, "")
    known = units.get(unit, "")
    return f"{column.heading}\n[{known}]" if known not in ("", unit) else column.heading


def print_metrics(
    console: Console, title: str, windows: list[dict[str, Any]], signals: Signals | None = None
) -> None:
    """Print a table with a row for each window, the settling band, and reasons for dashes.

    ``signals`` has the units of y and u.
    """
    units = {unit: signals.unit(unit) for unit in _UNITS.values()} if signals else {}
    headings = [_heading(column, units) for column in COLUMNS]
    rows = table(title, "from … to\n[s]", *headings, padding=(0, 1, 0, 0), pad_edge=False)
    for scores in windows:
        cells = [column.cell(scores) for column in COLUMNS]
        rows.add_row(_span(scores), *cells)
    console.print(rows)
    bands = [f"±{100.0 * scores['settling_band']:g} %" for scores in windows]
    alike = len(set(bands)) == 1
    text = bands[0] if alike else f"row by row {', '.join(bands)}"
    print_line(console, f"Settling band: {text} of the step.")
    for line in dict.fromkeys(line for scores in windows for line in _reasons(scores)):
        print_line(console, line)
    console.print()


def _reasons(scores: dict[str, Any]) -> list[str]:
    """Return a line for each reason why columns of a row are empty."""
    labels: dict[str, list[str]] = {}
    for column in COLUMNS:
        if reason := scores["missing"].get(column.key):
            labels.setdefault(reason, []).append(column.key.replace("_", " "))
    return [
        f"– in {_span(scores)} s"
        + (f" ({', '.join(names)}): {reason}." if len(names) < len(COLUMNS) else f": {reason}.")
        for reason, names in labels.items()
    ]


def _span(scores: dict[str, Any]) -> str:
    return f"{scores['start']:g} … {scores['stop']:g}"


def print_run(console: Console, run: Any, setup: Setup, title: str) -> tuple[Any, Any]:
    """Print and return the metrics of a run and what it learned; print the run's status.

    ``title`` is that of one axis. Of several both are by axis; the variation of u is that of its v.
    """
    if not run.several:
        windows = windowed_metrics(run, setup)
        print_metrics(console, title, windows, run.signals)
        return windows, print_outcome(console, run)
    scores, learned = {}, {}
    for name in run.axis_names:
        axis = run.axis(name)
        scores[name] = windowed_metrics(axis, setup)
        for window in scores[name]:  # windows of several axes have no target
            reasons = window["missing"].items()
            window["missing"] = {key: text.partition(": give target")[0] for key, text in reasons}
        print_metrics(console, f"{setup.title}: {name}, dt = {run.dt:g} s", scores[name])
        learned[name] = _learned(axis)
        if learned[name]:
            print_line(console, f"{name} learned: {_listed(learned[name])}")
    if run.status or run.failed_trials:
        console.print(("[red]" if run.lost else "") + escape(run.message), soft_wrap=True)
    return scores, learned


def _learned(run: Trajectory) -> dict[str, float]:
    theta = run["theta"][-1] if "theta" in run.names and len(run) else ()
    return {name: float(value) for name, value in zip(run.features, theta, strict=False)}


def _listed(learned: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in learned.items())


def print_outcome(console: Console, run: Trajectory) -> dict[str, float]:
    """Print and return the learned coefficients; print the run's status if it is not OK."""
    learned = _learned(run)
    if learned:
        print_line(console, f"Learned: {_listed(learned)}")
    if run.status or run.failed_trials:
        console.print(("[red]" if run.lost else "") + escape(run.message), soft_wrap=True)
    return learned


def save_run_figure(
    run: Trajectory,
    title: str,
    outputs: Outputs,
    name: str,
    add: Callable[[Trajectory, Any], None] | None = None,
) -> list[Path]:
    """Save a run's figure, with what ``add`` draws into its axes; return the paths of the files."""
    if outputs.figures is None:
        return []
    from quell.experiments.common import save_figure

    axes = run.plot()
    figure = axes[0].figure
    figure.suptitle(title)
    if add is not None:
        add(run, axes)
    return save_figure(figure, outputs.figures, name, outputs.overwrite)


# Failed runs that are printed, and that the results for programs name. By hand.
_PRINTED, _NAMED = 10, 1000


def summary(found: Sweep, worst: int) -> dict[str, Any]:
    """Return numbers of failures, quantiles of the measures and the worst runs.

    The quantiles are those of runs that neither diverged nor ran away.
    """
    import numpy as np

    from quell.sweeping.sweep import QUANTILES, share_interval
    from quell.types import Status

    data, failed = found.dataset, found.failed
    status = data["status"].values
    lost = (status >= 0) & ~found.complete
    failures = int(np.sum(failed))
    beyond = {
        name: int(np.sum(~(data[name].values <= limit) & (status >= 0) & ~lost))
        for name, limit in found.limits.items()
    }
    quantiles = {}
    for name in found.store.measures:
        values = data[name].values[found.complete]
        values = values[np.isfinite(values)]
        shares = np.quantile(values, QUANTILES).tolist() if values.size else [None] * len(QUANTILES)
        largest = float(np.max(values)) if values.size else None
        quantiles[name] = {"runs": int(values.size), "quantiles": shares, "largest": largest}
    metric = next(iter(found.store.measures))
    ordered = [
        {
            "run": run,
            "name": found.describe(run),
            metric: _number(data[metric][run].item()),
            "status": _status(int(status[run])),
        }
        for run in found.worst(metric, worst)
    ]
    return {
        "folder": str(found.store.folder),
        "runs": found.store.runs,
        "failures": failures,
        "failure_rate": failures / found.store.runs,
        "ci95": list(share_interval(failures, found.store.runs)),
        "errors": int(np.sum(status < 0)),
        "diverged": int(np.sum(lost & ((status & int(Status.DIVERGED)) != 0))),
        "ran_away": int(np.sum(lost & ((status & int(Status.DIVERGED)) == 0))),
        "beyond_limits": beyond,
        "measures": quantiles,
        "quantiles": list(QUANTILES),
        "worst": ordered,
        "failed_runs": [
            {"run": run, "name": found.describe(run), "reason": found.reason(run)}
            for run in _failed_first(found)[:_NAMED]
        ],
    }


def _failed_first(found: Sweep) -> list[int]:
    """Return the runs that failed: those with an error, then those lost, then beyond a limit."""
    import numpy as np

    failed = np.flatnonzero(found.failed)
    with_error, complete = found.dataset["status"].values[failed] < 0, found.complete[failed]
    order = np.lexsort((failed, complete, ~with_error))
    return [int(run) for run in failed[order]]


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _status(status: int) -> str:
    from quell.types import Status

    return "ERROR" if status < 0 else Status(status).name or "OK"


def print_summary(
    console: Console, title: str, found: Sweep, results: dict[str, Any], command: str
) -> None:
    """Print failures, quantiles, and the worst runs with the command that repeats the first."""
    low, high = (100.0 * share for share in results["ci95"])
    limits = "".join(
        f", {count} with {name} beyond {found.limits[name]:g}"
        for name, count in results["beyond_limits"].items()
    )
    print_line(
        console,
        f"{title}: {results['runs']} runs, {results['failures']} fail "
        f"({100.0 * results['failure_rate']:.3g} %, 95 % interval {low:.3g} … {high:.3g} %): "
        f"{results['errors']} with an error, {results['diverged']} diverged, "
        f"{results['ran_away']} ran away{limits}.",
    )
    rows = table("Runs to their end", "measure", "runs", "5 %", "median", "95 %", "largest")
    for name, each in results["measures"].items():
        numbers = [*each["quantiles"], each["largest"]]
        cells = ["–" if value is None else f"{value:.4g}" for value in numbers]
        rows.add_row(escape(found.label(name)), str(each["runs"]), *cells)
    console.print(rows)
    lost = results["errors"] + results["diverged"] + results["ran_away"]
    for i, each in enumerate(results["failed_runs"][: min(lost, _PRINTED)]):
        what = "done" if i < results["errors"] else "stable"
        print_line(console, f"NOT {what}: {each['name']}: {each['reason']}")
    if lost > _PRINTED:
        print_line(console, f"NOT done or not stable: {lost - _PRINTED} more; --json names them")
    metric = next(iter(found.store.measures))
    print_line(console, f"Worst runs by {metric}:")
    for each in results["worst"]:
        value = "–" if each[metric] is None else f"{each[metric]:.4g}"
        print_line(console, f"  {value:>10s}  {each['name']} ({each['status']})")
    if results["worst"]:
        print_line(console, f"To repeat one: {command} --repeat {results['worst'][0]['run']}")
    print_line(console, f"Runs: {results['folder']}/, which quell.sweeping.Sweep.open reads")


def stored_alike(
    folder: Path, number: int, name: str, run: Trajectory, measures: Mapping[str, Measure]
) -> bool | None:
    """Return whether a run has the measures that a folder has, bit for bit; None without them."""
    import numpy as np

    from quell.sweeping import Sweep
    from quell.sweeping.measures import measure_run
    from quell.sweeping.runs import MANIFEST

    if not (folder / MANIFEST).exists():
        return None
    stored = Sweep.open(folder)
    if number >= stored.store.runs or not stored.done[number] or stored.describe(number) != name:
        return None
    values = {each: measure_run(run, {each: measures[each]})[each] for each in measures}
    return set(values) == set(stored.store.measures) and all(
        np.array_equal(value, stored.dataset[each][number].item(), equal_nan=True)
        for each, value in values.items()
    )
