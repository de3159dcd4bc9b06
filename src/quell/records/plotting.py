"""Plots of records, with long lines reduced to few points for small files and quick figures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.guard import Reason
from quell.records.record import Record
from quell.types import Vector

# Share of the runs in a band [%], its label and opacity; chosen by hand.
_BANDS = ((100.0, "all", 0.15), (90.0, "90 %", 0.25), (50.0, "50 %", 0.4))
# About two points for each pixel of a wide figure.
_POINTS = 2000
_ESTIMATES = {"f_hat": "estimate of f", "f_learned": "learned share", "f_residual": "residual"}
# Reasons for a reduced authority that are marked in the plot of the guard.
_MARKED = (
    Reason.TOO_LOUD,
    Reason.OUT_OF_BOUNDS,
    Reason.EXPLODED,
    Reason.NOT_FINITE,
)


def thinned(t: Vector, values: Vector, points: int = _POINTS) -> tuple[Vector, Vector]:
    """Return about ``points`` samples that draw the same line: the extremes of each interval."""
    interval = t.size // (points // 2)
    if interval < 4:
        return t, values
    whole = t.size // interval * interval
    rows = np.asarray(values[:whole]).reshape(-1, interval)
    extremes = np.sort(np.stack([rows.argmin(axis=1), rows.argmax(axis=1)]), axis=0)
    extremes += np.arange(0, whole, interval)
    keep = np.unique(np.concatenate([[0], extremes.T.ravel(), np.arange(whole, t.size)]))
    return t[keep], np.asarray(values)[keep]


def draw_line(ax: Any, t: Vector, values: Vector, **style: Any) -> None:
    """Draw a thinned line into matplotlib axes."""
    ax.plot(*thinned(t, values), **style)


def plot_run(run: Record, diverged_at: float | None, axes: Any = None) -> Any:
    """Draw output and reference, control signal, estimates of f and, with a guard, its authority.

    ``diverged_at`` is the time at which the run diverged [s], if it did. Returns the axes.
    """
    guarded = "authority" in run.names
    if axes is None:
        axes = _new_axes(4 if guarded else 3, 2.3)
    if np.size(axes) not in ((3, 4) if guarded else (3,)):
        rule = "must be three matplotlib axes, or four for a run with a guard"
        raise ValueError(f"axes: {rule}, got {np.size(axes)}")
    t = run.t
    draw_line(axes[0], t, run["y"], label="y", color="C0")
    draw_line(axes[0], t, run["r"], label="r", color="0.3", linestyle="--", linewidth=1.0)
    draw_line(axes[1], t, run["u"], label="u", color="C1")
    for name, label in _ESTIMATES.items():
        if name in run.names:
            draw_line(axes[2], t, run[name], label=label, linewidth=1.0)
    if len(axes) == 4:
        _draw_guard(run, axes[3])
    labels = ("output", "control signal", "total disturbance", "guard")
    for ax, label in zip(axes, labels, strict=False):
        ax.set_ylabel(label)
        ax.legend(loc="upper right", fontsize="small", ncols=3 if label == "guard" else 1)
        ax.grid(alpha=0.3)
    axes[len(axes) - 1].set_xlabel("time [s]")
    if diverged_at is not None:
        axes[0].set_title(f"ended at {diverged_at:.3g} s: diverged", color="C3")
    return axes


def plot_batch(runs: Record, diverged: NDArray[np.bool_], ended: Vector, axes: Any = None) -> Any:
    """Draw output and control signal: median and bands of the runs, ends of diverged ones.

    ``diverged`` and ``ended`` [s] have an entry for each run. Returns the axes.
    """
    if axes is None:
        axes = _new_axes(2, 2.5)
    if np.size(axes) != 2:
        raise ValueError(f"axes: must be two matplotlib axes, got {np.size(axes)}")
    some = slice(None, None, max(runs.t.size // _POINTS, 1))
    t = runs.t[some]
    for ax, name, label, color in (
        (axes[0], "y", "output", "C0"),
        (axes[1], "u", "control signal", "C1"),
    ):
        if not np.all(diverged):
            _draw_bands(ax, t, runs[name][~diverged, some], color)
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    if "r" in runs.names:
        axes[0].plot(t, runs["r"][0, some], color="0.3", linestyle="--", linewidth=1.0, label="r")
    lost = ended[diverged]
    if lost.size:
        # The lines of runs that diverged would cover all others: mark their ends only.
        heights, transform = np.full(lost.size, 0.02), axes[0].get_xaxis_transform()
        axes[0].plot(lost, heights, "|", color="C3", transform=transform, label="diverged")
    axes[0].legend(loc="upper right", fontsize="small", ncols=3)
    axes[1].set_xlabel("time [s]")
    title = f"{diverged.size} runs, {lost.size} diverged"
    axes[0].set_title(title, color="C3" if lost.size else "0.2", fontsize="medium")
    return axes


def _new_axes(count: int, height: float) -> Any:
    """Return ``count`` axes over one time axis, each ``height`` inches high."""
    import matplotlib.pyplot as plt

    size = (8.0, height * count)
    return plt.subplots(count, 1, sharex=True, figsize=size, layout="constrained")[1]


def _draw_bands(ax: Any, t: Vector, values: Vector, color: str) -> None:
    """Draw the median of ``values`` (runs, samples) and the bands around it."""
    limits = [(50.0 - share / 2.0, 50.0 + share / 2.0) for share, _, _ in _BANDS]
    levels = sorted({50.0, *(level for pair in limits for level in pair)})
    at = dict(zip(levels, np.percentile(values, levels, axis=0), strict=True))
    for (low, high), (_, label, opacity) in zip(limits, _BANDS, strict=True):
        style = {"color": color, "alpha": opacity, "linewidth": 0.0, "label": label}
        ax.fill_between(t, at[low], at[high], **style)
    ax.plot(t, at[50.0], color=color, label="median")
    # A run that is about to diverge would hide all others.
    bottom, top = float(at[5.0].min()), float(at[95.0].max())
    margin = 0.5 * (top - bottom) or 1.0
    ax.set_ylim(bottom - margin, top + margin)


def _draw_guard(run: Record, ax: Any) -> None:
    """Draw the authority, the error left by the learner, and why the authority was reduced.

    The error is a share of that of an observer without learner.
    """
    t, authority, plain = run.t, run["authority"], run["error_plain"]
    left = np.divide(run["error_learned"], plain, out=np.ones_like(plain), where=plain > 0.0)
    draw_line(ax, t, authority, label="authority", color="C2")
    label = "error left at full authority"
    draw_line(ax, t, np.minimum(left, 1.5), label=label, color="C4", linewidth=1.0)
    for i, reason in enumerate(_MARKED):
        at = t[run["reason"] == reason]
        if at.size:
            at = at[:: max(at.size // 500, 1)]
            heights = np.full(at.size, -0.08 - 0.06 * i)
            label = reason.name.lower().replace("_", " ")
            ax.plot(at, heights, "|", markersize=4.0, color=f"C{5 + i}", label=label)
    ax.set_ylim(-0.45, 2.1)  # room for the legend
