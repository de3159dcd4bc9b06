"""The benchmark's figures: failure rates, responses, and the failure rate against how uncertain plants are."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quell.experiments.acc import samples as acc_samples
from quell.experiments.acc.controllers import DT, MF, MOST_U, OURS, PUBLISHED, designs
from quell.experiments.acc.criteria import DURATION, MOST_Y, SETTLED_AT, interval
from quell.experiments.acc.published import judge_published
from quell.experiments.acc.study import SPRINGS, Result, judge_sampled, records
from quell.experiments.common.figures import make_folder, save_figure

SPREADS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
# Plants for each spread, and responses in a figure.
_COUNT, _RESPONSES = 200, 200

Rates = Mapping[str, Mapping[str, Sequence[tuple[float, float, float]]]]


def save(
    result: Result, folder: str | os.PathLike[str], progress: Callable[[str, float], None]
) -> list[Path]:
    """Draw the figures of a result and save them to a folder; return the paths."""
    where = make_folder(folder)
    written = save_figure(_failures(result), where, "acc-failures")
    written += save_figure(_responses(result.samples[:_RESPONSES]), where, "acc-responses")
    return written + save_figure(_spread(against_spread(progress)), where, "acc-spread")


def against_spread(
    progress: Callable[[str, float], None], spreads: Sequence[float] = SPREADS, count: int = _COUNT
) -> Rates:
    """Return by spring and controller (failure rate, and its interval) for each spread, on ``count`` drawn samples each."""
    found: dict[str, dict[str, list[tuple[float, float, float]]]] = {
        spring: {} for spring in SPRINGS
    }
    ours = designs(DT)
    for i, spread in enumerate(spreads):
        samples = acc_samples.generated(count, spread, seed=1)
        for spring, cubic in SPRINGS.items():
            progress("spread", i / len(spreads))
            judged = {
                name: judge_published(design, samples, cubic) for name, design in PUBLISHED.items()
            }
            judged |= {
                name: judge_sampled(controller, samples, cubic) for name, controller in ours.items()
            }
            for name, one in judged.items():
                failures = int(np.sum(one.fails))
                found[spring].setdefault(name, []).append(
                    (failures / count, *interval(failures, count))
                )
    return found


def _figure(height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(9.0, height), layout="constrained")


def _failures(result: Result) -> Any:
    """Draw the failure rates with their intervals."""
    figure = _figure(5.2)
    ax = figure.subplots()
    for k, (spring, judged) in enumerate(result.judged.items()):
        rows = [one.to_json() for one in judged.values()]
        rates = np.array([row["failure_rate"] for row in rows], dtype=float)
        ends = np.array([row["ci95"] for row in rows], dtype=float)
        at = np.arange(rates.size) + 0.38 * (k - 0.5)
        error = 100.0 * np.maximum(np.abs(ends.T - rates), 0.0)
        ax.barh(
            at,
            100.0 * rates,
            height=0.36,
            xerr=error,
            color=f"C{k}",
            label=f"{spring} spring",
            error_kw={"elinewidth": 1.0},
        )
        for y, rate, high in zip(at, rates, ends[:, 1], strict=True):
            ax.text(100.0 * high + 1.0, y, f"{100.0 * rate:.1f} %", va="center", fontsize="small")
    ax.set_yticks(range(len(judged)), list(judged))
    ax.invert_yaxis()
    ax.set_xlim(0.0, 112.0)
    ax.set_xlabel("plants that fail [%], with 95 % confidence interval")
    ax.set_title(
        f"ACC benchmark, {len(result.samples)} plants ({result.source})", fontsize="medium"
    )
    ax.legend(loc="lower right", fontsize="small")
    return figure


def _responses(samples: Any) -> Any:
    """Draw y and u of our controllers on plants with cubic springs: median, 90 % of all, and all."""
    ours = {name: controller for name, controller in designs(DT).items() if name in OURS}
    figure = _figure(5.2)
    axes = figure.subplots(2, len(ours), sharex=True, sharey="row")
    plants = [acc_samples.plant(sample, cubic=True) for sample in samples]
    ended = 0
    for j, (name, controller) in enumerate(ours.items()):
        t, *channels = records(controller, plants, 1.0 / samples[:, 1])
        ended += int(np.sum(np.isnan(channels[0][:, -1])))
        for ax, values, bound, start in zip(
            axes[:, j], channels, (MOST_Y, MOST_U), (SETTLED_AT, 0.0), strict=True
        ):
            there = ~np.all(np.isnan(values), axis=0)
            levels = np.full((5, t.size), np.nan)
            levels[:, there] = np.nanpercentile(
                values[:, there], [0.0, 5.0, 50.0, 95.0, 100.0], axis=0
            )
            ax.fill_between(
                t, levels[0], levels[4], color="C0", alpha=0.2, linewidth=0.0, label="all"
            )
            ax.fill_between(
                t, levels[1], levels[3], color="C0", alpha=0.4, linewidth=0.0, label="90 %"
            )
            ax.plot(t, levels[2], color="C0", label="median")
            for sign in (-1.0, 1.0):
                ax.plot(
                    [start, DURATION], [sign * bound] * 2, color="C3", linewidth=1.0, linestyle="--"
                )
            ax.grid(alpha=0.3)
        axes[0, j].set_title(name, fontsize="medium")
        axes[1, j].set_xlabel("time [s]")
    axes[0, 0].set_ylabel("position of m2 [m]")
    axes[0, 0].set_ylim(-1.0, 2.5)
    axes[1, 0].set_ylabel("control signal [N]")
    axes[0, 0].legend(fontsize="small")
    lost = f"; {ended} runs that flew apart end where they did" if ended else ""
    title = f"Impulse on m2, the first {len(samples)} plants with cubic springs; dashed: what is required{lost}"
    figure.suptitle(title, fontsize="medium")
    return figure


def _spread(rates: Rates) -> Any:
    """Draw failure rates against the spread of the samples."""
    figure = _figure(4.0)
    axes = figure.subplots(1, len(rates), sharey=True)
    for ax, (spring, found) in zip(axes, rates.items(), strict=True):
        for i, (name, points) in enumerate(found.items()):
            rate, low, high = 100.0 * np.array(points).T
            style = "--" if name in PUBLISHED else "-" if name in OURS else ":"
            # Those that others lie upon are wide.
            wide = 4.0 if name in (MF, "PID") else 1.5
            ax.plot(
                SPREADS,
                rate,
                color=f"C{i}",
                linestyle=style,
                linewidth=wide,
                marker="o",
                markersize=2.0 * wide,
                label=name,
            )
            ax.fill_between(SPREADS, low, high, color=f"C{i}", alpha=0.1, linewidth=0.0)
        ax.set_title(f"{spring} spring", fontsize="medium")
        ax.set_xlabel("spread of the plants (1: as published)")
        ax.grid(alpha=0.3)
    axes[0].set_ylabel(f"of {_COUNT} drawn plants fail [%]")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize="small"
    )
    return figure
