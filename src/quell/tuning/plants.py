"""The plants that a tuning is for: one, a list, a batch, with a range of their gain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.lti.canonical import canonical
from quell.plants.batch import PlantBatch
from quell.plants.delay import DelayedPlant
from quell.plants.linear_part import linear_part
from quell.plants.sampled import SampledPlant, sampled_plant
from quell.tuning.constraints import Constraints
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.structures.base import Model
from quell.types import Vector

# A zero with a real part above this share of its size is in the right half plane.
_RIGHT = 1e-9


class Given(NamedTuple):
    """Plants as given, without delays and encoders, and their delays."""

    linear: tuple[Any, ...]
    delays: Vector  # [s]
    actuator_lag: float
    factors: Vector  # factors of the gain, for each plant
    sign: float  # sign of the gain that integral action needs
    degree: int
    b: float  # gain of the first plant from u to y^(degree)


def as_list(plant: Any) -> list[Any]:
    """Return the plants of a ``PlantBatch`` or of a list of plants; or one plant in a list.

    A list holds plants: objects, or tuples (numerator, denominator) and the like. A tuple is one
    plant.
    """
    if isinstance(plant, PlantBatch):
        return list(plant)
    if isinstance(plant, list) and plant:
        inner = (list, np.ndarray, float, int, np.number)
        if not any(isinstance(entry, inner) for entry in plant):
            return plant
    return [plant]


def with_known_noise(given: Constraints, plant: Any, limits: tuple[float, float]) -> Constraints:
    """Return the constraints with the noise of y that a plant tells of, if nothing bounds it yet.

    A plant with an encoder tells of its resolution, the model of a record of ``noise_std``. Either
    is of use between finite ``limits`` of u [u-unit], a share of which noise may take.
    """
    bounded = given.noise or given.m_ks or given.u_std or given.noise_over_pi is None
    if bounded or not math.isfinite(limits[1] - limits[0]):
        return given
    while isinstance(plant, DelayedPlant):
        plant = plant.plant
    std, step = (getattr(plant, name, None) or 0.0 for name in ("noise_std", "resolution"))
    if std > 0.0:  # rounding is part of it
        return replace(given, noise_std=std)
    return replace(given, resolution=step) if step > 0.0 else given


def given_plants(
    plant: Any,
    dt: float,
    *,
    delay: Any = 0.0,
    actuator_lag: float = 0.0,
    b_range: Sequence[float] = (1.0, 1.0),
    operating_point: Any = None,
) -> Given:
    """Return the plants, checked: the same sign of the gain.

    Raises ``ValueError`` for a plant with a zero at s = 0, on which integral action has no effect.
    """
    plants = as_list(plant)
    more = np.broadcast_to(np.asarray(delay, dtype=np.float64), (len(plants),))
    parts = [linear_part(each, dt, operating_point) for each in plants]
    delays = np.array([own for _, own in parts]) + more
    low, high = checks.vector("b_range", b_range, 2).tolist()
    if not 0.0 < low <= high:
        raise ValueError(f"b_range = {b_range!r}: must be two positive factors of b, low and high")
    forms = [canonical(linear) for linear, _ in parts]
    for i, form in enumerate(forms):
        if np.any(form.zeros == 0.0):
            raise ValueError(
                f"plant[{i}] has a zero at s = 0: integral action has no effect on its output; "
                "measure another output"
            )
    signs = [_sign(form.b, form.zeros) for form in forms]
    for i, sign in enumerate(signs):
        if sign != signs[0]:
            raise ValueError(
                f"plant[{i}] has the other sign of the gain than plant[0]: no controller with "
                "integral action stabilises both; check the direction of u"
            )
    linear = tuple(part for part, _ in parts)
    factors = np.unique([low, 1.0, high]) if (low, high) != (1.0, 1.0) else np.ones(1)
    return Given(linear, delays, actuator_lag, factors, signs[0], forms[0].degree, forms[0].b)


def _sign(b: float, zeros: Vector) -> float:
    """Return the sign that k_i needs: that of the numerator at s = 0.

    The closed loop's polynomial ``D s + N k_i`` must have the same sign at 0 and at infinity.
    """
    right = int(np.sum((zeros.real > _RIGHT * np.abs(zeros)) & (zeros.imag == 0.0)))
    return float(np.sign(b)) * (-1.0) ** right


def plant_set(given: Given, dt: float, own: Vector | None = None) -> PlantSet:
    """Return the set: each plant with each factor of the gain; the nominal one is the first.

    ``own`` has one factor for each plant instead.
    """
    sampled: list[SampledPlant] = []
    for linear, delay in zip(given.linear, given.delays.tolist(), strict=True):
        sampled.append(sampled_plant(linear, dt, delay, given.actuator_lag))
    if own is not None:
        return PlantSet(sampled, own, dt)
    order = np.argsort(np.abs(np.log(given.factors)), kind="stable")  # the factor 1 first
    factors = np.repeat(given.factors[order], len(sampled))
    return PlantSet(sampled * given.factors.size, factors, dt)


def model_of(given: Given, plants: PlantSet, constraints: Constraints) -> Model:
    """Return what structures may know: the first plant."""
    omega = plants.crossover
    # Beside the crossover, where an undamped resonance may be.
    beside = np.abs(plants.responses(omega * np.array([0.8, 1.25]))[0])
    gain = float(np.sqrt(beside[0] * beside[1]))
    return Model(
        plant=given.linear[0],
        delay=float(given.delays[0]),
        dt=plants.dt,
        sign=given.sign,
        degree=given.degree,
        b=abs(given.b),
        omega=omega,
        gain=gain,
        constraints=constraints,
    )
