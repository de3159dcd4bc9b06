"""A learner frozen at an instant: what it feeds back of the state and the control signal.

Around what it sees at that instant, a learner that learns no more is

    f_L = const + g · (x̂_1 … x̂_n, Δf̂) + h u_before + s u

For features that are the state, u and a constant that is exact everywhere, with g = θ. For any other learner (a network, a Gaussian
process, polynomials) it holds for small motions: g and h are central differences of its own ``predict``. The constant, and whatever turns
by itself (oscillators), is a feedforward: it moves the loop but does not close it, so no margin depends on it.

A guard multiplies all of it with the learner's authority β. Where it clips the output (``Reason.OUT_OF_BOUNDS``, ``TOO_FAST``), less is fed
back than is taken here.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quell import checks
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

# Central differences over so much of the size of a signal: they err by its square.
_STEP = 1e-4
_FEEDFORWARD = ("bias", "sin", "cos")


class Frozen(NamedTuple):
    """A learner that learns no more, for a plant of order n, with its authority."""

    gain: Vector
    """g (n + 1,), for x̂_1 … x̂_n and Δf̂."""
    before: float
    """h, for the control signal applied a sample before."""
    slope: float
    """s, for the control signal that is about to be applied."""


@predict.register(Frozen)
def _predict(
    learner: Frozen, memory: NoLearnerMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    constant = learner.before * u_before
    for i in range(seen.size):
        constant += learner.gain[i] * seen[i]
    return constant, learner.slope


# It learns as little as no learner does, and has no more to remember.
adapt.register(Frozen)(adapt.implementations[NoLearnerDesign])
commit.register(Frozen)(commit.implementations[NoLearnerDesign])
restart.register(Frozen)(restart.implementations[NoLearnerDesign])
coefficients.register(Frozen)(coefficients.implementations[NoLearnerDesign])


def frozen(controller: Any, run: Any = None, t: float | None = None) -> Frozen:
    """Freeze a controller's learner: as it is now, as it was at the end of a run, or at any time of it.

    Parameters
    ----------
    controller
        an ``ADRC``.
    run
        a ``Trajectory`` of it; or a state of it, for instance ``run.final_state``; by default the state the controller itself is in.
    t
        at which time of the run [s]; by default its end. What the learner had found by then is read from the record, so its features must
        be states, u, a constant and sinusoids. Freeze any other at the end of a run that ends then.

    Returns
    -------
    Frozen
        its gains, times the authority that a guard gave it.

    Raises
    ------
    ValueError
        where the record does not say what the learner had found, or the time is not in it; for a learner that calls a Python model, whose
        answer is held between calls.
    """
    if not hasattr(controller, "observer"):
        raise ValueError(
            f"controller = {controller!r}: must be an ADRC, only that has a learner to freeze"
        )
    if run is None:
        return _from_state(controller, controller._state)
    if not isinstance(run, Trajectory):
        return _from_state(controller, run)
    if t is None and run.final_state is not None:
        return _from_state(controller, run.final_state)
    return _from_record(controller, run, run.ended if t is None else checks.finite("t", t))


def _from_record(controller: Any, run: Trajectory, t: float) -> Frozen:
    row = first_sample_at(t, run.every * run.dt, len(run))
    if not (t >= 0.0 and row < len(run)):
        raise ValueError(f"t = {t!r}: must be a time of the record, from 0 to {run.t[-1]:g} s")
    order = controller.observer.order
    if tuple(run.features) != tuple(controller.features):
        raise ValueError(
            f"run has the features {run.features}: must be a run of this controller, which has {controller.features}"
        )
    if not (run.features or isinstance(controller.learner, NoLearner)):
        raise ValueError(
            f"t = {t!r}: {type(controller.learner).__name__} has no coefficients to record; "
            "pass the scenario to loops_over_time, or the final_state of a run that ends then"
        )
    gain, slope = np.zeros(order + 1), 0.0
    states = {f"x{i + 1}": i for i in range(order)}
    for name, theta in zip(run.features, run["theta"][row] if run.features else (), strict=True):
        if name in states:
            gain[states[name]] += theta
        elif name == "u":
            slope += float(theta)
        elif not name.startswith(_FEEDFORWARD):
            raise ValueError(
                f"t = {t!r}: the feature {name!r} is not linear, its coefficient alone says nothing; "
                "pass the scenario to loops_over_time, or the final_state of a run that ends then"
            )
    return _heard(
        controller,
        gain,
        0.0,
        slope,
        float(run["authority"][row]) if "authority" in run.names else 1.0,
    )


def _from_state(controller: Any, state: Any) -> Frozen:
    if hasattr(controller.learner, "external_fields"):
        raise ValueError(
            f"learner = {type(controller.learner).__name__}: a Python model is asked once a period and its answer held, "
            "so it has no gain at an instant; analyse the loop without it"
        )
    learner, memory = controller.parameters.learner, copied(state.learner)
    known = controller.read(state)
    seen, u = np.append(known.x, known.f_residual), known.u
    sizes = _sizes(controller, memory, seen, u)

    def output(seen: Vector, before: float) -> float:
        constant, slope = predict(learner, copied(memory), seen, before)
        return constant + slope * u

    def derivative(i: int) -> float:
        step = _STEP * sizes[i]
        moved = [np.append(seen, u) for _ in range(2)]
        moved[0][i] += step
        moved[1][i] -= step
        return (output(moved[0][:-1], moved[0][-1]) - output(moved[1][:-1], moved[1][-1])) / float(
            moved[0][i] - moved[1][i]
        )

    gains = [derivative(i) for i in range(seen.size + 1)]
    slope = float(predict(learner, copied(memory), seen, u)[1])
    return _heard(controller, np.array(gains[:-1]), gains[-1], slope, known.authority)


def _heard(controller: Any, gain: Vector, before: float, slope: float, authority: float) -> Frozen:
    """Return what a guard lets through: β times all of it; a slope outside of its interval counts for the u before."""
    if not (np.all(np.isfinite(gain)) and math.isfinite(before) and math.isfinite(slope)):
        raise ValueError(
            "learner: its output is not a number at this instant; there is nothing to analyse"
        )
    gain, before, slope = authority * gain, authority * before, authority * slope
    guard = controller.parameters.guard
    if (
        not isinstance(guard, UnguardedDesign)
        and not guard.least_slope <= slope <= guard.largest_slope
    ):
        before, slope = before + slope, 0.0
    return Frozen(gain, float(before), float(slope))


def _sizes(controller: Any, memory: Any, seen: Vector, u: float) -> Vector:
    """Return about how large x̂_1 … x̂_n, Δf̂ and u are: as the learner has found, or from how it is now."""
    scale = np.asarray(getattr(memory, "scale", ()))
    if scale.shape == (seen.size + 1,) and np.all(scale > 1e-90):
        return np.append(scale[:-2], scale[[-1, -2]])
    ladder = float(controller.omega_c) ** np.arange(seen.size)
    length = float(np.max(np.abs(seen) / ladder)) or 1.0
    return np.append(length * ladder, abs(u) or length * ladder[-1] / abs(controller.observer.b0))


def copied(state: Any) -> Any:
    """Return a copy of a nested NamedTuple of arrays."""
    return (
        type(state)(*(copied(value) for value in state))
        if isinstance(state, tuple)
        else np.array(state)
    )
