"""The identified plant with its Coulomb friction and delay, for simulations."""

from __future__ import annotations

from typing import Any

from quell.identification.result import Identified
from quell.plants.friction_and_delay import with_friction_and_delay


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
    friction = found.friction, found.friction_width
    return with_friction_and_delay(
        found.plant, found.num, found.den, *friction, found.delay, found.dt
    )
