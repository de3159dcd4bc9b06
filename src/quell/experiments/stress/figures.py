"""The figure of the guard's trial: distributions of the loops' ratios, by kind of learner."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell.experiments.common import save_figures
from quell.experiments.stress.axes import AxesResult
from quell.experiments.stress.general import HONEST as HONEST_LEARNERS
from quell.experiments.stress.general import GeneralResult
from quell.experiments.stress.study import HONEST, Judged, Result
from quell.records.plotting import grid_of_axes, new_figure

_PANELS = {"whole": "whole run", "load": "60 s of load"}
_AXES_PANELS = {"rms": "whole time of load", "late": "its second half"}
_GENERAL_PANELS = {"rms": "whole run", "window": "worst window", "peak": "largest error"}


def draw(result: Result | GeneralResult | AxesResult, ax: Any = None) -> Any:
    """Draw for each kind of learner the share of loops whose ratio is below x; return the axes.

    For the trial on flexible axes it is each kind of observer.

    Parameters
    ----------
    result
        of ``run``, or of the trial in general loops or on flexible axes.
    ax
        axes to draw into, two, or three for general loops; those of a new figure by default.
    """
    if isinstance(result, Result):
        groups: Mapping[str, Sequence[Judged]] = {kind: result.of(kind) for kind in result.kinds}
        return _draw(groups, _PANELS, "RMS error over that of MF-ESO", (HONEST,), ax)
    if isinstance(result, AxesResult):
        found = result.by_structure
        return _draw(found, _AXES_PANELS, "RMS error over that without learner", (), ax)
    groups = result.grouped(result.healthy, "kind")
    return _draw(groups, _GENERAL_PANELS, "over that of MF-ESO", HONEST_LEARNERS, ax)


def _draw(
    groups: Mapping[str, Sequence[Judged]],
    panels: Mapping[str, str],
    xlabel: str,
    honest: Collection[str],
    given: Any,
) -> Any:
    make = partial(new_figure, 5.5 * len(panels), 4.8)
    axes = grid_of_axes(given, make, 1, len(panels), sharey=True)[0]
    for ax, (name, title) in zip(axes, panels.items(), strict=True):
        for i, (kind, outcomes) in enumerate(groups.items()):
            values = np.sort([getattr(outcome.guarded, name) for outcome in outcomes])
            values = values[np.isfinite(values)]
            if values.size:
                shares = (np.arange(values.size) + 1.0) / values.size
                color, width = ("black", 2.0) if kind in honest else (f"C{i % 10}", 1.0)
                style = {"color": color, "linewidth": width, "linestyle": "-" if i < 10 else "--"}
                ax.step(values, shares, where="post", label=kind, **style)
        ax.axvline(1.0, color="0.5", linewidth=0.8)
        ax.set(xscale="log", title=title, xlabel=xlabel)
        ax.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("share of loops")
    axes[1].legend(fontsize="small", loc="upper left")
    return axes


def save(
    result: Result | GeneralResult | AxesResult,
    folder: str | os.PathLike[str],
    overwrite: bool = False,
) -> list[Path]:
    """Write the figure into ``folder``, created if missing; return the paths."""
    return save_figures({"stress": partial(draw, result)}, folder, overwrite=overwrite)
