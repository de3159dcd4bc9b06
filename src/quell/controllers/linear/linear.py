"""Linear controllers of two degrees of freedom in discrete time: one kernel for every linear law there is."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.bad_samples import control_at_rest, hold_last_good
from quell.controllers.base import control, reset_loop, set_applied_control, status_flags, write_row
from quell.controllers.limits import Limits, apply_limits, checked_limits
from quell.controllers.linear.law import LinearLaw, checked_law, rest_state
from quell.controllers.stateful import StatefulController
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.scalars import Scalars, clear
from quell.types import Status, Vector

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_OVERFLOWED = int(Status.OVERFLOWED)


class LinearDesign(NamedTuple):
    """Parameters of the controller."""

    law: LinearLaw
    start: Vector
    """The state (m,) of rest at y = 1."""
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

    x: Vector
    """The law's state (m,)."""
    next: Vector
    """Room for the one after it (m,)."""
    loop: NDArray[LinearLoop]
    """(1,)."""


@kernel
def _start(design: LinearDesign, state: LinearState, y: float) -> None:
    for i in range(state.x.size):
        state.x[i] = design.start[i] * y


@control.register(LinearDesign)
def _control(design: LinearDesign, state: LinearState, r: float, y: float) -> float:
    law, x, loop = design.law, state.x, state.loop[0]
    status = hold_last_good(loop, r, y)
    if loop.started == 0.0:
        if status & _MEASUREMENT_HELD != 0:
            loop.u = loop.u_unlimited = control_at_rest(design.limits)
            loop.status = status
            return loop.u
        _start(design, state, loop.y)
        loop.started = 1.0
    wished = law.D_r * loop.r + law.D_y * loop.y
    for i in range(x.size):
        wished += law.C[i] * x[i]
    if not is_finite(wished):
        status |= _OVERFLOWED
        _start(design, state, loop.y)
        wished = loop.u
    u, cut = apply_limits(design.limits, wished, loop.u)
    for i in range(x.size):
        total = law.B_r[i] * loop.r + law.B_y[i] * loop.y + law.B_u[i] * u
        for j in range(x.size):
            total += law.A[i, j] * x[j]
        state.next[i] = total
    for i in range(x.size):
        x[i] = state.next[i]
    loop.u = u
    loop.u_unlimited = wished
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
    # The law's state went on with the u that was returned.
    correction = u - state.loop[0].u
    for i in range(state.x.size):
        state.x[i] += design.law.B_u[i] * correction
    state.loop[0].u = u


class LinearController(StatefulController):
    """Any sampled linear law of two degrees of freedom, with limits, as a controller.

    It starts from rest: at the first good measurement y_0 the state is the one that a loop would have that had been resting at
    r = y = y_0 with u = 0. So no bump comes from y_0 ≠ 0 where the law has such a state; every law with integral action has. Where it has
    none, the state is at rest and u is what the law makes of it.

    What is applied, after limits, drives the law through ``B_u``; ``from_transfer_function`` chooses it. Bad samples are held, and u waits
    for a first good measurement, as in ``ADRC``.

    Parameters
    ----------
    law
        the law, for the sample time ``dt``.
    dt
        sample time [s].
    u_min, u_max
        limits of the control signal [u-unit].
    rate_limit
        how fast it may move, in either direction [u-unit/s].
    name
        for tables and plots.

    Raises
    ------
    ValueError
        for matrices whose shapes do not fit or that hold what is not finite, limits in the wrong order, a rate limit or sample time
        that is not positive.

    Examples
    --------
    >>> controller = LinearController.from_transfer_function([2.0, 1.0], [1.0, 0.0], dt=0.1, u_max=1.5)  # 2 + 1/s
    >>> controller.step(r=1.0, y=0.0)
    1.5
    >>> controller.status
    <Status.SATURATED: 4>
    """

    features: tuple[str, ...] = ()
    channels: tuple[tuple[str, int], ...] = (("u_wished", 1), ("status", 1))

    def __init__(
        self,
        law: LinearLaw,
        dt: float,
        *,
        u_min: float = -math.inf,
        u_max: float = math.inf,
        rate_limit: float = math.inf,
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
        rate_limit: float = math.inf,
        name: str = "transfer function",
    ) -> LinearController:
        """Make a controller of one degree of freedom from C(s): ``u = C (r − y)``, or ``u = −C y``.

        It is realised in scaled, balanced coordinates and sampled there, never as polynomials in z, whose roots crowd at 1.

        Parameters
        ----------
        num, den
            polynomials in s, highest power first; or ``num`` is a ``control.TransferFunction`` or ``control.StateSpace`` in continuous
            time, and ``den`` is left out.
        dt
            sample time [s].
        feedback
            ``"error"``: C acts on r − y; ``"output"``: on −y alone.
        method
            ``"tustin"``: ``s = 2 (z − 1) / (dt (z + 1))``, or ``"zoh"``: as if r and y were held over a sample, which is half a sample
            later.
        prewarp
            frequency [rad/s] at which Tustin's response is that of C(s) exactly.
        tracking_time
            how fast integrators follow u at its limits [s]; see ``quell.controllers.linear.transfer.anti_windup``. By default the time
            constant of C's slowest zero, or of its slowest pole, where it has none, other than zero.
        u_min, u_max, rate_limit, name
            as for the class.

        Raises
        ------
        ValueError
            for a C(s) that is not proper or not of one input and output, or arguments out of range.
        """
        from quell.controllers.linear.transfer import as_state_space, sampled_law

        dt = checks.positive("dt", dt, "s")
        on_error = checks.one_of("feedback", feedback, ("error", "output")) == "error"
        A, B, C, D = as_state_space(num, den)
        system = (
            A,
            np.hstack([B if on_error else 0.0 * B, -B]),
            C,
            np.hstack([D if on_error else 0.0 * D, -D]),
        )
        law = sampled_law(system, dt, method=method, prewarp=prewarp, tracking_time=tracking_time)
        return LinearController(law, dt, u_min=u_min, u_max=u_max, rate_limit=rate_limit, name=name)

    def _update_parameters(self) -> None:
        self.parameters = LinearDesign(self.law, rest_state(self.law), self._limits)

    def initial_state(self) -> LinearState:
        """Return a state before the first sample."""
        size = self.law.C.size
        return LinearState(np.zeros(size), np.zeros(size), LinearLoop.zeros())

    @property
    def status(self) -> Status:
        """What the last step had to report."""
        return Status(int(self._state.loop[0].status))
