"""The figure of a comparison: output and control signal of each controller."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from quell.experiments.common.figures import make_folder, save_figure
from quell.experiments.compare.study import Comparison
from quell.records.plotting import draw_line


def draw(result: Comparison) -> Any:
    """Return the figure: y and r above, u below, quiet ones in front; what would dwarf the others is cut off."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    first = next(iter(result.runs.values()))
    draw_line(above, first.t, first["r"], color="0.3", linestyle="--", linewidth=1.0, label="r")
    loudness = {name: float(np.sum(np.abs(np.diff(run["u"])))) for name, run in result.runs.items()}
    for i, (name, run) in enumerate(result.runs.items()):
        label = f"{name} (diverged)" if run.diverged else name
        style = {"color": f"C{i % 10}", "linewidth": 1.3, "linestyle": "-" if i < 10 else "--"}
        draw_line(above, run.t, run["y"], label=label, **style)
        draw_line(
            below,
            run.t,
            run["u"],
            zorder=3.0 - sorted(loudness, key=loudness.__getitem__).index(name) / len(loudness),
            **style,
        )
    for ax, channel, title in ((above, "y", "output"), (below, "u", "control signal")):
        ax.set_ylim(*_window([run[channel] for run in result.runs.values()]))
        ax.set_ylabel(title)
        ax.grid(alpha=0.3)
    above.legend(fontsize="small", ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    below.set_xlabel("time [s]")
    return figure


def save(result: Comparison, folder: str | os.PathLike[str]) -> list[Path]:
    """Write the figure into ``folder``, made if need be; return the paths."""
    return save_figure(draw(result), make_folder(folder), "compare")


def _window(signals: list[Any]) -> tuple[float, float]:
    """Return limits of an axis that hold all signals but what is far beyond the usual."""
    low, high = (
        float(np.median([np.min(s) for s in signals])),
        float(np.median([np.max(s) for s in signals])),
    )
    room = 1.5 * max(high - low, 1e-9)
    held = [np.clip(s, low - room, high + room) for s in signals]
    low, high = min(float(np.min(s)) for s in held), max(float(np.max(s)) for s in held)
    margin = 0.05 * max(high - low, 1e-9)
    return low - margin, high + margin
