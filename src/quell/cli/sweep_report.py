"""Report of a sweep: failures, quantiles of the measures, worst runs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from quell.cli.output import Console, print_line, table

if TYPE_CHECKING:
    from quell.records.trajectory import Trajectory
    from quell.sweeping import Measure, Sweep

# Distinct messages of failing runs that are printed. By hand.
_MESSAGES = 3


def summary(found: Sweep, worst: int) -> dict[str, Any]:
    """Return numbers of failures, quantiles of the measures and the worst runs.

    The quantiles are those of runs that did not diverge.
    """
    import numpy as np

    from quell.sweeping.figures import QUANTILES
    from quell.sweeping.shares import share_interval

    data, failed = found.dataset, found.failed
    status = data["status"].values
    diverged = (status >= 0) & ~found.complete
    failures = int(np.sum(failed))
    beyond = {
        name: int(np.sum(~(data[name].values <= limit) & (status >= 0) & ~diverged))
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
        "diverged": int(np.sum(diverged)),
        "beyond_limits": beyond,
        "measures": quantiles,
        "quantiles": list(QUANTILES),
        "worst": ordered,
    }


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
        f"{results['errors']} with an error, {results['diverged']} diverged{limits}.",
    )
    rows = table("Runs that did not diverge", "measure", "runs", "5 %", "median", "95 %", "largest")
    for name, each in results["measures"].items():
        numbers = [*each["quantiles"], each["largest"]]
        cells = ["–" if value is None else f"{value:.4g}" for value in numbers]
        rows.add_row(escape(found.label(name)), str(each["runs"]), *cells)
    console.print(rows)
    messages = Counter(text for text in found.dataset["message"].values.tolist() if text)
    for text, count in messages.most_common(_MESSAGES):
        print_line(console, f"{count} runs: {text}")
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
    from quell.sweeping.store import MANIFEST

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
