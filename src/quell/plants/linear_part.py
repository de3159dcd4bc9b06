"""The linear plant behind delays and encoders, for the analysis of loops."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from quell.lti.models import is_linear_model
from quell.plants.delay import DelayedPlant
from quell.plants.encoder import EncodedPlant
from quell.plants.labelled import labelled, signals_of
from quell.plants.linearise import linearised
from quell.plants.nonlinear.friction import FrictionPlant
from quell.plants.nonlinear.kernels import value_or_nan
from quell.plants.nonlinear.plant import NonlinearPlant, checked_point


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
        rate = value_or_nan(model.rate, 0.0, rest, 0.0, np.zeros(plant.disturbances))
    if np.all(np.asarray(rate) == 0.0):
        return rest, 0.0
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
