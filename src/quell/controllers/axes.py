"""Several axes that are coupled: one ESO, law, learner and guard for each, and a matrix B0.

The machine is

    y_i^(n_i) = f_i + (B0 u)_i,        i = 1 … n

with u (m,) of the actuators, m ≥ n. Each axis is an ``ADRC`` of its own with the input v_i and the
gain b0_i, ``b0_i v_i = (B0 u)_i``, usually 1: whatever couples the axes beyond B0 (centrifugal and
Coriolis forces, gravity, a B0 that is not right) is in f_i, which its observer estimates and its
learner learns. The axes ask for v, ``controllers/allocation.py`` finds u within the limits of the
actuators, and every observer receives its v_i with the u that was applied. So the limits of one
actuator, which take something from all axes, are no disturbance to any of them.

B0 is a constant matrix or a function of the estimates, of a robot for instance the inverse of its
mass matrix M(q). With an exact B0 the axes are independent loops; with another one their stability
is that of the whole, of which ``quell.analysis`` has measures.

In a sample each axis runs as ``controllers/law.py`` does it, then u is found for all.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers import allocation, given_controls, safe_axes
from quell.controllers.allocation import apply_to_axes, update_gain
from quell.controllers.axes_learning import (
    LearningOfAxes,
    learn_of_all,
    look_at_all,
    restart_of_all,
)
from quell.controllers.base import (
    Controller,
    RateLimit,
    bumpless_transfer,
    reset_loop,
    set_axis_held,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.bumpless import samples_to_settle
from quell.controllers.compensated import takes_control
from quell.controllers.compensator import Compensator, Estimate
from quell.controllers.each_axis import (
    ask_axes,
    axes_started,
    continue_axes,
    hold_axes,
    reset_axes,
    set_axes_derivatives,
    set_axes_manual,
    start_axes,
    tell_axes,
    transfer_axes,
    write_axes,
    write_motions,
)
from quell.controllers.given_controls import (
    ANY_CUT,
    allocate_given,
    reset_given,
    start_given,
    take_references,
    tell_given,
    write_given,
)
from quell.controllers.memory import Layout
from quell.controllers.safe_axes import keep_in_bands
from quell.controllers.several import (
    control_all,
    motion_by,
    prepared_step,
    set_applied_controls,
    start_all,
    take_signals,
    tell_applied,
    write_applied,
)
from quell.controllers.shaped_references import (
    are_shaped,
    plan_stops,
    shaped_design,
    shaped_memory,
    stop_of_moves,
    with_prefilter,
    without_prefilter,
)
from quell.controllers.stateful import StatefulController
from quell.kernels.sized import Flag, Scalars, Work, clear
from quell.observers.eso import ESO, with_gains
from quell.types import Channels, Matrix, Status, Vector

# ---- A sample of all axes ----


class AxesLoop(Scalars):
    """Scalars of the loop of all axes."""

    status: float  # flags of the last sample
    manual: float  # 1 in manual operation, else 0
    started: float  # 1 after the first sample or a start, else 0


class AxesDesign(NamedTuple):
    """Parameters of several axes."""

    axes: tuple[Any, ...]  # of each axis
    gain: Any  # B0
    rule: Any  # what is done at the limits
    limits: allocation.ActuatorLimits
    learning: Any  # of learners that see all axes, see ``axes_learning``
    widths: Any  # channels of each axis (n,), integers
    derivatives: Any  # derivatives of the reference of each axis (n,), integers
    safe: Any  # the safe sets of axes together, or none
    given: Any  # references, or control signals in their place
    # Whether there are parts: the calls of one that is absent are left out.
    learns_of_all: Flag
    has_bands: Flag
    gain_moves: Flag  # B0 is a function of the estimates
    takes_controls: Flag  # in the place of references


class AxesState(NamedTuple):
    """State of several axes."""

    axes: tuple[Any, ...]  # of each axis
    learning: Any
    gain: allocation.GainMemory
    range: allocation.RangeMemory
    safe: Any
    given: Any
    loop: NDArray[AxesLoop]  # (1,)
    x: Work  # estimates x[axis, derivative] (n, largest order)
    v: Vector  # what the axes asked for, then what was applied (n,)
    u: Vector  # applied control signals (m,)
    u_limited: Work  # those of the law; they differ from u in manual operation (m,)
    wish: Work  # what each axis is asked for: its reference, or v of given control signals (n,)
    r_given: Work  # references and measurements of a call from Python (n,)
    y_given: Work


@control_all.register(AxesDesign)
def _control_all(design: AxesDesign, state: AxesState, r: Vector, y: Vector, u: Vector) -> None:
    loop = state.loop[0]
    flags = take_references(
        design.given, state.given, design.axes, state.axes, state.gain, r, y, state.wish
    )
    if design.learns_of_all:
        look_at_all(design.learning, state.learning, design.axes, state.axes)
    flags = ask_axes(design.axes, state.axes, flags, state.wish, y, state.v, state.x)
    if design.learns_of_all:
        flags |= learn_of_all(design.learning, state.learning, design.axes, state.axes)
    if design.gain_moves:
        flags |= update_gain(design.gain, state.gain, state.x)
    if loop.manual != 0.0:
        loop.status = flags
        return
    flags |= allocate_given(
        design.given, state.given, design.rule, design.limits, state.gain, state.range, state.v,
        state.u, state.u_limited,
    )  # fmt: skip
    if design.has_bands:
        flags |= keep_in_bands(
            design.safe, state.safe, design.axes, state.axes, design.limits, state.gain,
            state.range, state.u_limited,
        )  # fmt: skip
    for k in range(u.size):
        state.u[k] = state.u_limited[k]
        u[k] = state.u[k]
    apply_to_axes(state.gain, state.u, state.v)
    if design.takes_controls:
        tell_given(design.given, state.given, design.axes, state.axes, state.gain, state.u, flags)
    tell_axes(design.axes, state.axes, state.v)
    loop.status, loop.started = flags, 1.0


@set_applied_controls.register(AxesDesign)
def _set_applied_controls(design: AxesDesign, state: AxesState, u: Vector) -> None:
    for k in range(u.size):
        state.u[k] = u[k]
    tell_applied(design, state)


@motion_by.register(AxesDesign)
def _motion_by(design: AxesDesign, state: AxesState, b0: Vector, u: Vector, v: Vector) -> None:
    apply_to_axes(state.gain, u, v)
    write_motions(design.axes, state.axes, v, v)


@write_applied.register(AxesDesign)
def _write_applied(design: AxesDesign, state: AxesState, u: Vector, row: Vector) -> None:
    v = row[: state.v.size]  # the first channel
    apply_to_axes(state.gain, u, v)
    write_motions(design.axes, state.axes, v, v)


@tell_applied.register(AxesDesign)
def _tell_applied(design: AxesDesign, state: AxesState) -> None:
    apply_to_axes(state.gain, state.u, state.v)
    tell_given(design.given, state.given, design.axes, state.axes, state.gain, state.u, ANY_CUT)
    tell_axes(design.axes, state.axes, state.v)


@start_all.register(AxesDesign)
def _start_all(
    design: AxesDesign, state: AxesState, samples: Any, y: Vector, u: Vector, r: Vector
) -> None:
    reset_loop(design, state)
    for i in range(state.v.size):
        for j in range(state.x.shape[1]):
            state.x[i, j] = y[i] if j == 0 else 0.0
    update_gain(design.gain, state.gain, state.x)
    for k in range(state.u.size):
        state.u[k] = u[k]
    apply_to_axes(state.gain, state.u, state.v)
    start_given(design.given, state.given, state.gain, y, u, r, state.wish)
    start_axes(design.axes, state.axes, samples, y, state.v, state.wish)
    state.loop[0].started = 1.0


def begin_manual(design: AxesDesign, state: AxesState) -> None:
    """Let the axes run in manual operation under the v in the state."""
    state.loop[0].manual = 1.0
    set_axes_manual(design.axes, state.axes, 1.0, state.v)


def end_manual(design: AxesDesign, state: AxesState) -> None:
    """End manual operation of a sample."""
    state.loop[0].manual = 0.0
    set_axes_manual(design.axes, state.axes, 0.0, state.v)


def hand_over_all(design: AxesDesign, state: AxesState) -> bool:
    """End manual operation: the next sample continues from the control signals of the last one.

    Return false before the first sample of one of the axes: then nothing has changed.
    """
    if state.loop[0].started == 0.0 or axes_started(design.axes, state.axes, 0) < state.v.size:
        return False
    continue_axes(design.axes, state.axes)
    return True


@bumpless_transfer.register(AxesDesign)
def _bumpless_transfer(design: AxesDesign, state: AxesState) -> None:
    transfer_axes(design.axes, state.axes)


@status_flags.register(AxesDesign)
def _status_flags(design: AxesDesign, state: AxesState) -> int:
    return int(state.loop[0].status)


@reset_loop.register(AxesDesign)
def _reset_loop(design: AxesDesign, state: AxesState) -> None:
    reset_axes(design.axes, state.axes)
    reset_given(design.given, state.given)
    restart_of_all(design.learning, state.learning)
    clear(state.loop)
    for k in range(state.u.size):
        state.u[k] = 0.0


@write_row.register(AxesDesign)
def _write_row(design: AxesDesign, state: AxesState, row: Vector) -> None:
    n = state.v.size
    write_motions(design.axes, state.axes, state.v, row)
    row[n] = state.loop[0].status
    end = write_axes(design.axes, state.axes, n + 1, design.widths, row)
    write_given(design.given, state.given, end, row)


@set_reference_derivatives.register(AxesDesign)
def _set_derivatives(design: AxesDesign, state: AxesState, derivatives: Vector) -> None:
    set_axes_derivatives(design.axes, state.axes, 0, design.derivatives, derivatives)


@set_axis_held.register(AxesDesign)
def _set_axis_held(design: AxesDesign, state: AxesState, axis: int, held: bool) -> None:
    hold_axes(design.axes, state.axes, axis, held)


# ---- The controller ----


class Axes(StatefulController):
    """Several coupled axes, each with its own ADRC, and the matrix from actuators to axes.

    Parameters
    ----------
    axes
        an ``ADRC`` for each axis, all with one ``dt``, and without limits of u: what it calls u is
        v_i, for ``b0 = 1`` the acceleration (for order 2) that it asks for. In a
        dictionary each has a name. They are copied. One that is ``Prefiltered`` follows its shaped
        reference; ``prefilters`` has them, None for an axis without. Or a ``Compensator`` for each:
        then control signals u_0 of the actuators (m,) take the place of the references r, and
        ``u = u_0 − B0⁺ f̂`` (``controllers/given_controls.py``).
    B0
        from the control signals to the axes (n, m) [y-unit/s^n per u-unit]: a matrix, or a function
        of the estimates that returns it. The function takes ``x[axis, derivative]``, so ``x[0, 0]``
        is the position of the first axis and ``x[1, 1]`` the rate of the second; it is compiled.
        Parameters that ``functools.partial`` binds by name, numbers, vectors or matrices, are data:
        other values of them compile nothing; each axis has b0 = 1 then. By default each actuator
        moves one axis, with its b0.
    M
        the inverse of B0 instead, of a robot its mass matrix: a matrix or a function.
    u_min, u_max
        limits of the actuators [u-unit]: one for all, or one for each.
    rate_limit
        largest rates [u-unit/s]: one for all, or a list with one, or with (lowest, highest), for
        each.
    saturation
        what happens at the limits: ``"each"`` cuts each actuator, ``"direction"`` scales all, so
        that v keeps its direction, and a list of all axes is their order of priority: what an
        axis misses counts 100 times as much, squared, as what the next one misses.
    weights
        of the actuators, where there are more than axes: u is the smallest ``Σ W (u − wished)²``
        that does what the axes ask for (m,). If an axis has a safe set, also of the change of u
        that keeps v within the bounds of all axes (``controllers/safe_axes.py``).
    wished
        the u from which that is measured (m,) [u-unit], as the thrusts that carry a craft; zero by
        default.
    drives
        controllers that give u_0 where the axes are compensators, one for each axis and for the
        actuator of its place, as ``PID``; r are then their references. They are copied.
    learner
        one that sees the states of all axes, with features ``AllAxes(...)``: one for all axes,
        which have one gain and θ of their own (``RLS``, ``NLMS``), or a list or dictionary with one
        for each, None for an axis without. One for all takes its frequency from the slowest axis.
        A learner that sees its own axis belongs into its ADRC.
    guard
        of these learners: a description, of which each axis has its own guard, or one for each.

    Raises
    ------
    ValueError
        for axes that do not fit, matrices of other shapes, a B0 that is singular or a function
        that fails.

    Warns
    -----
    DesignWarning
        if B0 is badly conditioned.

    Examples
    --------
    >>> import quell as ql
    >>> def joint():
    ...     observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3)
    ...     return ql.ADRC(observer, omega_c=8.0)
    >>> robot = ql.plants.arm(gravity=0.0)
    >>> controller = ql.Axes([joint(), joint()], M=robot.inertia, u_max=20.0, u_min=-20.0)
    >>> controller.step(r=[0.1, 0.0], y=[0.0, 0.0]).round(3).tolist()
    [2.667, 0.576]
    """

    parameters: AxesDesign
    _state: AxesState
    _moved = 1.0  # what was taken from the gain of one actuator into the b0 of its axis

    def __init__(
        self,
        axes: Sequence[Compensator] | Mapping[str, Compensator],
        B0: Any = None,
        *,
        M: Any = None,
        u_min: float | Sequence[float] = -np.inf,
        u_max: float | Sequence[float] = np.inf,
        rate_limit: RateLimit | Sequence[RateLimit] = np.inf,
        saturation: str | Sequence[int | str] = "each",
        weights: Sequence[float] | None = None,
        wished: Sequence[float] | None = None,
        drives: Sequence[Controller] | None = None,
        learner: Any = None,
        guard: Any = None,
    ) -> None:
        if not isinstance(axes, Mapping) and not checks.is_sequence(axes):
            raise ValueError(f"axes = {axes!r:.60}: must be an ADRC for each axis, in a list")
        given = axes if isinstance(axes, Mapping) else {}
        pairs = [without_prefilter(each) for each in (given.values() if given else axes)]
        parts = [axis for axis, _ in pairs]
        self.prefilters = tuple(prefilter for _, prefilter in pairs)
        self.names = tuple(given) or tuple(f"axis{i + 1}" for i in range(len(parts)))
        given_controls.check_axes(parts, self.names)
        self.axes: tuple[Any, ...] = tuple(copy.copy(axis) for axis in parts)
        self.B0, self.M, self.weights = B0, M, weights
        self._gain = self._checked_gain()
        if self._gain.first.shape == (1, 1) and isinstance(
            self._gain.design, allocation.ConstantGain
        ):
            # The gain of one actuator is the b0 of its axis, which has the bits of that ADRC then.
            self._moved = float(self._gain.first[0, 0])
            self.axes = (self.axes[0].with_b0(float(self.first_gain[0, 0])),)
            self._gain = self._checked_gain()
        given_controls.check_compensates(self.compensates, drives, wished)
        self._rule = allocation.checked_rule(saturation, wished, self._gain, self.names)
        self.drives = given_controls.checked_drives(drives, self.names, self.inputs, self.dt)
        self._actuators = allocation.checked_actuator_limits(
            u_min, u_max, rate_limit, self.inputs, self.dt
        )
        self._check_safe_sets(self._actuators)
        self.learning = LearningOfAxes(learner, guard, self.axes, self.names)
        self.learning.attach(self.axes)
        self._initialise()

    # ---- What simulation and real-time loop use ----

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.axes[0].dt

    @property
    def inputs(self) -> int:
        """Number of control signals m."""
        return self._gain.shape[1]

    @property
    def outputs(self) -> int:
        """Number of axes n, and so of references and measurements."""
        return len(self.axes)

    @property
    def references(self) -> int:
        """Number of references, or of control signals u_0 in their place."""
        return self.inputs if self.takes_u_0 else self.outputs

    @property
    def takes_u_0(self) -> bool:
        """Whether control signals take the place of references: of compensators without drives."""
        return self.compensates and not self.drives

    @property
    def compensates(self) -> bool:
        """Whether the axes are compensators."""
        return takes_control(self.axes[0])

    @property
    def first_gain(self) -> Matrix:
        """B0 before the first sample (n, m)."""
        return self.b0[:, None] * self._gain.first

    @property
    def unit_axes(self) -> tuple[Any, ...]:
        """The axes as controllers of ``y^(n)``, with b0 = 1: what they ask for is (B0 u)_i."""
        return tuple(axis if axis.observer.b0 == 1.0 else axis.with_b0(1.0) for axis in self.axes)

    @property
    def b0(self) -> Vector:
        """The nominal gain of each axis (n,), ``b0_i v_i = (B0 u)_i``."""
        return np.array([axis.observer.b0 for axis in self.axes])

    @property
    def _most(self) -> int:
        return max(axis.observer.order for axis in self.axes)

    @property
    def _has_bands(self) -> bool:
        return any(axis.safe_set is not None for axis in self.axes)

    def _checked_gain(self) -> allocation.Gain:
        given = (self.B0, self.M, self.weights, self.names, self._most)
        return allocation.checked_gain(*given, weighs_change=self._has_bands, b0=self.b0)

    @property
    def derivatives(self) -> tuple[int, ...]:
        """Number of derivatives of each reference that are fed forward; of u_0 none."""
        if self.takes_u_0:
            return (0,) * self.inputs
        return self._own_derivatives

    @property
    def _own_derivatives(self) -> tuple[int, ...]:
        """Derivatives that each axis takes from outside: a prefilter makes them itself."""
        each = zip(self.axes, self.prefilters, strict=True)
        return tuple(axis.derivatives if p is None else 0 for axis, p in each)

    @property
    def features(self) -> tuple[str, ...]:
        """No names: each axis has its own, ``axes[i].features``."""
        return ()

    @property
    def channels(self) -> Channels:
        """Name and width of each recorded channel: v, flags, then ``AXIS.x_hat`` and so on."""
        own = [
            (f"{name}.{channel}", width)
            for name, axis in zip(self.names, self.axes, strict=True)
            for channel, width in axis.channels
        ]
        shaped = [("r_shaped", self.outputs)] if are_shaped(self.prefilters) else []
        return (("v", self.outputs), ("status", 1), *own, *shaped)

    @property
    def limits(self) -> Any:
        """Limits of the actuators (m,): ``low``, ``high``, and the largest changes in a sample."""
        return self._actuators

    def _check_safe_sets(self, limits: allocation.ActuatorLimits) -> None:
        safe_sets = [axis.safe_set for axis in self.axes]
        safe_axes.check_safe_sets(safe_sets, self.names, self._gain.first, limits)

    def _update_parameters(self) -> None:
        widths = [sum(width for _, width in axis.channels) for axis in self.axes]
        given: Any = (
            given_controls.given_design(self.drives)
            if self.compensates
            else shaped_design(self.prefilters, self.dt)
        )
        self.parameters = AxesDesign(
            tuple(axis.parameters for axis in self.axes),
            self._gain.design,
            self._rule,
            self._actuators,
            self.learning.design(self.dt),
            np.array(widths, dtype=np.int64),
            np.array(self._own_derivatives, dtype=np.int64),
            safe_axes.safe_axes_design([axis.safe_set for axis in self.axes], self._gain.weights),
            given,
            learns_of_all=self.learning.learns,
            has_bands=self._has_bands,
            gain_moves=isinstance(self._gain.design, allocation.FunctionGain),
            takes_controls=self.compensates,
        )

    def initial_state(self) -> AxesState:
        """Return a state before the first sample, with nothing learned."""
        n, m = self._gain.shape
        given: Any = (
            given_controls.given_memory(self.drives, n, m)
            if self.compensates
            else shaped_memory(self.parameters.given, self.prefilters, self.axes)
        )
        return AxesState(
            axes=tuple(axis.initial_state() for axis in self.axes),
            learning=self.learning.memory(self.parameters.learning),
            gain=self._gain.memory(),
            range=allocation.range_memory(n, m, self._rule),
            safe=safe_axes.safe_axes_memory(self.parameters.safe, n, m),
            given=given,
            loop=AxesLoop.zeros(),
            x=np.zeros((n, self._most)),
            v=np.zeros(n),
            u=np.zeros(m),
            u_limited=np.zeros(m),
            wish=np.zeros(n),
            r_given=np.zeros(self.references),
            y_given=np.zeros(n),
        )

    def _use_state(self, state: AxesState) -> None:
        super()._use_state(state)
        for name, axis, own in zip(self.names, self.axes, state.axes, strict=True):
            axis._use_state(own)
            axis._axis = name

    # ---- Sample by sample ----

    def prepare(self) -> None:
        """Compile ``step``, or load it from the disk cache, so that its first call is fast."""
        self._packed, self._step = prepared_step(self.parameters, self._state)

    def step(  # type: ignore[override]
        self, r: Sequence[float] | Vector, y: Sequence[float] | Vector, *derivatives: Any
    ) -> Vector:
        """Take one sample: return the control signals (m,) [u-unit].

        Parameters
        ----------
        r, y
            references and measurements of the axes (n,) [y-unit]. One that is not finite is
            replaced as ``ADRC.step`` does; ``status`` reports it. Of compensators without drives r
            is u_0 (m,) [u-unit].
        derivatives
            r' (n,), r'' (n,) …, for axes with feedforward; zero by default.
        """
        if self._packed is None:
            self.prepare()
        state = self._state
        try:
            take_signals(state, r, y)
        except (TypeError, ValueError):
            n, m, names = self.outputs, self.references, ", ".join(self.names)
            rule = f"each must have {n} numbers, one for each axis ({names})"
            if self.takes_u_0:
                rule = f"u_0 must have {m} numbers, one for each actuator, y {n} ({names})"
            raise ValueError(f"r = {r!r}, y = {y!r}: {rule}") from None
        if derivatives:
            self._set_derivatives(derivatives)
        self._step(self._packed)
        return state.u.copy()

    def _set_derivatives(self, derivatives: Sequence[Any]) -> None:
        for given in derivatives:
            checks.vector("derivatives", given, self.outputs)
        for i, (axis, count) in enumerate(zip(self.axes, self._own_derivatives, strict=True)):
            if count:
                own = np.array([float(each[i]) for each in derivatives[:count]])
                set_reference_derivatives(axis.parameters, axis._state, own)

    def applied(self, u: Sequence[float] | Vector) -> None:  # type: ignore[override]
        """Set the control signals that were really applied since the last ``step`` (m,) [u-unit].

        Call it before the next ``step``. Limits that are known beforehand belong in ``u_min``,
        ``u_max`` and ``rate_limit``.
        """
        self._state.u[:] = checks.vector("u", u, self.inputs)
        tell_applied(self.parameters, self._state)

    def start(
        self,
        y: Sequence[float] | Vector,
        u: Sequence[float] | Vector | None = None,
        r: Sequence[float] | Vector | None = None,
    ) -> None:
        """Start at a machine that rests at ``y`` under ``u``: ``step`` continues from there.

        What was learned is kept.

        Parameters
        ----------
        y
            measurements (n,) [y-unit].
        u
            control signals that hold the machine there (m,) [u-unit]; zero by default. One that
            holds an arm against gravity, for instance.
        r
            references of the next step (n,); ``y`` by default. Of compensators it is checked only.
        """
        rest = checks.vector("y", y, self.outputs)
        given = np.zeros(self.inputs) if u is None else checks.vector("u", u, self.inputs)
        usual = given if self.takes_u_0 else rest
        goals = usual if r is None else checks.vector("r", r, self.references)
        samples = [samples_to_settle(axis.observer) for axis in self.axes]
        signals = (each.astype(self._state.v.dtype) for each in (rest, given, goals))
        start_all(self.parameters, self._state, samples, *signals)

    def track(
        self, r: Sequence[float] | Vector, y: Sequence[float] | Vector, u: Sequence[float] | Vector
    ) -> None:
        """Take one sample in manual operation: ``u`` (m,) is applied, unlimited.

        ``hand_over`` ends it.
        """
        state = self._state
        given = checks.vector("u", u, self.inputs).astype(state.v.dtype)
        with self._manual_operation(given):
            self.step(r, y)
        state.u[:] = given
        tell_applied(self.parameters, state)
        state.loop[0].started = 1.0

    @contextmanager
    def _manual_operation(self, u: Vector) -> Iterator[None]:
        design, state = self.parameters, self._state
        apply_to_axes(state.gain, u, state.v)
        begin_manual(design, state)
        try:
            yield
        finally:
            end_manual(design, state)

    def hand_over(self) -> None:
        """End manual operation: the next ``step`` continues from the u of the last ``track``.

        Raises ``ValueError`` before the first measurement of one of the axes.
        """
        if not hand_over_all(self.parameters, self._state):
            raise ValueError("hand_over: there was no sample yet; call track or start before")

    def retune(self, axis: int | str, **changes: Any) -> None:
        """Change the bandwidth or the observer of one axis while running, without a bump.

        Parameters
        ----------
        axis
            its name or number.
        **changes
            ``omega_c`` and ``observer``, as for ``ADRC.retune``, with the same errors.
        """
        if self.compensates and "omega_c" in changes:
            omega_c = changes["omega_c"]
            raise ValueError(f"omega_c = {omega_c!r}: a compensator has no law; give an observer")
        self.learning.check_retuning(changes)
        place, new = self.index(axis), changes.get("observer")
        if self._moved != 1.0 and isinstance(new, ESO):
            changes["observer"] = with_gains(new, new.b0 * self._moved, new.omega_o)
        self.axes[place]._axis = ""
        try:
            self.axes[place].retune(**changes)
        finally:
            self.axes[place]._axis = self.names[place]
        self.learning.update(self.axes)
        self._update_parameters()
        self._pack_again()

    def set_limits(self, *, u_min: Any = None, u_max: Any = None, rate_limit: Any = None) -> None:
        """Change limits of the actuators while running; what is not given stays.

        Parameters are those of ``Axes``. The next ``step`` is within the new limits of u. Raises
        ``ValueError`` as for new ``Axes``; then the limits are unchanged.
        """
        given = (u_min, u_max, rate_limit)
        new = allocation.changed_actuator_limits(self._actuators, *given, self.inputs, self.dt)
        self._check_safe_sets(new)
        self._actuators = new
        self._update_parameters()
        self._pack_again()

    @property
    def stopping_point(self) -> Vector:
        """Where the references can come to rest soonest (n,): as r of a step the moves stop.

        Of an axis without a ``ProfileGenerator`` it is the reference that it followed last. Raises
        ``ValueError`` if no axis has one.
        """
        if not plan_stops(self.parameters.given):
            raise ValueError("no axis plans a stop; take axes behind ProfileGenerator")
        r: Vector = np.zeros(self.outputs)
        stop_of_moves(self.parameters, self._state, r)
        return r

    def index(self, axis: int | str) -> int:
        """Return the number of an axis, from 0, given its name or number."""
        if isinstance(axis, str):
            return self.names.index(checks.one_of("axis", axis, self.names))
        return checks.whole("axis", axis, 0, self.outputs - 1)

    # ---- What it knows ----

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Estimates and status of each axis after the last step, by its name."""
        return self.read(self._state)

    def read(self, state: AxesState) -> dict[str, Estimate]:
        """Return the estimates and status of each axis in ``state``, by its name."""
        parts = zip(self.names, self.axes, state.axes, strict=True)
        return {name: axis.read(own) for name, axis, own in parts}

    @property
    def status(self) -> Status:
        """Flags of the last step: those of all axes and of the actuators."""
        return Status(int(self._state.loop[0].status))

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints."""
        each = zip(self.names, self.axes, self.prefilters, strict=True)
        found: dict[str, Any] = {
            "axes": {name: with_prefilter(axis, shaper) for name, axis, shaper in each}
        }
        if self.drives:
            found["drives"] = list(self.drives)
        for name in ("B0", "M"):
            if getattr(self, name) is not None:
                found[name] = getattr(self, name)
        for name in ("learner", "guard"):
            if getattr(self.learning, name) is not None:
                found[name] = getattr(self.learning, name)
        for name, values in (("u_min", self._actuators.low), ("u_max", self._actuators.high)):
            if np.all(np.isfinite(values)):
                found[name] = values.tolist()
        return found

    def _images(self) -> Layout:
        for name, axis in zip(self.names, self.axes, strict=True):
            try:
                axis._images()
            except ValueError as error:
                raise ValueError(f"axis {name}: {error}") from None
        return super()._images()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy is made from; a function of B0 is compiled anew for it."""
        kept = super().__getstate__()
        return {name: value for name, value in kept.items() if name != "_gain"}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        vars(self).update({name: value for name, value in kept.items() if name != "state"})
        self.axes = tuple(copy.copy(axis) for axis in self.axes)
        self.learning = copy.copy(self.learning)  # it designs the learners of these axes again
        self._gain = self._checked_gain()
        self._initialise()
        self.state = kept["state"]
