"""Cases that the first guard failed, each by its name: levels, a slow process, perfect knowledge.

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
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from quell.controllers import ADRC
from quell.experiments.stress.general.loops.loads import LOADS, Table
from quell.experiments.stress.general.loops.plant import GeneralPlant
from quell.experiments.stress.general.program import INPUTS, Program, Watched
from quell.guard import Guard
from quell.learners import Harmonic, Kalman, Learner
from quell.observers import ESO
from quell.parallel import in_parallel
from quell.plants import LinearPlant, delayed
from quell.signals import Constant, Ramp, Step
from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate
from quell.types import Vector

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
    """The figures of one case: without learner, with it unguarded, with it guarded."""

    case: str
    learner: str
    measure: str
    plain: float
    unguarded: float
    guarded: float
    floor: float = 0.0  #: added to both sides of a ratio, for measures that may be zero

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
    noise = Table(_NOISE * rng.standard_normal(t.size), dt)
    scenario = Scenario(0.0, _END, (Table(w, dt),), noise)
    plant = LinearPlant.of(([1.0], [1.0, 0.5, 0.0]))
    observer = ESO.model_free(order=2, b0=1.0, omega_o=10.0, dt=dt)

    def late(learner: Learner | None, guard: Guard | None) -> float:
        controller = ADRC(observer, 1.0, learner=learner, guard=guard)
        y = simulate(plant, controller, scenario, record_every=4)["y"]
        return float(np.sqrt(np.mean(y[y.size // 2 :] ** 2)))

    figures = late(None, None), late(learner, None), late(learner, guard)
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

    figures = figure(None, None), figure(learner, None), figure(learner, guard)
    case = f"slow process, {what}" + (f", {dead_time:g} s dead time" if dead_time else "")
    return Case(case, name, "peak" if what == "load" else "overshoot", *figures, _FLOOR * goal)


def perfect_case(order: int, kind: str, guard: Guard, seed: int) -> Case:
    """Return the RMS errors after 100 lags with a learner that returns the load itself."""
    rng, omega_o, dt = np.random.default_rng([seed, order]), 10.0, 5e-3
    lag = (order + 1) / omega_o
    t: Vector = dt * np.arange(round(_PERFECT_LAGS * lag / dt) + 1, dtype=np.float64)
    w = LOADS[kind](t, rng, 0.8)
    noise = Table(1e-4 / omega_o**order * rng.standard_normal(t.size), dt)
    scenario = Scenario(0.0, float(t[-1]), (Table(w, dt),), noise)
    A, B, C = np.diag(np.ones(order - 1), 1), np.eye(order)[-1:].T, np.eye(order)[:1]
    plant = GeneralPlant(LinearPlant(A, B, C))
    observer = ESO.model_free(order, 1.0, omega_o, dt)
    weights = np.zeros((2, len(INPUTS)))
    weights[:, INPUTS.index("load")] = 1.0

    def late(guard: Guard | None, with_learner: bool = True) -> float:
        learner = Program(weights, load=w, guard=guard)  # type: ignore[arg-type]
        controller = Watched(observer, 1.0, learner=learner, guard=guard)
        plain = ADRC(observer, 1.0)
        y = simulate(plant, controller if with_learner else plain, scenario)["y"]
        return float(np.sqrt(np.mean(y[round(PERFECT_FROM_LAGS * lag / dt) :] ** 2)))

    return Case(
        f"perfect, order {order}, {kind}",
        "the load itself",
        "RMS after 100 lags",
        *(late(None, False), late(None), late(guard)),
    )
