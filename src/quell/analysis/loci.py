"""Plots of loops in the complex plane: Nyquist plot, and root locus over a design's parameter."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from quell import checks
from quell.analysis.loop import LoopAnalysis
from quell.analysis.sweeps import loops_over_omega_o
from quell.controllers.base import Controller
from quell.records.plotting import given_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
