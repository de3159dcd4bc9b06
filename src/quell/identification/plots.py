"""The parts of the plot of an identification."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from quell.identification.experiment.frequency_response import FrequencyResponse
from quell.identification.validation import Residuals
from quell.quantities import Quantity, Signals
from quell.records.plotting import draw_line
from quell.types import Vector

_ROWS = ("gain output", "gain output", "phase error", "phase auto", "coherence cross")
_NAMES = ("gain", "phase", "coherence", "output", "error", "auto", "cross")
# Least coherence of the empirical points that are drawn; below it, noise exceeds the response.
_COHERENT = 0.5
# Quantile of the normal distribution: 99 % of values lie within this many standard deviations.
_WITHIN_99 = 2.576


def seven_axes(axes: Any) -> list[Any]:
    """Return seven matplotlib axes, those of a new figure by default."""
    if axes is None:
        import matplotlib.pyplot as plt

        figure = plt.figure(figsize=(10.0, 7.5), layout="constrained")
        rows: list[Any] = [row.split() for row in _ROWS]
        mosaic = figure.subplot_mosaic(rows)
        axes = [mosaic[name] for name in _NAMES]
    axes = list(np.ravel(axes))
    if len(axes) != len(_NAMES):
        raise ValueError(f"axes: must be {len(_NAMES)} matplotlib axes, got {len(axes)}")
    return axes


def draw_bode(
    axes: list[Any],
    measured: FrequencyResponse,
    response: Callable[[Any], Any],
    signals: Signals,
) -> None:
    """Draw gain, phase and coherence of the empirical response, and the model's response.

    The record of a step soon after the start has no empirical response, as u rests in all segments.
    """
    gain, phase, coherence = axes
    if measured.omega.size == 0:
        for each in axes:
            each.text(0.5, 0.5, "u moves too little", ha="center", transform=each.transAxes)
        return
    good = measured.coherence > _COHERENT
    omega = np.geomspace(measured.omega[0], measured.omega[-1], 2000)
    model = response(omega)
    dots = {"color": "0.6", "linestyle": "none", "marker": ".", "markersize": 3.0}
    points, size = measured.omega[good], np.abs(measured.response[good])
    gain.loglog(points, size, label="empirical", **dots)
    gain.loglog(omega, np.abs(model), color="C0", label="model")
    degrees = np.degrees(np.unwrap(np.angle(model)))
    # Of the measured phases, the one within half a turn of the model's.
    near = np.interp(measured.omega, omega, degrees)
    angle = near + np.degrees(np.angle(measured.response * np.exp(-1j * np.radians(near))))
    phase.semilogx(points, angle[good], **dots)
    phase.semilogx(omega, degrees, color="C0")
    coherence.semilogx(measured.omega, measured.coherence, color="0.4", linewidth=0.8)
    coherence.set_ylim(0.0, 1.05)
    unit = signals.unit("y-unit/u-unit") if signals.y.unit and signals.u.unit else ""
    size_of_G = Quantity("|G|", unit).label("")
    for ax, label in ((gain, size_of_G), (phase, "phase of G [°]"), (coherence, "coherence")):
        ax.set(ylabel=label, xlim=(omega[0], omega[-1]))
    if points.size:
        largest = max(np.max(size), np.max(np.abs(model[omega >= points[0]])))
        gain.set_ylim(0.3 * np.min(size), 3.0 * largest)
        lowest = min(np.min(angle[good]), np.min(degrees[omega <= points[-1]]))
        phase.set_ylim(lowest - 30.0, np.max(angle[good]) + 30.0)
    gain.legend(fontsize="small")
    coherence.set_xlabel("ω [rad/s]")


def draw_output(
    axes: list[Any],
    t: Vector,
    y: Vector,
    simulated: Vector,
    split: int,
    fits: dict[str, float],
    quantity: Quantity,
) -> None:
    """Draw output and error; the samples from ``split`` on were held out."""
    output, error = axes
    draw_line(output, t, y, color="0.6", linewidth=2.5, label="measured")
    for part, color, label, fit in (
        (slice(0, split), "C0", "simulated", "estimation"),
        (slice(split, t.size), "C1", "held out", "held out"),
    ):
        if part.start < t.size:
            label = f"{label}, {fits[fit]:.2f} %"
            draw_line(output, t[part], simulated[part], color=color, linewidth=1.0, label=label)
            draw_line(error, t[part], (y - simulated)[part], color=color, linewidth=0.8)
    output.set_ylabel(quantity.label("output"))
    output.legend(fontsize="small")
    error.set(xlabel="time [s]", ylabel=Quantity("error", quantity.unit).label(""))
    error.sharex(output)


def draw_tests(axes: list[Any], residuals: Residuals, samples: int) -> None:
    """Draw the correlations of the residuals, of ``samples`` samples, with their limits."""
    lags = residuals.lags
    auto, cross = axes
    for ax, first, values, limit, label in (
        (auto, 0, residuals.autocorrelation, _WITHIN_99 / math.sqrt(samples), "of the error"),
        (cross, -lags, residuals.cross_correlation, residuals.cross_limit, "with u"),
    ):
        ax.axhspan(-limit, limit, color="C2", alpha=0.2, label="99 %")
        ax.vlines(np.arange(first, lags + 1), 0.0, values, color="0.3", linewidth=1.0)
        ax.axhline(0.0, color="0.3", linewidth=0.8)
        ax.set_ylabel(f"correlation\n{label}" if ax is auto else label)
    auto.legend(fontsize="small", loc="upper right")
    cross.set_xlabel("error later than u by [samples]")
