"""The paper's simulation study (section IV) on the two-mass-spring benchmark.

From rest the output follows sin t for 110 s, while a learner learns; then the loop starts from rest
again, with what was learned, and follows a unit step. From 150 s a force sin(π(t − 150)/10) N acts
on m2. The paper leaves open the start from rest, the settling band of 0.2 %, the force's amplitude
and the observer's discretisation. They are chosen here to reproduce the paper's figures;
docs/theory describes how.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from quell import checks
from quell.analysis.loop import analyse
from quell.controllers import ADRC
from quell.experiments.common.scores import METRICS, Scores, step_scores
from quell.guard import Guard
from quell.learners import BatchGradient, Harmonic, Kalman, Learner
from quell.observers import ESO
from quell.plants import two_mass_spring
from quell.records import metrics
from quell.records.trajectory import Trajectory
from quell.signals import BandLimitedNoise, Constant, Sinusoid, Step
from quell.simulation import Scenario, simulate

STEP_AT, FORCE_AT, END = 110.0, 150.0, 250.0
"""Start of the step and of the force, end of the study [s], of the paper."""
STEP_WINDOW = (STEP_AT, FORCE_AT)
FORCE_WINDOW = (170.0, END)
"""Time in which the force is scored [s], from the start of the paper's second zoom on."""
BAND = 0.002
"""Half width of the settling band, as a fraction of the step: gives the paper's settling times."""

MF, MB, L, L1 = "MF-ESO", "MB-ESO", "L-ESO", "L-ESO (Algorithm 1)"
MF3, MB3 = "MF-ESO (3x bandwidth)", "MB-ESO (3x bandwidth)"
MF_2, MB_2 = "MF-ESO m = 2", "MB-ESO m = 2"
"""With two extended states, f and f', at ``TWO_STATES`` times the bandwidth: not in the paper."""
GUARDED = "L-ESO, guarded"
NAMES = (MF, MB, L, L1, MF3, MB3, MF_2, MB_2, GUARDED)
STATE, BIAS = "L-ESO, state only", "L-ESO, bias only"
HARMONIC, HARMONIC_GUARDED = "L-ESO, Harmonic", "L-ESO, Harmonic, guarded"
NO_BIAS = "L-ESO, Harmonic without bias, guarded"
L1_NO_U = "L-ESO (Algorithm 1 without u)"
MF_3, MB_3 = "MF-ESO m = 3", "MB-ESO m = 3"
"""With f, f' and f'', at ``THREE_STATES`` times the bandwidth."""

TWO_STATES, THREE_STATES = 0.75, 0.6
"""At these shares of omega_o MF-ESO with f' or f'' rejects the paper's force as L-ESO does, or
better, with about as much noise in u as MF-ESO."""
PAPERS_LOAD = 0.1 * math.pi
"""Frequency of the paper's force [rad/s]."""
LOADS = (0.1, PAPERS_LOAD, 0.8)
"""Frequencies of the force in the ranges [rad/s]: a third of the paper's, it, and 2.5 times it."""
# About 5 GB of records.
_MOST_SAMPLES = 5e6
GRADIENT_RATE = 0.01
"""Algorithm 1's rate · batch / dt [1/s]: it is stable below about 0.015/s (docs/theory)."""
GRADIENT_BATCH = 10
"""Samples in a batch of Algorithm 1: chosen by hand; the stable range does not depend on it."""
RATE_WITHOUT_U = 1.0
"""Its rate · batch / dt [1/s] without u among the features; at 3/s it still runs to the end."""


@dataclass(frozen=True)
class Settings:
    """The parameters of the study that may be varied."""

    dt: float = 1e-3  #: sample time [s]
    seed: int = 0  #: seed of the measurement noise
    omega_o: float = 10.0  #: observer bandwidth [rad/s]
    omega_c: float = 1.0  #: controller bandwidth [rad/s]
    reset: bool = True  #: whether the loop starts from rest at 110 s
    seeds: int = 1  #: number of seeds, from ``seed`` on, of ``Result.ranges``; none with 1

    def __post_init__(self) -> None:
        if checks.positive("dt", self.dt, "s") > 1.0:
            raise ValueError(f"dt = {self.dt!r}: must be at most 1 s")
        if END / self.dt > _MOST_SAMPLES:
            raise ValueError(
                f"dt = {self.dt!r}: must be at least {END / _MOST_SAMPLES:g} s, "
                "or eight whole records do not fit in memory"
            )
        checks.whole("seed", self.seed, 0)
        checks.whole("seeds", self.seeds, 1, 1000)
        checks.positive("omega_o", self.omega_o, "rad/s")
        checks.positive("omega_c", self.omega_c, "rad/s")


def scenario(settings: Settings, load: float = PAPERS_LOAD) -> Scenario:
    """Return the paper's scenario, with a force of the frequency ``load`` [rad/s]."""
    return Scenario(
        reference=Sinusoid(amplitude=1.0, omega=1.0).until(STEP_AT, then=Step(at=STEP_AT)),
        disturbances=(Constant(0.0), Sinusoid(amplitude=1.0, omega=load, start=FORCE_AT)),
        noise=BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=END,
        rest_at=(STEP_AT,) if settings.reset else (),
        seed=settings.seed,
    )


def gradient_rate(settings: Settings) -> float:
    """Return Algorithm 1's learning rate per sample; per second it is independent of dt."""
    return GRADIENT_RATE * settings.dt / GRADIENT_BATCH


def controllers(settings: Settings) -> dict[str, ADRC]:
    """Return the controllers ``NAMES`` by name."""
    return {
        MF: controller(settings),
        MB: controller(settings, model=True),
        L: controller(settings, learner=Kalman()),
        L1: controller(
            settings, learner=BatchGradient(rate=gradient_rate(settings), batch=GRADIENT_BATCH)
        ),
        MF3: controller(settings, bandwidth=3.0),
        MB3: controller(settings, bandwidth=3.0, model=True),
        MF_2: controller(settings, bandwidth=TWO_STATES, disturbance_order=2),
        MB_2: controller(settings, bandwidth=TWO_STATES, disturbance_order=2, model=True),
        GUARDED: controller(settings, learner=Kalman(), guard=True),
    }


def further_controllers(settings: Settings) -> dict[str, ADRC]:
    """Return those that stand in the ranges only: each needs a loop of its own to be compiled."""
    rate = RATE_WITHOUT_U * settings.dt / GRADIENT_BATCH
    three: dict[str, Any] = {"bandwidth": THREE_STATES, "disturbance_order": 3}
    return {
        MF_3: controller(settings, **three),
        MB_3: controller(settings, **three, model=True),
        STATE: controller(settings, learner=Kalman(bias=False)),
        BIAS: controller(settings, learner=Kalman(state=False)),
        HARMONIC: controller(settings, learner=Harmonic()),
        HARMONIC_GUARDED: controller(settings, learner=Harmonic(), guard=True),
        NO_BIAS: controller(settings, learner=Harmonic(bias=False), guard=True),
        L1_NO_U: controller(
            settings, learner=BatchGradient(rate=rate, batch=GRADIENT_BATCH, u=False)
        ),
    }


def controller(
    settings: Settings,
    *,
    model: bool = False,
    learner: Learner | None = None,
    guard: bool = False,
    bandwidth: float = 1.0,
    disturbance_order: int = 1,
) -> ADRC:
    """Return one controller; ``bandwidth`` multiplies ``omega_o``."""
    omega_o = bandwidth * settings.omega_o
    dt, m = settings.dt, disturbance_order
    observer = ESO.model_free(4, 1.0, omega_o, dt, disturbance_order=m)
    if model:
        observer = ESO.model_based(two_mass_spring(), omega_o, dt, disturbance_order=m)
    return ADRC(observer, settings.omega_c, learner=learner, guard=Guard() if guard else None)


def score(run: Trajectory) -> Scores:
    """Return the study's scores; None if the run ended too early, or y did not settle.

    Overshoot (a fraction), settling time [s] and control variation [N] are those of the step over
    [110, 150) s; peak and RMS of y − 1 [m] are those under the force over [170, 250] s;
    ``rms_from_step`` is the RMS over [110, 250] s.
    """
    found: Scores = dict.fromkeys(METRICS)
    t, y = run.t, run["y"]
    if run.ended >= FORCE_AT - 2 * run.dt:
        part = run.window(*STEP_WINDOW)
        found |= step_scores(t[part], y[part], 1.0, BAND)
        found["control_variation"] = metrics.control_variation(run["u"][part])
    if run.ended >= END - 2 * run.dt:
        after = END + 0.5 * run.dt
        forced = y[run.window(FORCE_WINDOW[0], after)] - 1.0
        found["disturbance_peak"] = metrics.peak(forced)
        found["disturbance_rms"] = metrics.rms(forced)
        found["rms_from_step"] = metrics.rms(y[run.window(STEP_AT, after)] - 1.0)
    return found


def margins(law: ADRC, run: Trajectory) -> Scores:
    """Return M_s and M_ks [N/m] of the loop at the end of a run, its learner's adaptation included.

    None for a run that diverged, and for a loop that is not stable at rest.
    """
    loop = None if run.diverged else analyse(two_mass_spring(), law, at=run)
    if loop is None or not loop.stable:
        return {"m_s": None, "m_ks": None}
    return {"m_s": 1.0 / loop.margins.modulus, "m_ks": loop.noise_to_control_peak}


def quick_run(settings: Settings, candidate: ADRC, load: float = PAPERS_LOAD) -> Trajectory:
    """Run the scenario and record every 10 ms, which is enough for peaks."""
    every = max(round(0.01 / settings.dt), 1)
    return simulate(two_mass_spring(), candidate, scenario(settings, load), record_every=every)
