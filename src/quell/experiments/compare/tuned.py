"""Controllers for a comparison, each tuned for the best load rejection under the same constraints.

``quell.tuning`` maximises the integral gain of each structure. A PID controller whose integral gain
is the largest may ring for long; it is tuned for the least integral of ``|y|`` after a step of the
load instead, which suits it better. The reference does not enter the constraints, so each
controller then gets the reference model, a lag of second order, with which its step settles soonest
without more overshoot than the settling band allows; or none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quell.analysis import LoopAnalysis, analyse
from quell.analysis.margins import least
from quell.controllers import Controller, Prefiltered, ReferenceModel
from quell.controllers.prefilters.prefilter import without_prefilters
from quell.parallel import one_blas_thread
from quell.records import metrics
from quell.tuning import Constraints
from quell.tuning.designs import Task, tuned_designs, with_noise_bound
from quell.tuning.optimiser.time_responses import Inputs
from quell.tuning.plants import Given, given_plants, model_of, plant_set
from quell.tuning.result.design import Design
from quell.tuning.structures.registry import make_structure
from quell.types import Matrix, Progress, Vector

STRUCTURES = {
    "tuned-pid": "pid",
    "tuned-lqg": "lqg",
    "tuned-p-pi-notch": "p-pi-notch",
    "tuned-bandwidths": "bandwidths",
    "tuned-freed": "freed",
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
    """Return the settling time; infinite with too much overshoot."""
    if metrics.overshoot(y, 1.0) > metrics.SETTLING_BAND:
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
