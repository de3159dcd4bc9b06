"""The benchmark's figures: failure rates, responses, and failure rates against uncertainty."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell import checks
from quell.experiments.acc.controllers import DT, MF, MOST_U, OURS, PUBLISHED, designs
from quell.experiments.acc.criteria import DURATION, MOST_Y, SETTLED_AT
from quell.experiments.acc.published import judge_published
from quell.experiments.acc.samples import generated, plant
from quell.experiments.acc.study import SPRINGS, Result, judge_sampled, records
from quell.experiments.common.figures import save_figures
from quell.records.plotting import grid_of_axes, new_figure
from quell.sweeping.shares import share_interval as interval
from quell.types import Matrix, Progress

SPREADS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
# Plants for each spread, and responses in a figure: chosen by hand, about a minute in all.
_COUNT, _RESPONSES = 200, 200

Rates = Mapping[str, Mapping[str, Sequence[tuple[float, float, float]]]]

NAMES = ("acc-failures", "acc-responses", "acc-spread")
"""Names of the figures."""


def save(
    result: Result, folder: str | os.PathLike[str], progress: Progress, overwrite: bool = False
) -> list[Path]:
    """Draw the figures into ``folder``, created if missing; return the paths."""
    named = {name: partial(draw, result, name, progress=progress) for name in NAMES}
    return save_figures(named, folder, progress, overwrite=overwrite)


def draw(
    result: Result, name: str, ax: Any = None, *, progress: Progress = lambda part, share: None
) -> Any:
    """Draw one of the figures ``NAMES`` and return its axes.

    Parameters
    ----------
    result
        of ``run``.
    name
        ``"acc-failures"`` with one axes, ``"acc-responses"`` with two for each of our three
        controllers, ``"acc-spread"`` with two; the last one is simulated for a minute.
    ax
        axes to draw into; those of a new figure by default.
    progress
        is told about that minute.

    Raises
    ------
    ValueError
        for another name or number of axes.
    """
    if checks.one_of("name", name, NAMES) == "acc-failures":
        return _failures(result, ax)
    if name == "acc-responses":
        return _responses(result.samples[:_RESPONSES], ax)
    return _spread(against_spread(progress), ax)


def against_spread(
    progress: Progress, spreads: Sequence[float] = SPREADS, count: int = _COUNT
) -> Rates:
    """Return by spring and controller the failure rate and its interval for each spread."""
    found: dict[str, dict[str, list[tuple[float, float, float]]]] = {s: {} for s in SPRINGS}
    ours = designs(DT)
    for i, spread in enumerate(spreads):
        samples = generated(count, spread, seed=1)
        for spring, cubic in SPRINGS.items():
            progress("spread", i / len(spreads))
            judged = {name: judge_published(C, samples, cubic) for name, C in PUBLISHED.items()}
            judged |= {name: judge_sampled(C, samples, cubic) for name, C in ours.items()}
            for name, one in judged.items():
                failures = int(np.sum(one.fails))
                point = (failures / count, *interval(failures, count))
                found[spring].setdefault(name, []).append(point)
    return found


def _failures(result: Result, given: Any) -> Any:
    """Draw the failure rates with their intervals."""
    axes = grid_of_axes(given, partial(new_figure, 9.0, 5.2), 1)[0]
    (ax,) = axes
    for k, (spring, judged) in enumerate(result.judged.items()):
        rows = [one.to_json() for one in judged.values()]
        rates = np.array([row["failure_rate"] for row in rows], dtype=float)
        ends = np.array([row["ci95"] for row in rows], dtype=float)
        at = np.arange(rates.size) + 0.38 * (k - 0.5)
        error = 100.0 * np.maximum(np.abs(ends.T - rates), 0.0)
        style = {"color": f"C{k}", "label": f"{spring} spring", "error_kw": {"elinewidth": 1.0}}
        ax.barh(at, 100.0 * rates, height=0.36, xerr=error, **style)
        for y, rate, high in zip(at, rates, ends[:, 1], strict=True):
            ax.text(100.0 * high + 1.0, y, f"{100.0 * rate:.1f} %", va="center", fontsize="small")
    ax.set_yticks(range(len(judged)), list(judged))
    ax.invert_yaxis()
    ax.set(xlim=(0.0, 112.0), xlabel="plants that fail [%], with 95 % confidence interval")
    title = f"ACC benchmark, {len(result.samples)} plants ({result.source})"
    ax.set_title(title, fontsize="medium")
    ax.legend(loc="lower right", fontsize="small")
    return axes


def _responses(samples: Matrix, given: Any) -> Any:
    """Draw y and u of our controllers with cubic springs: median, 90 % of the runs, and all."""
    ours = {name: controller for name, controller in designs(DT).items() if name in OURS}
    make = partial(new_figure, 9.0, 5.2)
    axes = grid_of_axes(given, make, 2, len(ours), sharex=True, sharey="row")
    plants = [plant(sample, cubic=True) for sample in samples]
    ended = 0
    for j, (name, controller) in enumerate(ours.items()):
        t, *channels = records(controller, plants, 1.0 / samples[:, 1])
        ended += int(np.sum(np.isnan(channels[0][:, -1])))
        for ax, values, bound, start in zip(
            axes[:, j], channels, (MOST_Y, MOST_U), (SETTLED_AT, 0.0), strict=True
        ):
            there = ~np.all(np.isnan(values), axis=0)
            levels = np.full((5, t.size), np.nan)
            shares = [0.0, 5.0, 50.0, 95.0, 100.0]
            levels[:, there] = np.nanpercentile(values[:, there], shares, axis=0)
            for low, label, alpha in ((0, "all", 0.2), (1, "90 %", 0.4)):
                band = {"color": "C0", "alpha": alpha, "linewidth": 0.0, "label": label}
                ax.fill_between(t, levels[low], levels[4 - low], **band)
            ax.plot(t, levels[2], color="C0", label="median")
            limit = {"color": "C3", "linewidth": 1.0, "linestyle": "--"}
            for sign in (-1.0, 1.0):
                ax.plot([start, DURATION], [sign * bound] * 2, **limit)
            ax.grid(alpha=0.3)
        axes[0, j].set_title(name, fontsize="medium")
        axes[1, j].set_xlabel("time [s]")
    axes[0, 0].set(ylabel="position of m2 [m]", ylim=(-1.0, 2.5))
    axes[1, 0].set_ylabel("control signal [N]")
    axes[0, 0].legend(fontsize="small")
    lost = f"; {ended} runs that flew apart end where they did" if ended else ""
    title = (
        f"Impulse on m2, the first {len(samples)} plants with cubic springs; "
        f"dashed: what is required{lost}"
    )
    if given is None:
        axes[0, 0].figure.suptitle(title, fontsize="medium")
    return axes


def _spread(rates: Rates, given: Any) -> Any:
    """Draw failure rates against the spread of the samples."""
    axes = grid_of_axes(given, partial(new_figure, 9.0, 4.0), 1, len(rates), sharey=True)[0]
    for ax, (spring, found) in zip(axes, rates.items(), strict=True):
        for i, (name, points) in enumerate(found.items()):
            rate, low, high = 100.0 * np.array(points).T
            style = "--" if name in PUBLISHED else "-" if name in OURS else ":"
            # Lines under another line are wide.
            wide = 4.0 if name in (MF, "PID") else 1.5
            marks = {"marker": "o", "markersize": 2.0 * wide, "label": name}
            ax.plot(SPREADS, rate, color=f"C{i}", linestyle=style, linewidth=wide, **marks)
            ax.fill_between(SPREADS, low, high, color=f"C{i}", alpha=0.1, linewidth=0.0)
        ax.set_title(f"{spring} spring", fontsize="medium")
        ax.set_xlabel("spread of the plants (1: as published)")
        ax.grid(alpha=0.3)
    axes[0].set_ylabel(f"of {_COUNT} drawn plants fail [%]")
    if given is None:
        handles = axes[0].get_legend_handles_labels()
        place = {"loc": "outside lower center", "ncols": 5, "fontsize": "small"}
        axes[0].figure.legend(*handles, **place)
    return axes
