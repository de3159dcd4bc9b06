"""The figures of the torsional experiment: the paper's two, and what was learned."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell import checks
from quell.experiments.common.figures import (
    ESTIMATES,
    STYLES,
    legend_label,
    save_paper_figures,
    wide_figure,
)
from quell.experiments.torsional.setup import (
    B0,
    BAND,
    END,
    FRICTION,
    LINEAR,
    MB,
    MB_OFF,
    MF,
    PLANTS,
    PROFILE_AT,
    TARGET,
    L,
)
from quell.experiments.torsional.study import Result
from quell.plants import torsional_identified
from quell.records.plotting import draw_line, grid_of_axes
from quell.records.trajectory import Trajectory
from quell.types import Progress, Vector

_STYLES: Mapping[str, dict[str, Any]] = {
    MF: STYLES[MF],
    MB: STYLES[MB],
    MB_OFF: {"color": "#2a6f97", "linewidth": 1.0, "linestyle": "--"},
    L: STYLES[L],
}
_HEADINGS = {FRICTION: "with friction", LINEAR: "linear"}
# From the profile's start [s]: the move, and the time around the arrival at π.
_MOVE, _ARRIVAL = (0.0, 4.0), (1.9, 6.0)
# Half height of the axes around π [%]: four settling bands.
_NEAR = 100.0 * 4.0 * BAND
# Time over which f is averaged [s]: chosen by hand.
_SMOOTHED = 0.02

NAMES = ("torsional-position", "torsional-control", "torsional-learning")
"""Names of the figures."""


def save(
    result: Result, folder: str | os.PathLike[str], progress: Progress, overwrite: bool = False
) -> list[Path]:
    """Draw all figures into ``folder``, created if missing; return the paths."""
    return save_paper_figures(draw, NAMES, result, folder, progress, overwrite)


def draw(result: Result, name: str, ax: Any = None) -> Any:
    """Draw one of the figures ``NAMES`` and return its axes.

    Parameters
    ----------
    result
        of ``run``.
    name
        ``"torsional-position"`` with three axes for each case, ``"torsional-control"`` with two for
        each case, ``"torsional-learning"`` with two.
    ax
        axes to draw into; those of a new figure by default.

    Raises
    ------
    ValueError
        for another name or number of axes.
    """
    drawings = dict(zip(NAMES, (_position, _control, _learning), strict=True))
    return drawings[checks.one_of("name", name, NAMES)](result, ax)


def _position(result: Result, given: Any) -> Any:
    """Draw the upper disk's angle: the move, and the arrival on both plants."""
    make = partial(wide_figure, 8.4, top=0.93, hspace=0.2)
    rows = grid_of_axes(given, make, len(result.cases), 3)
    for case, (move, *arrivals) in zip(result.cases, rows, strict=True):
        runs = case.outcomes[FRICTION].records
        for name, style in _STYLES.items():
            run = runs[name]
            _line(move, run, run["y"], _MOVE, label=legend_label(name, run), **style)
        reference = {"label": "r", "color": "0.3", "linestyle": ":", "linewidth": 1.0}
        _line(move, runs[MF], runs[MF]["r"], _MOVE, **reference)
        move.set_ylabel(f"{case.label}\nupper disk [rad]")
        for ax, kind in zip(arrivals, PLANTS, strict=True):
            for name, style in _STYLES.items():
                run = case.outcomes[kind].records[name]
                _line(ax, run, 100.0 / TARGET * (run["y"] - TARGET), _ARRIVAL, **style)
            ax.axhspan(-100.0 * BAND, 100.0 * BAND, color="0.9", zorder=0)
            ax.set_ylim(-_NEAR, _NEAR)
    rows[0, 0].set_title("with friction", fontsize="medium")
    for ax, kind in zip(rows[0, 1:], PLANTS, strict=True):
        ax.set_title(f"distance from π [%], {_HEADINGS[kind]}", fontsize="medium")
    rows[0, 0].legend(fontsize="x-small", loc="lower right")
    for ax in rows[-1]:
        ax.set_xlabel("time from the profile's start [s]")
    title = "Upper disk along the trapezoid to π, for each omega_c/omega_o [rad/s]; grey: ±0.2 %"
    if given is None:
        rows[0, 0].figure.suptitle(title, fontsize="medium", y=0.995)
    return rows


def _control(result: Result, given: Any) -> Any:
    """Draw the control signal on both plants."""
    make = partial(wide_figure, 8.4, left=0.1, hspace=0.1, wspace=0.05)
    rows = grid_of_axes(given, make, len(result.cases), 2, sharex=True, sharey="row")
    for case, axes in zip(result.cases, rows, strict=True):
        for ax, kind in zip(axes, PLANTS, strict=True):
            for name in (MF, L, MB):  # the quietest in front
                run, style = case.outcomes[kind].records[name], _STYLES[name]
                style = style | {"linewidth": 0.7, "alpha": 0.8, "label": legend_label(name, run)}
                _line(ax, run, run["u"], (0.0, END - PROFILE_AT), **style)
        axes[0].set_ylabel(f"{case.label}\ncontrol signal [V]")
    for ax, kind in zip(rows[0], PLANTS, strict=True):
        ax.set_title(_HEADINGS[kind], fontsize="medium")
    rows[0, 0].legend(fontsize="small", loc="upper right", ncols=3)
    for ax in rows[-1]:
        ax.set_xlabel("time from the profile's start [s]")
    return rows


def _learning(result: Result, given: Any) -> Any:
    """Draw the coefficients of L-ESO with friction, and the parts of its estimate of f."""
    case = result.cases[-1]
    run = case.outcomes[FRICTION].records[L]
    above, below = axes = grid_of_axes(given, partial(wide_figure, 7.2, left=0.1), 2)[:, 0]
    # The identified plant's own coefficients, f = −(b0/b) a·x + (1 − b0/b)(…), as its gain is b and
    # not b0.
    numbers = -torsional_identified().A[-1] * B0 / float(torsional_identified().B[-1, 0])
    for i, feature in enumerate(run.features[:3]):
        draw_line(above, run.t, run["theta"][:, i], label=feature, color=f"C{i}", linewidth=1.2)
        above.axhline(-numbers[i], color=f"C{i}", linestyle=":", linewidth=1.2)
    title = (
        f"coefficients of L-ESO at {case.label} with friction; "
        "dotted: the identified plant's, for b0"
    )
    above.set_title(title, fontsize="medium")
    above.set(ylabel="theta", ylim=(-4000.0, 2000.0))
    for channel, label in ESTIMATES.items():
        smooth = _smooth(run[channel], run.dt * run.every)
        draw_line(below, run.t, smooth, label=label, linewidth=1.0)
    below.set_title("total disturbance as L-ESO has it, averaged over 20 ms", fontsize="medium")
    below.set(xlabel="time [s]", ylabel="f [rad/s⁴]", ylim=(-2e4, 2e4))
    for ax in (above, below):
        ax.axvline(PROFILE_AT, color="0.3", linewidth=1.0, linestyle="--")
        ax.set_xlim(0.0, END)
        ax.legend(fontsize="small", ncols=3, loc="upper right")
    return axes


def _smooth(values: Vector, dt: float) -> Vector:
    width = max(round(_SMOOTHED / dt), 1)
    return np.convolve(values, np.full(width, 1.0 / width), mode="same")


def _line(ax: Any, run: Trajectory, values: Vector, span: tuple[float, ...], **style: Any) -> None:
    """Draw values of a run in a span of time from the profile's start [s]."""
    part = run.window(PROFILE_AT + span[0], PROFILE_AT + span[1])
    if part.stop > part.start:
        draw_line(ax, run.t[part] - PROFILE_AT, values[part], **style)
    ax.set_xlim(*span)
