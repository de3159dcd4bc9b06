"""The operating point and the scenario of a setup file that a tuning writes, as tables.

The scenario is a step of the reference, a load, and where each is judged. Both are of a size that u
can hold within its limits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.plants.base import Plant, measure
from quell.plants.linear import DelayedPlant, EncodedPlant, LinearPlant, delayed, lagged
from quell.plants.linearise import operating_point_of
from quell.plants.nonlinear import NonlinearPlant, checked_point
from quell.signals import Signal, Step, as_signal
from quell.simulation import Scenario
from quell.types import Vector

# ---- The operating point ----

# A step and a load take at most this share each of what u has left at rest, as both act in the end.
SHARE = 0.4
# A solution of A x + B u = −E w, C x = r within this share of its right side is one.
_SOLVED = 1e-6
# Smaller parts of a solution are rounding.
_ROUNDING = 1e-12
# Names of the times at which signals begin, in their tables.
_BEGINS = ("at", "start")


Limits = tuple[float, float]
"""u_min and u_max of the controller [u-unit], infinite where it has none."""


class Rest(NamedTuple):
    """An operating point: what holds the plant at rest there."""

    u: float  # [u-unit]
    y: float  # [y-unit]
    x0: tuple[float, ...] = ()  # state of the plant in the setup file; empty if it is not known
    w: tuple[float, ...] = ()  # its disturbances


def checked_rest(rest: Any) -> Rest | None:
    """Return the argument ``rest`` of ``tune``: None, (u, y) or a ``Rest``."""
    if rest is None or isinstance(rest, Rest):
        return rest
    u, y = checks.vector("rest", rest, 2).tolist()
    return Rest(u, y)


def rest_of_plant(plant: Any, dt: float, operating_point: Any = None) -> Rest | None:
    """Return the operating point of a nonlinear plant, as ``linear_part`` takes it; else None."""
    delayed: list[DelayedPlant] = []
    while isinstance(plant, DelayedPlant | EncodedPlant):
        delayed += [plant] if isinstance(plant, DelayedPlant) else []
        plant = plant.plant
    if operating_point is not None and hasattr(plant, "sampled"):
        x, u = checked_point(operating_point)
    elif isinstance(plant, NonlinearPlant):
        x, u = operating_point_of(plant)
    else:
        return None
    state = np.asarray(x, dtype=np.float64)
    y = float(measure(plant.sampled(dt, interpret=True), state))
    waiting = sum(each.order - each.plant.order for each in delayed)
    return Rest(float(u), y, (*state.tolist(), *[float(u)] * waiting), (0.0,) * plant.disturbances)


def rest_of_linear(linear: LinearPlant, rest: Rest) -> Rest:
    """Return state and disturbances that hold a linear plant at rest at (u, y).

    They solve ``A x + B u + E w = 0``, ``C x = y``, with the smallest ones if there are several.
    """
    n, m = linear.order, linear.disturbances
    matrix = np.block([[linear.A, linear.E], [linear.C, np.zeros((1, m))]])
    right = np.append(-linear.B[:, 0] * rest.u, rest.y)
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    found[np.abs(found) < _ROUNDING * np.max(np.abs(found), initial=0.0)] = 0.0
    return rest._replace(x0=tuple(found[:n].tolist()), w=tuple(found[n:].tolist()))


def rest_within(linear: LinearPlant, rest: Rest | None, limits: Limits) -> Rest | None:
    """Return an operating point within the limits of u: the given one, else zero or their middle.

    Raises ``ValueError`` for limits within which there is no such point.
    """
    low, high = limits
    at = 0.0 if rest is None else rest.u
    if low <= at <= high:
        return rest
    within = f"must lie within u_min = {low:g} and u_max = {high:g}"
    if rest is not None:
        raise ValueError(f"u at rest = {at:g}: {within}; no controller can hold the plant there")
    middle = 0.5 * (low + high)
    if not np.isfinite(middle) or np.linalg.matrix_rank(linear.A) < linear.order:
        raise ValueError(
            f"u at rest = 0: {within}; give u and y at rest: rest = (u, y), or --u-rest and "
            "--y-rest"
        )
    y = -float((linear.C @ np.linalg.solve(linear.A, linear.B))[0, 0]) * middle
    return Rest(middle, y)


def held_by(linear: LinearPlant, right: Vector) -> float:
    """Return u of a plant at rest, with ``A x + B u`` and ``C x`` as ``right`` (n + 1,) has them.

    Zero where there is none, as for a step of an axis.
    """
    matrix = np.block([[linear.A, linear.B], [linear.C, np.zeros((1, 1))]])
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    solved = np.linalg.norm(matrix @ found - right) <= _SOLVED * np.linalg.norm(right)
    return float(found[-1]) if solved else 0.0


def held_step(linear: LinearPlant) -> float:
    """Return the u that holds y at 1; zero for an axis, which needs none [u-unit/y-unit]."""
    return held_by(linear, np.append(np.zeros(linear.order), 1.0))


def held_load(linear: LinearPlant) -> float:
    """Return the u that holds y at zero under a first disturbance of 1; zero where none does."""
    if linear.disturbances == 0:
        return 0.0
    return held_by(linear, np.append(-linear.E[:, 0], 0.0))


def held_state(linear: LinearPlant, y: float, w: Sequence[float]) -> tuple[list[float], float]:
    """Return state and u at which a plant rests at ``y`` under its first disturbances ``w``.

    For a plant that rests nowhere there it is the nearest solution.
    """
    constant = np.zeros(linear.disturbances)
    constant[: len(w)] = w[: linear.disturbances]
    matrix = np.block([[linear.A, linear.B], [linear.C, np.zeros((1, 1))]])
    found = np.linalg.lstsq(matrix, np.append(-linear.E @ constant, y), rcond=None)[0]
    return found[:-1].tolist(), float(found[-1])


def held_sizes(
    linear: LinearPlant, rest: Rest | None, limits: Limits, of_axis: float
) -> tuple[float, float]:
    """Return the sizes of a step of r [y-unit] and of the first load that u can hold, of 1 at most.

    At rest each needs 40 % of what the limits leave. A step that needs no u at rest, as that of an
    axis, uses 40 % of it on the way: ``of_axis`` is what a step of 1 needs [u-unit/y-unit]. A size
    is negative where u has more room on the other side, as that of a load on a heater at zero.
    """
    at = 0.0 if rest is None else rest.u
    low, high = limits
    sizes: list[float] = []
    for u in (held_step(linear), held_load(linear)):
        # How large a positive and a negative one may be.
        ends = (high - at, low - at) if u > 0.0 else (low - at, high - at)
        most = [1.0 if u == 0.0 else min(1.0, abs(SHARE * end / u)) for end in ends]
        size = most[0] if most[0] >= most[1] else -most[1]
        if not sizes and u == 0.0 and of_axis > 0.0:
            size = min(1.0, SHARE * min(high - at, at - low) / of_axis)
        sizes.append(float(f"{size:.2g}"))
    return sizes[0], sizes[1] if linear.disturbances else sizes[0]


# ---- Tables of plant and scenario, and their objects ----


def scenario_tables(
    last: float, disturbances: int, rest: Rest | None, sizes: tuple[float, float] = (1.0, 1.0)
) -> dict[str, Any]:
    """Return ``scenario`` and ``metrics``: a step, and later a load if there is an input for it.

    ``sizes`` are those of the step and the load.
    A loop at an operating point has half of ``last`` [s] to come to rest: the controller starts
    from u = 0.
    """
    half, step = 0.5 * last, {"kind": "step"}
    if rest is None:
        at, constant, y = 0.0, [0.0] * disturbances, 0.0
    else:
        at, y = half, rest.y
        constant = [*rest.w, *[0.0] * (disturbances - len(rest.w))]
    at, load_at, end = (float(f"{time:.6g}") for time in (at, at + half, at + last))
    begins: Mapping[str, Any] = {"at": at} if at else {}
    reference: Any = {**step, **begins, **_size(sizes[0])}
    scenario: dict[str, Any] = {"duration": end, "reference": [y, reference] if y else reference}
    if rest is not None and rest.x0:
        scenario["x0"] = list(rest.x0)
    if disturbances:
        load: Any = {**step, "at": load_at, **_size(sizes[1])}
        first = [constant[0], load] if constant[0] else load
        scenario["disturbances"] = [first, *constant[1:]]
    return {"scenario": scenario, "metrics": _windows([at, load_at] if disturbances else [at])}


def _size(size: float) -> dict[str, float]:
    return {} if size == 1.0 else {"height": size}


def windows_of(scenario: Mapping[str, Any]) -> list[dict[str, float]]:
    """Return windows of a scenario's table, from one beginning of a signal to the next."""
    times = {0.0}
    signals = [scenario.get("reference"), *scenario.get("disturbances", ())]
    for signal in signals:
        parts = signal if isinstance(signal, list | tuple) else [signal]
        for part in parts:
            known = part if isinstance(part, Mapping) else {}
            begins = (known.get(name) for name in _BEGINS)
            times |= {float(time) for time in begins if isinstance(time, float | int)}
    end = float(scenario.get("duration", np.inf))
    return _windows(sorted(time for time in times if 0.0 <= time < end))


def _windows(times: list[float]) -> list[dict[str, float]]:
    ends = [{"stop": later} for later in times[1:]]
    return [{"start": at, **end} for at, end in zip(times, [*ends, {}], strict=True)]


def late_tables(
    tables: Mapping[str, Any], plant: Plant, dt: float, delay: float = 0.0, lag: float = 0.0
) -> dict[str, Any]:
    """Return the tables of a setup whose plant is behind a lag of its actuator and a delay [s].

    ``plant`` is the one of the tables. Names, ranges, paths of a sweep and operating points stay
    those of the plant inside; a start gets zeros for the further states. Raises ``ValueError`` for
    a delay that the plant can't have.
    """
    found = dict(tables)
    if lag > 0.0:
        inner: Any = plant
        while isinstance(inner, DelayedPlant | EncodedPlant):
            inner = inner.plant
        found = _outside(found, {"kind": "lagged", "lag": lag}, inner.order, 1)
        plant = lagged(plant, lag)
    if delay > 0.0:
        more = delayed(plant, delay, dt).order - plant.order
        found = _outside(found, {"kind": "delayed", "delay": delay}, plant.order, more)
    return found


def _outside(
    tables: Mapping[str, Any], outer: dict[str, Any], at: int, more: int
) -> dict[str, Any]:
    """Return the tables with a plant around theirs that has ``more`` states, at place ``at``."""
    plant = tables["plant"]
    inner: dict[str, Any] = {"kind": plant} if isinstance(plant, str) else dict(plant)
    outer = dict(outer)
    if "signals" in inner:
        outer["signals"] = inner.pop("signals")
    if "uncertain" in inner:
        outer["uncertain"] = {f"plant.{key}": ends for key, ends in inner.pop("uncertain").items()}
    found = {**tables, "plant": outer | {"plant": inner}}
    scenario, sweep = tables.get("scenario"), tables.get("sweep")
    if isinstance(scenario, Mapping) and "x0" in scenario:
        x0 = [*scenario["x0"]]
        found["scenario"] = {**scenario, "x0": [*x0[:at], *[0.0] * more, *x0[at:]]}
    if isinstance(sweep, Mapping) and isinstance(sweep.get("parameters"), Mapping):
        moved = {
            f"plant.{key}" if key.startswith("plant.") else key: value
            for key, value in sweep["parameters"].items()
        }
        found["sweep"] = {**sweep, "parameters": moved}
    tune = tables.get("tune")
    if isinstance(tune, Mapping) and isinstance(tune.get("schedule"), Mapping):
        found["tune"] = {**tune, "schedule": _inside(tune["schedule"])}
    return found


def _inside(schedule: Mapping[str, Any]) -> dict[str, Any]:
    """Return the operating points of a plant for one that contains it as ``plant``."""
    if "parameter" in schedule:
        names = schedule["parameter"]
        moved = [f"plant.{each}" for each in ([names] if isinstance(names, str) else names)]
        return {**schedule, "parameter": moved[0] if isinstance(names, str) else moved}
    points = [{**each, "plant": {"plant": each["plant"]}} for each in schedule["points"]]
    return {**schedule, "points": points}


def plant_table(
    linear: LinearPlant, actuator_lag: float, delay: float, dt: float
) -> tuple[dict[str, Any], int]:
    """Return the table of a linear plant behind a lag and a delay [s] of u, sampled at ``dt`` [s].

    Beside it, how many states lag and delay append, which are u at rest.
    """
    table: dict[str, Any] = {
        "kind": "linear",
        "A": linear.A.tolist(),
        "B": linear.B[:, 0].tolist(),
        "C": linear.C[0].tolist(),
        "E": linear.E.tolist(),
    }
    plant, order = late_plant(linear, actuator_lag, delay, dt), linear.order
    found = late_tables({"plant": table}, linear, dt, delay, actuator_lag)
    return found["plant"], plant.order - order


def late_plant(plant: Plant, actuator_lag: float, delay: float, dt: float) -> Plant:
    """Return a plant behind a lag and a delay [s] of u, if there are any."""
    plant = lagged(plant, actuator_lag) if actuator_lag > 0.0 else plant
    return delayed(plant, delay, dt) if delay > 0.0 else plant


def scenario_of(table: Mapping[str, Any]) -> Scenario:
    """Return the scenario of a table that ``scenario_tables`` made."""

    def signal(part: Any) -> Signal:
        if isinstance(part, list):
            first, second = map(signal, part)
            return first + second
        if isinstance(part, Mapping):
            return Step(**{key: value for key, value in part.items() if key != "kind"})
        return as_signal(part)

    loads = tuple(map(signal, table.get("disturbances", ())))
    return Scenario(signal(table["reference"]), table["duration"], loads, x0=table.get("x0"))
