"""The bandwidths of coupled axes, so that all bounds hold for the whole; a part of ``tune``.

Each axis is tuned alone first, on its own diagonal entry of the plant behind B0 (``tuning.tune``),
or on ``b/s^n`` where that entry cannot be stabilised by itself. That is optimal where the axes do
not notice each other. In the coupled loop it may keep no bound at all, so factors of omega_c and
omega_o that all axes share are tried on a grid, and from the best of them, in different valleys,
all bandwidths are searched together for the least mean of the logarithms of::

    ∫ |y_i| dt after a step of the load of axis i, over that of axis i alone

Where none of the grid keeps the bounds there are starts with one axis slower than the others by a
factor of ten, for each axis: loops that are closed one after the other, the fast ones first, need
no more than a plant that is diagonally dominant up to the bandwidth of each (Mayne, *Automatica* 9,
1973; Hovd & Skogestad, *Automatica* 30, 1994). It is the way out where the axes are coupled and B0
does not know it.

The bounds, for every plant of the set:

* M_s, M_t of each output and of each actuator with the loops of all others closed, and M_ks of each
  axis from y_i to v_i;
* the disk margin of all outputs at once, and of all actuators at once. By default it must be what
  any single loop has with these M_s and M_t, ``1/√((M_s² + M_t²)/2 − 1/4)``, which follows from
  ``|S − 1/2|² = (|S|² + |T|²)/2 − 1/4``: 0.658 for 1.6;
* the damping of the closed loop's poles.

The plants are those of the operating points, and those with entries of B0 that are off by a share,
in both directions: all combinations for two axes, else as many drawn ones.

Where actuators have limits the axes run in the file that is written, with steps of the references
and loads that the actuators can't hold (``acceptance.py``). Axes that fail give way to slower ones
that pass, where no ``∫ |y_i| dt`` is more than 1.5 times as large.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.analysis import matrices
from quell.analysis.coupling import (
    ABOVE_BANDWIDTH,
    INDEPENDENT,
    Coupling,
    balancing,
    coupling,
    is_turned,
    unstable_zeros,
)
from quell.analysis.multivariable import MultivariableLoop, analyse_axes
from quell.controllers.axes import Axes
from quell.learners.base import NoLearner
from quell.lti.zeros import invariant_zeros
from quell.observers.eso import with_gains
from quell.parallel import one_blas_thread
from quell.plants.channels import delayed_inputs
from quell.plants.linear import LinearPlant
from quell.plants.linearise import held_points
from quell.sweeping.sweep import share_interval
from quell.tuning.acceptance import Judged, accepted, judge_axes
from quell.tuning.axes_at_limits import (
    file_at,
    held_loads,
    least_gains,
    slower,
    step_sizes,
    time_constant,
    with_prefilters,
)
from quell.tuning.constraints import Constraints, first_given, given_constraints
from quell.tuning.interaction import PLACES, TOLERANCE, GivenB0, Interaction, Reached, excess
from quell.tuning.optimiser import coupled
from quell.tuning.report import Design
from quell.tuning.tuned import Check, Tuned
from quell.tuning.written import Written, bounded
from quell.types import Matrix, Progress, Vector

# Sign patterns of the errors of B0 that are in the set at most.
_MOST_PATTERNS = 16
# How much slower one axis is than the others in further starts.
_APART = 10.0
# Starts of a search.
_STARTS = 3
# Limits are lowered by as much as a result exceeds them, so many times.
_REPAIRS = 4
# An excess that is not repaired, and the most that bounds are tightened by in a round.
_HOPELESS, _MOST_TIGHTER = 0.5, 0.1
# Plants with errors of B0 that join the search in a round, and the lowest bandwidth in units of the
# lowest of the axes alone.
_WORST, _SLOWEST = 2, 1e-4
# A pole and a zero of the diagonal entry cancel within this share of their size, and of the
# fastest pole; it is far above rounding, and far below what a controller notices.
_CANCEL, _CANCEL_OF_FASTEST = 1e-6, 1e-10
# Difference to the gains of the plant, as a share of the largest entries of its row and column,
# below which B0 counts as that of the plant; and the frequencies that are looked at.
_SAME_B0, _FREQUENCIES = 0.01, 40
# An entry of B0 below this share of the largest ones of its row and column is rounding.
_ROUNDED = 1e-12
# Least sum of squares that is divided by.
_TINY = float(np.finfo(np.float64).tiny)
BOUNDS_TOGETHER = ("m_s", "m_t", "m_ks", "damping", "noise_over_pi", "omega_o_dt")
"""Bounds of ``Constraints`` that are for several axes."""
OBJECTIVES = ("load-iae", "load")


def tune_together(
    alone: Callable[..., Tuned],
    plant: Any,
    axes: Axes,
    *,
    constraints: Constraints | None,
    disk: float | None,
    B0_off: float,
    operating_points: Sequence[Any] | None,
    objective: str,
    check_samples: int,
    seed: int,
    setup: Mapping[str, Any] | None,
    written: Written | bool,
    progress: Progress | None,
) -> Tuned:
    """Return axes with the best bandwidths under bounds for the coupled loop.

    ``alone`` is ``tune`` of one axis; ``tune`` has the other parameters, and raises the errors.
    """
    if not isinstance(axes, Axes):
        raise ValueError(
            f"controller = {axes!r:.80}: must be quell.Axes; for one axis give dt and structure"
        )
    checks.one_of("objective", objective, OBJECTIVES)
    B0_off = checks.finite("B0_off", B0_off)
    if not 0.0 <= B0_off < 1.0:
        raise ValueError(f"B0_off = {B0_off!r}: must be a share from 0 to below 1, 0.2 for 20 %")
    bounds = _checked_bounds(constraints)
    least = checks.optional(checks.positive, "disk", disk) or _disk_of(bounds)
    if least >= 2.0:
        raise ValueError(f"disk = {disk!r}: must be below 2, the margin without any feedback")
    _check_tunable(axes)
    checks.whole("check_samples", check_samples, 1)
    checks.whole("seed", seed, 0)
    report = progress or (lambda part, share: None)
    points: list[Any] = [None]
    if operating_points is not None:
        points = list(held_points("operating_points", plant, operating_points))
    nominal = _nominal(plant, axes, points)
    parts = len(axes.names) + 2
    tuned_alone: dict[str, Tuned] = {}
    own = []
    with one_blas_thread():
        for i, name in enumerate(axes.names):
            report(f"{name} alone", i / parts)
            entry, tuned_alone[name] = _alone(alone, plant, axes, i, points[0], bounds, objective)
            own.append(entry)
        patterns = [_with_errors(one, B0_off, seed) for one in nominal]
        plants = [*nominal, *(each for part in patterns for each in part)]
        dead = max(matrices.linear_part_of(plant, axes.dt, points[0])[1], default=0)
        loops = partial(coupled.CoupledLoops, dt=axes.dt, dead=dead, objective=objective)
        limits, start, costs = _each_alone(tuned_alone, own, dead, axes, bounds, least, loops)
        loops = partial(loops, axes=axes.axes, alone=costs)
        report("together", (parts - 2) / parts)
        found, judged, worst = _search(loops, plants, len(nominal), axes, limits, start, bounds)
        report("check", (parts - 1) / parts)
        checked = None
        if B0_off > 0.0:
            drawn = partial(loops, limits=limits)
            checked = _check(nominal, B0_off, drawn, found, check_samples, seed)
        told, seen = list[str](), None
        stable = all(_loop(each, axes, found.values).stable for each in judged)
        if bounded(axes) and stable and written is not False:
            report("limits of u", (parts - 1) / parts)
            file = written
            if not isinstance(file, Written):
                file = file_at(plant, axes, points[0])
            held = held_loads(plant, axes, points[0])

            def at_limits(each: coupled.Found) -> Judged:
                """Return what the axes do with these bandwidths in the file."""
                whole = _made(axes, each.values)
                tau = time_constant(_loop(nominal[0], axes, each.values))
                sizes = step_sizes(nominal[0], whole, tau, points[0])
                return judge_axes(
                    file, whole, tau, held, sizes,
                    lambda of, files: with_prefilters(plant, of, held, points[0], files),
                )  # fmt: skip

            others = slower(found, loops(plants, limits=limits))
            found, seen, refused = accepted(found, others, at_limits, "the quickest")
            if refused:
                told.append(refused)
                worst = _exact(loops(judged, limits=limits), range(len(judged)), axes, found.values)
        made: Axes = _made(axes, found.values) if seen is None else seen.controller
        A, B, C, R = nominal[0]
        bandwidth, fastest = (
            float(np.max(np.sqrt(values[:, 0] * values[:, 1]))) for values in (found.values, start)
        )
        shown = tuple(_loop(each, made, found.values) for each in judged)
        designs = _designs(made, shown, judged, found, costs, objective, setup)
        return Tuned(
            axes=tuple(designs.values()),
            designs=designs,
            analysis=shown[0],
            constraints=bounds,
            objective=objective,
            check=checked,
            setup=dict(setup or {}),
            judged_at_limits=seen,
            told=(*told, *least_gains(shown)),
            machine=made,
            alone=tuned_alone,
            details=Interaction(
                names=axes.names,
                loops=shown,
                disk=least,
                reached=tuple(worst),
                B0_off=B0_off,
                points=len(points),
                plants=len(plants),
                left=_relative_gains(A, B @ R, C, axes, bandwidth),
                of_plant=_relative_gains(A, B, C, axes, bandwidth),
                given=_given_gain(plant, axes, points[0], nominal[0], bandwidth, fastest),
                with_learners=_with_learners(plant, made, points[0]),
            ),
        )


# ---- Arguments ----


def _checked_bounds(given: Constraints | None) -> Constraints:
    bounds = given_constraints(given)
    others = (name for name in Constraints.__dataclass_fields__ if name not in BOUNDS_TOGETHER)
    if name := first_given(bounds, tuple(others)):
        raise ValueError(
            f"constraints: {name} is not bounded for axes; bound m_ks, the gain from y to v"
        )
    return bounds


def _disk_of(bounds: Constraints) -> float:
    """Return the disk margin of any single loop with these M_s and M_t."""
    # |T| ≤ 1 + |S| and the reverse, where one of them is not bounded.
    m_s = bounds.m_s or 1.0 + float(bounds.m_t or 0.0)
    m_t = bounds.m_t or 1.0 + float(bounds.m_s or 0.0)
    return 1.0 / math.sqrt(0.5 * (m_s**2 + m_t**2) - 0.25)


def _check_tunable(axes: Axes) -> None:
    """Raise a ``ValueError`` for axes whose bandwidths cannot be tuned."""
    if axes.compensates:
        raise ValueError(
            "axes: NOT tuned, they are compensators, which have no omega_c, and whose loops others "
            "close; tune_compensator tunes one for its own controller"
        )
    if axes.learning.learns and axes.learning.is_shared:
        raise ValueError(
            "learner: NOT tuned with one for all axes: its features pass through one lag filter, "
            "so that all omega_o would have to be equal; tune axes without it, or give a list with "
            "a learner for each axis"
        )
    for name, axis in zip(axes.names, axes.axes, strict=True):
        if axis.feedback is not None:
            raise ValueError(f"axis {name}: feedback is not linear; tune without it")
        if axis.observer.disturbance_order > 1:
            raise ValueError(
                f"axis {name}: disturbance_order = {axis.observer.disturbance_order} of its "
                "observer: must be 1"
            )


def _nominal(plant: Any, axes: Axes, points: Sequence[Any]) -> list[coupled.Plant]:
    """Return the plant at each operating point."""
    found = []
    for point in points:
        A, B, C = matrices.sampled_matrices(plant, axes.dt, point)
        if (C.shape[0], B.shape[1]) != (axes.outputs, axes.inputs):
            raise ValueError(
                f"plant has {B.shape[1]} inputs and {C.shape[0]} outputs: the controller has "
                f"{axes.outputs} axes and {axes.inputs} actuators"
            )
        R = matrices.gain_at(axes, matrices.estimates_at(axes, plant, point))[1]
        found.append(coupled.Plant(A, B, C, R))
    return found


def _with_errors(nominal: coupled.Plant, off: float, seed: int) -> list[coupled.Plant]:
    """Return the plants whose B0 differs from the controller's by a share."""
    if off == 0.0:
        return []
    B0 = _gain_of(nominal)
    entries = int(np.count_nonzero(B0))
    if 2**entries <= _MOST_PATTERNS:
        patterns = np.array(list(itertools.product((-1.0, 1.0), repeat=entries)))
    else:
        rng = np.random.default_rng([seed, 2])
        patterns = rng.choice(np.array([-1.0, 1.0]), size=(_MOST_PATTERNS, entries))
    return [_off_by(nominal, B0, off * signs) for signs in patterns]


def _gain_of(nominal: coupled.Plant) -> Matrix:
    """Return B0 of its inverse; an entry that is rounding beside its row and column is zero."""
    B0 = np.asarray(np.linalg.pinv(nominal.R), dtype=np.float64)
    size = np.abs(B0)
    least = np.minimum(np.max(size, axis=0), np.max(size, axis=1, keepdims=True))
    return np.where(size > _ROUNDED * least, B0, 0.0)


def _off_by(nominal: coupled.Plant, B0: Matrix, shares: Vector) -> coupled.Plant:
    """Return the plant with the entries of B0 that are not zero off by shares."""
    error = np.zeros(B0.shape)
    error[B0 != 0.0] = shares * B0[B0 != 0.0]
    return nominal._replace(B=nominal.B + nominal.B @ nominal.R @ error)


# ---- Each axis alone ----


def _alone(
    tune: Callable[..., Tuned],
    plant: Any,
    axes: Axes,
    i: int,
    point: Any,
    bounds: Constraints,
    objective: str,
) -> tuple[tuple[Vector, Vector], Tuned]:
    """Return the plant that one axis is tuned on alone, and its tuning.

    It is the diagonal entry of the plant behind B0. There the other axes are free, and an arm may
    fall, so that no controller of this axis helps: then it is ``b/s^n``.
    """
    name, axis = axes.names[i], axes.axes[i]
    observer, structure = axis.observer, "bandwidths"
    if axis.half_gain:
        structure = "half-gain-law"
    elif observer.form == "reduced":
        structure = "reduced"
    elif not observer.has_one_pole and observer.poles is None:
        structure = "half-gain"
    waiting = matrices.linear_part_of(plant, axes.dt, point)[1]
    how: dict[str, Any] = {"structure": structure, "order": observer.order, "compare": ()}
    how |= {"objective": objective, "constraints": bounds}
    late = max(waiting, default=0) * axes.dt
    try:
        own = diagonal_plant(plant, axes, i, point)
        if own[0][0] < 0.0:
            raise ValueError("v moves it the wrong way: check the signs of B0")
        try:
            return own, tune(own, axes.dt, delay=late, **how)
        except ValueError:
            chain = own[0][:1], np.eye(1, observer.order + 1)[0]
            return chain, tune(chain, axes.dt, delay=late, **how)
    except ValueError as error:
        raise ValueError(f"axis {name} alone: {error}") from None


def diagonal_plant(plant: Any, axes: Axes, i: int, point: Any) -> tuple[Vector, Vector]:
    """Return the transfer function from v_i to y_i, without delays."""
    linear = matrices.linear_part_of(plant, axes.dt, point)[0]
    R = matrices.gain_at(axes, matrices.estimates_at(axes, plant, point))[1]
    return diagonal_entry(linear.A, linear.B @ R[:, i], linear.C[i])


def diagonal_entry(A: Matrix, b: Vector, c: Vector) -> tuple[Vector, Vector]:
    """Return numerator and denominator from one input to one output, without what cancels.

    The poles of the other axes are zeros as well, so that they leave. Raises ``ValueError`` if the
    input does not move the output.
    """
    poles = np.linalg.eigvals(A).astype(complex).tolist()
    zeros = invariant_zeros(A, b[:, None], c[None, :]).values.astype(complex).tolist()
    row, gain = c.copy(), 0.0
    for _ in range(A.shape[0]):
        gain = float(row @ b)
        if abs(gain) > 1e-9 * float(np.abs(row) @ np.abs(b)):
            break
        row, gain = row @ A, 0.0
    if gain == 0.0:
        raise ValueError("its v does not move its y; check B0 and the order of the outputs")
    fastest = float(np.max(np.abs(poles), initial=0.0))
    for zero in list(zeros):
        distance = [abs(pole - zero) for pole in poles]
        nearest = int(np.argmin(distance)) if poles else -1
        near = _CANCEL * abs(zero) + _CANCEL_OF_FASTEST * fastest
        if poles and distance[nearest] <= near:
            del poles[nearest]
            zeros.remove(zero)
    num, den = (np.atleast_1d(np.real(np.poly(roots))) for roots in (zeros, poles))
    return gain * num, den


def _each_alone(
    alone: Mapping[str, Tuned],
    own_plants: Sequence[tuple[Vector, Vector]],
    dead: int,
    axes: Axes,
    bounds: Constraints,
    least: float,
    loops: Callable[..., coupled.CoupledLoops],
) -> tuple[coupled.Limits, Matrix, Vector]:
    """Return the bounds, the best bandwidths of each axis alone with b0 = 1, and their costs.

    ``tune`` has another b0, which is the gain of the axis here.
    """
    rows, costs, known = [], [], []
    for i, name in enumerate(axes.names):
        values = alone[name].design.values
        m_ks = alone[name].constraints.m_ks
        known.append(m_ks)
        own = bounds.m_s, bounds.m_t, None if m_ks is None else (m_ks,), least, bounds.damping
        linear = LinearPlant.of(own_plants[i])
        one = linear
        late = delayed_inputs(one, dead * axes.dt, axes.dt) if dead else one
        single = coupled.Plant(*matrices.sampled_matrices(late, axes.dt), np.eye(1))
        task = loops([single], [axes.axes[i]], coupled.Limits(*own), alone=np.ones(1))
        start = np.array([[values["omega_c"], values["omega_o"]]])
        low, high = _ends(start, bounds, axes.dt)
        first = coupled.starts(task, start, low, high, _STARTS)
        ends = [coupled.optimum(task, each.values, low, high) for each in first]
        best = min(ends, key=lambda each: each.rank)
        rows.append(best.values[0])
        costs.append(best.measured.costs[0])
    of_noise = None if None in known else tuple(each for each in known if each is not None)
    limits = coupled.Limits(bounds.m_s, bounds.m_t, of_noise, least, bounds.damping)
    return limits, np.array(rows), np.array(costs)


def _ends(start: Matrix, bounds: Constraints, dt: float) -> tuple[Vector, Vector]:
    """Return the least and the largest omega_c and omega_o."""
    return np.full(2, _SLOWEST * float(np.min(start))), np.full(2, bounds.omega_o_dt / dt)


# ---- All axes ----


def _search(
    loops: Callable[..., coupled.CoupledLoops],
    plants: Sequence[coupled.Plant],
    points: int,
    axes: Axes,
    limits: coupled.Limits,
    start: Matrix,
    bounds: Constraints,
) -> tuple[coupled.Found, list[coupled.Plant], list[Reached]]:
    """Return the best bandwidths, the plants they are judged on, and the bounds there.

    The search has the plants of the operating points, and those with errors of B0 that turned out
    to be the worst so far. Bounds are judged on exact responses.
    """
    low, high = _ends(start, bounds, axes.dt)
    every = loops(plants, limits=limits)
    members = list(range(points))
    first = coupled.starts(every, start, low, high, _STARTS)
    for i in range(len(start) if len(start) > 1 and first[0].rank[0] else 0):
        apart = start.copy()
        apart[i] /= _APART
        first += coupled.starts(every, apart, low, high, 1)
    first = sorted(first, key=lambda each: each.rank)[:_STARTS]
    for each in first:
        members = _with_worst(every, each, members)
    now, found, reached = [each.values for each in first], first[0], [_NOT_STABLE]
    for _ in range(_REPAIRS):
        few = loops([plants[j] for j in members], limits=limits)
        ends = [coupled.optimum(few, each, low, high) for each in now]
        ends = [coupled.Found(each.values, every.measured(each.values)) for each in ends]
        best = min(ends, key=lambda each: each.rank)
        members = _with_worst(every, best, members)
        there = _exact(every, members, axes, best.values)
        worst = excess(there)
        if worst < excess(reached):
            reached, found = there, best
        if worst <= TOLERANCE or worst > _HOPELESS:
            break
        now, limits = [best.values], _tightened(limits, 1.0 + min(1.2 * worst, _MOST_TIGHTER))
    return found, [plants[j] for j in members], reached


def _with_worst(loops: coupled.CoupledLoops, found: coupled.Found, members: list[int]) -> list[int]:
    """Return the members of a set, and the plants with the least slacks at a result."""
    slacks = np.min(loops.measured(found.values).slacks, axis=1)
    return sorted({*members, *np.argsort(slacks)[:_WORST].tolist()})


def _tightened(limits: coupled.Limits, share: float) -> coupled.Limits:
    """Return bounds that are tighter by a share."""
    return coupled.Limits(
        None if limits.m_s is None else max(limits.m_s / share, 1.001),
        None if limits.m_t is None else max(limits.m_t / share, 1.001),
        None if limits.m_ks is None else tuple(value / share for value in limits.m_ks),
        limits.disk * share,
        None if limits.damping is None else 1.0 - (1.0 - limits.damping) / share,
    )


def _made(axes: Axes, values: Matrix) -> Axes:
    """Return axes with these bandwidths, at their start, as if they were made with them."""
    made = copy.copy(axes)
    for axis, (omega_c, omega_o) in zip(made.axes, values.tolist(), strict=True):
        axis._axis = ""  # until ``made`` is made anew with all of them
        observer = with_gains(axis.observer, axis.observer.b0, omega_o)
        axis.retune(omega_c=omega_c, observer=observer)
        # A learner keeps its scales when a running axis is retuned.
        axis._learner_omega_c = omega_c
        axis._initialise()
    made.learning.update(made.axes)
    made._initialise()
    return made


def _loop(plant: coupled.Plant, axes: Axes, values: Matrix) -> MultivariableLoop:
    """Return the loop of a plant with plain axes of these bandwidths."""
    laws = [
        coupled.Law(axis).at(*map(float, row)) for axis, row in zip(axes.axes, values, strict=True)
    ]
    law = matrices.joined(laws, plant.R)
    return MultivariableLoop((plant.A, plant.B, plant.C), law, axes.dt, outputs=axes.names)


class _Peaks(NamedTuple):
    """Largest sizes over all frequencies of one loop."""

    outputs: Matrix  # |S|, |T| (2, p)
    actuators: Matrix  # (2, m)
    noise: Vector  # |C S| from y_i to v_i (p,)


def _peaks(loop: MultivariableLoop, plant: coupled.Plant) -> _Peaks:
    omega = loop.omega[1:]
    S_o, S_i = (np.einsum("kii->ki", loop.response(name, omega)) for name in ("S_o", "S_i"))
    to_v = np.einsum("kii->ki", np.linalg.pinv(plant.R) @ loop.response("CS", omega))
    outputs, actuators = (
        np.array([np.max(np.abs(S), axis=0), np.max(np.abs(1.0 - S), axis=0)]) for S in (S_o, S_i)
    )
    return _Peaks(outputs, actuators, np.max(np.abs(to_v), axis=0))


_NOT_STABLE = Reached("the loop is not stable", math.nan, math.nan, math.inf)


def _exact(
    loops: coupled.CoupledLoops, members: Sequence[int], axes: Axes, values: Matrix
) -> list[Reached]:
    """Return the worst of each bound, over frequency on the grids of ``MultivariableLoop``."""
    found: dict[str, list[Reached]] = {}

    def add(kind: str, of: str, value: float, limit: float) -> None:
        found.setdefault(kind, []).append(Reached(f"{kind} of {of}", value, limit, value / limit))

    limits = loops.limits
    for j in members:
        plant = loops.plants[j]
        loop = _loop(plant, axes, values)
        if not loop.stable:
            return [_NOT_STABLE]
        peaks = _peaks(loop, plant)
        for row, kind, limit in ((0, "M_s", limits.m_s), (1, "M_t", limits.m_t)):
            if limit is not None:
                sizes = np.concatenate([peaks.outputs[row], peaks.actuators[row]]).tolist()
                for channel, size in zip((*loop.outputs, *loop.inputs), sizes, strict=True):
                    add(kind, channel, size, limit)
        for name, size, limit in zip(
            axes.names, peaks.noise.tolist(), limits.m_ks or (), strict=False
        ):
            add("M_ks", name, size, limit)
        for at in PLACES:
            alpha = loop.disk_margin(at).alpha
            found.setdefault("disk", []).append(
                Reached(f"disk margin of all {at}", alpha, limits.disk, limits.disk / alpha, True)
            )
        pole = loops.least_damped(values, j)
        if pole is not None:
            found.setdefault("damping", []).append(
                Reached("damping of the poles", pole.damping, pole.least, pole.ratio, True)
            )
    return [max(each, key=lambda bound: bound.ratio) for each in found.values()]


def _designs(
    axes: Axes,
    loops: Sequence[MultivariableLoop],
    plants: Sequence[coupled.Plant],
    found: coupled.Found,
    alone: Vector,
    objective: str,
    setup: Mapping[str, Any] | None,
) -> dict[str, Design]:
    """Return the design of each axis; its measures are the worst of the loops, from y to v."""
    nan = np.full(len(axes.names), math.inf)
    peaks = [
        _peaks(loop, plant) if loop.stable else _Peaks(np.array([nan, nan]), np.array([nan]), nan)
        for loop, plant in zip(loops, plants, strict=True)
    ]
    designs = {}
    for i, (name, axis) in enumerate(zip(axes.names, axes.axes, strict=True)):
        omega_c, omega_o = found.values[i].tolist()
        k_i = coupled.integral_gain(coupled.Law(axis).at(omega_c, omega_o), axes.dt)
        measures = {
            "M_s": max(float(each.outputs[0, i]) for each in peaks),
            "M_t": max(float(each.outputs[1, i]) for each in peaks),
            "M_ks": max(float(each.noise[i]) for each in peaks),
            "delay_margin": min(
                loop.channel_margins(name).delay if loop.stable else 0.0 for loop in loops
            ),
            "alone": float(alone[i]),
        }
        size = float(found.measured.costs[i])
        if objective == "load":  # the cost is that of the search, 1/k_i
            size, measures["alone"] = k_i, 1.0 / measures["alone"]
        own = {} if setup is None or "axis" not in setup else setup["axis"][i]
        law = own.get("controller", {})
        law = {**({"kind": law} if isinstance(law, str) else law), "omega_c": omega_c}
        if axis.feedforward is True:
            law["feedforward"] = True
        designs[name] = Design(
            name=name,
            controller=axis,
            values={"omega_c": omega_c, "omega_o": omega_o},
            objective=size,
            k_i=k_i,
            measures=measures,
            active=(),
            tables={"observer": {**own.get("observer", {}), "omega_o": omega_o}, "controller": law},
        )
    return designs


def _check(
    nominal: Sequence[coupled.Plant],
    off: float,
    loops: Callable[..., coupled.CoupledLoops],
    found: coupled.Found,
    samples: int,
    seed: int,
) -> Check:
    """Return how the result does with drawn errors of B0."""
    rng = np.random.default_rng([seed, 3])
    drawn = []
    for k in range(samples):
        one = nominal[k % len(nominal)]
        B0 = _gain_of(one)
        drawn.append(_off_by(one, B0, rng.uniform(-off, off, int(np.count_nonzero(B0)))))
    measured = loops(drawn).measured(found.values)
    ratios = np.exp(-np.min(measured.slacks, axis=1))
    stable = measured.slacks[:, -1] > coupled.UNSTABLE
    bad = int(np.sum((ratios > 1.0 + 2.0 * TOLERANCE) | ~stable))
    interval = share_interval(bad, samples)
    return Check(samples, int(np.sum(~stable)), bad, interval, of="drawn errors of B0")


def _relative_gains(A: Matrix, B: Matrix, C: Matrix, axes: Axes, at: float) -> Coupling | None:
    """Return the relative gains at a frequency; None where there are none."""
    found = _coupling(A, B, C, axes, at)
    return None if found is None else replace(found, at=found.at[-1:])


def _coupling(A: Matrix, B: Matrix, C: Matrix, axes: Axes, at: float) -> Coupling | None:
    if B.shape[1] != C.shape[0]:
        return None
    plant = SimpleNamespace(A=A, B=B, C=C, dt=axes.dt)
    try:
        return coupling(plant, axes.dt, min(at, 0.9 * math.pi / axes.dt), axes.names)
    except ValueError:
        return None


def _given_gain(
    plant: Any, axes: Axes, point: Any, nominal: coupled.Plant, at: float, fastest: float
) -> GivenB0:
    """Return what is known of the controller's B0 at a bandwidth: whether another one is better.

    ``fastest`` is the largest bandwidth of the axes alone, to which zeros are compared.
    B0 is that of the plant if its rows are those of the gains far above all dynamics, to a factor,
    or those of the gains at some frequency above the bandwidth: lags of actuators and resonances
    are above the frequencies for which B0 is meant.
    """
    A, B, C, R = nominal
    N = A - np.eye(A.shape[0])
    linear = matrices.linear_part_of(plant, axes.dt, point)[0]
    B0 = matrices.gain_at(axes, matrices.estimates_at(axes, plant, point))[0]
    high, degrees = matrices.high_gains(linear.A, linear.B, linear.C)
    is_of_plant = _are_rows_of(high, B0)
    for omega in np.geomspace(min(at, 0.5 / axes.dt), math.pi / axes.dt, _FREQUENCIES):
        if is_of_plant:
            break
        shifted = 1j * omega * np.eye(linear.A.shape[0]) - linear.A
        is_of_plant = _are_rows_of(linear.C @ np.linalg.solve(shifted, linear.B), B0)
    better: bool | None = None
    if is_of_plant:
        better = False
    elif degrees == [axis.observer.order for axis in axes.axes]:
        inverse = np.linalg.pinv(high)
        left = _relative_gains(A, B @ inverse, C, axes, at)
        better = left is not None and left.factor <= INDEPENDENT  # not with NaN
        better = better and not is_turned(N, B @ inverse, C)
    pairs = None
    if B.shape[1] == C.shape[0]:
        whole = _coupling(A, B, C, axes, at)
        pairs = None if whole is None else whole.pairing
        if pairs is not None and np.array_equal(B0 != 0.0, np.eye(len(pairs))[list(pairs)]):
            pairs = None
    zeros = unstable_zeros(N, B @ R, C, axes.dt, ABOVE_BANDWIDTH * fastest)
    return GivenB0(is_of_plant, better, is_turned(N, B @ R, C), zeros, pairs)


def _are_rows_of(G: Any, B0: Matrix) -> bool:
    """Return whether the rows of B0 are those of gains G, each to a factor."""
    rows, columns = balancing(B0)
    B0, G = B0 * rows * columns, G * columns
    along = np.sum(G.conj() * B0, axis=1) / np.maximum(np.sum(np.abs(G) ** 2, axis=1), _TINY)
    return bool(np.max(np.abs(B0 - along[:, None] * G)) <= _SAME_B0)


def _with_learners(plant: Any, axes: Axes, point: Any) -> MultivariableLoop | None:
    """Return the nominal loop with learners at rest; None without any."""
    if all(isinstance(axis.learner, NoLearner) for axis in axes.axes):
        return None
    return analyse_axes(plant, axes, point)
