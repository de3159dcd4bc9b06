"""The comparison that ``quell compare`` shows: controllers on the two-mass-spring benchmark.

The benchmark is that of Wie & Bernstein (1992) without friction; the load's position is measured
and controlled. From rest there is a unit step, then a constant force on the load, with measurement
noise. All controllers are designed for m1 = m2 = k = 1, whatever the plant is. Those of ``NAMES``
have fixed designs by published rules; ``tuned_controllers`` are optimal under the same constraints.

This plant is hard for a PID controller: between force and load there is the phase of four
integrators. Tuned by SIMC for the rigid body, with the filter's lag as its delay, it is stable and
slow. PI control with a notch can't be stable on a plant that is free to move; ``pi-notch`` has a
derivative part.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from quell import checks
from quell.controllers import ADRC, Controller, Prefiltered
from quell.controllers.baselines import LQG, PID, ZV, ZVD, Notch, NotchPID, ResonanceRatio
from quell.experiments.compare.study import Comparison, compare
from quell.experiments.compare.tuned import Entry, sensitivities, tuned
from quell.guard import Guard
from quell.learners import Kalman
from quell.observers import ESO
from quell.plants import two_mass_spring
from quell.signals import BandLimitedNoise, Step
from quell.simulation import Scenario
from quell.tuning import Constraints
from quell.types import Progress

OMEGA_C, OMEGA_O = 1.0, 10.0
"""Bandwidths of all controllers that have them [rad/s]: those of the paper's simulation study."""
RESONANCE = math.sqrt(2.0)
"""Resonance of the nominal plant, free at both ends [rad/s]: √(k/m1 + k/m2)."""
FORCE_AT, END = 40.0, 100.0  # start of the constant force, end of the scenario [s]: chosen by hand
FORCE = 0.1  # force on the load [N]: a tenth of the force that moves it by the step within a second
# Longest sample time [s]: omega_o dt = 1 with the bandwidth above.
_LONGEST_DT = 0.1
# Largest |p| dt of poles of tuned observers and filters: sampling costs margin beyond.
_POLES_DT = 0.5
# About 1 GB of records for each controller.
_MOST_SAMPLES = 5e6


@dataclass(frozen=True)
class Benchmark:
    """The real plant, and the limits of the controllers."""

    m1: float = 1.0  #: mass that is pushed [kg]
    m2: float = 1.0  #: mass that is measured [kg]
    k: float = 1.0  #: stiffness [N/m]
    dt: float = 1e-3  #: sample time [s]
    u_max: float = math.inf  #: limit of the control force, in both directions [N]
    seed: int = 0  #: seed of the measurement noise

    def __post_init__(self) -> None:
        if checks.positive("dt", self.dt, "s") > _LONGEST_DT:
            raise ValueError(
                f"dt = {self.dt!r}: must be at most {_LONGEST_DT:g} s, "
                f"the observers' bandwidth is {OMEGA_O:g} rad/s"
            )
        if END / self.dt > _MOST_SAMPLES:
            raise ValueError(
                f"dt = {self.dt!r}: must be at least {END / _MOST_SAMPLES:g} s, "
                "or the records do not fit in memory"
            )
        if not self.u_max > 0.0:
            raise ValueError(f"u_max = {self.u_max!r}: must be greater than zero [N], inf for none")
        checks.whole("seed", self.seed, 0)
        two_mass_spring(self.m1, self.m2, self.k).sampled(self.dt)


def scenario(settings: Benchmark) -> Scenario:
    """Return the scenario: a unit step from rest, a force from ``FORCE_AT`` on, noise."""
    return Scenario(
        reference=1.0,
        disturbances=(0.0, Step(at=FORCE_AT, height=FORCE)),
        noise=BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=END,
        seed=settings.seed,
    )


def controller(name: str, dt: float, u_max: float = math.inf) -> Controller:
    """Return one of the benchmark's controllers, designed for m1 = m2 = k = 1 and ``|u| <= u_max``.

    ``name`` is one of ``NAMES``, with ``zv+`` or ``zvd+`` before it to shape the reference for the
    plant's resonance. The message for an unknown name lists the known ones.
    """
    *shapers, base = name.split("+")
    if base not in _DESIGNS or len(shapers) > 1 or not set(shapers) <= set(_SHAPERS):
        raise ValueError(
            f"controllers: {name!r} must be one of {', '.join(NAMES)}, "
            "or zv+ or zvd+ and one of these, as zv+pid"
        )
    design = _DESIGNS[base](dt, {"u_min": -u_max, "u_max": u_max})
    return Prefiltered(design, _SHAPERS[shapers[0]](RESONANCE)) if shapers else design


def tuned_controllers(
    names: Sequence[str], dt: float, u_max: float = math.inf, progress: Progress | None = None
) -> tuple[dict[str, Entry], Constraints]:
    """Tune controllers (``compare.STRUCTURES``) for m1 = m2 = k = 1 as robustly as ``mf-eso``.

    M_s, M_t and M_ks are bounded by those of ``mf-eso``.
    """
    plant = two_mass_spring()
    ours = sensitivities(plant, controller("mf-eso", dt))
    assert ours is not None
    measured = {"m_s": ours.m_s, "m_t": ours.m_t, "m_ks": ours.m_ks}
    bounds = Constraints(**measured, damping=None, omega_o_dt=_POLES_DT)
    limits = {"u_min": -u_max, "u_max": u_max}
    return tuned(plant, dt, names, bounds, order=4, limits=limits, progress=progress)


def two_mass(
    settings: Benchmark,
    names: Sequence[str],
    progress: Callable[[float], None] | None = None,
    more: Mapping[str, Controller] | None = None,
) -> Comparison:
    """Run the controllers ``names``, and ``more``, on the plant of ``settings``."""
    controllers = {name: controller(name, settings.dt, settings.u_max) for name in names}
    controllers |= more or {}
    plant = two_mass_spring(settings.m1, settings.m2, settings.k)
    return compare(plant, controllers, scenario(settings), load_at=FORCE_AT, progress=progress)


def _pid(dt: float, limits: dict[str, Any]) -> PID:
    # The slow filter lags at the resonance by more than the derivative leads, which damps it (phase
    # stabilisation).
    tf = 2.0 * math.sqrt(2.0) / RESONANCE
    return PID.simc_double_integrator(0.5, tf, tau_c=0.5 * tf, dt=dt, tf=tf, b=0.6, **limits)


def _notch_pid(dt: float, limits: dict[str, Any]) -> NotchPID:
    # Above the resonance, where the notch lags. At the resonance it would take the resonance out of
    # the loop, undamped.
    notch, tf = Notch.at(1.5 * RESONANCE), math.sqrt(2.0) / RESONANCE
    tuned = PID.simc_double_integrator(0.5, tf + notch.delay, tau_c=tf, dt=dt)
    return NotchPID(notch, tuned.kp, tuned.ki, tuned.kd, tf=tf, b=0.6, dt=dt, **limits)


def _model_free(dt: float) -> ESO:
    return ESO.model_free(order=4, b0=1.0, omega_o=OMEGA_O, dt=dt)


_DESIGNS: Mapping[str, Callable[[float, dict[str, Any]], Controller]] = {
    "mf-eso": lambda dt, limits: ADRC(_model_free(dt), OMEGA_C, **limits),
    "mb-eso": lambda dt, limits: ADRC(
        ESO.model_based(two_mass_spring(), OMEGA_O, dt), OMEGA_C, **limits
    ),
    "l-eso": lambda dt, limits: ADRC(_model_free(dt), OMEGA_C, learner=Kalman(), **limits),
    "guarded-l-eso": lambda dt, limits: ADRC(
        _model_free(dt), OMEGA_C, learner=Kalman(), guard=Guard(), **limits
    ),
    "pid": _pid,
    "pi-notch": _notch_pid,
    "lqg": lambda dt, limits: LQG(two_mass_spring(), OMEGA_C, OMEGA_O, dt, **limits),
    "resonance-ratio": lambda dt, limits: ResonanceRatio(omega_o=OMEGA_O, dt=dt, **limits),
}
_SHAPERS = {"zv": ZV, "zvd": ZVD}
NAMES = tuple(_DESIGNS)  # the benchmark's controllers
