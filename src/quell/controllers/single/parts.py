"""Parameters and states of controllers in single precision."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.controllers.adrc.law import AdrcDesign
from quell.controllers.linear.delta import delta_law
from quell.controllers.linear.law import LinearLaw
from quell.controllers.prefilters.prefilter import PrefilteredDesign
from quell.features.custom import CustomDesign
from quell.guard.state import CARRIES, GuardDesign, GuardMemory
from quell.kernels.single import in_single
from quell.learners.adapters.kernels import PythonDesign
from quell.learners.kalman.kernels import KalmanDesign, KalmanMemory, needs_carries
from quell.learners.lag import Lag
from quell.learners.noise_gate import NoiseGate, NoiseGateMemory
from quell.observers.delta import delta_form

_OTHERS = "take a learner of quell.learners with its own kernels, or one of the other features"
# Shares by which averages follow in a sample. What is left of a smaller one in the sum is below
# half a unit of the last digit where the average is within a tenth of its goal.
_RATES: dict[type, tuple[str, ...]] = {
    GuardDesign: ("forget", "earn", "forget_account", "rise", "decay", "growth", "smooth"),
    KalmanDesign: ("forget",),
    NoiseGate: ("forget",),
}
_LEAST_RATE = 2.0**-21
# What decays to zero needs a unit of the last digit in a sample.
_LEAST_DECAY = 2.0**-23


def single_design(design: Any) -> Any:
    """Return a controller's parameters in single precision, designed in double.

    Observers and linear laws are in delta form. Raises ``ValueError`` for what is out of the range
    of single precision, or works in double only.
    """
    _check(design, "")
    return in_single(_in_delta_form(design))


def _in_delta_form(design: Any) -> Any:
    """Return parameters with observers and linear laws in delta form, still in double."""
    form = delta_form(design)
    if form is not design:
        return form
    if isinstance(design, LinearLaw):
        return delta_law(design)
    if isinstance(design, Lag):
        # β is rounded first, so that the gain of a stage at rest, (1−β)/(1−β), remains one.
        pole = float(np.float32(design.pole))
        return design._replace(pole=pole, rise=1.0 - pole)
    if hasattr(design, "_fields"):
        return type(design)(*map(_in_delta_form, design))
    return design


def single_state(design: Any, state: Any) -> Any:
    """Return the state for ``design``, which ``single_design`` returned.

    ``state`` is that of the controller in double precision before the first sample.
    """
    return in_single(_with_carries(design, state))


def _check(value: Any, name: str) -> None:
    """Raise a ``ValueError`` for a part that works in double only, or averages for too long."""
    if isinstance(value, PythonDesign | CustomDesign):
        what = "a model in Python" if isinstance(value, PythonDesign) else "features.Custom"
        raise ValueError(f"{name} is {what}: it works in double precision only; {_OTHERS}")
    for field, part in zip(getattr(value, "_fields", ()), value, strict=False):
        if isinstance(part, tuple):
            _check(part, f"{name}.{field}" if name else field)
        elif field in _RATES.get(type(value), ()):
            least = _LEAST_DECAY if field == "decay" else _LEAST_RATE
            if 0.0 < part < least:
                raise ValueError(
                    f"{name}.{field} = {part:.3g} a sample: must be at least {least:.3g} in single "
                    "precision, or the average stands still; raise dt or omega_o, or stay in "
                    "double precision"
                )


def _with_carries(design: Any, state: Any) -> Any:
    """Return the state with room for the carries of compensated sums."""
    if isinstance(design, PrefilteredDesign):
        return state._replace(controller=_with_carries(design.controller, state.controller))
    if isinstance(design, AdrcDesign):
        state = state._replace(z=np.zeros(design.eso.states))
        learner = state.learner
        if isinstance(design.learner, KalmanDesign) and needs_carries(design.learner):
            wide = np.hstack([learner.covariance, np.zeros((learner.theta.size, 1))])
            state = state._replace(learner=learner._replace(covariance=wide))
    return _with_longer(state)


def _with_longer(state: Any) -> Any:
    """Return a state with longer arrays where kernels carry what rounding takes."""
    if not hasattr(state, "_fields"):
        return state
    state = type(state)(*map(_with_longer, state))
    if isinstance(state, GuardMemory):
        return state._replace(shown=np.append(state.shown, np.zeros(CARRIES)))
    if isinstance(state, KalmanMemory):
        state = state._replace(carry=np.zeros(state.theta.size))
    if isinstance(state, KalmanMemory | NoiseGateMemory):
        return state._replace(mean=np.zeros(2 * state.mean.size))
    return state
