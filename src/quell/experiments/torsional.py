"""The paper's hardware experiment (section V) on a twin of the ECP 205 torsional testbed.

From rest the upper disk follows (π/2) sin(π t/2) for 40 s, while a learner learns; then the loop
starts from rest again, with what was learned, and follows a trapezoidal profile to π within 2 s.
The output comes from an encoder of 16 000 counts. There are two plants: *friction*, the twin with
Coulomb friction, converter and current limit, and *linear*, the transfer function that the paper
identified, behind the encoder.

The paper leaves open: the duration of the training (40 s here), the ramps of the profile (0.5 s
each), the settling band (±0.2 % of the move; settling counts from the profile's start, as in the
two-mass study), and the observers (those of that study). u is limited to the range of the drive,
and the observers get the limited u. The only random quantity is the start between two edges of the
encoder; results are medians over several starts.

The torsional experiment: run it, measure the values that the paper claims, judge the claims.

The figures of the torsional experiment: the paper's two, and what was learned.
"""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell import checks
from quell.controllers import ADRC
from quell.experiments.common import (
    ESTIMATES,
    METRICS,
    STYLES,
    Claim,
    Scores,
    ended_early,
    legend_label,
    ratio,
    save_paper_figures,
    step_scores,
    wide_figure,
)
from quell.guard import Guard
from quell.learners import Kalman
from quell.observers import ESO
from quell.parallel import in_parallel
from quell.plants import LinearPlant, Plant, encoded, torsional, torsional_identified
from quell.records import metrics
from quell.records.plotting import draw_line, grid_of_axes
from quell.records.trajectory import Trajectory
from quell.signals import Sinusoid, Trapezoid
from quell.simulation import simulate
from quell.simulation.scenario import Scenario
from quell.types import Progress, Vector

# ---- The paper's hardware experiment (section V) on a twin of the ECP 205 torsional testbed ----

PROFILE_AT, END = 40.0, 50.0  # start of the profile, end of the experiment [s]; see above
TARGET, MOVE_TIME, RAMP_TIME = math.pi, 2.0, 0.5
BAND = 0.002  # half width of the settling band, as a fraction of the move; see above
COUNTS = 16_000  # counts per turn of the encoder, of the paper
B0 = 5.5e4  # the paper's b0 of MF-ESO and L-ESO [rad/(V s⁴)]; the identified plant has 4.6e4
STARTS = 5  # number of starts: chosen by hand, an odd number for medians
CASES = ((90.0, 40.0), (40.0, 90.0), (20.0, 90.0))
"""omega_c and omega_o [rad/s]: the paper's, exchanged, and where the claims hold best."""

MF, MB, L = "MF-ESO", "MB-ESO", "L-ESO"
MB_OFF, LG = "MB-ESO (10 % off)", "L-ESO (guarded)"
NAMES = (MF, MB, L, MB_OFF, LG)
FRICTION, LINEAR = "friction", "linear"
PLANTS = (FRICTION, LINEAR)

# Longest sample time [s]: at 5 ms the fastest loop still works; chosen with a margin to it.
_LONGEST_DT = 2e-3
# Shortest sample time [s]: about 5 GB of records.
_SHORTEST_DT = 1e-4


@dataclass(frozen=True)
class Settings:
    """The parameters of the experiment that may be varied."""

    dt: float = 1e-3  #: sample time [s]
    seed: int = 0  #: seed of the starts between two edges of the encoder

    def __post_init__(self) -> None:
        if not _SHORTEST_DT <= checks.positive("dt", self.dt, "s") <= _LONGEST_DT:
            raise ValueError(
                f"dt = {self.dt!r}: must be from {_SHORTEST_DT:g} to {_LONGEST_DT:g} s, "
                "as the loops have up to 90 rad/s"
            )
        checks.whole("seed", self.seed, 0)


def plant(kind: str) -> Plant:
    """Return the plant with friction, or the linear one."""
    return torsional(counts=COUNTS) if kind == FRICTION else encoded(torsional_identified(), COUNTS)


def scenarios(settings: Settings, kind: str) -> list[Scenario]:
    """Return the scenario for each start; both disks are turned by the same fraction of a count."""
    training = Sinusoid(amplitude=0.5 * math.pi, omega=0.5 * math.pi)
    profile = Trapezoid(distance=TARGET, duration=MOVE_TIME, ramp_time=RAMP_TIME, start=PROFILE_AT)
    reference = training.until(PROFILE_AT, then=profile)
    scenario = Scenario(reference, duration=END, rest_at=(PROFILE_AT,))
    rest = np.array([1.0, float(kind == FRICTION), 0.0, 0.0]) * math.tau / COUNTS
    parts = np.random.default_rng(settings.seed).uniform(-0.5, 0.5, STARTS)
    return [replace(scenario, x0=part * rest) for part in parts]


def model_off() -> LinearPlant:
    """Return the identified model with coefficients 10 % too large, and a gain 10 % too small."""
    numerator = [4.6e4 * (1.0 - 0.1)]
    denominator = np.array([1.901, 1683.0, 1812.0, 0.1032]) * (1.0 + 0.1)
    return LinearPlant.of((numerator, [1.0, *denominator]), name="torsional plant, not quite")


def controllers(settings: Settings, omega_c: float, omega_o: float) -> dict[str, ADRC]:
    """Return the controllers by name, with bandwidths in rad/s; the learner is not tuned."""
    free = ESO.model_free(order=4, b0=B0, omega_o=omega_o, dt=settings.dt)
    exact = ESO.model_based(torsional_identified(), omega_o=omega_o, dt=settings.dt)
    off = ESO.model_based(model_off(), omega_o=omega_o, dt=settings.dt)
    most = torsional().u_max

    def law(observer: ESO, learner: Kalman | None = None, guard: Guard | None = None) -> ADRC:
        return ADRC(observer, omega_c, learner=learner, guard=guard, u_min=-most, u_max=most)

    return {
        MF: law(free),
        MB: law(exact),
        L: law(free, Kalman()),
        MB_OFF: law(off),
        LG: law(free, Kalman(), Guard()),
    }


def score(run: Trajectory) -> Scores:
    """Return the scores over [40, 50] s; None if the run ended too early, or y did not settle.

    Overshoot (a fraction of π), settling time [s] from the profile's start, control variation [V],
    and the RMS of y − r [rad]. ``disturbance_peak`` and ``disturbance_rms`` are None: nothing but
    friction disturbs.
    """
    found: Scores = dict.fromkeys(METRICS)
    if run.ended >= END - 2 * run.dt:
        part = run.window(PROFILE_AT, END + 0.5 * run.dt)
        y = run["y"][part]
        found |= step_scores(run.t[part], y, TARGET, BAND)
        found["control_variation"] = metrics.control_variation(run["u"][part])
        found["rms_from_step"] = metrics.rms(y - run["r"][part])
    return found


# ---- The torsional experiment ----

# One count of the encoder as a fraction of the move, the resolution of an overshoot. Overshoots are
# whole counts, up to rounding, for which there is the last factor.
_COUNT = 2.0 / COUNTS * (1.0 + 1e-6)


@dataclass(frozen=True)
class Outcome:
    """The results on one plant."""

    records: Mapping[str, Trajectory]  #: records of the first start
    scores: Mapping[str, Scores]  #: medians over the starts, by controller
    #: least and largest score over the starts
    spread: Mapping[str, Mapping[str, tuple[float, float] | None]]
    claims: tuple[Claim, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists; None for values that were not measured."""
        return {
            "controllers": {name: dict(score) for name, score in self.scores.items()},
            "spread": {name: dict(spread) for name, spread in self.spread.items()},
            "claims": [asdict(claim) for claim in self.claims],
            "ended_early": ended_early(self.records),
        }


@dataclass(frozen=True)
class Case:
    """One pair of bandwidths [rad/s], on each plant."""

    omega_c: float
    omega_o: float
    outcomes: Mapping[str, Outcome]

    @property
    def label(self) -> str:
        """The pair, as in ``"20/90"``."""
        return f"{self.omega_c:g}/{self.omega_o:g}"

    def to_json(self) -> dict[str, Any]:
        """Return the results: those with friction at the top, the linear plant's under its name."""
        bandwidths = {"omega_c": self.omega_c, "omega_o": self.omega_o}
        friction, linear = self.outcomes[FRICTION].to_json(), self.outcomes[LINEAR].to_json()
        return bandwidths | {"settings": bandwidths} | friction | {LINEAR: linear}


@dataclass(frozen=True)
class Result:
    """The results, case by case."""

    settings: Settings
    cases: tuple[Case, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        about = {
            "plant": "ECP 205 torsional plant, two disks, y = angle of the upper one; "
            "with friction, and (linear) as identified",
            "encoder_counts": COUNTS,
            "profile_window": (PROFILE_AT, END),
            "settling_band": BAND,
            "starts": STARTS,
            "units": "SI; overshoot as a fraction of the move; "
            "settling time from the profile's start; medians over the starts",
        }
        cases = [case.to_json() for case in self.cases]
        return {"settings": asdict(self.settings) | about, "cases": cases}


def run(settings: Settings, progress: Progress | None = None) -> Result:
    """Run the experiment."""
    progress = progress or (lambda part, share: None)
    jobs = {
        (case, kind, name): partial(_starts, plant(kind), controller, scenarios(settings, kind))
        for case in CASES
        for kind in PLANTS
        for name, controller in controllers(settings, *case).items()
    }
    done = dict(zip(jobs, in_parallel(jobs.values(), partial(progress, "simulating")), strict=True))

    def outcome(case: tuple[float, float], kind: str) -> Outcome:
        mine = {name: found for (*at, name), found in done.items() if at == [case, kind]}
        scores = {name: _over_starts(found, statistics.median) for name, (_, found) in mine.items()}
        spread = {
            name: _over_starts(found, lambda values: (min(values), max(values)))
            for name, (_, found) in mine.items()
        }
        records = {name: first for name, (first, _) in mine.items()}
        return Outcome(records, scores, spread, tuple(_claims(scores, settings.dt)))

    cases = (Case(*case, {kind: outcome(case, kind) for kind in PLANTS}) for case in CASES)
    return Result(settings, tuple(cases))


def _starts(
    plant: Plant, controller: ADRC, starts: Sequence[Scenario]
) -> tuple[Trajectory, list[Scores]]:
    """Run a controller from all starts; return the first record, and all scores."""
    first = simulate(plant, controller, starts[0])
    others = (simulate(plant, controller, start) for start in starts[1:])
    return first, [score(first), *map(score, others)]


def _over_starts(scores: Sequence[Scores], summary: Callable[[list[float]], Any]) -> dict[str, Any]:
    """Summarise each score over the starts; None if a start does not have it."""
    columns = {key: [score[key] for score in scores] for key in scores[0]}
    return {
        key: None if None in values else summary([v for v in values if v is not None])
        for key, values in columns.items()
    }


def _claims(scores: Mapping[str, Scores], dt: float) -> Iterable[Claim]:
    """Judge the paper's two observations.

    L-ESO has the least overshoot and settles first; its control variation is below MF-ESO's and
    above MB-ESO's. Overshoots differ by at least a count of the encoder, settling times by a
    sample.
    """
    for key, name, unit, resolution in (
        ("overshoot", "overshoot", "", _COUNT),
        ("settling_time", "settling", "s", dt),
    ):
        for other in (MF, MB_OFF, MB):
            rival = scores[other][key]
            most = None if rival is None else rival + resolution
            yield Claim.at_most(f"{L}: {name} ≤ {other}'s", "best", scores[L][key], most, unit)
    for other, judge in ((MF, Claim.below_one), (MB, Claim.above_one)):
        value = ratio(scores[L]["control_variation"], scores[other]["control_variation"])
        yield judge(f"{L}: variation over {other}'s", value)


# ---- The figures of the torsional experiment ----

_STYLES: Mapping[str, dict[str, Any]] = {
    MF: STYLES[MF],
    MB: STYLES[MB],
    MB_OFF: {"color": "#2a6f97", "linewidth": 1.0, "linestyle": "--"},
    L: STYLES[L],
}
_HEADINGS = {FRICTION: "with friction", LINEAR: "linear"}
# From the profile's start [s]: the move, and the time around the arrival at π.
_MOVE, _ARRIVAL = (0.0, 4.0), (1.9, 6.0)
# Half height of the axes around π [%]: four settling bands.
_NEAR = 100.0 * 4.0 * BAND
# Time over which f is averaged [s]: chosen by hand.
_SMOOTHED = 0.02

FIGURE_NAMES = ("torsional-position", "torsional-control", "torsional-learning")
"""Names of the figures."""


def save(
    result: Result, folder: str | os.PathLike[str], progress: Progress, overwrite: bool = False
) -> list[Path]:
    """Draw all figures into ``folder``, created if missing; return the paths."""
    return save_paper_figures(draw, FIGURE_NAMES, result, folder, progress, overwrite)


def draw(result: Result, name: str, ax: Any = None) -> Any:
    """Draw one of the figures ``FIGURE_NAMES`` and return its axes.

    Parameters
    ----------
    result
        of ``run``.
    name
        ``"torsional-position"`` with three axes for each case, ``"torsional-control"`` with two for
        each case, ``"torsional-learning"`` with two.
    ax
        axes to draw into; those of a new figure by default.

    Raises
    ------
    ValueError
        for another name or number of axes.
    """
    drawings = dict(zip(FIGURE_NAMES, (_position, _control, _learning), strict=True))
    return drawings[checks.one_of("name", name, FIGURE_NAMES)](result, ax)


def _position(result: Result, given: Any) -> Any:
    """Draw the upper disk's angle: the move, and the arrival on both plants."""
    make = partial(wide_figure, 8.4, top=0.93, hspace=0.2)
    rows = grid_of_axes(given, make, len(result.cases), 3)
    for case, (move, *arrivals) in zip(result.cases, rows, strict=True):
        runs = case.outcomes[FRICTION].records
        for name, style in _STYLES.items():
            run = runs[name]
            _line(move, run, run["y"], _MOVE, label=legend_label(name, run), **style)
        reference = {"label": "r", "color": "0.3", "linestyle": ":", "linewidth": 1.0}
        _line(move, runs[MF], runs[MF]["r"], _MOVE, **reference)
        move.set_ylabel(f"{case.label}\nupper disk [rad]")
        for ax, kind in zip(arrivals, PLANTS, strict=True):
            for name, style in _STYLES.items():
                run = case.outcomes[kind].records[name]
                _line(ax, run, 100.0 / TARGET * (run["y"] - TARGET), _ARRIVAL, **style)
            ax.axhspan(-100.0 * BAND, 100.0 * BAND, color="0.9", zorder=0)
            ax.set_ylim(-_NEAR, _NEAR)
    rows[0, 0].set_title("with friction", fontsize="medium")
    for ax, kind in zip(rows[0, 1:], PLANTS, strict=True):
        ax.set_title(f"distance from π [%], {_HEADINGS[kind]}", fontsize="medium")
    rows[0, 0].legend(fontsize="x-small", loc="lower right")
    for ax in rows[-1]:
        ax.set_xlabel("time from the profile's start [s]")
    title = "Upper disk along the trapezoid to π, for each omega_c/omega_o [rad/s]; grey: ±0.2 %"
    if given is None:
        rows[0, 0].figure.suptitle(title, fontsize="medium", y=0.995)
    return rows


def _control(result: Result, given: Any) -> Any:
    """Draw the control signal on both plants."""
    make = partial(wide_figure, 8.4, left=0.1, hspace=0.1, wspace=0.05)
    rows = grid_of_axes(given, make, len(result.cases), 2, sharex=True, sharey="row")
    for case, axes in zip(result.cases, rows, strict=True):
        for ax, kind in zip(axes, PLANTS, strict=True):
            for name in (MF, L, MB):  # the quietest in front
                run, style = case.outcomes[kind].records[name], _STYLES[name]
                style = style | {"linewidth": 0.7, "alpha": 0.8, "label": legend_label(name, run)}
                _line(ax, run, run["u"], (0.0, END - PROFILE_AT), **style)
        axes[0].set_ylabel(f"{case.label}\ncontrol signal [V]")
    for ax, kind in zip(rows[0], PLANTS, strict=True):
        ax.set_title(_HEADINGS[kind], fontsize="medium")
    rows[0, 0].legend(fontsize="small", loc="upper right", ncols=3)
    for ax in rows[-1]:
        ax.set_xlabel("time from the profile's start [s]")
    return rows


def _learning(result: Result, given: Any) -> Any:
    """Draw the coefficients of L-ESO with friction, and the parts of its estimate of f."""
    case = result.cases[-1]
    run = case.outcomes[FRICTION].records[L]
    above, below = axes = grid_of_axes(given, partial(wide_figure, 7.2, left=0.1), 2)[:, 0]
    # The identified plant's own coefficients, f = −(b0/b) a·x + (1 − b0/b)(…), as its gain is b and
    # not b0.
    numbers = -torsional_identified().A[-1] * B0 / float(torsional_identified().B[-1, 0])
    for i, feature in enumerate(run.features[:3]):
        draw_line(above, run.t, run["theta"][:, i], label=feature, color=f"C{i}", linewidth=1.2)
        above.axhline(-numbers[i], color=f"C{i}", linestyle=":", linewidth=1.2)
    title = (
        f"coefficients of L-ESO at {case.label} with friction; "
        "dotted: the identified plant's, for b0"
    )
    above.set_title(title, fontsize="medium")
    above.set(ylabel="theta", ylim=(-4000.0, 2000.0))
    for channel, label in ESTIMATES.items():
        smooth = _smooth(run[channel], run.dt * run.every)
        draw_line(below, run.t, smooth, label=label, linewidth=1.0)
    below.set_title("total disturbance as L-ESO has it, averaged over 20 ms", fontsize="medium")
    below.set(xlabel="time [s]", ylabel="f [rad/s⁴]", ylim=(-2e4, 2e4))
    for ax in (above, below):
        ax.axvline(PROFILE_AT, color="0.3", linewidth=1.0, linestyle="--")
        ax.set_xlim(0.0, END)
        ax.legend(fontsize="small", ncols=3, loc="upper right")
    return axes


def _smooth(values: Vector, dt: float) -> Vector:
    width = max(round(_SMOOTHED / dt), 1)
    return np.convolve(values, np.full(width, 1.0 / width), mode="same")


def _line(ax: Any, run: Trajectory, values: Vector, span: tuple[float, ...], **style: Any) -> None:
    """Draw values of a run in a span of time from the profile's start [s]."""
    part = run.window(PROFILE_AT + span[0], PROFILE_AT + span[1])
    if part.stop > part.start:
        draw_line(ax, run.t[part] - PROFILE_AT, values[part], **style)
    ax.set_xlim(*span)
