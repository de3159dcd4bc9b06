"""Random flexible axes: a motor and one or two inertias, the encoder at either end.

J_motor is 1e-4 to 1e-3 kg m², J_load/J_motor 0.3 to 10. The load swings against a held motor at 15
to 90 Hz, with a damping of 0, 0.005 or 0.03 (not 0 where a design would invert it); a third
inertia, 0.3 J_motor, sits in between on a coupling that is twice as stiff. 4 kHz, torque a sample
late. A torque of 0.1 to 1 N m at 1 to 16 Hz acts on the load after 30 to 60 lags of the observer;
the encoder's noise is 2π/2¹⁶ to 2π/2²³ rad.

``STRUCTURES`` are the observers. *Model-free*: order 2 with the encoder at the motor, 4 at the
load, b0 that of the rigid axis or of the chain. The others have a model, exact in half of the
loops; in the other half the inertias behind the motor are 30 % off. With the encoder at the load
it leaves out the damping of the couplings, whose zero at −k/c no loop sees.

omega_o is 3 to 8 omega_c, and omega_c as large as the modulus margin of 0.45 to 0.7 that a loop
draws allows: M_s is 1.4 to 2.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from quell.analysis import analyse
from quell.controllers import ADRC
from quell.experiments.stress.adversaries import log_uniform
from quell.experiments.stress.general.loops.loads import Table
from quell.guard import Guard
from quell.learners import Learner
from quell.observers import ESO
from quell.plants import delayed, n_mass
from quell.plants.delay import DelayedPlant
from quell.simulation.scenario import Scenario

Rng = np.random.Generator

STRUCTURES = ("model-free", "model-based", "zeros kept", "own poles")
DT = 2.5e-4
"""Sample time, and delay of the torque [s]."""
# Lags of the observer, and periods of the load, that a run lasts at least.
_RUN_LAGS, _PERIODS = 300.0, 12.0
# Fastest observer that is drawn, in 1/dt, beyond which ``ADRC`` warns.
_FASTEST = 0.3
# omega_c is lowered by this factor until the margin suffices, or it is below the slowest [rad/s].
_LOWER, _SLOWEST = 0.8, 6.0
_MOST_TRIES = 1000
_PATTERN = (-0.8, 0.6)  # two poles of "own poles" in units of omega_o; the others lie at −1


@dataclass(frozen=True, eq=False)
class Axis:
    """A flexible axis, its controller without learner, and what acts on it."""

    structure: str  #: one of ``STRUCTURES``
    sensor: str  #: "motor" or "load"
    inertias: tuple[float, ...]  #: from the motor on [kg m²]
    stiffnesses: tuple[float, ...]  #: [N m/rad]
    damping: float  #: of each coupling [N m s/rad]
    wrong: float  #: factor of the model's inertias behind the motor
    omega_c: float
    omega_o: float
    margin: float  #: modulus margin without learner
    frequency: float  #: of the load [Hz]
    amplitude: float  #: of the load [N m]
    noise: float  #: standard deviation of the encoder's noise [rad]
    seed: int

    @property
    def linear(self) -> Any:
        """The axis without its delay."""
        return self._chain_of(1.0, self.damping)

    @property
    def plant(self) -> DelayedPlant:
        """The axis, the torque a sample late."""
        return delayed(self.linear, DT, DT)

    def _chain_of(self, wrong: float, damping: float) -> Any:
        """Return the axis with other inertias behind the motor and another damping."""
        inertias = (self.inertias[0], *(wrong * J for J in self.inertias[1:]))
        sensor = 1 if self.sensor == "motor" else len(inertias)
        dampings = [damping] * len(self.stiffnesses)
        return n_mass(inertias, self.stiffnesses, dampings, sensor=sensor)

    @cached_property
    def observer(self) -> ESO:
        """The observer."""
        if self.structure == "model-free":
            return ESO.model_free(*self._chain, self.omega_o, DT, delay=DT)
        model = self._chain_of(self.wrong, self.damping if self.sensor == "motor" else 0.0)
        own: list[float | tuple[float, float]] = [_PATTERN, *[-1.0] * (2 * len(self.inertias) - 1)]
        poles = own if self.structure == "own poles" else None
        kept = self.structure == "zeros kept"
        return ESO.model_based(model, self.omega_o, DT, keep_zeros=kept, poles=poles, delay=DT)

    @property
    def _chain(self) -> tuple[int, float]:
        """Order and b0 of a design without model."""
        if self.sensor == "motor":
            return 2, 1.0 / sum(self.inertias)
        stiffness = 1.0 / sum(1.0 / k for k in self.stiffnesses)
        return 4, stiffness / (self.inertias[0] * self.inertias[-1])

    def controller(self, learner: Learner | None = None, guard: Guard | None = None) -> ADRC:
        """Return the controller, with a learner and a guard."""
        return ADRC(self.observer, self.omega_c, learner=learner, guard=guard)

    @property
    def duration(self) -> float:
        """Length of a run [s]."""
        return max(_RUN_LAGS * self.observer.lag_time, _PERIODS / self.frequency)

    @property
    def load_at(self) -> float:
        """Start of the load [s]."""
        return float(np.random.default_rng(self.seed).uniform(30.0, 60.0) * self.observer.lag_time)

    def scenario(self, draw: int) -> Scenario:
        """Return load and noise; ``draw`` is the number of the draw of the noise."""
        t = DT * np.arange(round((self.load_at + self.duration) / DT) + 1, dtype=np.float64)
        since = np.maximum(t - self.load_at, 0.0)
        load = self.amplitude * np.sin(2.0 * np.pi * self.frequency * since)
        rng = np.random.default_rng([self.seed, draw])
        noise = Table(self.noise * rng.standard_normal(t.size), DT)
        return Scenario(0.0, float(t[-1]), (Table(load, DT),), noise)

    def describe(self) -> str:
        """Return what a table shows of it."""
        right = "" if self.wrong == 1.0 or self.structure == "model-free" else ", model 30 % off"
        return (
            f"{len(self.inertias)} inertias, ratio {self.inertias[-1] / self.inertias[0]:.2g}, "
            f"encoder at the {self.sensor}, {self.structure}{right}, {self.frequency:.2g} Hz, "
            f"margin {self.margin:.2f}, seed {self.seed}"
        )


def draw_axis(rng: Rng, structure: str | None = None) -> Axis:
    """Return a random axis, with an observer of the ``structure`` if it is given."""
    for _ in range(_MOST_TRIES):
        found = _slow_enough(_draw(rng, structure), rng.uniform(0.45, 0.7))
        if found is not None:
            return found
    raise ValueError(f"structure = {structure!r}: no axis with a margin was found")


def _draw(rng: Rng, structure: str | None) -> Axis:
    motor, ratio = log_uniform(rng, 1e-4, 1e-3), log_uniform(rng, 0.3, 10.0)
    load, swing = ratio * motor, 2.0 * np.pi * log_uniform(rng, 15.0, 90.0)
    stiffness = load * swing**2
    kind = str(rng.choice(STRUCTURES)) if structure is None else structure
    sensor = str(rng.choice(["motor", "load"]))
    # A design that inverts zeros without damping is refused.
    inverts = sensor == "motor" and kind != "model-free"
    damping = float(rng.choice([0.005, 0.03] if inverts else [0.0, 0.005, 0.03]))
    three = rng.random() < 0.25
    omega_c = log_uniform(rng, 30.0, 300.0)
    return Axis(
        structure=kind,
        sensor=sensor,
        inertias=(motor, 0.3 * motor, load) if three else (motor, load),
        stiffnesses=(2.0 * stiffness, stiffness) if three else (stiffness,),
        damping=2.0 * damping * math.sqrt(stiffness * load),
        wrong=float(rng.choice([1.0, 1.0, 0.7, 1.3])),
        omega_c=omega_c,
        omega_o=rng.uniform(3.0, 8.0) * omega_c,
        margin=0.0,
        frequency=log_uniform(rng, 1.0, 16.0),
        amplitude=log_uniform(rng, 0.1, 1.0),
        noise=2.0 * np.pi / 2.0 ** rng.uniform(16.0, 23.0),
        seed=int(rng.integers(2**31)),
    )


def _slow_enough(axis: Axis, margin: float) -> Axis | None:
    """Return the axis with bandwidths as large as the margin allows; None if none are."""
    while axis.omega_c > _SLOWEST:
        if axis.omega_o * DT <= _FASTEST:
            found = analyse(axis.linear, axis.controller(), delay=DT)
            if found.stable and found.margins.modulus >= margin:
                return replace(axis, margin=float(found.margins.modulus))
        axis = replace(axis, omega_c=_LOWER * axis.omega_c, omega_o=_LOWER * axis.omega_o)
    return None
