"""The paper's hardware experiment (section V) on a twin of the ECP 205 torsional testbed.

From rest the upper disk follows (π/2) sin(π t/2) for 40 s, while a learner learns; then the loop
starts from rest again, with what was learned, and follows a trapezoidal profile to π within 2 s.
The output comes from an encoder of 16 000 counts. There are two plants: *friction*, the twin with
Coulomb friction, converter and current limit, and *linear*, the transfer function that the paper
identified, behind the encoder.

The paper leaves open: the duration of the training (40 s here), the ramps of the profile (0.5 s
each), the settling band (±0.2 % of the move; settling counts from the profile's start, as in the
two-mass study), and the observers (those of that study). u is limited to the range of the drive,
and the observers get the limited u. The only random quantity is the start between two edges of the
encoder; results are medians over several starts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from quell import checks
from quell.controllers import ADRC
from quell.experiments.common.scores import METRICS, Scores, step_scores
from quell.guard import Guard
from quell.learners import Kalman
from quell.observers import ESO
from quell.plants import LinearPlant, Plant, encoded, torsional, torsional_identified
from quell.records import metrics
from quell.records.trajectory import Trajectory
from quell.signals import Sinusoid, Trapezoid
from quell.simulation.scenario import Scenario

PROFILE_AT, END = 40.0, 50.0  # start of the profile, end of the experiment [s]; see above
TARGET, MOVE_TIME, RAMP_TIME = math.pi, 2.0, 0.5
BAND = 0.002  # half width of the settling band, as a fraction of the move; see above
COUNTS = 16_000  # counts per turn of the encoder, of the paper
B0 = 5.5e4  # the paper's b0 of MF-ESO and L-ESO [rad/(V s⁴)]; the identified plant has 4.6e4
STARTS = 5  # number of starts: chosen by hand, an odd number for medians
CASES = ((90.0, 40.0), (40.0, 90.0), (20.0, 90.0))
"""omega_c and omega_o [rad/s]: the paper's, exchanged, and where the claims hold best."""

MF, MB, L = "MF-ESO", "MB-ESO", "L-ESO"
MB_OFF, LG = "MB-ESO (10 % off)", "L-ESO (guarded)"
NAMES = (MF, MB, L, MB_OFF, LG)
FRICTION, LINEAR = "friction", "linear"
PLANTS = (FRICTION, LINEAR)

# Longest sample time [s]: at 5 ms the fastest loop still works; chosen with a margin to it.
_LONGEST_DT = 2e-3
# Shortest sample time [s]: about 5 GB of records.
_SHORTEST_DT = 1e-4


@dataclass(frozen=True)
class Settings:
    """The parameters of the experiment that may be varied."""

    dt: float = 1e-3  #: sample time [s]
    seed: int = 0  #: seed of the starts between two edges of the encoder

    def __post_init__(self) -> None:
        if not _SHORTEST_DT <= checks.positive("dt", self.dt, "s") <= _LONGEST_DT:
            raise ValueError(
                f"dt = {self.dt!r}: must be from {_SHORTEST_DT:g} to {_LONGEST_DT:g} s, "
                "as the loops have up to 90 rad/s"
            )
        checks.whole("seed", self.seed, 0)


def plant(kind: str) -> Plant:
    """Return the plant with friction, or the linear one."""
    return torsional(counts=COUNTS) if kind == FRICTION else encoded(torsional_identified(), COUNTS)


def scenarios(settings: Settings, kind: str) -> list[Scenario]:
    """Return the scenario for each start; both disks are turned by the same fraction of a count."""
    training = Sinusoid(amplitude=0.5 * math.pi, omega=0.5 * math.pi)
    profile = Trapezoid(distance=TARGET, duration=MOVE_TIME, ramp_time=RAMP_TIME, start=PROFILE_AT)
    reference = training.until(PROFILE_AT, then=profile)
    scenario = Scenario(reference, duration=END, rest_at=(PROFILE_AT,))
    rest = np.array([1.0, float(kind == FRICTION), 0.0, 0.0]) * math.tau / COUNTS
    parts = np.random.default_rng(settings.seed).uniform(-0.5, 0.5, STARTS)
    return [replace(scenario, x0=part * rest) for part in parts]


def model_off(share: float = 0.1) -> LinearPlant:
    """Return the identified model with coefficients too large, and a gain too small, by a share."""
    numerator = [4.6e4 * (1.0 - share)]
    denominator = np.array([1.901, 1683.0, 1812.0, 0.1032]) * (1.0 + share)
    return LinearPlant.of((numerator, [1.0, *denominator]), name="torsional plant, not quite")


def controllers(settings: Settings, omega_c: float, omega_o: float) -> dict[str, ADRC]:
    """Return the controllers by name, with bandwidths in rad/s; the learner is not tuned."""
    free = ESO.model_free(order=4, b0=B0, omega_o=omega_o, dt=settings.dt)
    exact = ESO.model_based(torsional_identified(), omega_o=omega_o, dt=settings.dt)
    off = ESO.model_based(model_off(), omega_o=omega_o, dt=settings.dt)
    most = torsional().u_max

    def law(observer: ESO, learner: Kalman | None = None, guard: Guard | None = None) -> ADRC:
        return ADRC(observer, omega_c, learner=learner, guard=guard, u_min=-most, u_max=most)

    return {
        MF: law(free),
        MB: law(exact),
        L: law(free, Kalman()),
        MB_OFF: law(off),
        LG: law(free, Kalman(), Guard()),
    }


def score(run: Trajectory) -> Scores:
    """Return the scores over [40, 50] s; None if the run ended too early, or y did not settle.

    Overshoot (a fraction of π), settling time [s] from the profile's start, control variation [V],
    and the RMS of y − r [rad]. ``disturbance_peak`` and ``disturbance_rms`` are None: nothing but
    friction disturbs.
    """
    found: Scores = dict.fromkeys(METRICS)
    if run.ended >= END - 2 * run.dt:
        part = run.window(PROFILE_AT, END + 0.5 * run.dt)
        y = run["y"][part]
        found |= step_scores(run.t[part], y, TARGET, BAND)
        found["control_variation"] = metrics.control_variation(run["u"][part])
        found["rms_from_step"] = metrics.rms(y - run["r"][part])
    return found
