"""Start under load, manual operation and retuning, as functions of parameters and state.

A controller starts under load, or follows manual operation, by its observer: the observer receives
y and the applied u and estimates f (Herbst, "Practical Active Disturbance Rejection Control:
Bumpless Transfer, Rate Limitation, and Incremental Algorithm", arXiv 1908.04610). At rest at the
reference the law then returns exactly that u. Otherwise, with another reference or new gains, the
difference is added to u and decays as ``exp(−omega_c t)``. The observer receives the sum, so the
offset does not disturb its estimate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from quell.controllers.base import change_parameters, reset_loop
from quell.controllers.held import look_anew
from quell.controllers.law import AdrcDesign, AdrcState, known_share, unlimited_control
from quell.controllers.safe_set import settle_at_rest, settle_safe_set, shift_f
from quell.controllers.schedule import gain_in_use, known_of_model
from quell.guard import limit
from quell.kernels.dispatch import call_specialised, compiled
from quell.learners.base import predict
from quell.observers.design import scaled_response
from quell.observers.eso import ESO
from quell.observers.forms import (
    NonlinearModel,
    acting_control,
    begin,
    observe,
    state_for,
    without_delay,
)
from quell.types import Vector

# Time constants after which an initial error is below the unit roundoff: exp(−40) = 4e-18.
_TIME_CONSTANTS = 40.0
# Bound on the time that ``start`` takes: some seconds of calculation. Chosen by hand.
_MOST_SAMPLES = 100_000_000


def start_at_rest(
    design: AdrcDesign, state: AdrcState, samples: int, y: float, u: float, r: float
) -> None:
    """Set the state to rest at y under u, with the reference r; see ``samples_to_settle``.

    The numbers are in the precision of the state.
    """
    _start_loop(design, state, y, u, r)
    begin(design.eso, state.z, state.estimates, y)
    settle_at_rest(design.safe_set, state.safe_set, y, u, samples)
    loop = state.loop[0]
    model, z, estimates = design.eso, state.z, state.estimates
    known = loop.f_learned + loop.f_known
    call_specialised(_observe_at_rest, model, z, estimates, y, u, known, samples)
    _feed_forward(design, state, u)
    known = loop.f_learned + loop.f_known
    call_specialised(_observe_at_rest, model, z, estimates, y, u, known, samples)
    loop.bumpless = 1.0


def start_in_motion(
    design: AdrcDesign, state: AdrcState, x: Vector, f: Vector, u: float, r: float
) -> None:
    """Set the state to the estimates ``x`` (n,) and ``f`` (m,) under u, with the reference r."""
    _start_loop(design, state, float(x[0]), u, r)
    state.estimates[:] = np.append(x, f)
    _feed_forward(design, state, u)
    state.estimates[x.size] -= state.loop[0].f_learned + state.loop[0].f_known
    state.z[:] = state_for(design.eso, x, state.estimates[x.size :], u)
    settle_safe_set(design.safe_set, state.safe_set, x, float(f[0]))


def _start_loop(design: AdrcDesign, state: AdrcState, y: float, u: float, r: float) -> None:
    reset_loop(design, state)
    loop = state.loop[0]
    loop.y, loop.r, loop.u = y, r, u
    loop.started = loop.has_reference = 1.0
    loop.f_known = known_share(design.feedforward, r, state.reference)


def _feed_forward(design: AdrcDesign, state: AdrcState, u: float) -> None:
    """Set the learner's share of f for the estimates in ``state`` under u."""
    loop = state.loop[0]
    constant, slope = predict(design.learner, state.learner, state.estimates, u)
    constant, slope, _ = limit(design.guard, state.guard, 0.0, 0.0, constant, slope, u)
    loop.constant, loop.slope = constant, slope
    loop.f_learned = constant + slope * u


def samples_to_settle(observer: ESO) -> int:
    """Return after how many samples an observer has forgotten its initial state."""
    samples = _TIME_CONSTANTS * observer.lag_time / observer.dt
    if not isinstance(without_delay(observer.model), NonlinearModel):
        transition = scaled_response(observer.model, observer.units, observer.order).transition
        slowest = float(np.max(np.abs(np.linalg.eigvals(transition))))
        if 0.0 < slowest < 1.0:
            samples = max(samples, _TIME_CONSTANTS / -math.log(slowest))
    return min(round(samples), _MOST_SAMPLES) + observer.states


@compiled
def _observe_at_rest(
    model: Any, z: Vector, estimates: Vector, y: float, u: float, f_learned: float, samples: int
) -> None:
    """Update the observer with constant y, u and f_L."""
    for _ in range(samples):
        observe(model, z, estimates, y, u, f_learned)


@contextmanager
def manual_operation(state: AdrcState, u: float) -> Iterator[None]:
    """Apply ``u`` instead of the law's own control signal inside the ``with`` block."""
    state.loop[0].manual, state.loop[0].u_manual = 1.0, u
    try:
        yield
    finally:
        state.loop[0].manual = 0.0


@change_parameters.register(AdrcDesign)
def change_design(old: AdrcDesign, new: AdrcDesign, state: AdrcState) -> None:
    """Convert a running state to new parameters, without a jump of u."""
    loop, size = state.loop[0], new.law.size
    if loop.started == 0.0:
        return
    look_anew(new.held, state.held)
    before = unlimited_control(old, state, loop.constant, loop.slope)
    # By definition f is what b0 u and a·x do not explain, so its estimate changes with b0 and a.
    # Its derivatives, if the observer has them, stay: how u moves from now on is not known.
    acting = acting_control(old.eso, state.z, loop.u)
    memory = state.schedule  # a b0 of a table changes with the next sample
    change = gain_in_use(old.schedule, memory, old.b0) - gain_in_use(new.schedule, memory, new.b0)
    change *= acting
    for i in range(size):
        change += (new.cancel[i] - old.cancel[i]) * state.estimates[i]
    shift_f(new.safe_set, state.safe_set, change)
    # The model's share of f depends on them, too, and is not in the estimate.
    known = known_of_model(
        new.schedule, memory, new.feedforward, loop.r, state.reference, new.b0,
        known_share(new.feedforward, loop.r, state.reference),
    )  # fmt: skip
    change -= known - loop.f_known
    loop.f_known = known
    state.z[size] += change
    state.estimates[size] += change
    loop.offset += before - unlimited_control(new, state, loop.constant, loop.slope)


def check_replacement(old: ESO, new: Any, learns: bool) -> None:
    """Check that ``new`` can replace ``old`` in a running controller; ``learns`` with a learner."""
    if not isinstance(new, ESO):
        raise ValueError(f"observer = {new!r}: must be an ESO")
    names = ("order", "disturbance_order", "degree", "f_degree", "dt", "form", "states")
    for name in names:
        if getattr(new, name) != getattr(old, name):
            rule = f"the present one {getattr(old, name)!r}: must be the same"
            raise ValueError(f"observer has {name} = {getattr(new, name)!r}, {rule}")
    same_gain = new.b0 == old.b0
    plants = [(getattr(new.plant, name), getattr(old.plant, name)) for name in "aBE"]
    if same_gain and all(np.array_equal(*pair) for pair in plants):
        return
    if any(observer.plant.zeros.size or not observer.plant.matched for observer in (old, new)):
        raise ValueError(
            "observer has another model or b0, which changes the meaning of its states for a plant "
            "with zeros; change omega_o only"
        )
    if learns and not (same_gain and np.array_equal(new.cancel, old.cancel)):
        raise ValueError(
            f"observer has b0 = {new.b0!r} and a = {new.cancel.tolist()}, not those of the present "
            "one: what was learned refers to that; change omega_o only, or make a new controller"
        )


def check_structure(old: AdrcDesign, new: AdrcDesign) -> None:
    """Raise a ``ValueError`` if compiled code and state arrays for ``old`` do not fit ``new``."""
    if _structure(new) != _structure(old):
        raise ValueError("observer is of another structure than the present one: make a new ADRC")


def _structure(value: Any) -> Any:
    """Return types and array shapes of a nested NamedTuple."""
    if isinstance(value, tuple):
        return type(value), tuple(map(_structure, value))
    return value.shape if isinstance(value, np.ndarray) else type(value)
