"""Tuning of a compensator on top of a controller that stays as it is.

A compensator changes the loop, so it is tuned as a controller is: M_s, M_t and M_ks of the whole
loop, with the controller in it, are bounded, and of all observers within the bounds the
one is taken that leaves the least ``∫|y|`` after a step of the load at the plant's input. The
bounds hold, 1.5 times as wide, where all poles and zeros of the plant are slower or faster, too.

Two families of observers are tried: model-free ones of the orders up to the plant's relative
degree, whose b0 is a factor times the plant's gain (a larger b0 compensates less, and costs less
margin where the plant has a resonance or a delay above its bandwidth), and those with a model of
the plant, whole and reduced. Each has its bandwidth ω_o as the second parameter. Both are searched
on a grid of logarithms, then between its points; a loop is sampled exactly, its peaks are those of
``analyse``.

Where u has limits the result runs in the file that is written, as all tuned loops do
(``acceptance.py``); one that fails there gives way to one within the bounds with at most 1.5 times
its integral.

With a load d at the plant's input, the controller C, the plant P and the observer's response Q from
f to f̂, a nominal model gives ``y = P (1 − Q)/(1 + P C) d``: the compensator removes what lies
within the bandwidth of Q, whatever C does.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.analysis.loop import LoopAnalysis, closed_loop, subsystem
from quell.analysis.margins import Response
from quell.controllers.base import Controller, limits_of
from quell.controllers.compensated import Compensated, check_takes_compensator
from quell.controllers.compensator import Compensator
from quell.lti.canonical import Reduced, design_models
from quell.observers.eso import ESO
from quell.plants.linear import LinearPlant
from quell.tuning import acceptance
from quell.tuning.constraints import Constraints, first_given, given_constraints
from quell.tuning.optimiser.loops import PlantSet, area_until_rest, law_of, load_step, response
from quell.tuning.optimiser.requirements import Active
from quell.tuning.plants import Given, given_plants, model_of, plant_set
from quell.tuning.report import ACTIVE, Design
from quell.tuning.structures.adrc import matrices
from quell.tuning.tables import late_plant
from quell.tuning.tuned import Tuned
from quell.tuning.written import Written
from quell.types import DesignWarning, Vector

# Default bounds of the whole loop: a tuned controller has M_s = 1.6 itself, and what the
# compensator adds needs some of the margin. M_ks may be so many times that of the controller.
_PEAKS, _NOISE = 2.0, 3.0
# Points of the grids: bandwidths of the observer from a tenth of the loop's to the limit of
# sampling, and factors of the plant's gain.
_BANDWIDTHS, _FACTORS = 14, (0.7, 1.0, 1.4, 2.0, 3.0, 5.0)
# Steps of the search between points of the grid, each half as wide as the one before.
_HALVINGS = 5
# What the peaks may be, over their bounds, where all poles and zeros of the plant are elsewhere.
_ELSEWHERE = 1.5
# Less than this share of the load's effect is not worth a second observer.
_WORTH = 0.05
# Candidates that may take the place of one that fails at the limits of u, at most.
_MOST_OTHERS = 6


class Measures(NamedTuple):
    """Figures of a loop: peaks of its sensitivities and the effect of a load."""

    m_s: float  #: largest ``|S|``
    m_t: float  #: largest ``|T|``
    m_ks: float  #: largest ``|K S|`` [u-unit/y-unit]
    iae: float
    """``∫|y|`` after a unit step of the load [y-unit s/u-unit]; infinite if y stays off."""
    m_s_elsewhere: float  #: largest ``|S|`` with the poles and zeros of ``speeds``


class _Candidate(NamedTuple):
    observer: ESO
    name: str
    table: dict[str, Any]  # [observer] of a setup file
    measures: Measures

    @property
    def omega_o(self) -> str:
        """Its bandwidth as text."""
        return f"omega_o = {self.observer.omega_o:.4g} rad/s"


@dataclass(frozen=True, eq=False)
class OnTop:
    """A compensator beside its controller alone, as the ``details`` of a ``Tuned``."""

    name: str  #: form of the observer
    before: Measures  #: of the controller alone
    after: Measures  #: with the compensator
    loads: tuple[Vector, Vector]  #: y after the step of the load, before and after [y-unit]
    loads_dt: float  #: time from one y of the loads to the next: ``dt``, or more of slow loops [s]
    plants: int
    active: tuple[Active, ...]  #: the bounds at their limits

    bounded, drawn, met = " of the whole loop", 1, True

    @property
    def worth(self) -> bool:
        """Whether the compensator removes at least a twentieth of the load's effect."""
        return self.after.iae <= (1.0 - _WORTH) * self.before.iae

    def lines(self, tuned: Tuned) -> list[str]:
        """Return what the compensator leaves of a load, and whether it is worth it."""
        left = "a load leaves no constant error, which the controller alone leaves"
        if math.isfinite(self.before.iae):
            left = f"a load leaves {self.after.iae / self.before.iae:.3g} of what it leaves without"
        lines = [f"{self.name} observer: {left}"]
        if not self.worth:
            lines.append(
                "NOT worth a compensator: within the bounds none removes a twentieth of the load's "
                "effect; the controller uses the margin itself: tune it more gently (M_s 1.4), or "
                "allow more with Constraints(m_s=..., m_ks=...)"
            )
        return lines

    def to_json(self) -> dict[str, Any]:
        """Return it as a table."""
        figures = {"before": self.before._asdict(), "after": self.after._asdict()}
        return {"observer": self.name, "worth": self.worth, **figures}

    def plot(self, m_s: float | None, axes: Any = None) -> Any:
        """Draw y after a step of the load, with and without compensator; return the axes."""
        from quell.records.plotting import grid_of_axes, new_figure

        axes = grid_of_axes(axes, lambda: new_figure(6.4, 4.8), 1)[:, 0]
        for y, label in zip(self.loads, ("controller alone", "with compensator"), strict=True):
            size = np.abs(y)
            shown = min(int(np.flatnonzero(size > 0.02 * np.max(size))[-1]) + 2, y.size)
            axes[0].plot(np.arange(shown) * self.loads_dt, y[:shown], label=label)
        axes[0].set(xlabel="t [s]", ylabel="y [y-unit]", title="Step of the load")
        axes[0].legend()
        return axes


def tune_compensator(
    plant: Any,
    controller: Controller,
    *,
    constraints: Constraints | None = None,
    b_range: tuple[float, float] = (1.0, 1.0),
    speeds: tuple[float, float] = (0.88, 1.2),
    delay: float = 0.0,
    actuator_lag: float = 0.0,
    operating_point: Any = None,
    load: float = 1.0,
    file: Callable[[dict[str, Any]], tuple[Controller, Written]] | None = None,
    **options: Any,
) -> Tuned:
    """Return the compensator that rejects loads best on top of a linear controller.

    Parameters
    ----------
    plant
        a plant as ``tune`` takes it, or several: the controller's own. All bounds hold for all of
        them; the first one is the model.
    controller
        a linear controller without observer, which stays as it is: ``quell.baselines.PID``,
        ``PPI``, ``LQG``, ``LinearController.from_transfer_function``.
    constraints
        M_s, M_t, M_ks, delay margin and ``omega_o_dt`` of the whole loop; others do not hold for a
        compensator. By default M_s = M_t = 2 and three times the controller's M_ks.
    b_range
        lowest and highest gain of the plant over that of the model.
    speeds
        lowest and highest factor of the poles and zeros of the first plant, for which 1.5 times
        the bounds hold: an observer with a model of a resonance would else rely on its frequency.
        By default (0.88, 1.2): inertias that are 30 % larger and smaller. (1, 1) for none.
    delay, actuator_lag, operating_point
        as for ``analyse``.
    load
        step of the load at the plant's input [u-unit].
    file
        returns, for a table ``[observer]``, the controller of the setup file that is written and
        its loop, in which both are judged; by default the controller and the linear plant.
    **options
        ``learner``, ``guard``, ``omega_c``, limits and ``safe_set`` of the ``Compensator``.

    Returns
    -------
    Tuned
        ``controller`` is both in one, ``details`` (``OnTop``) has the figures before and after.

    Raises
    ------
    ValueError
        for a controller that is not linear, that does not stabilise the plant or exceeds the
        bounds by itself, for bounds that do not hold for a compensator, and if no compensator keeps
        them.

    Examples
    --------
    >>> import quell as ql
    >>> plant = ([1.0], [1.0, 1.0, 0.0])
    >>> pid = ql.baselines.PID(kp=4.0, ki=1.0, kd=3.0, tf=0.05, dt=0.01)
    >>> tuned = tune_compensator(plant, pid)
    >>> figures = tuned.details
    >>> figures.after.iae < 0.3 * figures.before.iae, figures.after.m_s <= 2.0
    (True, True)
    """
    check_takes_compensator(controller)
    dt = float(controller.dt)
    how: dict[str, Any] = {"delay": delay, "actuator_lag": actuator_lag, "b_range": b_range}
    given = given_plants(plant, dt, operating_point=operating_point, **how)
    count = len(given.linear)
    known = given
    given = _with_speeds(given, speeds)
    plants = _Plants(plant_set(given, dt), count, len(given.linear))
    inputs = load_step(plants.all, checks.nonzero("load", load, "or nothing is rejected"))
    before = _measured(controller, plants)
    if not math.isfinite(before.m_s):
        raise ValueError(
            f"controller = {controller!r}: its loop with the plant is unstable; a compensator "
            "needs one that is stable without it"
        )
    bounds = given_constraints(constraints, Constraints(m_s=_PEAKS, m_t=_PEAKS, damping=None))
    _check_used(bounds)
    if bounds.m_ks is None:
        bounds = replace(bounds, m_ks=_NOISE * before.m_ks)
    model = model_of(given, plants.all, bounds)
    if _excess(before, bounds) > 0.0:
        raise ValueError(
            f"constraints: the controller alone has {before}, and the bounds are {bounds}: a "
            "compensator can not give margin back; raise the bounds or tune the controller gently"
        )
    candidates: list[_Candidate] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DesignWarning)  # of candidates on the way
        for family in _families(model, dt):
            candidates += _searched(family, controller, plants, bounds, model)
    if not candidates:
        raise ValueError(
            "no compensator keeps the bounds with this controller: it uses the margin itself; tune "
            f"it more gently, or raise the bounds ({bounds})"
        )
    candidates.sort(key=lambda each: each.measures.iae)
    best, judged, told = candidates[0], None, list[str]()
    linear = LinearPlant.of(known.linear[0])

    def seen(each: _Candidate) -> acceptance.Judged:
        """Return what a candidate does in the file."""
        both: Controller = Compensated(controller, Compensator(each.observer, **options))
        plain = Compensated(controller, Compensator(each.observer))
        late = actuator_lag, float(known.delays[0])
        if file is None:
            written = acceptance.file_without_step(late_plant(linear, *late, dt), dt)
        else:
            both, written = file(each.table)
        if len(plants.all.plants) > plants.distinct or count > 1:
            parts = [LinearPlant.of(one) for one in known.linear]
            every = [(actuator_lag, float(delay)) for delay in known.delays]
            written = acceptance.with_others(written, parts, every, plant_set(known, dt))
        analysis = LoopAnalysis(plants.all.scaled()[0], law_of(plain), dt)
        return acceptance.judge(
            acceptance.Loop(written, linear, None, plants.all, limits_of(both), 0.0, False),
            both,
            analysis,
        )

    limits = limits_of(Compensated(controller, Compensator(best.observer, **options)))
    if file is not None or any(map(math.isfinite, limits)):
        others = _less_and_less(candidates) if math.isfinite(limits[1] - limits[0]) else []
        best, judged, refused = acceptance.accepted(
            best, others, seen, f"{best.name} with {best.omega_o}"
        )
        told += [refused] if refused else []
    both = Compensated(controller, Compensator(best.observer, **options))
    numbers = {name: value for name, value in options.items() if isinstance(value, int | float)}
    plain = Compensated(controller, Compensator(best.observer))  # without learner
    members = [each for j, each in enumerate(plants.all.scaled()) if not plants.elsewhere(j)]
    loops = [LoopAnalysis(each, law_of(plain), dt) for each in members]
    told += acceptance.conditionally_stable(each.margins.gain for each in loops)
    laws, after = (law_of(controller), law_of(plain)), best.measures
    loads = response(loops[0].plant, laws[0], inputs), response(loops[0].plant, laws[1], inputs)
    alone = _design("controller alone", controller, before)
    design = _design("with compensator", both, after, before)
    design = replace(
        design,
        values={"b0": best.observer.b0, "omega_o": best.observer.omega_o},
        tables={"observer": best.table, "compensator": numbers},
    )
    kinds = ("M_s", "M_t", "M_ks"), after[:3], (bounds.m_s, bounds.m_t, bounds.m_ks)
    at_limits = tuple(
        Active(kind, size, limit, math.nan, 0)
        for kind, size, limit in zip(*kinds, strict=True)
        if limit is not None and size >= (1.0 - ACTIVE) * limit
    )
    apart = dt * inputs.distance
    return Tuned(
        axes=(design,),
        designs={each.name: each for each in (alone, design)},
        analysis=loops[0],
        constraints=bounds,
        objective="load-iae",
        judged_at_limits=judged,
        told=tuple(told),
        details=OnTop(best.name, before, after, loads, apart, len(plants.all.plants), at_limits),
    )


def _design(
    name: str, controller: Any, measures: Measures, alone: Measures | None = None
) -> Design:
    """Return a loop with its figures, beside those of the controller alone."""
    found = {"M_s": measures.m_s, "M_t": measures.m_t, "M_ks": measures.m_ks}
    found |= {"M_s elsewhere": measures.m_s_elsewhere}
    found |= {} if alone is None else {"alone": alone.iae}
    return Design(name, controller, {}, measures.iae, math.nan, found, (), {})


def _less_and_less(candidates: list[_Candidate]) -> list[_Candidate]:
    """Return candidates behind the best one, with integrals up to 1.5 times its own."""
    best = candidates[0].measures.iae
    ends = np.geomspace(1.0, acceptance.WORSE, _MOST_OTHERS + 1)
    found = []
    for low, high in itertools.pairwise(ends.tolist()):
        # The slowest observer of each part: it is the most different one.
        part = [each for each in candidates[1:] if low * best < each.measures.iae <= high * best]
        found += sorted(part, key=lambda each: each.observer.omega_o)[:1]
    return found


# Bounds that the search of an observer does not know.
_NOT_USED = (
    *("u_std", "noise_std", "resolution", "noise_share", "noise_over_pi"),
    *("damping", "u_max", "rate_max"),
)


def _check_used(bounds: Constraints) -> None:
    """Raise a ``ValueError`` for bounds that would not hold; values by default are none."""
    if name := first_given(bounds, _NOT_USED):
        raise ValueError(
            f"constraints.{name} = {getattr(bounds, name)!r}: does not hold for a compensator; "
            "leave it out and bound m_s, m_t, m_ks and delay_margin, or tune the whole controller "
            "with quell.tune"
        )


def _with_speeds(given: Given, speeds: tuple[float, float]) -> Given:
    """Return the plants, and the first one with all poles and zeros at other frequencies."""
    low, high = checks.vector("speeds", speeds, 2).tolist()
    if not 0.0 < low <= 1.0 <= high:
        raise ValueError(f"speeds = {speeds!r}: must be a factor up to 1 and one from 1 on")
    first, more = LinearPlant.of(given.linear[0]), []
    for factor in {low, high} - {1.0}:
        parts = factor * first.A, factor * first.B, first.C
        more.append(LinearPlant(*parts, E=factor * first.E))
    delays = np.append(given.delays, np.full(len(more), given.delays[0]))
    return given._replace(linear=(*given.linear, *more), delays=delays)


class _Plants(NamedTuple):
    """The plants of a set, of which some are the first one at other speeds."""

    all: PlantSet
    given: int  # number of those that were given
    distinct: int  # number of all, without the factors of their gain

    def elsewhere(self, j: int) -> bool:
        """Return whether plant j is the first one at another speed."""
        return j % self.distinct >= self.given


class _Family(NamedTuple):
    """Observers of one form, by ω_o and the factor of the plant's gain."""

    order: int
    model: Reduced | None  # None for model-free ones
    b: float  # gain of the plant
    dt: float
    factors: tuple[float, ...]

    @property
    def name(self) -> str:
        kind = "model-free" if self.model is None else "model-based"
        return f"{kind} (order {self.order})"

    def observer(self, omega_o: float, factor: float) -> ESO:
        """Return an observer."""
        if self.model is None:
            return ESO.model_free(self.order, factor * self.b, omega_o, self.dt)
        return ESO.model_based(self.model.plant, omega_o, self.dt)

    def table(self, observer: ESO) -> dict[str, Any]:
        """Return the table ``[observer]`` of a setup file for one of them."""
        if self.model is None:
            numbers = {"order": observer.order, "b0": observer.b0, "omega_o": observer.omega_o}
            return {"kind": "model-free", **numbers}
        plant = {"kind": "linear", **matrices(self.model)}
        return {"kind": "model-based", "omega_o": observer.omega_o, "plant": plant}


def _families(model: Any, dt: float) -> Iterator[_Family]:
    orders = {model.degree, min(model.degree, 2)} if model.degree > 1 else {1}
    for order in sorted(orders):
        b = model.sign * model.b
        yield _Family(order, None, b, dt, _FACTORS)
    for reduced in design_models(model.plant) if model.plant is not None else ():
        yield _Family(reduced.order, reduced, b, dt, (1.0,))


def _searched(
    family: _Family, controller: Controller, plants: _Plants, bounds: Constraints, model: Any
) -> list[_Candidate]:
    """Return the observers of a family that keep the bounds, of those that the search tried."""
    fastest = bounds.omega_o_dt / plants.all.dt
    grid = np.geomspace(min(0.1 * model.omega, 0.01 * fastest), fastest, _BANDWIDTHS)
    tried: dict[tuple[float, float], tuple[float, _Candidate] | None] = {}

    def at(omega_o: float, factor: float) -> tuple[float, _Candidate] | None:
        key = (omega_o, factor)
        if key not in tried:
            tried[key] = _tried(family, key, controller, plants, bounds)
        return tried[key]

    for omega_o, factor in itertools.product(grid.tolist(), family.factors):
        at(omega_o, factor)
    ratio = float(grid[1] / grid[0])
    for _ in range(_HALVINGS):
        kept = [(found[0], key) for key, found in tried.items() if found is not None]
        if not kept:
            return []
        _, (omega_o, factor) = min(kept)
        ratio = math.sqrt(ratio)
        for other in (omega_o / ratio, min(omega_o * ratio, fastest)):
            at(other, factor)
        if len(family.factors) > 1:
            for other in (factor / math.sqrt(ratio), factor * math.sqrt(ratio)):
                at(omega_o, other)
    return [found[1] for found in tried.values() if found is not None]


def _tried(
    family: _Family,
    key: tuple[float, float],
    controller: Controller,
    plants: _Plants,
    bounds: Constraints,
) -> tuple[float, _Candidate] | None:
    """Return the cost of a candidate and itself; None if it breaks a bound."""
    try:
        observer = family.observer(*key)
        both = Compensated(controller, Compensator(observer))
    except ValueError:  # this plant has no such observer
        return None
    measures = _measured(both, plants, bounds)
    if _excess(measures, bounds) > 0.0:
        return None
    return measures.iae, _Candidate(observer, family.name, family.table(observer), measures)


def _measured(
    controller: Controller, plants: _Plants, bounds: Constraints | None = None
) -> Measures:
    """Return the largest figures over all plants; infinite for an unstable loop."""
    law, of = law_of(controller), plants.all
    worst, unstable = Measures(0.0, 0.0, 0.0, 0.0, 0.0), Measures(*5 * [math.inf])
    C = Response(subsystem(of.plants[0], law, "C_y"))(of.omega, of.dt)
    for j, (plant, P) in enumerate(zip(of.scaled(), of.P, strict=True)):
        loop = LoopAnalysis(plant, law, of.dt)
        if not loop.stable:
            return unstable
        S = 1.0 / (1.0 + P * C)
        m_s, m_t, m_ks = (float(np.max(np.abs(each))) for each in (S, P * C * S, C * S))
        if plants.elsewhere(j):
            share = 1.0 / _ELSEWHERE
            found = Measures(0.0, share * m_t, share * m_ks, 0.0, m_s)
        else:
            found = Measures(m_s, m_t, m_ks, 0.0, 0.0)
            least = None if bounds is None else bounds.delay_margin
            if least is not None and loop.margins.delay < least:
                return unstable
        worst = Measures(*map(max, worst, found))
    if bounds is None or _excess(worst, bounds) <= 0.0:  # responses over time are slow
        known = [plant for j, plant in enumerate(of.scaled()) if not plants.elsewhere(j)]
        # Until y is at rest: the loop of a gentle controller is far slower than its plant.
        iae = max(area_until_rest(closed_loop(plant, law, "d", "y")) * of.dt for plant in known)
        worst = worst._replace(iae=iae)
    return worst


def _excess(measures: Measures, bounds: Constraints) -> float:
    """Return by how much the worst bound is exceeded, as a share."""
    limits = (bounds.m_s, bounds.m_t, bounds.m_ks)
    largest = max(measures.m_s, measures.m_s_elsewhere / _ELSEWHERE)
    sizes = (largest, measures.m_t, measures.m_ks)
    known = [size / limit - 1.0 for size, limit in zip(sizes, limits, strict=True) if limit]
    return max(known) - 1e-9
