"""The ACC benchmark, a test designed by others: fixed controllers on a thousand uncertain plants.

Two masses on a spring, moved through an actuator with lag; all parameters are uncertain. After a
unit impulse on m2 the output must be within 0.1 m from 15 s on, with ``|u| ≤ 0.5`` N always
(Rocchetta, Crespo & Kenny, DSCC 2019). Each plant is simulated twice, without and with the cubic
part of its spring, for 30 s at dt = 10 ms.

The benchmark's figures: failure rates, responses, and failure rates against uncertainty.

Tuning for the box of uncertain plants: an MF-ESO whose law and observer have poles of their own.

The loop is nonlinear, because u is limited and the spring has a cubic part, and what counts is the
benchmark's criterion; so the ten parameters are found by simulation (``quell.tuning.simulated``),
from the MF-ESO of ``acc.controllers`` on.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell import checks
from quell.analysis import analyse
from quell.controllers import Controller
from quell.experiments.acc.loops import (
    B0,
    DT,
    DURATION,
    MF,
    MOST_U,
    MOST_Y,
    OMEGA_C,
    OMEGA_O,
    OURS,
    PUBLISHED,
    SETTLED_AT,
    CaseResult,
    Judged,
    designs,
    generated,
    judge,
    judge_published,
    plant,
    study_cases,
    unstable,
)
from quell.experiments.common import save_figures
from quell.plants import CubicSpringPlant, LinearPlant, PlantBatch, two_mass_spring
from quell.records.plotting import grid_of_axes, new_figure
from quell.simulation import Scenario, simulate
from quell.sweeping.sweep import share_interval as interval
from quell.tuning import Constraints
from quell.tuning.by_simulation import Build, tune_structure
from quell.tuning.simulated import Mean, Problem, Search
from quell.tuning.structures.base import Model
from quell.tuning.structures.registry import make_structure
from quell.types import Matrix, Progress, Vector

# ---- The ACC benchmark, a test designed by others ----

SPRINGS = {"linear": False, "cubic": True}
# Number of plants for the timing on one core: about a second on the machines used here.
_ONE_CORE = 100
# |y| at which a run ends [m]: a softening spring can break. Chosen by hand; any |y| far above 0.1 m
# is a failure.
_LOST = 1e3


@dataclass(frozen=True)
class Result:
    """The results, by spring and controller."""

    samples: Matrix
    source: str  #: origin of the samples
    judged: Mapping[str, Mapping[str, Judged]]
    cases: Mapping[str, CaseResult]  #: design cases of the original problem, by controller
    runs_per_second: float  #: judged runs of 30 s, of all sampled controllers, on all cores
    runs_per_second_one_core: float

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        rates: dict[str, Any] = {}
        for spring, found in self.judged.items():
            rates[spring] = {name: judged.to_json() for name, judged in found.items()}
        return rates | {
            "cases": {name: case.to_json() for name, case in self.cases.items()},
            "samples": {"source": self.source, "count": len(self.samples)},
            "runs_per_second": self.runs_per_second,
            "runs_per_second_one_core": self.runs_per_second_one_core,
        }


def run(samples: Matrix, source: str = "given", progress: Progress | None = None) -> Result:
    """Run the benchmark on samples (count, 6), and the design cases of the original problem."""
    report = progress or (lambda part, share: None)
    sampled, judged, spent, count = designs(DT), {}, 0.0, 0
    for spring, cubic in SPRINGS.items():
        found = {}
        for i, (name, published) in enumerate(PUBLISHED.items()):
            report(f"{name}, {spring}", i / len(PUBLISHED))
            found[name] = judge_published(published, samples, cubic)
        for name, controller in sampled.items():
            began = time.perf_counter()
            part = partial(report, f"{name}, {spring}")
            found[name] = judge_sampled(controller, samples, cubic, part)
            spent, count = spent + time.perf_counter() - began, count + len(samples)
        judged[spring] = found
    report("one core", 0.0)
    few, began = samples[:_ONE_CORE], time.perf_counter()
    for cubic in SPRINGS.values():
        for controller in sampled.values():
            judge_sampled(controller, few, cubic, workers=1)
    alone = len(few) * len(SPRINGS) * len(sampled) / (time.perf_counter() - began)
    report("design cases", 0.0)
    return Result(samples, source, judged, study_cases(), count / spent, alone)


def judge_sampled(
    controller: Controller,
    samples: Matrix,
    cubic: bool,
    progress: Callable[[float], None] | None = None,
    workers: int | None = None,
) -> Judged:
    """Simulate one controller on every plant and judge it; on all cores by default."""
    plants = [plant(sample, cubic) for sample in samples]
    recorded = records(controller, plants, 1.0 / samples[:, 1], progress, workers)
    return judge(*recorded, unstable(plants, controller))


def records(
    controller: Controller,
    plants: Sequence[LinearPlant | CubicSpringPlant],
    speeds: Vector,
    progress: Callable[[float], None] | None = None,
    workers: int | None = None,
) -> tuple[Vector, Matrix, Matrix]:
    """Return times (samples,), y and u (count, samples); m2 starts with ``speeds`` [m/s]."""
    starts = ([0.0, 0.0, 0.0, speed, 0.0] for speed in speeds.tolist())
    impulses = [Scenario(duration=DURATION, x0=x0) for x0 in starts]
    options: dict[str, Any] = {"limit": _LOST, "progress": progress, "workers": workers}
    runs = simulate(PlantBatch(plants), controller, impulses, record=("y", "u"), **options)
    return runs.t, runs["y"], runs["u"]


# ---- The benchmark's figures ----

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


def against_spread(progress: Progress) -> Rates:
    """Return by spring and controller the failure rate and its interval for each spread."""
    found: dict[str, dict[str, list[tuple[float, float, float]]]] = {s: {} for s in SPRINGS}
    ours = designs(DT)
    for i, spread in enumerate(SPREADS):
        samples = generated(_COUNT, spread, seed=1)
        for spring, cubic in SPRINGS.items():
            progress("spread", i / len(SPREADS))
            judged = {name: judge_published(C, samples, cubic) for name, C in PUBLISHED.items()}
            judged |= {name: judge_sampled(C, samples, cubic) for name, C in ours.items()}
            for name, one in judged.items():
                failures = int(np.sum(one.fails))
                point = (failures / _COUNT, *interval(failures, _COUNT))
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


# ---- Tuning for the box of uncertain plants ----

# Largest gain from noise in y to u, in units of that of MF-ESO. The benchmark has no noise, and
# without a bound the observer's poles become as fast as the sampling allows. Chosen by hand.
_MOST_NOISE = 10.0
# Weight of the size of |y| beside the failures, and the decades of |y| over 0.1 m in which it
# counts: it ranks candidates with equally many failures. Chosen by hand.
_WEIGHT, _DECADES = 0.03, (-0.3, 0.5)
# Ranges of the search: a factor either way around MF-ESO.
_FACTOR = 6.0
ORDER = 4


def build() -> Build:
    """Return the structure, an ADRC of order 4 with free poles and ``|p| dt <= 0.5``."""
    # Scales of the bounds only: the nominal plant has b = 1 and |P| = 1 near 1 rad/s.
    scales: dict[str, Any] = {"b": 1.0, "omega": 1.0, "gain": 1.0}
    bounds = Constraints(damping=None)
    loop = Model(None, delay=0.0, dt=DT, sign=1.0, degree=ORDER, constraints=bounds, **scales)
    return Build(make_structure("poles", loop, ORDER), {"u_min": -MOST_U, "u_max": MOST_U})


def start(made: Build) -> dict[str, float]:
    """Return the values with which the structure is the MF-ESO of ``designs``."""
    structure: Any = made.structure
    row = structure.rows_of(B0, np.full(ORDER, -OMEGA_C), np.full(ORDER + 1, -OMEGA_O))
    return dict(zip((p.name for p in structure.parameters), row.tolist(), strict=True))


def scores(controller: Controller, samples: Sequence[Vector]) -> Matrix:
    """Return (1, samples): 1 for a plant with cubic spring that fails, and a share for its |y|."""
    plants = [plant(sample, cubic=True) for sample in samples]
    lost = unstable(plants, controller)
    late, fails = np.full(len(plants), np.inf), np.ones(len(plants))
    kept = np.flatnonzero(~lost).tolist()
    if kept:  # an unstable loop fails, whatever its run shows
        speeds = np.array([1.0 / samples[i][1] for i in kept])
        recorded = records(controller, [plants[i] for i in kept], speeds, workers=1)
        judged = judge(*recorded, lost[kept])
        late[kept], fails[kept] = judged.late_peak, judged.fails
    decades = np.log10(np.maximum(late, 1e-9) / MOST_Y)
    return np.array([fails + _WEIGHT * np.clip(decades, *_DECADES)])


class TooMuchNoise:
    """By how much noise moves u more than allowed, as a logarithm; zero or less if it does not."""

    def __init__(self) -> None:
        self._most = _MOST_NOISE * noise_gain(designs(DT)[MF])

    def __call__(self, controller: Controller) -> float:
        """Return the logarithm of the gain over the largest one; infinite if it is unstable."""
        return float(np.log(noise_gain(controller) / self._most))


def noise_gain(controller: Controller) -> float:
    """Return the RMS of u per RMS of white noise in y, in the nominal loop [N/m]."""
    loop = analyse(two_mass_spring(), controller)
    return loop.noise_to_control if loop.stable else float("inf")


def tune(samples: Matrix, **options: Any) -> tuple[Search, Controller]:
    """Tune for samples (count, 6); ``options`` as for ``quell.tuning.simulated.search``."""
    made = build()
    problem = Problem(list(samples), scores, {"failures": Mean()})
    options = {"factor": _FACTOR, "violation": TooMuchNoise(), **options}
    found = tune_structure(made, problem, start(made), **options)
    best: Mapping[str, float] = found.best.parameters
    return found, made(best)
