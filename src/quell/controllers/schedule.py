"""Gains that follow the machine: b0 and bandwidths from tables over one or two signals.

An axis whose inertia changes with its extension has another b = 1/J at each point of operation. A
``Schedule`` has tables of b0, omega_c and omega_o over the points of a signal, and each sample the
controller works with the values in between::

    1/b0 = (1 − w)/b0_i + w/b0_{i+1},      k = (1 − w) k_i + w k_{i+1},      L = (1 − w) L_i + …

with the weight w of the signal in the cell between two points; of two signals it is bilinear. b0 is
interpolated by its reciprocal, which is the inertia. The law's gains k and the observer's L are
those of the bandwidths at the points; a cell in which a bandwidth changes by more than a quarter
is divided, so that in between they are those of a bandwidth within 1.3 %. The cell moves by one in
a sample, so the time is constant; after a jump of the signal over many cells it arrives after as
many samples.

**b0 without a jump of u.** The observer keeps its b0. The difference is a known share of f,

    y^(n) = b0(σ) u + f = b0 u + f + (b0(σ) − b0) u

that the observer receives with the applied u, as it receives a learner's, and the law divides by
b0(σ). f is what b0(σ) u does not explain, so its estimate changes with b0(σ),

    Δf̂ ← Δf̂ + (b0_before − b0_now) u,

and the law's u is the same before and after (``change_design`` has the same rule). Under a load at
rest this is also what the machine does: f = b d, with the load d in units of u.

**omega_c** adds ``(k(σ) − k)·(r − x̂)`` to the law; the jump that a change of k would make is added
to u and decays as exp(−omega_c t), as after ``retune``. **omega_o** adds ``(L(σ) − L) e`` to the
observer's correction, with its innovation e = y − ŷ, which of a current observer is
(y − x̂_1)/(1 − L_1).

**What holds.** At each fixed value of the signal the loop is that of ``controller.at(value)``, to
which ``analyse`` applies; ``tune_schedule`` does so at and between the points. That a loop whose
frozen loops are all stable is stable itself is true for slow changes only (Shamma & Athans,
*Automatica* 27, 1991): with a signal that changes by a factor of the table in less than some times
1/omega_c nothing is proved, and a signal which the loop itself moves (y, speed) is a feedback that
the frozen loops do not have. Measure it (``benchmarks/schedule.py``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import is_usable
from quell.kernels.dispatch import generic_with_default, kernel
from quell.kernels.single import add_with_carry
from quell.kernels.sized import Flag, Scalars, Size
from quell.observers.design import design_model
from quell.observers.eso import ESO
from quell.observers.forms import DelayedModel, DeltaModel, EsoModel, without_delay
from quell.types import Matrix, Status, Vector

SIGNALS = ("reference", "y", "speed", "external")
"""What a schedule may follow: r, y, the estimate of y', or a signal that is given."""

_REFERENCE, _Y, _SPEED, _EXTERNAL = range(len(SIGNALS))
_SCHEDULE_HELD = int(Status.SCHEDULE_HELD)
# Largest ratio of a bandwidth within a cell. The mean of two squares is ((q − 1)/(q + 1))² above
# the square of the mean: 1.3 % for q = 1.25.
_LARGEST_RATIO = 1.25
# Most points of a table after its cells are divided: 16 kB of six columns in double precision.
_MOST_POINTS = 512


# ---- Parameters and state ----


class NoSchedule(NamedTuple):
    """The absence of a schedule: the gains stay."""


class NoScheduleMemory(NamedTuple):
    """State without a schedule."""

    nothing: Vector  # (0,)


class NoAxis(NamedTuple):
    """The absence of a second signal."""


class Axis(NamedTuple):
    """A signal and its points."""

    points: Vector  # increasing (p,)
    inverse: Vector  # 1/width of the cells (p − 1,)
    signal: Size  # place in ``SIGNALS``
    given: Size  # place among the external signals


class ScheduleDesign(NamedTuple):
    """Parameters of a schedule, for a law with m gains and an observer with N states."""

    first: Axis
    second: Any
    table: Matrix  # rows of the points: 1/b0, k − k_base (m,), (L − L_base)/(1 − L_1) (N,)
    inverse_b0: float  # 1/b0 of the observer
    has_b0: Flag
    is_delayed: Flag  # whether the observer keeps the u that have not acted yet
    law: Size  # m, or zero without a table of omega_c
    gains: Size  # N, or zero without a table of omega_o
    takes_u: Flag  # whether the reference is a control signal u_0


class ScheduleLoop(Scalars):
    """Scalars of a schedule, kept from one sample to the next."""

    b0: float  # in use
    found: float  # 1 after the first usable signal, else 0


class AxisLoop(Scalars):
    """Scalars of a signal, kept from one sample to the next."""

    signal: float  # last usable value
    cell: float  # place of its cell


class ScheduleMemory(NamedTuple):
    """State of a schedule."""

    given: Vector  # external signals, the last usable ones
    usable: Vector  # 1 where the signal that was given last is usable, else 0
    first: NDArray[AxisLoop]  # (1,)
    second: NDArray[AxisLoop]  # (1,)
    values: Vector  # k − k_base and (L − L_base)/(1 − L_1) in use
    loop: NDArray[ScheduleLoop]  # (1,)


# ---- The schedule sample by sample ----


@generic_with_default
def gain_in_use(design: Any, memory: Any, b0: float) -> float:
    """Return b0(σ); ``b0`` is that of the observer."""
    return b0


@generic_with_default
def control_as_observed(design: Any, memory: Any, u: float) -> float:
    """Return the control signal for an observer with another b0: ``b0(σ)/b0 u``."""
    return u


@generic_with_default
def known_with_schedule(design: Any, memory: Any, known: float, b0: float, u: float) -> float:
    """Return ``known``, what is known of f, with the share of the schedule while u acts.

    It has one if the observer delays u: then only here the u that acts is known.
    """
    return known


@generic_with_default
def scheduled_law(
    design: Any, memory: Any, seen: Vector, r: float, reference: Vector, b0: float, total: float
) -> float:
    """Return the law's numerator ``total`` with the gains that the schedule adds."""
    return total


@generic_with_default
def scheduled_correction(
    design: Any, memory: Any, eso: Any, z: Vector, seen: Vector, y: float
) -> None:
    """Add to the observer's correction what the schedule adds to its gains."""


@generic_with_default
def follow_signals(
    design: Any, memory: Any, loop: Any, z: Vector, seen: Vector, reference: Vector, at_f: int,
    u: float, continues: bool,
) -> int:  # fmt: skip
    """Take the signals of a sample, without a jump of u; return the status flags.

    ``u`` is the control signal that acted, ``at_f`` the place of f. In the first sample of a loop,
    which does not continue another one, u may jump.
    """
    return 0


@generic_with_default
def set_signals(design: Any, memory: Any, values: Vector, begin: int) -> None:
    """Set the external signals of the next sample.

    They stand in ``values`` from ``begin`` on, or are the last ones for −1.
    """


@generic_with_default
def forget_signals(design: Any, memory: Any, b0: float) -> None:
    """Begin with the signals of the next sample, and until then with the gains of the base."""


@gain_in_use.register(ScheduleDesign)
def _gain_in_use(design: ScheduleDesign, memory: ScheduleMemory, b0: float) -> float:
    return memory.loop[0].b0 if design.has_b0 else b0


@control_as_observed.register(ScheduleDesign)
def _as_observed(design: ScheduleDesign, memory: ScheduleMemory, u: float) -> float:
    if design.has_b0 and not design.is_delayed:
        return u * (memory.loop[0].b0 * design.inverse_b0)
    return u


@known_with_schedule.register(ScheduleDesign)
def _known(
    design: ScheduleDesign, memory: ScheduleMemory, known: float, b0: float, u: float
) -> float:
    if design.has_b0 and design.is_delayed:
        return known + (memory.loop[0].b0 - b0) * u
    return known


@scheduled_law.register(ScheduleDesign)
def _scheduled_law(
    design: ScheduleDesign,
    memory: ScheduleMemory,
    seen: Vector,
    r: float,
    reference: Vector,
    b0: float,
    total: float,
) -> float:
    for i in range(design.law):
        total += memory.values[i] * (_wished(reference, r, i) - seen[i])
    if design.takes_u and design.has_b0:
        total += (memory.loop[0].b0 - b0) * r
    return total


@kernel
def _wished(reference: Vector, r: float, i: int) -> float:
    """Return the i-th derivative of the reference, zero if it is not given."""
    wished = r if i == 0 else 0.0
    if reference.size > 0 and 0 < i <= reference.size:
        wished = reference[i - 1]
    return wished


@generic_with_default
def add_to_state(eso: Any, z: Vector, seen: Vector, i: int, change: float) -> None:
    """Add a correction of this sample to a state and to its estimate."""
    z[i] += change
    if not eso.predictor:
        seen[i] += change


@add_to_state.register(DeltaModel)
def _add_with_carry(eso: DeltaModel, z: Vector, seen: Vector, i: int, change: float) -> None:
    add_with_carry(z, seen.size, i, z[seen.size + i] + change)
    if not eso.predictor:
        seen[i] = z[i]


@add_to_state.register(DelayedModel)
def _add_to_inner(eso: DelayedModel, z: Vector, seen: Vector, i: int, change: float) -> None:
    add_to_state(eso.inner, z, seen, i, change)


@scheduled_correction.register(ScheduleDesign)
def _correct(
    design: ScheduleDesign, memory: ScheduleMemory, eso: Any, z: Vector, seen: Vector, y: float
) -> None:
    error = y - seen[0]
    for i in range(design.gains):
        add_to_state(eso, z, seen, i, memory.values[design.law + i] * error)


@kernel
def _signal(axis: Axis, memory: ScheduleMemory, loop: Any, seen: Vector) -> float:
    """Return the value of a signal in this sample."""
    if axis.signal == _REFERENCE:
        return loop.r
    if axis.signal == _Y:
        return loop.y
    if axis.signal == _SPEED:
        return seen[1]
    return memory.given[axis.given] if memory.usable[axis.given] != 0.0 else math.inf


@kernel
def _is_missing(axis: Axis, value: float) -> bool:
    """Return whether a signal is not usable; r and y always are, as the loop has kept them."""
    return axis.signal >= _SPEED and not is_usable(value)


@kernel
def _place(axis: Axis, own: Any, given: float, is_known: bool) -> tuple[int, float, int]:
    """Return the cell of a signal, the weight w in it, and the status flags."""
    value, status, last = given, 0, axis.points.size - 2
    if axis.signal >= _SPEED:
        if is_usable(given):
            own.signal = given
        else:
            value, status = own.signal, _SCHEDULE_HELD
    cell = min(max(int(own.cell), 0), last)
    if not is_known:
        cell = 0
        for i in range(1, axis.points.size - 1):
            if value >= axis.points[i]:
                cell = i
    elif value > axis.points[cell + 1]:
        cell = min(cell + 1, last)
    elif value < axis.points[cell]:
        cell = max(cell - 1, 0)
    own.cell = cell
    weight = (value - axis.points[cell]) * axis.inverse[cell]
    return cell, min(max(weight, 0.0), 1.0), status


@generic_with_default
def _is_second_missing(second: Any, memory: ScheduleMemory, loop: Any, seen: Vector) -> bool:
    """Return whether a second signal is not usable."""
    return False


@_is_second_missing.register(Axis)
def _is_missing_too(second: Axis, memory: ScheduleMemory, loop: Any, seen: Vector) -> bool:
    return _is_missing(second, _signal(second, memory, loop, seen))


@generic_with_default
def _place_second(
    second: Any, memory: ScheduleMemory, loop: Any, seen: Vector
) -> tuple[int, float, int]:
    """Return cell, weight and status flags of a second signal."""
    return 0, 0.0, 0


@_place_second.register(Axis)
def _place_in_second(
    second: Axis, memory: ScheduleMemory, loop: Any, seen: Vector
) -> tuple[int, float, int]:
    value, is_known = _signal(second, memory, loop, seen), memory.loop[0].found != 0.0
    cell, weight, status = _place(second, memory.second[0], value, is_known)
    return cell, weight, status


@generic_with_default
def _blended(
    second: Any, table: Matrix, row: int, column: int, weight: float, other: float, j: int
) -> float:
    """Return an entry of the table between its points."""
    low = table[row, j]
    return low + weight * (table[row + 1, j] - low)


@_blended.register(Axis)
def _bilinear(
    second: Axis, table: Matrix, row: int, column: int, weight: float, other: float, j: int
) -> float:
    at = row * second.points.size + column
    above = at + second.points.size
    low, high = table[at, j], table[above, j]
    low += other * (table[at + 1, j] - low)
    high += other * (table[above + 1, j] - high)
    return low + weight * (high - low)


@follow_signals.register(ScheduleDesign)
def _follow(
    design: ScheduleDesign, memory: ScheduleMemory, loop: Any, z: Vector, seen: Vector,
    reference: Vector, at_f: int, u: float, continues: bool,
) -> int:  # fmt: skip
    own, second, table = memory.loop[0], design.second, design.table
    given, is_known = _signal(design.first, memory, loop, seen), own.found != 0.0
    if not is_known and (
        _is_missing(design.first, given) or _is_second_missing(second, memory, loop, seen)
    ):
        return _SCHEDULE_HELD
    row, weight, status = _place(design.first, memory.first[0], given, is_known)
    column, other, more = _place_second(second, memory, loop, seen)
    own.found = 1.0
    if design.has_b0:
        b0 = 1.0 / _blended(second, table, row, column, weight, other, 0)
        change = (own.b0 - b0) * u
        z[at_f] += change
        seen[at_f] += change
        own.b0 = b0
    jump = 0.0  # of the law's numerator
    for i in range(design.law):
        value = _blended(second, table, row, column, weight, other, 1 + i)
        jump += (memory.values[i] - value) * (_wished(reference, loop.r, i) - seen[i])
        memory.values[i] = value
    if design.law > 0 and continues:
        loop.offset += jump / own.b0
    for i in range(design.law, design.law + design.gains):
        memory.values[i] = _blended(second, table, row, column, weight, other, 1 + i)
    return status | more


@kernel
def set_signal(memory: ScheduleMemory, i: int, value: float) -> None:
    """Set an external signal; one that is not usable leaves the last one."""
    memory.usable[i] = 0.0
    if is_usable(value):
        memory.given[i] = value
        memory.usable[i] = 1.0


@set_signals.register(ScheduleDesign)
def _set_signals(
    design: ScheduleDesign, memory: ScheduleMemory, values: Vector, begin: int
) -> None:
    count = memory.given.size
    first = begin if begin >= 0 else values.size - count
    if first >= 0 and first + count <= values.size:
        for i in range(count):
            set_signal(memory, i, values[first + i])


@forget_signals.register(ScheduleDesign)
def _forget_signals(design: ScheduleDesign, memory: ScheduleMemory, b0: float) -> None:
    own = memory.loop[0]
    own.found = 0.0
    own.b0 = b0
    for i in range(memory.values.size):
        memory.values[i] = 0.0


# ---- The schedule ----


class Point(NamedTuple):
    """The gains at one value of the signals."""

    b0: float
    omega_c: float
    omega_o: float


@dataclass(frozen=True)
class Schedule:
    """Tables of b0 and bandwidths over one or two signals, for ``ADRC(…, schedule=…)``.

    The module's docstring has the equations, and what holds. ``quell.tune_schedule`` makes one.

    Parameters
    ----------
    points
        values of the signal, increasing; of two signals a pair of such lists.
    signal
        what is followed: ``"reference"``, ``"y"``, ``"speed"``, the estimate of y', or
        ``"external"``, which ``set_signals`` gives, in simulations ``Scenario.schedule``. A pair of
        two of them for tables over two signals.
    b0
        nominal control gain at the points [y-unit/u-unit/s^n], all of one sign; of two signals a
        list for each point of the first one. That of the observer by default.
    omega_c
        controller bandwidth at the points [rad/s]; that of the controller by default.
    omega_o
        observer bandwidth at the points [rad/s]; that of the observer by default.

    Raises
    ------
    ValueError
        for points that do not increase, tables of another size, numbers out of range, no table at
        all; and in a controller, see ``ADRC``, for what can not be scheduled.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=2000.0, omega_o=300.0, dt=5e-4)
    >>> arm = Schedule(points=(0.0, 1.0), signal="external", b0=(5000.0, 500.0))
    >>> controller = ql.ADRC(observer, omega_c=60.0, schedule=arm)
    >>> round(controller.at(0.5).observer.b0, 1)  # of the mean inertia
    909.1
    """

    points: Sequence[float] | Sequence[Sequence[float]]
    signal: str | Sequence[str] = "external"
    b0: Sequence[float] | Sequence[Sequence[float]] | None = None
    omega_c: Sequence[float] | Sequence[Sequence[float]] | None = None
    omega_o: Sequence[float] | Sequence[Sequence[float]] | None = None

    def __post_init__(self) -> None:
        names = (self.signal,) if isinstance(self.signal, str) else tuple(self.signal)
        for name in names:
            checks.one_of("signal", name, SIGNALS)
        if len(names) not in (1, 2) or (len({*names}) < len(names) and names[0] != "external"):
            raise ValueError(f"signal = {self.signal!r}: must be one signal, or two different ones")
        given = (self.points,) if len(names) == 1 else self.points
        if not checks.is_sequence(given) or len(given) != len(names):
            rule = "must be a list for each of the two signals"
            raise ValueError(f"points = {self.points!r}: {rule}")
        axes = []
        for i, each in enumerate(given):
            name = "points" if len(names) == 1 else f"points[{i}]"
            axis = checks.vector(name, each)
            if axis.size < 2 or not np.all(np.diff(axis) > 0.0):
                raise ValueError(f"{name} = {each!r}: must be two or more increasing numbers")
            axes.append(axis)
        shape = tuple(axis.size for axis in axes)
        if self.b0 is None and self.omega_c is None and self.omega_o is None:
            raise ValueError("b0, omega_c and omega_o are None: give a table of one of them")
        for name in Point._fields:
            table = getattr(self, name)
            if table is None:
                continue
            try:
                found = np.asarray(table, dtype=np.float64)
            except (TypeError, ValueError):
                found = np.zeros(0)
            if found.shape != shape or not np.all(np.isfinite(found)):
                size = " x ".join(map(str, shape))
                raise ValueError(f"{name} = {table!r}: must be {size} finite numbers, as points")
            if np.any(found == 0.0) or np.any(np.sign(found) != np.sign(found.flat[0])):
                raise ValueError(f"{name} = {table!r}: must be of one sign, and not zero")
            if name != "b0" and found.flat[0] < 0.0:
                raise ValueError(f"{name} = {table!r}: must be positive, in rad/s")

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals, one or two."""
        return (self.signal,) if isinstance(self.signal, str) else tuple(self.signal)

    @property
    def axes(self) -> tuple[Vector, ...]:
        """Points of each signal."""
        given = (self.points,) if len(self.signals) == 1 else self.points
        return tuple(np.asarray(each, dtype=np.float64) for each in given)

    @property
    def external(self) -> int:
        """Number of external signals."""
        return self.signals.count("external")

    def at(self, values: Sequence[float], base: Point) -> Point:
        """Return the gains for values of the signals, of which those outside are at the end.

        ``base`` has the gains for which there is no table.
        """
        cells = []
        for axis, value in zip(self.axes, values, strict=True):
            cell = int(np.clip(np.searchsorted(axis, value, "right") - 1, 0, axis.size - 2))
            weight = (value - axis[cell]) / (axis[cell + 1] - axis[cell])
            cells.append((cell, float(np.clip(weight, 0.0, 1.0))))
        found = base._asdict()
        for name in Point._fields:
            if getattr(self, name) is not None:
                table = np.asarray(getattr(self, name), dtype=np.float64)
                table = 1.0 / table if name == "b0" else table
                for cell, weight in reversed(cells):
                    below, above = table[..., cell], table[..., cell + 1]
                    table = below + weight * (above - below)
                found[name] = float(1.0 / table if name == "b0" else table)
        return Point(**found)

    def design(
        self, observer: ESO, omega_c: float, law: Callable[[float], Vector] | None
    ) -> ScheduleDesign:
        """Return the parameters; ``law`` gives the gains (m,) of a bandwidth, None without law."""
        base = Point(observer.b0, omega_c, observer.omega_o)
        self._check(observer, law is not None)
        axes = [self._divided(i, axis) for i, axis in enumerate(self.axes)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        points = [self.at(values, base) for values in grid.tolist()]
        columns = [np.array([[1.0 / point.b0] for point in points])]
        if self.omega_c is not None and law is not None:
            own = law(omega_c)
            columns.append(np.array([law(point.omega_c) - own for point in points]))
        gains = 0
        if self.omega_o is not None:
            with_gain, gains = redesign(observer), observer.estimates
            own = with_gain(observer.omega_o)
            share = 1.0 if observer.form == "predictor" else 1.0 - own[0]
            columns.append(np.array([(with_gain(p.omega_o) - own) / share for p in points]))
        given = iter(range(len(axes)))
        made = [
            Axis(
                np.ascontiguousarray(axis),
                1.0 / np.diff(axis),
                SIGNALS.index(name),
                next(given) if name == "external" else 0,
            )
            for axis, name in zip(axes, self.signals, strict=True)
        ]
        return ScheduleDesign(
            first=made[0],
            second=made[1] if len(made) == 2 else NoAxis(),
            table=np.ascontiguousarray(np.hstack(columns)),
            inverse_b0=1.0 / observer.b0,
            has_b0=self.b0 is not None,
            is_delayed=isinstance(observer.model, DelayedModel),
            law=0 if self.omega_c is None else int(columns[1].shape[1]),
            gains=gains,
            takes_u=law is None,
        )

    def memory(self, design: ScheduleDesign) -> ScheduleMemory:
        """Return the state before the first sample."""
        loop = ScheduleLoop.zeros()
        loop[0].b0 = 1.0 / design.inverse_b0
        return ScheduleMemory(
            given=np.zeros(self.external),
            usable=np.zeros(self.external),
            first=AxisLoop.zeros(),
            second=AxisLoop.zeros(),
            values=np.zeros(design.law + design.gains),
            loop=loop,
        )

    def check_retuning(self, old: ESO, new: ESO | None, has_omega_c: bool) -> None:
        """Raise a ``ValueError`` if a controller is given a new value that its tables replace."""
        changes = {"b0": new is not None and new.b0 != old.b0, "omega_c": has_omega_c}
        changes["omega_o"] = new is not None and new.omega_o != old.omega_o
        for name, changed in changes.items():
            if changed and getattr(self, name) is not None:
                raise ValueError(
                    f"{name} is in the table of the schedule: another one of the controller has no "
                    "effect; make a controller with another schedule"
                )

    def _check(self, observer: ESO, has_law: bool) -> None:
        """Raise a ``ValueError`` for what can not be scheduled."""
        if "speed" in self.signals and observer.order < 2:
            raise ValueError(
                "schedule.signal = 'speed': the observer is of order 1 and has no estimate of y'; "
                "follow 'y' or an external signal"
            )
        if self.omega_c is not None and not has_law:
            raise ValueError("schedule.omega_c: a compensator has no law; give b0 and omega_o")
        if self.b0 is None:
            return
        check_b0_of(observer)
        if np.ravel(self.b0)[0] * observer.b0 < 0.0:
            raise ValueError(
                f"schedule.b0 = {self.b0!r}: must have the sign of the observer's {observer.b0!r}"
            )

    def _divided(self, i: int, axis: Vector) -> Vector:
        """Return the points of a signal, and more where a bandwidth changes much between two."""
        parts = np.ones(axis.size - 1)
        for name in ("omega_c", "omega_o"):
            if getattr(self, name) is not None:
                table = np.moveaxis(np.asarray(getattr(self, name), dtype=np.float64), i, 0)
                ratio = np.abs(np.diff(np.log(table.reshape(axis.size, -1)), axis=0))
                # In equal steps the lowest has the largest ratio, e.g. 1.25, 1.2, 1.17, … to 2.
                steps = np.expm1(np.max(ratio, axis=1)) / (_LARGEST_RATIO - 1.0)
                parts = np.maximum(parts, np.ceil(steps))
        total = int(np.sum(parts)) + 1
        if total > _MOST_POINTS:
            raise ValueError(
                f"schedule: bandwidths change so much that {total} points are needed; at most "
                f"{_MOST_POINTS}: give a table with less change"
            )
        pieces = [
            np.linspace(axis[j], axis[j + 1], int(n), endpoint=False) for j, n in enumerate(parts)
        ]
        return np.concatenate([*pieces, axis[-1:]])


def redesign(observer: ESO) -> Callable[[float], Vector]:
    """Return the gain L (N,) of an observer as a function of omega_o.

    Raises ``ValueError`` for observers whose gain does not follow from omega_o.
    """
    model = without_delay(observer.model)
    refusal = ValueError(
        f"schedule.omega_o: the gain of {observer!r} does not follow from omega_o, or its "
        "correction is of another kind; take ESO.model_free or ESO.model_based in the form "
        "'current' or 'predictor', without keep_zeros"
    )
    if type(model) is not EsoModel or observer.form == "reduced":
        raise refusal

    def gain(omega_o: float, half_gain: bool = False) -> Vector:
        how: dict[str, Any] = {"form": observer.form, "half_gain": half_gain}
        how |= {"poles": observer.poles, "disturbance_order": observer.disturbance_order}
        plant, b0, dt = observer.plant, observer.b0, observer.dt
        return design_model(plant, b0, omega_o, dt, keep_zeros=False, **how).gain

    for half in (False, True):
        if np.allclose(gain(observer.omega_o, half), model.gain, rtol=1e-9, atol=0.0):
            return lambda omega_o: gain(omega_o, half)
    raise refusal


def with_gains(observer: ESO, b0: float, omega_o: float) -> ESO:
    """Return an observer with another b0 and bandwidth."""
    delayed = observer.model
    model = without_delay(delayed)
    if omega_o != observer.omega_o:
        model = model._replace(gain=redesign(observer)(omega_o))
    model = model._replace(input=model.input * (b0 / observer.b0))
    made = delayed._replace(inner=model) if isinstance(delayed, DelayedModel) else model
    return replace(observer, b0=b0, omega_o=omega_o, model=made)


def check_b0_of(observer: ESO) -> None:
    """Raise a ``ValueError`` for an observer whose b0 can not change while it runs."""
    if observer.plant.zeros.size or not observer.plant.matched:
        raise ValueError(
            "schedule.b0: for a plant with zeros, or with an f that enters elsewhere than u, "
            "b0 changes the meaning of the states; schedule omega_c and omega_o only"
        )


def checked_schedule(schedule: Any) -> Any:
    """Return ``schedule`` if it is a ``Schedule``, an ``OnlineGain``, or None."""
    needed = ("design", "memory", "at", "check_retuning")
    is_one = not isinstance(schedule, type) and all(hasattr(schedule, name) for name in needed)
    if schedule is None or is_one:
        return schedule
    example = "quell.Schedule((0.0, 1.0), 'external', b0=(5000.0, 500.0))"
    raise ValueError(f"schedule = {schedule!r}: must be {example}, or None")


def is_scheduled(controller: Any) -> bool:
    """Return whether a controller, or the one in it, has a schedule."""
    while controller is not None:
        if getattr(controller, "schedule", None) is not None:
            return True
        inner = getattr(controller, "compensator", None)
        controller = inner or getattr(controller, "controller", None)
    return False
