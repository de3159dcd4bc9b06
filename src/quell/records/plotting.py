"""Drawing of records: small files and quick figures from long runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from quell.guard import Reason
from quell.types import Vector

if TYPE_CHECKING:
    from quell.records.batch_trajectory import BatchTrajectory
    from quell.records.trajectory import Trajectory

# Shares of the runs that a band holds, and how dark it is.
_BANDS = ((100.0, "all", 0.15), (90.0, "90 %", 0.25), (50.0, "50 %", 0.4))
# About two points for each pixel of a wide figure.
_POINTS = 2000


def thinned(t: Vector, values: Vector, points: int = _POINTS) -> tuple[Vector, Vector]:
    """Return about ``points`` samples that draw the same line: the least and the largest of each stretch, in the order they came."""
    stretch = t.size // (points // 2)
    if stretch < 4:
        return t, values
    whole = t.size // stretch * stretch
    shaped = np.asarray(values[:whole]).reshape(-1, stretch)
    extremes = np.sort(
        np.stack([shaped.argmin(axis=1), shaped.argmax(axis=1)]), axis=0
    ) + np.arange(0, whole, stretch)
    keep = np.unique(np.concatenate([[0], extremes.T.ravel(), np.arange(whole, t.size)]))
    return t[keep], np.asarray(values)[keep]


def draw(ax: Any, t: Vector, values: Vector, **style: Any) -> None:
    """Draw a thinned line into matplotlib axes."""
    ax.plot(*thinned(t, values), **style)


def plot_trajectory(run: Trajectory, axes: Any = None) -> Any:
    """Draw output and reference, control signal, estimates of f and, where there is a guard, its authority; return the axes."""
    guarded = "authority" in run.names
    count = 4 if guarded and axes is None else 3
    if axes is None:
        import matplotlib.pyplot as plt

        _, axes = plt.subplots(
            count, 1, sharex=True, figsize=(8.0, 2.3 * count), layout="constrained"
        )
    if np.size(axes) not in (3, 4) or (np.size(axes) == 4 and not guarded):
        raise ValueError(
            f"axes: must be three matplotlib axes, or four for a run with a guard, got {np.size(axes)}"
        )
    t = run.t
    draw(axes[0], t, run["y"], label="y", color="C0")
    draw(axes[0], t, run["r"], label="r", color="0.3", linestyle="--", linewidth=1.0)
    draw(axes[1], t, run["u"], label="u", color="C1")
    for name, label in (
        ("f_hat", "estimate of f"),
        ("f_learned", "learned share"),
        ("f_residual", "residual"),
    ):
        if name in run.names:
            draw(axes[2], t, run[name], label=label, linewidth=1.0)
    if len(axes) == 4:
        _draw_guard(run, axes[3])
    for ax, label in zip(
        axes, ("output", "control signal", "total disturbance", "guard"), strict=False
    ):
        ax.set_ylabel(label)
        ax.legend(loc="upper right", fontsize="small", ncols=3 if label == "guard" else 1)
        ax.grid(alpha=0.3)
    axes[len(axes) - 1].set_xlabel("time [s]")
    if run.diverged:
        axes[0].set_title(f"ended at {run.ended:.3g} s: diverged", color="C3")
    return axes


def plot_batch(runs: BatchTrajectory, axes: Any = None) -> Any:
    """Draw output and control signal of a batch: median and bands of the runs that went through, and where others diverged."""
    if axes is None:
        import matplotlib.pyplot as plt

        _, axes = plt.subplots(2, 1, sharex=True, figsize=(8.0, 5.0), layout="constrained")
    if np.size(axes) != 2:
        raise ValueError(f"axes: must be two matplotlib axes, got {np.size(axes)}")
    whole, lost = np.flatnonzero(~runs.diverged), np.flatnonzero(runs.diverged)
    some = slice(None, None, max(runs.t.size // _POINTS, 1))
    t = runs.t[some]
    for ax, name, label, color in (
        (axes[0], "y", "output", "C0"),
        (axes[1], "u", "control signal", "C1"),
    ):
        if whole.size:
            values = runs[name][whole, some]
            shares = sorted(
                {
                    50.0,
                    *(50.0 + side * share / 2.0 for share, _, _ in _BANDS for side in (-1.0, 1.0)),
                }
            )
            at = dict(zip(shares, np.percentile(values, shares, axis=0), strict=True))
            for share, held, dark in _BANDS:
                ax.fill_between(
                    t,
                    at[50.0 - share / 2.0],
                    at[50.0 + share / 2.0],
                    color=color,
                    alpha=dark,
                    linewidth=0.0,
                    label=held,
                )
            ax.plot(t, at[50.0], color=color, label="median")
            # A run on its way to infinity would hide all others.
            low, high = float(at[5.0].min()), float(at[95.0].max())
            margin = 0.5 * (high - low) or 1.0
            ax.set_ylim(low - margin, high + margin)
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    if "r" in runs.names:
        axes[0].plot(t, runs["r"][0, some], color="0.3", linestyle="--", linewidth=1.0, label="r")
    # The lines of runs that diverged would cover all others; where each of them ended is marked below.
    if lost.size:
        axes[0].plot(
            runs.ended[lost],
            np.full(lost.size, 0.02),
            "|",
            color="C3",
            transform=axes[0].get_xaxis_transform(),
            label="diverged",
        )
    axes[0].legend(loc="upper right", fontsize="small", ncols=3)
    axes[1].set_xlabel("time [s]")
    axes[0].set_title(
        f"{len(runs)} runs, {lost.size} diverged",
        color="C3" if lost.size else "0.2",
        fontsize="medium",
    )
    return axes


def _draw_guard(run: Trajectory, ax: Any) -> None:
    """Draw the authority, the share of the plain observer's error that is left with the learner, and where it was held back and why."""
    t, authority, plain = run.t, run["authority"], run["error_plain"]
    left = np.minimum(
        np.divide(run["error_learned"], plain, out=np.ones_like(plain), where=plain > 0.0), 1.5
    )
    draw(ax, t, authority, label="authority", color="C2")
    draw(ax, t, left, label="error left at full authority", color="C4", linewidth=1.0)
    shown = [
        Reason.TOO_LOUD,
        Reason.OUT_OF_BOUNDS,
        Reason.TOO_FAST,
        Reason.EXPLODED,
        Reason.NOT_FINITE,
    ]
    for i, reason in enumerate(shown):
        at = t[run["reason"] == reason]
        if at.size:
            at = at[:: max(at.size // 500, 1)]
            label = reason.name.lower().replace("_", " ")
            ax.plot(
                at,
                np.full(at.size, -0.08 - 0.06 * i),
                "|",
                markersize=4.0,
                color=f"C{5 + i}",
                label=label,
            )
    ax.set_ylim(-0.45, 2.1)  # room for the legend
