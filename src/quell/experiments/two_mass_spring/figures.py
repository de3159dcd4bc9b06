"""The figures of the two-mass study: the paper's two, what was learned, and Algorithm 1."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell import checks
from quell.experiments.common.figures import (
    ESTIMATES,
    STYLES,
    legend_label,
    save_paper_figures,
    wide_figure,
)
from quell.experiments.two_mass_spring.gradient_range import HORIZON
from quell.experiments.two_mass_spring.setup import END, FORCE_AT, L1, MB, MF, STEP_AT, L
from quell.experiments.two_mass_spring.study import Result
from quell.records.plotting import draw_line, grid_of_axes
from quell.records.trajectory import Trajectory
from quell.types import Progress, Vector

# Start of the paper's figures [s], and their two zooms.
_FROM = 120.0
_ZOOMS = ((126.0, 134.0), (170.0, 195.0))
_STYLES: Mapping[str, dict[str, Any]] = {
    MF: STYLES[MF],
    MB: STYLES[MB],
    L1: {"color": "0.55", "linewidth": 1.0, "linestyle": "--"},
    L: STYLES[L],
}
# The benchmark's f is −2 y'' + disturbance (paper eq. (disturbance-twomass-MFESO) with m1 = m2 = k
# = 1, b0 = b).
_TRUE_THETA = {"x1": 0.0, "x2": 0.0, "x3": -2.0, "x4": 0.0}

NAMES = ("position", "control", "learning", "algorithm-1")
"""Names of the figures."""


def save(
    result: Result, folder: str | os.PathLike[str], progress: Progress, overwrite: bool = False
) -> list[Path]:
    """Draw all figures into ``folder``, created if missing; return the paths."""
    return save_paper_figures(draw, NAMES, result, folder, progress, overwrite)


def draw(result: Result, name: str, ax: Any = None) -> Any:
    """Draw one of the figures ``NAMES`` and return its axes.

    Parameters
    ----------
    result
        of ``run``.
    name
        ``"position"`` with three axes (whole run, two zooms), ``"control"`` with three for each of
        the four controllers, ``"learning"`` with three, ``"algorithm-1"`` with two.
    ax
        axes to draw into; those of a new figure by default.

    Raises
    ------
    ValueError
        for another name or number of axes.
    """
    return _DRAWINGS[checks.one_of("name", name, NAMES)](result, ax)


def _control(result: Result, ax: Any) -> Any:
    """Draw u of each controller of equal bandwidth: a row for each, whole and in the two zooms.

    In one plot the noise of one controller would hide the others.
    """
    names, spans = [*_STYLES], ((_FROM, END), *_ZOOMS)
    shared = {"sharex": "col", "sharey": "col", "width_ratios": (2.0, 1.0, 1.0)}
    axes = grid_of_axes(ax, partial(wide_figure, 7.0), len(names), 3, **shared)
    for row, name in zip(axes, names, strict=True):
        run = result.runs[name]
        for one, (start, stop) in zip(row, spans, strict=True):
            part = run.window(start, stop)
            if part.stop > part.start:
                draw_line(one, run.t[part], run["u"][part], color="black", linewidth=0.7)
            one.set_xlim(start, stop)
        row[0].set_ylabel(f"{legend_label(name, run)}\nu [N]")
    for one, (start, stop) in zip(axes[0], spans, strict=True):
        one.set_title(f"{start:g} s to {stop:g} s", fontsize="medium")
    for one in axes[-1]:
        one.set_xlabel("time [s]")
    return axes.ravel()


def _position(result: Result, ax: Any) -> Any:
    """Draw y of the controllers of equal bandwidth: whole, and the paper's two zooms."""
    if ax is None:
        axes = wide_figure(6.4).subplot_mosaic([["all", "all"], ["step", "force"]])
    else:
        axes = dict(zip(("all", "step", "force"), grid_of_axes(ax, dict, 3)[:, 0], strict=True))
    spans = {"all": (_FROM, END), "step": _ZOOMS[0], "force": _ZOOMS[1]}
    for place, (start, stop) in spans.items():
        one = axes[place]
        for name, style in _STYLES.items():
            run, label_of_run = result.runs[name], legend_label(name, result.runs[name])
            part = run.window(start, stop)
            if part.stop > part.start:
                draw_line(one, run.t[part], run["y"][part], label=label_of_run, **style)
        one.set(xlim=(start, stop), xlabel="time [s]")
    whole = axes["all"]
    whole.set_ylabel("position of m2 [m]")
    whole.set_title(
        f"position of m2, from {_FROM:g} s: step at {STEP_AT:g} s, force on m2 from {FORCE_AT:g} s"
    )
    whole.legend(ncols=2, loc="lower left", fontsize="small")
    for start, stop in _ZOOMS:
        whole.axvspan(start, stop, color="0.9", zorder=0)
    for place in ("step", "force"):
        axes[place].set_title("zoom {:g} s to {:g} s".format(*spans[place]), fontsize="medium")
    return np.array([axes[place] for place in spans])


def _learning(result: Result, ax: Any) -> Any:
    """Draw the coefficients of L-ESO, its estimate of f, and the errors of the three observers."""
    run = result.runs[L]
    axes = grid_of_axes(ax, partial(wide_figure, 8.0), 3, sharex=True)[:, 0]
    for i, feature in enumerate(run.features):
        draw_line(axes[0], run.t, run["theta"][:, i], label=feature, color=f"C{i}", linewidth=1.2)
        if feature in _TRUE_THETA:
            axes[0].axhline(_TRUE_THETA[feature], color=f"C{i}", linestyle=":", linewidth=1.0)
    axes[0].set(ylim=(-3.0, 1.5), ylabel="theta")
    axes[0].set_title("coefficients of L-ESO; dotted: the plant's own", fontsize="medium")
    truth, dotted = _true_disturbance(run), {"color": "black", "linestyle": ":"}
    for channel, label in ESTIMATES.items():
        draw_line(axes[1], run.t, run[channel], label=label, linewidth=1.0)
    draw_line(axes[1], run.t, truth, label="true f", linewidth=1.0, **dotted)
    axes[1].set_title("total disturbance as L-ESO has it", fontsize="medium")
    for name in (MF, MB, L):
        other = result.runs[name]
        error = other["f_hat"] - _true_disturbance(other, known=name == MB)
        draw_line(axes[2], other.t, error, label=legend_label(name, other), **_STYLES[name])
    title = "error of the three estimates of f (MB-ESO estimates what its model leaves)"
    axes[2].set_title(title, fontsize="medium")
    axes[2].set_xlabel("time [s]")
    for each in axes[1:]:
        each.set_ylabel("f [m/s⁴]")
    for each in axes:
        each.legend(ncols=5, loc="lower left", fontsize="small")
    axes[2].set_ylim(-0.6, 0.6)
    axes[1].set_ylim(-1.8, 1.4)
    return axes


def _true_disturbance(run: Trajectory, known: bool = False) -> Vector:
    """Return the true f, ``−2 y'' + w2 + w2''``; without the first term for a ``known`` model."""
    x, w2 = run["x"], run["w"][:, 1]
    y2 = x[:, 0] - x[:, 1] + w2
    step = run.dt * run.every
    external = w2 + np.gradient(np.gradient(w2, step), step) * (np.abs(run.t - FORCE_AT) > 3 * step)
    return np.asarray(external if known else external - 2.0 * y2)


def _algorithm_1(result: Result, ax: Any) -> Any:
    """Draw when Algorithm 1 diverges, and its disturbance peak if it does not."""
    above, below = axes = grid_of_axes(ax, partial(wide_figure, 6.0), 2, sharex=True)[:, 0]
    batches = sorted({trial.batch for trial in result.gradient_trials})
    for marker, batch in zip("osx", batches, strict=False):
        trials = [trial for trial in result.gradient_trials if trial.batch == batch]
        stable = [trial for trial in trials if trial.stable]
        style = {"marker": marker, "label": f"batch of {batch}"}
        above.loglog([t.rate for t in trials], [t.ended for t in trials], **style)
        below.semilogx([t.rate for t in stable], [t.disturbance_peak for t in stable], **style)
    above.axhline(END, color="0.3", linestyle=":", linewidth=1.2, label="end of the study")
    above.set_ylabel("diverges at [s]")
    title = f"Algorithm 1: when it diverges, in {HORIZON:g} s of the study's scenario"
    above.set_title(title, fontsize="medium")
    for name in (MF, L):
        peak, color = result.scores[name]["disturbance_peak"], _STYLES[name]["color"]
        if peak is not None:
            below.axhline(peak, color=color, linestyle="--", linewidth=1.0, label=name)
    below.set_ylim(bottom=0.0)
    below.set(ylabel="disturbance peak, 170–250 s [m]", xlabel="rate · batch / dt [1/s]")
    for each in axes:
        each.legend(fontsize="small")
    return axes


_DRAWINGS: Mapping[str, Callable[[Result, Any], Any]] = {
    "position": _position,
    "control": _control,
    "learning": _learning,
    "algorithm-1": _algorithm_1,
}
