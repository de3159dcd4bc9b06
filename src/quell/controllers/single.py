"""Controllers in single precision.

Parameters and states of controllers in single precision.

A controller that calculates in single precision, as it does on a processor without double.

Its parameters are designed in double precision and then rounded, its state is single, and its
observer or linear law is in delta form (``observers/forms.py``). The plant, the clock and the
record stay in double: r and y are rounded where the controller receives them.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numba
import numpy as np

from quell import checks
from quell.controllers.axes import Axes, AxesDesign
from quell.controllers.axes_chain import AxisDesigns
from quell.controllers.base import (
    Controller,
    bumpless_transfer,
    change_parameters,
    check_controller,
    control,
    reset_loop,
    set_applied_control,
    set_held,
    set_reference_derivatives,
    set_schedule_signals,
    status_flags,
    write_row,
)
from quell.controllers.compensated import Compensated, CompensatedDesign
from quell.controllers.compensator import manual_operation
from quell.controllers.held import HeldDesign
from quell.controllers.law import AdrcDesign
from quell.controllers.linear import LinearLaw, delta_law
from quell.controllers.memory import Layout, images_of, learned_state
from quell.controllers.prefilters import Prefiltered, PrefilteredDesign, Wrapper
from quell.controllers.safe_set import SafeSetDesign
from quell.controllers.state_space import StateFeedback
from quell.features.base import CustomDesign
from quell.guard.kernels import CARRIES, GuardDesign, GuardMemory
from quell.kernels import dispatch
from quell.kernels.functions import single
from quell.kernels.linking import KERNEL_OPTIONS, in_both_precisions
from quell.kernels.numba_internals import REMEDY
from quell.kernels.single import in_single
from quell.learners.all_axes import NoiseGateOfAxes
from quell.learners.base import Lag, NoiseGate, NoiseGateMemory
from quell.learners.kalman import KalmanDesign, KalmanMemory, needs_carries
from quell.learners.python_model import PythonDesign
from quell.observers.forms import delta_form
from quell.types import Vector

# ---- Parameters and states of controllers in single precision ----

_OTHERS = "take a learner of quell.learners with its own kernels, or one of the other features"
# Shares by which averages follow in a sample. What is left of a smaller one in the sum is below
# half a unit of the last digit where the average is within a tenth of its goal.
_RATES: dict[type, tuple[str, ...]] = {
    GuardDesign: ("forget", "earn", "forget_account", "rise", "decay", "growth", "smooth"),
    KalmanDesign: ("forget",),
    NoiseGate: ("forget",),
    NoiseGateOfAxes: ("forget",),
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
    if isinstance(design, CompensatedDesign):
        inner = _with_carries(design.compensator, state.compensator)
        given = _with_carries(design.controller, state.controller)
        return state._replace(controller=given, compensator=inner)
    if isinstance(design, AxesDesign):
        axes = _with_carries(design.axes, state.axes)
        return state._replace(axes=axes, learning=_with_longer(state.learning))
    if isinstance(design, AxisDesigns):
        own, others = design.axis, design.others
        behind = _with_carries(others, state.others)
        return state._replace(axis=_with_carries(own, state.axis), others=behind)
    if isinstance(design, AdrcDesign):
        state = state._replace(z=np.zeros(design.eso.states))
        if isinstance(design.safe_set, SafeSetDesign):
            wide = state.safe_set._replace(z=np.zeros(design.safe_set.eso.states))
            state = state._replace(safe_set=wide)
        if isinstance(design.held, HeldDesign):
            wide = state.held._replace(z=np.zeros(design.eso.states))
            state = state._replace(held=wide)
        learner = state.learner
        if isinstance(design.learner, KalmanDesign) and needs_carries(design.learner):
            # Only the lower triangle; what is above has the carries.
            wide = np.hstack([np.tril(learner.covariance), np.zeros((learner.theta.size, 1))])
            state = state._replace(learner=learner._replace(covariance=wide))
    return _with_longer(state)


def _with_longer(state: Any) -> Any:
    """Return a state with longer arrays where kernels carry what rounding takes."""
    if not hasattr(state, "_fields"):
        return state
    state = type(state)(*map(_with_longer, state))
    if isinstance(state, GuardMemory):
        return state._replace(filtered=np.append(state.filtered, np.zeros(CARRIES)))
    if isinstance(state, KalmanMemory):
        state = state._replace(carry=np.zeros(state.theta.size))
    if isinstance(state, KalmanMemory | NoiseGateMemory):
        return state._replace(mean=np.append(state.mean, np.zeros(state.mean.size)))
    return state


# ---- A controller that calculates in single precision ----


class SingleDesign(NamedTuple):
    """Parameters of a controller in single precision, whose functions take and return double."""

    controller: Any


@control.register(SingleDesign)
@in_both_precisions
def _control(design: SingleDesign, state: Any, r: float, y: float) -> float:
    return np.float64(control(design.controller, state, single(r), single(y)))


@set_reference_derivatives.register(SingleDesign)
@in_both_precisions
def _set_reference_derivatives(design: SingleDesign, state: Any, derivatives: Vector) -> None:
    set_reference_derivatives(design.controller, state, derivatives)


@set_schedule_signals.register(SingleDesign)
@in_both_precisions
def _set_schedule_signals(design: SingleDesign, state: Any, values: Vector) -> None:
    set_schedule_signals(design.controller, state, values)


@set_held.register(SingleDesign)
def _set_held(design: SingleDesign, state: Any, held: bool) -> None:
    set_held(design.controller, state, held)


@write_row.register(SingleDesign)
@in_both_precisions
def _write_row(design: SingleDesign, state: Any, row: Vector) -> None:
    write_row(design.controller, state, row)


@status_flags.register(SingleDesign)
def _status_flags(design: SingleDesign, state: Any) -> int:
    return status_flags(design.controller, state)


@reset_loop.register(SingleDesign)
def _reset_loop(design: SingleDesign, state: Any) -> None:
    reset_loop(design.controller, state)


@set_applied_control.register(SingleDesign)
@in_both_precisions
def _set_applied_control(design: SingleDesign, state: Any, u: float) -> None:
    set_applied_control(design.controller, state, single(u))


@bumpless_transfer.register(SingleDesign)
def _bumpless_transfer(design: SingleDesign, state: Any) -> None:
    bumpless_transfer(design.controller, state)


@change_parameters.register(SingleDesign)
def _change_parameters(old: SingleDesign, new: SingleDesign, state: Any) -> None:
    change_parameters(old.controller, new.controller, state)


def check_compilable() -> None:
    """Raise a ``ValueError`` if this Numba would compile single precision as double.

    Literals of kernels become single by a pass of our compiler, which other versions do without.
    """
    if not KERNEL_OPTIONS:
        raise ValueError(
            f"precision = 'single': is compiled with Numba 0.68 only, and this is "
            f"{numba.__version__}; {REMEDY}, or run with interpret=True"
        )


def in_single_precision(controller: Controller) -> SinglePrecision:
    """Return a controller that calculates what ``controller`` does, in single precision.

    Raises
    ------
    ValueError
        for what is no controller; for a parameter out of the range of single precision; and for
        models in Python and ``features.Custom``, which work in double precision only.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01)
    >>> single = in_single_precision(ql.ADRC(observer, omega_c=2.0, u_max=0.1))
    >>> single.step(r=1.0, y=0.0)
    0.10000000149011612
    """
    if isinstance(controller, SinglePrecision):
        return controller
    if isinstance(controller, Axes | StateFeedback):
        what = "several axes run" if isinstance(controller, Axes) else "state feedback runs"
        raise ValueError(
            f"controller = {type(controller).__name__}(…): {what} in Python in double precision "
            "only; quell.export.c(…, precision='single', accept=True) writes the C code in single"
        )
    return SinglePrecision(controller)


class SinglePrecision(Wrapper):
    """A controller in single precision; make it with ``in_single_precision``.

    The given controller is copied and not changed; what it has learned is kept.
    ``parameters.controller`` and the state are single. If it is an ADRC, or one behind a prefilter,
    the methods for start, manual operation and retuning are available here, too.
    """

    def __init__(self, controller: Controller) -> None:
        check_controller(controller)
        self.controller: Any = copy.deepcopy(controller)  # in double: it designs the parameters
        self._initialise()
        self._use_state(single_state(self.parameters.controller, learned_state(controller)))

    def prepare(self) -> None:
        """Compile ``step``, or load it from the disk cache, so that its first call is fast."""
        if not dispatch.interpret_all:
            check_compilable()
        super().prepare()

    def _update_parameters(self) -> None:
        self.parameters = SingleDesign(single_design(self.controller.parameters))

    def initial_state(self) -> Any:
        """Return a state before the first sample."""
        return single_state(self.parameters.controller, self.controller.initial_state())

    @property
    def derivatives(self) -> int:
        """Number of derivatives of the reference that are fed forward."""
        return int(getattr(self.controller, "derivatives", 0))

    def step(self, r: float, y: float, *derivatives: float) -> float:
        """Take one sample: return the control signal [u-unit], see ``ADRC.step``."""
        if derivatives or self.derivatives:
            values = np.array(derivatives, dtype=np.float64)
            set_reference_derivatives(self.parameters, self._state, values)
        return super().step(r, y)

    def _images(self) -> Layout:
        return images_of(self.parameters.controller, self._state, self.dt)

    @property
    def _inner(self) -> Any:
        return _acting_on(super()._inner, self.parameters.controller, self._state)

    def track(self, r: float, y: float, u: float, *derivatives: float) -> float:
        """Take one sample in manual operation, see ``ADRC.track``."""
        state = self._adrc._state
        with manual_operation(state, checks.signal("u", u)):
            self.step(r, y, *derivatives)
        return float(state.loop[0].u_limited)

    def _with_part(self, new: Any) -> Any:
        return SingleDesign(single_design(new))

    def read(self, state: Any) -> Any:
        """Return the estimates and the status in ``state``."""
        return self._inner.read(state)


def _acting_on(controller: Any, design: Any, state: Any) -> Any:
    """Return a controller that acts on ``state`` with the parameters ``design``.

    It shares all else with ``controller``: nothing is designed again.
    """
    acting = object.__new__(type(controller))
    vars(acting).update(vars(controller), parameters=design, _state=state, _packed=None)
    if isinstance(controller, Prefiltered):
        acting.controller = _acting_on(controller.controller, design.controller, state.controller)
    elif isinstance(controller, Compensated):
        parts = design.compensator, state.compensator
        acting.compensator = _acting_on(controller.compensator, *parts)
    return acting


__all__ = ["SinglePrecision", "check_compilable", "in_single_precision"]
