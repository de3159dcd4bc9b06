"""Report of a run: metrics, figure, learned coefficients."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape

from quell.cli.output import Column, print_line, table

if TYPE_CHECKING:
    from quell.records.trajectory import Trajectory
    from quell.setup import Setup

COLUMNS = (
    Column("overshoot", "overshoot\n[%]", 100.0, ".2f"),
    Column("settling_time", "settling\n[s]", 1.0, ".2f"),
    Column("rise_time", "rise\n[s]", 1.0, ".2f"),
    Column("peak_error", "peak of\nr − y", 1.0, ".4g"),
    Column("rms", "RMS of\nr − y", 1.0, ".4g"),
    Column("control_variation", "variation\nof u", 1.0, ".4g"),
)


def windowed_metrics(run: Trajectory, setup: Setup) -> list[dict[str, Any]]:
    """Return the metrics of each window of a setup; by default after the last start from rest.

    Each also has ``start`` and ``stop`` [s], and nothing else if the run ended before the window.
    A metric that does not exist is None. Windows after the end of the scenario are left out.
    """
    end = run.ended if setup.scenario is None else setup.scenario.duration
    rests = () if setup.scenario is None else setup.scenario.rest_at
    windows = [window for window in setup.windows if window.get("start", 0.0) < end]
    results = []
    for window in windows or [{"start": float(rests[-1]) if len(rests) else 0.0}]:
        start, stop = window.get("start", 0.0), window.get("stop")
        values = run.metrics(**window) if len(run) and start < run.t[-1] else {}
        results.append(
            {"start": start, "stop": end if stop is None else min(stop, end)}
            | {name: value if math.isfinite(value) else None for name, value in values.items()}
        )
    return results


def print_metrics(console: Console, title: str, windows: list[dict[str, Any]]) -> None:
    """Print a table with a row for each window."""
    rows = table(title, "from … to\n[s]", *(column.heading for column in COLUMNS))
    for scores in windows:
        cells = [column.cell(scores) for column in COLUMNS]
        rows.add_row(f"{scores['start']:g} … {scores['stop']:g}", *cells)
    console.print(rows)


def print_outcome(console: Console, run: Trajectory) -> dict[str, float]:
    """Print and return the learned coefficients; print the run's status if it is not OK."""
    theta = run["theta"][-1] if "theta" in run.names and len(run) else ()
    learned = {name: float(value) for name, value in zip(run.features, theta, strict=False)}
    if learned:
        named = ", ".join(f"{name} {value:.4g}" for name, value in learned.items())
        print_line(console, f"Learned: {named}")
    if run.diverged or run.status:
        console.print(("[red]" if run.diverged else "") + escape(run.message), soft_wrap=True)
    return learned


def save_run_figure(
    run: Trajectory,
    title: str,
    folder: Path,
    name: str,
    add: Callable[[Trajectory, Any], None] | None = None,
) -> list[Path]:
    """Save a run's figure, with what ``add`` draws into its axes; return the paths of the files."""
    import matplotlib.pyplot as plt

    from quell.experiments.common.figures import save_figure

    axes = run.plot()
    figure = axes[0].figure
    figure.suptitle(title)
    if add is not None:
        add(run, axes)
    try:
        return save_figure(figure, folder, name)
    finally:
        plt.close(figure)
