"""The trial on axes: honest learners beside no learner, in means over draws of the noise.

There are three parts: random flexible axes; for every fourth of them an arm whose two joints are
coupled (``arm``), with a right b0 and with one that is too small; and for every eighth a draw of
the features in the trial of settling near rest (``near_rest``).

On flexible axes the error is y, as the reference is zero. Measures are the RMS errors from the
start of the load on, and of the second half of that time (*late*), each the mean over ``DRAWS``
draws of the noise, which are the same with and without learner. *Chance* is the loop without
learner and other draws of the noise, over the loop without learner.

Every axis has ``Harmonic()`` or ``Kalman()`` in turn, every joint of an arm ``Harmonic()``. A run
is *lost* if it diverges or leaves |y| = 100 rad where the loop without learner does not. The ratios
of an arm are those of the joint that loses more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from quell.experiments.common.scores import quantiles
from quell.experiments.stress.axes import arm, loops, near_rest
from quell.experiments.stress.axes.arm import TOO_SMALL, draw_arm
from quell.experiments.stress.axes.loops import Axis, draw_axis
from quell.experiments.stress.axes.near_rest import RestOutcome
from quell.experiments.stress.general.result import Bar
from quell.experiments.stress.general.trial import HONEST
from quell.experiments.stress.study import check_numbers
from quell.files import nonfinite_to_none
from quell.guard import Guard
from quell.learners import Learner
from quell.parallel import in_parallel
from quell.simulation.simulate import simulate

DRAWS = 4
"""Draws of the noise over which the errors of a loop are averaged."""
_AXES_PER_ARM, _AXES_PER_STEP = 4, 8
# Overshoot [fraction of the step] that a guard may add near rest: half of the settling band.
_FURTHER = 0.001
_LIMIT = 100.0  # |y| beyond which a run counts as lost [rad]
_WORST_LISTED = 10


class AxisErrors(NamedTuple):
    """RMS errors, means over the draws of the noise; infinite if one of the runs is lost."""

    rms: float  #: from the start of the load on
    late: float  #: of the second half of that time

    def over(self, other: AxisErrors) -> AxisErrors:
        """Return the ratios to those of another loop."""
        return AxisErrors(*(a / b for a, b in zip(self, other, strict=True)))


@dataclass(frozen=True)
class AxisOutcome:
    """The ratios of one loop."""

    learner: str
    loop: str
    structure: str
    sensor: str
    guarded: AxisErrors  #: over no learner
    unguarded: AxisErrors  #: over no learner
    chance: AxisErrors  #: no learner with other draws of the noise, over no learner

    @property
    def lost(self) -> bool:
        """Whether the guarded loop is lost."""
        return math.isinf(self.guarded.rms)

    @property
    def over_unguarded(self) -> AxisErrors:
        """The guarded loop over the unguarded one; zero where that is lost."""
        return self.guarded.over(self.unguarded)


@dataclass(frozen=True)
class AxesResult:
    """All loops of the trial."""

    settings: dict[str, Any]
    outcomes: Sequence[AxisOutcome]  #: of the flexible axes
    arms: Sequence[AxisOutcome] = ()
    rest: Sequence[RestOutcome] = ()

    @property
    def by_structure(self) -> dict[str, list[AxisOutcome]]:
        """The axes of each kind of observer, and the arms of each b0."""
        found: dict[str, list[AxisOutcome]] = {}
        for outcome in (*self.outcomes, *self.arms):
            found.setdefault(outcome.structure, []).append(outcome)
        return found

    def bars(self) -> list[Bar]:
        """Return the figures that have a bar."""
        every = [*self.outcomes, *self.arms]
        rows = [Bar("all", "lost", float(sum(o.lost for o in every)), 0.0)] if every else []
        return rows + self._axis_bars() + self._arm_bars() + self._rest_bars()

    def _axis_bars(self) -> list[Bar]:
        if not self.outcomes:
            return []
        found, chance = summary(self.outcomes), _chance(self.outcomes)
        over_none = "guarded over no learner, largest"
        over_unguarded = "guarded over unguarded, median"
        rows = [
            Bar("RMS", over_none, found["rms"]["max"], 1.02, chance["rms"]["max"]),
            Bar("late", over_none, found["late"]["max"], 1.02, chance["late"]["max"]),
        ]
        for name in ("rms", "late"):
            median = found[f"{name}_over_unguarded"]["median"]
            rows.append(Bar("RMS" if name == "rms" else name, over_unguarded, median, 1.15))
        return rows

    def _arm_bars(self) -> list[Bar]:
        rows, measure = [], "guarded over no learner, largest of the worse joints"
        for kind, outcomes in self.by_structure.items():
            if outcomes[0] in self.arms:
                found, chance = summary(outcomes)["rms"]["max"], _chance(outcomes)["rms"]["max"]
                rows.append(Bar(kind, f"RMS, {measure}", found, 1.0, chance))
        return rows

    def _rest_bars(self) -> list[Bar]:
        if not self.rest:
            return []
        beside = "guarded, and better of no learner and unguarded"
        noise = [o.other_noise for o in self.rest]
        plain = [o.plain for o in self.rest]
        longer = max(a.time / b.time for a, b in zip(noise, plain, strict=True))
        further = max(a.overshoot - b.overshoot for a, b in zip(noise, plain, strict=True))
        slowest, most = max(o.longer for o in self.rest), max(o.further for o in self.rest)
        return [
            Bar("near rest", f"ratio of settling times, {beside}, largest", slowest, 1.05, longer),
            Bar("near rest", f"difference of overshoots, {beside}", most, _FURTHER, further),
        ]

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        worst = sorted((*self.outcomes, *self.arms), key=lambda o: -o.guarded.rms)[:_WORST_LISTED]
        return {
            "settings": self.settings,
            "bars": [{**bar._asdict(), "met": bar.met} for bar in self.bars()],
            "all": summary(self.outcomes),
            "chance": _chance(self.outcomes),
            "near_rest": [_rest_to_json(outcome) for outcome in self.rest],
            "structures": {name: summary(each) for name, each in self.by_structure.items()},
            "worst": [_to_json(outcome) for outcome in worst],
        }


def summary(outcomes: Sequence[AxisOutcome]) -> dict[str, Any]:
    """Return counts, and quantiles of the ratios; None for those of no numbers."""
    found: dict[str, Any] = {"loops": len(outcomes), "lost": sum(o.lost for o in outcomes)}
    for name in AxisErrors._fields:
        found[name] = quantiles(getattr(o.guarded, name) for o in outcomes)
        over_unguarded = (getattr(o.over_unguarded, name) for o in outcomes)
        found[f"{name}_over_unguarded"] = quantiles(over_unguarded)
    return found


def _chance(outcomes: Sequence[AxisOutcome]) -> dict[str, Any]:
    return {
        name: quantiles(getattr(o.chance, name) for o in outcomes) for name in AxisErrors._fields
    }


def _to_json(outcome: AxisOutcome) -> dict[str, Any]:
    found = asdict(outcome)
    for name in ("guarded", "unguarded", "chance"):
        found[name] = nonfinite_to_none(getattr(outcome, name)._asdict())
    return found


def _rest_to_json(outcome: RestOutcome) -> dict[str, Any]:
    found: dict[str, Any] = {"features": outcome.features}
    for name in ("guarded", "unguarded", "plain", "other_noise"):
        found[name] = nonfinite_to_none(getattr(outcome, name)._asdict())
    return found


def run(
    count: int,
    seed: int,
    *,
    guard: Guard | None,
    progress: Callable[[float], None] | None = None,
) -> AxesResult:
    """Run the trial on ``count`` flexible axes, with the guard or without (None).

    There are also a fourth as many arms of each kind, and an eighth as many steps near rest.

    Seeds below 10 000 are for tuning, from 1 000 000 on for judging. ``progress`` is called with
    the finished share.
    """
    check_numbers(0, count, seed)
    of_arms, steps = math.ceil(count / _AXES_PER_ARM), math.ceil(count / _AXES_PER_STEP)
    jobs: list[Callable[[], Any]] = [partial(run_one, seed, i, guard) for i in range(count)]
    for too_small in (1.0, TOO_SMALL):
        jobs += [partial(run_arm, seed, i, too_small, guard) for i in range(of_arms)]
    jobs += [partial(near_rest.run_one, seed + i, DRAWS, guard) for i in range(steps)]
    settings = {
        "honest": count,
        "seed": seed,
        "guard": None if guard is None else asdict(guard),
        "learners": {name: repr(learner) for name, learner in HONEST.items()},
        "loops": loops.__doc__,
        "arms": arm.__doc__,
        "near_rest": near_rest.__doc__,
        "ratios": __doc__,
    }
    found = in_parallel(jobs, progress)
    last = count + 2 * of_arms
    return AxesResult(settings, found[:count], found[count:last], found[last:])


def run_one(seed: int, index: int, guard: Guard | None) -> AxisOutcome:
    """Run the loop with this number."""
    axis = draw_axis(np.random.default_rng([seed, index]))
    kind = list(HONEST)[index % len(HONEST)]
    plain = errors(axis, None, None)
    unguarded = errors(axis, HONEST[kind], None).over(plain)
    guarded = unguarded
    if guard is not None:
        guarded = errors(axis, HONEST[kind], guard).over(plain)
    return AxisOutcome(
        learner=kind,
        loop=axis.describe(),
        structure=axis.structure,
        sensor=axis.sensor,
        guarded=guarded,
        unguarded=unguarded,
        chance=errors(axis, None, None, first=DRAWS).over(plain),
    )


def run_arm(seed: int, index: int, too_small: float, guard: Guard | None) -> AxisOutcome:
    """Run the arm with this number, with a b0 that is so many times too small."""
    drawn = draw_arm(np.random.default_rng([seed, index]), too_small)
    usual, others = range(DRAWS), range(DRAWS, 2 * DRAWS)
    plain = arm.errors(drawn, None, None, usual)
    unguarded = arm.errors(drawn, arm.LEARNER, None, usual)
    guarded = unguarded if guard is None else arm.errors(drawn, arm.LEARNER, guard, usual)
    return AxisOutcome(
        learner=type(arm.LEARNER).__name__,
        loop=drawn.describe(),
        structure=drawn.kind,
        sensor="each joint",
        guarded=AxisErrors(*guarded.worst(plain)),
        unguarded=AxisErrors(*unguarded.worst(plain)),
        chance=AxisErrors(*arm.errors(drawn, None, None, others).worst(plain)),
    )


def errors(axis: Axis, learner: Learner | None, guard: Guard | None, first: int = 0) -> AxisErrors:
    """Return the errors of a loop, over draws of the noise from number ``first`` on."""
    controller, found = axis.controller(learner, guard), []
    for draw in range(first, first + DRAWS):
        run = simulate(axis.plant, controller, axis.scenario(draw), limit=_LIMIT)
        if run.diverged:
            return AxisErrors(math.inf, math.inf)
        square = run["y"][run.t >= axis.load_at] ** 2
        late = square[square.size // 2 :]
        found.append([math.sqrt(np.mean(square)), math.sqrt(np.mean(late))])
    return AxisErrors(*np.mean(found, axis=0).tolist())
