"""Figures as files: each as PNG and SVG, whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from quell.files import written_atomically
from quell.records.trajectory import Trajectory

# How the paper's three controllers are drawn in every figure.
STYLES: dict[str, dict[str, Any]] = {
    "MF-ESO": {"color": "#c1440e", "linewidth": 1.2},
    "MB-ESO": {"color": "#2a6f97", "linewidth": 2.4, "alpha": 0.55},
    "L-ESO": {"color": "black", "linewidth": 1.2},
}


def wide_figure(height: float) -> Any:
    """Return an empty figure, apart from any that the user has open; its margins are fixed, as measuring them takes longer than drawing."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, height))
    margin = 0.5 / height
    figure.subplots_adjust(
        left=0.08, right=0.98, bottom=margin, top=1.0 - 0.65 * margin, hspace=0.3, wspace=0.2
    )
    return figure


def legend_label(name: str, run: Trajectory) -> str:
    """Return what a legend calls a run."""
    return f"{name} (diverged at {run.ended:.3g} s)" if run.diverged else name


def make_folder(folder: str | os.PathLike[str]) -> Path:
    """Return a folder for figures, made if need be; a ``ValueError`` says why it can't be."""
    where = Path(folder)
    try:
        where.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f"figures = {str(where)!r}: must be a folder that can be made ({error.strerror})"
        ) from None
    return where


def save_figure(figure: Any, where: Path, name: str) -> list[Path]:
    """Write a figure to ``where`` as PNG and SVG; return the paths. The same figure gives the same files."""
    import matplotlib

    written = []
    with matplotlib.rc_context({"svg.hashsalt": "quell"}):
        for suffix in ("png", "svg"):
            path = where / f"{name}.{suffix}"
            with written_atomically(path) as part:
                figure.savefig(part, dpi=130, metadata={"Date": None} if suffix == "svg" else None)
            written.append(path)
    return written


def save_figures(
    figures: Iterable[tuple[str, Any]],
    count: int,
    folder: str | os.PathLike[str],
    progress: Callable[[str, float], None],
) -> list[Path]:
    """Write ``count`` figures with their names, in the studies' style, into ``folder``, made if need be; return the paths.

    Raises
    ------
    ValueError
        where the folder can't be made.
    """
    import matplotlib

    where = make_folder(folder)
    written = []
    with matplotlib.rc_context({"font.size": 9.0, "axes.grid": True, "grid.alpha": 0.3}):
        for i, (name, figure) in enumerate(figures):
            progress("figures", i / count)
            written += save_figure(figure, where, name)
    progress("figures", 1.0)
    return written
