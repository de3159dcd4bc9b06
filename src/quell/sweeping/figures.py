"""Figures of a sweep: failure rate and quantiles of the measures over a parameter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.sweeping.shares import share_interval
from quell.types import Vector

QUANTILES = (0.05, 0.5, 0.95)
# Groups of values of a parameter: enough to show a shape, few enough that each has runs. By hand.
_MOST_GROUPS = 20
# So many values are groups of their own even where fewer groups are asked for. By hand.
_FEW = 6
# Colours of the lines of several groups, which readers with any colour vision tell apart.
_COLORS = ("#2a6f97", "#c1440e", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# Quantiles that go beyond so many times the median are drawn on a logarithmic scale. By hand.
_WIDE = 50.0


class Groups(NamedTuple):
    """Runs in groups of near values of a parameter."""

    centres: Vector  # (groups,)
    texts: list[str] | None  # of values that are no numbers
    members: list[NDArray[np.int64]]

    def labels(self, parameter: str) -> list[str]:
        """Return a label for each group: the text, or the value in the middle."""
        if self.texts is not None:
            return [f"{parameter} = {text}" for text in self.texts]
        return [f"{parameter} = {centre:.3g}" for centre in self.centres.tolist()]


def groups_of(
    values: NDArray[Any],
    texts: list[str] | None,
    done: NDArray[np.bool_],
    most: int = _MOST_GROUPS,
) -> Groups:
    """Return the runs that are done by the value of a parameter, which may be one of some texts.

    More values than ``most``, and than six, form ``most`` groups of about as many runs each.
    """
    runs = np.flatnonzero(done)
    if texts is not None:
        members = [runs[values[runs] == text] for text in texts]
        return Groups(np.arange(len(texts), dtype=np.float64), texts, members)
    order = runs[np.argsort(values[runs], kind="stable")]
    distinct = np.unique(values[runs])
    if distinct.size <= _FEW or distinct.size <= most:
        return Groups(distinct, None, [runs[values[runs] == each] for each in distinct])
    members = [each for each in np.array_split(order, most) if each.size]
    return Groups(np.array([np.median(values[each]) for each in members]), None, members)


def plot_over(
    parameter: str,
    lines: Mapping[str, Groups],
    failed: NDArray[np.bool_],
    measures: Mapping[str, Vector],
    figure: Any = None,
    ax: Any = None,
) -> Any:
    """Draw failure rate and quantiles of each measure over a parameter; return the axes.

    ``lines`` has the groups of runs of each line by its label.
    """
    axes = _new_axes(len(measures), figure) if ax is None else np.ravel(ax)
    if axes.size < 1 + len(measures):
        raise ValueError(f"ax: must be {1 + len(measures)} matplotlib axes, got {axes.size}")
    colors = [_COLORS[i % len(_COLORS)] for i in range(len(lines))]
    shown = ["#c1440e"] if len(lines) == 1 else colors
    for color, (label, groups) in zip(shown, lines.items(), strict=True):
        _plot_failures(axes[0], failed, groups, color, label)
    for axis, (name, values) in zip(axes[1:], measures.items(), strict=False):
        for color, groups in zip(colors, lines.values(), strict=True):
            _plot_quantiles(axis, values, groups, color)
        axis.set_title(name)
    if len(lines) > 1:
        axes[0].legend(fontsize="small")
    groups = next(iter(lines.values()))
    for axis in axes[1 + len(measures) :]:
        axis.set_axis_off()
    for axis in axes[: 1 + len(measures)]:
        axis.set_xlabel(parameter)
        axis.tick_params(labelbottom=True)
        axis.grid(alpha=0.3)
        if groups.texts is not None:
            axis.set_xticks(groups.centres, groups.texts)
            axis.set_xlim(-0.5, len(groups.texts) - 0.5)
    return axes[: 1 + len(measures)]


def _new_axes(measures: int, figure: Any) -> Any:
    """Return axes for the failures and for so many measures, in a figure or in a new one."""
    columns = 2 if measures == 3 else min(3, 1 + measures)
    rows = -(-(1 + measures) // columns)
    if figure is None:
        import matplotlib.pyplot as plt

        figure = plt.figure(figsize=(3.6 * columns, 2.9 * rows), layout="constrained")
    figure.suptitle("failures; median and 5 to 95 % of the runs that did not diverge", fontsize=10)
    return figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()


def _plot_failures(
    axis: Any, failed: NDArray[np.bool_], groups: Groups, color: str, label: str
) -> None:
    counts = [(int(np.sum(failed[each])), each.size) for each in groups.members]
    rates = np.array([100.0 * failures / max(runs, 1) for failures, runs in counts])
    low, high = 100.0 * np.array([share_interval(*each) for each in counts]).T
    reach = np.maximum([rates - low, high - rates], 0.0)
    style: dict[str, Any] = {"fmt": "o", "markersize": 3, "capsize": 2, "color": color}
    axis.errorbar(groups.centres, rates, reach, label=label or None, **style)
    axis.set_title("failure rate [%], 95 % interval")
    axis.set_ylim(bottom=0.0)


def _plot_quantiles(axis: Any, values: Vector, groups: Groups, color: str) -> None:
    found = np.full((len(QUANTILES), len(groups.members)), np.nan)
    for i, members in enumerate(groups.members):
        there = values[members][np.isfinite(values[members])]
        if there.size:
            found[:, i] = np.quantile(there, QUANTILES)
    low, median, high = found
    known = found[np.isfinite(found)]
    if known.size and np.min(known) > 0.0 and np.max(known) > _WIDE * np.nanmedian(median):
        axis.set_yscale("log")  # a few runs near divergence would hide all others
    if groups.texts is None:
        axis.fill_between(groups.centres, low, high, color=color, alpha=0.25, linewidth=0)
        axis.plot(groups.centres, median, color=color)
    else:
        reach = np.maximum([median - low, high - median], 0.0)
        axis.errorbar(groups.centres, median, reach, fmt="o", capsize=3, color=color)
