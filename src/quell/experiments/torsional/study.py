"""The torsional experiment as a whole: run it, measure what the paper claims of it, judge."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from quell.controllers import ADRC
from quell.experiments.common.claims import Claim
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

Scores = Mapping[str, float | None]
# One count of the encoder as a fraction of the move: what an overshoot can be told apart by. Overshoots are whole counts but for rounding.
COUNT = 2.0 / COUNTS * (1.0 + 1e-6)


@dataclass(frozen=True)
class Outcome:
    """What came out on one plant."""

    records: Mapping[str, Trajectory]
    """Of the first start."""
    scores: Mapping[str, Scores]
    """Medians over the starts."""
    spread: Mapping[str, Mapping[str, tuple[float, float] | None]]
    """Least and largest."""
    claims: tuple[Claim, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists; what could not be measured is None."""
        messages = {name: run.message for name, run in self.records.items() if run.diverged}
        return {
            "controllers": {name: dict(score) for name, score in self.scores.items()},
            "spread": {name: dict(spread) for name, spread in self.spread.items()},
            "claims": [asdict(claim) for claim in self.claims],
            "ended_early": {
                name: {"at": self.records[name].ended, "message": text}
                for name, text in messages.items()
            },
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
        """Return the plant with friction at the top, and the linear one below its name."""
        bandwidths = {"omega_c": self.omega_c, "omega_o": self.omega_o}
        return (
            bandwidths
            | {"settings": bandwidths}
            | self.outcomes[FRICTION].to_json()
            | {LINEAR: self.outcomes[LINEAR].to_json()}
        )


@dataclass(frozen=True)
class Result:
    """What came out, case by case."""

    settings: Settings
    cases: tuple[Case, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        about = {
            "plant": "ECP 205 torsional plant, two disks, y = angle of the upper one; with friction, and (linear) as identified",
            "encoder_counts": COUNTS,
            "profile_window": (PROFILE_AT, END),
            "settling_band": BAND,
            "starts": STARTS,
            "units": "SI; overshoot as a fraction of the move; settling time from the profile's start; medians over the starts",
        }
        return {
            "settings": asdict(self.settings) | about,
            "cases": [case.to_json() for case in self.cases],
        }


def run(settings: Settings, progress: Callable[[str, float], None] | None = None) -> Result:
    """Run the experiment.

    Parameters
    ----------
    settings
        what is varied.
    progress
        called with what is being done and the share of it that is.
    """
    progress = progress or (lambda what, share: None)
    jobs = {
        (case, kind, name): partial(_starts, plant(kind), controller, scenarios(settings, kind))
        for case in CASES
        for kind in PLANTS
        for name, controller in controllers(settings, *case).items()
    }
    done = dict(
        zip(
            jobs,
            in_parallel(jobs.values(), lambda share: progress("simulating", share)),
            strict=True,
        )
    )

    def outcome(case: tuple[float, float], kind: str) -> Outcome:
        mine = {
            name: found
            for (its, plant_kind, name), found in done.items()
            if (its, plant_kind) == (case, kind)
        }
        scores = {name: _over_starts(found, statistics.median) for name, (_, found) in mine.items()}
        spread = {
            name: _over_starts(found, lambda values: (min(values), max(values)))
            for name, (_, found) in mine.items()
        }
        return Outcome(
            {name: first for name, (first, _) in mine.items()},
            scores,
            spread,
            tuple(_claims(scores, settings.dt)),
        )

    return Result(
        settings,
        tuple(Case(*case, {kind: outcome(case, kind) for kind in PLANTS}) for case in CASES),
    )


def _starts(
    what: Plant, controller: ADRC, courses: Sequence[Scenario]
) -> tuple[Trajectory, list[Scores]]:
    """Run a controller from all starts; return the first record, and all scores."""
    first = simulate(what, controller, courses[0])
    return first, [
        score(first),
        *(score(simulate(what, controller, course)) for course in courses[1:]),
    ]


def _over_starts(scores: Sequence[Scores], summary: Callable[[list[float]], Any]) -> dict[str, Any]:
    """Summarise each metric over the starts; one that a single start lacks is lacking."""
    columns = {key: [score[key] for score in scores] for key in scores[0]}
    return {
        key: None if None in values else summary([v for v in values if v is not None])
        for key, values in columns.items()
    }


def _claims(scores: Mapping[str, Scores], dt: float) -> Iterable[Claim]:
    """Judge the paper's two observations: L-ESO has the least overshoot and settles first, and moves u less than MF-ESO, more than MB-ESO.

    Overshoots are told apart by a count of the encoder, settling times by a sample.
    """
    for key, what, unit, least in (
        ("overshoot", "overshoot", "", COUNT),
        ("settling_time", "settling", "s", dt),
    ):
        for other in (MF, MB_OFF, MB):
            rival = scores[other][key]
            yield Claim.at_most(
                f"{L}: {what} ≤ {other}'s",
                "best",
                scores[L][key],
                None if rival is None else rival + least,
                unit,
            )
    mine = scores[L]["control_variation"]
    for other, judge in ((MF, Claim.below_one), (MB, Claim.above_one)):
        rival = scores[other]["control_variation"]
        yield judge(
            f"{L}: variation over {other}'s", None if mine is None or not rival else mine / rival
        )
