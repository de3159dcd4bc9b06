"""State feedback with a multivariable ESO: several inputs, outputs and disturbances in one loop.

The plant is ``x' = A x + B u + E d``, ``y = C_y x``; the outputs that are controlled, ``z = C x``,
need not be measured. With the estimates of ``ESO.state_space``, after each measurement::

    u = U r + Γ d̂ − K (x̂ − X r − Π d̂)

K from ``state_feedback`` or ``quadratic_feedback``, the others from ``regulator``: they say where
state and control signals have to be, so that z = r under d. Each actuator is cut by itself, and the
observer receives what was applied. A measurement that is not finite is missing, and the others
correct; the loop begins at rest, at the first sample in which all are measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.allocation import (
    ActuatorLimits,
    RangeMemory,
    changed_actuator_limits,
    checked_actuator_limits,
    cut_to_range,
    range_memory,
)
from quell.controllers.base import RateLimit, is_usable, reset_loop, status_flags, write_row
from quell.controllers.feedback_gains import regulator
from quell.controllers.several import (
    control_all,
    prepared_step,
    start_all,
    take_signals,
    tell_applied,
)
from quell.controllers.stateful import StatefulController
from quell.kernels.dispatch import kernel
from quell.kernels.sized import Scalars, Work, clear
from quell.observers.multivariable import MultivariableESO
from quell.observers.multivariable_forms import begin_signals, observe_signals
from quell.types import Channels, Matrix, Status, Vector

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_REFERENCE_HELD = int(Status.REFERENCE_HELD)


class FeedbackLoop(Scalars):
    """Scalars of the loop."""

    status: float  # flags of the last sample
    started: float  # 1 after the first sample in which all outputs were measured, else 0


class FeedbackDesign(NamedTuple):
    """Parameters of state feedback, for n states, m inputs, p outputs and N − n disturbances."""

    eso: Any
    gain: Matrix  # K (m, n)
    of_disturbance: Matrix  # Γ + K Π (m, N − n)
    of_reference: Matrix  # U + K X (m, outputs)
    rest_by_y: Matrix  # estimates at rest by y (N, p)
    rest_by_u: Matrix  # and by u (N, m)
    limits: ActuatorLimits


class FeedbackState(NamedTuple):
    """State of state feedback."""

    z: Vector  # state of the observer
    estimates: Vector  # x̂, d̂ and the derivatives of d̂ (N,)
    loop: NDArray[FeedbackLoop]  # (1,)
    reference: Vector  # last finite references
    nothing: Vector  # known disturbances: zero (q,)
    u: Vector  # applied control signals (m,)
    range: RangeMemory
    wished: Work  # control signals of the law before the limits, then behind them (m,)
    r_given: Work  # references and measurements of a call from Python
    y_given: Work


@kernel
def _begin_at_rest(design: FeedbackDesign, state: FeedbackState, y: Vector) -> None:
    """Set the estimates to those of rest at y under the applied u."""
    for i in range(state.estimates.size):
        total = 0.0
        for j in range(y.size):
            total += design.rest_by_y[i, j] * y[j]
        for j in range(state.u.size):
            total += design.rest_by_u[i, j] * state.u[j]
        state.estimates[i] = total
    begin_signals(design.eso, state.z, state.estimates)


@control_all.register(FeedbackDesign)
def _control(design: FeedbackDesign, state: FeedbackState, r: Vector, y: Vector, u: Vector) -> None:
    loop, status, missing = state.loop[0], 0, 0
    for i in range(r.size):
        if is_usable(r[i]):
            state.reference[i] = r[i]
        else:
            status |= _REFERENCE_HELD
    for j in range(y.size):
        missing += 0 if is_usable(y[j]) else 1
    if missing > 0:
        status |= _MEASUREMENT_HELD
    if loop.started != 0.0:
        observe_signals(design.eso, state.z, state.estimates, y, state.u, state.nothing)
    elif missing == 0:
        _begin_at_rest(design, state, y)
        loop.started = 1.0
    n = design.gain.shape[1]
    for i in range(u.size):
        wished = 0.0
        for j in range(r.size):
            wished += design.of_reference[i, j] * state.reference[j]
        for j in range(design.of_disturbance.shape[1]):
            wished += design.of_disturbance[i, j] * state.estimates[n + j]
        for j in range(n):
            wished -= design.gain[i, j] * state.estimates[j]
        state.wished[i] = wished
    if loop.started == 0.0:
        for i in range(u.size):
            u[i] = min(max(0.0, design.limits.low[i]), design.limits.high[i])
    else:
        status |= cut_to_range(design.limits, state.u, state.range, state.wished)
        for i in range(u.size):
            u[i] = state.wished[i]
    for i in range(u.size):
        state.u[i] = u[i]
    loop.status = status


@start_all.register(FeedbackDesign)
def _start_all(
    design: FeedbackDesign, state: FeedbackState, samples: Any, y: Vector, u: Vector, r: Vector
) -> None:
    reset_loop(design, state)
    for i in range(u.size):
        state.u[i] = u[i]
    for i in range(r.size):
        if is_usable(r[i]):
            state.reference[i] = r[i]
    _begin_at_rest(design, state, y)
    state.loop[0].started = 1.0


@tell_applied.register(FeedbackDesign)
def _tell_applied(design: FeedbackDesign, state: FeedbackState) -> None:
    pass  # the observer reads them in the next sample


@status_flags.register(FeedbackDesign)
def _status_flags(design: FeedbackDesign, state: FeedbackState) -> int:
    return int(state.loop[0].status)


@reset_loop.register(FeedbackDesign)
def _reset_loop(design: FeedbackDesign, state: FeedbackState) -> None:
    clear(state.loop)
    for i in range(state.u.size):
        state.u[i] = 0.0
    for i in range(state.estimates.size):
        state.estimates[i] = 0.0
    begin_signals(design.eso, state.z, state.estimates)


@write_row.register(FeedbackDesign)
def _write_row(design: FeedbackDesign, state: FeedbackState, row: Vector) -> None:
    for i in range(state.estimates.size):
        row[i] = state.estimates[i]
    row[state.estimates.size] = state.loop[0].status


class StateFeedback(StatefulController):
    """State feedback with a multivariable ESO, which compensates the disturbances it estimates.

    Parameters
    ----------
    observer
        of the plant, from ``ESO.state_space``.
    gain
        K (m, n) [u-unit per unit of a state], from ``state_feedback`` or ``quadratic_feedback``.
    controlled
        C (outputs, n) of the outputs z = C x that follow the references; by default those that are
        measured. There may be at most as many as inputs.
    u_min, u_max, rate_limit
        limits of the actuators, one for all or one for each, as for ``Axes``.

    Attributes
    ----------
    regulator : Regulator
        Π, Γ, X and U.

    Raises
    ------
    ValueError
        for a gain that does not fit, and naming the disturbance or reference for which there is no
        solution; for an observer of the predictor form.

    Examples
    --------
    A torque on the load of two inertias, with an encoder at each:

    >>> import numpy as np
    >>> import quell as ql
    >>> from quell.controllers import StateFeedback, state_feedback
    >>> A = [[0, 1, 0, 0], [-5, 0, 5, 0], [0, 0, 0, 1], [5, 0, -5, 0]]
    >>> B, E, encoders = [0, 0.5, 0, 0], [0, 0, 0, 0.5], np.eye(4)[[0, 2]]
    >>> observer = ql.ESO.state_space(
    ...     A, B, encoders, E, dt=1e-3, noise_variance=[1e-8, 1e-8], drift=[1.0]
    ... )
    >>> gain = state_feedback(A, B, omega_c=3.0, dt=1e-3)
    >>> controller = StateFeedback(observer, gain, controlled=encoders[1:], u_min=-20, u_max=20)
    >>> controller.step(r=[0.1], y=[0.0, 0.0]).round(3).tolist()
    [3.221]
    """

    parameters: FeedbackDesign
    _state: FeedbackState
    features: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    axes: tuple[Any, ...] = ()

    def __init__(
        self,
        observer: MultivariableESO,
        gain: Any,
        *,
        controlled: Any = None,
        u_min: float | Sequence[float] = -np.inf,
        u_max: float | Sequence[float] = np.inf,
        rate_limit: RateLimit | Sequence[RateLimit] = np.inf,
    ) -> None:
        if not isinstance(observer, MultivariableESO):
            raise ValueError(f"observer = {observer!r:.60}: must be one of quell.ESO.state_space")
        if observer.form != "current":
            raise ValueError(
                f"observer.form = {observer.form!r}: the law uses the measurement of its own "
                "sample; make it with form='current'"
            )
        if np.any(observer.D):
            raise ValueError("observer has D other than zero: y must not follow u at once")
        self.observer = observer
        n, m = observer.B.shape
        self.gain = checks.matrix("gain", [gain] if np.ndim(gain) == 1 else gain)
        if self.gain.shape != (m, n):
            raise ValueError(
                f"gain has shape {self.gain.shape}: must be ({m}, {n}), a row for each control "
                "signal and a column for each state of the observer"
            )
        self.controlled = observer.C if controlled is None else np.atleast_2d(controlled)
        self.regulator = regulator(
            observer.A, observer.B, self.controlled, observer.E, observer.disturbance_order
        )
        self._actuators = checked_actuator_limits(u_min, u_max, rate_limit, m, observer.dt)
        self._initialise()

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.observer.dt

    @property
    def inputs(self) -> int:
        """Number of control signals m."""
        return int(self.observer.B.shape[1])

    @property
    def outputs(self) -> int:
        """Number of measurements p."""
        return int(self.observer.C.shape[0])

    @property
    def references(self) -> int:
        """Number of controlled outputs, and so of references."""
        return int(self.regulator.X.shape[1])

    @property
    def derivatives(self) -> tuple[int, ...]:
        """Number of derivatives of each reference that are fed forward: none."""
        return (0,) * self.references

    @property
    def channels(self) -> Channels:
        """Name and width of each recorded channel, in order."""
        n = self.observer.order
        return (("x_hat", n), ("d_hat", self.observer.estimates - n), ("status", 1))

    @property
    def limits(self) -> Any:
        """Limits of the actuators (m,)."""
        return self._actuators

    def _update_parameters(self) -> None:
        observer, law = self.observer, self.regulator
        y, u = np.eye(self.outputs), np.eye(self.inputs)
        by_y = [observer.at_rest(column, np.zeros(self.inputs)) for column in y]
        by_u = [observer.at_rest(np.zeros(self.outputs), column) for column in u]
        self.parameters = FeedbackDesign(
            observer.model,
            np.ascontiguousarray(self.gain),
            np.ascontiguousarray(law.Gamma + self.gain @ law.Pi),
            np.ascontiguousarray(law.U + self.gain @ law.X),
            np.array(by_y).T.copy(),
            np.array(by_u).T.copy(),
            self._actuators,
        )

    def initial_state(self) -> FeedbackState:
        """Return a state before the first sample."""
        observer = self.observer
        state = FeedbackState(
            z=np.zeros(observer.model.states),
            estimates=np.zeros(observer.estimates),
            loop=FeedbackLoop.zeros(),
            reference=np.zeros(self.references),
            nothing=np.zeros(observer.E.shape[1]),
            u=np.zeros(self.inputs),
            range=range_memory(self.inputs, self.inputs, None),
            wished=np.zeros(self.inputs),
            r_given=np.zeros(self.references),
            y_given=np.zeros(self.outputs),
        )
        begin_signals(self.parameters.eso, state.z, state.estimates)
        return state

    def prepare(self) -> None:
        """Compile ``step``, or load it from the disk cache, so that its first call is fast."""
        self._packed, self._step = prepared_step(self.parameters, self._state)

    def step(  # type: ignore[override]
        self, r: Sequence[float] | Vector, y: Sequence[float] | Vector
    ) -> Vector:
        """Take one sample: return the control signals (m,) [u-unit].

        Parameters
        ----------
        r
            references of the controlled outputs; one that is not finite is the last one.
        y
            measurements (p,); one that is not finite is missing.
        """
        if self._packed is None:
            self.prepare()
        state = self._state
        try:
            take_signals(state, r, y)
        except (TypeError, ValueError):
            raise ValueError(
                f"r = {r!r}, y = {y!r}: must have {self.references} and {self.outputs} numbers"
            ) from None
        self._step(self._packed)
        return state.u.copy()

    def applied(self, u: Sequence[float] | Vector) -> None:  # type: ignore[override]
        """Set the control signals that were really applied since the last ``step`` (m,)."""
        self._state.u[:] = checks.vector("u", u, self.inputs)

    def start(
        self,
        y: Sequence[float] | Vector,
        u: Sequence[float] | Vector,
        r: Sequence[float] | Vector | None = None,
    ) -> None:
        """Start at a plant that rests at measurements ``y`` under control signals ``u``.

        ``r`` are the references until a step has others; by default the last ones.
        """
        rest, given = checks.vector("y", y, self.outputs), checks.vector("u", u, self.inputs)
        state = self._state
        goals = state.reference if r is None else checks.vector("r", r, self.references)
        signals = (each.astype(state.u.dtype) for each in (rest, given, goals))
        start_all(self.parameters, state, 0, *signals)

    def set_limits(self, *, u_min: Any = None, u_max: Any = None, rate_limit: Any = None) -> None:
        """Change limits of the actuators while running; what is not given stays."""
        given = (u_min, u_max, rate_limit)
        self._actuators = changed_actuator_limits(self._actuators, *given, self.inputs, self.dt)
        self.parameters = self.parameters._replace(limits=self._actuators)
        self._pack_again()

    @property
    def status(self) -> Status:
        """Flags of the last step."""
        return Status(int(self._state.loop[0].status))

    @property
    def estimate(self) -> tuple[Vector, Vector]:
        """The states x̂ (n,) and disturbances d̂ (N − n,) as estimated in the last step."""
        n, found = self.observer.order, self._state.estimates.copy()
        return found[:n], found[n:]

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints."""
        return {"observer": self.observer, "gain": self.gain.tolist()}
