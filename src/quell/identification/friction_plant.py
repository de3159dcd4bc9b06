"""The identified plant with its Coulomb friction and delay, for simulations."""

from __future__ import annotations

from typing import Any

from quell.identification.result import Identified
from quell.plants.delay import delayed
from quell.plants.nonlinear.friction import FrictionPlant


def simulated_plant(found: Identified) -> Any:
    """Return the plant of a model for ``simulate``, with its friction and its delay.

    Friction acts against u, ``u − F tanh(y'/v)``, with v a fiftieth of the RMS speed in the record;
    that of the model acts on driven and measured side, here all of it on the side of u. The
    constant force is left out. Without friction it is the linear plant.

    Parameters
    ----------
    found
        result of ``identify``.

    Raises
    ------
    ValueError
        for direct feedthrough.
    """
    plant: Any = found.plant
    width = found.friction_width
    if found.friction is not None and width is not None:
        plant = FrictionPlant(plant, found.num, found.den, found.friction, width, plant.name)
    if late := round(found.delay / found.dt):
        plant = delayed(plant, late * found.dt, found.dt)
    return plant
