"""The picture of an identification."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from quell.records.plotting import draw_line

if TYPE_CHECKING:
    from quell.identification.result import Identified

_MOSAIC: Any = [
    ["gain", "output"],
    ["gain", "output"],
    ["phase", "error"],
    ["phase", "auto"],
    ["coherence", "cross"],
]
_PLACES = ("gain", "phase", "coherence", "output", "error", "auto", "cross")
# Below this coherence the empirical response says nothing.
_COHERENT = 0.5


def plot_identified(found: Identified, axes: Any = None) -> Any:
    """Draw the seven parts; see ``Identified.plot``."""
    if axes is None:
        import matplotlib.pyplot as plt

        figure = plt.figure(figsize=(10.0, 7.5), layout="constrained")
        mosaic = figure.subplot_mosaic(_MOSAIC)
        axes = [mosaic[place] for place in _PLACES]
    axes = list(np.ravel(axes))
    if len(axes) != len(_PLACES):
        raise ValueError(f"axes: must be {len(_PLACES)} matplotlib axes, got {len(axes)}")
    _draw_bode(found, *axes[:3])
    _draw_output(found, *axes[3:5])
    _draw_tests(found, *axes[5:])
    for ax in axes:
        ax.grid(alpha=0.3)
    return axes


def _draw_bode(found: Identified, gain: Any, phase: Any, coherence: Any) -> None:
    empirical = found.empirical()
    good = empirical.coherence > _COHERENT
    omega = np.geomspace(empirical.omega[0], empirical.omega[-1], 2000)
    model = found.response(omega)
    gain.loglog(
        empirical.omega[good],
        np.abs(empirical.response[good]),
        ".",
        color="0.6",
        markersize=3.0,
        label="empirical",
    )
    gain.loglog(omega, np.abs(model), color="C0", label="model")
    degrees = np.degrees(np.unwrap(np.angle(model)))
    # The phase of the record is that within half a turn of the model's.
    measured = np.degrees(
        np.angle(
            empirical.response
            * np.exp(-1j * np.radians(np.interp(empirical.omega, omega, degrees)))
        )
    )
    measured += np.interp(empirical.omega, omega, degrees)
    phase.semilogx(empirical.omega[good], measured[good], ".", color="0.6", markersize=3.0)
    phase.semilogx(omega, degrees, color="C0")
    coherence.semilogx(empirical.omega, empirical.coherence, color="0.4", linewidth=0.8)
    coherence.set_ylim(0.0, 1.05)
    for ax, label in ((gain, "|G|"), (phase, "phase of G [°]"), (coherence, "coherence")):
        ax.set_ylabel(label)
        ax.set_xlim(omega[0], omega[-1])
    inside = np.abs(empirical.response[good])
    if inside.size:
        gain.set_ylim(
            0.3 * np.min(inside),
            3.0
            * max(np.max(inside), float(np.max(np.abs(model[omega >= empirical.omega[good][0]])))),
        )
        shown = degrees[(omega <= empirical.omega[good][-1])]
        phase.set_ylim(
            min(np.min(measured[good]), np.min(shown)) - 30.0, np.max(measured[good]) + 30.0
        )
    gain.legend(fontsize="small")
    coherence.set_xlabel("ω [rad/s]")


def _draw_output(found: Identified, output: Any, error: Any) -> None:
    t, split = found.t, found.held_from
    draw_line(output, t, found.y, color="0.6", linewidth=2.5, label="measured")
    draw_line(
        output,
        t[:split],
        found.simulated[:split],
        color="C0",
        linewidth=1.0,
        label=f"simulated, {found.fits['estimation']:.2f} %",
    )
    draw_line(error, t[:split], (found.y - found.simulated)[:split], color="C0", linewidth=0.8)
    if split < t.size:
        draw_line(
            output,
            t[split:],
            found.simulated[split:],
            color="C1",
            linewidth=1.0,
            label=f"held out, {found.fits['held out']:.2f} %",
        )
        draw_line(error, t[split:], (found.y - found.simulated)[split:], color="C1", linewidth=0.8)
    output.set_ylabel("output")
    output.legend(fontsize="small")
    error.set_ylabel("error")
    error.set_xlabel("time [s]")
    error.sharex(output)


def _draw_tests(found: Identified, auto: Any, cross: Any) -> None:
    left = found.residuals
    lags, both = np.arange(left.lags + 1), np.arange(-left.lags, left.lags + 1)
    bound = 2.576 / np.sqrt(
        max(found.y.size - found.held_from, 1) if found.held_from < found.y.size else found.y.size
    )
    for ax, x, values, limit, label in (
        (auto, lags, left.autocorrelation, bound, "correlation\nof the error"),
        (cross, both, left.cross_correlation, left.cross_limit, "with u"),
    ):
        ax.axhspan(-limit, limit, color="C2", alpha=0.2, label="99 %")
        ax.vlines(x, 0.0, values, color="0.3", linewidth=1.0)
        ax.axhline(0.0, color="0.3", linewidth=0.8)
        ax.set_ylabel(label)
    auto.legend(fontsize="small", loc="upper right")
    cross.set_xlabel("error later than u by [samples]")
