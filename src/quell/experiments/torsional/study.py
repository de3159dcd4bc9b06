"""The torsional experiment: run it, measure the values that the paper claims, judge the claims."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from quell.controllers import ADRC
from quell.experiments.common.claims import Claim, ratio
from quell.experiments.common.scores import Scores, ended_early
from quell.experiments.torsional.setup import (
    BAND,
    CASES,
    COUNTS,
    END,
    FRICTION,
    LINEAR,
    MB,
    MB_OFF,
    MF,
    PLANTS,
    PROFILE_AT,
    STARTS,
    L,
    Settings,
    controllers,
    plant,
    scenarios,
    score,
)
from quell.parallel import in_parallel
from quell.plants import Plant
from quell.records.trajectory import Trajectory
from quell.simulation import Scenario, simulate
from quell.types import Progress

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
