"""Controllers around another: prefilters of the reference, a reference model, a differentiator.

The base class of controllers around another: behind a prefilter, or in single precision.

A prefilter of the reference in front of any controller.

``prefilter`` and ``settle`` are registered for the type of a prefilter's parameters. A prefilter
that provides derivatives of the shaped reference has an attribute ``derivatives``, their number,
and registers ``write_derivatives``. One that would take long to return from an absurd reference
registers ``restart_if_astray``. One that can stop registers ``stopping_point``.

A reference model: a lag between the reference and the loop, with derivatives of its output.

    r_f = ω^m / (s + ω)^m · r,    r_f^(m) = ω^m (r − r_f) − Σ_{i=1}^{m−1} C(m, i) ω^(m−i) r_f^(i)

If as many derivatives are fed forward as the plant has integrators, the ideal loop responds to r as
the model does, for any ``omega_c``: two degrees of freedom, one for the reference and one for
disturbances (Horowitz, *Synthesis of Feedback Systems*, 1963). It is sampled with zero-order hold.
With a bounded rate the model is given a reference that follows r at ``rate_limit`` at most. r_f is
a weighted mean of what that was, so ``|r_f'|`` is bounded as well.

Han's tracking differentiator: a reference that a plant can follow, and its derivative.

Han, *IEEE Trans. Industrial Electronics* 56, 2009, eqs. (10) and (11)::

    v_1⁺ = v_1 + h v_2,      v_2⁺ = v_2 + h fhan(v_1 − r, v_2, r_0, h_0)

``fhan`` drives the sampled double integrator to the origin in the least time that ``|fhan| ≤ r_0``
allows, and for ``h_0 = h`` without overshoot. A larger ``h_0`` gives a smoother transition and
filters noise in r. The paper prints ``d = h_0 r_0²``, which has the wrong unit: d is compared with
a position, so it must be ``r_0 h_0²``.

Within its acceleration v_1 may need a long time to return from where an absurd reference took it,
and a loop at its limits does not follow it there. So it starts again, from rest at y, when y has
been 100 times nearer to r than v_1 for 1000 samples in a row.
"""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import (
    Controller,
    Limits,
    RateLimit,
    bumpless_transfer,
    change_parameters,
    check_controller,
    control,
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
from quell.controllers.stateful import Retuning, StatefulController
from quell.kernels.dispatch import generic, generic_with_default, is_finite, kernel
from quell.kernels.functions import copysign, sqrt
from quell.kernels.sized import Scalars, Work, clear
from quell.lti.models import zero_order_hold
from quell.observers.eso import ESO
from quell.types import Channels, Matrix, Status, Vector

# ---- The base class of controllers around another ----


class Wrapper(StatefulController):
    """A controller around ``controller``, of which it has limits, features and channels.

    If that is an ADRC, or a wrapper of one, the methods for start, manual operation and retuning
    are those of the ADRC.
    """

    controller: Any

    def __getattr__(self, name: str) -> Any:
        """Return numbers that the controller inside was made with, as ``omega_c`` or ``tf``."""
        known = name != "controller" and not name.startswith("_")
        if known and name in inspect.signature(type(self.controller)).parameters:
            value = getattr(self.controller, name, self)
            numbers = isinstance(value, int | float | tuple) and not isinstance(value, bool)
            if value is None or numbers:
                return value
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __copy__(self) -> Any:
        """Return a copy with a controller of its own, which shares no state with this one."""
        made = type(self).__new__(type(self))
        made.__setstate__({**self.__getstate__(), "controller": copy.copy(self.controller)})
        return made

    def _take_parameters(self) -> None:
        """Use the parameters that the controller has now."""
        self._update_parameters()
        self._pack_again()

    @property
    def _inner(self) -> Any:
        """The controller, acting on this state; an error if it has no methods for hand-over."""
        if isinstance(self.controller, Compensator | Wrapper):
            return self.controller
        raise ValueError(
            f"controller = {type(self.controller).__name__}: must be an ADRC to start under load, "
            "hand over or retune"
        )

    @property
    def _adrc(self) -> Compensator:
        """The ADRC behind all wrappers, acting on this state."""
        inner = self._inner
        return inner if isinstance(inner, Compensator) else inner._adrc

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return float(self.controller.dt)

    @property
    def limits(self) -> Limits:
        """Limits of the control signal."""
        return self.controller.limits

    @property
    def external_signals(self) -> int:
        """Number of external signals that a schedule in it follows."""
        return int(getattr(self.controller, "external_signals", 0))

    def set_signals(self, *values: float) -> None:
        """Set the external signals of a schedule, see ``ADRC.set_signals``."""
        self._inner.set_signals(*values)

    def at(self, *signals: float) -> Any:
        """Return the controller without schedule at fixed signals, see ``ADRC.at``."""
        made = copy.copy(self)
        made.controller = self.controller.at(*signals)
        made._initialise()
        return made

    def set_limits(
        self,
        *,
        u_min: float | None = None,
        u_max: float | None = None,
        rate_limit: RateLimit | None = None,
    ) -> None:
        """Change limits while running, see ``ADRC.set_limits``."""
        self.controller.set_limits(u_min=u_min, u_max=u_max, rate_limit=rate_limit)
        self._take_parameters()

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the features whose coefficients the channel ``theta`` has."""
        return tuple(self.controller.features)

    @property
    def channels(self) -> Channels:
        """Name and width of what ``write_row`` writes, in order."""
        return self.controller.channels

    @property
    def status(self) -> Status:
        """Status flags of the last step."""
        return Status(int(status_flags(self.parameters, self._state)))

    def start(self, y: float, u: float = 0.0, r: float | None = None) -> None:
        """Start at a plant that rests at ``y`` under ``u``, see ``ADRC.start``."""
        self._inner.start(y, u, r)

    def start_at(self, x: Any, f: float = 0.0, *, u: float = 0.0, r: float | None = None) -> None:
        """Start with given estimates, see ``ADRC.start_at``."""
        self._inner.start_at(x, f, u=u, r=r)

    def hand_over(self) -> None:
        """End manual operation, see ``ADRC.hand_over``."""
        self._inner.hand_over()

    def set_held(self, held: bool) -> None:
        """Set whether the plant is held, see ``ADRC.set_held``."""
        self._inner.set_held(held)

    def retune(self, *, omega_c: float | None = None, observer: ESO | None = None) -> None:
        """Change bandwidths while running, see ``ADRC.retune``."""
        self._change_to(self._retuned(omega_c, observer), compiles=False)()

    def prepare_retune(
        self, *, omega_c: float | None = None, observer: ESO | None = None
    ) -> Callable[[], None]:
        """Return a function that does what ``retune`` does, see ``ADRC.prepare_retune``."""
        return self._change_to(self._retuned(omega_c, observer), compiles=True)

    def _retuned(self, omega_c: float | None, observer: ESO | None) -> Callable[[], Retuning]:
        """Return a function that designs the parameters with other bandwidths."""
        self._check_inner()
        given = {"omega_c": omega_c, "observer": observer}
        return partial(
            self._retuning, **{name: value for name, value in given.items() if value is not None}
        )

    def _check_inner(self) -> None:
        """Raise a ``ValueError`` if the controller has no methods for hand-over and retuning."""
        _ = self._inner

    def _retuning(self, **given: Any) -> Retuning:
        """Return the parameters with other bandwidths, and what sets the attributes for them."""
        inner = self._retuned_part
        new, take = inner._retuning(**given)

        def take_all() -> None:
            take()
            inner.parameters, inner._packed = new, None

        return Retuning(self._with_part(new), take_all)

    @property
    def _retuned_part(self) -> Any:
        """The controller in this one whose bandwidths change."""
        return self.controller

    def _with_part(self, new: Any) -> Any:
        """Return the parameters with others of the part whose bandwidths change."""
        return self.parameters._replace(controller=new)

    @property
    def estimate(self) -> Any:
        """Estimates and status of the ADRC after the last step, see ``ADRC.estimate``."""
        return self.read(self._state)

    def read(self, state: Any) -> Any:
        """Return the estimates and the status of the ADRC in ``state``."""
        raise NotImplementedError


# ---- A prefilter of the reference in front of any controller ----

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


@generic_with_default
def stopping_point(design: Any, memory: Any) -> float:
    """Return where the shaped reference comes to rest soonest; NaN without limits that plan it."""
    return math.nan


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
    used: Work  # those that the controller uses
    loop: NDArray[PrefilteredLoop]  # (1,)


@kernel
def shaped_reference(
    design: Any, memory: Any, controller: Any, state: Any, r: float, y: float
) -> float:
    """Take one sample of a prefilter: return the reference for the controller behind it.

    ``design`` has the ``prefilter``, ``memory`` the fields of ``PrefilteredState`` but for the
    controller, which receives the derivatives that it uses.
    """
    loop = memory.loop[0]
    loop.status = 0.0
    if loop.started == 0.0 and is_usable(y):
        settle(design.prefilter, memory.prefilter, y)
        loop.started = 1.0
    if is_usable(r):
        loop.r = r
        loop.has_reference = 1.0
    else:
        loop.status = _REFERENCE_HELD
    shaped = r
    if loop.started != 0.0 and loop.has_reference != 0.0:
        if is_usable(y):
            restart_if_astray(design.prefilter, memory.prefilter, loop.r, y)
        shaped = prefilter(design.prefilter, memory.prefilter, loop.r)
        if memory.derivatives.size > 0:
            write_derivatives(design.prefilter, memory.prefilter, memory.derivatives)
            # What a prefilter has beyond them would be taken for signals of a schedule.
            for i in range(memory.used.size):
                memory.used[i] = memory.derivatives[i]
            set_reference_derivatives(controller, state, memory.used)
    loop.r_shaped = shaped if is_finite(shaped) else y
    return shaped


@control.register(PrefilteredDesign)
def _control(design: PrefilteredDesign, state: PrefilteredState, r: float, y: float) -> float:
    shaped = shaped_reference(design, state, design.controller, state.controller, r, y)
    return control(design.controller, state.controller, shaped, y)


@set_reference_derivatives.register(PrefilteredDesign)
def _set_signals(design: PrefilteredDesign, state: PrefilteredState, derivatives: Vector) -> None:
    set_schedule_signals(design.controller, state.controller, derivatives)


@set_schedule_signals.register(PrefilteredDesign)
def _set_schedule_signals(
    design: PrefilteredDesign, state: PrefilteredState, values: Vector
) -> None:
    set_schedule_signals(design.controller, state.controller, values)


@set_held.register(PrefilteredDesign)
def _set_held(design: PrefilteredDesign, state: PrefilteredState, held: bool) -> None:
    set_held(design.controller, state.controller, held)


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


@change_parameters.register(PrefilteredDesign)
def _change_parameters(
    old: PrefilteredDesign, new: PrefilteredDesign, state: PrefilteredState
) -> None:
    change_parameters(old.controller, new.controller, state.controller)


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
        if getattr(controller, "_u_is_given", False):
            raise ValueError(
                "controller = Compensator: takes u_0, and a prefilter shapes a reference; put the "
                "prefilter in front of the controller of u_0"
            )
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
        inner = self.controller.initial_state()
        wanted = getattr(self.controller, "derivatives", 0)
        design = self.parameters.prefilter
        return PrefilteredState(inner, *prefilter_memory(self.prefilter, design, wanted))

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


def prefilter_memory(
    prefilter: Prefilter, design: Any, wanted: int
) -> tuple[Any, Vector, Vector, NDArray[PrefilteredLoop]]:
    """Return the state of a prefilter before the first sample, as ``PrefilteredState`` has it.

    ``wanted`` is the number of derivatives that the controller behind it takes.
    """
    count = getattr(prefilter, "derivatives", 0) if wanted > 0 else 0
    derivatives, used = np.zeros(count), np.zeros(min(count, wanted))
    return prefilter.memory(design), derivatives, used, PrefilteredLoop.zeros()


def without_prefilters(controller: Controller) -> Controller:
    """Return the controller behind all prefilters, which are outside of the loop."""
    while isinstance(controller, Prefiltered):
        controller = controller.controller
    return controller


# ---- A reference model ----


class ReferenceModelDesign(NamedTuple):
    """Parameters, of order m; the coordinates are ``r_f^(i) dt^i``."""

    transition: Matrix  # (m, m)
    input: Vector  # (m,)
    rates: Vector  # coefficients of the state and of r in r_f^(m) (m + 1,)
    dt: float


class BoundedModelDesign(NamedTuple):
    """Parameters of a reference model with bounded rate."""

    model: ReferenceModelDesign
    most_change: float  # of the reference in a sample


class ReferenceModelMemory(NamedTuple):
    """State."""

    x: Vector  # (2 m,): the state, and scratch for the next one
    r: Vector  # (1,): the reference of the last sample, with bounded rate


@prefilter.register(ReferenceModelDesign)
def _prefilter(design: ReferenceModelDesign, memory: ReferenceModelMemory, r: float) -> float:
    x, m = memory.x, design.input.size
    for i in range(m):
        total = design.input[i] * r
        for j in range(m):
            total += design.transition[i, j] * x[j]
        x[m + i] = total
    for i in range(m):
        x[i] = x[m + i]
    memory.r[0] = r
    return x[0]


@write_derivatives.register(ReferenceModelDesign)
def _write_derivatives(
    design: ReferenceModelDesign, memory: ReferenceModelMemory, derivatives: Vector
) -> None:
    m, unit = design.input.size, 1.0
    highest = design.rates[m] * memory.r[0]
    for i in range(m):
        if i > 0:
            derivatives[i - 1] = memory.x[i] / unit
        highest += design.rates[i] * memory.x[i]
        unit *= design.dt
    derivatives[m - 1] = highest / unit


@settle.register(ReferenceModelDesign)
def _settle(design: ReferenceModelDesign, memory: ReferenceModelMemory, value: float) -> None:
    for i in range(memory.x.size):
        memory.x[i] = 0.0
    memory.x[0] = memory.r[0] = value


@prefilter.register(BoundedModelDesign)
def _prefilter_bounded(design: BoundedModelDesign, memory: ReferenceModelMemory, r: float) -> float:
    change, most = r - memory.r[0], design.most_change
    if change > most:
        r = memory.r[0] + most
    elif change < -most:
        r = memory.r[0] - most
    return prefilter(design.model, memory, r)


@write_derivatives.register(BoundedModelDesign)
def _write_derivatives_bounded(
    design: BoundedModelDesign, memory: ReferenceModelMemory, derivatives: Vector
) -> None:
    write_derivatives(design.model, memory, derivatives)


@settle.register(BoundedModelDesign)
def _settle_bounded(design: BoundedModelDesign, memory: ReferenceModelMemory, value: float) -> None:
    settle(design.model, memory, value)


@dataclass(frozen=True)
class ReferenceModel:
    """A lag of order m at ``omega`` before a controller, for use in ``Prefiltered``.

    Parameters
    ----------
    omega
        bandwidth [rad/s], at most 1/dt.
    order
        order m, 1 to 8: with feedforward in the controller, the plant's order (relative degree).
    rate_limit
        largest rate of what it makes of the reference [y-unit/s]: a larger step takes longer, and
        needs no more u on the way; none by default.

    Raises
    ------
    ValueError
        for a bandwidth or a rate that is not positive, or in ``design`` a bandwidth too high for
        the sample time.
    """

    omega: float
    order: int = 2
    rate_limit: float = math.inf

    def __post_init__(self) -> None:
        checks.positive("omega", self.omega, "rad/s")
        checks.whole("order", self.order, 1, 8)
        checks.positive_or_infinite("rate_limit", self.rate_limit, "y-unit/s")

    @property
    def derivatives(self) -> int:
        """Number of derivatives of its output: m."""
        return self.order

    def design(self, dt: float) -> ReferenceModelDesign | BoundedModelDesign:
        """Return the parameters for a sample time [s]."""
        m, rate = self.order, self.omega * checks.positive("dt", dt, "s")
        if rate > 1.0:
            rule = f"omega * dt = {rate:.3g} must be at most 1; lower omega or dt"
            raise ValueError(f"omega = {self.omega!r} rad/s with dt = {dt!r} s: {rule}")
        rates = np.array([-math.comb(m, i) * rate ** (m - i) for i in range(m)])
        A = np.diag(np.ones(m - 1), 1)
        A[-1] = rates
        B = np.zeros((m, 1))
        B[-1] = rate**m
        transition, (gamma,) = zero_order_hold(A, [B], 1.0)
        last = np.append(rates, rate**m)
        model = ReferenceModelDesign(transition, gamma[:, 0].copy(), last, dt)
        most = float(self.rate_limit) * dt
        return BoundedModelDesign(model, most) if math.isfinite(most) else model

    def memory(self, design: ReferenceModelDesign | BoundedModelDesign) -> ReferenceModelMemory:
        """Return the state at rest at zero."""
        return ReferenceModelMemory(np.zeros(2 * self.order), np.zeros(1))


# ---- Han's tracking differentiator ----

# A y that follows v_1 is behind it by a small part of the way, and is nearer to r than v_1 for a
# moment only, when r returns to y. Both chosen by hand; after a restart v_1 is where y is.
_FAR = 100.0
_SAMPLES_FAR = 1000.0


class TrackingDesign(NamedTuple):
    """Parameters."""

    acceleration: float  # r_0 [y-unit/s²]
    horizon: float  # h_0 [s]
    dt: float  # h [s]


class TrackingLoop(Scalars):
    """Scalars kept from one sample to the next."""

    far: float  # samples in a row in which y was far nearer to r than v_1


class TrackingMemory(NamedTuple):
    """State."""

    v: Vector  # v_1 [y-unit] and v_2 [y-unit/s] (2,)
    loop: NDArray[TrackingLoop]  # (1,)


@kernel
def fhan(x1: float, x2: float, r0: float, h0: float) -> float:
    """Return the acceleration within ±r0 that takes position x1 and speed x2 to zero fastest."""
    d = r0 * h0 * h0
    a0 = h0 * x2
    y = x1 + a0
    a = a0 + (y if abs(y) <= d else copysign(0.5 * (sqrt(d * (d + 8.0 * abs(y))) - d), y))
    return -r0 * a / d if abs(a) <= d else -copysign(r0, a)


@prefilter.register(TrackingDesign)
def _prefilter_differentiator(design: TrackingDesign, memory: TrackingMemory, r: float) -> float:
    v = memory.v
    acceleration = fhan(v[0] - r, v[1], design.acceleration, design.horizon)
    v[0] += design.dt * v[1]
    v[1] += design.dt * acceleration
    return float(v[0])


@write_derivatives.register(TrackingDesign)
def _write_derivatives_differentiator(
    design: TrackingDesign, memory: TrackingMemory, derivatives: Vector
) -> None:
    derivatives[0] = memory.v[1]


@settle.register(TrackingDesign)
def _settle_differentiator(design: TrackingDesign, memory: TrackingMemory, value: float) -> None:
    memory.v[0], memory.v[1] = value, 0.0
    memory.loop[0].far = 0.0


@restart_if_astray.register(TrackingDesign)
def _restart_if_astray(design: TrackingDesign, memory: TrackingMemory, r: float, y: float) -> None:
    loop, resolved = memory.loop[0], design.acceleration * design.horizon * design.horizon
    if not abs(memory.v[0] - r) > _FAR * max(abs(y - r), resolved):
        loop.far = 0.0
        return
    loop.far += 1.0
    if loop.far >= _SAMPLES_FAR:
        memory.v[0], memory.v[1] = y, 0.0
        loop.far = 0.0


@dataclass(frozen=True)
class TrackingDifferentiator:
    """A prefilter whose output has a bounded second derivative; for use in ``Prefiltered``.

    Parameters
    ----------
    acceleration
        largest second derivative, r_0 [y-unit/s²].
    horizon
        h_0 [s]: by default the sample time, for the shortest transition; larger is smoother.

    Raises
    ------
    ValueError
        for a parameter that is not positive, and in ``design`` for a horizon shorter than a sample.

    Examples
    --------
    >>> profile = TrackingDifferentiator(acceleration=2.0)
    >>> design = profile.design(dt=0.01)
    >>> memory = profile.memory(design)
    >>> [round(prefilter(design, memory, 1.0), 4) for _ in range(3)]
    [0.0, 0.0002, 0.0006]
    """

    acceleration: float
    horizon: float | None = None

    def __post_init__(self) -> None:
        checks.positive("acceleration", self.acceleration, "y-unit/s^2")
        if self.horizon is not None:
            checks.positive("horizon", self.horizon, "s")

    @property
    def derivatives(self) -> int:
        """Number of derivatives of its output: one."""
        return 1

    def design(self, dt: float) -> TrackingDesign:
        """Return the parameters for a sample time [s]."""
        dt = checks.positive("dt", dt, "s")
        horizon = dt if self.horizon is None else float(self.horizon)
        if horizon < dt:
            rule = "must be at least a sample, or the profile would oscillate"
            raise ValueError(f"horizon = {horizon!r} s with dt = {dt!r} s: {rule}")
        return TrackingDesign(float(self.acceleration), horizon, dt)

    def memory(self, design: TrackingDesign) -> TrackingMemory:
        """Return the state at rest at zero."""
        return TrackingMemory(np.zeros(2), TrackingLoop.zeros())
