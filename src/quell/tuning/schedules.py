"""``tune_schedule``: one controller for a set of operating points, with gains that follow them.

The plant at a point is known: a function of the signals, or a plant for each point. Where the
points differ by the gain b most of all, as an axis with a changing inertia, one pair of bandwidths
serves all of them: the plants are scaled to the same b, one ADRC is tuned for them all, and its
schedule has

    b0_i = b0 b_i / b

so that each loop keeps the constraints. With ``tables="all"`` each point has bandwidths of its own
tuning, which may lie far apart: the optimum of an ADRC often has two places, one with the fast
poles in the law and one with them in the observer.

The result is judged at the points, and between them where the plant is a function: M_s and M_t of
the frozen loop, and the integral of ``|y|`` after a step of the load over that of a controller that
is tuned for this very point, with the same structure and constraints.

Where u has limits the controller runs in the file that is written, and at each point with its plant
and the signals held (``acceptance.py``). One that fails gives way to one with a tighter bound of
what noise does to u, if its integrals are at most 1.5 times as large.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.analysis.loop import LoopAnalysis, analyse_axis
from quell.controllers.adrc import ADRC
from quell.controllers.schedule import Schedule
from quell.observers.eso import with_gains
from quell.parallel import one_blas_thread
from quell.plants.linear import LinearPlant
from quell.tuning import acceptance
from quell.tuning.constraints import Constraints, given_constraints
from quell.tuning.designs import range_of_u
from quell.tuning.optimiser.loops import area_until_rest
from quell.tuning.optimiser.requirements import Active
from quell.tuning.plants import Given, given_plants, with_known_noise
from quell.tuning.report import Design
from quell.tuning.tables import checked_rest, late_plant, rest_of_plant, rest_within, scenario_of
from quell.tuning.tune import tune
from quell.tuning.tuned import Tuned
from quell.tuning.written import Written
from quell.types import Progress

_STRUCTURES = ("bandwidths", "half-gain", "half-gain-law")
_TABLES = ("b0", "all")
# Range of b without which a point has one plant, and so no quantile.
_NO_RANGE = (1.0, 1.0)
# Options of ``tune`` that are for sets of plants, or for other results.
_NOT_HERE = ("uncertain", "scenario", "search", "compare", "feedforward")
# Bandwidths that differ by less are those of one optimum; and the ratio of the integrals of |y|
# from which on the summary advises other tables.
_SAME, _MUCH = 1e-6, 1.15
# Times the bound of M_s from which on the summary tells of it between the points.
_MORE = 1.05
# Points at which the controller runs at most, and shares of the bound of noise in u with which one
# is tuned that takes the place of a controller that fails at the limits of u.
_MOST_POINTS, _GENTLER = 12, (0.6, 0.35, 0.2)
# Derivatives that a profile generator has.
_MOST_DERIVATIVES = 3


@dataclass(frozen=True, eq=False)
class AtPoints:
    """A schedule at its points, as the ``details`` of a ``Tuned``.

    Attributes
    ----------
    schedule : Schedule
        that of the controller.
    loops : Mapping
        the loops at fixed signals, at the points and between them where the plant is known.
    own : Mapping
        the tuning of each point by itself, by signals.
    joint : Tuned or None
        the tuning for all points at once, of plants with the same b; None with ``tables="all"``.
    knows_between : bool
        whether the plant is a function of the signals.
    m_s_limit : float or None
        the bound of M_s.
    """

    schedule: Schedule
    loops: Mapping[tuple[float, ...], Design]
    own: Mapping[tuple[float, ...], Tuned]
    joint: Tuned | None
    knows_between: bool
    m_s_limit: float | None

    bounded, drawn, met = "", 3, True

    @property
    def plants(self) -> int:
        """The number of points for which the bounds hold."""
        return len(self.own)

    @property
    def active(self) -> tuple[Active, ...]:
        """The bounds at their limits, of all points that are tuned at once or of each."""
        if self.joint is not None:
            return self.joint.design.active
        return tuple(
            each._replace(name=f"{each.name} at {_place(at)}", omega=math.nan)
            for at, own in self.own.items()
            for each in own.design.active
        )

    @property
    def m_s(self) -> float:
        """The largest M_s of all frozen loops; infinite if one is unstable."""
        return max(each.measures["M_s"] for each in self.loops.values())

    @property
    def ratios(self) -> dict[tuple[float, ...], float]:
        """The integrals of ``|y|`` over those of the points' own tunings."""
        return {
            at: each.measures["iae"] / each.measures["alone"] for at, each in self.loops.items()
        }

    @property
    def worst_ratio(self) -> float:
        """The largest of the ``ratios``."""
        return max(ratio for ratio in self.ratios.values() if not math.isnan(ratio))

    def lines(self, tuned: Tuned) -> list[str]:
        """Return the largest M_s and ratio, and what does not hold or is not known, as lines."""
        lines = [f"largest M_s {self.m_s:.3f}, largest ratio of ∫|y| {self.worst_ratio:.3f}"]
        bound = self.m_s_limit
        if bound and self.m_s > _MORE * bound:
            worst = max(self.loops, key=lambda at: self.loops[at].measures["M_s"])
            lines.append(
                f"NOT within M_s = {bound:g}: {self.m_s:.3f} at {_place(worst)}, where "
                "the plant is not that of the interpolated gains; give more points around it"
            )
        if self.joint is not None and self.worst_ratio > _MUCH:
            lines.append(
                "NOT as good as the own tuning at each point, which needs other bandwidths there, "
                'too: tables="all" has them'
            )
        if not self.knows_between:
            lines.append(
                "NOT known between the points: the plant is given there only; give a function of "
                "the signal, or more points"
            )
        lines.append(
            "NOT proved for signals that change quickly: margins are those of fixed signals; "
            "simulate the fastest change"
        )
        return lines

    def to_json(self) -> dict[str, Any]:
        """Return it as a table."""
        return {
            "schedule": _table(self.schedule),
            "m_s": self.m_s,
            "worst_ratio": self.worst_ratio,
            "knows_between": self.knows_between,
            "own": [
                {"signals": list(at), "design": each.design.to_json()}
                for at, each in self.own.items()
            ],
        }

    def plot(self, m_s: float | None, axes: Any = None) -> Any:
        """Draw b0, M_s with its bound, and the ratio of the integrals over the first signal.

        Of two signals there is a line for each value of the second one. Points of the table are
        filled. Returns the three axes.
        """
        from quell.records.plotting import grid_of_axes, new_figure

        axes = grid_of_axes(axes, lambda: new_figure(6.4, 6.4), 3, sharex=True)[:, 0]
        names, ratios = self.schedule.signals, self.ratios
        for second in sorted({at[1:] for at in self.loops}):
            own = [at for at in self.loops if at[1:] == second]
            label = f"{names[1]} {_place(second)}" if second else None
            columns = [
                [self.loops[at].measures["b0"] for at in own],
                [self.loops[at].measures["M_s"] for at in own],
                [ratios[at] for at in own],
            ]
            for ax, values in zip(axes, columns, strict=True):
                (line,) = ax.plot([at[0] for at in own], values, "o-", mfc="none", label=label)
                filled = [(at[0], b) for at, b in zip(own, values, strict=True) if at in self.own]
                ax.plot(*zip(*filled, strict=True), "o", color=line.get_color())
        if m_s is not None:
            axes[1].axhline(m_s, color="black", linestyle="--", label="bound")
            axes[1].legend()
        quantities = ("b0", "M_s", "∫|y| over that\nof its own tuning")
        for ax, quantity in zip(axes, quantities, strict=True):
            ax.set(ylabel=quantity)
            ax.grid(True, alpha=0.3)
        axes[2].set(xlabel=f"{names[0]} signal" if names[0] == "external" else names[0])
        if len(names) == 2:
            axes[0].legend()
        return axes


def _table(schedule: Schedule) -> dict[str, Any]:
    """Return the table of a schedule in a setup file; None where it has none."""
    names = ("signal", "points", "b0", "omega_c", "omega_o")
    return {name: _listed(getattr(schedule, name)) for name in names}


def _place(signals: Sequence[float]) -> str:
    return ", ".join(f"{value:.4g}" for value in signals)


def _listed(value: Any) -> Any:
    if value is None:
        return None
    if isinstance(value, str):
        return value
    return [_listed(each) for each in value] if np.ndim(value) or not _is_number(value) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number)


def tune_schedule(
    plant: Callable[..., Any] | Mapping[Any, Any],
    dt: float,
    *,
    points: Any = None,
    signal: str | Sequence[str] = "external",
    tables: str = "b0",
    structure: str = "bandwidths",
    order: int | None = None,
    between: int = 1,
    delay: float = 0.0,
    actuator_lag: float = 0.0,
    setup: Mapping[str, Any] | None = None,
    rest: Any = None,
    written: Written | bool = True,
    progress: Progress | None = None,
    **options: Any,
) -> Tuned:
    """Return the best ADRC with a schedule for a plant that changes with one or two signals.

    Parameters
    ----------
    plant
        a function of the signals that returns a plant, of any kind that ``tune`` accepts; or the
        plants by point, ``{0.0: plant, 1.0: plant, …}``, with pairs as keys for two signals.
    dt
        sample time [s].
    points
        points of the tables, for a function: increasing numbers; a pair of lists for two signals.
    signal
        what the schedule follows, as for ``Schedule``.
    tables
        ``"b0"``: one pair of bandwidths and a table of b0; ``"all"``: three tables, each point with
        its own tuning.
    structure
        ``"bandwidths"``, ``"half-gain"`` or ``"half-gain-law"``.
    order
        order of the ADRC; by default the relative degree of the plant.
    between
        number of values in each cell at which the result is judged, too, for a function.
    delay, actuator_lag
        as for ``tune``.
    setup
        tables of a setup file that ``Tuned.toml`` completes; made from the plant of the
        middle point by default.
    rest
        u and y at rest at the middle point, as for ``tune``; the scenario of ``toml`` begins there.
    written
        plant and scenario of ``setup`` as objects, as for ``tune``.
    progress
        called with the point that is tuned and the share that is done.
    **options
        of ``tune``: ``objective``, ``constraints``, ``b_range``, ``u_min``, ``u_max``,
        ``rate_limit``, …

    Returns
    -------
    Tuned
        ``designs`` are the loops at the points and between them, ``details`` (``AtPoints``) has the
        schedule and what is known of it.

    Raises
    ------
    ValueError
        as ``tune``; for points that are missing or do not form a grid, and for plants of different
        relative degree.

    Examples
    --------
    >>> import quell as ql
    >>> def axis(inertia):
    ...     return ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0 / inertia], [1.0, 0.0])
    >>> tuned = ql.tune_schedule(axis, 1e-3, points=(2e-4, 2e-3))
    >>> points = tuned.details
    >>> [round(b0 / points.schedule.b0[-1], 3) for b0 in points.schedule.b0], round(points.m_s, 2)
    ([10.0, 1.0], 1.6)
    """
    checks.one_of("tables", tables, _TABLES)
    checks.one_of("structure", structure, _STRUCTURES)
    for name in _NOT_HERE:
        if name in options:
            raise ValueError(f"{name}: tune_schedule has no such argument; tune each point for it")
    axes, plant_at, is_function = _points(plant, points)
    grid = list(product(*axes))
    # Points and signal are checked before the tuning, which takes longer.
    shape = tuple(len(axis) for axis in axes)
    given_points = axes[0] if len(axes) == 1 else axes
    signals = Schedule(given_points, signal, b0=np.ones(shape).tolist()).signals
    late: dict[str, Any] = {"delay": delay, "actuator_lag": actuator_lag}
    given = [given_plants(plant_at(at), dt, **late) for at in grid]
    degree = given[0].degree
    for at, each in zip(grid, given, strict=True):
        if each.degree != degree:
            raise ValueError(
                f"plant at {at} has the relative degree {each.degree}, the first one {degree}: "
                "one ADRC can not serve both; leave the far zeros out of the models"
            )
    order = degree if order is None else checks.whole("order", order, 1, 8)
    limits = {k: v for k, v in options.items() if k in ("u_min", "u_max", "rate_limit")}
    # The scaled plants below have no encoder.
    bounds = with_known_noise(
        given_constraints(options.get("constraints")), plant_at(grid[0]), range_of_u(limits)
    )
    how: dict[str, Any] = {"structure": structure, "order": order, "compare": (), **late, **options}
    how |= {"written": False}
    how["constraints"] = bounds
    fine = []
    if is_function:
        finer = (_finer(axis, checks.whole("between", between, 0)) for axis in axes)
        fine = [at for at in product(*finer) if at not in grid]
    report, parts = progress or (lambda part, share: None), len(grid) + len(fine) + 1
    middle, joint_only = grid[len(grid) // 2], {}
    if tables == "b0" and tuple(options.get("b_range", _NO_RANGE)) == _NO_RANGE:
        joint_only = {name: how.pop(name) for name in ("quantile",) if name in how}

    # An axis follows a profile within the limits of u with the feedforward of its order, which
    # changes no margin and follows the tables.
    moves = isinstance(written, Written) and written.moves
    forward = written is not False and not moves and order <= _MOST_DERIVATIVES
    forward &= math.isfinite(np.subtract(*range_of_u(limits)))
    parts_of_plants = [LinearPlant.of(each.linear[0]) for each in given]
    forward &= all(np.linalg.matrix_rank(each.A) < each.order for each in parts_of_plants)

    def tuned_points(bounds: Constraints) -> dict[tuple[float, ...], Tuned]:
        """Return the tuning of each point by itself."""
        own = {}
        for i, at in enumerate(grid):
            report(f"at {_place(at)}", i / parts)
            of_file = {"setup": setup, "rest": rest} if at == middle else {}
            own[at] = tune(plant_at(at), dt, **{**how, "constraints": bounds}, **of_file)
        return own

    def made(bounds: Constraints, own: Mapping[tuple[float, ...], Tuned]) -> _Made:
        """Return a controller with a schedule, and what it was tuned by."""
        joint = None
        found: dict[str, Any] = {}
        if tables == "b0":
            report("for all points", len(grid) / parts)
            b = np.array([each.b for each in given])
            # The least b: bounds on u, as M_ks, are those of the point with the largest gains.
            base = b[int(np.argmin(np.abs(b)))]
            same = [_scaled(each, base / own_b) for each, own_b in zip(given, b, strict=True)]
            delays = [float(each.delays[0]) for each in given]
            for_all = {**how, **joint_only, "delay": delays, "constraints": bounds}
            joint = tune(same, dt, **for_all)
            tuned: Any = joint.design.controller
            found["b0"] = tuned.observer.b0 * b / base
        else:
            at_points: list[Any] = [each.design.controller for each in own.values()]
            tuned = at_points[0]
            found["b0"] = np.array([each.observer.b0 for each in at_points])
            found["omega_c"] = np.array([each.omega_c for each in at_points])
            found["omega_o"] = np.array([each.observer.omega_o for each in at_points])
            # What is the same at all points, as omega_o at the limit of the sample time, is no
            # table.
            found = {
                name: values
                for name, values in found.items()
                if name == "b0" or np.ptp(values) > _SAME * np.max(values)
            }
        lists = {name: value.reshape(shape).tolist() for name, value in found.items()}
        schedule = Schedule(given_points, signal, **lists)
        b0 = float(found["b0"][len(grid) // 2])
        observer = with_gains(tuned.observer, b0, tuned.observer.omega_o)
        half = {"half_gain": tuned.half_gain, "feedforward": forward}
        controller = ADRC(observer, tuned.omega_c, schedule=schedule, **half, **limits)
        return _Made(controller, own, joint)

    first = made(bounds, tuned_points(bounds))
    linear = dict(zip(grid, parts_of_plants, strict=True))
    waiting = {at: float(each.delays[0]) for at, each in zip(grid, given, strict=True)}

    def frozen(of: _Made, at: tuple[float, ...]) -> LoopAnalysis:
        return analyse_axis(plant_at(at), of.controller.at(*at), **late)

    def gentler() -> Iterator[_Made]:
        """Yield controllers with tighter bounds of noise in u that are not much worse."""
        now = (first.joint or first.own[middle]).constraints
        name = "u_std" if now.u_std is not None else "m_ks"
        usual = [load_iae(frozen(first, at)) for at in grid]
        for share in _GENTLER if getattr(now, name) is not None else ():
            tight = replace(now, **{name: share * getattr(now, name)})
            own = first.own if tables == "b0" else tuned_points(tight)
            other = made(tight, own)
            worse = [load_iae(frozen(other, at)) for at in grid]
            if max(a / b for a, b in zip(worse, usual, strict=True)) > acceptance.WORSE:
                return
            yield other

    judged, told, ends = None, list[str](), range_of_u(limits)
    # The objects of a setup that has a scenario have to be given.
    known = isinstance(written, Written) or setup is None or "scenario" not in setup
    if written is not False and known and any(map(math.isfinite, ends)):
        plant_of_file = scenario = None
        if isinstance(written, Written):
            plant_of_file, scenario = written.plant, written.scenario
        if plant_of_file is None:
            plant_of_file = late_plant(linear[middle], actuator_lag, waiting[middle], dt)
        if scenario is None:
            scenario = scenario_of(first.own[middle].setup["scenario"])
        file = Written(plant_of_file, scenario, dt)
        external = [v for name, v in zip(signals, middle, strict=True) if name == "external"]
        if external and not file.scenario.schedule:
            file = replace(file, scenario=replace(file.scenario, schedule=tuple(external)))
        spread = np.linspace(0, len(grid) - 1, min(_MOST_POINTS, len(grid)))
        members = [grid[i] for i in np.unique(np.round(spread).astype(int))]
        others = [
            acceptance.place_of(
                file, linear[at], (actuator_lag, waiting[at]), f"at {_place(at)}", at
            )
            for at in members
        ]
        file = replace(file, others=tuple(others), of_others="points of the schedule, linear")
        task = first.own[middle].task
        assert task is not None
        shaped = task.objective != "tracking" and not file.moves
        point = checked_rest(rest) or rest_of_plant(plant_at(middle), dt)
        if setup is None or "scenario" not in setup:
            point = rest_within(linear[middle], point, ends)
        at_rest = 0.0 if point is None else point.u
        loop = acceptance.Loop(file, linear[middle], task.model, task.plants, ends, at_rest, shaped)

        def seen(each: _Made) -> acceptance.Judged:
            return acceptance.judge(loop, each.controller, frozen(each, middle))

        report("limits of u", len(grid) / parts)
        first, judged, refused = acceptance.accepted(first, gentler(), seen, "the first controller")
        told += [refused] if refused else []
    loops = [frozen(first, at) for at in grid]
    told += acceptance.conditionally_stable(each.margins.gain for each in loops if each.stable)
    found = {}
    for i, at in enumerate(sorted([*grid, *fine])):
        share = i / (len(grid) + len(fine))
        report(f"judging at {_place(at)}", (len(grid) + 1 + share * len(fine)) / parts)
        alone = first.own[at] if at in first.own else tune(plant_at(at), dt, **how)
        name = f"{'at' if at in first.own else 'between, at'} {_place(at)}"
        found[at] = _design(name, plant_at(at), first.controller.at(*at), alone, late)
    tuned, of_file = first.joint or first.own[middle], first.own[middle]
    schedule, observer = first.controller.schedule, first.controller.observer
    assert schedule is not None
    table = {name: value for name, value in _table(schedule).items() if value is not None}
    law: dict[str, Any] = {"omega_c": first.controller.omega_c}
    law |= {"feedforward": True} if first.controller.feedforward else {}
    law["schedule"] = table
    given_gains = {"b0": observer.b0, "omega_o": observer.omega_o}
    design = replace(
        tuned.design,
        name=f"{tuned.design.name} with a schedule",
        controller=first.controller,
        values={"omega_c": first.controller.omega_c, "omega_o": observer.omega_o},
        active=(),
        tables={
            "observer": {**tuned.design.tables["observer"], **given_gains},
            "controller": {**tuned.design.tables["controller"], **law},
        },
        solution=None,
    )
    file_tables = dict(of_file.setup)
    if schedule.external and "schedule" not in file_tables["scenario"]:
        fixed = zip(schedule.signals, middle, strict=True)
        of_signals = {"schedule": [value for name, value in fixed if name == "external"]}
        file_tables["scenario"] = {**file_tables["scenario"], **of_signals}
    knows = is_function and between > 0
    m_s = tuned.constraints.m_s
    return Tuned(
        axes=(design,),
        designs={each.name: each for each in found.values()},
        analysis=frozen(first, middle),
        constraints=tuned.constraints,
        objective=tuned.objective,
        setup=file_tables,
        noise_bound=tuned.noise_bound,
        signals=of_file.signals,
        judged_at_limits=judged,
        told=tuple(told),
        alone=first.own,
        details=AtPoints(schedule, found, first.own, first.joint, knows, m_s),
    )


class _Made(NamedTuple):
    """A controller with a schedule, and what it was tuned by."""

    controller: ADRC
    own: Mapping[tuple[float, ...], Tuned]
    joint: Tuned | None


def _points(
    plant: Any, points: Any
) -> tuple[list[list[float]], Callable[[tuple[float, ...]], Any], bool]:
    """Return the axes, the plant at signals, and whether it is a function."""
    if isinstance(plant, Mapping):
        if points is not None:
            raise ValueError("points: the plants have them, as keys; leave it out")
        known = {(key if isinstance(key, tuple) else (key,)): value for key, value in plant.items()}
        keys = [tuple(checks.finite("key of plant", each) for each in key) for key in known]
        if not keys or {len(key) for key in keys} not in ({1}, {2}):
            raise ValueError("plant = {...}: keys must be numbers, or pairs of two numbers")
        axes = [sorted(set(column)) for column in zip(*keys, strict=True)]
        if len(keys) != math.prod(map(len, axes)):
            raise ValueError("plant = {...}: needs one for each pair of points, a full grid")
        return axes, lambda at: known[at], False
    if not callable(plant):
        raise ValueError(
            f"plant = {plant!r}: must be a function of the signal that returns a plant, or a "
            "mapping from points to plants"
        )
    if points is None:
        raise ValueError("points = None: a plant that is a function needs the points of the tables")
    lists = points if np.ndim(points[0]) else [points]
    axes = [checks.vector("points", each).tolist() for each in lists]
    return axes, lambda at: plant(*at), True


def _scaled(given: Given, factor: float) -> LinearPlant:
    """Return a plant, without its delay, with another gain from u, and from a load beside it."""
    linear = LinearPlant.of(given.linear[0])
    return LinearPlant(linear.A, factor * linear.B, linear.C, factor * linear.E)


def _finer(axis: list[float], between: int) -> list[float]:
    """Return the points of an axis with ``between`` values in each cell."""
    inner = [np.linspace(*cell, between + 2)[:-1].tolist() for cell in pairwise(axis)]
    return [value for cell in inner for value in cell] + [axis[-1]]


def _design(
    name: str, plant: Any, controller: ADRC, alone: Tuned, late: Mapping[str, Any]
) -> Design:
    """Return the loop of a plant with the controller at fixed signals, beside its own tuning."""
    with one_blas_thread():
        loop, own = (analyse_axis(plant, each, **late) for each in (controller, alone.controller))
        m_t = loop.response("T", loop.omega) if loop.stable else np.array([math.inf])
        measures = {
            "M_s": 1.0 / loop.margins.modulus if loop.stable else math.inf,
            "M_t": float(np.max(np.abs(m_t))),
            "iae": load_iae(loop),
            "alone": load_iae(own),
            "b0": controller.observer.b0,
        }
    objective, nan = alone.objective, math.nan
    size = measures["iae"] if objective == "load-iae" else nan
    return Design(name, controller, {}, size, nan, measures, (), {})


def load_iae(loop: LoopAnalysis) -> float:
    """Return the integral of ``|y|`` after a unit step of the load at the plant's input."""
    if not loop.stable:
        return math.inf
    return area_until_rest(loop.closed_loop("d", "y")) * float(loop.dt)
