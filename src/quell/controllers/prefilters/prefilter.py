"""A prefilter of the reference in front of any controller.

``prefilter`` and ``settle`` are registered for the type of a prefilter's parameters. A prefilter
that provides derivatives of the shaped reference has an attribute ``derivatives``, their number,
and registers ``write_derivatives``. One that would take long to return from an absurd reference
registers ``restart_if_astray``. One that can stop registers ``stopping_point``.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.adrc.handover import manual_operation
from quell.controllers.bad_samples import is_usable
from quell.controllers.base import (
    Controller,
    bumpless_transfer,
    check_controller,
    control,
    reset_loop,
    set_applied_control,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.prefilters.wrapper import Wrapper
from quell.controllers.stateful import StatefulController
from quell.kernels.dispatch import generic, generic_with_default, is_finite
from quell.kernels.scalars import Scalars, clear
from quell.types import Channels, Status, Vector

_REFERENCE_HELD = int(Status.REFERENCE_HELD)


class Prefilter(Protocol):
    """The interface of a prefilter."""

    def design(self, dt: float) -> Any:
        """Return the parameters, a NamedTuple, for a sample time ``dt`` [s]."""

    def memory(self, design: Any) -> Any:
        """Return the state, a NamedTuple of arrays."""


@generic
def prefilter(design: Any, memory: Any, r: float) -> float:
    """Take one sample: return the shaped reference for the finite reference ``r``."""
    raise TypeError


@generic
def settle(design: Any, memory: Any, value: float) -> None:
    """Set the state to rest at ``value``, as after a constant reference."""
    raise TypeError


@generic_with_default
def write_derivatives(design: Any, memory: Any, derivatives: Vector) -> None:
    """Write the first, second, … derivative of the last shaped reference."""


@generic_with_default
def restart_if_astray(design: Any, memory: Any, r: float, y: float) -> None:
    """Start again from rest at ``y`` if the shaped reference is no transition from y to r."""


@generic
def stopping_point(design: Any, memory: Any) -> float:
    """Return where the shaped reference comes to rest soonest, for a prefilter with limits."""
    raise TypeError


class PrefilteredDesign(NamedTuple):
    """Parameters of a controller behind a prefilter."""

    controller: Any
    prefilter: Any


class PrefilteredLoop(Scalars):
    """Scalars of the prefilter, kept from one sample to the next."""

    r_shaped: float  # reference that the controller received
    r: float  # last finite reference
    started: float  # 1 after the first finite measurement, else 0
    has_reference: float  # 1 after the first finite reference, else 0
    status: float  # status flags of the prefilter in the last sample


class PrefilteredState(NamedTuple):
    """State of a controller behind a prefilter."""

    controller: Any
    prefilter: Any
    derivatives: Vector  # derivatives of the shaped reference; empty if the controller uses none
    loop: NDArray[PrefilteredLoop]  # (1,)


@control.register(PrefilteredDesign)
def _control(design: PrefilteredDesign, state: PrefilteredState, r: float, y: float) -> float:
    loop = state.loop[0]
    loop.status = 0.0
    if loop.started == 0.0 and is_usable(y):
        settle(design.prefilter, state.prefilter, y)
        loop.started = 1.0
    if is_usable(r):
        loop.r = r
        loop.has_reference = 1.0
    else:
        loop.status = _REFERENCE_HELD
    shaped = r
    if loop.started != 0.0 and loop.has_reference != 0.0:
        if is_usable(y):
            restart_if_astray(design.prefilter, state.prefilter, loop.r, y)
        shaped = prefilter(design.prefilter, state.prefilter, loop.r)
        if state.derivatives.size > 0:
            write_derivatives(design.prefilter, state.prefilter, state.derivatives)
            set_reference_derivatives(design.controller, state.controller, state.derivatives)
    loop.r_shaped = shaped if is_finite(shaped) else y
    return control(design.controller, state.controller, shaped, y)


@write_row.register(PrefilteredDesign)
def _write_row(design: PrefilteredDesign, state: PrefilteredState, row: Vector) -> None:
    row[0] = state.loop[0].r_shaped
    write_row(design.controller, state.controller, row[1:])


@status_flags.register(PrefilteredDesign)
def _status_flags(design: PrefilteredDesign, state: PrefilteredState) -> int:
    return status_flags(design.controller, state.controller) | int(state.loop[0].status)


@reset_loop.register(PrefilteredDesign)
def _reset_loop(design: PrefilteredDesign, state: PrefilteredState) -> None:
    clear(state.loop)
    reset_loop(design.controller, state.controller)


@set_applied_control.register(PrefilteredDesign)
def _set_applied_control(design: PrefilteredDesign, state: PrefilteredState, u: float) -> None:
    set_applied_control(design.controller, state.controller, u)


@bumpless_transfer.register(PrefilteredDesign)
def _bumpless_transfer(design: PrefilteredDesign, state: PrefilteredState) -> None:
    bumpless_transfer(design.controller, state.controller)


class Prefiltered(Wrapper):
    """A controller that follows a prefiltered reference.

    The prefilter starts at rest at the first finite measurement, so another reference in the first
    sample acts as a step. The shaped reference is the channel ``r_shaped``. The given controller is
    copied and not changed. If it is an ADRC, its methods ``start``, ``start_at``, ``track``,
    ``hand_over``, ``applied``, ``increment`` and ``retune`` are available here.

    Parameters
    ----------
    controller
        any controller: ``ADRC``, ``LinearController``, another ``Prefiltered``.
    prefilter
        for example ``quell.baselines.ZV(omega, zeta)``; for a controller with feedforward one with
        derivatives, such as ``ReferenceModel``.

    Raises
    ------
    ValueError
        for an object that is no controller or no prefilter, and for a controller with feedforward
        behind a prefilter without derivatives.

    Examples
    --------
    >>> from quell.controllers.baselines import PID, ZV
    >>> shaped = Prefiltered(PID(kp=2.0, dt=0.1), ZV(omega=5.0))
    >>> shaped.step(r=1.0, y=0.0)
    1.0
    """

    def __init__(self, controller: Controller, prefilter: Prefilter) -> None:
        check_controller(controller)
        complete = hasattr(prefilter, "design") and hasattr(prefilter, "memory")
        if isinstance(prefilter, type) or not complete:
            rule = "must be a prefilter, for example quell.baselines.ZV(omega=1.4)"
            raise ValueError(f"prefilter = {prefilter!r}: {rule}")
        if getattr(controller, "derivatives", 0) and not getattr(prefilter, "derivatives", 0):
            raise ValueError(
                f"controller has feedforward, and {type(prefilter).__name__} provides no "
                "derivatives of the shaped reference: use feedforward=False, or a prefilter with "
                "derivatives such as ReferenceModel"
            )
        self.controller: Any = copy.copy(controller)
        self.prefilter = prefilter
        self._initialise()

    def _use_state(self, state: PrefilteredState) -> None:
        super()._use_state(state)
        # The controller shares its part of the running state, so its methods act on it.
        if isinstance(self.controller, StatefulController):
            self.controller._use_state(state.controller)

    def start(self, y: float, u: float = 0.0, r: float | None = None) -> None:
        """Start at rest at ``y``, see ``ADRC.start``; the prefilter is at rest there too."""
        super().start(y, u, r)
        self._settle_at(float(y), float(y if r is None else r))

    def start_at(self, x: Any, f: float = 0.0, *, u: float = 0.0, r: float | None = None) -> None:
        """Start with given estimates, see ``ADRC.start_at``; the prefilter is at rest at x[0]."""
        super().start_at(x, f, u=u, r=r)
        y = float(np.ravel(x)[0])
        self._settle_at(y, float(y if r is None else r))

    def _settle_at(self, y: float, r: float) -> None:
        settle(self.parameters.prefilter, self._state.prefilter, y)
        loop = self._state.loop[0]
        loop.started = loop.has_reference = 1.0
        loop.r = r

    def track(self, r: float, y: float, u: float) -> float:
        """Take one sample in manual operation, see ``ADRC.track``."""
        state = self._adrc._state
        with manual_operation(state, checks.signal("u", u)):
            self.step(r, y)
        return float(state.loop[0].u_limited)

    def increment(self, r: float, y: float) -> float:
        """Take one sample and return the change of the control signal, see ``ADRC.increment``."""
        before = float(self._adrc._state.loop[0].u)
        return self.step(r, y) - before

    @property
    def stopping_point(self) -> float:
        """Where the shaped reference can come to rest soonest [y-unit]: as r of a step it stops.

        Raises ``ValueError`` for a prefilter without limits that plan a stop.
        """
        design = self.parameters.prefilter
        if type(design) not in stopping_point.implementations:
            raise ValueError(
                f"prefilter = {type(self.prefilter).__name__}: plans no stop; take ProfileGenerator"
            )
        return float(stopping_point(design, self._state.prefilter))

    def _take_parameters(self) -> None:
        """Use the parameters that the controller has now."""
        self.parameters = self.parameters._replace(controller=self.controller.parameters)
        self._pack_again()

    def _update_parameters(self) -> None:
        design = self.prefilter.design(self.dt)
        self.parameters = PrefilteredDesign(self.controller.parameters, design)

    @property
    def channels(self) -> Channels:
        """Name and width of what ``write_row`` writes, in order."""
        return (("r_shaped", 1), *super().channels)

    def initial_state(self) -> PrefilteredState:
        """Return a state before the first sample, with nothing learned."""
        used = getattr(self.controller, "derivatives", 0) > 0
        count = getattr(self.prefilter, "derivatives", 0) if used else 0
        inner = self.controller.initial_state()
        memory = self.prefilter.memory(self.parameters.prefilter)
        return PrefilteredState(inner, memory, np.zeros(count), PrefilteredLoop.zeros())

    def read(self, state: PrefilteredState) -> Any:
        """Return the estimates of the ADRC in ``state``."""
        return self.controller.read(state.controller)

    @property
    def _external_fields(self) -> tuple[str, ...]:
        inner = getattr(self.controller, "_external_fields", ())
        return tuple(f"controller.{name}" for name in inner)

    def _external_snapshots(self, state: PrefilteredState) -> dict[str, Any]:
        if not self._external_fields:
            return {}
        saved = self.controller._saved(state.controller)
        return {name: saved[name.removeprefix("controller.")][()] for name in self._external_fields}

    def _restore_external(self, state: PrefilteredState, snapshots: Mapping[str, Any]) -> None:
        inner = {name.removeprefix("controller."): value for name, value in snapshots.items()}
        self.controller._restore_external(state.controller, inner)


def without_prefilters(controller: Controller) -> Controller:
    """Return the controller behind all prefilters, which are outside of the loop."""
    while isinstance(controller, Prefiltered):
        controller = controller.controller
    return controller
