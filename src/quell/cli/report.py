"""How the commands that run a setup show what came of it: a table of metrics, a figure, JSON."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quell.experiments.common.figures import save_figure
from quell.records.trajectory import Trajectory
from quell.setup import Setup

_COLUMNS = (
    ("overshoot", "overshoot\n[%]", 100.0, ".2f"),
    ("settling_time", "settling\n[s]", 1.0, ".2f"),
    ("rise_time", "rise\n[s]", 1.0, ".2f"),
    ("peak_error", "peak of\nr − y", 1.0, ".4g"),
    ("rms", "RMS of\nr − y", 1.0, ".4g"),
    ("control_variation", "variation\nof u", 1.0, ".4g"),
)


def judge(run: Trajectory, setup: Setup) -> list[dict[str, Any]]:
    """Return the metrics of each window that the setup asks for: by default, of all that follows the last start from rest.

    Each has ``start`` and ``stop`` [s] besides; where the run ended before a window there is nothing else. None is for a number that
    there is not. Windows that the scenario does not reach are left out.
    """
    end = run.ended if setup.scenario is None else setup.scenario.duration
    rests = () if setup.scenario is None else setup.scenario.rest_at
    windows = [window for window in setup.windows if window.get("start", 0.0) < end]
    found = []
    for window in windows or [{"start": float(rests[-1]) if len(rests) else 0.0}]:
        start, stop = window.get("start", 0.0), window.get("stop")
        about: dict[str, Any] = {"start": start, "stop": end if stop is None else min(stop, end)}
        values = run.metrics(**window) if len(run) and start < run.t[-1] else {}
        found.append(
            about
            | {name: value if math.isfinite(value) else None for name, value in values.items()}
        )
    return found


def print_judgement(console: Console, title: str, scores: list[dict[str, Any]]) -> None:
    """Print a table with a row for each window."""
    table = Table(title=escape(title), title_justify="left", box=SIMPLE_HEAD)
    table.add_column("from … to\n[s]", no_wrap=True)
    for _, heading, _, _ in _COLUMNS:
        table.add_column(escape(heading), justify="right", no_wrap=True)
    for score in scores:
        values = [(score.get(key), factor, form) for key, _, factor, form in _COLUMNS]
        cells = [
            "–" if value is None else format(factor * value, form) for value, factor, form in values
        ]
        table.add_row(f"{score['start']:g} … {score['stop']:g}", *cells)
    console.print(table)


def print_outcome(console: Console, run: Trajectory) -> dict[str, float]:
    """Print what was learned and what happened; return the coefficients."""
    theta = run["theta"][-1] if "theta" in run.names and len(run) else ()
    learned = {name: float(value) for name, value in zip(run.features, theta, strict=False)}
    if learned:
        console.print(
            "Learned: "
            + escape(", ".join(f"{name} {value:.4g}" for name, value in learned.items())),
            soft_wrap=True,
        )
    if run.diverged or run.status:
        console.print(("[red]" if run.diverged else "") + escape(run.message), soft_wrap=True)
    return learned


def figure_of(
    run: Trajectory,
    title: str,
    folder: Path,
    name: str,
    add: Callable[[Trajectory, Any], None] | None = None,
) -> list[Path]:
    """Draw a run, and what is to be added; return the paths of the files."""
    import matplotlib.pyplot as plt

    axes = run.plot()
    figure = axes[0].figure
    figure.suptitle(title)
    if add is not None:
        add(run, axes)
    try:
        return save_figure(figure, folder, name)
    finally:
        plt.close(figure)
