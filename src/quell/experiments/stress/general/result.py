"""The result of the trial in general loops, and whether it meets the bars."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from quell.experiments.common.scores import quantiles
from quell.experiments.stress.general.measures import Measures
from quell.experiments.stress.general.named import Case
from quell.experiments.stress.general.trial import HEALTHY, GeneralOutcome
from quell.files import nonfinite_to_none

# A run counts as worse from this ratio of the RMS errors on.
_WORSE = 1.05
_WORST_LISTED = 10
# What a bar is over, what it measures, where that is in a ``summary``, and the bar.
_BARS = (
    ("all", "lost where MF-ESO has a modulus margin of 0.35", "lost", 0.0),
    ("hostile", "RMS of the run, 99 %", "rms p99", 1.05),
    ("hostile", "RMS of the run, largest", "rms max", 1.2),
    ("hostile", "worst window, 99 %", "window p99", 1.5),
    ("hostile", "worst window, largest", "window max", 2.5),
    ("honest", "RMS of the run, largest", "rms max", 1.2),
    ("honest", "share worse by more than 5 %", "worse", 0.003),
    ("honest", "largest error, 99 %", "peak p99", 1.1),
    ("honest", "largest error, largest", "peak max", 1.5),
)


class Bar(NamedTuple):
    """A limit that a figure must not exceed."""

    over: str
    measure: str
    figure: float | None  # None without runs
    bar: float
    other_noise: float | None = None  # the figure of MF-ESO itself, with another draw of the noise

    @property
    def met(self) -> bool:
        """Whether the figure is within the bar."""
        return self.figure is not None and self.figure <= self.bar


@dataclass(frozen=True)
class GeneralResult:
    """All runs of a trial in general loops, and the named cases."""

    settings: Mapping[str, Any]
    outcomes: Sequence[GeneralOutcome]
    cases: Sequence[Case]

    @property
    def healthy(self) -> list[GeneralOutcome]:
        """The outcomes for which the bars hold."""
        return [o for o in self.outcomes if o.healthy]

    @property
    def left_out(self) -> dict[str, int]:
        """Numbers of runs that do not count, by the reason, and of these the lost ones."""
        low = [o for o in self.outcomes if o.margin < HEALTHY]
        rest = [o for o in self.outcomes if o.margin >= HEALTHY and not o.healthy]
        return {
            "low_margin": len(low),
            "plain_lost": sum(o.plain_lost for o in rest),
            "fragile": sum(o.fragile for o in rest),
            "lost": sum(o.lost for o in (*low, *rest)),
        }

    @property
    def hostile(self) -> list[GeneralOutcome]:
        """Those of them with a hostile learner."""
        return [o for o in self.healthy if not o.honest]

    @property
    def honest(self) -> list[GeneralOutcome]:
        """Those of them with an honest learner."""
        return [o for o in self.healthy if o.honest]

    def grouped(self, outcomes: Sequence[GeneralOutcome], by: str) -> dict[str, Any]:
        """Return outcomes by one of their fields, in the order of the field's first values."""
        groups: dict[str, list[GeneralOutcome]] = {}
        for outcome in outcomes:
            groups.setdefault(str(getattr(outcome, by)), []).append(outcome)
        return groups

    def bars(self) -> list[Bar]:
        """Return the figures that have a bar; those of cases that were not run are left out."""
        groups = {"all": self.healthy, "hostile": self.hostile, "honest": self.honest}
        figures = {name: summary(group) for name, group in groups.items()}
        others = {name: _with_other_noise(group) for name, group in groups.items()}
        found = [
            Bar(over, measure, _look_up(figures[over], key), bar, _look_up(others[over], key))
            for over, measure, key, bar in _BARS
        ]
        return found + [bar for bar in self._case_bars() if bar.figure is not None]

    def _case_bars(self) -> list[Bar]:
        levels, slow, perfect = (
            [case for case in self.cases if case.case.startswith(begins)]
            for begins in ("level", "slow process", "perfect")
        )
        over_unguarded = max((case.over_unguarded for case in levels), default=None)
        over_plain = max((case.over_plain for case in slow), default=None)
        on_steps = [case.lost_share for case in perfect if "steps" in case.case]
        on_others = [case.lost_share for case in perfect if "steps" not in case.case]
        return [
            Bar("level", "late RMS, guarded over unguarded", over_unguarded, 1.1),
            Bar("slow process", "overshoot, load peak", over_plain, 1.0),
            Bar("perfect", "share of benefit lost", max(on_others, default=None), 0.05),
            Bar("perfect, rare steps", "share of benefit lost", max(on_steps, default=None), 0.05),
        ]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        worst = sorted(self.healthy, key=lambda o: -(o.rms if np.isfinite(o.rms) else np.inf))
        groups = {"hostile": self.hostile, "honest": self.honest}
        return {
            "settings": dict(self.settings),
            "left_out": self.left_out,
            "bars": [{**bar._asdict(), "met": bar.met} for bar in self.bars()],
            **{name: summary(group) for name, group in groups.items()},
            **{f"{name}_other_noise": _with_other_noise(group) for name, group in groups.items()},
            **{
                f"{name}_by_{by}": {
                    key: summary(some) for key, some in self.grouped(group, by).items()
                }
                for name, group in groups.items()
                for by in ("kind", "family", "load", "reference", "order")
            },
            "worst": [_to_json(outcome) for outcome in worst[:_WORST_LISTED]],
            "cases": [nonfinite_to_none(asdict(case)) for case in self.cases],
        }


def _to_json(outcome: GeneralOutcome) -> Any:
    """Return a dictionary for ``json.dump``."""
    return nonfinite_to_none({**asdict(outcome), "other_noise": outcome.other_noise._asdict()})


def _look_up(found: Mapping[str, Any], key: str) -> float | None:
    """Return a figure of a ``summary``."""
    name, *part = key.split()
    return found[name][part[0]] if part else found[name]


def _with_other_noise(outcomes: Sequence[GeneralOutcome]) -> dict[str, Any]:
    """Return the ``summary`` of MF-ESO itself, with another draw of the noise in the same loops."""
    return summary([outcome.of_other_noise for outcome in outcomes])


def summary(outcomes: Sequence[GeneralOutcome]) -> dict[str, Any]:
    """Return counts and quantiles of the ratios to MF-ESO; None for the quantiles of no numbers."""
    found: dict[str, Any] = {"runs": len(outcomes), "lost": sum(o.lost for o in outcomes)}
    for name in Measures._fields:
        found[name] = quantiles(getattr(o, name) for o in outcomes)
    rms = [o.rms for o in outcomes if math.isfinite(o.rms)]
    found["worse"] = float(np.mean([ratio > _WORSE for ratio in rms])) if rms else None
    return found
