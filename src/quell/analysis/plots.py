"""Plots of loops: Bode and Nyquist plots, gang of four, root locus, margins over time or bandwidth.

Plots of loops: Bode plot, gang of four, margins over time or bandwidth.

Plots of loops in the complex plane: Nyquist plot, and root locus over a design's parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.analysis.linearise import adapting
from quell.analysis.loop import LoopAnalysis, analyse_axis
from quell.controllers.base import Controller
from quell.records.plotting import given_axes
from quell.records.trajectory import Trajectory
from quell.simulation import Scenario, simulate
from quell.types import Vector

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# ---- A loop at several instants of a run, and a design at several bandwidths ----


def loops_over_time(
    plant: Any, controller: Controller, run: Any, times: Any, **options: Any
) -> list[LoopAnalysis]:
    """Analyse the loop with its learner as it was at several instants.

    Each is the loop that would follow if the plant came to rest there (``analyse``). That all of
    them are stable does not prove that the loop with a learner that learns is stable
    (docs/analysis_learners). Raises
    ``ValueError`` as ``frozen`` and ``analyse`` do, for a time outside of the run, and for a
    scenario in which the loop diverges before it.

    Parameters
    ----------
    plant, controller
        as for ``analyse``; with a scenario the plant must be one that can be simulated.
    run
        a ``Trajectory``, whose record holds the learner's coefficients; or the ``Scenario`` of a
        run, which is simulated up to each instant and works for every learner.
    times
        instants [s].
    options
        ``delay``, ``actuator_lag`` and ``operating_point``, as for ``analyse``.
    """
    instants = checks.vector("times", times).tolist()
    if isinstance(run, Trajectory):
        return [
            analyse_axis(plant, controller, at=adapting(controller, run, t), **options)
            for t in instants
        ]
    if not isinstance(run, Scenario):
        raise ValueError(f"run = {run!r}: must be a Trajectory or a Scenario")
    loops = []
    for t in instants:
        if not 0.0 < t <= run.duration:
            raise ValueError(f"times has {t!r}: must lie within (0, duration = {run.duration!r}] s")
        until = replace(run, duration=t, rest_at=tuple(at for at in run.rest_at if at < t))
        # Only the final state is used.
        record = simulate(plant, controller, until, record_every=10**9)
        if record.diverged:
            raise ValueError(f"times has {t!r}: the loop diverged at {record.ended:.6g} s")
        loops.append(analyse_axis(plant, controller, at=record, **options))
    return loops


def loops_over_omega_o(
    plant: Any, make_controller: Callable[[float], Controller], omegas: Any, **options: Any
) -> list[LoopAnalysis]:
    """Analyse designs with several observer bandwidths.

    Parameters
    ----------
    plant
        as for ``analyse``.
    make_controller
        returns the controller for an omega_o [rad/s].
    omegas
        the bandwidths [rad/s], at least one.
    options
        ``delay``, ``actuator_lag`` and ``operating_point``, as for ``analyse``.

    Raises
    ------
    ValueError
        for a bandwidth that is not greater than zero; as ``analyse``.
    """
    bandwidths = checks.positive_vector("omegas", omegas)
    if bandwidths.size == 0:
        raise ValueError(f"omegas = {omegas!r}: must hold at least one bandwidth")
    return [
        analyse_axis(plant, make_controller(omega_o), **options) for omega_o in bandwidths.tolist()
    ]


# ---- Plots of loops ----

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


# ---- Plots of loops in the complex plane ----

# Part of the plane that a Nyquist plot shows: the point −1 and what is near it. By hand.
_REACH = 2.5
# Poles farther from the origin than so many times the median are not drawn. By hand.
_FAR = 30.0


def plot_nyquist(loop: LoopAnalysis, ax: Any = None, *, axes: Any = None, **style: Any) -> Axes:
    """Plot ``L(jω)`` near the point −1, with the circle that it must not enter; return the axes.

    The circle about −1 touches the curve: its radius is the modulus margin 1/M_s.

    Parameters
    ----------
    loop
        from ``analyse``.
    ax, axes
        matplotlib axes; those of a new figure by default.
    style
        of the curve, for example ``label``.
    """
    one = _one(given_axes(axes, ax))
    L = loop.response("L", loop.omega[:-1])
    (line,) = one.plot(L.real, L.imag, **style)
    mirrored = {"color": line.get_color(), "linestyle": "--", "linewidth": 0.8, "alpha": 0.6}
    one.plot(L.real, -L.imag, **mirrored)
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    one.plot(np.cos(angle), np.sin(angle), color="0.7", linewidth=0.8)
    one.plot([-1.0], [0.0], "+", color="C3", markersize=10.0)
    modulus = loop.margins.modulus
    if np.isfinite(modulus) and modulus > 0.0:
        circle = -1.0 + modulus * np.cos(angle), modulus * np.sin(angle)
        one.plot(*circle, color="C3", linestyle=":", linewidth=1.0)
        text = rf"modulus margin {modulus:.2f}, $M_s$ = {1.0 / modulus:.2f}"
        one.set_title(text, loc="right", fontsize="small")
    one.set(xlim=(-_REACH - 0.5, _REACH - 0.5), ylim=(-_REACH, _REACH), aspect="equal")
    one.set(xlabel="Re L", ylabel="Im L")
    one.grid(alpha=0.3)
    return one


def plot_root_locus(
    plant: Any,
    make_controller: Callable[[float], Controller],
    values: Any,
    ax: Any = None,
    *,
    axes: Any = None,
    parameter: str = "omega_o",
    **lags: Any,
) -> Axes:
    """Plot the poles of the loop in the s-plane over a design's parameter; return the axes.

    Parameters
    ----------
    plant
        as for ``analyse``.
    make_controller
        returns the controller for a value: of omega_o [rad/s], of b0, or of another number.
    values
        the values, greater than zero.
    ax, axes
        matplotlib axes; those of a new figure by default.
    parameter
        name of what is varied, for the colour bar.
    lags
        ``delay``, ``actuator_lag`` and ``operating_point``, as for ``analyse``.

    Raises
    ------
    ValueError
        as ``loops_over_omega_o``.
    """
    numbers = checks.positive_vector("values", values)
    loops = loops_over_omega_o(plant, make_controller, numbers, **lags)
    one = _one(given_axes(axes, ax))
    poles = [loop.s_poles[np.isfinite(loop.s_poles)] for loop in loops]
    far = _FAR * float(np.median(np.abs(np.concatenate(poles))))
    points = np.concatenate([each[np.abs(each) <= far] for each in poles])
    counts = [int(np.sum(np.abs(each) <= far)) for each in poles]
    from matplotlib.colors import LogNorm

    colors: dict[str, Any] = {"c": np.repeat(numbers, counts), "cmap": "viridis", "norm": LogNorm()}
    shown = one.scatter(points.real, points.imag, s=9.0, **colors)
    one.axvline(0.0, color="C3", linewidth=1.0)
    unit = "rad/s" if parameter in ("omega_o", "omega_c") else ""
    for at, marker in ((0, "x"), (-1, "o")):
        ends = poles[at][np.abs(poles[at]) <= far]
        style = {"color": "0.2", "markersize": 6.0, "fillstyle": "none", "linestyle": "none"}
        label = f"{parameter} = {numbers[at]:.3g} {unit}".rstrip()
        one.plot(ends.real, ends.imag, marker, label=label, **style)
    one.figure.colorbar(shown, ax=one, label=f"{parameter} [{unit}]" if unit else parameter)
    one.set(xlabel="Re s [1/s]", ylabel="Im s [rad/s]")
    above: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "frameon": False}
    one.legend(ncols=2, fontsize="small", **above)
    one.grid(alpha=0.3)
    return one


def _one(ax: Any) -> Any:
    """Return the axes, those of a new figure for None."""
    if ax is not None:
        found = np.ravel(np.asarray(ax, dtype=object))
        if found.size != 1:
            raise ValueError(f"ax: must be one of matplotlib's axes, got {found.size}")
        return found[0]
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(5.6, 5.0), layout="constrained")[1]
