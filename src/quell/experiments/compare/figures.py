"""The figure of a comparison: output and control signal of each controller."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell.experiments.common.figures import save_figures
from quell.experiments.compare.study import Comparison
from quell.records.plotting import draw_line, given_axes, grid_of_axes, new_figure


def draw(result: Comparison, axes: Any = None, *, ax: Any = None) -> Any:
    """Draw y and r above, u below; quiet signals in front, extreme values cut off.

    Parameters
    ----------
    result
        of ``compare``.
    axes, ax
        two matplotlib axes; those of a new figure by default.

    Returns
    -------
    numpy.ndarray
        the axes.
    """
    make = partial(new_figure, 10.0, 7.0)
    above, below = axes = grid_of_axes(given_axes(axes, ax), make, 2, sharex=True)[:, 0]
    first = next(iter(result.runs.values()))
    draw_line(above, first.t, first["r"], color="0.3", linestyle="--", linewidth=1.0, label="r")
    variation = {name: np.sum(np.abs(np.diff(run["u"]))) for name, run in result.runs.items()}
    quietest_first = sorted(variation, key=variation.__getitem__)
    for i, (name, run) in enumerate(result.runs.items()):
        label = f"{name} (diverged)" if run.diverged else name
        style = {"color": f"C{i % 10}", "linewidth": 1.3, "linestyle": "-" if i < 10 else "--"}
        depth = 3.0 - quietest_first.index(name) / len(quietest_first)
        draw_line(above, run.t, run["y"], label=label, **style)
        draw_line(below, run.t, run["u"], zorder=depth, **style)
    y, u = first.signals.y.label("output"), first.signals.u.label("control signal")
    for each, channel, title in ((above, "y", y), (below, "u", u)):
        limits = _limits([run[channel] for run in result.runs.values()])
        each.set(ylim=limits, ylabel=title)
        each.grid(alpha=0.3)
    above.legend(fontsize="small", ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    below.set_xlabel("time [s]")
    return axes


def save(
    result: Comparison,
    folder: str | os.PathLike[str],
    overwrite: bool = False,
    name: str = "compare",
) -> list[Path]:
    """Write the figure into ``folder``, created if missing; return the paths."""
    return save_figures({name: partial(draw, result)}, folder, overwrite=overwrite)


def _limits(signals: list[Any]) -> tuple[float, float]:
    """Return limits of an axis that hold all signals except for extreme values."""
    low, high = (float(np.median([pick(s) for s in signals])) for pick in (np.min, np.max))
    room = 1.5 * max(high - low, 1e-9)
    clipped = [np.clip(s, low - room, high + room) for s in signals]
    low, high = min(float(np.min(s)) for s in clipped), max(float(np.max(s)) for s in clipped)
    margin = 0.05 * max(high - low, 1e-9)
    return low - margin, high + margin
