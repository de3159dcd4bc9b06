"""A learner frozen at an instant: its feedback of the state and the control signal.

Around its inputs at that instant, a learner that no longer learns is

    f_L = const + g · (x̂_1 … x̂_n, Δf̂) + h u_before + s u

For features that are the state, u and a constant, this is exact everywhere, with g = θ. For any
other learner (a network, a Gaussian process, polynomials) it holds for small motions: g and h are
central differences of its own ``predict``. The constant, and autonomous features (oscillators), are
a feedforward: they move the loop but do not close it, so no margin depends on them.

A learner with a gate of noise (``learners/noise_gate.py``) is taken in motion, with the gate open:
within the noise its feedback of a signal is cut, and the loop is as without it.

A guard multiplies all of it by the learner's authority β. When it clips the output
(``Reason.OUT_OF_BOUNDS``), the true feedback is smaller than the one computed here.
"""

from __future__ import annotations

import math
import re
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.adrc.law import AdrcState
from quell.controllers.base import Controller
from quell.guard import UnguardedDesign
from quell.learners.base import (
    NoLearner,
    NoLearnerDesign,
    NoLearnerMemory,
    adapt,
    coefficients,
    commit,
    predict,
    restart,
)
from quell.records.sample_times import first_sample_at
from quell.records.trajectory import Trajectory
from quell.types import Vector

# Step of the central differences, relative to the size of a signal; their relative error is of the
# order of its square, 1e-8.
_STEP = 1e-4
# Features of time alone, by their names in ``Bias`` and ``Harmonic``.
_FEEDFORWARD = re.compile(r"bias|(sin|cos)\d+")
_USE_STATE = "pass the scenario to loops_over_time, or the final_state of a run that ends then"


class Frozen(NamedTuple):
    """A learner that no longer learns, for a plant of order n; all with its authority."""

    gain: Vector  # g (n + 1,), for x̂_1 … x̂_n and Δf̂
    before: float  # h, for the control signal applied a sample before
    slope: float  # s, for the control signal that is about to be applied
    authority: float = 1.0  # β, by which these are multiplied already


@predict.register(Frozen)
def _predict(
    learner: Frozen, memory: NoLearnerMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    constant = learner.before * u_before
    for i in range(learner.gain.size):
        constant += learner.gain[i] * seen[i]
    return constant, learner.slope


# Everything else is as without a learner.
for _generic in (adapt, commit, restart, coefficients):
    _generic.register(Frozen)(_generic.implementations[NoLearnerDesign])


def frozen(controller: Controller, run: Any = None, t: float | None = None) -> Frozen:
    """Freeze a controller's learner: now, at the end of a run, or at any time of it.

    The gains include the authority that a guard gave it. Raises ``ValueError`` if the record
    lacks the time or the learner's coefficients, and for a learner that calls a Python model, whose
    answer is held between calls.

    Parameters
    ----------
    controller
        an ``ADRC``.
    run
        a ``Trajectory`` of it, or a state of it, for instance ``run.final_state``; by default the
        controller's own state.
    t
        time of the run [s]; by default its end. The coefficients at that time come from the record,
        so the learner's features must be states, u, a constant and sinusoids. Freeze any other
        learner at the end of a run that ends at that time.
    """
    if not isinstance(controller, ADRC):
        raise ValueError(f"controller = {controller!r}: must be an ADRC")
    if run is None:
        return _from_state(controller, controller._state)
    if isinstance(run, AdrcState):
        return _from_state(controller, run)
    if not isinstance(run, Trajectory):
        raise ValueError(f"run = {run!r}: must be a run of the controller, or a state of it")
    if t is None and run.final_state is not None:
        return _from_state(controller, run.final_state)
    return _from_record(controller, run, run.ended if t is None else checks.finite("t", t))


def _from_record(controller: ADRC, run: Trajectory, t: float) -> Frozen:
    row = first_sample_at(t, run.every * run.dt, len(run))
    if not (t >= 0.0 and row < len(run)):
        raise ValueError(f"t = {t!r}: must be a time of the record, from 0 to {run.t[-1]:g} s")
    order = controller.observer.order
    if tuple(run.features) != tuple(controller.features):
        rule = f"must be a run of this controller, which has {controller.features}"
        raise ValueError(f"run has the features {run.features}: {rule}")
    if not (run.features or isinstance(controller.learner, NoLearner)):
        name = type(controller.learner).__name__
        raise ValueError(f"t = {t!r}: {name} has no coefficients to record; {_USE_STATE}")
    gain, slope = np.zeros(order + 1), 0.0
    states = {f"x{i + 1}": i for i in range(order)}
    for name, theta in zip(run.features, run["theta"][row] if run.features else (), strict=True):
        if name in states:
            gain[states[name]] += theta
        elif name == "u":
            slope += float(theta)
        elif not _FEEDFORWARD.fullmatch(name):
            raise ValueError(f"t = {t!r}: the feature {name!r} is not linear; {_USE_STATE}")
    authority = float(run["authority"][row]) if "authority" in run.names else 1.0
    return _with_authority(controller, gain, 0.0, slope, authority)


def _from_state(controller: ADRC, state: Any) -> Frozen:
    if hasattr(controller.learner, "external_fields"):
        raise ValueError(
            f"learner = {type(controller.learner).__name__}: a Python model is called once a "
            "period, so it has no gain at an instant; analyse the loop without it"
        )
    learner, memory = controller.parameters.learner, copy_state(state.learner)
    if hasattr(memory, "gate"):
        memory.gate.variance[:] = np.inf  # all signals move
    known = controller.read(state)
    seen, u = np.append(known.x, known.f_residual), known.u
    sizes = _signal_sizes(controller, memory, seen, u)

    def output(seen: Vector, before: float) -> float:
        constant, slope = predict(learner, copy_state(memory), seen, before)
        return constant + slope * u

    def derivative(i: int) -> float:
        step = _STEP * sizes[i]
        moved = [np.append(seen, u) for _ in range(2)]
        moved[0][i] += step
        moved[1][i] -= step
        difference = output(moved[0][:-1], moved[0][-1]) - output(moved[1][:-1], moved[1][-1])
        return difference / float(moved[0][i] - moved[1][i])

    gains = [derivative(i) for i in range(seen.size + 1)]
    slope = float(predict(learner, copy_state(memory), seen, u)[1])
    return _with_authority(controller, np.array(gains[:-1]), gains[-1], slope, known.authority)


def _with_authority(
    controller: ADRC, gain: Vector, before: float, slope: float, authority: float
) -> Frozen:
    """Return β times all of it; a slope outside of the guard's interval acts on the u before."""
    if not (np.all(np.isfinite(gain)) and math.isfinite(before) and math.isfinite(slope)):
        raise ValueError("learner: its output is not finite at this instant")
    gain, before, slope = authority * gain, authority * before, authority * slope
    guard = controller.parameters.guard
    guarded = not isinstance(guard, UnguardedDesign)
    if guarded and not guard.least_slope <= slope <= guard.largest_slope:
        before, slope = before + slope, 0.0
    return Frozen(gain, float(before), float(slope), authority)


def _signal_sizes(controller: ADRC, memory: Any, seen: Vector, u: float) -> Vector:
    """Return the sizes of x̂_1 … x̂_n, Δf̂ and u: the learner's scales, or from present values."""
    scale = np.asarray(getattr(memory, "scale", ()))
    # A scale is at its floor, 1e-100 (``features.scaling``), until its signal was seen.
    if scale.shape == (seen.size + 1,) and np.all(scale > 1e-90):
        return np.append(scale[:-2], scale[[-1, -2]])
    ladder = float(controller.omega_c) ** np.arange(seen.size)
    length = float(np.max(np.abs(seen) / ladder)) or 1.0
    return np.append(length * ladder, abs(u) or length * ladder[-1] / abs(controller.observer.b0))


def copy_state(state: Any) -> Any:
    """Return a copy of a nested NamedTuple of arrays."""
    return type(state)(*map(copy_state, state)) if isinstance(state, tuple) else np.array(state)
