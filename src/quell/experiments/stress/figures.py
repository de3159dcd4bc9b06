"""The figure of the guard's trial: how the ratios are distributed, by kind of learner."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from quell.experiments.common.figures import make_folder, save_figure
from quell.experiments.stress.study import HONEST, Result


def draw(result: Result) -> Any:
    """Return the figure: for each kind the share of runs whose ratio is below x."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.8), layout="constrained")
    whole, load = figure.subplots(1, 2, sharey=True)
    for ax, name, title in ((whole, "ratio", "whole run"), (load, "load_ratio", "60 s of load")):
        for i, kind in enumerate(result.kinds):
            values = np.sort([getattr(outcome, name) for outcome in result.of(kind)])
            values = values[np.isfinite(values)]
            if values.size:
                style = (
                    {"color": "black", "linewidth": 2.0}
                    if kind == HONEST
                    else {"color": f"C{i % 10}", "linewidth": 1.0}
                )
                style["linestyle"] = "-" if i < 10 else "--"
                ax.step(
                    values,
                    (np.arange(values.size) + 1.0) / values.size,
                    where="post",
                    label=kind,
                    **style,
                )
        ax.axvline(1.0, color="0.5", linewidth=0.8)
        ax.set_xscale("log")
        ax.set_title(title)
        ax.set_xlabel("RMS error over that of MF-ESO")
        ax.grid(alpha=0.3, which="both")
    whole.set_ylabel("share of runs")
    load.legend(fontsize="small", loc="upper left")
    return figure


def save(result: Result, folder: Path) -> list[Path]:
    """Write the figure into ``folder``, made if need be; return the paths."""
    return save_figure(draw(result), make_folder(folder), "stress")
