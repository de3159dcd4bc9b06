"""The trial of the guard in general loops: named cases, searched learners, the result.

Measures of a loop: RMS error, largest error, worst window.

Cases that the first guard failed, each by its name: levels, a slow process, perfect knowledge.

**Levels.** ``y'' + 0.5 y' = u + w``, b0 exact, omega_c = 1, omega_o = 10 rad/s, dt = 5 ms. From
20 s on w is constant (0, 30, 100); from 60 s on a sinusoid of amplitude 3 at 0.8 rad/s, or a
coloured load of standard deviation 3 and bandwidth 0.5 rad/s is added. The measure is the RMS error
of the second half of 300 s.

**Slow process.** ``1.5/(120 s + 1)``, dt = 1 s, omega_o = 0.15, omega_c = 0.025 rad/s, b0 exact,
alone and with 20 s of dead time, which the observer knows: a ramp of 0.2/s to 60, a step to 60, a
load of −10 at the input of the plant at rest at 60. Measures: overshoot over 60, and the largest
error after the load.

**Perfect knowledge.** On chains of integrators, b0 exact, a learner returns the load itself. Its
benefit is what it takes from the RMS error of MF-ESO after 100 lags; the guard costs a share of it.

The figures of levels and perfect knowledge are means over draws of the noise; chance is the loop
with the learner unguarded and other draws. The slow process has no noise.

The whole trial in general loops: random loops and named cases, beside MF-ESO.

The trial in general loops: hostile and honest learners, each beside MF-ESO on the same seeds.

Errors are those of y against the response that the loop is designed for. The measures of a loop are
means over draws of the noise, and its ratios are those over the measures of MF-ESO (``study``,
which also says what chance is). A loop is *lost* if one of its runs diverges, or leaves ``|y|`` =
100, where MF-ESO does not. Bars hold for loops whose modulus margin is at least ``HEALTHY``. With
limits of u the margin of the linear part says little: a loop in which MF-ESO itself hardly holds is
*fragile*, and does not count: with limits that are 20 % lower it is lost, or has measures 1.5 times
as large.

Where friction holds a plant or lets it slip, or limits of u hardly suffice, the draw of the noise
decides which happens: a single run says little there, and chance says how little a mean does.

Seeds below 10 000 are for tuning; seeds from 1 000 000 on are for judging, and are looked at once.

Adversaries that know the loop: drawn at random, or found by a search (``cross_entropy``).

Both are ``Program`` learners with the loop's own numbers: a point θ in ``SIZE`` dimensions says how
much of the exact f (``exact_weights``) and of each input they return in their two modes, and when
they change between them.

Search for the worst learner by the cross-entropy method.

Rubinstein & Kroese, *The Cross-Entropy Method*, 2004, section 5.1: points are drawn from a normal
distribution with independent entries, scored, and mean and standard deviation move to those of the
best, smoothed (their section 5.1.2), until the generations are used up. The first generation are
random draws of "earn and spend", and the best of them is the first mean.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from math import comb
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quell.controllers import ADRC
from quell.experiments.stress import loops
from quell.experiments.stress.adversaries import INPUTS, RULES, Program, Watched, draw_adversary
from quell.experiments.stress.adversaries import KINDS as BLIND_KINDS
from quell.experiments.stress.loops import (
    FAMILIES,
    LOADS,
    GeneralLoop,
    GeneralPlant,
    Table,
    draw_loop,
    ideal,
    load_gain,
)
from quell.experiments.stress.study import (
    OTHERS,
    USUAL,
    Bar,
    Judged,
    bars_of,
    check_numbers,
    compare,
    mean_errors,
    ratios,
    summary,
)
from quell.files import nonfinite_to_none
from quell.guard import Guard
from quell.learners import Harmonic, Kalman, Learner
from quell.observers import ESO
from quell.parallel import in_parallel, part_of
from quell.plants import LinearPlant, delayed
from quell.signals import Constant, Ramp, Step
from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate
from quell.types import Matrix, Vector

# ---- Measures of a run ----

WINDOW_LAGS = 10.0
"""Length of a window in lags N/omega_o of the observer."""
LATE_SHARE = 0.5
"""The late part of a run begins here, as a share of its duration."""


class Measures(NamedTuple):
    """Measures of an error e(t), all in its unit, or their ratios; infinite if a run is lost."""

    rms: float  #: RMS of the whole run
    peak: float  #: largest ``|e|``
    window: float  #: largest RMS over a window of ``WINDOW_LAGS``
    late: float  #: RMS of the second half


def measure_error(error: Vector, window: int) -> Measures:
    """Return the measures of an error, for windows of so many of its samples."""
    square = error**2
    total = np.concatenate([[0.0], np.cumsum(square)])
    size = min(max(window, 1), error.size)
    in_windows = (total[size:] - total[:-size]) / size
    late = square[int(LATE_SHARE * error.size) :]
    return Measures(
        rms=float(np.sqrt(np.mean(square))),
        peak=float(np.max(np.abs(error))),
        window=float(np.sqrt(max(np.max(in_windows), 0.0))),
        late=float(np.sqrt(np.mean(late))),
    )


# ---- Cases that the first guard failed, each by its name ----

LEARNERS: dict[str, Learner] = {"Harmonic": Harmonic(), "Kalman": Kalman()}
LEVELS = (0.0, 30.0, 100.0)
_LEVEL_AT, _LOAD_AT, _END = 20.0, 60.0, 300.0
_SIZE, _OMEGA = 3.0, 0.8
_FLOOR = 1e-3  # an overshoot counts as none far below this share of the move
_NOISE = 1e-5  # standard deviation of the measurement noise

PERFECT_FROM_LAGS = 100.0
_PERFECT_LAGS = 300.0
PERFECT_LOADS = ("sine", "coloured", "square", "steps", "amplitude-modulated", "chirp")


@dataclass(frozen=True)
class Case:
    """The figures of one case: without learner, with it unguarded, with it guarded.

    Each is a mean over draws of the noise.
    """

    case: str
    learner: str
    measure: str
    plain: float
    unguarded: float
    guarded: float
    other_noise: float  #: unguarded with other draws of the noise; NaN without noise
    floor: float = 0.0  #: added to both sides of a ratio, for measures that may be zero

    @property
    def of_other_noise(self) -> Case:
        """The same with other draws of the noise in place of the guard: what chance does."""
        return replace(self, guarded=self.other_noise)

    @property
    def over_unguarded(self) -> float:
        """Guarded over unguarded; infinite where unguarded has no error."""
        return self.guarded / self.unguarded if self.unguarded > 0.0 else math.inf

    @property
    def over_plain(self) -> float:
        """Guarded over without learner."""
        return (self.guarded + self.floor) / (self.plain + self.floor)

    @property
    def lost_share(self) -> float:
        """Share of the benefit that the guard costs."""
        return (self.guarded - self.unguarded) / (self.plain - self.unguarded)


def _figures(
    figure: Callable[[Learner | None, Guard | None, int], float], learner: Learner, guard: Guard
) -> tuple[float, float, float, float]:
    """Return the four figures of a case, means over draws of the noise."""

    def mean(learner: Learner | None, guard: Guard | None, draws: range) -> float:
        return float(np.mean([figure(learner, guard, draw) for draw in draws]))

    return (
        mean(None, None, USUAL),
        mean(learner, None, USUAL),
        mean(learner, guard, USUAL),
        mean(learner, None, OTHERS),
    )


def run_named(guard: Guard, seed: int = 0) -> list[Case]:
    """Return all cases with a guard; ``seed`` is that of noise and coloured loads."""
    jobs: list[Any] = []
    for name, learner in LEARNERS.items():
        for kind in ("sine", "coloured"):
            each = partial(level_case, kind=kind, name=name, learner=learner)
            jobs += [partial(each, level=level, guard=guard, seed=seed) for level in LEVELS]
        for dead_time in (0.0, 20.0):
            jobs += [partial(slow_case, what, dead_time, name, learner, guard) for what in SLOW]
    for order in (1, 2, 4):
        jobs += [partial(perfect_case, order, kind, guard, seed) for kind in PERFECT_LOADS]
    return in_parallel(jobs)


def level_case(
    *, level: float, kind: str, name: str, learner: Learner, guard: Guard, seed: int
) -> Case:
    """Return the late RMS errors on a constant level with a sinusoidal or coloured load."""
    rng, dt = np.random.default_rng([seed, int(level)]), 5e-3
    t: Vector = dt * np.arange(round(_END / dt) + 1, dtype=np.float64)
    w = np.where(t >= _LEVEL_AT, level, 0.0)
    later = t >= _LOAD_AT
    size = _SIZE if kind == "sine" else _SIZE * np.sqrt(2.0)
    omega = _OMEGA if kind == "sine" else 0.5
    w[later] += size * LOADS[kind](t[later] - _LOAD_AT, rng, omega)
    noises = _NOISE * rng.standard_normal((OTHERS.stop, t.size))
    plant = LinearPlant.of(([1.0], [1.0, 0.5, 0.0]))
    observer = ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=dt)

    def late(learner: Learner | None, guard: Guard | None, draw: int) -> float:
        controller = ADRC(observer, 1.0, learner=learner, guard=guard)
        scenario = Scenario(0.0, _END, (Table(w, dt),), Table(noises[draw], dt))
        y = simulate(plant, controller, scenario, record_every=4)["y"]
        return float(np.sqrt(np.mean(y[y.size // 2 :] ** 2)))

    figures = _figures(late, learner, guard)
    return Case(f"level {level:g}, {kind}", name, "late RMS", *figures)


SLOW = ("ramp", "step", "load")


def slow_case(what: str, dead_time: float, name: str, learner: Learner, guard: Guard) -> Case:
    """Return overshoot or load peak of the slow process."""
    dt, goal = 1.0, 60.0
    plant: Any = LinearPlant.of(([1.5], [120.0, 1.0]))
    if dead_time > 0.0:
        plant = delayed(plant, dead_time, dt)
    observer = ESO.model_free(order=1, b0=1.5 / 120.0, omega_o=0.15, dt=dt, delay=dead_time)
    reference: Any = {"ramp": Ramp(0.2, 50.0, 50.0 + goal / 0.2), "step": Step(goal, 50.0)}.get(
        what, Step(goal, 50.0)
    )
    load_at = 1500.0
    load = Step(-10.0, load_at) if what == "load" else Constant(0.0)
    scenario = Scenario(reference, 2.0 * load_at, (load,))

    def figure(learner: Learner | None, guard: Guard | None) -> float:
        y = simulate(plant, ADRC(observer, 0.025, learner=learner, guard=guard), scenario)["y"]
        if what == "load":
            return float(np.max(np.abs(y[int(load_at / dt) :] - goal)))
        return max(float(np.max(y)) - goal, 0.0)

    figures = figure(None, None), figure(learner, None), figure(learner, guard), math.nan
    case = f"slow process, {what}" + (f", {dead_time:g} s dead time" if dead_time else "")
    return Case(case, name, "peak" if what == "load" else "overshoot", *figures, _FLOOR * goal)


def perfect_case(order: int, kind: str, guard: Guard, seed: int) -> Case:
    """Return the RMS errors after 100 lags with a learner that returns the load itself."""
    rng, omega_o, dt = np.random.default_rng([seed, order]), 10.0, 5e-3
    lag = (order + 1) / omega_o
    t: Vector = dt * np.arange(round(_PERFECT_LAGS * lag / dt) + 1, dtype=np.float64)
    w = LOADS[kind](t, rng, 0.8)
    noises = 1e-4 / omega_o**order * rng.standard_normal((OTHERS.stop, t.size))
    A, B, C = np.diag(np.ones(order - 1), 1), np.eye(order)[-1:].T, np.eye(order)[:1]
    plant = GeneralPlant(LinearPlant(A, B, C))
    observer = ESO.model_free(order, 1.0, omega_o, dt)
    weights = np.zeros((2, len(INPUTS)))
    weights[:, INPUTS.index("load")] = 1.0

    knows = Program(weights, load=w)  # type: ignore[arg-type]

    def late(learner: Learner | None, guard: Guard | None, draw: int) -> float:
        controller = ADRC(observer, 1.0)
        if learner is not None:
            controller = Watched(observer, 1.0, learner=replace(knows, guard=guard), guard=guard)
        scenario = Scenario(0.0, float(t[-1]), (Table(w, dt),), Table(noises[draw], dt))
        y = simulate(plant, controller, scenario)["y"]
        return float(np.sqrt(np.mean(y[round(PERFECT_FROM_LAGS * lag / dt) :] ** 2)))

    case = f"perfect, order {order}, {kind}"
    figures = _figures(late, knows, guard)
    return Case(case, "the load itself", "RMS after 100 lags", *figures)


# ---- Adversaries that know the loop ----

Rng = np.random.Generator

EARN, SEARCHED = "earn and spend", "searched"
KINDS = (*BLIND_KINDS, EARN, SEARCHED)
"""Hostile learners by name: those of the two-mass trial, and two that see everything."""

_WIDTH = len(INPUTS)
SIZE = 2 * (1 + _WIDTH) + len(RULES) + 1
"""Numbers in θ: of each mode the share of the exact f and the weights; the rules, the frequency."""
_AT = {name: i for i, name in enumerate(INPUTS)}
# Spread of the points around one that a search has found, in units of the search's own spread at
# its beginning. Chosen by hand: enough that no two are alike.
_NEARBY = 0.05
FOUND = Path(__file__).with_name("searched.json")
"""Points that the searches found for each order: made by ``benchmarks/stress_search.py``."""


def exact_weights(loop: GeneralLoop) -> Vector:
    """Return the weights of ``INPUTS`` whose sum is f, in the linear part of the plant.

    ``f = −a x + (b − b0) u + w``; a load that does not enter where u does counts as it acts at low
    frequencies.
    """
    n, A = loop.order, loop.plant.linear.A
    a = np.poly(A[:n, :n])[:0:-1]
    gains = np.array([comb(n, i) for i in range(n)])  # of the law, with omega_c = 1
    weights = np.zeros(_WIDTH)
    weights[_AT["k1 x1"] : _AT["k1 x1"] + n] = -a / gains
    weights[_AT["b0 u"]] = 1.0 / loop.gain_error - 1.0
    weights[_AT["load"]] = load_gain(loop.plant.linear, n)
    return weights


def adversary_at(point: Vector, loop: GeneralLoop, guard: Guard | None) -> Program:
    """Return the adversary at a point θ (SIZE,), for a loop and the guard that it watches."""
    exact = exact_weights(loop)
    modes = point[: 2 * (1 + _WIDTH)].reshape(2, 1 + _WIDTH)
    trusted, distrusted, least, most, omega = point[2 * (1 + _WIDTH) :]
    weights = modes[:, :1] * exact + modes[:, 1:]
    rules = (
        float(1.0 / (1.0 + np.exp(-trusted))),
        float(1.0 / (1.0 + np.exp(-distrusted))),
        float(10.0 * np.exp(np.clip(least, -6.0, 6.0))),
        float(10.0 * np.exp(np.clip(most, -6.0, 6.0))),
    )
    frequency = float(np.exp(np.clip(omega, -4.0, 4.0)))
    return Program(weights.tolist(), rules, frequency, loop.tables[1], guard)


def centre() -> Vector:
    """Return the point from which a search begins: f itself in the first mode, −f in the second."""
    point = np.zeros(SIZE)
    point[0], point[1 + _WIDTH] = 1.0, -1.0
    point[2 * (1 + _WIDTH)], point[2 * (1 + _WIDTH) + 1] = 1.0, -2.0
    return point


def spread() -> Vector:
    """Return the standard deviations with which a search begins."""
    point = np.full(SIZE, 0.3)
    point[1 + _WIDTH] = 2.0
    point[2 + _WIDTH :] = 1.0
    return point


def draw_attack(kind: str, rng: Rng, loop: GeneralLoop, guard: Guard | None) -> Learner:
    """Return a random hostile learner of one of the ``KINDS`` for a loop."""
    if kind == EARN:
        return adversary_at(earn_and_spend(rng), loop, guard)
    if kind == SEARCHED:
        found = found_points(loop.order)
        point = found[int(rng.integers(len(found)))]
        return adversary_at(point + _NEARBY * spread() * rng.normal(size=SIZE), loop, guard)
    return draw_adversary(kind, rng)


def earn_and_spend(rng: Rng) -> Vector:
    """Return a point that returns f until it is trusted, and then one of several kinds of harm."""
    point = np.zeros(SIZE)
    point[0] = 1.0
    attack = point[1 + _WIDTH : 2 * (1 + _WIDTH)]  # a view: share of the exact f, then weights
    kind, sign = int(rng.integers(6)), float(rng.choice([-1.0, 1.0]))
    if kind == 0:
        attack[0] = sign * rng.uniform(0.0, 4.0)
    elif kind == 1:
        attack[1 + _AT["f_plain"]] = 1.0
        attack[1 + _AT["q"]] = sign * rng.uniform(0.5, 5.0)
    else:
        attack[0] = 1.0
        push = ("e sign(q)", "e sign(x2)", "e sin(omega t)", "e")[kind - 2]
        attack[1 + _AT[push]] = sign * rng.uniform(0.3, 3.0)
    point[-5:] = rng.normal([1.0, -1.0, 0.0, 0.0, 0.0], [1.0, 2.0, 1.0, 1.5, 1.0])
    return point


@cache
def found_points(order: int) -> list[Vector]:
    """Return what the searches found for loops of an order: ``benchmarks/stress_search.py``."""
    if not FOUND.is_file():
        return [centre()]
    table = json.loads(FOUND.read_text(encoding="utf-8"))
    return [np.array(point) for point in table[str(order)]]


# ---- The trial in general loops ----

HEALTHY = 0.35
"""Least modulus margin of the loops for which the bars hold."""
HONEST: dict[str, Learner] = {"Harmonic": Harmonic(), "Kalman": Kalman()}
# What tells fragile loops: share of the limits, and ratio to the measures with the full limits.
# Chosen by hand; with the first guard all saturated loops with ratios above 8 were fragile.
_LOWER_LIMITS, _FRAGILE = 0.8, 1.5
# A loop whose reference is within 2 counts as lost beyond this |y|.
_LIMIT = 100.0
# Recorded samples in a lag of the observer: the error changes little between them.
_RECORDS_PER_LAG = 20.0


@dataclass(frozen=True)
class GeneralOutcome(Judged):
    """The ratios of one loop."""

    kind: str
    honest: bool
    index: int  #: number of the loop in the trial, apart for hostile and honest learners
    learner: str
    loop: str
    family: str
    order: int
    load: str
    reference: str
    level: float  #: constant part of the load
    margin: float
    fragile: bool  #: whether MF-ESO hardly holds within the limits of u
    guarded: Measures  #: over MF-ESO
    chance: Measures  #: MF-ESO with other draws of the noise, over MF-ESO

    @property
    def healthy(self) -> bool:
        """Whether the bars hold for its loop."""
        return self.margin >= HEALTHY and not (self.plain_lost or self.fragile)


def error_of(loop: GeneralLoop, learner: Learner | None, guard: Guard | None) -> Measures:
    """Return the measures of a run, infinite ones if it is lost."""
    every = max(int(loop.lag / _RECORDS_PER_LAG / loop.dt), 1)
    controller = loop.controller(learner, guard)
    run = simulate(loop.plant, controller, loop.scenario, record_every=every, limit=_LIMIT)
    if run.diverged:
        return Measures(*[math.inf] * 4)
    wanted = ideal(loop.tables[0], loop.dt, loop.order)[::every]
    return measure_error(run["y"] - wanted, round(WINDOW_LAGS * loop.lag / (every * loop.dt)))


def errors(
    drawn: Sequence[GeneralLoop], learner: Learner | None, guard: Guard | None, draws: Iterable[int]
) -> Measures:
    """Return the measures of a loop, given with all draws of its noise, over some of them."""
    return mean_errors(lambda draw: error_of(drawn[draw], learner, guard), draws)


def is_fragile(drawn: Sequence[GeneralLoop], plain: Measures) -> bool:
    """Return whether MF-ESO hardly holds within the limits of u.

    ``drawn`` is the loop with some draws of the noise, over which ``plain`` are its measures.
    """
    loop = drawn[0]
    if min(loop.u_limit, loop.plant.limit) == math.inf:
        return False
    plant, u_limit = (
        replace(loop.plant, limit=_LOWER_LIMITS * loop.plant.limit),
        _LOWER_LIMITS * loop.u_limit,
    )
    lower = [replace(each, plant=plant, u_limit=u_limit) for each in drawn]
    found = errors(lower, None, None, range(len(lower)))
    return max(ratios(found, plain)[:3]) > _FRAGILE


def run_one(
    seed: int, index: int, kind: str, guard: Guard | None, honest: bool = False
) -> GeneralOutcome:
    """Run the loop with this number, with a learner and without."""
    rng = np.random.default_rng([seed, index, int(honest)])
    loop = draw_loop(rng)
    learner = HONEST[kind] if honest else draw_attack(kind, rng, loop, guard)
    drawn = [replace(loop, draw=draw) for draw in range(OTHERS.stop)]  # each keeps its tables
    plain, guarded, chance = compare(partial(errors, drawn), learner, guard)
    usual = [drawn[draw] for draw in USUAL]
    return GeneralOutcome(
        kind=kind,
        honest=honest,
        index=index,
        learner=repr(learner),
        loop=loop.describe(),
        family=loop.family,
        order=loop.order,
        load=loop.load,
        reference=loop.reference,
        level=loop.level,
        margin=loop.margin,
        fragile=math.isfinite(plain.rms) and is_fragile(usual, plain),
        guarded=Measures(*guarded),
        chance=Measures(*chance),
    )


def run_all(
    runs: int,
    honest: int,
    seed: int,
    *,
    guard: Guard | None,
    kinds: Sequence[str] = KINDS,
    progress: Callable[[float], None] | None = None,
) -> list[GeneralOutcome]:
    """Run loops with hostile and with honest learners, the kinds of each in turn."""
    good = tuple(HONEST)
    jobs = [partial(run_one, seed, i, kinds[i % len(kinds)], guard) for i in range(runs)]
    jobs += [partial(run_one, seed, i, good[i % len(good)], guard, True) for i in range(honest)]
    return in_parallel(jobs, progress)


# ---- The result of the trial in general loops, and whether it meets the bars ----

_WORST_LISTED = 10
# What a bar is over, what it measures, where that is in a ``summary``, and the bar.
_BARS = (
    ("all", "lost where MF-ESO has a modulus margin of 0.35", "lost", 0.0),
    ("hostile", "RMS error, 99 %", "rms p99", 1.05),
    ("hostile", "RMS error, largest", "rms max", 1.2),
    ("hostile", "worst window, 99 %", "window p99", 1.5),
    ("hostile", "worst window, largest", "window max", 2.5),
    ("honest", "RMS error, largest", "rms max", 1.2),
    ("honest", "share worse by more than 5 %", "rms worse", 0.003),
    ("honest", "largest error, 99 %", "peak p99", 1.1),
    ("honest", "largest error, largest", "peak max", 1.5),
)


@dataclass(frozen=True)
class GeneralResult:
    """All loops of a trial, and the named cases."""

    settings: Mapping[str, Any]
    outcomes: Sequence[GeneralOutcome]
    cases: Sequence[Case]

    @property
    def healthy(self) -> list[GeneralOutcome]:
        """The outcomes for which the bars hold."""
        return [o for o in self.outcomes if o.healthy]

    @property
    def left_out(self) -> dict[str, int]:
        """Numbers of loops that do not count, by the reason, and of these the lost ones."""
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
        """Return the figures that have a bar; those of what was not run are left out."""
        groups = {"all": self.healthy, "hostile": self.hostile, "honest": self.honest}
        return bars_of(_BARS, Measures, groups) + self._case_bars()

    def _case_bars(self) -> list[Bar]:
        levels, slow, perfect = (
            [case for case in self.cases if case.case.startswith(begins)]
            for begins in ("level", "slow process", "perfect")
        )
        on_steps = [case for case in perfect if "steps" in case.case]
        on_others = [case for case in perfect if "steps" not in case.case]
        rows = (
            ("level", "late RMS, guarded over unguarded", levels, "over_unguarded", 1.1),
            ("slow process", "overshoot, load peak", slow, "over_plain", 1.0),
            ("perfect", "share of benefit lost", on_others, "lost_share", 0.05),
            ("perfect, rare steps", "share of benefit lost", on_steps, "lost_share", 0.05),
        )
        found = []
        for over, measure, cases, name, limit in rows:
            if cases:
                figure = max(getattr(case, name) for case in cases)
                noise = max(getattr(case.of_other_noise, name) for case in cases)
                found.append(
                    Bar(over, measure, figure, limit, None if math.isnan(noise) else noise)
                )
        return found

    def to_json(self) -> dict[str, Any]:
        """Return plain dictionaries and lists for ``json.dump``."""
        worst = sorted(self.healthy, key=lambda o: -o.guarded.rms)[:_WORST_LISTED]
        groups = {"hostile": self.hostile, "honest": self.honest}
        return {
            "settings": dict(self.settings),
            "left_out": self.left_out,
            "bars": [{**bar._asdict(), "met": bar.met} for bar in self.bars()],
            **{name: summary(group, Measures) for name, group in groups.items()},
            **{
                f"{name}_other_noise": summary(group, Measures, "chance")
                for name, group in groups.items()
            },
            **{
                f"{name}_by_{by}": {
                    key: summary(some, Measures) for key, some in self.grouped(group, by).items()
                }
                for name, group in groups.items()
                for by in ("kind", "family", "load", "reference", "order")
            },
            "worst": [outcome.to_json() for outcome in worst],
            "cases": [nonfinite_to_none(asdict(case)) for case in self.cases],
        }


# ---- The whole trial in general loops ----


def run(
    runs: int,
    honest: int,
    seed: int,
    *,
    guard: Guard | None,
    progress: Callable[[float], None] | None = None,
) -> GeneralResult:
    """Run a trial in general loops, with the guard or without (None), and the named cases.

    There are ``runs`` loops with hostile learners and ``honest`` with honest ones, all kinds in
    turn, each with ``study.DRAWS`` draws of the noise. Seeds below 10 000 are for tuning, from
    1 000 000 on for judging. The named cases compare with the loop without guard, so they need one.
    ``progress`` is called with the finished share.
    """
    check_numbers(runs, honest, seed)
    outcomes = run_all(runs, honest, seed, guard=guard, progress=part_of(progress, 0, 9, 10))
    cases = [] if guard is None else run_named(guard, seed)
    if progress is not None:
        progress(1.0)
    settings = {
        "runs": runs,
        "honest": honest,
        "seed": seed,
        "guard": None if guard is None else asdict(guard),
        "learners": {name: repr(learner) for name, learner in HONEST.items()},
        "loops": loops.__doc__,
        "ratios": __doc__,
    }
    return GeneralResult(settings, outcomes, cases)


# ---- Search for the worst learner by the cross-entropy method ----

# Share of the points that is the best, and weight of the new mean and deviation: usual values.
_ELITE, _SMOOTHING = 0.15, 0.7
# Score of a lost loop: above that of an error a hundredfold.
_LOST = 30.0

# Deviation around the best of the first generation, as a share of that of ``spread``: wider, hardly
# a point in 37 dimensions is better than its centre (in 12 generations the score at order 1 rose by
# 0.1 with 1, by 0.7 with 0.4 and by 1.1 with 0.2).
_AROUND = 0.2

Score = Callable[[Measures], float]


# Ratios that are equally bad: the trial's bars for the largest of all runs.
_BAR_RMS, _BAR_WINDOW = 1.2, 2.5
# Weight of the worst loop against the mean of all: what is sought is the worst. Chosen by hand.
_WORST = 0.5


def harm(ratios: Measures) -> float:
    """Return how bad ratios are: 0 for those of MF-ESO, 1 at the trial's bars."""
    rms, window = np.log(ratios.rms) / np.log(_BAR_RMS), np.log(ratios.window) / np.log(_BAR_WINDOW)
    return float(max(rms, window))


class Found(NamedTuple):
    """The best point of a search, its score, and the best score of each generation."""

    point: Vector
    score: float
    history: list[float]


def search(
    loops: Sequence[GeneralLoop],
    guard: Guard | None,
    rng: np.random.Generator,
    *,
    generations: int = 12,
    population: int = 40,
    score: Score = harm,
) -> Found:
    """Search for the point whose adversary does most harm in some loops.

    Parameters
    ----------
    loops
        in which each point is judged.
    guard
        of the loops; None for none.
    rng
        of the points.
    generations, population
        number of rounds, and of points in each.
    score
        what a point is judged by, from the ratios of a run to MF-ESO's.
    """
    first = np.array([centre()] + [earn_and_spend(rng) for _ in range(population - 1)])
    best, history = Found(first[0], -np.inf, []), []
    mean, deviation = first[0], spread()
    for generation in range(generations):
        points = mean + deviation * rng.normal(size=(population, SIZE)) if generation else first
        points[0] = best.point if generation else first[0]
        scores = judge(points, loops, guard, score)
        order = np.argsort(-scores)
        history.append(float(scores[order[0]]))
        best = Found(points[order[0]], history[-1], history)
        if generation == 0:
            mean, deviation = best.point, _AROUND * deviation
            continue
        elite = points[order[: max(round(_ELITE * population), 2)]]
        mean = (1.0 - _SMOOTHING) * mean + _SMOOTHING * elite.mean(axis=0)
        deviation = (1.0 - _SMOOTHING) * deviation + _SMOOTHING * elite.std(axis=0)
    return best


def judge(
    points: Matrix, loops: Sequence[GeneralLoop], guard: Guard | None, score: Score = harm
) -> Vector:
    """Return the score of each point (points, SIZE): the mean of that over loops and the worst."""
    plain = in_parallel([partial(error_of, loop, None, None) for loop in loops])
    kept = [each for each in zip(loops, plain, strict=True) if math.isfinite(each[1].rms)]

    def one(point: Vector) -> float:
        scores = [0.0]
        for loop, base in kept:
            run = error_of(loop, adversary_at(point, loop, guard), guard)
            found = Measures(*ratios(run, base))
            scores.append(score(found) if math.isfinite(found.rms) else _LOST)
        return float((1.0 - _WORST) * np.mean(scores) + _WORST * np.max(scores))

    return np.array(in_parallel([partial(one, point) for point in points]))


__all__ = [
    "FAMILIES", "INPUTS", "KINDS", "Case", "Found", "GeneralLoop", "GeneralOutcome", "GeneralPlant",
    "GeneralResult", "Measures", "Program", "Watched", "adversary_at", "centre", "draw_attack",
    "draw_loop", "error_of", "errors", "exact_weights", "harm", "judge", "measure_error", "run",
    "run_named", "run_one", "search", "spread"
]  # fmt: skip
