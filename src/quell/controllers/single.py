"""Controllers in single precision.

Parameters and states of controllers in single precision.

A controller that calculates in single precision, as it does on a processor without double.

Its parameters are designed in double precision and then rounded, its state is single, and its
observer or linear law is in delta form (``observers/forms.py``). The plant, the clock and the
record stay in double: r and y are rounded where the controller receives them. Several axes and
state feedback run so, too, with arrays of r, y and u.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numba
import numpy as np

from quell import checks
from quell.controllers.allocation import FunctionGain
from quell.controllers.axes import Axes, AxesDesign
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
from quell.controllers.bumpless import manual_operation
from quell.controllers.compensated import Compensated, CompensatedDesign
from quell.controllers.held import HeldDesign
from quell.controllers.law import AdrcDesign
from quell.controllers.linear import LinearLaw, delta_law
from quell.controllers.memory import Layout, learned_state
from quell.controllers.prefilters import Prefiltered, PrefilteredDesign, Wrapper
from quell.controllers.safe_set import SafeSetDesign
from quell.controllers.several import control_all
from quell.controllers.state_space import FeedbackDesign, StateFeedback
from quell.features.base import CustomDesign
from quell.guard.kernels import CARRIES, GuardDesign, GuardMemory
from quell.kernels import dispatch
from quell.kernels.dispatch import generic_with_default
from quell.kernels.functions import single
from quell.kernels.linking import KERNEL_OPTIONS, in_both_precisions
from quell.kernels.numba_internals import REMEDY
from quell.kernels.single import in_single
from quell.kernels.sized import remade
from quell.lazy import imported_on_use
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
    if isinstance(design, tuple):
        return remade(design, map(_in_delta_form, design))
    return design


def single_state(design: Any, state: Any) -> Any:
    """Return the state for ``design``, which ``single_design`` returned.

    ``state`` is that of the controller in double precision before the first sample.
    """
    return in_single(_with_carries(design, state))


def _check(value: Any, name: str) -> None:
    """Raise a ``ValueError`` for a part that works in double only, or averages for too long."""
    if isinstance(value, FunctionGain):
        raise ValueError(
            "precision = 'single': B0 or M is a function, which is compiled in double precision; "
            "stay in double, or take a constant matrix"
        )
    if isinstance(value, PythonDesign | CustomDesign):
        what = "a model in Python" if isinstance(value, PythonDesign) else "features.Custom"
        raise ValueError(f"{name} is {what}: it works in double precision only; {_OTHERS}")
    for field, part in zip(getattr(value, "_fields", range(len(value))), value, strict=True):
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
        axes = tuple(map(_with_carries, design.axes, state.axes))
        return state._replace(axes=axes, learning=_with_longer(state.learning))
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


@generic_with_default
@in_both_precisions
def control_in_single(controller: Any, state: Any, r: Vector, y: Vector, u: Vector) -> None:
    """Take one sample of a controller in single precision, with signals in double."""
    u[0] = np.float64(control(controller, state, single(r[0]), single(y[0])))


@control_in_single.register(AxesDesign)
@control_in_single.register(FeedbackDesign)
@in_both_precisions
def _control_in_single(controller: Any, state: Any, r: Vector, y: Vector, u: Vector) -> None:
    for i in range(r.size):
        state.r_given[i] = single(r[i])
    for i in range(y.size):
        state.y_given[i] = single(y[i])
    control_all(controller, state, state.r_given, state.y_given, state.u)
    for k in range(u.size):
        u[k] = np.float64(state.u[k])


@control_all.register(SingleDesign)
@in_both_precisions
def _control_all(design: SingleDesign, state: Any, r: Vector, y: Vector, u: Vector) -> None:
    control_in_single(design.controller, state, r, y, u)


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


def in_single_precision(controller: Controller | Axes | StateFeedback) -> SinglePrecision:
    """Return a controller that calculates what ``controller`` does, in single precision.

    Of ``Axes`` and ``StateFeedback`` it takes and returns arrays, as they do.

    Raises
    ------
    ValueError
        for what is no controller; for a parameter out of the range of single precision; for
        models in Python and ``features.Custom``, which work in double precision only; and for axes
        whose B0 is a function.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01)
    >>> single = in_single_precision(ql.ADRC(observer, omega_c=2.0, u_max=0.1))
    >>> single.step(r=1.0, y=0.0)
    0.10000000149011612
    """
    return controller if isinstance(controller, SinglePrecision) else SinglePrecision(controller)


# What a controller of several signals has beside the attributes of one.
_OF_SEVERAL = ("axes", "estimates", "inputs", "names", "outputs", "references")


class SinglePrecision(Wrapper):
    """A controller in single precision; make it with ``in_single_precision``.

    The given controller is copied and not changed; what it has learned is kept.
    ``parameters.controller`` and the state are single. If it is an ADRC, or one behind a prefilter,
    the methods for start, manual operation and retuning are available here, too. Those of ``Axes``
    and ``StateFeedback`` are, but for ``retune``: make it again from retuned axes.
    """

    _acts: Any = None

    def __init__(self, controller: Any) -> None:
        check_controller(controller, several=True)
        self.controller: Any = copy.deepcopy(controller)  # in double: it designs the parameters
        self._several = hasattr(controller, "inputs")  # r, y and u are arrays; asked in each step
        self._initialise()
        self._use_state(single_state(self.parameters.controller, learned_state(controller)))

    def __getattr__(self, name: str) -> Any:
        """Return what a controller of several signals has; other names are those of ``Wrapper``."""
        return getattr(self._acting, name) if name in _OF_SEVERAL else super().__getattr__(name)

    @property
    def _acting(self) -> Any:
        """The controller, acting on this state with parameters in single precision."""
        design, acts = self.parameters.controller, self._acts
        if acts is None or acts.parameters is not design or acts._state is not self._state:
            acts = self._acts = _acting_on(self.controller, design, self._state)
        return acts

    def prepare(self) -> None:
        """Compile ``step``, or load it from the disk cache, so that its first call is fast."""
        if not dispatch.interpret_all:
            check_compilable()
        if self._several:
            self._acting.prepare()
        else:
            super().prepare()

    def _update_parameters(self) -> None:
        self.parameters = SingleDesign(single_design(self.controller.parameters))

    def initial_state(self) -> Any:
        """Return a state before the first sample."""
        return single_state(self.parameters.controller, self.controller.initial_state())

    @property
    def derivatives(self) -> Any:
        """Number of derivatives of the reference, or of each one, that are fed forward."""
        return getattr(self.controller, "derivatives", 0)

    def step(self, r: Any, y: Any, *derivatives: Any) -> Any:
        """Take one sample: return the control signal [u-unit], see ``ADRC.step``.

        Of several signals return u (m,) in double precision, see ``Axes.step``.
        """
        if self._several:
            if self._acting._packed is None:
                self.prepare()
            with np.errstate(over="ignore"):  # a number out of the range of single becomes infinite
                return self._acting.step(r, y, *derivatives).astype(np.float64)
        if derivatives or self.derivatives:
            values = np.array(derivatives, dtype=np.float64)
            set_reference_derivatives(self.parameters, self._state, values)
        return super().step(r, y)

    def applied(self, u: Any) -> None:
        """Set what was really applied since the last ``step``, see ``ADRC.applied``."""
        if self._several:
            self._acting.applied(u)
        else:
            super().applied(u)

    def start(self, y: Any, u: Any = None, r: Any = None) -> None:
        """Start at a plant that rests at ``y`` under ``u``, zero by default, see ``ADRC.start``."""
        rest = np.zeros(self.inputs) if self._several else 0.0
        self._inner.start(y, rest if u is None else u, r)

    def _images(self) -> Layout:
        return self._acting._images()

    @property
    def _inner(self) -> Any:
        if not self._several:
            _ = super()._inner
        return self._acting

    def _check_inner(self) -> None:
        if self._several:
            raise ValueError("retune: NOT possible of axes in single precision: make it again")
        super()._check_inner()

    def track(self, r: Any, y: Any, u: Any, *derivatives: float) -> Any:
        """Take one sample in manual operation, see ``ADRC.track`` and ``Axes.track``."""
        if self._several:
            return self._acting.track(r, y, u)
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
    elif isinstance(controller, Axes):
        acting.axes = tuple(map(_acting_on, controller.axes, design.axes, state.axes))
    return acting


__all__ = ["SinglePrecision", "check_compilable", "in_single_precision"]
__getattr__ = imported_on_use(__name__, {}, (), {"SeveralInSingle": "SinglePrecision"})
