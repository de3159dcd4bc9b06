"""A style of matplotlib for figures of papers."""

from __future__ import annotations

from typing import Any

from quell import checks

# Widths of a figure over one and two columns of IEEE's journals, 3.5 and 7.16 inches, and the share
# of its width that its height is.
_WIDTHS, _HEIGHT = {1: 3.5, 2: 7.16}, 0.62
# Colours that readers with any colour vision tell apart (Okabe & Ito, *Color Universal Design*,
# 2008), without yellow, which is too light for lines.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
# Each line differs in its dashes, too: prints are often grey.
_DASHES = ("-", "--", "-.", ":", "-", "--", "-.")


def style(columns: int = 1) -> dict[str, Any]:
    """Return settings of matplotlib for a figure in a paper.

    The figure is as wide as one or two columns, its text has 8 points in a serif font with matching
    formulas, lines differ in colour and dashes, and PDF and PostScript contain TrueType fonts, as
    IEEE asks for.

    Parameters
    ----------
    columns
        columns that the figure is wide, 1 or 2.

    Raises
    ------
    ValueError
        for another number of columns.

    Examples
    --------
    >>> import matplotlib
    >>> import quell as ql
    >>> with matplotlib.rc_context(ql.style(columns=2)):
    ...     matplotlib.rcParams["figure.figsize"][0]
    7.16
    """
    from cycler import cycler

    width = _WIDTHS[checks.whole("columns", columns, 1, 2)]
    return {
        "figure.figsize": (width, _HEIGHT * width),
        "figure.constrained_layout.use": True,
        "savefig.dpi": 600,
        "font.family": "serif",
        "font.serif": ["Times New Roman", "Times", "STIXGeneral", "DejaVu Serif"],
        "mathtext.fontset": "stix",
        "font.size": 8.0,
        "axes.titlesize": 8.0,
        "axes.labelsize": 8.0,
        "legend.fontsize": 7.0,
        "xtick.labelsize": 7.0,
        "ytick.labelsize": 7.0,
        "axes.prop_cycle": cycler(color=_COLORS) + cycler(linestyle=_DASHES),
        "lines.linewidth": 1.0,
        "axes.linewidth": 0.6,
        "axes.grid": True,
        "grid.alpha": 0.3,
        "grid.linewidth": 0.4,
        "legend.frameon": False,
        "pdf.fonttype": 42,
        "ps.fonttype": 42,
    }
