"""The guard's trial: hostile learners and an honest one in random loops, each beside MF-ESO.

Errors are those of y against the response that the loop is designed for, ``(omega_c/(s +
omega_c))^n`` times r, so that they do not contain the lag of the design. They are RMS errors: over
the whole run, over the 60 s of load, and *late*, from 50 s after the start of the load.

Judged are means: the errors of a loop are the means over ``DRAWS`` draws of the measurement noise,
the same with and without learner, and the ratio of a loop is its mean error over that of MF-ESO.
*Chance* is MF-ESO with as many other draws of the noise, over MF-ESO. A loop is *lost* if one of
its runs diverges where MF-ESO holds with all of these draws. All sets of loops are judged in this
way.

Random loops: two-mass-spring plants, all controlled by one design without tuning.

Masses in [0.5, 2] kg, stiffness in [0.3, 3] N/m, b0 wrong by a factor in [0.6, 1.6], sample times
of 1, 2 and 5 ms, a load on m2 of 0.1 to 1.5 rad/s and 0.1 to 2 N; omega_c = 1 and omega_o = 10
rad/s for all. From rest the output follows sin t for 60 s, then a unit step; the load acts from 90
s on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from quell import checks
from quell.controllers import ADRC
from quell.experiments.common import quantiles
from quell.experiments.stress.adversaries import KINDS, draw_adversary
from quell.files import nonfinite_to_none
from quell.guard import Guard
from quell.learners import Harmonic, Learner
from quell.observers import ESO
from quell.parallel import in_parallel
from quell.plants import LinearPlant, two_mass_spring
from quell.signals import BandLimitedNoise, Sinusoid, Step
from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate
from quell.types import Vector

# ---- Means over draws of the noise, ratios and bars, for all sets of loops ----

DRAWS = 4
"""Draws of the noise over which the errors of a loop are averaged."""
USUAL, OTHERS = range(DRAWS), range(DRAWS, 2 * DRAWS)
"""Numbers of the draws with and without learner, and of those that show what chance does."""
WORSE = 1.05
"""A loop counts as worse from this ratio on."""

E = TypeVar("E", bound=tuple[Any, ...])  # a NamedTuple of errors: numbers, or one for each joint


def mean_errors(one: Callable[[int], E], draws: Iterable[int]) -> E:
    """Return the means of a loop's errors over draws of the noise.

    ``one`` returns the errors with the draw of a number, infinite ones if the loop is lost; the
    means are then infinite, too.
    """
    found = [one(draw) for draw in draws]
    make: Any = type(found[0])
    return make(*np.mean(found, axis=0))


def ratios(errors: Sequence[Any], plain: Sequence[Any]) -> list[float]:
    """Return the ratios of errors to those of the loop without learner, of joints the largest.

    A ratio is infinite if the loop is lost, NaN if that without learner is.
    """
    return [
        float(np.max(a / np.maximum(b, 1e-300))) if np.all(np.isfinite(b)) else math.nan
        for a, b in zip(errors, plain, strict=True)
    ]


def compare(
    errors: Callable[[Learner | None, Guard | None, range], E],
    learner: Learner | None,
    guard: Guard | None,
) -> tuple[E, list[float], list[float]]:
    """Return the errors of a loop without learner, and the ratios to them: guarded, and by chance.

    ``errors`` returns the means for a learner, a guard and draws of the noise.
    """
    plain = errors(None, None, USUAL)
    guarded, others = errors(learner, guard, USUAL), errors(None, None, OTHERS)
    return plain, ratios(guarded, plain), ratios(others, plain)


class Judged:
    """The contract of the outcomes of all sets of loops: NamedTuples of ratios."""

    guarded: Any  # with learner (and guard), over no learner
    chance: Any  # no learner with other draws of the noise, over no learner

    @property
    def plain_lost(self) -> bool:
        """Whether the loop without learner is lost."""
        return math.isnan(self.guarded[0])

    @property
    def lost(self) -> bool:
        """Whether the loop is lost with the learner, and only then."""
        return math.isinf(self.guarded[0])

    def to_json(self) -> Any:
        """Return a dictionary for ``json.dump``."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}  # type: ignore[arg-type]
        for name, value in found.items():
            if hasattr(value, "_asdict"):
                found[name] = value._asdict()
            elif is_dataclass(value) and not isinstance(value, type):
                found[name] = asdict(value)
        return nonfinite_to_none(found)


def summary(outcomes: Sequence[Judged], kind: Any, of: str = "guarded") -> dict[str, Any]:
    """Return counts, and of each ratio quantiles, the share of worse loops and the mean logarithm.

    Parameters
    ----------
    outcomes
        of loops. A lost one counts as worse, but not in quantiles and logarithms. Figures of no
        numbers are None.
    kind
        the NamedTuple of their ratios.
    of
        which ratios: ``"guarded"``, ``"chance"`` or another attribute of the outcomes.
    """
    kept = [getattr(outcome, of) for outcome in outcomes if not outcome.plain_lost]
    counts: dict[str, Any] = {
        "loops": len(outcomes),
        "lost": sum(math.isinf(each[0]) for each in kept),
        "plain_lost": len(outcomes) - len(kept),
    }
    for i, name in enumerate(kind._fields):
        values = np.array([each[i] for each in kept])
        logs = np.log(np.maximum(values[np.isfinite(values)], 1e-300))
        counts[name] = {
            **quantiles(values),
            "worse": float(np.mean(values > WORSE)) if values.size else None,
            "mean_log": float(np.mean(logs)) if logs.size else None,
        }
    return counts


class Bar(NamedTuple):
    """A limit that a figure must not exceed."""

    over: str
    measure: str
    figure: float | None  # None if all loops are lost
    bar: float
    other_noise: float | None = None  # what chance alone makes of the figure

    @property
    def met(self) -> bool:
        """Whether the figure is within the bar."""
        return self.figure is not None and self.figure <= self.bar


def bars_of(
    table: Sequence[tuple[str, str, str, float]], kind: Any, groups: Mapping[str, Sequence[Judged]]
) -> list[Bar]:
    """Return the bars of a table: what each is over, what it measures, its place in a summary.

    Bars of groups without loops are left out.
    """
    found = []
    guarded = {name: summary(some, kind) for name, some in groups.items()}
    chance = {name: summary(some, kind, "chance") for name, some in groups.items()}
    for over, measure, key, limit in table:
        if guarded[over]["loops"] > guarded[over]["plain_lost"]:
            figures = _look_up(guarded[over], key), _look_up(chance[over], key)
            found.append(Bar(over, measure, figures[0], limit, figures[1]))
    return found


def _look_up(found: Mapping[str, Any], key: str) -> float | None:
    """Return a figure of a ``summary``."""
    name, *part = key.split()
    value: Any = found[name][part[0]] if part else float(found[name])
    return None if value is None else float(value)


# ---- Random loops of two masses ----

STEP_AT, LOAD_AT, END = 60.0, 90.0, 150.0
"""Start of the step and of the load, end of a run [s]: chosen by hand."""
REFERENCE = Sinusoid().until(STEP_AT, then=Step(at=STEP_AT))


@dataclass(frozen=True)
class Loop:
    """One plant with its sample time, its load and the error of the design's b0."""

    m1: float
    m2: float
    k: float
    gain_error: float  #: b0 / b
    dt: float
    omega: float  #: frequency of the load [rad/s]
    amplitude: float  #: amplitude of the load [N]
    seed: int  #: seed of the noise
    draw: int = 0  #: which draw of the noise; all else is the same

    @property
    def plant(self) -> LinearPlant:
        """The plant."""
        return two_mass_spring(self.m1, self.m2, self.k)

    @property
    def scenario(self) -> Scenario:
        """Reference, load and noise."""
        return Scenario(
            reference=REFERENCE,
            disturbances=(0.0, Sinusoid(self.amplitude, self.omega, start=LOAD_AT)),
            noise=BandLimitedNoise(power=1e-12, sample_time=0.01),
            duration=END,
            seed=self.seed + self.draw,
        )

    def controller(self, learner: Learner | None = None, guard: Guard | None = None) -> ADRC:
        """Return the design that all loops share, with a learner and a guard."""
        b0 = self.gain_error * self.k / (self.m1 * self.m2)
        observer = ESO.model_free(order=4, b0=b0, omega_o=10.0, dt=self.dt)
        return ADRC(observer, omega_c=1.0, learner=learner, guard=guard)


def draw_loops(count: int, rng: np.random.Generator) -> list[Loop]:
    """Return ``count`` random loops."""
    return [
        Loop(
            m1=rng.uniform(0.5, 2.0),
            m2=rng.uniform(0.5, 2.0),
            k=rng.uniform(0.3, 3.0),
            gain_error=rng.uniform(0.6, 1.6),
            dt=float(rng.choice([1e-3, 2e-3, 5e-3])),
            omega=rng.uniform(0.1, 1.5),
            amplitude=rng.uniform(0.1, 2.0),
            seed=int(rng.integers(2**31)),
        )
        for _ in range(count)
    ]


HONEST = "honest"
# Start of the "late" part of the load [s]: chosen by hand, learners have learned the load by then.
_LATE_AT = LOAD_AT + 50.0
# A loop that has to hold 1 m counts as unstable beyond this |y| [m].
_LIMIT = 100.0
# Time between recorded samples [s]: a multiple of all sample times.
_RECORD_DT = 0.02
# Chosen by hand: a trial of a million runs takes hours or days.
_MOST_RUNS = 1_000_000
_WORST_LISTED = 5


# What a bar is over, what it measures, where that is in a ``summary``, and the bar.
_BARS = (
    ("all", "lost", "lost", 0.0),
    ("hostile", "whole run, 99 %", "whole p99", 1.1),
    ("hostile", "whole run, largest", "whole max", 1.5),
    ("hostile", "minute of load, 99 %", "load p99", 1.5),
    ("honest", "minute of load, median", "load median", 0.2),
    ("honest", "minute of load, 99 %", "load p99", 1.05),
    ("honest", "minute of load, largest", "load max", 1.2),
    ("honest", "late, median", "late median", 0.02),
)


class Errors(NamedTuple):
    """RMS errors, means over draws of the noise, or their ratios; infinite if a run is lost."""

    whole: float  #: of the whole run
    load: float  #: of the 60 s of load
    late: float  #: from 50 s after the start of the load


@dataclass(frozen=True)
class Outcome(Judged):
    """The ratios of one loop."""

    kind: str
    loop: Loop
    learner: str
    guarded: Errors  #: over MF-ESO
    chance: Errors  #: MF-ESO with other draws of the noise, over MF-ESO


@dataclass(frozen=True)
class Result:
    """All loops of a trial."""

    settings: Mapping[str, Any]
    outcomes: Sequence[Outcome]

    def of(self, kind: str) -> list[Outcome]:
        """Return the outcomes of one kind of learner."""
        return [outcome for outcome in self.outcomes if outcome.kind == kind]

    @property
    def hostile(self) -> list[Outcome]:
        """Outcomes of all learners but the honest one."""
        return [outcome for outcome in self.outcomes if outcome.kind != HONEST]

    @property
    def kinds(self) -> list[str]:
        """The kinds of learners in the trial, in order."""
        return list(dict.fromkeys(outcome.kind for outcome in self.outcomes))

    def bars(self) -> list[Bar]:
        """Return the figures that have a bar."""
        groups = {"all": self.outcomes, "hostile": self.hostile, "honest": self.of(HONEST)}
        return bars_of(_BARS, Errors, groups)

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        groups = {"hostile": self.hostile, "honest": self.of(HONEST)}
        counted = [o for o in self.hostile if not o.plain_lost]
        worst = sorted(counted, key=lambda o: -o.guarded.load)[:_WORST_LISTED]
        return {
            "settings": dict(self.settings),
            "bars": [{**bar._asdict(), "met": bar.met} for bar in self.bars()],
            **{name: summary(group, Errors) for name, group in groups.items()},
            **{
                f"{name}_other_noise": summary(group, Errors, "chance")
                for name, group in groups.items()
            },
            "kinds": {
                kind: summary(self.of(kind), Errors) for kind in self.kinds if kind != HONEST
            },
            "worst": [outcome.to_json() for outcome in worst],
        }


def run(
    runs: int,
    honest: int,
    seed: int,
    *,
    guard: Guard | None,
    learner: Learner | None = None,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Run a trial, with the guard or without (None).

    There are ``runs`` loops with hostile learners, all kinds in turn, and ``honest`` loops with
    ``learner``, ``Harmonic()`` by default, each with ``DRAWS`` draws of the noise. ``progress`` is
    called with the finished share, 0 to 1.
    """
    check_numbers(runs, honest, seed)
    rng = np.random.default_rng(seed)
    kinds = [KINDS[i % len(KINDS)] for i in range(runs)]
    jobs = [
        partial(run_one, kind, loop, draw_adversary(kind, rng), guard)
        for kind, loop in zip(kinds, draw_loops(runs, rng), strict=True)
    ]
    good = Harmonic() if learner is None else learner
    jobs += [partial(run_one, HONEST, loop, good, guard) for loop in draw_loops(honest, rng)]
    counts = {"runs": runs, "honest": honest, "seed": seed}
    parts = {"guard": None if guard is None else asdict(guard), "learner": repr(good)}
    about = {"loops": __doc__, "ratios": __doc__}
    return Result(counts | parts | about, in_parallel(jobs, progress))


def check_numbers(runs: int, honest: int, seed: int) -> None:
    """Raise a ``ValueError`` unless these are numbers of loops of a trial and its seed."""
    checks.whole("runs", runs, 0, _MOST_RUNS)
    checks.whole("honest", honest, 0, _MOST_RUNS)
    checks.whole("seed", seed, 0)
    if runs + honest == 0:
        raise ValueError("runs = 0, honest = 0: at least one must be positive")


def run_one(kind: str, loop: Loop, learner: Learner, guard: Guard | None) -> Outcome:
    """Run one loop with a learner, and without."""
    _, guarded, chance = compare(partial(errors, loop), learner, guard)
    return Outcome(kind, loop, repr(learner), Errors(*guarded), Errors(*chance))


def errors(
    loop: Loop, learner: Learner | None, guard: Guard | None, draws: Iterable[int] = (0,)
) -> Errors:
    """Return the errors of a loop over these draws of the noise; infinite if one run is lost."""
    every, controller = round(_RECORD_DT / loop.dt), loop.controller(learner, guard)

    def one(draw: int) -> Errors:
        scenario = replace(loop, draw=draw).scenario
        run = simulate(loop.plant, controller, scenario, record_every=every, limit=_LIMIT)
        if run.diverged:
            return Errors(math.inf, math.inf, math.inf)
        error, end = run["y"] - _ideal(len(run)), END + _RECORD_DT
        windows = (slice(None), run.window(LOAD_AT, end), run.window(_LATE_AT, end))
        return Errors(*(float(np.sqrt(np.mean(error[window] ** 2))) for window in windows))

    return mean_errors(one, draws)


@cache
def _ideal(samples: int) -> Vector:
    """Return the response of four poles at −1 rad/s to the scenario's reference."""
    from scipy.signal import lsim

    t = np.arange(samples) * _RECORD_DT
    return np.asarray(lsim(([1.0], [1.0, 4.0, 6.0, 4.0, 1.0]), REFERENCE(t), t)[1])
