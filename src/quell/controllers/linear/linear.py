"""The controller of a sampled linear law of two degrees of freedom."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.bad_samples import hold_last_good, is_usable_control
from quell.controllers.base import control, reset_loop, set_applied_control, status_flags, write_row
from quell.controllers.limits import (
    Limits,
    RateLimit,
    apply_limits,
    checked_limits,
    control_at_rest,
    largest_wish,
)
from quell.controllers.linear.law import LinearLaw, advance_law, checked_law, rest_state
from quell.controllers.linear.transfer import as_state_space, sampled_law
from quell.controllers.stateful import StatefulController
from quell.kernels.dispatch import kernel
from quell.kernels.scalars import Scalars, clear
from quell.types import Channels, Status, Vector

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_OVERFLOWED = int(Status.OVERFLOWED)
# An integrator gives a control signal to rounding; other laws miss it by far more. Chosen by hand.
_NEAR = 1e-6


class LinearDesign(NamedTuple):
    """Parameters of the controller."""

    law: Any  # a LinearLaw or DeltaLaw
    start: Vector  # initial state for y = 1 (m,), see ``rest_state``
    limits: Limits


class LinearLoop(Scalars):
    """Scalars of the control loop, kept from one sample to the next."""

    u: float  # applied control signal
    u_unlimited: float  # control signal of the law before limits
    r: float  # last finite reference
    y: float  # last finite measurement
    started: float  # 1 after the first finite measurement, else 0
    has_reference: float  # 1 after the first finite reference, else 0
    status: float  # status flags of the last sample


class LinearState(NamedTuple):
    """State of the controller."""

    x: Vector  # state of the law (m,)
    next: Vector  # memory for the next state, or carries of a law in delta form (m,)
    loop: NDArray[LinearLoop]  # (1,)


@kernel
def _set_rest(design: LinearDesign, state: LinearState, y: float) -> None:
    """Set the state of the law to rest at ``y``."""
    for i in range(state.x.size):
        state.x[i] = design.start[i] * y
        state.next[i] = 0.0


@kernel
def _unlimited_control(design: LinearDesign, state: LinearState) -> float:
    unlimited = design.law.D_r * state.loop[0].r + design.law.D_y * state.loop[0].y
    for i in range(state.x.size):
        unlimited += design.law.C[i] * state.x[i]
    return unlimited


@control.register(LinearDesign)
def _control(design: LinearDesign, state: LinearState, r: float, y: float) -> float:
    loop = state.loop[0]
    status = hold_last_good(loop, r, y)
    if loop.started == 0.0:
        if status & _MEASUREMENT_HELD != 0:
            loop.u = loop.u_unlimited = control_at_rest(design.limits)
            loop.status = status
            return loop.u
        _set_rest(design, state, loop.y)
        loop.started = 1.0
    unlimited = _unlimited_control(design, state)
    if not is_usable_control(design.limits, unlimited):
        status |= _OVERFLOWED
        _set_rest(design, state, loop.y)
        unlimited = loop.u
    elif abs(unlimited) > largest_wish(design.limits):
        status |= _OVERFLOWED
        _set_rest(design, state, loop.y)
        unlimited = _unlimited_control(design, state)
    u, cut = apply_limits(design.limits, unlimited, loop.u)
    advance_law(design.law, state.x, state.next, loop.r, loop.y, u)
    loop.u = u
    loop.u_unlimited = unlimited
    loop.status = status | cut
    return u


@write_row.register(LinearDesign)
def _write_row(design: LinearDesign, state: LinearState, row: Vector) -> None:
    row[0] = state.loop[0].u_unlimited
    row[1] = state.loop[0].status


@status_flags.register(LinearDesign)
def _status_flags(design: LinearDesign, state: LinearState) -> int:
    return int(state.loop[0].status)


@reset_loop.register(LinearDesign)
def _reset_loop(design: LinearDesign, state: LinearState) -> None:
    clear(state.loop)


@set_applied_control.register(LinearDesign)
def _set_applied_control(design: LinearDesign, state: LinearState, u: float) -> None:
    # The state was updated with the u that ``control`` returned.
    correction = u - state.loop[0].u
    for i in range(state.x.size):
        state.x[i] += design.law.B_u[i] * correction
    state.loop[0].u = u


class LinearController(StatefulController):
    """A sampled linear law of two degrees of freedom, with limits.

    It starts from rest: the initial state is that of a loop at rest at r = y = y_0 with u = 0,
    where y_0 is the first finite measurement. So u starts without a bump if the law has such a
    state, as every law with integral action has. Otherwise the state is constant and u follows from
    it.

    The applied control signal, after limits, drives the law through ``B_u``, which
    ``from_transfer_function`` chooses. Values that are not finite are replaced by the last finite
    ones, and u waits for a first finite measurement, as in ``ADRC``.

    Parameters
    ----------
    law
        the law, sampled with ``dt``.
    dt
        sample time [s].
    u_min, u_max
        limits of the control signal [u-unit].
    rate_limit
        largest rate of the control signal, in both directions, or (lowest, highest) [u-unit/s].
    name
        label in tables and plots.

    Raises
    ------
    ValueError
        for matrices of unsuitable shape or with entries that are not finite, limits in the wrong
        order, or a rate limit or sample time that is not positive.

    Examples
    --------
    >>> num, den = [2.0, 1.0], [1.0, 0.0]  # 2 + 1/s
    >>> controller = LinearController.from_transfer_function(num, den, dt=0.1, u_max=1.5)
    >>> controller.step(r=1.0, y=0.0)
    1.5
    >>> controller.status
    <Status.SATURATED: 4>
    """

    features: tuple[str, ...] = ()
    channels: Channels = (("u_wished", 1), ("status", 1))

    def __init__(
        self,
        law: LinearLaw,
        dt: float,
        *,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: RateLimit = math.inf,
        name: str = "linear controller",
    ) -> None:
        self.law = checked_law(law)
        self.dt = checks.positive("dt", dt, "s")
        self.name = name
        self._limits = checked_limits(u_min, u_max, rate_limit, self.dt)
        self._initialise()

    @classmethod
    def from_transfer_function(
        cls,
        num: Any,
        den: Any = None,
        dt: float | None = None,
        *,
        feedback: str = "error",
        method: str = "tustin",
        prewarp: float | None = None,
        tracking_time: float | None = None,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: RateLimit = math.inf,
        name: str = "transfer function",
    ) -> LinearController:
        """Return the controller ``u = C (r − y)`` or ``u = −C y`` for a transfer function C(s).

        C is sampled in scaled, balanced coordinates of its state, not as polynomials in z: their
        roots are close to 1, where coefficients determine them badly. Raises ``ValueError`` for a
        C(s) that is not proper or has several inputs or outputs.

        Parameters
        ----------
        num, den
            polynomials in s, highest power first; or ``num`` is a ``control.TransferFunction`` or
            ``control.StateSpace`` in continuous time, without ``den``.
        dt
            sample time [s].
        feedback
            ``"error"``: C acts on r − y; ``"output"``: C acts on −y.
        method
            ``"tustin"``: ``s = 2 (z − 1) / (dt (z + 1))``; or ``"zoh"``: r and y are constant
            between samples, which delays by half a sample.
        prewarp
            frequency [rad/s] at which the response with Tustin's method is exactly that of C(s).
        tracking_time
            time constant with which integrators follow u at its limits [s]; see
            ``quell.controllers.linear.transfer.anti_windup``. By default that of C's slowest zero
            other than s = 0, or of its slowest pole if it has no such zero.
        u_min, u_max, rate_limit, name
            as for the class.
        """
        dt = checks.positive("dt", dt, "s")
        on_error = checks.one_of("feedback", feedback, ("error", "output")) == "error"
        A, B, C, D = as_state_space(num, den)
        from_r = 1.0 if on_error else 0.0
        system = (A, np.hstack([from_r * B, -B]), C, np.hstack([from_r * D, -D]))
        law = sampled_law(system, dt, method=method, prewarp=prewarp, tracking_time=tracking_time)
        return LinearController(law, dt, u_min=u_min, u_max=u_max, rate_limit=rate_limit, name=name)

    def _update_parameters(self) -> None:
        self.parameters = LinearDesign(self.law, rest_state(self.law), self._limits)

    def initial_state(self) -> LinearState:
        """Return a state before the first sample."""
        size = self.law.C.size
        return LinearState(np.zeros(size), np.zeros(size), LinearLoop.zeros())

    def start(self, y: float, u: float = 0.0, r: float | None = None) -> None:
        """Start at a plant that rests at ``y`` under ``u``: the next ``step`` continues from ``u``.

        Parameters
        ----------
        y
            measurement [y-unit].
        u
            control signal that holds the plant there [u-unit]; should be within the limits.
        r
            reference of the next step [y-unit]; ``y`` by default.

        Raises
        ------
        ValueError
            for a law without integral action, whose u follows from r and y, and for numbers that
            are not finite.
        """
        y, u = checks.signal("y", y), checks.signal("u", u)
        goal = y if r is None else checks.signal("r", r)
        wanted = u - self.law.D_r * (goal - y)  # what the law would give at r = y
        x = rest_state(self.law, y, wanted)
        given = float(self.law.C @ x) + (self.law.D_r + self.law.D_y) * y
        if abs(given - wanted) > _NEAR * (abs(given) + abs(wanted)):
            rule = "the law has no integral action, its u follows from r and y; leave start out"
            raise ValueError(f"u = {u!r} at y = {y!r}: {rule}")
        self.reset()
        self._state.x[:] = x
        loop = self._state.loop[0]
        loop.u, loop.u_unlimited, loop.r, loop.y = u, u, goal, y
        loop.started = loop.has_reference = 1.0

    @property
    def status(self) -> Status:
        """Status flags of the last step."""
        return Status(int(self._state.loop[0].status))
