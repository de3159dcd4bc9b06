"""The paper's hardware experiment (section V) on the twin: the ECP 205 torsional testbed under MF-ESO, MB-ESO and L-ESO.

From rest the upper disk follows (π/2) sin(π t/2) for 40 s, in which a learner learns; then the loop starts from rest again, with what
was learned, and follows a trapezoidal profile to π within 2 s. The output is what an encoder of 16 000 counts counts. Two plants:
*friction*, the twin with Coulomb friction, converter and current limit, and *linear*, the transfer function that the paper identified,
behind the encoder.

What the paper leaves open: the training takes 40 s; the profile speeds up and brakes for 0.5 s each; the settling band is ±0.2 % of the
move, and settling is counted from the profile's start, as in the two-mass study; the observers are those of that study too. u is limited to
what the drive can do, and the observers are told. A run's only chance is where between two edges of the encoder it starts; so there are
several, and figures are medians of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from quell import checks
from quell.controllers import ADRC
from quell.guard import Guard
from quell.learners import Kalman
from quell.observers import ESO
from quell.plants import LinearPlant, Plant, encoded, torsional, torsional_identified
from quell.records import metrics
from quell.records.trajectory import Trajectory
from quell.signals import Sinusoid, Trapezoid
from quell.simulation.scenario import Scenario

PROFILE_AT, END = 40.0, 50.0
TARGET, MOVE_TIME, RAMP_TIME = math.pi, 2.0, 0.5
BAND = 0.002
COUNTS = 16_000
B0 = 5.5e4
STARTS = 5
# omega_c and omega_o [rad/s]: as the paper has them, the other way round, and where the claims hold best.
CASES = ((90.0, 40.0), (40.0, 90.0), (20.0, 90.0))

MF, MB, L = "MF-ESO", "MB-ESO", "L-ESO"
MB_OFF, LG = "MB-ESO (10 % off)", "L-ESO (guarded)"
NAMES = (MF, MB, L, MB_OFF, LG)
FRICTION, LINEAR = "friction", "linear"
PLANTS = (FRICTION, LINEAR)

# At 5 ms the fastest of the loops is still one.
_LONGEST_DT = 2e-3
# About 5 GB of records.
_SHORTEST_DT = 1e-4


@dataclass(frozen=True)
class Settings:
    """What may be varied.

    Parameters
    ----------
    dt
        sample time [s].
    seed
        of where the runs start, between two edges of the encoder.

    Raises
    ------
    ValueError
        for a value that no experiment can be made with.
    """

    dt: float = 1e-3
    seed: int = 0

    def __post_init__(self) -> None:
        if not _SHORTEST_DT <= checks.positive("dt", self.dt, "s") <= _LONGEST_DT:
            raise ValueError(
                f"dt = {self.dt!r}: must be from {_SHORTEST_DT:g} to {_LONGEST_DT:g} s, as the loops have up to 90 rad/s"
            )
        checks.whole("seed", self.seed, 0)


def plant(kind: str) -> Plant:
    """Return the plant with friction, or the linear one."""
    return torsional(counts=COUNTS) if kind == FRICTION else encoded(torsional_identified(), COUNTS)


def scenarios(settings: Settings, kind: str) -> list[Scenario]:
    """Return the experiment once for each start: both disks turned by the same part of a count."""
    training = Sinusoid(amplitude=0.5 * math.pi, omega=0.5 * math.pi)
    profile = Trapezoid(distance=TARGET, duration=MOVE_TIME, ramp_time=RAMP_TIME, start=PROFILE_AT)
    what = Scenario(
        reference=training.until(PROFILE_AT, then=profile), duration=END, rest_at=(PROFILE_AT,)
    )
    rest = np.array([1.0, float(kind == FRICTION), 0.0, 0.0]) * math.tau / COUNTS
    parts = np.random.default_rng(settings.seed).uniform(-0.5, 0.5, STARTS)
    return [replace(what, x0=part * rest) for part in parts]


def model_off(share: float = 0.1) -> LinearPlant:
    """Return the identified model with coefficients too large by a share, and a gain too small by it."""
    numerator, denominator = (
        [4.6e4 * (1.0 - share)],
        np.array([1.901, 1683.0, 1812.0, 0.1032]) * (1.0 + share),
    )
    return LinearPlant.of((numerator, [1.0, *denominator]), name="torsional plant, not quite")


def controllers(settings: Settings, omega_c: float, omega_o: float) -> dict[str, ADRC]:
    """Return the controllers by name, with bandwidths in rad/s; there is one learner for all cases, ``Kalman()``, with nothing tuned."""
    free = ESO.model_free(order=4, b0=B0, omega_o=omega_o, dt=settings.dt)
    exact, off = (
        ESO.model_based(model, omega_o=omega_o, dt=settings.dt)
        for model in (torsional_identified(), model_off())
    )
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


def score(run: Trajectory) -> dict[str, float | None]:
    """Return the metrics of the profile, over [40, 50] s; None where the run did not get there, or y not into its band.

    Overshoot (a fraction of π), settling time [s] from the profile's start, control variation [V], and the RMS of y − r [rad].
    ``disturbance_peak`` and ``disturbance_rms`` are None: nothing but friction disturbs.
    """
    found: dict[str, float | None] = dict.fromkeys(
        (
            "overshoot",
            "settling_time",
            "disturbance_peak",
            "disturbance_rms",
            "control_variation",
            "rms_from_step",
        )
    )
    if run.ended < END - 2 * run.dt:
        return found
    part = run.window(PROFILE_AT, END + 0.5 * run.dt)
    t, y = run.t[part], run["y"][part]
    settling = metrics.settling_time(t, y, TARGET, BAND)
    return found | {
        "overshoot": metrics.overshoot(y, TARGET),
        "settling_time": None if math.isnan(settling) else settling,
        "control_variation": metrics.control_variation(run["u"][part]),
        "rms_from_step": metrics.rms(y - run["r"][part]),
    }
