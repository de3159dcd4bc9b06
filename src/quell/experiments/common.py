"""Parts that several experiments share: claims, figures as files, scores.

A published claim, the measured value, and whether the claim holds.

Figures as files: PNG, SVG and PDF, each written completely or not at all.

Scores of runs for tables and JSON files; None stands for a number that a run does not have.

The check that controllers which are compared have one sample time.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell.files import check_free, remove_if_empty_at_exit, written_atomically
from quell.records import metrics
from quell.records.trajectory import Trajectory
from quell.types import Progress, Vector

# ---- A published claim, the measured value, and whether the claim holds ----


@dataclass(frozen=True)
class Claim:
    """One claim of a paper, judged by a stated rule; it does not hold without a measured value."""

    claim: str
    paper: float | str
    measured: float | None
    holds: bool
    rule: str
    unit: str = ""

    @classmethod
    def near(
        cls, claim: str, paper: float, measured: float | None, tolerance: float, unit: str = ""
    ) -> Claim:
        """Judge a value that must lie within ``tolerance`` of the paper's."""
        holds = measured is not None and abs(measured - paper) <= tolerance
        return cls(claim, paper, measured, holds, f"{paper:g} ± {tolerance:g}", unit)

    @classmethod
    def below_one(cls, claim: str, measured: float | None) -> Claim:
        """Judge a ratio that must be below 1, by at least one per cent."""
        return cls(claim, "below 1", measured, measured is not None and measured <= 0.99, "≤ 0.99")

    @classmethod
    def above_one(cls, claim: str, measured: float | None) -> Claim:
        """Judge a ratio that must be above 1, by at least one per cent."""
        return cls(claim, "above 1", measured, measured is not None and measured >= 1.01, "≥ 1.01")

    @classmethod
    def at_least(cls, claim: str, paper: float, measured: float | None) -> Claim:
        """Judge a value that must reach the paper's, which is rounded: 3 is reached from 2.5 on."""
        least = paper - 0.5
        holds = measured is not None and measured >= least
        return cls(claim, paper, measured, holds, f"≥ {least:g}")

    @classmethod
    def at_most(
        cls, claim: str, paper: str, measured: float | None, most: float | None, unit: str = ""
    ) -> Claim:
        """Judge a value that must not exceed another; the claim holds if there is no other."""
        holds = measured is not None and (most is None or measured <= most * (1.0 + 1e-9))
        return cls(claim, paper, measured, holds, "any" if most is None else f"≤ {most:.5g}", unit)


def ratio(value: float | None, reference: float | None) -> float | None:
    """Return ``value / reference``; None if either is missing or the reference is zero."""
    return None if value is None or not reference else value / reference


# ---- Figures as files ----

STYLES: dict[str, dict[str, Any]] = {
    "MF-ESO": {"color": "#c1440e", "linewidth": 1.2},
    "MB-ESO": {"color": "#2a6f97", "linewidth": 2.4, "alpha": 0.55},
    "L-ESO": {"color": "black", "linewidth": 1.2},
}
"""Line styles of the paper's three controllers, in all figures."""
ESTIMATES = {"f_hat": "estimate", "f_learned": "learned", "f_residual": "residual"}
"""Channels of the estimates of f, with their names in legends."""
# Formats of a figure, and what leaves the time out of a file.
_SUFFIXES = ("png", "svg", "pdf")
_UNDATED: dict[str, dict[str, Any]] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
PAPER_STYLE = {"font.size": 9.0, "axes.grid": True, "grid.alpha": 0.3}
"""Settings of matplotlib for the figures of the paper's experiments."""


def wide_figure(height: float, **margins: float) -> Any:
    """Return an empty figure with fixed margins; an automatic layout takes longer than drawing."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(9.0, height))
    margin = 0.5 / height
    usual = {"left": 0.08, "right": 0.98, "bottom": margin, "top": 1.0 - 0.65 * margin}
    figure.subplots_adjust(**(usual | {"hspace": 0.3, "wspace": 0.2} | margins))
    return figure


def legend_label(name: str, run: Trajectory) -> str:
    """Return the name of a run for a legend."""
    return f"{name} (diverged at {run.ended:.3g} s)" if run.diverged else name


def make_folder(folder: str | os.PathLike[str]) -> Path:
    """Create a folder for figures if it does not exist; raise a ``ValueError`` if that fails.

    A new one is removed when this program ends, if it is empty then.
    """
    path = Path(folder)
    try:
        if not path.is_dir():
            path.mkdir(parents=True, exist_ok=True)
            remove_if_empty_at_exit(path)
    except OSError as error:
        rule = f"must be a folder that can be made ({error.strerror})"
        raise ValueError(f"figures = {str(path)!r}: {rule}") from None
    return path


def figure_files(folder: str | os.PathLike[str], names: Iterable[str]) -> list[Path]:
    """Return the files of figures with these names."""
    return [Path(folder) / f"{name}.{suffix}" for name in names for suffix in _SUFFIXES]


def save_figure(
    figure: Any, folder: str | os.PathLike[str], name: str, overwrite: bool = False
) -> list[Path]:
    """Write a figure, or that of some axes, as PNG, SVG and PDF, close it, and return the paths."""
    import matplotlib

    if not hasattr(figure, "savefig"):
        figure = np.ravel(figure)[0].figure
    try:
        written = figure_files(make_folder(folder), [name])
        for path in written:
            check_free(path, overwrite)
        # The same figure gives the same files. Fonts of a PDF are TrueType, as journals ask for.
        with matplotlib.rc_context({"svg.hashsalt": "quell", "pdf.fonttype": 42}):
            for path in written:
                with written_atomically(path, overwrite) as part:
                    figure.savefig(part, dpi=130, metadata=_UNDATED.get(path.suffix))
    finally:
        pyplot = sys.modules.get("matplotlib.pyplot")
        if pyplot is not None:  # it would keep its figures until the program ends
            pyplot.close(figure)
    return written


def save_figures(
    drawings: Mapping[str, Callable[[], Any]],
    folder: str | os.PathLike[str],
    progress: Progress | None = None,
    style: Any = None,
    overwrite: bool = False,
) -> list[Path]:
    """Draw figures and write each as PNG, SVG and PDF; return the paths.

    ``drawings`` has a function that returns a figure or its axes for each name of a file, ``style``
    settings of matplotlib. Nothing is drawn if a file exists, unless ``overwrite`` allows to
    replace it.
    """
    import matplotlib

    for path in figure_files(folder, drawings):
        check_free(path, overwrite)
    report = progress or (lambda part, share: None)
    written = []
    with matplotlib.rc_context(style):
        for i, (name, draw) in enumerate(drawings.items()):
            report("figures", i / len(drawings))
            written += save_figure(draw(), folder, name, overwrite)
    report("figures", 1.0)
    return written


def save_paper_figures(
    draw: Callable[[Any, str], Any],
    names: Iterable[str],
    result: Any,
    folder: str | os.PathLike[str],
    progress: Progress,
    overwrite: bool,
) -> list[Path]:
    """Draw each of the named figures of a result as the paper's are, and write them."""
    drawings = {name: partial(draw, result, name) for name in names}
    return save_figures(drawings, folder, progress, PAPER_STYLE, overwrite)


# ---- Scores of runs for tables and JSON files ----

Scores = dict[str, float | None]

# Names of the scores in the experiments of the paper.
METRICS = (
    *("overshoot", "settling_time", "disturbance_peak"),
    *("disturbance_rms", "control_variation", "rms_from_step"),
)


def step_scores(t: Vector, y: Vector, target: float, band: float, initial: float = 0.0) -> Scores:
    """Return overshoot (fraction) and settling time [s], None for what does not settle."""
    found = {
        "overshoot": metrics.overshoot(y, target, initial, band),
        "settling_time": metrics.settling_time(t, y, target, band, initial),
    }
    return {name: None if math.isnan(value) else value for name, value in found.items()}


def quantiles(values: Iterable[float]) -> Scores:
    """Return median, 90 %, 99 % and maximum of the finite values; None for those of no numbers."""
    array = np.array(list(values))
    finite = array[np.isfinite(array)]
    shares = {"median": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}
    if finite.size == 0:
        return dict.fromkeys(shares)
    return {key: float(np.quantile(finite, share)) for key, share in shares.items()}


def ended_early(runs: Mapping[str, Trajectory]) -> dict[str, dict[str, Any]]:
    """Return time and message of the runs that diverged or whose y ran away, by name."""
    ended = {name: run for name, run in runs.items() if run.lost}
    return {name: {"at": run.ended, "message": run.message} for name, run in ended.items()}


# ---- One sample time for all that is compared ----

# Sample times that differ by less than this share are one: 1/4000 and 2.5e-4 s. Chosen by hand.
_SAME_DT = 1e-9


def check_sample_times(controllers: Mapping[str, Any]) -> None:
    """Raise ``ValueError`` if controllers by name have different sample times.

    All measures are of samples. What y does between them is in none, so they change with dt by
    themselves, and by more than good controllers differ.
    """
    times = {name: float(controller.dt) for name, controller in controllers.items()}
    least, most = min(times, key=times.__getitem__), max(times, key=times.__getitem__)
    if times[most] > (1.0 + _SAME_DT) * times[least]:
        raise ValueError(
            f"{least} has dt = {times[least]:g} s, {most} {times[most]:g} s: must have one dt, as "
            "the errors between samples are in no measure; design all for the same dt"
        )
