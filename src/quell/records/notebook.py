"""Runs, analyses, models and tunings in a notebook: their text and a small figure."""

from __future__ import annotations

import io
from html import escape
from typing import Any


class InNotebook:
    """A base class of objects that a notebook shows with a figure."""

    _size = (7.0, 3.4)  # of the figure [inch]

    def _draw_small(self, figure: Any) -> None:
        """Draw into an empty figure of matplotlib."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        """Return the text, and the figure as SVG; it opens no window and belongs to no pyplot."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=self._size, layout="constrained")
        self._draw_small(figure)
        image = io.StringIO()
        figure.savefig(image, format="svg")
        drawing = image.getvalue()
        text = f"<pre style='white-space: pre-wrap'>{escape(repr(self))}</pre>"
        return f"{text}\n{drawing[drawing.index('<svg') :]}"
