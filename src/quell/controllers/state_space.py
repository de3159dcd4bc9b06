"""State feedback with a multivariable ESO: several inputs, outputs and disturbances in one loop.

The plant is ``x' = A x + B u + E d``, ``y = C_y x``; the outputs that are controlled, ``z = C x``,
need not be measured. With the estimates of ``ESO.state_space``, after each measurement::

    u = U r + Γ d̂ − K (x̂ − X r − Π d̂)

Each actuator is cut by itself, and the observer receives what was applied. A measurement that is
not finite is missing, and the others correct; the loop begins at rest, at the first sample in which
all are measured.

K places the poles: ``state_feedback`` puts all those of ``Φ − Γ_u K`` at ``exp(−omega_c dt)``,
``quadratic_feedback`` minimises a quadratic cost: the gains of observers of the transposed system
(``observers/gains.py``). A flexible mode far above omega_c is better left where it is, which the
second one does; to move it costs large gains.

Π and Γ (``regulator``) say where the state and u have to be, so that z stays at zero under d: they
solve the *regulator equations* (Francis, *SIAM J. Control and Optimization* 15, 1977; Francis &
Wonham, *Automatica* 12, 1976). For a constant d::

    A Π + B Γ + E = 0,      C Π = 0

and for ``w = (d, d', …)``, of which d is a polynomial, with ``w' = S w``::

    A Π + B Γ + (E, 0, …) = Π S,      C Π = 0

If d enters where u does (it is *matched*), Π = 0 and ``B Γ = −E``: u cancels d at its place. If
not, the state has to move, as a spring is wound up before it carries a load. With d alone z is zero
for a constant d, and each further derivative adds what its change needs. X and U are the same for
the reference: ``A X + B U = 0``, ``C X = I``.
"""

from __future__ import annotations

import math
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
from quell.lti.models import zero_order_hold
from quell.lti.zeros import fitting_matrices
from quell.observers import gains
from quell.observers.multivariable import MultivariableESO
from quell.observers.multivariable_forms import begin_signals, observe_signals
from quell.types import Channels, Matrix, Status, Vector

# ---- Gains of a state feedback ----

# An equation that is left with more than this share of its terms has no solution. Chosen by hand.
_SOLVED = 1e-8


class Regulator(NamedTuple):
    """Where state and control signal have to be for given disturbances and references."""

    Pi: Matrix  #: Π (n, q · disturbance_order), states for (d, d', …)
    Gamma: Matrix  #: Γ (m, q · disturbance_order), control signals for (d, d', …)
    X: Matrix  #: states for r (n, outputs)
    U: Matrix  #: control signals for r (m, outputs)


def regulator(A: Any, B: Any, C: Any, E: Any, disturbance_order: int = 1) -> Regulator:
    """Return the solution of the regulator equations of ``x' = A x + B u + E d``, ``z = C x``.

    Parameters
    ----------
    A, B, C, E
        matrices (n, n), (n, m), (outputs, n) and (n, q), or vectors where there is one column or
        row. C has the outputs that are controlled; they need not be those that are measured.
    disturbance_order
        number of d, d', … that are compensated, as in ``ESO.state_space``.

    Returns
    -------
    Regulator
        with more inputs than outputs the one with the least squares of Γ and U, in units of u.

    Raises
    ------
    ValueError
        for matrices that do not fit, and naming the disturbance that no u keeps from z, or the
        output that no u moves to a constant r.

    Examples
    --------
    A torque of 1 N m on the load of two inertias of 2 kg m² with a spring of 10 N m/rad: u
    carries it through the spring, and the motor stands 0.1 rad behind.

    >>> A = [[0, 1, 0, 0], [-5, 0, 5, 0], [0, 0, 0, 1], [5, 0, -5, 0]]
    >>> found = regulator(A, [0, 0.5, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0.5])
    >>> found.Gamma.round(9).tolist(), found.Pi[0].round(9).tolist()
    ([[-1.0]], [-0.1])
    """
    A, B, C, _ = fitting_matrices(A, B, C)
    _, E, _, _ = fitting_matrices(A, E, C, None, "E", "disturbances")
    order = checks.whole("disturbance_order", disturbance_order, 1, 3)
    (n, m), (outputs, _) = B.shape, C.shape
    columns, rows = _equilibrated(np.block([[A, B], [C, np.zeros((outputs, m))]]))

    def solved(of_state: Matrix, of_output: Matrix, names: list[str]) -> Matrix:
        found = []
        for wanted, name in zip(np.vstack([of_state, of_output]).T, names, strict=True):
            whole = np.block([[A, B], [C, np.zeros((outputs, m))]])
            solution = gains.settle(
                [
                    (whole * rows[:, None], wanted * rows),
                    (np.eye(n + m)[n:], np.zeros(m)),
                    (np.eye(n + m)[:n] / columns[:n, None], np.zeros(n)),
                ],
                columns,
            )
            left = np.abs(whole @ solution - wanted)
            size = np.abs(whole) @ np.abs(solution) + np.abs(wanted)
            if np.max(left * rows) > _SOLVED * np.max(size * rows):
                short = f": there are {m} inputs for {outputs} outputs" if m < outputs else ""
                raise ValueError(
                    f"{name}{short}; from u to z there must be no invariant zero at s = 0, and "
                    "at least as many inputs as outputs: control other outputs, or add an actuator"
                )
            found.append(solution)
        return np.array(found).T

    zero = np.zeros((outputs, E.shape[1]))
    before, parts = np.zeros((n, E.shape[1])), []
    for i in range(order):
        names = [
            f"no u keeps d{c + 1}{chr(39) * i} from the outputs z = C x" for c in range(E.shape[1])
        ]
        parts.append(solved(before - (E if i == 0 else 0.0), zero, names))
        before = parts[-1][:n]
    whole = np.hstack(parts)
    names = [f"no u moves z{j + 1} to a constant r" for j in range(outputs)]
    given = solved(np.zeros((n, outputs)), np.eye(outputs), names)
    return Regulator(whole[:n], whole[n:], given[:n], given[n:])


def state_feedback(A: Any, B: Any, omega_c: float, dt: float) -> Matrix:
    """Return K (m, n) of ``u = −K x``, with all poles of the sampled loop at ``exp(−omega_c dt)``.

    Parameters
    ----------
    A, B
        matrices (n, n) and (n, m), or a vector (n,) for one input.
    omega_c
        bandwidth of the loop [rad/s].
    dt
        sample time [s]; u is held over a sample.

    Raises
    ------
    ValueError
        if u does not move all states, or the poles can not be placed in double precision.

    Examples
    --------
    >>> state_feedback([[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0], 10.0, 1e-6).round(2).tolist()
    [[50.0, 10.0]]
    """
    A, B, _, _ = fitting_matrices(A, B, np.eye(np.shape(A)[0]))
    omega, dt = checks.positive("omega_c", omega_c, "rad/s"), checks.positive("dt", dt, "s")
    units = gains.units_of(A.T, B.T, omega)
    scaled = A / units[None, :] * units[:, None]
    _, (difference, inputs) = zero_order_hold(scaled, [scaled, B * units[:, None]], dt)
    gain = gains.place_equal_poles(difference.T, inputs.T, -math.expm1(-omega * dt))
    if gain is None:
        raise ValueError(
            f"omega_c = {omega_c!r} rad/s with dt = {dt!r} s: the poles can not be placed; u must "
            "move all states (leave out those that it does not), and dt must not be a period of "
            "an undamped mode"
        )
    return gain.T * units[None, :]


def quadratic_feedback(A: Any, B: Any, state_weight: Any, control_weight: Any, dt: float) -> Matrix:
    """Return K (m, n) of ``u = −K x`` with the least ``Σ xᵀ Q x + uᵀ R u`` over the samples.

    Parameters
    ----------
    A, B
        matrices (n, n) and (n, m), or a vector (n,) for one input.
    state_weight
        Q (n, n), symmetric, without negative eigenvalues. ``C.T @ C`` weighs the outputs ``C x``.
    control_weight
        the diagonal of R (m,), above zero. An inertia J with the weight 1 on its angle and
        ``1/(J² omega_c⁴)`` on the torque has poles of the radius omega_c, with a damping of 0.7.
    dt
        sample time [s]; u is held over a sample.

    Raises
    ------
    ValueError
        for weights that do not fit; if u does not stabilise all states, or the cost does not see
        an unstable one.

    Examples
    --------
    >>> A, B, Q = [[0.0, 1.0], [0.0, 0.0]], [0.0, 2.0], [[1.0, 0.0], [0.0, 0.0]]
    >>> quadratic_feedback(A, B, Q, 4.0 / 10.0**4, 1e-5).round(2).tolist()
    [[50.0, 7.07]]
    """
    A, B, _, _ = fitting_matrices(A, B, np.eye(np.shape(A)[0]))
    n, m = B.shape
    dt = checks.positive("dt", dt, "s")
    Q = checks.weight("state_weight", state_weight, n)
    R = checks.vector("control_weight", control_weight, m)
    if not np.all(R > 0.0):
        raise ValueError(f"control_weight = {control_weight!r}: each entry must be above zero")
    phi, (gamma,) = zero_order_hold(A, [B], dt)
    units = gains.units_of(A.T, B.T / np.sqrt(R)[:, None], 0.1 / dt)
    transition, inputs = phi.T * units[None, :] / units[:, None], gamma.T * units[None, :]
    cost = Q / (units[:, None] * units[None, :])
    found = gains.predicted_covariances(transition, cost, inputs, R, np.ones((1, m)))
    if found is None:
        raise ValueError(
            f"control_weight = {R.tolist()!r} with dt = {dt!r} s: no gain is stable and has the "
            "least cost; u must move all states that do not decay, and state_weight must see them"
        )
    # The filter's gain L corrects after the prediction; the law acts before it: K = (Φᵀ L)ᵀ.
    gain = transition @ gains.kalman_gain_of(found[0], inputs, R, np.ones(m, dtype=bool))
    return (gain * units[:, None]).T


def _equilibrated(matrix: Matrix) -> tuple[Matrix, Matrix]:
    """Return factors of columns and rows that bring their largest entries close to one."""
    columns, rows = np.ones(matrix.shape[1]), np.ones(matrix.shape[0])
    for _ in range(20):
        scaled = np.abs(matrix) * rows[:, None] * columns[None, :]
        sizes = np.max(scaled, axis=1), np.max(scaled, axis=0)
        rows /= np.sqrt(np.where(sizes[0] > 0.0, sizes[0], 1.0))
        columns /= np.sqrt(np.where(sizes[1] > 0.0, sizes[1], 1.0))
    return np.exp2(np.round(np.log2(columns))), np.exp2(np.round(np.log2(rows)))


# ---- State feedback ----

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
