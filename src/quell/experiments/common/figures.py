"""Figures as files: PNG, SVG and PDF, each written completely or not at all."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell.files import check_free, remove_if_empty_at_exit, written_atomically
from quell.records.trajectory import Trajectory
from quell.types import Progress

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
