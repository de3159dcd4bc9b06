"""A controller with a disturbance compensator on top of it.

Any controller gives u_0 from r and y, and the compensator adds what cancels the total disturbance
(``controllers/compensator.py``)::

    u_0 = C(r, y),      u = sat( u_0 − (f_L + Δf̂)/b0 )

Limits are those of the sum. What they take is taken from u_0: the controller is told that it
applied ``u_0 + u − u_unlimited``, so that its integrator does not wind up, whichever of the two
parts asked for too much. In manual operation, too. While the plant is held (``set_held``) its
integrator stays as it is (``hold_integrators``): u_0 follows the reference with the rest of the
law, and the release finds the integrator as the brake has found it.

Where a measurement is missing, both receive the one that the observer expects.

With an integrator in C the loop has two, one in C and one in the observer, which share a constant
load: the observer takes it within its lag, and the integrator of C comes to rest where it would be
without load.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from numpy.typing import NDArray

from quell import checks
from quell.controllers.adrc import ADRC
from quell.controllers.base import (
    Controller,
    Limits,
    RateLimit,
    bumpless_transfer,
    change_parameters,
    check_controller,
    control,
    hold_integrators,
    is_usable,
    reset_loop,
    set_applied_control,
    set_held,
    set_reference_derivatives,
    set_schedule_signals,
    status_flags,
    write_row,
)
from quell.controllers.bumpless import manual_operation
from quell.controllers.compensator import Compensator
from quell.controllers.held import rests_at_y
from quell.controllers.law import AdrcDesign, AdrcState, known_now, unlimited_control
from quell.controllers.prefilters import Wrapper, without_prefilters
from quell.controllers.schedule import control_as_observed
from quell.controllers.stateful import StatefulController
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Scalars, clear
from quell.observers.eso import ESO
from quell.observers.forms import acting_control, expected_measurement
from quell.types import Channels, Status, Vector

_CUT = int(Status.SATURATED | Status.RATE_LIMITED | Status.SAFE_SET_ACTED)


class CompensatedDesign(NamedTuple):
    """Parameters of a controller with a compensator."""

    controller: Any  # of u_0
    compensator: AdrcDesign


class CompensatedLoop(Scalars):
    """Scalars kept from one sample to the next."""

    u_given: float  # u_0, as the controller was told that it was applied


class CompensatedState(NamedTuple):
    """State of a controller with a compensator."""

    controller: Any
    compensator: AdrcState
    loop: NDArray[CompensatedLoop]  # (1,)


@kernel
def measured_or_expected(design: AdrcDesign, state: AdrcState, y: float) -> float:
    """Return y, or what the observer of a compensator expects where none has come."""
    inner = state.loop[0]
    if is_usable(y) or inner.started == 0.0:
        return y
    known = known_now(design, state, acting_control(design.eso, state.z, inner.u))
    observed = control_as_observed(design.schedule, state.schedule, inner.u)
    return expected_measurement(design.eso, state.z, observed, known)


@control.register(CompensatedDesign)
def _control(design: CompensatedDesign, state: CompensatedState, r: float, y: float) -> float:
    loop, inner = state.loop[0], state.compensator.loop[0]
    measured = measured_or_expected(design.compensator, state.compensator, y)
    given = control(design.controller, state.controller, r, measured)
    u = control(design.compensator, state.compensator, given, y)
    if inner.held != 0.0:
        hold_integrators(design.controller, state.controller, loop.u_given)
        return u
    loop.u_given = given
    if int(inner.status) & _CUT != 0 or inner.manual != 0.0:
        wished = unlimited_control(
            design.compensator, state.compensator, inner.constant, inner.slope
        )
        loop.u_given = given + (u - wished - inner.offset)
        set_applied_control(design.controller, state.controller, loop.u_given)
    return u


@set_reference_derivatives.register(CompensatedDesign)
def _set_reference_derivatives(
    design: CompensatedDesign, state: CompensatedState, derivatives: Vector
) -> None:
    set_reference_derivatives(design.controller, state.controller, derivatives)
    set_schedule_signals(design.compensator, state.compensator, derivatives)


@set_schedule_signals.register(CompensatedDesign)
def _set_schedule_signals(
    design: CompensatedDesign, state: CompensatedState, values: Vector
) -> None:
    set_schedule_signals(design.compensator, state.compensator, values)


@set_held.register(CompensatedDesign)
def _set_held(design: CompensatedDesign, state: CompensatedState, held: bool) -> None:
    set_held(design.compensator, state.compensator, held)


@write_row.register(CompensatedDesign)
def _write_row(design: CompensatedDesign, state: CompensatedState, row: Vector) -> None:
    row[0] = state.compensator.loop[0].r
    write_row(design.compensator, state.compensator, row[1:])


@status_flags.register(CompensatedDesign)
def _status_flags(design: CompensatedDesign, state: CompensatedState) -> int:
    own = status_flags(design.compensator, state.compensator)
    return own | status_flags(design.controller, state.controller)


@reset_loop.register(CompensatedDesign)
def _reset_loop(design: CompensatedDesign, state: CompensatedState) -> None:
    clear(state.loop)
    reset_loop(design.controller, state.controller)
    reset_loop(design.compensator, state.compensator)


@set_applied_control.register(CompensatedDesign)
def _set_applied_control(design: CompensatedDesign, state: CompensatedState, u: float) -> None:
    loop, inner = state.loop[0], state.compensator.loop[0]
    if inner.held == 0.0:
        loop.u_given += u - inner.u
        set_applied_control(design.controller, state.controller, loop.u_given)
    set_applied_control(design.compensator, state.compensator, u)


@bumpless_transfer.register(CompensatedDesign)
def _bumpless_transfer(design: CompensatedDesign, state: CompensatedState) -> None:
    bumpless_transfer(design.controller, state.controller)
    bumpless_transfer(design.compensator, state.compensator)


@change_parameters.register(CompensatedDesign)
def _change_parameters(
    old: CompensatedDesign, new: CompensatedDesign, state: CompensatedState
) -> None:
    change_parameters(old.controller, new.controller, state.controller)
    change_parameters(old.compensator, new.compensator, state.compensator)


def compensating_part(controller: Any) -> Compensator | None:
    """Return the part of a controller with the observer: itself, or its compensator; else None."""
    part = controller.compensator if isinstance(controller, Compensated) else controller
    return part if isinstance(part, Compensator) else None


def can_be_held(controller: Any) -> bool:
    """Return whether ``set_held`` has an effect: whether an observer in it knows the plant's rest.

    The controller may be behind a prefilter, or in single precision.
    """
    while controller is not None and not isinstance(controller, Compensator):
        inner = getattr(controller, "compensator", None)
        controller = inner or getattr(controller, "controller", None)
    return controller is not None and rests_at_y(controller.observer)


def takes_control(controller: Any) -> bool:
    """Return whether the reference of a controller is u_0: whether it is a compensator alone."""
    return isinstance(controller, Compensator) and not isinstance(controller, ADRC)


def check_takes_compensator(controller: Any) -> None:
    """Raise a ``ValueError`` if a compensator can not stand on top of a controller."""
    check_controller(controller)
    if without_prefilters(controller) is not controller:
        raise ValueError(
            "controller is behind a prefilter: put the prefilter in front of both, as "
            "Prefiltered(Compensated(controller, compensator), prefilter)"
        )
    if isinstance(controller, Compensator | Wrapper):
        raise ValueError(
            f"controller = {type(controller).__name__}: has an observer, or is a wrapper; take a "
            "controller without observer such as quell.baselines.PID, and give a learner or a "
            "guard of an ADRC to itself"
        )


class Compensated(Wrapper):
    """A controller with a compensator on top: ``u = u_0 − (f_L + Δf̂)/b0``.

    It is used as any controller: ``step(r, y)``, ``simulate``, ``analyse``, export, rigs. Both
    parts are copied and not changed. ``start``, ``track``, ``hand_over`` and ``retune`` are those
    of the compensator.

    Parameters
    ----------
    controller
        gives u_0: a PID, P-PI with notches, LQG, any linear controller, or one of your own. An
        ``ADRC`` has an observer and takes learner and guard itself; a prefilter stands in front:
        ``Prefiltered(Compensated(...), prefilter)``.
    compensator
        with the same dt. If it has no limits of u, those of the controller are the limits of the
        sum; the controller alone has none here.

    Raises
    ------
    ValueError
        for another sample time, a controller with an observer or a prefilter of its own, or what is
        no controller or no compensator.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=50.0, omega_o=60.0, dt=0.001)
    >>> pid = ql.baselines.PID(kp=2.0, ki=4.0, kd=0.1, tf=0.005, dt=0.001, u_min=-1.0, u_max=1.0)
    >>> axis = Compensated(pid, ql.Compensator(observer))
    >>> axis.step(r=1.0, y=0.0)
    1.0
    """

    compensator: Compensator

    def __init__(self, controller: Controller, compensator: Compensator) -> None:
        check_takes_compensator(controller)
        if not takes_control(compensator):
            rule = "must be a quell.Compensator(observer, ...)"
            raise ValueError(f"compensator = {compensator!r}: {rule}")
        if float(controller.dt) != compensator.dt:
            raise ValueError(
                f"compensator has dt = {compensator.dt!r} s, and the controller "
                f"{float(controller.dt)!r} s: must be the same"
            )
        self.controller = copy.copy(controller)
        self.compensator = copy.copy(compensator)
        self._take_limits()
        self._initialise()

    def _take_limits(self) -> None:
        """Make limits those of the sum: the controller itself has none."""
        own: Limits | None = getattr(self.controller, "limits", None)
        if own is None or not hasattr(self.controller, "set_limits"):
            return
        if not any(map(math.isfinite, self.compensator.limits)):
            dt = self.dt
            rates = (own.least_change / dt, own.most_change / dt)
            free = not any(map(math.isfinite, rates))
            self.compensator.set_limits(
                u_min=own.low, u_max=own.high, rate_limit=math.inf if free else rates
            )
        self.controller.set_limits(u_min=-math.inf, u_max=math.inf, rate_limit=math.inf)

    def __copy__(self) -> Any:
        """Return a copy with parts of its own, which shares no state with this one."""
        made = type(self).__new__(type(self))
        parts = {name: copy.copy(getattr(self, name)) for name in ("controller", "compensator")}
        made.__setstate__({**self.__getstate__(), **parts})
        return made

    def _use_state(self, state: CompensatedState) -> None:
        super()._use_state(state)
        # The parts share theirs of the running state, so their methods act on it.
        self.compensator._use_state(state.compensator)
        if isinstance(self.controller, StatefulController):
            self.controller._use_state(state.controller)

    def _update_parameters(self) -> None:
        self.parameters = CompensatedDesign(self.controller.parameters, self.compensator.parameters)

    def initial_state(self) -> CompensatedState:
        """Return a state before the first sample, with nothing learned."""
        states = self.controller.initial_state(), self.compensator.initial_state()
        return CompensatedState(*states, CompensatedLoop.zeros())

    @property
    def _inner(self) -> Compensator:
        return self.compensator

    @property
    def _retuned_part(self) -> Any:
        return self.compensator

    def _with_part(self, new: Any) -> Any:
        return self.parameters._replace(compensator=new)

    @property
    def external_signals(self) -> int:
        """Number of external signals that the compensator's schedule follows."""
        return self.compensator.external_signals

    def at(self, *signals: float) -> Any:
        """Return the controller without schedule at fixed signals, see ``ADRC.at``."""
        made = copy.copy(self)
        made.compensator = self.compensator.at(*signals)
        made._initialise()
        return made

    @property
    def observer(self) -> ESO:
        """The compensator's observer."""
        return self.compensator.observer

    @property
    def derivatives(self) -> int:
        """Number of derivatives of the reference that the controller feeds forward."""
        return int(getattr(self.controller, "derivatives", 0))

    @property
    def limits(self) -> Limits:
        """Limits of the control signal, of the sum of both parts."""
        return self.compensator.limits

    def set_limits(
        self,
        *,
        u_min: float | None = None,
        u_max: float | None = None,
        rate_limit: RateLimit | None = None,
    ) -> None:
        """Change limits while running, see ``ADRC.set_limits``."""
        self.compensator.set_limits(u_min=u_min, u_max=u_max, rate_limit=rate_limit)
        self._take_parameters()

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the features whose coefficients the channel ``theta`` has."""
        return self.compensator.features

    @property
    def channels(self) -> Channels:
        """Name and width of what ``write_row`` writes, in order."""
        return (("u_given", 1), *self.compensator.channels)

    def start(self, y: float, u: float = 0.0, r: float | None = None) -> None:
        """Start at a plant that rests at ``y`` under ``u``, see ``ADRC.start``.

        The controller begins at its rest, and the observer's estimate holds the load; so the next
        step continues from ``u`` whatever its reference is, and ``r`` is checked only.
        """
        if r is not None:
            checks.signal("r", r)
        reset_loop(self.parameters.controller, self._state.controller)
        self.compensator.start(y, u, 0.0)

    def start_at(self, x: Any, f: float = 0.0, *, u: float = 0.0, r: float | None = None) -> None:
        """Start with given estimates, see ``ADRC.start_at``; the controller begins at its rest."""
        if r is not None:
            checks.signal("r", r)
        reset_loop(self.parameters.controller, self._state.controller)
        self.compensator.start_at(x, f, u=u, r=0.0)

    def track(self, r: float, y: float, u: float) -> float:
        """Take one sample in manual operation, see ``ADRC.track``; the controller follows u."""
        state = self._state.compensator
        with manual_operation(state, checks.signal("u", u)):
            self.step(r, y)
        return float(state.loop[0].u_limited)

    def read(self, state: CompensatedState) -> Any:
        """Return the estimates of the compensator in ``state``."""
        return self.compensator.read(state.compensator)

    @property
    def _external_fields(self) -> tuple[str, ...]:
        return tuple(f"compensator.{name}" for name in self.compensator._external_fields)

    def _external_snapshots(self, state: CompensatedState) -> dict[str, Any]:
        found = self.compensator._external_snapshots(state.compensator)
        return {f"compensator.{name}": value for name, value in found.items()}

    def _restore_external(self, state: CompensatedState, snapshots: Mapping[str, Any]) -> None:
        inner = {name.removeprefix("compensator."): value for name, value in snapshots.items()}
        self.compensator._restore_external(state.compensator, inner)
