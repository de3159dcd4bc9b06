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

**b0: a load stays a load.** The observer keeps its b0, b_n. The difference is a known share of f,

    y^(n) = b0(σ) u + f = b_n u + f + (b0(σ) − b_n) u

that the observer receives with the applied u, as it receives a learner's, and the law divides by
b0(σ). f is what b0(σ) u does not explain: of an inertia with the loads d, in units of u,
``y^(n) = b0(σ) (u + d)``, it is b0(σ) d. So f changes with b0(σ) and f/b0(σ) does not, and the
estimate follows in the sample in which b0(σ) changes, with its derivatives if there are some,

    Δf̂ ← Δf̂ · b0_now/b0_before        (less a·x̂ if the observer has a model)

At rest, and at constant speed, u is then the same before and after. In an acceleration u_0 it
changes by ``u_0 (1/b0_now − 1/b0_before)``, which is what another inertia takes. This holds for an
inertia. Where the actuator's gain changes and the loads do not, they are not constant in units of
u: divide u by that gain outside of the controller, and b0 is constant.

**A learner, and a guard,** know f for the observer's b0, so that what they learned at one inertia
is right at another. With ``ρ = b0(σ)/b_n``::

    g = f/ρ,    g_L = h + s u,    f_L = ρ g_L,    u = (u_0 − Δf̂ − ρ h) / (b_n ρ + ρ s)

A gain of the plant that is wrong by a constant factor, ``b = β b0(σ)``, is a constant coefficient
of u: ``g = b_n (β d + (β − 1) u)``; for f itself it would be (β − 1) b0(σ). The observer's error,
in units of g, obeys the same equation as without a schedule but for a term (ρ'/ρ) (Δg − Δĝ), that
of its own lag error. So the regression of ``learners/base.py`` has no bias at its solution: for the
g_L that is right, Δg = g − g_L is zero, so is Δĝ = Δf̂/ρ, and

    Δĝ + g_L^F = θ·φ^F        with the filter F of before, however quickly b0 changes.

With the b0 of the moment in place of b_n the target would be ``(ρ g)^F``, and the learner, whose
features are filtered without ρ, would take each change of the inertia for one of θ. The guard
compares the same quantities, so its bounds are in units of the load, not of an acceleration.

**omega_o** has no such form: each feature of a learner is filtered with the observer's lag, and a
table of omega_o changes that filter with what is in it. It is refused with a learner.

**The feedforward of a model** has the inertia of the observer's b0: the terms from r^(n) on follow
1/b0(σ), the terms below, Coulomb friction and the constant are forces and stay, and f_m, what the
model knows of f, follows both. **A safe set** has bounds for b0(σ) u in place of b_n u, with a
margin for the largest b0. **HeldPlant** predicts the motion from ρ u, and keeps the load of before.

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
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import is_usable
from quell.controllers.held import scale_loads
from quell.controllers.safe_set import divide_bounds, scale_f
from quell.kernels.dispatch import generic_with_default, kernel
from quell.kernels.single import add_with_carry
from quell.kernels.sized import Flag, Scalars, Size
from quell.observers.eso import ESO, redesign
from quell.observers.forms import DelayedModel, DeltaModel
from quell.types import Matrix, Status, Vector

SIGNALS = ("reference", "y", "speed", "external")
"""The signals that a schedule may follow: r, y, the estimate of y', or a signal that is given."""

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
    cancel: Vector  # a (n,) of the model that the law cancels
    fixed: Vector  # c of what is fed forward and does not follow 1/b0, when u acts
    fixed_acting: Vector  # of a model the same for the u that the observer receives in this sample
    extended: Size  # m of the observer if there are b0 and a learner, else 0
    has_safe_set: Flag  # beside b0
    has_held: Flag  # whether there are b0 and a detection of holds


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
    residual: Vector  # Δf̂, Δf̂', … while a learner is shown those for the observer's b0 (m,)
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
def control_at_nominal(design: Any, memory: Any, u: float) -> float:
    """Return what a control signal is for the observer's b0: ``b0(σ)/b0 u``."""
    return u


@generic_with_default
def at_nominal(design: Any, memory: Any, f: float) -> float:
    """Return g, what an f for b0(σ) is for the observer's b0."""
    return f


@generic_with_default
def at_present(design: Any, memory: Any, g: float) -> float:
    """Return f for b0(σ), of which ``g`` is the one for the observer's b0."""
    return g


@generic_with_default
def show_at_nominal(design: Any, memory: Any, estimates: Vector, at_f: int) -> None:
    """Convert Δf̂ and its derivatives in ``estimates`` to those for the observer's b0."""


@generic_with_default
def show_at_present(design: Any, memory: Any, estimates: Vector, at_f: int) -> None:
    """Undo ``show_at_nominal``."""


@generic_with_default
def fixed_control(
    feedforward: Any, coefficients: Vector, r: float, reference: Vector, acting: bool
) -> float:
    """Return the part of a control signal fed forward that does not follow 1/b0.

    ``coefficients`` are those of r, r', …; ``acting`` asks for the one that the observer receives.
    """
    return 0.0


@generic_with_default
def known_of_model(
    design: Any, memory: Any, feedforward: Any, r: float, reference: Vector, b0: float, known: float
) -> float:
    """Return f_m, what a feedforward knows of f, for b0(σ); ``known`` is that for ``b0``."""
    return known


@generic_with_default
def show_feedforward(
    design: Any, memory: Any, feedforward: Any, r: float, reference: Vector, row: Vector
) -> None:
    """Convert u_ff in ``row``, which is that for the observer's b0."""


@generic_with_default
def safe_as_applied(
    design: Any, memory: Any, safe: float, unlimited: float, safe_set: Any, set_memory: Any
) -> float:
    """Return the control signal for ``safe``, which a safe set found for the observer's b0.

    Its bounds become those of that control signal; ``unlimited`` is what it was asked for.
    """
    return safe


@generic_with_default
def known_with_schedule(design: Any, memory: Any, known: float, b0: float, u: float) -> float:
    """Return ``known``, what is known of f, with the share of the schedule while u acts.

    It has one if the observer delays u: then only here the u that acts is known.
    """
    return known


@generic_with_default
def scheduled_law(
    design: Any, memory: Any, feedforward: Any, estimates: Vector, r: float, reference: Vector,
    b0: float, total: float,
) -> float:  # fmt: skip
    """Return the law's numerator ``total`` with what the schedule adds to gains and feedforward."""
    return total


@generic_with_default
def scheduled_correction(
    design: Any, memory: Any, eso: Any, z: Vector, estimates: Vector, y: float
) -> None:
    """Add to the observer's correction what the schedule adds to its gains."""


@generic_with_default
def follow_signals(
    design: Any, memory: Any, loop: Any, z: Vector, estimates: Vector, reference: Vector, at_f: int,
    u: float, continues: bool, safe_set: Any, set_memory: Any, held: Any, held_memory: Any,
) -> int:  # fmt: skip
    """Take the signals of a sample, without a jump of u; return the status flags.

    ``u`` is the control signal that acted, ``at_f`` the place of f, which is estimated in a safe
    set and in a detection, too. In the first sample of a loop, which does not continue another
    one, u may jump.
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


@control_at_nominal.register(ScheduleDesign)
def _control_at_nominal(design: ScheduleDesign, memory: ScheduleMemory, u: float) -> float:
    if design.has_safe_set or design.has_held:
        return u * _ratio(design, memory)
    return u


@kernel
def _ratio(design: ScheduleDesign, memory: ScheduleMemory) -> float:
    """Return ρ."""
    return memory.loop[0].b0 * design.inverse_b0


@at_nominal.register(ScheduleDesign)
def _at_nominal(design: ScheduleDesign, memory: ScheduleMemory, f: float) -> float:
    return f / _ratio(design, memory) if design.extended > 0 else f


@at_present.register(ScheduleDesign)
def _at_present(design: ScheduleDesign, memory: ScheduleMemory, g: float) -> float:
    return g * _ratio(design, memory) if design.extended > 0 else g


@show_at_nominal.register(ScheduleDesign)
def _show_at_nominal(
    design: ScheduleDesign, memory: ScheduleMemory, estimates: Vector, at_f: int
) -> None:
    for i in range(design.extended):
        memory.residual[i] = estimates[at_f + i]
        estimates[at_f + i] = at_nominal(design, memory, estimates[at_f + i])


@show_at_present.register(ScheduleDesign)
def _show_at_present(
    design: ScheduleDesign, memory: ScheduleMemory, estimates: Vector, at_f: int
) -> None:
    for i in range(design.extended):
        estimates[at_f + i] = memory.residual[i]


@known_with_schedule.register(ScheduleDesign)
def _known(
    design: ScheduleDesign, memory: ScheduleMemory, known: float, b0: float, u: float
) -> float:
    if design.has_b0 and design.is_delayed:
        return known + (memory.loop[0].b0 - b0) * u
    return known


@known_of_model.register(ScheduleDesign)
def _known_of_model(
    design: ScheduleDesign, memory: ScheduleMemory, feedforward: Any, r: float, reference: Vector,
    b0: float, known: float,
) -> float:  # fmt: skip
    if design.fixed_acting.size > 0:
        fixed = fixed_control(feedforward, design.fixed_acting, r, reference, True)
        known -= (memory.loop[0].b0 - b0) * fixed
    return known


@show_feedforward.register(ScheduleDesign)
def _show_feedforward(
    design: ScheduleDesign, memory: ScheduleMemory, feedforward: Any, r: float, reference: Vector,
    row: Vector,
) -> None:  # fmt: skip
    if design.fixed_acting.size > 0:
        fixed = fixed_control(feedforward, design.fixed, r, reference, False)
        row[0] = fixed + (row[0] - fixed) / _ratio(design, memory)


@scheduled_law.register(ScheduleDesign)
def _scheduled_law(
    design: ScheduleDesign, memory: ScheduleMemory, feedforward: Any, estimates: Vector, r: float,
    reference: Vector, b0: float, total: float,
) -> float:  # fmt: skip
    for i in range(design.law):
        total += memory.values[i] * (_wished(reference, r, i) - estimates[i])
    if design.fixed.size > 0:
        fixed = fixed_control(feedforward, design.fixed, r, reference, False)
        total += (memory.loop[0].b0 - b0) * fixed
    return total


@kernel
def _wished(reference: Vector, r: float, i: int) -> float:
    """Return the i-th derivative of the reference, zero if it is not given."""
    wished = r if i == 0 else 0.0
    if reference.size > 0 and 0 < i <= reference.size:
        wished = reference[i - 1]
    return wished


@generic_with_default
def add_to_state(eso: Any, z: Vector, estimates: Vector, i: int, change: float) -> None:
    """Add a correction of this sample to a state and to its estimate."""
    z[i] += change
    if not eso.predictor:
        estimates[i] += change


@add_to_state.register(DeltaModel)
def _add_with_carry(eso: DeltaModel, z: Vector, estimates: Vector, i: int, change: float) -> None:
    add_with_carry(z, estimates.size, i, z[estimates.size + i] + change)
    if not eso.predictor:
        estimates[i] = z[i]


@add_to_state.register(DelayedModel)
def _add_to_inner(eso: DelayedModel, z: Vector, estimates: Vector, i: int, change: float) -> None:
    add_to_state(eso.inner, z, estimates, i, change)


@scheduled_correction.register(ScheduleDesign)
def _correct(
    design: ScheduleDesign, memory: ScheduleMemory, eso: Any, z: Vector, estimates: Vector, y: float
) -> None:
    error = y - estimates[0]
    for i in range(design.gains):
        add_to_state(eso, z, estimates, i, memory.values[design.law + i] * error)


@kernel
def _signal(axis: Axis, memory: ScheduleMemory, loop: Any, estimates: Vector) -> float:
    """Return the value of a signal in this sample."""
    if axis.signal == _REFERENCE:
        return loop.r
    if axis.signal == _Y:
        return loop.y
    if axis.signal == _SPEED:
        return estimates[1]
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
def _is_second_missing(second: Any, memory: ScheduleMemory, loop: Any, estimates: Vector) -> bool:
    """Return whether a second signal is not usable."""
    return False


@_is_second_missing.register(Axis)
def _is_missing_too(second: Axis, memory: ScheduleMemory, loop: Any, estimates: Vector) -> bool:
    return _is_missing(second, _signal(second, memory, loop, estimates))


@generic_with_default
def _place_second(
    second: Any, memory: ScheduleMemory, loop: Any, estimates: Vector
) -> tuple[int, float, int]:
    """Return cell, weight and status flags of a second signal."""
    return 0, 0.0, 0


@_place_second.register(Axis)
def _place_in_second(
    second: Axis, memory: ScheduleMemory, loop: Any, estimates: Vector
) -> tuple[int, float, int]:
    value, is_known = _signal(second, memory, loop, estimates), memory.loop[0].found != 0.0
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
    design: ScheduleDesign, memory: ScheduleMemory, loop: Any, z: Vector, estimates: Vector,
    reference: Vector, at_f: int, u: float, continues: bool, safe_set: Any, set_memory: Any,
    held: Any, held_memory: Any,
) -> int:  # fmt: skip
    own, second, table = memory.loop[0], design.second, design.table
    given, is_known = _signal(design.first, memory, loop, estimates), own.found != 0.0
    if not is_known and (
        _is_missing(design.first, given) or _is_second_missing(second, memory, loop, estimates)
    ):
        return _SCHEDULE_HELD
    row, weight, status = _place(design.first, memory.first[0], given, is_known)
    column, other, more = _place_second(second, memory, loop, estimates)
    own.found = 1.0
    if design.has_b0:
        b0 = 1.0 / _blended(second, table, row, column, weight, other, 0)
        ratio, model = b0 / own.b0, 0.0
        own.b0 = b0
        for i in range(design.cancel.size):
            model += design.cancel[i] * estimates[i]
        for i in range(at_f, estimates.size):
            change = (ratio - 1.0) * (estimates[i] - model)
            z[i] += change
            estimates[i] += change
            model = 0.0
        if design.has_safe_set:
            scale_f(safe_set, set_memory, ratio)
        if design.has_held:
            scale_loads(held, held_memory, ratio)
    jump = 0.0  # of the law's numerator
    for i in range(design.law):
        value = _blended(second, table, row, column, weight, other, 1 + i)
        jump += (memory.values[i] - value) * (_wished(reference, loop.r, i) - estimates[i])
        memory.values[i] = value
    if design.law > 0 and continues:
        loop.offset += jump / own.b0
    for i in range(design.law, design.law + design.gains):
        memory.values[i] = _blended(second, table, row, column, weight, other, 1 + i)
    return status | more


@safe_as_applied.register(ScheduleDesign)
def _safe_as_applied(
    design: ScheduleDesign, memory: ScheduleMemory, safe: float, unlimited: float, safe_set: Any,
    set_memory: Any,
) -> float:  # fmt: skip
    if not design.has_safe_set:
        return unlimited
    ratio = _ratio(design, memory)
    divide_bounds(safe_set, set_memory, ratio)
    return safe / ratio


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
        list for each point of the first one. That of the observer by default. It is 1/J of an
        inertia; a learner, and the inertia of a model's feedforward, refer to the observer's b0. A
        learner's bounds of noise are those there: take a small one for a noisy y.
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

    def largest_ratio(self, observer: ESO) -> float:
        """Return the largest b0 over that of the observer, which is in use before a signal."""
        table = np.ravel([observer.b0] if self.b0 is None else self.b0)
        return max(1.0, float(np.max(table / observer.b0)))

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
        """Return the parameters; ``law`` gives the gains (m,) of a bandwidth, None without law.

        They are those of a controller of observer and law alone: it sets what its other parts need.
        """
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
            cancel=np.zeros(0),
            fixed=np.zeros(0),
            fixed_acting=np.zeros(0),
            extended=0,
            has_safe_set=False,
            has_held=False,
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
            residual=np.zeros(design.extended),
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
