"""Controllers side by side: tuned under equal constraints, on a benchmark or for a setup.

Controllers for a comparison, each tuned for the best load rejection under the same constraints.

``quell.tuning`` maximises the integral gain of each structure. A PID controller whose integral gain
is the largest may ring for long; it is tuned for the least integral of ``|y|`` after a step of the
load instead, which suits it better. The reference does not enter the constraints, so each
controller then gets the reference model, a lag of second order, with which its step settles soonest
without more overshoot than the settling band allows; or none.

The comparison that ``quell compare`` shows: controllers on the two-mass-spring benchmark.

The benchmark is that of Wie & Bernstein (1992) without friction; the load's position is measured
and controlled. From rest there is a unit step, then a constant force on the load, with measurement
noise. All controllers are designed for m1 = m2 = k = 1, whatever the plant is. Those of ``NAMES``
have fixed designs by published rules; ``tuned_controllers`` are optimal under the same constraints.

This plant is hard for a PID controller: between force and load there is the phase of four
integrators. Tuned by SIMC for the rigid body, with the filter's lag as its delay, it is stable and
slow. PI control with a notch can't be stable on a plant that is free to move; ``pi-notch`` has a
derivative part.

The comparison of a setup: its own controller, and tuned ones for its plant, in its scenario.

The figure of a comparison: output and control signal of each controller.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quell import checks
from quell.analysis import LoopAnalysis, analyse
from quell.analysis.margins import least
from quell.controllers import (
    ADRC,
    Compensated,
    Compensator,
    Controller,
    Prefiltered,
    ReferenceModel,
)
from quell.controllers.base import check_controller
from quell.controllers.baselines import EI, LQG, MZV, PID, ZV, ZVD, Notch, NotchPID, ResonanceRatio
from quell.controllers.prefilters import without_prefilters
from quell.experiments.common import Scores, check_sample_times, save_figures, step_scores
from quell.guard import Guard
from quell.learners import Kalman
from quell.observers import ESO
from quell.parallel import in_parallel, one_blas_thread
from quell.plants import Plant, two_mass_spring
from quell.plants.base import Flow, PlantWrapper, one_at_a_time
from quell.plants.linear import EncodedPlant, delayed
from quell.plants.linearise import linear_model, linear_part
from quell.records import metrics
from quell.records.plotting import draw_line, given_axes, grid_of_axes, new_figure
from quell.records.trajectory import Trajectory
from quell.setup.loading import Setup, varied
from quell.signals import BandLimitedNoise, Step
from quell.simulation import Scenario, simulate
from quell.tuning import Constraints
from quell.tuning.designs import Task, tuned_designs, with_noise_bound
from quell.tuning.optimiser.loops import Inputs
from quell.tuning.plants import Given, given_plants, model_of, plant_set
from quell.tuning.report import Design
from quell.tuning.structures.registry import make_structure
from quell.types import Matrix, Progress, Vector

# ---- Controllers for a comparison ----

STRUCTURES = {
    "tuned-pid": "pid",
    "tuned-lqg": "lqg",
    "tuned-p-pi-notch": "p-pi-notch",
    "tuned-bandwidths": "bandwidths",
    "tuned-poles": "poles",
    "tuned-mb-eso": "model-based",
}
"""Structures of ``quell.tuning`` by their names in a comparison."""

# Bandwidths of the reference model that are tried, over the crossover frequency of the loop, and
# their number; samples of the step response on which they are judged. Chosen by hand.
_SLOWEST, _FASTEST, _TRIED = 0.05, 10.0, 60
_SAMPLES = 40_000
# Longest sample time at which a PID controller, with four times in seconds as its parameters, is
# tuned, in units of the time of one radian at the crossover, and duration of the load response in
# the same units: responses of 4000 samples. Chosen by hand.
_PID_DT, _PID_LASTS = 0.025, 100.0
# Bounds for it in units of the given ones: the longer samples shift M_t of two masses by 2.3 %.
_PID_BOUNDS = 0.97
# Frequency at which k_i is read, in units of the slowest closed-loop pole: its error is the square.
_LOW = 1e-3


@dataclass(frozen=True)
class Sensitivities:
    """Largest gains of a linear loop, and its integral gain."""

    m_s: float  #: largest ``|S|``
    m_t: float  #: largest ``|T|``
    m_ks: float  #: largest gain from y to u [u-unit/y-unit]
    k_i: float  #: u per integral of y, for a constant load; infinite with two integrators


@dataclass(frozen=True)
class Entry:
    """A tuned controller, or the reason why there is none."""

    structure: str
    controller: Controller | None
    values: Mapping[str, float]
    reason: str = ""


def sensitivities(plant: Any, controller: Controller) -> Sensitivities | None:
    """Return the largest gains of a stable linear loop; None for another one."""
    controller = without_prefilters(controller)
    if controller.features:
        return None
    loop = analyse(plant, controller)
    return of_loop(loop) if loop.stable else None


def of_loop(loop: LoopAnalysis) -> Sensitivities:
    """Return the largest gains of a stable loop."""

    def inverse(omega: Vector) -> Vector:
        return 1.0 / np.abs(loop.response("T", omega))

    smallest, _ = least(inverse, loop.omega, inverse(loop.omega))
    low = _LOW * float(np.min(np.abs(loop.s_poles)))
    k_i, lower = (
        omega / abs(complex(loop.response("PS", [omega])[0])) for omega in (low, 0.5 * low)
    )
    return Sensitivities(
        m_s=1.0 / loop.margins.modulus,
        m_t=1.0 / smallest,
        m_ks=loop.noise_to_control_peak,
        k_i=math.inf if lower > 1.5 * k_i else k_i,  # twice as large with two integrators
    )


def tuned(
    plant: Any,
    dt: float,
    names: Sequence[str],
    constraints: Constraints,
    *,
    order: int | None = None,
    limits: Mapping[str, Any] | None = None,
    delay: Any = 0.0,
    progress: Progress | None = None,
) -> tuple[dict[str, Entry], Constraints]:
    """Tune structures for a linear plant; return them by name, and the constraints.

    Parameters
    ----------
    plant, delay
        as for ``quell.tune``: also a list of plants, the nominal one first, and their delays [s].
    dt
        sample time [s].
    names
        of ``STRUCTURES``.
    constraints
        the bounds; without one of the noise M_ks may be ten times that of the optimal PI.
    order
        order of ADRC without model; by default 1 or 2, or the plant's relative degree if that is
        higher.
    limits
        ``u_min``, ``u_max``, ``rate_limit``.
    progress
        called with the structure and the share done.
    """
    report = progress or (lambda part, share: None)
    given = given_plants(plant, dt, delay=delay)
    plants = plant_set(given, dt)
    order = given.degree if order is None and given.degree > 2 else order
    inputs = Inputs(np.zeros(10), np.ones(10))  # not used by the objective "load"
    model = model_of(given, plants, constraints)
    task = Task(plants, model, constraints, "load", inputs, 1.0, order, limits or {})
    entries = {}
    with one_blas_thread():
        task, _ = with_noise_bound(task)
        chosen = {name: STRUCTURES[name] for name in names}
        designs = tuned_designs([s for s in chosen.values() if s != "pid"], task, report)
        if "pid" in chosen.values():
            designs["pid"] = _tuned_pid(given, task, report)
        for name, structure in chosen.items():
            design = designs[structure]
            made = design.controller
            if made is not None:
                made = shaped(given.linear[0], made, float(given.delays[0]))
            entries[name] = Entry(structure, made, design.values, design.reason)
    return entries, task.constraints


def _tuned_pid(given: Given, task: Task, progress: Progress) -> Design:
    """Return the PID controller with the least integral of ``|y|`` after a step of the load."""
    dt, unit = task.plants.dt, 1.0 / task.model.omega
    # A delay must be a whole number of the longer samples, too.
    times = 1 if given.delays[0] > 0.0 else max(math.floor(_PID_DT * unit / dt), 1)
    plants = plant_set(given, times * dt)
    count = round(_PID_LASTS * unit / plants.dt)
    bounds = task.constraints
    if times > 1:
        m_s, m_t = (
            None if m is None else max(_PID_BOUNDS * m, 1.01) for m in (bounds.m_s, bounds.m_t)
        )
        bounds = replace(bounds, m_s=m_s, m_t=m_t)
    slow = replace(
        task,
        plants=plants,
        constraints=bounds,
        model=model_of(given, plants, bounds),
        objective="load-iae",
        inputs=Inputs(np.zeros(count), np.ones(count)),
    )
    found = tuned_designs(["pid"], slow, progress)["pid"]
    if found.controller is None:
        return found
    structure = make_structure("pid", task.model)
    assert found.solution is not None
    row = found.solution.values
    return replace(found, controller=structure.controller(row, **task.limits))


def shaped(plant: Any, controller: Controller, delay: float = 0.0) -> Controller:
    """Return the controller behind the reference model with which its step settles soonest.

    Of the reference models, none included, those count whose step overshoots by no more than the
    settling band; if there are none, the slowest one is taken.
    """
    loop = analyse(plant, controller, delay=delay)
    slowest = float(np.min(-loop.s_poles.real))
    crossover = loop.margins.phase_omega
    scale = crossover if math.isfinite(crossover) else slowest
    fastest = min(_FASTEST * scale, 0.5 / loop.dt)
    bandwidths = np.geomspace(min(_SLOWEST * scale, 0.1 * fastest), fastest, _TRIED)
    last = 12.0 / min(slowest, float(bandwidths[0]))
    every = max(math.ceil(last / loop.dt / _SAMPLES), 1)
    y = _step(loop, math.ceil(last / loop.dt))[::every]
    t: Vector = loop.dt * every * np.arange(y.size, dtype=np.float64)
    best: tuple[float, float | None] = (_settled(t, y), None)
    for omega in bandwidths.tolist():
        time = _settled(t, _filtered(y, omega, loop.dt * every))
        if time < best[0]:
            best = time, omega
    if not math.isfinite(best[0]):
        best = best[0], float(bandwidths[0])
    if best[1] is None:
        return controller
    return Prefiltered(controller, ReferenceModel(best[1], order=2))


def _settled(t: Vector, y: Vector) -> float:
    """Return the settling time; infinite with too much overshoot, or where y does not settle."""
    if not metrics.overshoot(y, 1.0) <= metrics.SETTLING_BAND:
        return math.inf
    found = metrics.settling_time(t, y, 1.0, metrics.SETTLING_BAND)
    return math.inf if found is None or math.isnan(found) else float(found)


def _step(loop: LoopAnalysis, count: int) -> Vector:
    """Return the step response of the closed loop (count,)."""
    system = loop.closed_loop("r", "y")
    A: Matrix = np.eye(system.N.shape[0]) + system.N
    x, y = np.zeros(A.shape[0]), np.empty(count)
    for i in range(count):
        y[i] = system.C @ x + system.D
        x = A @ x + system.B
    return y


def _filtered(y: Vector, omega: float, dt: float) -> Vector:
    """Return a response behind ``ω²/(s + ω)²``: two first-order lags, sampled with hold."""
    from scipy.signal import lfilter

    pole = math.exp(-omega * dt)
    for _ in range(2):
        y = lfilter([0.0, 1.0 - pole], [1.0, -pole], y)
    return np.asarray(y, dtype=np.float64)


# ---- Any controllers on any plant in one scenario, and their scores ----

BAND = metrics.SETTLING_BAND  # half width of the settling band, as a fraction of the step

_KEYS = (
    *("overshoot", "settling_time", "disturbance_peak", "rms"),
    *("control_variation", "total_variation", "control_energy", "energy", "peak_power"),
)


@dataclass(frozen=True)
class Comparison:
    """The result of ``compare``, by name of the controller."""

    runs: dict[str, Trajectory]
    scores: dict[str, Scores]  #: None for a number that a run does not have
    no_power: str = ""  #: why no run has energy and peak power; empty if the plant has them

    def to_json(self) -> dict[str, Any]:
        """Return scores and statuses, for programs."""
        ends = {
            name: {"status": run.status.name or "OK", "diverged": run.diverged, "lost": run.lost}
            for name, run in self.runs.items()
        }
        why = {"no_power": self.no_power} if self.no_power else {}
        scores = {name: score | ends[name] for name, score in self.scores.items()}
        return {"controllers": scores} | why


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
    """Run controllers on a plant through one scenario with the same noise, and score the runs.

    Parameters
    ----------
    plant, scenario, record_every
        as for ``simulate``; with ``record_every`` above 1 there is no control variation.
    controllers
        by name, any number, with one sample time, as what y does between samples is in no score.
    load_at
        time from which on a disturbance is scored [s]. The run before it is scored as a step, from
        its first value to the last reference before ``load_at``. By default the whole run is the
        step.
    band
        half width of the settling band, as a fraction of the step.
    progress
        called with the finished share, 0 to 1.

    Returns
    -------
    Comparison
        with ``overshoot`` (fraction), ``settling_time`` [s], ``disturbance_peak`` (largest ``|r −
        y|`` from ``load_at`` on) and ``rms`` of r − y over the whole run [y-unit], and
        ``control_variation`` and ``total_variation`` over the whole run [u-unit], of which the
        latter has the first jump of u from zero, and ``control_energy``, ∫u² dt [u-unit² s]. A
        plant that has a ``Flow`` also gives ``energy``, what u puts into it without what it takes
        back, ∫max(P, 0) dt [J], and ``peak_power``, the largest ``|P|`` [W], of P = u · flow;
        for others ``no_power`` of the result says why they are None.

    Examples
    --------
    >>> from quell.controllers.baselines import PID
    >>> from quell.plants import LinearPlant
    >>> lag = LinearPlant([[-1.0]], [1.0], [1.0])
    >>> step = Scenario(reference=1.0, duration=5.0)
    >>> result = compare(lag, {"PI": PID(kp=4.0, ki=4.0, dt=0.01)}, step)
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
    for name, controller in controllers.items():
        check_controller(controller, f"controllers[{name!r}]")
    check_sample_times(controllers)
    jobs = [
        partial(simulate, plant, controller, scenario, record_every=record_every)
        for controller in controllers.values()
    ]
    workers = 1 if one_at_a_time(plant) else None
    runs = dict(zip(controllers, in_parallel(jobs, progress, workers), strict=True))
    duration = scenario.duration
    scores = {name: score(run, duration, load_at, band) for name, run in runs.items()}
    flow, fault = _flow_of(plant, record_every)
    if flow is not None:
        for name, run in runs.items():
            if not run.diverged and len(run) > 1:
                scores[name] |= power_scores(flow, run)
    return Comparison(runs, scores, fault)


def _flow_of(plant: Any, every: int) -> tuple[Flow | None, str]:
    """Return the flow of a plant, or why energy and peak power are not known."""
    inner = plant
    while isinstance(inner, EncodedPlant) and not hasattr(inner, "flow"):
        inner = inner.plant  # whose states are those of the encoded one
    flow = getattr(inner, "flow", None)
    if isinstance(flow, Flow):
        fault = "only each nth sample is recorded" if every > 1 else ""
        return (None, fault) if fault else (flow, "")
    if isinstance(inner, PlantWrapper):
        return None, f"{plant.name!r} acts on u late"
    return None, (
        f"{plant.name!r} does not say how fast u moves it; labelled(plant, flow=weights of the "
        "states) does, for a force or torque u"
    )


def power_scores(flow: Flow, run: Trajectory) -> Scores:
    """Return the energy that u puts into a plant [J], and its peak power [W], of a complete run.

    u is held, so its power has two ends in each sample; between them the flow is taken as a line.
    """
    u = np.clip(run["u"][:-1], -flow.largest, flow.largest)
    moved = run["x"] @ np.array(flow.state)
    with np.errstate(over="ignore", invalid="ignore"):
        begin, end = (u * (part + flow.direct * u) for part in (moved[:-1], moved[1:]))
        found = {
            "energy": float(np.sum(_positive_part(begin, end)) * run.dt),
            "peak_power": float(np.max(np.abs([begin, end]))),
        }
    return {name: value if math.isfinite(value) else None for name, value in found.items()}


def _positive_part(begin: Vector, end: Vector) -> Vector:
    """Return the means of the positive parts of lines from ``begin`` to ``end``."""
    high, low = np.maximum(begin, end), np.minimum(begin, end)
    crosses = (high > 0.0) & (low < 0.0)
    triangle = 0.5 * high * high / np.where(crosses, high - low, 1.0)
    return np.where(crosses, triangle, 0.5 * np.maximum(begin + end, 0.0))


def score(
    run: Trajectory, duration: float, load_at: float | None = None, band: float = BAND
) -> Scores:
    """Return the scores of one run; None if it ended too early, or y did not settle."""
    found: Scores = dict.fromkeys(_KEYS)
    step_ends = duration if load_at is None else load_at
    t, y, r = run.t, run["y"], run["r"]
    if run.ended >= step_ends - 2.0 * run.dt:
        part = run.window(0.0, math.inf if load_at is None else load_at)
        target, initial = float(r[part][-1]), float(y[0])
        if target != initial:
            found |= step_scores(t[part], y[part], target, band, initial)
    if not run.diverged:
        error = r - y
        if load_at is not None:
            found["disturbance_peak"] = metrics.peak(error[run.window(load_at, math.inf)])
        found["rms"] = metrics.rms(error)
        if run.every == 1:
            found["control_variation"] = metrics.control_variation(run["u"])
            found["total_variation"] = metrics.total_variation(run["u"])
            found["control_energy"] = metrics.control_energy(t, run["u"])
    return found


# ---- The comparison that quell compare shows ----

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
# Bandwidth of the observer of a compensator on top of another controller, over OMEGA_O: with all of
# it the loop with LQG has an M_s of 3.2, with half of it 2.4. Chosen by hand.
_ON_TOP = 0.5
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

    ``name`` is one of ``NAMES``, with a shaper before it, as ``zv+``, to shape the reference for
    the plant's resonance. The message for an unknown name lists the known ones.
    """
    *shapers, base = name.split("+")
    if base not in _DESIGNS or len(shapers) > 1 or not set(shapers) <= set(_SHAPERS):
        raise ValueError(
            f"controllers: {name!r} must be one of {', '.join(NAMES)}, "
            f"or one of {', '.join(each + '+' for each in _SHAPERS)} and one of these, as zv+pid"
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


def _lqg(dt: float, limits: dict[str, Any]) -> LQG:
    return LQG(two_mass_spring(), OMEGA_C, OMEGA_O, dt, **limits)


def _learning(
    base: Callable[[float, dict[str, Any]], Controller], dt: float, limits: dict[str, Any]
) -> Compensated:
    """Return a baseline with a compensator that learns, guarded, on top of it."""
    observer = ESO.model_based(two_mass_spring(), _ON_TOP * OMEGA_O, dt)
    learner: dict[str, Any] = {"omega_c": OMEGA_C, "learner": Kalman(), "guard": Guard()}
    return Compensated(base(dt, limits), Compensator(observer, **learner, **limits))


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
    "lqg": _lqg,
    "l-pid": lambda dt, limits: _learning(_pid, dt, limits),
    "l-pi-notch": lambda dt, limits: _learning(_notch_pid, dt, limits),
    "l-lqg": lambda dt, limits: _learning(_lqg, dt, limits),
    "resonance-ratio": lambda dt, limits: ResonanceRatio(omega_o=OMEGA_O, dt=dt, **limits),
}
_SHAPERS = {"zv": ZV, "zvd": ZVD, "mzv": MZV, "ei": EI}
NAMES = tuple(_DESIGNS)  # the benchmark's controllers


# ---- The comparison of a setup ----

# Least bound of |T|: with integral action |T| is 1 at low frequencies, and rounding is beyond.
_LEAST_M_T = 1.01
OWN = "setup"
"""Name of the setup's own controller."""


@dataclass(frozen=True)
class SetupComparison:
    """A comparison: plant, controllers, constraints and results."""

    plant: str  #: name of the plant
    linear: Any  #: its linear part, for which the controllers were tuned
    dt: float
    controllers: Mapping[str, Controller]
    entries: Mapping[str, Entry]
    constraints: Constraints | None
    load_at: float | None
    result: Comparison
    notes: tuple[str, ...] = ()  #: what was changed so that all are compared alike


def of_setup(
    given: Setup,
    names: Sequence[str],
    bounds: tuple[float | None, float | None, float | None],
    load_at: float | None,
    progress: Progress,
) -> SetupComparison:
    """Compare ``names``, of ``"setup"`` and ``STRUCTURES``; raises ``ValueError`` for others.

    ``bounds`` are M_s, M_t and M_ks of tuned loops; those of [tune], or else of the setup's
    controller before it has learned anything, stand for None. The delay of [tune] is behind u in
    all loops, and no loop has feedforward, as not all structures can. Tuned controllers have the
    limits of u of the setup's, too.
    """
    unknown = [name for name in names if name != OWN and name not in STRUCTURES]
    if unknown:
        known = ", ".join((OWN, *STRUCTURES))
        raise ValueError(f"controllers: {unknown[0]!r} must be one of {known}")
    plant, scenario = given.needed("plant"), given.needed("scenario")
    dt = float(given.controller.dt)
    late = _late(plant, given, dt)
    if scenario.x0 is not None and late.order > plant.order:  # u was zero before
        x0 = [*np.asarray(scenario.x0).tolist(), *[0.0] * (late.order - plant.order)]
        scenario = replace(scenario, x0=x0)
    plant, own, notes = late, given.controller, list[str]()
    linear, delay = linear_part(linear_model(plant), dt)
    chosen = [name for name in names if name != OWN]
    entries: dict[str, Entry] = {}
    constraints = None
    if chosen and getattr(without_prefilters(own), "feedforward", False):
        own = varied(given, {"controller.feedforward": False}).controller
        notes.append(f"{OWN}: without its feedforward, which PID and LQG do not have")
    if chosen:
        how: dict[str, Any] = {"limits": _limits(given.controller), "delay": delay}
        wanted = _constraints(_asked(bounds, given), analyse(linear, own, delay=delay))
        entries, constraints = tuned(linear, dt, chosen, wanted, progress=progress, **how)
    made = {name: e.controller for name, e in entries.items() if e.controller is not None}
    controllers = {name: own if name == OWN else made.get(name) for name in names}
    possible = {name: each for name, each in controllers.items() if each is not None}
    begins = _begins(scenario) if load_at is None else load_at
    report = partial(progress, "runs")
    result = compare(plant, possible, scenario, load_at=begins, progress=report)
    whole = linear if delay == 0.0 else plant
    parts = plant.name, whole, dt, possible, entries, constraints, begins, result
    return SetupComparison(*parts, tuple(notes))


def _asked(
    bounds: tuple[float | None, float | None, float | None], given: Setup
) -> tuple[float | None, float | None, float | None]:
    """Return the bounds, those that [tune] names in place of None."""
    table = given.description.tune
    written = {} if table is None else table.written()
    m_s, m_t, m_ks = (
        written.get(name) if bound is None else bound
        for name, bound in zip(("m_s", "m_t", "m_ks"), bounds, strict=True)
    )
    return m_s, m_t, m_ks


def _late(plant: Any, given: Setup, dt: float) -> Any:
    """Return the plant behind the delay of [tune], which the design of `quell tune` has, too."""
    delay = (given.tune or {}).get("delay", 0.0)
    if not isinstance(delay, float | int):
        raise ValueError(f"tune.delay = {delay!r}: must be one number here, one plant is compared")
    return plant if delay == 0.0 else delayed(plant, delay, dt)


def _constraints(
    bounds: tuple[float | None, float | None, float | None], own: LoopAnalysis
) -> Constraints:
    if None not in bounds or not own.stable:
        pairs = zip(("m_s", "m_t", "m_ks"), bounds, strict=True)
        given: dict[str, Any] = {name: value for name, value in pairs if value is not None}
        return Constraints(**given, damping=None)
    found = of_loop(own)
    both = zip(bounds, (found.m_s, found.m_t, found.m_ks), strict=True)
    m_s, m_t, m_ks = (other if bound is None else bound for bound, other in both)
    # Every loop has an M_s above 1, but |T| may be 1 at its largest.
    return Constraints(m_s=m_s, m_t=max(m_t, _LEAST_M_T), m_ks=m_ks, damping=None)


def _limits(controller: Any) -> dict[str, Any]:
    inner = getattr(controller, "controller", controller)
    found = getattr(getattr(inner, "parameters", None), "limits", None)
    if found is None:
        return {}
    return {"u_min": float(found.low), "u_max": float(found.high)}


def _begins(scenario: Scenario) -> float | None:
    """Return when the first disturbance that begins later than the run does so [s], if any."""
    times = [float(getattr(each, "at", 0.0)) for each in scenario.disturbances]
    return min((time for time in times if 0.0 < time < scenario.duration), default=None)


# ---- The figure of a comparison ----


def draw(result: Comparison, axes: Any = None, *, ax: Any = None) -> Any:
    """Draw y and r above, u below; quiet signals in front, extreme values cut off.

    Parameters
    ----------
    result
        of ``compare``.
    axes, ax
        two matplotlib axes; those of a new figure by default.

    Returns
    -------
    numpy.ndarray
        the axes.
    """
    make = partial(new_figure, 10.0, 7.0)
    above, below = axes = grid_of_axes(given_axes(axes, ax), make, 2, sharex=True)[:, 0]
    first = next(iter(result.runs.values()))
    draw_line(above, first.t, first["r"], color="0.3", linestyle="--", linewidth=1.0, label="r")
    variation = {name: np.sum(np.abs(np.diff(run["u"]))) for name, run in result.runs.items()}
    quietest_first = sorted(variation, key=variation.__getitem__)
    for i, (name, run) in enumerate(result.runs.items()):
        label = f"{name} (diverged)" if run.lost else name
        style = {"color": f"C{i % 10}", "linewidth": 1.3, "linestyle": "-" if i < 10 else "--"}
        depth = 3.0 - quietest_first.index(name) / len(quietest_first)
        draw_line(above, run.t, run["y"], label=label, **style)
        draw_line(below, run.t, run["u"], zorder=depth, **style)
    y, u = first.signals.y.label("output"), first.signals.u.label("control signal")
    for each, channel, title in ((above, "y", y), (below, "u", u)):
        limits = _limits_figures([run[channel] for run in result.runs.values()])
        each.set(ylim=limits, ylabel=title)
        each.grid(alpha=0.3)
    above.legend(fontsize="small", ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    below.set_xlabel("time [s]")
    return axes


def save(
    result: Comparison,
    folder: str | os.PathLike[str],
    overwrite: bool = False,
    name: str = "compare",
) -> list[Path]:
    """Write the figure into ``folder``, created if missing; return the paths."""
    return save_figures({name: partial(draw, result)}, folder, overwrite=overwrite)


def _limits_figures(signals: list[Any]) -> tuple[float, float]:
    """Return limits of an axis that hold all signals except for extreme values."""
    low, high = (float(np.median([pick(s) for s in signals])) for pick in (np.min, np.max))
    room = 1.5 * max(high - low, 1e-9)
    clipped = [np.clip(s, low - room, high + room) for s in signals]
    low, high = min(float(np.min(s)) for s in clipped), max(float(np.max(s)) for s in clipped)
    margin = 0.05 * max(high - low, 1e-9)
    return low - margin, high + margin


__all__ = [
    "BAND",
    "END",
    "FORCE",
    "FORCE_AT",
    "NAMES",
    "STRUCTURES",
    "Benchmark",
    "Comparison",
    "Entry",
    "Sensitivities",
    "SetupComparison",
    "compare",
    "controller",
    "draw",
    "of_setup",
    "save",
    "scenario",
    "score",
    "sensitivities",
    "shaped",
    "tuned",
    "tuned_controllers",
    "two_mass",
]
