"""Plots of records, with long lines reduced to few points, and a style for figures of papers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.guard import Reason
from quell.quantities import Quantity
from quell.records.record import Record, flags_of
from quell.types import Status, Vector

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Share of the runs in a band [%], its label and opacity; chosen by hand.
_BANDS = ((100.0, "all", 0.15), (90.0, "90 %", 0.25), (50.0, "50 %", 0.4))
# About two points for each pixel of a wide figure.
_POINTS = 2000
# A limit farther away than so many times the largest |u| would hide the signal. Chosen by hand.
_NEAR_LIMIT = 3.0
_ESTIMATES = {"f_hat": "estimate of f", "f_learned": "learned share", "f_residual": "residual"}
# Reasons for a reduced authority that are marked in the plot of the guard.
_MARKED = (
    Reason.TOO_LOUD,
    Reason.OUT_OF_BOUNDS,
    Reason.WITHHELD,
    Reason.EXPLODED,
    Reason.NOT_FINITE,
    Reason.FAILED,
)
# A longer label [characters] is higher than its panel of a run: its unit stands below.
_LABEL = 20
# Widths of a figure over one and two columns of IEEE's journals, 3.5 and 7.16 inches, and the share
# of its width that its height is.
_WIDTHS, _HEIGHT = {1: 3.5, 2: 7.16}, 0.62
# Colours that readers with any colour vision tell apart (Okabe & Ito, *Color Universal Design*,
# 2008), without yellow, which is too light for lines.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
# Each line differs in its dashes, too: prints are often grey.
_DASHES = ("-", "--", "-.", ":", "-", "--", "-.")


def thinned(t: Vector, values: Vector) -> tuple[Vector, Vector]:
    """Return about ``_POINTS`` samples that draw the same line: the extremes of each interval."""
    interval = t.size // (_POINTS // 2)
    if interval < 4:
        return t, values
    whole = t.size // interval * interval
    rows = np.asarray(values[:whole]).reshape(-1, interval)
    extremes = np.sort(np.stack([rows.argmin(axis=1), rows.argmax(axis=1)]), axis=0)
    extremes += np.arange(0, whole, interval)
    keep = np.unique(np.concatenate([[0], extremes.T.ravel(), np.arange(whole, t.size)]))
    return t[keep], np.asarray(values)[keep]


def draw_line(ax: Axes, t: Vector, values: Vector, **style: Any) -> None:
    """Draw a thinned line into matplotlib axes."""
    ax.plot(*thinned(t, values), **style)


def given_axes(axes: Any, ax: Any) -> Any:
    """Return the axes of a call that takes them by either name; rows of axes in one vector.

    Raises
    ------
    ValueError
        if both are given.
    """
    if axes is not None and ax is not None:
        raise ValueError("axes and ax: are two names of the same; give one")
    found = ax if axes is None else axes
    return np.ravel(found) if np.ndim(found) > 1 else found


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure [inch] of ``pyplot`` that is laid out automatically."""
    import matplotlib.pyplot as plt

    return plt.figure(figsize=(width, height), layout="constrained")


def grid_of_axes(
    ax: Any, make: Callable[[], Any], rows: int, columns: int = 1, **shared: Any
) -> Any:
    """Return axes (rows, columns): those given, or new ones in a figure that ``make`` returns.

    Raises
    ------
    ValueError
        for another number of axes.
    """
    if ax is None:
        return make().subplots(rows, columns, squeeze=False, **shared)
    found = np.ravel(np.asarray(ax, dtype=object))
    if found.size != rows * columns:
        raise ValueError(f"ax: must be {rows * columns} matplotlib axes, got {found.size}")
    return found.reshape(rows, columns)


def plot_run(run: Any, diverged_at: float | None, axes: Any = None) -> Any:
    """Draw output and reference, control signal, estimates of f, the guard's authority, the error.

    ``run`` is a ``Trajectory``, ``diverged_at`` the time at which it diverged [s], if it did.
    Returns the axes in this order, without those that the run has nothing for.
    """
    panels = [_draw_output, _draw_control, _draw_estimates]
    panels += [_draw_guard] if "authority" in run.names else []
    new = axes is None
    if new:
        if not any(name in run.names for name in _ESTIMATES):
            panels.remove(_draw_estimates)
        panels.append(_draw_error)
        count = len(panels)
        # The error is below the output, and last in the array.
        below = _new_axes(count, 1.5)
        axes = below[[0, *range(2, count), 1]]
    elif np.size(axes) == len(panels) + 1:
        panels.append(_draw_error)
    if np.size(axes) != len(panels):
        more = len(panels)
        rule = f"must be {more} matplotlib axes for this run, or {more + 1} with the error"
        raise ValueError(f"axes: {rule}, got {np.size(axes)}")
    for ax, draw in zip(axes, panels, strict=True):
        draw(run, ax)
        # Beside the axes, where it hides no data.
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize="small", frameon=False)
        ax.grid(alpha=0.3)
        if new and len(label := ax.get_ylabel()) > _LABEL:
            ax.set_ylabel(label.replace(" [", "\n["))
    axes[-2 if new else -1].set_xlabel("time [s]")
    if diverged_at is not None:
        axes[0].set_title(f"ended at {diverged_at:.3g} s: diverged", color="C3")
    return axes


def _draw_output(run: Any, ax: Axes) -> None:
    draw_line(ax, run.t, run["y"], label="y", color="C0")
    # Above y, so that it is seen where both are equal.
    draw_line(ax, run.t, run["r"], label="r", color="0.2", linestyle=(0, (4, 3)), linewidth=1.2)
    ax.set_ylabel(run.signals.y.label("output"))


def _draw_error(run: Any, ax: Axes) -> None:
    draw_line(ax, run.t, run["r"] - run["y"], label="r − y", color="C3", linewidth=1.0)
    ax.axhline(0.0, color="0.6", linewidth=0.8)
    ax.set_ylabel(Quantity("error", run.signals.y.unit).label("error"))


def _draw_control(run: Any, ax: Axes) -> None:
    u = run["u"]
    draw_line(ax, run.t, u, label="u", color="C1")
    reach = float(np.max(np.abs(u), initial=0.0))
    shown = [at for at in run.u_limits if np.isfinite(at) and abs(at) <= _NEAR_LIMIT * reach]
    for i, at in enumerate(shown):
        label = None if i else "limit"
        ax.axhline(at, color="0.4", linestyle=":", linewidth=1.2, label=label)
    if "status" in run.names:
        held = (flags_of(run["status"]) & int(Status.SATURATED)) != 0
        edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]]).astype(np.int8)))
        spans = edges.reshape(-1, 2)
        if len(spans):
            step = run.every * run.dt
            bars = [(low * step, (high - low) * step) for low, high in _joined(spans, len(run))]
            style: dict[str, Any] = {
                "transform": ax.get_xaxis_transform(),
                "color": "C3",
                "alpha": 0.15,
            }
            ax.broken_barh(bars, (0.0, 1.0), label="saturated", linewidth=0.0, **style)
    ax.set_ylabel(run.signals.u.label("control signal"))


def _joined(spans: NDArray[np.int64], samples: int) -> list[tuple[int, int]]:
    """Return spans of samples, those joined whose gap is too small to be seen."""
    gap, found = samples / _POINTS, [tuple(spans[0].tolist())]
    for low, high in spans[1:].tolist():
        if low - found[-1][1] < gap:
            found[-1] = (found[-1][0], high)
        else:
            found.append((low, high))
    return found


def _draw_estimates(run: Any, ax: Axes) -> None:
    learner = "f_learned" in run.names and (bool(run.features) or np.any(run["f_learned"]))
    for name, label in _ESTIMATES.items():
        if name in run.names and (name == "f_hat" or learner):
            draw_line(ax, run.t, run[name], label=label, linewidth=1.0)
    unit = run.signals.unit("y-unit/s^n") if run.signals.y.unit else ""
    ax.set_ylabel(Quantity(run.signals.f.name, unit).label("total disturbance"))


def draw_loop(run: Any, axes: Any) -> None:
    """Draw outputs with their references, and all control signals, into two matplotlib axes."""
    rows = (("y", "output", "C0"), ("u", "control signal", "C1"))
    for ax, (name, label, color) in zip(axes, rows, strict=True):
        for wanted in run["r"].reshape(len(run), -1).T if name == "y" and "r" in run.names else ():
            draw_line(ax, run.t, wanted, color="0.2", linestyle=(0, (4, 3)), linewidth=1.2)
        values = run[name].reshape(len(run), -1)
        for k, column in enumerate(values.T):
            draw_line(ax, run.t, column, color=color if values.shape[1] == 1 else f"C{k % 10}")
        known = getattr(run.signals, name)
        ax.set_ylabel(label if isinstance(known, tuple) else (known or Quantity()).label(label))
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("time [s]")


def plot_axes(run: Any, axes: Any = None) -> Any:
    """Draw output, error and estimates of each axis of a machine, and all control signals.

    Returns the matplotlib axes: a row of outputs, of errors, of
    estimates, and one for the control signals.
    """
    if not run.axis_names:
        return _plot_signals(run, axes)
    machine = [run.axis(i) for i in range(len(run.axis_names))]
    count = len(machine)
    if axes is None:
        figure = new_figure(4.2 * count, 8.5)
        grid = figure.add_gridspec(4, count)
        places = [grid[row, i] for row in range(3) for i in range(count)]
        axes = np.array([figure.add_subplot(place) for place in [*places, grid[3, :]]])
    axes = np.ravel(axes)
    if axes.size != 3 * count + 1:
        raise ValueError(f"axes: must be {3 * count + 1} matplotlib axes, got {axes.size}")
    for i, (name, axis) in enumerate(zip(run.axis_names, machine, strict=True)):
        column = axes[i : 3 * count : count]
        for ax, draw in zip(column, (_draw_output, _draw_error, _draw_estimates), strict=True):
            draw(axis, ax)
            ax.legend(loc="upper right", fontsize="small")
            ax.grid(alpha=0.3)
            if i:
                ax.set_ylabel("")
        column[0].set_title(name)
    u = run["u"].reshape(len(run), -1)
    for k in range(u.shape[1]):
        draw_line(axes[-1], run.t, u[:, k], label=f"u[{k}]", color=f"C{k % 10}", linewidth=1.0)
    axes[-1].set_ylabel("control signals")
    axes[-1].set_xlabel("time [s]")
    axes[-1].legend(loc="upper right", fontsize="small")
    axes[-1].grid(alpha=0.3)
    if run.diverged:
        axes[0].set_title(f"ended at {run.ended:.3g} s: diverged", color="C3")
    return axes


def _plot_signals(run: Any, axes: Any) -> Any:
    """Draw outputs with references, control signals and disturbances of a loop without axes."""
    axes = np.ravel(_new_axes(3, 2.5) if axes is None else axes)
    if axes.size != 3:
        raise ValueError(f"axes: must be 3 matplotlib axes, got {axes.size}")
    rows = (("y", "outputs"), ("u", "control signals"), ("d_hat", "disturbances"))
    for ax, (name, label) in zip(axes, rows, strict=True):
        values = run[name].reshape(len(run), -1)
        for k in range(values.shape[1]):
            draw_line(ax, run.t, values[:, k], label=f"{name}[{k}]", color=f"C{k % 10}")
        if name == "y":
            for wanted in run["r"].reshape(len(run), -1).T:
                draw_line(ax, run.t, wanted, color="0.2", linestyle=(0, (4, 3)), linewidth=1.2)
        ax.set_ylabel(label)
        ax.legend(loc="upper right", fontsize="small")
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("time [s]")
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
        known = runs.signals.y if name == "y" else runs.signals.u
        ax.set_ylabel(known.label(label))
        ax.grid(alpha=0.3)
    if "r" in runs.names:
        axes[0].plot(t, runs["r"][0, some], color="0.3", linestyle="--", linewidth=1.0, label="r")
    lost = ended[diverged]
    if lost.size:
        # The lines of runs that diverged would cover all others: mark their ends only.
        heights, transform = np.full(lost.size, 0.02), axes[0].get_xaxis_transform()
        axes[0].plot(lost, heights, "|", color="C3", transform=transform, label="diverged")
    beside = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.02), "frameon": False}
    axes[0].legend(fontsize="small", **beside)
    axes[1].set_xlabel("time [s]")
    title = f"{diverged.size} runs, {lost.size} diverged"
    axes[0].set_title(title, color="C3" if lost.size else "0.2", fontsize="medium")
    return axes


def plot_batch_of_axes(runs: Any, axes: Any = None) -> Any:
    """Draw output and v of each axis of a batch of machines; return the axes (2 n,), y first."""
    count = len(runs.axis_names)
    if not count:
        raise ValueError("the loop has several signals and no axes: plot columns of runs['y']")
    if axes is None:
        axes = new_figure(1.0 + 4.2 * count, 5.0).subplots(2, count, sharex=True)
    axes = np.ravel(axes)
    if axes.size != 2 * count:
        raise ValueError(f"axes: must be {2 * count} matplotlib axes, got {axes.size}")
    for i, name in enumerate(runs.axis_names):
        plot_batch(runs.axis(i), runs.diverged, runs.ended, axes[i::count])
        axes[i].set_title(f"{name}: {axes[i].get_title()}", fontsize="medium")
        axes[count + i].set_ylabel("v")
        if i < count - 1:
            axes[i].get_legend().remove()
    return axes


def _new_axes(count: int, height: float) -> Any:
    """Return ``count`` axes over one time axis, each ``height`` inches high."""
    import matplotlib.pyplot as plt

    size = (8.0, height * count)
    return plt.subplots(count, 1, sharex=True, figsize=size, layout="constrained")[1]


def _draw_bands(ax: Axes, t: Vector, values: Vector, color: str) -> None:
    """Draw the median of ``values`` (runs, samples) and the bands around it."""
    limits = [(50.0 - share / 2.0, 50.0 + share / 2.0) for share, _, _ in _BANDS]
    levels = sorted({50.0, *(level for pair in limits for level in pair)})
    at = dict(zip(levels, np.percentile(values, levels, axis=0), strict=True))
    for (low, high), (_, label, opacity) in zip(limits, _BANDS, strict=True):
        style: dict[str, Any] = {"color": color, "alpha": opacity, "linewidth": 0.0, "label": label}
        ax.fill_between(t, at[low], at[high], **style)
    ax.plot(t, at[50.0], color=color, label="median")
    # A run that is about to diverge would hide all others.
    bottom, top = float(at[5.0].min()), float(at[95.0].max())
    margin = 0.5 * (top - bottom) or 1.0
    ax.set_ylim(bottom - margin, top + margin)


def _draw_guard(run: Any, ax: Axes) -> None:
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
    ax.set_ylim(-0.45, 1.6)
    ax.set_ylabel("guard")


def style(columns: int = 1) -> dict[str, Any]:
    """Return settings of matplotlib for a figure in a paper.

    The figure is as wide as one or two columns, its text has 8 points in a serif font with matching
    formulas, lines differ in colour and dashes, and PDF and PostScript contain TrueType fonts, as
    IEEE asks for.

    Parameters
    ----------
    columns
        columns that the figure is wide, 1 or 2.

    Raises
    ------
    ValueError
        for another number of columns.

    Examples
    --------
    >>> import matplotlib
    >>> import quell as ql
    >>> with matplotlib.rc_context(ql.style(columns=2)):
    ...     matplotlib.rcParams["figure.figsize"][0]
    7.16
    """
    from cycler import cycler

    width = _WIDTHS[checks.whole("columns", columns, 1, 2)]
    return {
        "figure.figsize": (width, _HEIGHT * width),
        "figure.constrained_layout.use": True,
        "savefig.dpi": 600,
        "font.family": "serif",
        "font.serif": ["Times New Roman", "Times", "STIXGeneral", "DejaVu Serif"],
        "mathtext.fontset": "stix",
        "font.size": 8.0,
        "axes.titlesize": 8.0,
        "axes.labelsize": 8.0,
        "legend.fontsize": 7.0,
        "xtick.labelsize": 7.0,
        "ytick.labelsize": 7.0,
        "axes.prop_cycle": cycler(color=_COLORS) + cycler(linestyle=_DASHES),
        "lines.linewidth": 1.0,
        "axes.linewidth": 0.6,
        "axes.grid": True,
        "grid.alpha": 0.3,
        "grid.linewidth": 0.4,
        "legend.frameon": False,
        "pdf.fonttype": 42,
        "ps.fonttype": 42,
    }
