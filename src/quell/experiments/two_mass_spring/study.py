"""The two-mass study as a whole: run it, measure what the paper claims of it, judge."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from quell.experiments.common.claims import Claim
from quell.experiments.two_mass_spring import gradient_range
from quell.experiments.two_mass_spring.gradient_range import Trial
from quell.experiments.two_mass_spring.setup import (
    BAND,
    FORCE_WINDOW,
    GRADIENT_BATCH,
    L1,
    MB,
    MF,
    NAMES,
    STEP_WINDOW,
    L,
    Settings,
    controller,
    controllers,
    gradient_rate,
    quick_run,
    scenario,
    score,
)
from quell.learners import BatchGradient
from quell.parallel import in_parallel
from quell.plants import two_mass_spring
from quell.records import metrics
from quell.records.trajectory import Trajectory
from quell.simulation.simulate import simulate

# Multiples of omega_o at which the ESOs without learner are measured.
_BANDWIDTHS = (0.9, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0)


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
        messages = {name: run.message for name, run in self.runs.items() if run.diverged}
        return {
            "settings": asdict(self.settings) | about,
            "controllers": {name: dict(score) for name, score in self.scores.items()},
            "claims": [asdict(claim) for claim in self.claims],
            "algorithm_1_stable_up_to": {
                batch: gradient_range.stable_up_to(self.gradient_trials, batch) for batch in batches
            },
            "ended_early": {
                name: {"at": self.runs[name].ended, "message": text}
                for name, text in messages.items()
            },
        }


def run(settings: Settings, progress: Callable[[str, float], None] | None = None) -> Result:
    """Run the study.

    Parameters
    ----------
    settings
        what is varied.
    progress
        called with what is being done and the share of it that is.
    """
    progress = progress or (lambda what, share: None)
    plant, what = two_mass_spring(), scenario(settings)
    runs = {}
    for i, (name, candidate) in enumerate(controllers(settings).items()):
        progress("simulating", i / len(NAMES))
        runs[name] = simulate(plant, candidate, what)
    progress("simulating", 1.0)
    scores = {name: score(run) for name, run in runs.items()}
    needed = {name: _bandwidth_for(settings, name == MB, scores, progress) for name in (MF, MB)}
    variations = _batch_variations(settings)
    claims = tuple(_claims(runs, scores, needed, variations))
    return Result(settings, runs, scores, claims, gradient_range.trials(settings, progress))


def _bandwidth_for(
    settings: Settings, model: bool, scores: Any, progress: Callable[[str, float], None]
) -> dict[str, float | None]:
    """Return for each learner how many times ``omega_o`` the ESO without one needs for the same disturbance peak.

    Peaks are measured on a grid of bandwidths, as far as the sample time allows and the loop is stable, and interpolated between
    logarithms. A peak that none of them reaches gives the largest multiple that was measured; one that all are below gives None.
    """
    grid = [factor for factor in _BANDWIDTHS if factor * settings.omega_o * settings.dt < math.pi]
    progress("bandwidths", 0.5 if model else 0.0)
    candidates = [controller(settings, model=model, bandwidth=factor) for factor in grid]
    found = map(
        score, in_parallel([partial(quick_run, settings, candidate) for candidate in candidates])
    )
    progress("bandwidths", 1.0 if model else 0.5)
    points = [
        (math.log(s["disturbance_peak"]), math.log(factor))
        for s, factor in zip(found, grid, strict=True)
        if s["disturbance_peak"]
    ]
    peaks, factors = np.array(sorted(points)).T if points else (np.zeros(0), np.zeros(0))
    needed: dict[str, float | None] = {}
    for learner in (L, L1):
        peak = scores[learner]["disturbance_peak"]
        known = peak is not None and peaks.size > 1 and math.log(peak) <= peaks[-1]
        needed[learner] = (
            float(np.exp(np.interp(math.log(peak), peaks, factors))) if known else None
        )
    return needed


def _batch_variations(settings: Settings) -> tuple[float | None, float | None]:
    """Return Algorithm 1's control variation with a batch ten times larger, at the same rate a sample and at the same rate a second."""
    rate, batch = gradient_rate(settings), 10 * GRADIENT_BATCH
    candidates = [controller(settings, learner=BatchGradient(r, batch)) for r in (rate, rate / 10)]
    same, slower = map(
        score,
        in_parallel(
            [partial(simulate, two_mass_spring(), c, scenario(settings)) for c in candidates]
        ),
    )
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
        yield Claim.near(
            f"{name}: settling time", paper, scores[name]["settling_time"], 1.0, unit="s"
        )
    for name in (L, L1):
        yield Claim.near(
            f"{name}: largest distance from MB-ESO, 126–134 s",
            0.0,
            _apart(runs[name], runs[MB]),
            BAND,
            unit="m",
        )
    for name in (L, L1):
        ratio = _ratio(
            scores[name]["disturbance_peak"],
            _least(scores[MF]["disturbance_peak"], scores[MB]["disturbance_peak"]),
        )
        yield Claim.below_one(f"{name}: peak over the best ESO's without learner", ratio)
    for name in (L, L1):
        for other in (MF, MB):
            yield Claim.at_least(
                f"{name}: times the bandwidth {other} needs for its peak", 3.0, needed[other][name]
            )
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
