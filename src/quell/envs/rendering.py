"""Text and pictures of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quell.quantities import UNKNOWN, Signals

MODES = ("ansi", "rgb_array")
_SIZE, _DOTS = (6.4, 4.8), 100  # inches, and dots an inch: 640 x 480, as Gymnasium's own


def as_text(past: Sequence[tuple[float, ...]], signals: Signals = UNKNOWN) -> str:
    """Return the last of the rows (t, r, y, u) as a line with units."""
    t, r, y, u = past[-1]
    of_y, of_u = (f" {each.unit}" if each.unit else "" for each in (signals.y, signals.u))
    return f"t = {t:8.3f} s   r = {r:10.4g}{of_y}   y = {y:10.4g}{of_y}   u = {u:10.4g}{of_u}\n"


def as_picture(past: Sequence[tuple[float, ...]], signals: Signals = UNKNOWN) -> Any:
    """Return rows (t, r, y, u) as a picture (480, 640, 3) of y over r, and of u, with units."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, dpi=_DOTS, layout="constrained")
    canvas: Any = FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    t, r, y, u = np.asarray(past).T
    upper.plot(t, y, label="y")
    upper.plot(t, r, "--", label="r")
    upper.set_ylabel(signals.y.label("output"))
    # u is held during the step that ends with its row.
    lower.step(t, u, where="pre", label="u")
    lower.set_ylabel(signals.u.label("control signal"))
    lower.set_xlabel("time [s]")
    for axes in (upper, lower):
        # Above the axes, where it hides no data.
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3].copy()
