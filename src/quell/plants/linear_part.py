"""The linear plant behind delays and encoders, for the analysis of loops."""

from __future__ import annotations

import math
from typing import Any

from quell.lti.models import is_linear_model
from quell.plants.delay import DelayedPlant
from quell.plants.encoder import EncodedPlant
from quell.plants.linearise import linearised
from quell.plants.nonlinear import NonlinearPlant


def linear_model(plant: Any) -> Any:
    """Return the part of a plant that a design can use, for example the one without friction."""
    return getattr(plant, "linear", plant)


def linear_part(plant: Any, dt: float, operating_point: Any = None) -> tuple[Any, float]:
    """Return a linear plant and the delay [s] of its input, for ``analyse``.

    An encoder is left out: its steps are no gain. A nonlinear plant is linearised at the
    ``operating_point`` (x, u). Raises ``ValueError`` for a delay that was made for another sample
    time, and for a nonlinear plant without operating point.
    """
    delay = 0.0
    while isinstance(plant, DelayedPlant | EncodedPlant):
        if isinstance(plant, DelayedPlant):
            if not math.isclose(plant.dt, dt, rel_tol=1e-9):
                raise ValueError(
                    f"plant is delayed by samples of {plant.dt!r} s, the controller has dt = "
                    f"{dt!r} s: must be the same; pass the plant inside, and delay = "
                    f"{plant.samples * plant.dt!r}"
                )
            delay += plant.samples * dt
        plant = plant.plant
    if operating_point is not None:
        try:
            x, u = operating_point
        except (TypeError, ValueError):
            raise ValueError(
                f"operating_point = {operating_point!r}: must be a state and a control signal, "
                "(x, u)"
            ) from None
        return linearised(plant, x, u), delay
    if isinstance(plant, NonlinearPlant) or hasattr(plant, "k_cubic"):
        raise ValueError(
            f"plant = {plant.name!r} is nonlinear: give the point at which it is linearised, "
            "operating_point=(x, u)"
        )
    if hasattr(plant, "linear") and hasattr(plant, "sampled"):
        raise ValueError(
            f"plant = {plant.name!r} has dry friction, limits or an encoder, which are not linear: "
            "analyse its linear part, plant.linear, with its delay as delay="
        )
    if callable(plant) and not (hasattr(plant, "sampled") or is_linear_model(plant)):
        raise ValueError(
            f"plant = {plant!r} is a function: pass quell.plants.NonlinearPlant(f, order=...), and "
            "operating_point=(x, u)"
        )
    return plant, delay
