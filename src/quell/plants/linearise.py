"""The linear plant behind delays and encoders, for the analysis of loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from quell import checks
from quell.lti.models import is_linear_model
from quell.plants.base import as_input, check_one_input, labelled, signals_of
from quell.plants.channels import DelayedInputs, EncodedOutputs
from quell.plants.flexible import CubicSpringPlant
from quell.plants.friction import FrictionPlant
from quell.plants.linear import DelayedPlant, EncodedPlant, LaggedPlant, LinearPlant, lagged
from quell.plants.nonlinear import NonlinearPlant, checked_point, value_or_nan
from quell.types import Matrix, Vector

# Step of the central differences, absolute for values below 1, else relative. Its error is 1e-10 by
# rounding and 1e-12 f'''/6 by truncation, which is 3e-7 of f' even for friction tanh(v/0.001).
_STEP = 1e-6
# Slopes of four steps in a row that differ from a line by more than this share belong to a function
# with a jump or a corner. Chosen by hand; those of smooth functions are a line to 1e-5.
_SMOOTH, _PLACES = 1e-2, np.array([-1.5, -0.5, 0.5, 1.5])

# A slope that varies by less than this share of the largest slope of its value may be rounding.
_HIDDEN = 1e-7
# Rates that are left at a state that counts as held at rest, in units of those without u.
_AT_REST = 1e-6


def linearised(plant: Any, x: Any, u: Any = 0.0, *, w: Any = None, t: float = 0.0) -> Any:
    """Return a plant linearised about a state and a control signal.

    Its states and signals are the differences from those of the operating point. The result
    describes small motions, also when the point is not a state of rest.

    Parameters
    ----------
    plant
        a ``NonlinearPlant``, whose derivatives are found by central differences with steps of 1e-6
        (choose units in which states are of order one); a plant
        with a cubic spring; an encoded plant, whose encoders are left out; a linear plant, which is
        returned as it is.
    x
        state (n,).
    u
        control signal [u-unit]; of a plant with several, all of them (m,), or one for all.
    w
        disturbances (m,); zero by default.
    t
        time [s], for an equation that depends on it.

    Returns
    -------
    LinearPlant

    Raises
    ------
    ValueError
        for another plant, a state of unsuitable length, and a plant that has no derivative there
        (dry friction at standstill, a stop, a dead zone's edge).

    Examples
    --------
    >>> import math
    >>> pendulum = NonlinearPlant(lambda t, x, u, w: (x[1], u - 9.81 * math.sin(x[0])), order=2)
    >>> linearised(pendulum, x=[math.pi, 0.0]).A.round(6).tolist()
    [[0.0, 1.0], [9.81, 0.0]]
    """
    while isinstance(plant, EncodedPlant | EncodedOutputs):
        plant = plant.plant
    if isinstance(plant, LinearPlant):
        return plant
    if isinstance(plant, CubicSpringPlant):
        return _with_spring_of(plant, checks.vector("x", x, plant.order))
    if isinstance(plant, NonlinearPlant):
        state = checks.vector("x", x, plant.order)
        loads = np.zeros(plant.disturbances) if w is None else w
        loads = checks.vector("w", loads, plant.disturbances)
        if np.ndim(u) == 0:
            signals = np.full(plant.inputs, checks.finite("u", u))
        else:
            signals = checks.vector("u", u, plant.inputs)
        return _differentiated(plant, state, signals, loads, checks.finite("t", t))
    rule = "must be a NonlinearPlant, a plant with a cubic spring, or a linear plant"
    raise ValueError(f"plant = {getattr(plant, 'name', plant)!r}: {rule}")


def held_points(name: str, plant: Any, points: Any) -> tuple[tuple[Vector, Vector], ...]:
    """Return the operating points (x, u) of a list of them, each as ``held_at`` does.

    ``name`` is that of the argument. Raises ``ValueError`` for what is no list of points, an empty
    one, and as ``held_at``.
    """
    rule = "must be a list of operating points, states x or (x, u)"
    if not _has_entries(points):
        raise ValueError(f"{name} = {points!r:.60}: {rule}")
    if len(points) == 0:
        raise ValueError(f"{name} = []: give at least one state, or (x, u)")
    if _nonlinear(plant).order > 1 and not any(_has_entries(each) for each in points):
        raise ValueError(f"{name} = {points!r:.60}: {rule}; of one state write [[…]]")
    found = []
    for i, each in enumerate(points):
        try:
            found.append(held_at(plant, each))
        except ValueError as error:
            raise ValueError(f"{name}[{i}]: {error}") from None
    return tuple(found)


def held_at(plant: Any, point: Any) -> tuple[Vector, Vector]:
    """Return an operating point (x, u) of a plant with several signals; u holds x at rest.

    Parameters
    ----------
    plant
        a ``NonlinearPlant``, also behind delays or encoders.
    point
        (x, u), which is returned as it is, or the state x (n,), for which u is found by least
        squares: the equations of motion are taken as linear in u.

    Raises
    ------
    ValueError
        for another plant, a state of unsuitable length, and one that no u holds at rest.
    """
    plant = _nonlinear(plant)
    if isinstance(point, list | tuple) and len(point) == 2 and np.ndim(point[0]) > 0:
        x = checks.vector("x", point[0], plant.order)
        return x, checks.vector("u", point[1], plant.inputs)
    try:
        x = checks.vector("x", point, plant.order)
    except ValueError:
        rule = f"must be a state of {plant.order} entries, or (x, u)"
        raise ValueError(f"operating point {point!r:.60}: {rule}") from None
    model: Any = plant.sampled(1.0, interpret=True)
    w = np.zeros(plant.disturbances)

    def rate(u: Vector) -> Vector:
        return np.array(model.rate(0.0, x, as_input(model, u), w), dtype=np.float64)

    first = rate(np.zeros(plant.inputs))
    columns = np.column_stack([rate(row) - first for row in np.eye(plant.inputs)])
    u: Vector = np.asarray(np.linalg.lstsq(columns, -first, rcond=None)[0], dtype=np.float64)
    left = float(np.max(np.abs(rate(u))))
    if not left <= _AT_REST * (1.0 + float(np.max(np.abs(first)))):
        raise ValueError(
            f"x = {x.tolist()!r}: no u holds it at rest (rates of up to {left:.3g} are left); give "
            "a state with rates of zero, and of an elastic joint with its deflection, or (x, u)"
        )
    return x, u


def _has_entries(value: Any) -> bool:
    return checks.is_sequence(value) or (isinstance(value, np.ndarray) and value.ndim > 0)


def _nonlinear(plant: Any) -> NonlinearPlant:
    """Return a nonlinear plant without its delays and encoders."""
    while isinstance(plant, DelayedInputs | EncodedOutputs):
        plant = plant.plant
    if not isinstance(plant, NonlinearPlant):
        name = getattr(plant, "name", plant)
        raise ValueError(
            f"plant = {name!r}: must be a nonlinear plant; a linear one is the same at all points"
        )
    return plant


def _with_spring_of(plant: CubicSpringPlant, x: Vector) -> LinearPlant:
    """Return the linear part with ``k + 3 k_cubic (x1 − x2)²`` for k."""
    A = plant.linear.A.copy()
    stiffness = 3.0 * plant.k_cubic * (x[0] - x[1]) ** 2
    A[2, :2] += np.array([-1.0, 1.0]) * stiffness / plant.m1
    A[3, :2] += np.array([1.0, -1.0]) * stiffness / plant.m2
    return LinearPlant(A, plant.linear.B, plant.linear.C, plant.linear.E, name=plant.name)


def _differentiated(
    plant: NonlinearPlant, x: Vector, u: Vector, w: Vector, t: float
) -> LinearPlant:
    model: Any = plant.sampled(1.0, interpret=True)
    n, m = x.size, x.size + u.size

    def rate(point: Vector) -> Any:
        return model.rate(t, point[:n], as_input(model, point[n:m]), point[m:])

    J = _jacobian(rate, np.concatenate([x, u, w]), "f")
    C = _jacobian(lambda point: np.atleast_1d(model.output(point)), x, "output")
    parts = (J[:, :n], J[:, n:m], C, J[:, m:])
    return LinearPlant(*parts, name=f"{plant.name}, linearised")


def _jacobian(function: Callable[[Vector], Any], point: Vector, name: str) -> Matrix:
    """Return the derivatives (m, n) of m values by the n entries of ``point``."""
    steps = _STEP * np.maximum(1.0, np.abs(point))
    every, sizes = [], []
    for i, step in enumerate(steps):
        values = []
        for share in (-2.0, -1.0, 0.0, 1.0, 2.0):
            moved = point.copy()
            moved[i] += share * step
            values.append(np.array(function(moved), dtype=np.float64))
        every.append(np.diff(values, axis=0) / step)
        # Rounding errors of the values, divided by the step.
        sizes.append(np.max(np.abs(values), axis=0) * 1e-9 / step)
    # At rest large terms cancel, whose rounding errors the values do not show.
    hidden = _HIDDEN * np.max(np.abs(every), axis=(0, 1)) if every else np.zeros(0)
    columns = []
    for i, (slopes, size) in enumerate(zip(every, sizes, strict=True)):
        allowed = _SMOOTH * np.max(np.abs(slopes), axis=0) + size + hidden
        # What is left of the slopes without their own trend, which a second derivative makes.
        bend = np.tensordot(_PLACES, slopes, 1) / (_PLACES @ _PLACES)
        if not np.all(np.ptp(slopes - np.multiply.outer(_PLACES, bend), axis=0) <= allowed):
            raise ValueError(
                f"{name} has no derivative by entry {i} of (x, u, w) = {point.tolist()!r}, where "
                "it jumps or has a corner (dry friction, a stop, the end of a range); take a point "
                "beside it, or a smooth model"
            )
        columns.append(0.5 * (slopes[1] + slopes[2]))
    return np.array(columns).T


def linear_model(plant: Any) -> Any:
    """Return the part of a plant that a design can use, for example the one without friction.

    That of a nonlinear plant is the one about its operating point, if it has one and its equation
    has a derivative there; else the plant is returned as it is.
    """
    if isinstance(plant, NonlinearPlant):
        with suppress(ValueError):
            return _named_as(plant, linearised(plant, *operating_point_of(plant)))
    if isinstance(plant, DelayedPlant | EncodedPlant):
        inner = linear_model(plant.plant)
        return plant if inner is plant.plant else replace(plant, plant=inner)
    if isinstance(plant, LaggedPlant):
        inner = linear_model(plant.plant)
        return plant if inner is plant.plant else _named_as(plant, lagged(inner, plant.lag))
    return _named_as(plant, getattr(plant, "linear", plant))


def _named_as(plant: Any, part: Any) -> Any:
    """Return the part of a plant with the names and units that the plant's y and u have."""
    known = signals_of(plant)
    return labelled(part, known.y, known.u) if known.known and part is not plant else part


def operating_point_of(plant: NonlinearPlant) -> tuple[Any, float]:
    """Return the operating point (x, u) of a nonlinear plant; zero if that is a state of rest.

    Raises ``ValueError`` if it has none.
    """
    if plant.operating_point is not None:
        return checked_point(plant.operating_point)
    rest, model = np.zeros(plant.order), plant.sampled(1.0, interpret=True)
    with np.errstate(all="ignore"):
        u = as_input(model, np.zeros(plant.inputs))
        rate = value_or_nan(model.rate, 0.0, rest, u, np.zeros(plant.disturbances))
    if np.all(np.asarray(rate) == 0.0):
        return rest, plant.no_control
    raise ValueError(
        f"plant = {plant.name!r} is nonlinear, and zero is no state of rest: give the point at "
        "which it is linearised, operating_point=(x, u)"
    )


def linear_part(plant: Any, dt: float, operating_point: Any = None) -> tuple[Any, float]:
    """Return a linear plant and the delay [s] of its input, for ``analyse``.

    An encoder is left out: its steps are no gain. So is the friction of an identified model. A
    nonlinear plant is linearised at the ``operating_point`` (x, u), by default its own. Raises
    ``ValueError`` for a delay that was made for another sample time, and for a nonlinear plant
    without operating point.
    """
    check_one_input(plant, "quell.Axes and quell.analysis.analyse")
    delay = 0.0
    while isinstance(plant, DelayedPlant | EncodedPlant):
        if isinstance(plant, DelayedPlant):
            if not math.isclose(plant.dt, dt, rel_tol=1e-9):
                raise ValueError(
                    f"plant is delayed by samples of {plant.dt!r} s, the controller has dt = "
                    f"{dt!r} s: must be the same; pass the plant inside, and delay = "
                    f"{plant.delay!r}"
                )
            delay += plant.delay
        plant = plant.plant
    if isinstance(plant, LaggedPlant):
        inner, more = linear_part(plant.plant, dt, operating_point)
        return lagged(LinearPlant.of(inner), plant.lag), delay + more
    if operating_point is not None:
        return linearised(plant, *checked_point(operating_point)), delay
    if isinstance(plant, NonlinearPlant):
        return linearised(plant, *operating_point_of(plant)), delay
    if isinstance(plant, FrictionPlant):  # an identified one: its model is the linear part
        return plant.linear, delay
    if hasattr(plant, "k_cubic"):
        raise ValueError(
            f"plant = {plant.name!r} is nonlinear: give the point at which it is linearised, "
            "operating_point=(x, u)"
        )
    if hasattr(plant, "linear") and hasattr(plant, "sampled"):
        raise ValueError(
            f"plant = {plant.name!r} has dry friction, limits or an encoder, or play, which "
            "are not linear: analyse its linear part, plant.linear, with its delay as delay="
        )
    if callable(plant) and not (hasattr(plant, "sampled") or is_linear_model(plant)):
        raise ValueError(
            f"plant = {plant!r} is a function: pass quell.plants.NonlinearPlant(f, order=...), and "
            "operating_point=(x, u)"
        )
    return plant, delay
