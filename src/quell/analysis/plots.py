"""Plots of loops: Bode plot, gang of four, margins over time or bandwidth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.analysis.loop import LoopAnalysis
from quell.analysis.sweeps import loops_over_omega_o
from quell.controllers.base import Controller
from quell.types import Vector

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AID: dict[str, Any] = {"color": "0.5", "linewidth": 0.8}


def plot_bode(loop: LoopAnalysis, axes: Any = None, **style: Any) -> list[Axes]:
    """Plot gain and phase of the loop ``L = P C_y`` with its margins; return the axes.

    The margins' numbers are written only into a new figure: with a second loop they would overlap.

    Parameters
    ----------
    loop
        from ``analyse``.
    axes
        two matplotlib axes; a new figure by default.
    style
        of the lines, for example ``label``.

    Raises
    ------
    ValueError
        for another number of axes.
    """
    new_figure = axes is None
    top, low = axes = _axes(axes, 2, 1)
    # At half the sampling rate itself a sampled plant may have a zero, and no phase.
    omega = loop.omega[:-1]
    L = loop.response("L", omega)
    phase = np.degrees(np.unwrap(np.angle(L)))
    margins = loop.margins
    crossing = margins.phase_omega if np.isfinite(margins.phase_omega) else omega[-1]
    phase -= 360.0 * np.ceil(np.interp(crossing, omega, phase) / 360.0)
    (line,) = top.loglog(omega, np.abs(L), **style)
    low.semilogx(omega, phase, color=line.get_color())
    top.axhline(1.0, **_AID)
    low.axhline(-180.0, **_AID)

    def mark(ax: Axes, omega: float, ends: tuple[float, float], text: str, middle: float) -> None:
        ax.vlines(omega, *ends, color=line.get_color(), linewidth=2.5, alpha=0.6)
        if new_figure:
            ax.annotate(text, (omega, middle), xytext=(5, -3), textcoords="offset points")

    if np.isfinite(margins.phase_omega):
        at = float(np.interp(margins.phase_omega, omega, phase))
        mark(low, margins.phase_omega, (-180.0, at), f"{margins.phase:.0f}°", 0.5 * (at - 180.0))
    for factor, at in zip(margins.gain, margins.gain_omega, strict=True):
        if np.isfinite(at):
            ends = min(1.0, 1.0 / factor), max(1.0, 1.0 / factor)
            mark(top, at, ends, f"{factor:.2g}", factor**-0.5)
    _limit_ratio(top, np.abs(L))
    low.set_ylim(max(float(np.min(phase)), -720.0) - 20.0, min(float(np.max(phase)), 180.0) + 20.0)
    for ax, label in zip(axes, ("|L|", "phase of L [°]"), strict=True):
        _finish(ax, label, loop)
    low.set_xlabel("ω [rad/s]")
    return axes


def plot_gang_of_four(loop: LoopAnalysis, axes: Any = None, **style: Any) -> list[Axes]:
    """Plot the gains of S, T, PS (load to y) and CS (noise to u); return these four axes.

    The parameters are those of ``plot_bode``, but with four axes.

    Raises
    ------
    ValueError
        for another number of axes.
    """
    axes = _axes(axes, 2, 2)
    meanings = ("", "", ": load at the plant's input to y", ": measurement noise to u")
    for ax, name, meaning in zip(axes, ("S", "T", "PS", "CS"), meanings, strict=True):
        gain = np.abs(loop.response(name, loop.omega))
        ax.loglog(loop.omega, gain, **style)
        _limit_ratio(ax, gain)
        if name in ("S", "T"):
            ax.axhline(1.0, **_AID)
        ax.set_title(f"|{name}|{meaning}", fontsize="medium")
        _finish(ax, "", loop)
    for ax in axes[2:]:
        ax.set_xlabel("ω [rad/s]")
    return axes


def plot_margins_over_time(
    times: Any, loops: Sequence[LoopAnalysis], axes: Any = None, **style: Any
) -> list[Axes]:
    """Plot the margins of the loop with its learner frozen at each instant; return the axes.

    Parameters
    ----------
    times
        instants [s].
    loops
        one for each, from ``loops_over_time``.
    axes, style
        as for ``plot_bode``, but with three axes.

    Raises
    ------
    ValueError
        for another number of loops than instants, or of axes.
    """
    axes = _plot_margins(checks.vector("times", times), loops, axes, style)
    axes[-1].set_xlabel("learner frozen at [s]")
    return axes


def plot_margins_against_omega_o(
    plant: Any,
    make_controller: Callable[[float], Controller],
    omegas: Any,
    axes: Any = None,
    **lags: float,
) -> list[Axes]:
    """Plot the margins, and the noise in u, over the observer's bandwidth; return the axes.

    Parameters
    ----------
    plant, make_controller, omegas, lags
        as for ``loops_over_omega_o``.
    axes
        four matplotlib axes; a new figure by default.

    Raises
    ------
    ValueError
        as ``loops_over_omega_o``; for another number of axes.
    """
    loops = loops_over_omega_o(plant, make_controller, omegas, **lags)
    omegas = checks.vector("omegas", omegas)
    axes = _axes(axes, 4, 1)
    _plot_margins(omegas, loops, axes[:3], {})
    axes[3].loglog(omegas, [loop.noise_to_control if loop.stable else np.nan for loop in loops])
    _finish(axes[3], "RMS of u per\nRMS of noise")
    for ax in axes:
        ax.set_xscale("log")
    axes[3].set_xlabel("omega_o [rad/s]")
    return axes


def _plot_margins(
    x: Vector, loops: Sequence[LoopAnalysis], axes: Any, style: dict[str, Any]
) -> list[Axes]:
    if len(x) != len(loops):
        raise ValueError(f"loops has {len(loops)} entries: must have {len(x)}, one for each point")
    axes = _axes(axes, 3, 1)
    for ax, name in ((axes[0], "modulus"), (axes[0], "disk"), (axes[1], "phase")):
        legend = {} if name == "phase" else {"label": f"{name} margin"}
        ax.plot(x, [getattr(loop.margins, name) for loop in loops], **(legend | style))
    for ax in axes[:2]:
        ax.set_ylim(0.0, None)
    low, high = np.array([loop.b_range if loop.stable else (np.nan, np.nan) for loop in loops]).T
    # A range may begin at zero or be infinite, which a logarithmic axis does not show.
    axes[2].fill_between(x, np.maximum(low, 1e-3), np.minimum(high, 1e3), alpha=0.3, **style)
    axes[2].set_yscale("log")
    axes[2].axhline(1.0, **_AID)
    gain = "gain" if any(loop.b_over_b0 is None for loop in loops) else "b/b0"
    labels = ("margin", "phase margin [°]", f"{gain} for which\nit is stable")
    for ax, label in zip(axes, labels, strict=True):
        _finish(ax, label)
    axes[0].legend(fontsize="small")
    return axes


def _axes(axes: Any, rows: int, columns: int) -> list[Axes]:
    """Return the axes as a list; those of a new figure for None."""
    if axes is None:
        import matplotlib.pyplot as plt

        size = (4.0 * columns if columns > 1 else 7.0, 2.4 * rows if rows < 4 else 1.9 * rows)
        _, axes = plt.subplots(rows, columns, sharex=True, figsize=size, layout="constrained")
    axes = list(np.ravel(axes))
    if len(axes) != rows * columns:
        raise ValueError(f"axes: must be {rows * columns} matplotlib axes, got {len(axes)}")
    return axes


def _limit_ratio(ax: Axes, size: Vector) -> None:
    """Limit the axis to six decades about the median, to leave out undamped poles and zeros."""
    finite = size[np.isfinite(size) & (size > 0.0)]
    middle = float(np.median(finite))
    low, high = 0.5 * float(np.min(finite)), 2.0 * float(np.max(finite))
    ax.set_ylim(max(low, 1e-6 * middle), min(high, 1e6 * middle))


def _finish(ax: Axes, label: str, loop: LoopAnalysis | None = None) -> None:
    """Add label and grid and, for a ``loop``, a line at half its sampling rate."""
    if loop is not None:
        ax.axvline(np.pi / loop.dt, color="0.7", linestyle=":", linewidth=1.0)
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)
