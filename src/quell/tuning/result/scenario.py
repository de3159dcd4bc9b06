"""The scenario of a tuned setup file: a step of the reference, a load, and where each is judged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.plants.base import measure
from quell.plants.delay import DelayedPlant
from quell.plants.encoder import EncodedPlant
from quell.plants.linear import LinearPlant
from quell.plants.linear_part import operating_point_of
from quell.plants.nonlinear.plant import NonlinearPlant, checked_point

# A step and a load take at most this share each of what u has left at rest, as both act in the end.
_SHARE = 0.4
# A solution of A x + B u = −E w, C x = r within this share of its right side is one.
_SOLVED = 1e-6
# Smaller parts of a solution are rounding.
_ROUNDING = 1e-12
# Names of the times at which signals begin, in their tables.
_TIMES = ("at", "start")


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


def held_sizes(
    linear: LinearPlant, rest: Rest | None, limits: Limits, peak: float
) -> tuple[float, float]:
    """Return the sizes of a step of r [y-unit] and of the first load that u can hold, of 1 at most.

    At rest the step needs u with ``A x + B u = 0``, ``C x = 1``, the load ``A x + B u = −E``,
    ``C x = 0``; each gets 40 % of what the limits leave. A step that needs no u at rest, as that of
    an axis, keeps the largest ``|u|`` on the way within the limits, which is ``peak`` after a step
    of 1 without limits [u-unit/y-unit]. A size is negative where u has more room on the other side,
    as that of a load on a heater at zero.
    """
    at = 0.0 if rest is None else rest.u
    low, high = limits
    n = linear.order
    matrix = np.block([[linear.A, linear.B], [linear.C, np.zeros((1, 1))]])
    rights = [np.append(np.zeros(n), 1.0)]
    rights += [np.append(-linear.E[:, 0], 0.0)] if linear.disturbances else []
    sizes: list[float] = []
    for right in rights:
        found = np.linalg.lstsq(matrix, right, rcond=None)[0]
        solved = np.linalg.norm(matrix @ found - right) <= _SOLVED * np.linalg.norm(right)
        u = float(found[-1]) if solved else 0.0
        # How large a positive and a negative one may be.
        ends = (high - at, low - at) if u > 0.0 else (low - at, high - at)
        most = [1.0 if u == 0.0 else min(1.0, abs(_SHARE * end / u)) for end in ends]
        size = most[0] if most[0] >= most[1] else -most[1]
        if not sizes and u == 0.0 and peak > 0.0:
            size = min(1.0, min(high - at, at - low) / peak)
        sizes.append(float(f"{size:.2g}"))
    return sizes[0], sizes[-1]


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
            begins = (known.get(name) for name in _TIMES)
            times |= {float(time) for time in begins if isinstance(time, float | int)}
    end = float(scenario.get("duration", np.inf))
    return _windows(sorted(time for time in times if 0.0 <= time < end))


def _windows(times: list[float]) -> list[dict[str, float]]:
    ends = [{"stop": later} for later in times[1:]]
    return [{"start": at, **end} for at, end in zip(times, [*ends, {}], strict=True)]


def late_tables(tables: Mapping[str, Any], delay: float, samples: int) -> dict[str, Any]:
    """Return the tables of a setup whose plant is behind a further delay [s] of so many states.

    Names, ranges and paths of a sweep stay those of the plant inside.
    """
    plant = tables["plant"]
    inner: dict[str, Any] = {"kind": plant} if isinstance(plant, str) else dict(plant)
    outer: dict[str, Any] = {"kind": "delayed", "delay": delay}
    if "signals" in inner:
        outer["signals"] = inner.pop("signals")
    if "uncertain" in inner:
        outer["uncertain"] = {f"plant.{key}": ends for key, ends in inner.pop("uncertain").items()}
    found = {**tables, "plant": outer | {"plant": inner}}
    scenario, sweep = tables.get("scenario"), tables.get("sweep")
    if isinstance(scenario, Mapping) and "x0" in scenario:
        found["scenario"] = {**scenario, "x0": [*scenario["x0"], *[0.0] * samples]}
    if isinstance(sweep, Mapping) and isinstance(sweep.get("parameters"), Mapping):
        moved = {
            f"plant.{key}" if key.startswith("plant.") else key: value
            for key, value in sweep["parameters"].items()
        }
        found["sweep"] = {**sweep, "parameters": moved}
    return found
