"""Plots of loops: Bode plot, gang of four, margins over time or bandwidth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.analysis.loop import LoopAnalysis
from quell.analysis.sweeps import loops_over_omega_o
from quell.controllers.base import Controller
from quell.records.plotting import given_axes
from quell.types import Vector

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AID: dict[str, Any] = {"color": "0.5", "linewidth": 0.8}


def plot_bode(
    loop: LoopAnalysis,
    axes: Any = None,
    *,
    ax: Any = None,
    decibels: bool = False,
    hertz: bool = False,
    **style: Any,
) -> list[Axes]:
    """Plot gain and phase of the loop ``L = P C_y`` with its margins; return the axes.

    The margins' numbers are written above the axes, and only into a new figure: with a second loop
    they would overlap.

    Parameters
    ----------
    loop
        from ``analyse``.
    axes, ax
        two matplotlib axes; a new figure by default.
    decibels
        draw the gain in dB.
    hertz
        draw over the frequency in Hz; over ω in rad/s by default.
    style
        of the lines, for example ``label``.

    Raises
    ------
    ValueError
        for another number of axes.
    """
    axes = given_axes(axes, ax)
    new_figure = axes is None
    scale = 1.0 / (2.0 * np.pi) if hertz else 1.0
    gain: Any = _in_decibels if decibels else np.asarray
    top, low = axes = _axes(axes, 2, 1)
    # At half the sampling rate itself a sampled plant may have a zero, and no phase.
    omega = loop.omega[:-1]
    L = loop.response("L", omega)
    phase = np.degrees(np.unwrap(np.angle(L)))
    margins = loop.margins
    crossing = margins.phase_omega if np.isfinite(margins.phase_omega) else omega[-1]
    phase -= 360.0 * np.ceil(np.interp(crossing, omega, phase) / 360.0)
    others = [_limits_of_others(each) for each in axes]
    (line,) = top.semilogx(scale * omega, gain(np.abs(L)), **style)
    low.semilogx(scale * omega, phase, color=line.get_color())
    top.axhline(gain(1.0), **_AID)
    low.axhline(-180.0, **_AID)

    unit = "Hz" if hertz else "rad/s"

    def mark(ax: Axes, omega: float, ends: tuple[Any, Any]) -> None:
        ax.vlines(scale * omega, *ends, color=line.get_color(), linewidth=2.5, alpha=0.6)

    if np.isfinite(margins.phase_omega):
        at = float(np.interp(margins.phase_omega, omega, phase))
        mark(low, margins.phase_omega, (-180.0, at))
        if new_figure:
            text = f"phase margin {margins.phase:.0f}° at {scale * margins.phase_omega:.3g} {unit}"
            low.set_title(text, loc="right", fontsize="small")
    found = []
    for factor, at in zip(margins.gain, margins.gain_omega, strict=True):
        if np.isfinite(at):
            ends = min(1.0, 1.0 / factor), max(1.0, 1.0 / factor)
            mark(top, at, (gain(ends[0]), gain(ends[1])))
            size = f"{_in_decibels(factor):.1f} dB" if decibels else f"{factor:.2g}"
            found.append(f"{size} at {scale * at:.3g} {unit}")
    if found and new_figure:
        top.set_title(f"gain margin {', '.join(found)}", loc="right", fontsize="small")
    _show(top, [gain(end) for end in _ratio_limits(np.abs(L))], others[0])
    if not decibels:
        top.set_yscale("log")
    ends = max(float(np.min(phase)), -720.0) - 20.0, min(float(np.max(phase)), 180.0) + 20.0
    _show(low, ends, others[1])
    for each, label in zip(
        axes, ("|L| [dB]" if decibels else "|L|", "phase of L [°]"), strict=True
    ):
        _finish(each, label, loop, scale)
    low.set_xlabel("frequency [Hz]" if hertz else "ω [rad/s]")
    return axes


def plot_gang_of_four(
    loop: LoopAnalysis,
    axes: Any = None,
    *,
    ax: Any = None,
    decibels: bool = False,
    hertz: bool = False,
    **style: Any,
) -> list[Axes]:
    """Plot the gains of S, T, PS (load to y) and CS (noise to u); return these four axes.

    The parameters are those of ``plot_bode``, but with four axes.

    Raises
    ------
    ValueError
        for another number of axes.
    """
    axes = _axes(given_axes(axes, ax), 2, 2)
    scale = 1.0 / (2.0 * np.pi) if hertz else 1.0
    shown: Any = _in_decibels if decibels else np.asarray
    meanings = ("", "", ": load at the plant's input to y", ": measurement noise to u")
    for each, name, meaning in zip(axes, ("S", "T", "PS", "CS"), meanings, strict=True):
        gain = np.abs(loop.response(name, loop.omega))
        others = _limits_of_others(each)
        each.semilogx(scale * loop.omega, shown(gain), **style)
        if not decibels:
            each.set_yscale("log")
        _show(each, [shown(end) for end in _ratio_limits(gain)], others)
        if name in ("S", "T"):
            each.axhline(shown(1.0), **_AID)
        each.set_title(f"|{name}|{meaning}", fontsize="medium")
        _finish(each, "dB" if decibels else "", loop, scale)
    for each in axes[2:]:
        each.set_xlabel("frequency [Hz]" if hertz else "ω [rad/s]")
    return axes


def plot_margins_over_time(
    times: Any, loops: Sequence[LoopAnalysis], axes: Any = None, *, ax: Any = None, **style: Any
) -> list[Axes]:
    """Plot the margins of the loop with its learner as it was at each instant; return the axes.

    Parameters
    ----------
    times
        instants [s].
    loops
        one for each, from ``loops_over_time``.
    axes, ax, style
        as for ``plot_bode``, but with three axes.

    Raises
    ------
    ValueError
        for another number of loops than instants, or of axes.
    """
    axes = _plot_margins(checks.vector("times", times), loops, given_axes(axes, ax), style)
    axes[-1].set_xlabel("learner as it was at [s]")
    return axes


def plot_margins_against_omega_o(
    plant: Any,
    make_controller: Callable[[float], Controller],
    omegas: Any,
    axes: Any = None,
    *,
    ax: Any = None,
    **lags: float,
) -> list[Axes]:
    """Plot the margins, and the noise in u, over the observer's bandwidth; return the axes.

    Parameters
    ----------
    plant, make_controller, omegas, lags
        as for ``loops_over_omega_o``.
    axes, ax
        four matplotlib axes; a new figure by default.

    Raises
    ------
    ValueError
        as ``loops_over_omega_o``; for another number of axes.
    """
    loops = loops_over_omega_o(plant, make_controller, omegas, **lags)
    omegas = checks.vector("omegas", omegas)
    axes = _axes(given_axes(axes, ax), 4, 1)
    _plot_margins(omegas, loops, axes[:3], {})
    axes[3].loglog(omegas, [loop.noise_to_control if loop.stable else np.nan for loop in loops])
    _finish(axes[3], "RMS of u per\nRMS of noise")
    for each in axes:
        each.set_xscale("log")
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


def _in_decibels(size: Any) -> Any:
    return 20.0 * np.log10(size)


def _limits_of_others(ax: Any) -> tuple[float, float] | None:
    """Return the limits that curves of other loops have given the axes; None if it has none."""
    low, high = ax.get_ylim()
    return (low, high) if ax.lines else None


def _show(ax: Any, ends: Sequence[float], others: tuple[float, float] | None) -> None:
    """Limit y to the two ``ends``, and to what the axes show of other loops."""
    low, high = others or ends
    ax.set_ylim(min(low, ends[0]), max(high, ends[1]))


def _ratio_limits(size: Vector) -> tuple[float, float]:
    """Return limits of six decades about the median, to leave out undamped poles and zeros."""
    finite = size[np.isfinite(size) & (size > 0.0)]
    middle = float(np.median(finite))
    low, high = 0.5 * float(np.min(finite)), 2.0 * float(np.max(finite))
    return max(low, 1e-6 * middle), min(high, 1e6 * middle)


def _finish(ax: Axes, label: str, loop: LoopAnalysis | None = None, scale: float = 1.0) -> None:
    """Add label and grid and, for a ``loop``, a line at half its sampling rate."""
    if loop is not None:
        ax.axvline(scale * np.pi / loop.dt, color="0.7", linestyle=":", linewidth=1.0)
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)
