"""The figure of the guard's trial: distributions of the ratios, by kind of learner."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell.experiments.common.figures import new_figure, save_figures
from quell.experiments.stress.study import HONEST, Result


def draw(result: Result) -> Any:
    """Return the figure: for each kind the share of runs whose ratio is below x."""
    figure = new_figure(11.0, 4.8)
    whole, load = figure.subplots(1, 2, sharey=True)
    for ax, name, title in ((whole, "ratio", "whole run"), (load, "load_ratio", "60 s of load")):
        for i, kind in enumerate(result.kinds):
            values = np.sort([getattr(outcome, name) for outcome in result.of(kind)])
            values = values[np.isfinite(values)]
            if values.size:
                shares = (np.arange(values.size) + 1.0) / values.size
                color, width = ("black", 2.0) if kind == HONEST else (f"C{i % 10}", 1.0)
                style = {"color": color, "linewidth": width, "linestyle": "-" if i < 10 else "--"}
                ax.step(values, shares, where="post", label=kind, **style)
        ax.axvline(1.0, color="0.5", linewidth=0.8)
        ax.set(xscale="log", title=title, xlabel="RMS error over that of MF-ESO")
        ax.grid(alpha=0.3, which="both")
    whole.set_ylabel("share of runs")
    load.legend(fontsize="small", loc="upper left")
    return figure


def save(result: Result, folder: str | os.PathLike[str], overwrite: bool = False) -> list[Path]:
    """Write the figure into ``folder``, created if missing; return the paths."""
    return save_figures({"stress": partial(draw, result)}, folder, overwrite=overwrite)
