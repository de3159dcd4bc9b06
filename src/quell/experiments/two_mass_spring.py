"""The paper's simulation study (section IV): the two-mass-spring benchmark under MF-ESO, MB-ESO and L-ESO.

From rest the output follows sin t for 110 s, in which a learner learns; then the loop starts from rest again, with what was learned,
and follows a unit step. From 150 s a force sin(π(t − 150)/10) N acts on m2. What the paper leaves open (the start from rest, the
settling band of 0.2 %, the force's amplitude, the observer's discretisation) is set so as to reproduce the paper's figures; docs/theory
says how that was found.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from quell import checks, metrics
from quell.controllers import ADRC
from quell.experiments import gradient_range
from quell.experiments.claims import Claim
from quell.experiments.gradient_range import Trial
from quell.learners import BatchGradient, Kalman, Learner
from quell.observers import ESO
from quell.plants import two_mass_spring
from quell.signals import BandLimitedNoise, Constant, Sinusoid, Step
from quell.simulation import Scenario, simulate
from quell.trajectory import Trajectory

STEP_AT, FORCE_AT, END = 110.0, 150.0, 250.0
STEP_WINDOW = (STEP_AT, FORCE_AT)
FORCE_WINDOW = (170.0, END)
BAND = 0.002

MF, MB, L, L1 = "MF-ESO", "MB-ESO", "L-ESO", "L-ESO (Algorithm 1)"
MF3, MB3 = "MF-ESO (3x bandwidth)", "MB-ESO (3x bandwidth)"
NAMES = (MF, MB, L, L1, MF3, MB3)

# Algorithm 1 learns by rate · batch / dt a second. It is stable below about 0.015/s whatever the batch (docs/theory); this is inside.
GRADIENT_RATE = 0.01
GRADIENT_BATCH = 10


@dataclass(frozen=True)
class Settings:
    """What may be varied.

    Parameters
    ----------
    dt
        sample time [s].
    seed
        of the measurement noise.
    omega_o, omega_c
        observer and controller bandwidth [rad/s].
    reset
        whether the loop starts from rest at 110 s.

    Raises
    ------
    ValueError
        for a value that no experiment can be made with.
    """

    dt: float = 1e-3
    seed: int = 0
    omega_o: float = 10.0
    omega_c: float = 1.0
    reset: bool = True

    def __post_init__(self) -> None:
        if checks.positive("dt", self.dt, "s") > 1.0:
            raise ValueError(f"dt = {self.dt!r}: must be at most 1 s, the loop moves within seconds")
        if END / self.dt > 1e8:
            raise ValueError(f"dt = {self.dt!r}: must be at least {END / 1e8:g} s, or the record does not fit in memory")
        checks.whole("seed", self.seed, 0)
        checks.positive("omega_o", self.omega_o, "rad/s")
        checks.positive("omega_c", self.omega_c, "rad/s")


@dataclass(frozen=True)
class Result:
    """What came out: a record, a row of scores for each controller, and the paper's claims judged."""

    settings: Settings
    runs: Mapping[str, Trajectory]
    scores: Mapping[str, Mapping[str, float | None]]
    claims: tuple[Claim, ...]
    gradient_trials: tuple[Trial, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``; what could not be measured is None."""
        about = {
            "plant": "two-mass-spring, m1 = m2 = 1 kg, k = 1 N/m, y = x2",
            "step_window": STEP_WINDOW,
            "disturbance_window": FORCE_WINDOW,
            "settling_band": BAND,
            "algorithm_1": {"rate": gradient_rate(self.settings), "batch": GRADIENT_BATCH},
            "units": "SI; overshoot as a fraction of the step",
        }
        batches = sorted({trial.batch for trial in self.gradient_trials})
        messages = {name: run.status.message for name, run in self.runs.items() if run.status}
        return {
            "settings": asdict(self.settings) | about,
            "controllers": {name: dict(score) for name, score in self.scores.items()},
            "claims": [asdict(claim) for claim in self.claims],
            "algorithm_1_stable_up_to": {batch: gradient_range.stable_up_to(self.gradient_trials, batch) for batch in batches},
            "ended_early": {name: {"at": self.runs[name].ended, "message": text} for name, text in messages.items()},
        }


def scenario(settings: Settings) -> Scenario:
    """Return the paper's scenario."""
    return Scenario(
        reference=Sinusoid(amplitude=1.0, omega=1.0).until(STEP_AT, then=Step(at=STEP_AT)),
        disturbances=(Constant(0.0), Sinusoid(amplitude=1.0, omega=0.1 * math.pi, start=FORCE_AT)),
        noise=BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=END,
        rest_at=(STEP_AT,) if settings.reset else (),
        seed=settings.seed,
    )


def gradient_rate(settings: Settings) -> float:
    """Return Algorithm 1's learning rate a sample, the same a second for every sample time."""
    return GRADIENT_RATE * settings.dt / GRADIENT_BATCH


def controllers(settings: Settings) -> dict[str, ADRC]:
    """Return the six controllers by name."""
    return {
        MF: controller(settings),
        MB: controller(settings, model=True),
        L: controller(settings, learner=Kalman()),
        L1: controller(settings, learner=BatchGradient(gradient_rate(settings), GRADIENT_BATCH)),
        MF3: controller(settings, bandwidth=3.0),
        MB3: controller(settings, bandwidth=3.0, model=True),
    }


def controller(settings: Settings, *, model: bool = False, learner: Learner | None = None, bandwidth: float = 1.0) -> ADRC:
    """Return one controller; ``bandwidth`` multiplies ``omega_o``."""
    omega_o = bandwidth * settings.omega_o
    observer = (
        ESO.model_based(two_mass_spring(), omega_o=omega_o, dt=settings.dt)
        if model
        else ESO.model_free(order=4, b0=1.0, omega_o=omega_o, dt=settings.dt)
    )
    return ADRC(observer, settings.omega_c, learner=learner)


def run(settings: Settings, progress: Callable[[str, float], None] | None = None) -> Result:
    """Run the study.

    Parameters
    ----------
    settings
        what is varied.
    progress
        called with what is being done and the share of it that is.
    """
    tell = progress or (lambda what, share: None)
    plant, what = two_mass_spring(), scenario(settings)
    runs = {}
    for i, (name, candidate) in enumerate(controllers(settings).items()):
        tell("simulating", i / len(NAMES))
        runs[name] = simulate(plant, candidate, what)
    tell("simulating", 1.0)
    scores = {name: score(run) for name, run in runs.items()}
    needed = {name: _bandwidth_for(settings, name == MB, scores, tell) for name in (MF, MB)}
    variations = _batch_variations(settings)
    claims = tuple(_claims(runs, scores, needed, variations))
    return Result(settings, runs, scores, claims, gradient_range.trials(settings, tell))


def score(run: Trajectory) -> dict[str, float | None]:
    """Return the study's metrics; None where the run did not get that far, or y not into its band.

    Overshoot (a fraction), settling time [s] and control variation [N] are those of the step over [110, 150) s; peak and RMS of y − 1 [m]
    are those under the force over [170, 250] s; ``rms_from_step`` is the RMS over [110, 250] s.
    """
    found: dict[str, float | None] = dict.fromkeys(
        ("overshoot", "settling_time", "disturbance_peak", "disturbance_rms", "control_variation", "rms_from_step")
    )
    t, y = run.t, run["y"]
    if run.ended >= FORCE_AT - 2 * run.dt:
        part = run.window(*STEP_WINDOW)
        settling = metrics.settling_time(t[part], y[part], 1.0, BAND)
        found |= {
            "overshoot": metrics.overshoot(y[part], 1.0),
            "settling_time": None if math.isnan(settling) else settling,
            "control_variation": metrics.control_variation(run["u"][part]),
        }
    if run.ended >= END - 2 * run.dt:
        error = y - 1.0
        forced, stepped = (run.window(start, END + 0.5 * run.dt) for start in (FORCE_WINDOW[0], STEP_AT))
        found |= {
            "disturbance_peak": metrics.peak(error[forced]),
            "disturbance_rms": metrics.rms(error[forced]),
            "rms_from_step": metrics.rms(error[stepped]),
        }
    return found


def in_parallel(jobs: Iterable[Callable[[], Any]]) -> list[Any]:
    """Run independent simulations on all cores; compiled loops release the interpreter."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return [future.result() for future in [pool.submit(job) for job in jobs]]


def quick_run(settings: Settings, candidate: ADRC) -> Trajectory:
    """Run the scenario and record every 10 ms, which is all that peaks need."""
    return simulate(two_mass_spring(), candidate, scenario(settings), record_every=max(round(0.01 / settings.dt), 1))


def _bandwidth_for(settings: Settings, model: bool, scores: Any, tell: Callable[[str, float], None]) -> dict[str, float | None]:
    """Return for each learner how many times ``omega_o`` the ESO without one needs for the same disturbance peak.

    Peaks are measured on a grid of bandwidths and interpolated between logarithms; None where the grid does not reach.
    """
    grid = [factor for factor in (0.9, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0) if factor * settings.omega_o * settings.dt < 1.5]
    tell("bandwidths", 0.5 if model else 0.0)
    candidates = [controller(settings, model=model, bandwidth=factor) for factor in grid]
    found = map(score, in_parallel([partial(quick_run, settings, candidate) for candidate in candidates]))
    tell("bandwidths", 1.0 if model else 0.5)
    points = [(math.log(s["disturbance_peak"]), math.log(factor)) for s, factor in zip(found, grid, strict=True) if s["disturbance_peak"]]
    needed: dict[str, float | None] = {}
    for learner in (L, L1):
        peak = scores[learner]["disturbance_peak"]
        peaks, factors = np.array(sorted(points)).T if points else (np.zeros(0), np.zeros(0))
        within = peak is not None and peaks.size > 1 and peaks[0] <= math.log(peak) <= peaks[-1]
        needed[learner] = float(np.exp(np.interp(math.log(peak), peaks, factors))) if within else None
    return needed


def _batch_variations(settings: Settings) -> tuple[float | None, float | None]:
    """Return Algorithm 1's control variation with a batch ten times larger, at the same rate a sample and at the same rate a second."""
    rate, batch = gradient_rate(settings), 10 * GRADIENT_BATCH
    candidates = [controller(settings, learner=BatchGradient(r, batch)) for r in (rate, rate / 10)]
    same, slower = map(score, in_parallel([partial(simulate, two_mass_spring(), c, scenario(settings)) for c in candidates]))
    return same["control_variation"], slower["control_variation"]


def _claims(
    runs: Mapping[str, Trajectory],
    scores: Mapping[str, Mapping[str, float | None]],
    needed: Mapping[str, Mapping[str, float | None]],
    variations: tuple[float | None, float | None],
) -> Iterable[Claim]:
    """Judge what section IV claims, in its order; claims on L-ESO once for each learner."""
    for name, paper in ((MF, 0.005), (MB, 0.0), (L, 0.0), (L1, 0.0)):
        value = scores[name]["overshoot"]
        yield Claim.near(f"{name}: overshoot", paper, value, 0.001)
    for name, paper in ((MF, 16.0), (MB, 12.0), (L, 12.0), (L1, 12.0)):
        yield Claim.near(f"{name}: settling time", paper, scores[name]["settling_time"], 1.0, unit="s")
    for name in (L, L1):
        yield Claim.near(f"{name}: largest distance from MB-ESO, 126–134 s", 0.0, _apart(runs[name], runs[MB]), BAND, unit="m")
    for name in (L, L1):
        ratio = _ratio(scores[name]["disturbance_peak"], _least(scores[MF]["disturbance_peak"], scores[MB]["disturbance_peak"]))
        yield Claim.below_one(f"{name}: peak over the best ESO's without learner", ratio)
    for name in (L, L1):
        for other in (MF, MB):
            yield Claim.at_least(f"{name}: times the bandwidth {other} needs for its peak", 3.0, needed[other][name])
    for name in (L, L1):
        ratio = _ratio(scores[name]["control_variation"], scores[MF]["control_variation"])
        yield Claim.above_one(f"{name}: control variation over MF-ESO's", ratio)
    same, slower = (_ratio(value, scores[L1]["control_variation"]) for value in variations)
    yield Claim.below_one("Algorithm 1: variation with a batch 10 times as large", same)
    yield Claim.below_one("Algorithm 1: the same, and as fast a learning", slower)


def _apart(one: Trajectory, other: Trajectory) -> float | None:
    part = one.window(126.0, 134.0)
    if min(one.ended, other.ended) < 134.0:
        return None
    return metrics.peak(one["y"][part] - other["y"][part])


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else value / reference


def _least(*values: float | None) -> float | None:
    known = [value for value in values if value is not None]
    return min(known) if known else None
