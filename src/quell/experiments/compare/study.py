"""Controllers side by side in one scenario, and the comparison that ``quell compare`` shows.

``compare(plant, controllers, scenario)`` is for any plant. ``two_mass(...)`` is that with the two-mass-spring benchmark (Wie & Bernstein
1992, the load's position measured and controlled, no friction): from rest a unit step, then a constant force on the load, with
measurement noise. All controllers are designed for m1 = m2 = k = 1, whatever the plant is.

PID control has a hard time there: between force and load lie four integrators' worth of phase. By its rules (SIMC for the rigid
body, the filter's lag as its delay) it is stable, and as slow as the table says. PI + notch can't be stable at all on a plant that is free
to move; ``pi-notch`` has a derivative part.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from quell import checks
from quell.controllers import ADRC, Controller, Prefiltered
from quell.controllers.baselines import LQG, PID, ZV, ZVD, Notch, NotchPID, ResonanceRatio
from quell.learners import Kalman
from quell.observers import ESO
from quell.parallel import in_parallel
from quell.plants import Plant, two_mass_spring
from quell.records import metrics
from quell.records.trajectory import Trajectory
from quell.signals import BandLimitedNoise, Step
from quell.simulation import Scenario, simulate

OMEGA_C, OMEGA_O = 1.0, 10.0
"""Bandwidths of all controllers that have them [rad/s]."""
RESONANCE = math.sqrt(2.0)
"""Of the nominal benchmark, free at both ends [rad/s]."""
FORCE_AT, END = 40.0, 100.0
FORCE = 0.1
"""On the load [N]: a tenth of what moves it by the step within a second."""
BAND = 0.02
_MOST_SAMPLES = 5e6


@dataclass(frozen=True)
class Comparison:
    """What ``compare`` returns.

    Attributes
    ----------
    runs
        a trajectory for each controller, by name.
    scores
        metrics for each controller, by name; None where there is no such number.
    """

    runs: dict[str, Trajectory]
    scores: dict[str, dict[str, float | None]]

    def to_json(self) -> dict[str, Any]:
        """Return scores and statuses, for programs."""
        return {
            "controllers": {
                name: {
                    **score,
                    "status": self.runs[name].status.name or "OK",
                    "diverged": self.runs[name].diverged,
                }
                for name, score in self.scores.items()
            }
        }


def compare(
    plant: Plant,
    controllers: Mapping[str, Controller],
    scenario: Scenario,
    *,
    load_at: float | None = None,
    band: float = BAND,
    record_every: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Comparison:
    """Run controllers on a plant through the same scenario, with the same noise, on all cores, and judge them.

    Parameters
    ----------
    plant, scenario
        what to run, as for ``simulate``.
    controllers
        by name, as many as you like, of any sample times.
    load_at
        from when on a disturbance is judged [s]; before, the run is judged as a step from its first value to the reference's last before.
        By default there is no such time: the whole run is the step.
    band
        half width of the settling band, as a fraction of the step.
    record_every
        as for ``simulate``; with more than 1 there is no control variation.
    progress
        called with the share done.

    Returns
    -------
    Comparison
        with ``overshoot`` (fraction), ``settling_time`` [s], ``disturbance_peak`` (largest ``|r − y|`` from ``load_at`` on) and ``rms``
        of r − y over the whole run [y-unit], and ``control_variation`` over the whole run [u-unit].

    Raises
    ------
    ValueError
        where there is no controller, or an argument is out of range.

    Examples
    --------
    >>> from quell.controllers.baselines import PID
    >>> from quell.plants import LinearPlant
    >>> lag = LinearPlant([[-1.0]], [1.0], [1.0])
    >>> result = compare(lag, {"PI": PID(kp=4.0, ki=4.0, dt=0.01)}, Scenario(reference=1.0, duration=5.0))
    >>> round(result.scores["PI"]["settling_time"], 2)
    0.96
    """
    if not controllers:
        raise ValueError("controllers is empty: must have at least one, as {name: controller}")
    checks.positive("band", band)
    if load_at is not None and not 0.0 < checks.finite("load_at", load_at) < scenario.duration:
        raise ValueError(
            f"load_at = {load_at!r}: must lie within (0, duration = {scenario.duration!r})"
        )
    jobs = [
        partial(simulate, plant, controller, scenario, record_every=record_every)
        for controller in controllers.values()
    ]
    runs = dict(zip(controllers, in_parallel(jobs, progress), strict=True))
    return Comparison(
        runs, {name: score(run, scenario.duration, load_at, band) for name, run in runs.items()}
    )


def score(
    run: Trajectory, duration: float, load_at: float | None = None, band: float = BAND
) -> dict[str, float | None]:
    """Judge one run; see ``compare``. None where it did not get that far, or y not into its band."""
    found: dict[str, float | None] = dict.fromkeys(
        ("overshoot", "settling_time", "disturbance_peak", "rms", "control_variation")
    )
    step_ends = duration if load_at is None else load_at
    t, y, r = run.t, run["y"], run["r"]
    if run.ended >= step_ends - 2.0 * run.dt:
        part = run.window(0.0, math.inf if load_at is None else load_at)
        target, initial = float(r[part][-1]), float(y[0])
        if target != initial:
            settling = metrics.settling_time(t[part], y[part], target, band, initial)
            found["overshoot"] = metrics.overshoot(y[part], target, initial)
            found["settling_time"] = None if math.isnan(settling) else settling
    if not run.diverged:
        error = r - y
        if load_at is not None:
            found["disturbance_peak"] = metrics.peak(error[run.window(load_at, math.inf)])
        found["rms"] = metrics.rms(error)
        if run.every == 1:
            found["control_variation"] = metrics.control_variation(run["u"])
    return found


@dataclass(frozen=True)
class Benchmark:
    """The plant as it really is, and what the controllers may do.

    Parameters
    ----------
    m1, m2, k
        masses [kg] and stiffness [N/m].
    dt
        sample time [s].
    u_max
        limit of the control force, either way [N].
    seed
        of the measurement noise.

    Raises
    ------
    ValueError
        for a value that no comparison can be made with.
    """

    m1: float = 1.0
    m2: float = 1.0
    k: float = 1.0
    dt: float = 1e-3
    u_max: float = math.inf
    seed: int = 0

    def __post_init__(self) -> None:
        if checks.positive("dt", self.dt, "s") > 0.1:
            raise ValueError(
                f"dt = {self.dt!r}: must be at most 0.1 s, the observers' bandwidth is {OMEGA_O:g} rad/s"
            )
        if END / self.dt > _MOST_SAMPLES:
            raise ValueError(
                f"dt = {self.dt!r}: must be at least {END / _MOST_SAMPLES:g} s, or the records do not fit in memory"
            )
        if not self.u_max > 0.0:
            raise ValueError(f"u_max = {self.u_max!r}: must be greater than zero [N], inf for none")
        checks.whole("seed", self.seed, 0)
        two_mass_spring(self.m1, self.m2, self.k)


def scenario(settings: Benchmark) -> Scenario:
    """Return the benchmark's scenario: a unit step from rest, a constant force on the load from ``FORCE_AT`` on, noise."""
    return Scenario(
        reference=1.0,
        disturbances=(0.0, Step(at=FORCE_AT, height=FORCE)),
        noise=BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=END,
        seed=settings.seed,
    )


def controller(name: str, dt: float, u_max: float = math.inf) -> Any:
    """Return one of the benchmark's controllers, designed for m1 = m2 = k = 1.

    Parameters
    ----------
    name
        one of ``NAMES``, with ``zv+`` or ``zvd+`` before it to shape the reference for the plant's resonance.
    dt
        sample time [s].
    u_max
        limit of the control force, either way [N].

    Raises
    ------
    ValueError
        for an unknown name; the message lists the known ones.
    """
    *shapers, base = name.split("+")
    if (
        base not in _DESIGNS
        or len(shapers) > 1
        or any(shaper not in _SHAPERS for shaper in shapers)
    ):
        raise ValueError(
            f"controllers: {name!r} must be one of {', '.join(NAMES)}, or zv+ or zvd+ and one of these, as zv+pid"
        )
    made = _DESIGNS[base](dt, {"u_min": -u_max, "u_max": u_max})
    return Prefiltered(made, _SHAPERS[shapers[0]](RESONANCE)) if shapers else made


def two_mass(
    settings: Benchmark, names: Sequence[str], progress: Callable[[float], None] | None = None
) -> Comparison:
    """Run the benchmark's comparison: the controllers of these names on the plant of ``settings``.

    Raises
    ------
    ValueError
        for an unknown name.
    """
    made = {name: controller(name, settings.dt, settings.u_max) for name in names}
    plant = two_mass_spring(settings.m1, settings.m2, settings.k)
    return compare(plant, made, scenario(settings), load_at=FORCE_AT, progress=progress)


def _pid(dt: float, limits: dict[str, Any]) -> PID:
    # The filter is slow enough to lag by more at the resonance than the derivative leads: that damps it (phase stabilisation).
    tf = 2.0 * math.sqrt(2.0) / RESONANCE
    return PID.simc_double_integrator(0.5, tf, tau_c=0.5 * tf, dt=dt, tf=tf, b=0.6, **limits)


def _notch_pid(dt: float, limits: dict[str, Any]) -> NotchPID:
    # Above the resonance, where it lags: on it, a notch would take the resonance out of the loop and never damp it.
    notch, tf = Notch.at(1.5 * RESONANCE), math.sqrt(2.0) / RESONANCE
    tuned = PID.simc_double_integrator(0.5, tf + notch.delay, tau_c=tf, dt=dt)
    return NotchPID(notch, tuned.kp, tuned.ki, tuned.kd, tf=tf, b=0.6, dt=dt, **limits)


def _model_free(dt: float) -> ESO:
    return ESO.model_free(order=4, b0=1.0, omega_o=OMEGA_O, dt=dt)


_DESIGNS: Mapping[str, Callable[[float, dict[str, Any]], Any]] = {
    "mf-eso": lambda dt, limits: ADRC(_model_free(dt), OMEGA_C, **limits),
    "mb-eso": lambda dt, limits: ADRC(
        ESO.model_based(two_mass_spring(), OMEGA_O, dt), OMEGA_C, **limits
    ),
    "l-eso": lambda dt, limits: ADRC(_model_free(dt), OMEGA_C, learner=Kalman(), **limits),
    "pid": _pid,
    "pi-notch": _notch_pid,
    "lqg": lambda dt, limits: LQG(two_mass_spring(), OMEGA_C, OMEGA_O, dt, **limits),
    "resonance-ratio": lambda dt, limits: ResonanceRatio(omega_o=OMEGA_O, dt=dt, **limits),
}
_SHAPERS = {"zv": ZV, "zvd": ZVD}
NAMES = tuple(_DESIGNS)
"""The benchmark's controllers."""
