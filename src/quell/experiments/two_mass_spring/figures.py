"""The figures of the two-mass study: the paper's two, what was learned, and where Algorithm 1 is stable."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quell.experiments.common.figures import STYLES, legend_label, save_figures, wide_figure
from quell.experiments.two_mass_spring.gradient_range import HORIZON, Trial
from quell.experiments.two_mass_spring.setup import END, FORCE_AT, L1, MB, MF, STEP_AT, L
from quell.experiments.two_mass_spring.study import Result
from quell.records.plotting import draw_line
from quell.records.trajectory import Trajectory

# The paper's figures begin here, and zoom into these.
_FROM = 120.0
_ZOOMS = ((126.0, 134.0), (170.0, 195.0))
_STYLES: Mapping[str, dict[str, Any]] = {
    MF: STYLES[MF],
    MB: STYLES[MB],
    L1: {"color": "0.55", "linewidth": 1.0, "linestyle": "--"},
    L: STYLES[L],
}
# The benchmark's f is −2 y'' + disturbance (paper eq. (disturbance-twomass-MFESO) with m1 = m2 = k = 1, b0 = b).
_TRUE_THETA = {"x1": 0.0, "x2": 0.0, "x3": -2.0, "x4": 0.0}


def save(
    result: Result, folder: str | os.PathLike[str], progress: Callable[[str, float], None]
) -> list[Path]:
    """Draw all figures into ``folder``, made if need be, each as PNG and SVG; return the paths.

    Raises
    ------
    ValueError
        where the folder can't be made.
    """
    return save_figures(_figures(result), 4, folder, progress)


def _figures(result: Result) -> Iterator[tuple[str, Any]]:
    yield "position", _comparison(result, "y", "position of m2 [m]")
    yield "control", _comparison(result, "u", "control force [N]")
    yield "learning", _learning(result)
    yield "algorithm-1", _algorithm_1(result)


def _comparison(result: Result, channel: str, label: str) -> Any:
    """Draw one channel of all controllers of the same bandwidth: whole, and the paper's two zooms."""
    figure = wide_figure(6.4)
    axes = figure.subplot_mosaic([["all", "all"], ["step", "force"]])
    spans = {"all": (_FROM, END), "step": _ZOOMS[0], "force": _ZOOMS[1]}
    for place, (start, stop) in spans.items():
        ax = axes[place]
        for name, style in _STYLES.items():
            run = result.runs[name]
            part = run.window(start, stop)
            if part.stop > part.start:
                draw_line(
                    ax, run.t[part], run[channel][part], label=legend_label(name, run), **style
                )
        ax.set_xlim(start, stop)
        ax.set_xlabel("time [s]")
    axes["all"].set_ylabel(label)
    axes["all"].set_title(
        f"{label.split(' [')[0]}, from {_FROM:g} s: step at {STEP_AT:g} s, force on m2 from {FORCE_AT:g} s"
    )
    axes["all"].legend(
        ncols=2, loc="upper left" if channel == "u" else "lower left", fontsize="small"
    )
    for start, stop in _ZOOMS:
        axes["all"].axvspan(start, stop, color="0.9", zorder=0)
    for place in ("step", "force"):
        axes[place].set_title("zoom {:g} s to {:g} s".format(*spans[place]), fontsize="medium")
    return figure


def _learning(result: Result) -> Any:
    """Draw what L-ESO learned, what it takes f to be and how the three observers estimate it."""
    run = result.runs[L]
    figure = wide_figure(8.0)
    axes = figure.subplots(3, 1, sharex=True)
    for i, feature in enumerate(run.features):
        draw_line(axes[0], run.t, run["theta"][:, i], label=feature, color=f"C{i}", linewidth=1.2)
        if feature in _TRUE_THETA:
            axes[0].axhline(_TRUE_THETA[feature], color=f"C{i}", linestyle=":", linewidth=1.0)
    axes[0].set_ylim(-3.0, 1.5)
    axes[0].set_title("coefficients of L-ESO; dotted: the plant's own", fontsize="medium")
    axes[0].set_ylabel("theta")
    truth = _true_disturbance(run)
    for values, label in (
        (run["f_hat"], "estimate"),
        (run["f_learned"], "learned"),
        (run["f_residual"], "residual"),
    ):
        draw_line(axes[1], run.t, values, label=label, linewidth=1.0)
    draw_line(axes[1], run.t, truth, label="true f", color="black", linestyle=":", linewidth=1.0)
    axes[1].set_title("total disturbance as L-ESO has it", fontsize="medium")
    for name in (MF, MB, L):
        other = result.runs[name]
        draw_line(
            axes[2],
            other.t,
            other["f_hat"] - _true_disturbance(other, known=name == MB),
            label=legend_label(name, other),
            **_STYLES[name],
        )
    axes[2].set_title(
        "error of the three estimates of f (MB-ESO estimates what its model leaves)",
        fontsize="medium",
    )
    axes[2].set_xlabel("time [s]")
    for ax in axes[1:]:
        ax.set_ylabel("f [m/s⁴]")
    for ax in axes:
        ax.legend(ncols=5, loc="lower left", fontsize="small")
    axes[2].set_ylim(-0.6, 0.6)
    axes[1].set_ylim(-1.8, 1.4)
    return figure


def _true_disturbance(run: Trajectory, known: bool = False) -> Any:
    """Return f of the benchmark from the record: ``−2 y'' + w2 + w2''`` (without the first term where the model is known)."""
    x, w2 = run["x"], run["w"][:, 1]
    y2 = x[:, 0] - x[:, 1] + w2
    step = run.dt * run.every
    external = w2 + np.gradient(np.gradient(w2, step), step) * (np.abs(run.t - FORCE_AT) > 3 * step)
    return external if known else external - 2.0 * y2


def _algorithm_1(result: Result) -> Any:
    """Draw when Algorithm 1 diverges, and what it gains where it does not."""
    figure = wide_figure(6.0)
    axes = figure.subplots(2, 1, sharex=True)
    markers = "osx"
    for marker, batch in zip(
        markers, sorted({trial.batch for trial in result.gradient_trials}), strict=False
    ):
        mine: list[Trial] = [trial for trial in result.gradient_trials if trial.batch == batch]
        axes[0].loglog(
            [t.rate for t in mine],
            [t.ended for t in mine],
            marker=marker,
            label=f"batch of {batch}",
        )
        stable = [t for t in mine if t.stable]
        axes[1].semilogx(
            [t.rate for t in stable],
            [t.disturbance_peak for t in stable],
            marker=marker,
            label=f"batch of {batch}",
        )
    axes[0].axhline(END, color="0.3", linestyle=":", linewidth=1.2, label="end of the study")
    axes[0].set_ylabel("diverges at [s]")
    axes[0].set_title(
        f"Algorithm 1: when it diverges, in {HORIZON:g} s of the study's scenario",
        fontsize="medium",
    )
    for name in (MF, L):
        peak = result.scores[name]["disturbance_peak"]
        if peak is not None:
            axes[1].axhline(
                peak, color=_STYLES[name]["color"], linestyle="--", linewidth=1.0, label=name
            )
    axes[1].set_ylim(bottom=0.0)
    axes[1].set_ylabel("disturbance peak, 170–250 s [m]")
    axes[1].set_xlabel("rate · batch / dt [1/s]")
    for ax in axes:
        ax.legend(fontsize="small")
    return figure
