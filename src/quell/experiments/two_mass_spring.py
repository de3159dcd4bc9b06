"""The paper's simulation study (section IV) on the two-mass-spring benchmark.

From rest the output follows sin t for 110 s, while a learner learns; then the loop starts from rest
again, with what was learned, and follows a unit step. From 150 s a force sin(π(t − 150)/10) N acts
on m2. The paper leaves open the start from rest, the settling band of 0.2 %, the force's amplitude
and the observer's discretisation. They are chosen here to reproduce the paper's figures;
docs/paper describes how.

Means and 95 % intervals over seeds of the noise, under forces of three frequencies.

The rows are all controllers of the study: those of the paper, those that were added, and what a
learner is made of, one by one. The step and the margins are those of the run with the paper's
force, because a force begins after the step.

The two-mass study: run it, measure the values that the paper claims, judge the claims.

The figures of the two-mass study: the paper's two, what was learned, and Algorithm 1.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from quell import checks
from quell.analysis.loop import analyse_axis
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
from quell.learners import BatchGradient, Harmonic, Kalman, Learner
from quell.observers import ESO
from quell.parallel import in_parallel
from quell.plants import two_mass_spring
from quell.records import metrics
from quell.records.plotting import draw_line, grid_of_axes
from quell.records.trajectory import Trajectory
from quell.signals import BandLimitedNoise, Constant, Sinusoid, Step
from quell.simulation import Scenario, simulate
from quell.types import Progress, Vector

# ---- The paper's simulation study (section IV) on the two-mass-spring benchmark ----

STEP_AT, FORCE_AT, END = 110.0, 150.0, 250.0
"""Start of the step and of the force, end of the study [s], of the paper."""
STEP_WINDOW = (STEP_AT, FORCE_AT)
FORCE_WINDOW = (170.0, END)
"""Time in which the force is scored [s], from the start of the paper's second zoom on."""
BAND = 0.002
"""Half width of the settling band, as a fraction of the step: gives the paper's settling times."""

MF, MB, L, L1 = "MF-ESO", "MB-ESO", "L-ESO", "L-ESO (Algorithm 1)"
MF3, MB3 = "MF-ESO (3x bandwidth)", "MB-ESO (3x bandwidth)"
MF_2, MB_2 = "MF-ESO m = 2", "MB-ESO m = 2"
"""With two extended states, f and f', at ``TWO_STATES`` times the bandwidth: not in the paper."""
GUARDED = "L-ESO, guarded"
NAMES = (MF, MB, L, L1, MF3, MB3, MF_2, MB_2, GUARDED)
STATE, BIAS = "L-ESO, state only", "L-ESO, bias only"
HARMONIC, HARMONIC_GUARDED = "L-ESO, Harmonic", "L-ESO, Harmonic, guarded"
NO_BIAS = "L-ESO, Harmonic without bias, guarded"
L1_NO_U = "L-ESO (Algorithm 1 without u)"
MF_3, MB_3 = "MF-ESO m = 3", "MB-ESO m = 3"
"""With f, f' and f'', at ``THREE_STATES`` times the bandwidth."""

TWO_STATES, THREE_STATES = 0.75, 0.6
"""At these shares of omega_o MF-ESO with f' or f'' rejects the paper's force as L-ESO does, or
better, with about as much noise in u as MF-ESO."""
PAPERS_LOAD = 0.1 * math.pi
"""Frequency of the paper's force [rad/s]."""
LOADS = (0.1, PAPERS_LOAD, 0.8)
"""Frequencies of the force in the ranges [rad/s]: a third of the paper's, it, and 2.5 times it."""
# About 5 GB of records.
_MOST_SAMPLES = 5e6
GRADIENT_RATE = 0.01
"""Algorithm 1's rate · batch / dt [1/s]: it is stable below about 0.015/s (docs/paper)."""
GRADIENT_BATCH = 10
"""Samples in a batch of Algorithm 1: chosen by hand; the stable range does not depend on it."""
RATE_WITHOUT_U = 1.0
"""Its rate · batch / dt [1/s] without u among the features; at 3/s it still runs to the end."""


@dataclass(frozen=True)
class Settings:
    """The parameters of the study that may be varied."""

    dt: float = 1e-3  #: sample time [s]
    seed: int = 0  #: seed of the measurement noise
    omega_o: float = 10.0  #: observer bandwidth [rad/s]
    omega_c: float = 1.0  #: controller bandwidth [rad/s]
    reset: bool = True  #: whether the loop starts from rest at 110 s
    seeds: int = 1  #: number of seeds, from ``seed`` on, of ``Result.ranges``; none with 1

    def __post_init__(self) -> None:
        if checks.positive("dt", self.dt, "s") > 1.0:
            raise ValueError(f"dt = {self.dt!r}: must be at most 1 s")
        if END / self.dt > _MOST_SAMPLES:
            raise ValueError(
                f"dt = {self.dt!r}: must be at least {END / _MOST_SAMPLES:g} s, "
                "or eight whole records do not fit in memory"
            )
        checks.whole("seed", self.seed, 0)
        checks.whole("seeds", self.seeds, 1, 1000)
        checks.positive("omega_o", self.omega_o, "rad/s")
        checks.positive("omega_c", self.omega_c, "rad/s")


def scenario(settings: Settings, load: float = PAPERS_LOAD) -> Scenario:
    """Return the paper's scenario, with a force of the frequency ``load`` [rad/s]."""
    return Scenario(
        reference=Sinusoid(amplitude=1.0, omega=1.0).until(STEP_AT, then=Step(at=STEP_AT)),
        disturbances=(Constant(0.0), Sinusoid(amplitude=1.0, omega=load, start=FORCE_AT)),
        noise=BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=END,
        rest_at=(STEP_AT,) if settings.reset else (),
        seed=settings.seed,
    )


def gradient_rate(settings: Settings) -> float:
    """Return Algorithm 1's learning rate per sample; per second it is independent of dt."""
    return GRADIENT_RATE * settings.dt / GRADIENT_BATCH


def controllers(settings: Settings) -> dict[str, ADRC]:
    """Return the controllers ``NAMES`` by name."""
    return {
        MF: controller(settings),
        MB: controller(settings, model=True),
        L: controller(settings, learner=Kalman()),
        L1: controller(
            settings, learner=BatchGradient(rate=gradient_rate(settings), batch=GRADIENT_BATCH)
        ),
        MF3: controller(settings, bandwidth=3.0),
        MB3: controller(settings, bandwidth=3.0, model=True),
        MF_2: controller(settings, bandwidth=TWO_STATES, disturbance_order=2),
        MB_2: controller(settings, bandwidth=TWO_STATES, disturbance_order=2, model=True),
        GUARDED: controller(settings, learner=Kalman(), guard=True),
    }


def further_controllers(settings: Settings) -> dict[str, ADRC]:
    """Return those that stand in the ranges only: each needs a loop of its own to be compiled."""
    rate = RATE_WITHOUT_U * settings.dt / GRADIENT_BATCH
    three: dict[str, Any] = {"bandwidth": THREE_STATES, "disturbance_order": 3}
    return {
        MF_3: controller(settings, **three),
        MB_3: controller(settings, **three, model=True),
        STATE: controller(settings, learner=Kalman(bias=False)),
        BIAS: controller(settings, learner=Kalman(state=False)),
        HARMONIC: controller(settings, learner=Harmonic()),
        HARMONIC_GUARDED: controller(settings, learner=Harmonic(), guard=True),
        NO_BIAS: controller(settings, learner=Harmonic(bias=False), guard=True),
        L1_NO_U: controller(
            settings, learner=BatchGradient(rate=rate, batch=GRADIENT_BATCH, u=False)
        ),
    }


def controller(
    settings: Settings,
    *,
    model: bool = False,
    learner: Learner | None = None,
    guard: bool = False,
    bandwidth: float = 1.0,
    disturbance_order: int = 1,
) -> ADRC:
    """Return one controller; ``bandwidth`` multiplies ``omega_o``."""
    omega_o = bandwidth * settings.omega_o
    dt, m = settings.dt, disturbance_order
    observer = ESO.model_free(4, 1.0, omega_o, dt, disturbance_order=m)
    if model:
        observer = ESO.model_based(two_mass_spring(), omega_o, dt, disturbance_order=m)
    return ADRC(observer, settings.omega_c, learner=learner, guard=Guard() if guard else None)


def score(run: Trajectory) -> Scores:
    """Return the study's scores; None if the run ended too early, or y did not settle.

    Overshoot (a fraction), settling time [s] and control variation [N] are those of the step over
    [110, 150) s; peak and RMS of y − 1 [m] are those under the force over [170, 250] s;
    ``rms_from_step`` is the RMS over [110, 250] s.
    """
    found: Scores = dict.fromkeys(METRICS)
    t, y = run.t, run["y"]
    if run.ended >= FORCE_AT - 2 * run.dt:
        part = run.window(*STEP_WINDOW)
        found |= step_scores(t[part], y[part], 1.0, BAND)
        found["control_variation"] = metrics.control_variation(run["u"][part])
    if run.ended >= END - 2 * run.dt:
        after = END + 0.5 * run.dt
        forced = y[run.window(FORCE_WINDOW[0], after)] - 1.0
        found["disturbance_peak"] = metrics.peak(forced)
        found["disturbance_rms"] = metrics.rms(forced)
        found["rms_from_step"] = metrics.rms(y[run.window(STEP_AT, after)] - 1.0)
    return found


def margins(law: ADRC, run: Trajectory) -> Scores:
    """Return M_s and M_ks [N/m] of the loop at the end of a run, its learner's adaptation included.

    None for a run that diverged, and for a loop that is not stable at rest.
    """
    loop = None if run.diverged else analyse_axis(two_mass_spring(), law, at=run)
    if loop is None or not loop.stable:
        return {"m_s": None, "m_ks": None}
    return {"m_s": 1.0 / loop.margins.modulus, "m_ks": loop.noise_to_control_peak}


def quick_run(settings: Settings, candidate: ADRC, load: float = PAPERS_LOAD) -> Trajectory:
    """Run the scenario and record every 10 ms, which is enough for peaks."""
    every = max(round(0.01 / settings.dt), 1)
    return simulate(two_mass_spring(), candidate, scenario(settings, load), record_every=every)


# ---- Means and 95 % intervals over seeds of the noise, under forces of three frequencies ----

_OF_STEP = ("overshoot", "settling_time", "control_variation")


@dataclass(frozen=True)
class Range:
    """Mean of a score over the seeds; None where a run has none, as one that diverged."""

    mean: float | None
    half_width: float | None  #: of the 95 % interval of the mean, by Student's t; None for a seed
    missing: int  #: runs without this score


Ranges: TypeAlias = Mapping[str, Mapping[str, Range]]


def peak_name(load: float) -> str:
    """Return the name of the largest distance of y from 1 under a force of a frequency [rad/s]."""
    return f"peak_at_{load:.3g}"


SCORES = (*_OF_STEP, *map(peak_name, LOADS), "m_s", "m_ks")
"""Names of the scores that have ranges."""


def all_controllers(settings: Settings) -> dict[str, ADRC]:
    """Return the controllers of the ranges by name."""
    return controllers(settings) | further_controllers(settings)


def ranges(settings: Settings, progress: Progress | None = None) -> Ranges:
    """Run every controller with the seeds ``seed`` … ``seed + seeds − 1`` and each force."""
    progress = progress or (lambda part, share: None)
    laws = all_controllers(settings)
    seeds = [settings.seed + i for i in range(settings.seeds)]
    jobs = [
        partial(_scores, replace(settings, seed=seed), law, load)
        for law in laws.values()
        for seed in seeds
        for load in LOADS
    ]
    done = in_parallel(jobs, partial(progress, "seeds and forces"))
    count = len(seeds) * len(LOADS)
    parts = {name: done[i * count : (i + 1) * count] for i, name in enumerate(laws)}
    return {name: _of_scores(found) for name, found in parts.items()}


def _scores(settings: Settings, law: ADRC, load: float) -> Scores:
    """Return the peak under one force, and under the paper's all else, too."""
    if load != PAPERS_LOAD:
        return {peak_name(load): score(quick_run(settings, law, load))["disturbance_peak"]}
    run = simulate(two_mass_spring(), law, scenario(settings))
    found = score(run) | margins(law, run)
    wanted = {name: found[name] for name in (*_OF_STEP, "m_s", "m_ks")}
    return wanted | {peak_name(load): found["disturbance_peak"]}


def _of_scores(found: Iterable[Scores]) -> dict[str, Range]:
    runs = list(found)
    return {name: range_of(run[name] for run in runs if name in run) for name in SCORES}


def range_of(values: Iterable[float | None]) -> Range:
    """Return mean and interval of values; a mean over some of the runs alone would mislead."""
    every = list(values)
    given = np.array([value for value in every if value is not None])
    if given.size < len(every) or given.size == 0:
        return Range(None, None, len(every) - given.size)
    if given.size == 1:
        return Range(float(given[0]), None, 0)
    from quell.tuning.simulated.problem import half_width_of_mean

    return Range(float(np.mean(given)), half_width_of_mean(given), 0)


def ranges_to_json(found: Ranges, settings: Settings) -> dict[str, Any]:
    """Return plain data for ``json.dump``."""
    rows = {
        name: {key: asdict(each) for key, each in scores.items()} for name, scores in found.items()
    }
    loads = {peak_name(load): load for load in LOADS}
    return {"ranges": {"seeds": settings.seeds, "loads": loads, "controllers": rows}}


# ---- The time until Algorithm 1 diverges, in the two-mass study's scenario, ten times as long ----

BATCHES = (1, 10, 1000)
"""Samples in a batch: chosen by hand, to show that the limit does not depend on it."""
RATES = tuple(float(rate) for rate in np.geomspace(1e-3, 1.0, 13))
"""rate · batch / dt [1/s], the speed of θ: a range around the limit of 0.015/s."""
HORIZON = 2500.0  # duration of a run that does not diverge [s]: ten times that of the study


@dataclass(frozen=True)
class Trial:
    """One run of Algorithm 1."""

    batch: int
    rate: float  #: rate · batch / dt [1/s]
    ended: float  #: end of the run [s]: ``HORIZON``, or the time of divergence
    stable: bool  #: true if the run did not diverge within the study's duration
    disturbance_peak: float | None


def trials(
    settings: Settings, progress: Progress, rates: Sequence[float] = RATES
) -> tuple[Trial, ...]:
    """Run Algorithm 1 with every batch and rate.

    The sample time is 10 ms if the observer allows it: the result depends on the rate per second,
    not per sample.
    """
    coarse = replace(settings, dt=max(settings.dt, min(0.01, 0.1 / settings.omega_o)))
    plant, long = two_mass_spring(), replace(scenario(coarse), duration=HORIZON)
    every = max(round(0.1 / coarse.dt), 1)

    def trial(batch: int, rate: float) -> Trial:
        learner = BatchGradient(rate=rate * coarse.dt / batch, batch=batch)
        run = simulate(plant, controller(coarse, learner=learner), long, record_every=every)
        return Trial(batch, rate, run.ended, run.ended > END, score(run)["disturbance_peak"])

    cases = [(batch, rate) for batch in BATCHES for rate in rates]
    done = []
    for i in range(0, len(cases), len(rates)):
        progress("learning rates", i / len(cases))
        done += in_parallel([partial(trial, *case) for case in cases[i : i + len(rates)]])
    progress("learning rates", 1.0)
    return tuple(done)


def stable_up_to(found: Sequence[Trial], batch: int) -> float | None:
    """Return the largest rate up to which all trials with ``batch`` are stable [1/s], or None."""
    largest = None
    for trial in sorted((t for t in found if t.batch == batch), key=lambda t: t.rate):
        if not trial.stable:
            break
        largest = trial.rate
    return largest


# ---- The two-mass study ----

# Multiples of omega_o at which the ESOs without learner are measured: a grid around the claimed
# factor of 3, chosen by hand.
_BANDWIDTHS = (0.9, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0)


@dataclass(frozen=True)
class Result:
    """A record and scores for each controller, and the paper's claims, judged."""

    settings: Settings
    runs: Mapping[str, Trajectory]
    scores: Mapping[str, Scores]
    claims: tuple[Claim, ...]
    gradient_trials: tuple[Trial, ...]
    ranges: Ranges | None = None  #: over ``settings.seeds`` seeds; None for one seed

    def to_json(self) -> dict[str, Any]:
        """Return plain data for ``json.dump``; None for values that were not measured."""
        about = {
            "plant": "two-mass-spring, m1 = m2 = 1 kg, k = 1 N/m, y = x2",
            "step_window": STEP_WINDOW,
            "disturbance_window": FORCE_WINDOW,
            "settling_band": BAND,
            "algorithm_1": {"rate": gradient_rate(self.settings), "batch": GRADIENT_BATCH},
            "units": "SI; overshoot as a fraction of the step",
        }
        batches = sorted({trial.batch for trial in self.gradient_trials})
        several = {} if self.ranges is None else ranges_to_json(self.ranges, self.settings)
        return {
            "settings": asdict(self.settings) | about,
            "controllers": {name: dict(score) for name, score in self.scores.items()},
            "claims": [asdict(claim) for claim in self.claims],
            "algorithm_1_stable_up_to": {
                batch: stable_up_to(self.gradient_trials, batch) for batch in batches
            },
            "ended_early": ended_early(self.runs),
        } | several


def run(settings: Settings, progress: Progress | None = None) -> Result:
    """Run the study; with several ``settings.seeds`` also its ranges, under three loads."""
    progress = progress or (lambda part, share: None)
    plant, paper = two_mass_spring(), scenario(settings)
    laws = controllers(settings)
    jobs = [partial(simulate, plant, each, paper) for each in laws.values()]
    done = in_parallel(jobs, partial(progress, "simulating"))
    runs = dict(zip(NAMES, done, strict=True))
    scores = {name: score(run) | margins(laws[name], run) for name, run in runs.items()}
    needed = {name: _bandwidth_for(settings, name == MB, scores, progress) for name in (MF, MB)}
    variations = _batch_variations(settings)
    claims = tuple(_claims(runs, scores, needed, variations))
    several = ranges(settings, progress) if settings.seeds > 1 else None
    return Result(settings, runs, scores, claims, trials(settings, progress), several)


def _bandwidth_for(
    settings: Settings, model: bool, scores: Mapping[str, Scores], progress: Progress
) -> Scores:
    """Return for each learner the multiple of ``omega_o`` at which an ESO has the same peak.

    Peaks are measured on a grid of bandwidths that the sample time allows and the loop is stable
    at; between them logarithms are interpolated. A peak below all of them gives the largest
    multiple that was measured, one above all gives None.
    """
    grid = [factor for factor in _BANDWIDTHS if factor * settings.omega_o * settings.dt < math.pi]
    progress("bandwidths", 0.5 if model else 0.0)
    candidates = [controller(settings, model=model, bandwidth=factor) for factor in grid]
    found = map(score, in_parallel([partial(quick_run, settings, c) for c in candidates]))
    progress("bandwidths", 1.0 if model else 0.5)
    points = [
        (math.log(peak), math.log(factor))
        for s, factor in zip(found, grid, strict=True)
        if (peak := s["disturbance_peak"])
    ]
    peaks, factors = np.array(sorted(points)).T if points else (np.zeros(0), np.zeros(0))
    needed: Scores = dict.fromkeys((L, L1))
    for learner in needed:
        peak = scores[learner]["disturbance_peak"]
        if peak is not None and peaks.size > 1 and math.log(peak) <= peaks[-1]:
            needed[learner] = float(np.exp(np.interp(math.log(peak), peaks, factors)))
    return needed


def _batch_variations(settings: Settings) -> tuple[float | None, float | None]:
    """Return Algorithm 1's variation with ten times the batch, at equal rate per sample or time."""
    rate, batch = gradient_rate(settings), 10 * GRADIENT_BATCH
    candidates = [
        controller(settings, learner=BatchGradient(rate=r, batch=batch)) for r in (rate, rate / 10)
    ]
    jobs = [partial(simulate, two_mass_spring(), c, scenario(settings)) for c in candidates]
    same, slower = map(score, in_parallel(jobs))
    return same["control_variation"], slower["control_variation"]


def _claims(
    runs: Mapping[str, Trajectory],
    scores: Mapping[str, Scores],
    needed: Mapping[str, Scores],
    variations: tuple[float | None, float | None],
) -> Iterable[Claim]:
    """Judge the claims of section IV, in its order; claims on L-ESO once for each learner."""
    for name, paper in ((MF, 0.005), (MB, 0.0), (L, 0.0), (L1, 0.0)):
        value = scores[name]["overshoot"]
        yield Claim.near(f"{name}: overshoot", paper, value, 0.001)
    for name, paper in ((MF, 16.0), (MB, 12.0), (L, 12.0), (L1, 12.0)):
        value = scores[name]["settling_time"]
        yield Claim.near(f"{name}: settling time", paper, value, 1.0, unit="s")
    for name in (L, L1):
        text = f"{name}: largest distance from MB-ESO, 126–134 s"
        yield Claim.near(text, 0.0, _apart(runs[name], runs[MB]), BAND, unit="m")
    peaks = {name: found["disturbance_peak"] for name, found in scores.items()}
    best = min((peak for name in (MF, MB) if (peak := peaks[name]) is not None), default=None)
    for name in (L, L1):
        value = ratio(peaks[name], best)
        yield Claim.below_one(f"{name}: peak over the best ESO's without learner", value)
    for name in (L, L1):
        for other in (MF, MB):
            text = f"{name}: times the bandwidth {other} needs for its peak"
            yield Claim.at_least(text, 3.0, needed[other][name])
    for name in (L, L1):
        value = ratio(scores[name]["control_variation"], scores[MF]["control_variation"])
        yield Claim.above_one(f"{name}: control variation over MF-ESO's", value)
    same, slower = (ratio(value, scores[L1]["control_variation"]) for value in variations)
    yield Claim.below_one("Algorithm 1: variation with a batch 10 times as large", same)
    yield Claim.below_one("Algorithm 1: the same, and as fast a learning", slower)


def _apart(one: Trajectory, other: Trajectory) -> float | None:
    """Return the largest distance of two outputs in the paper's zoom [m]; None after early ends."""
    part = one.window(126.0, 134.0)
    if min(one.ended, other.ended) < 134.0:
        return None
    return metrics.peak(one["y"][part] - other["y"][part])


# ---- The figures of the two-mass study ----

# Start of the paper's figures [s], and their two zooms.
_FROM = 120.0
_ZOOMS = ((126.0, 134.0), (170.0, 195.0))
_STYLES: Mapping[str, dict[str, Any]] = {
    MF: STYLES[MF],
    MB: STYLES[MB],
    L1: {"color": "0.55", "linewidth": 1.0, "linestyle": "--"},
    L: STYLES[L],
}
# The benchmark's f is −2 y'' + disturbance (paper eq. (disturbance-twomass-MFESO) with m1 = m2 = k
# = 1, b0 = b).
_TRUE_THETA = {"x1": 0.0, "x2": 0.0, "x3": -2.0, "x4": 0.0}

FIGURE_NAMES = ("position", "control", "learning", "algorithm-1")
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
        ``"position"`` with three axes (whole run, two zooms), ``"control"`` with three for each of
        the four controllers, ``"learning"`` with three, ``"algorithm-1"`` with two.
    ax
        axes to draw into; those of a new figure by default.

    Raises
    ------
    ValueError
        for another name or number of axes.
    """
    return _DRAWINGS[checks.one_of("name", name, FIGURE_NAMES)](result, ax)


def _control(result: Result, ax: Any) -> Any:
    """Draw u of each controller of equal bandwidth: a row for each, whole and in the two zooms.

    In one plot the noise of one controller would hide the others.
    """
    names, spans = [*_STYLES], ((_FROM, END), *_ZOOMS)
    shared = {"sharex": "col", "sharey": "col", "width_ratios": (2.0, 1.0, 1.0)}
    axes = grid_of_axes(ax, partial(wide_figure, 7.0), len(names), 3, **shared)
    for row, name in zip(axes, names, strict=True):
        run = result.runs[name]
        for one, (start, stop) in zip(row, spans, strict=True):
            part = run.window(start, stop)
            if part.stop > part.start:
                draw_line(one, run.t[part], run["u"][part], color="black", linewidth=0.7)
            one.set_xlim(start, stop)
        row[0].set_ylabel(f"{legend_label(name, run)}\nu [N]")
    for one, (start, stop) in zip(axes[0], spans, strict=True):
        one.set_title(f"{start:g} s to {stop:g} s", fontsize="medium")
    for one in axes[-1]:
        one.set_xlabel("time [s]")
    return axes.ravel()


def _position(result: Result, ax: Any) -> Any:
    """Draw y of the controllers of equal bandwidth: whole, and the paper's two zooms."""
    if ax is None:
        axes = wide_figure(6.4).subplot_mosaic([["all", "all"], ["step", "force"]])
    else:
        axes = dict(zip(("all", "step", "force"), grid_of_axes(ax, dict, 3)[:, 0], strict=True))
    spans = {"all": (_FROM, END), "step": _ZOOMS[0], "force": _ZOOMS[1]}
    for place, (start, stop) in spans.items():
        one = axes[place]
        for name, style in _STYLES.items():
            run, label_of_run = result.runs[name], legend_label(name, result.runs[name])
            part = run.window(start, stop)
            if part.stop > part.start:
                draw_line(one, run.t[part], run["y"][part], label=label_of_run, **style)
        one.set(xlim=(start, stop), xlabel="time [s]")
    whole = axes["all"]
    whole.set_ylabel("position of m2 [m]")
    whole.set_title(
        f"position of m2, from {_FROM:g} s: step at {STEP_AT:g} s, force on m2 from {FORCE_AT:g} s"
    )
    whole.legend(ncols=2, loc="lower left", fontsize="small")
    for start, stop in _ZOOMS:
        whole.axvspan(start, stop, color="0.9", zorder=0)
    for place in ("step", "force"):
        axes[place].set_title("zoom {:g} s to {:g} s".format(*spans[place]), fontsize="medium")
    return np.array([axes[place] for place in spans])


def _learning(result: Result, ax: Any) -> Any:
    """Draw the coefficients of L-ESO, its estimate of f, and the errors of the three observers."""
    run = result.runs[L]
    axes = grid_of_axes(ax, partial(wide_figure, 8.0), 3, sharex=True)[:, 0]
    for i, feature in enumerate(run.features):
        draw_line(axes[0], run.t, run["theta"][:, i], label=feature, color=f"C{i}", linewidth=1.2)
        if feature in _TRUE_THETA:
            axes[0].axhline(_TRUE_THETA[feature], color=f"C{i}", linestyle=":", linewidth=1.0)
    axes[0].set(ylim=(-3.0, 1.5), ylabel="theta")
    axes[0].set_title("coefficients of L-ESO; dotted: the plant's own", fontsize="medium")
    truth, dotted = _true_disturbance(run), {"color": "black", "linestyle": ":"}
    for channel, label in ESTIMATES.items():
        draw_line(axes[1], run.t, run[channel], label=label, linewidth=1.0)
    draw_line(axes[1], run.t, truth, label="true f", linewidth=1.0, **dotted)
    axes[1].set_title("total disturbance as L-ESO has it", fontsize="medium")
    for name in (MF, MB, L):
        other = result.runs[name]
        error = other["f_hat"] - _true_disturbance(other, known=name == MB)
        draw_line(axes[2], other.t, error, label=legend_label(name, other), **_STYLES[name])
    title = "error of the three estimates of f (MB-ESO estimates what its model leaves)"
    axes[2].set_title(title, fontsize="medium")
    axes[2].set_xlabel("time [s]")
    for each in axes[1:]:
        each.set_ylabel("f [m/s⁴]")
    for each in axes:
        each.legend(ncols=5, loc="lower left", fontsize="small")
    axes[2].set_ylim(-0.6, 0.6)
    axes[1].set_ylim(-1.8, 1.4)
    return axes


def _true_disturbance(run: Trajectory, known: bool = False) -> Vector:
    """Return the true f, ``−2 y'' + w2 + w2''``; without the first term for a ``known`` model."""
    x, w2 = run["x"], run["w"][:, 1]
    y2 = x[:, 0] - x[:, 1] + w2
    step = run.dt * run.every
    external = w2 + np.gradient(np.gradient(w2, step), step) * (np.abs(run.t - FORCE_AT) > 3 * step)
    return np.asarray(external if known else external - 2.0 * y2)


def _algorithm_1(result: Result, ax: Any) -> Any:
    """Draw when Algorithm 1 diverges, and its disturbance peak if it does not."""
    above, below = axes = grid_of_axes(ax, partial(wide_figure, 6.0), 2, sharex=True)[:, 0]
    batches = sorted({trial.batch for trial in result.gradient_trials})
    for marker, batch in zip("osx", batches, strict=False):
        trials = [trial for trial in result.gradient_trials if trial.batch == batch]
        stable = [trial for trial in trials if trial.stable]
        style = {"marker": marker, "label": f"batch of {batch}"}
        above.loglog([t.rate for t in trials], [t.ended for t in trials], **style)
        below.semilogx([t.rate for t in stable], [t.disturbance_peak for t in stable], **style)
    above.axhline(END, color="0.3", linestyle=":", linewidth=1.2, label="end of the study")
    above.set_ylabel("diverges at [s]")
    title = f"Algorithm 1: when it diverges, in {HORIZON:g} s of the study's scenario"
    above.set_title(title, fontsize="medium")
    for name in (MF, L):
        peak, color = result.scores[name]["disturbance_peak"], _STYLES[name]["color"]
        if peak is not None:
            below.axhline(peak, color=color, linestyle="--", linewidth=1.0, label=name)
    below.set_ylim(bottom=0.0)
    below.set(ylabel="disturbance peak, 170–250 s [m]", xlabel="rate · batch / dt [1/s]")
    for each in axes:
        each.legend(fontsize="small")
    return axes


_DRAWINGS: Mapping[str, Callable[[Result, Any], Any]] = {
    "position": _position,
    "control": _control,
    "learning": _learning,
    "algorithm-1": _algorithm_1,
}
