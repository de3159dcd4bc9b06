"""Drawing of records: small files and quick figures from long runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from quell.types import Vector

if TYPE_CHECKING:
    from quell.trajectory import Trajectory

# About two points for each pixel of a wide figure.
_POINTS = 2000


def thinned(t: Vector, values: Vector, points: int = _POINTS) -> tuple[Vector, Vector]:
    """Return about ``points`` samples that draw the same line: the least and the largest of each stretch, in the order they came."""
    stretch = t.size // (points // 2)
    if stretch < 4:
        return t, values
    whole = t.size // stretch * stretch
    shaped = np.asarray(values[:whole]).reshape(-1, stretch)
    extremes = np.sort(np.stack([shaped.argmin(axis=1), shaped.argmax(axis=1)]), axis=0) + np.arange(0, whole, stretch)
    keep = np.unique(np.concatenate([[0], extremes.T.ravel(), np.arange(whole, t.size)]))
    return t[keep], np.asarray(values)[keep]


def draw(ax: Any, t: Vector, values: Vector, **style: Any) -> None:
    """Draw a thinned line into matplotlib axes."""
    ax.plot(*thinned(t, values), **style)


def plot_trajectory(run: Trajectory, axes: Any = None) -> Any:
    """Draw output and reference, control signal and estimates of f into three axes; return them."""
    if axes is None:
        import matplotlib.pyplot as plt

        _, axes = plt.subplots(3, 1, sharex=True, figsize=(8.0, 7.0), layout="constrained")
    if np.size(axes) != 3:
        raise ValueError(f"axes: must be three matplotlib axes, got {np.size(axes)}")
    t = run.t
    draw(axes[0], t, run["y"], label="y", color="C0")
    draw(axes[0], t, run["r"], label="r", color="0.3", linestyle="--", linewidth=1.0)
    draw(axes[1], t, run["u"], label="u", color="C1")
    for name, label in (("f_hat", "estimate of f"), ("f_learned", "learned share"), ("f_residual", "residual")):
        if name in run.names:
            draw(axes[2], t, run[name], label=label, linewidth=1.0)
    for ax, label in zip(axes, ("output", "control signal", "total disturbance"), strict=True):
        ax.set_ylabel(label)
        ax.legend(loc="upper right", fontsize="small")
        ax.grid(alpha=0.3)
    axes[2].set_xlabel("time [s]")
    if run.diverged:
        axes[0].set_title(f"ended at {run.ended:.3g} s: diverged", color="C3")
    return axes
