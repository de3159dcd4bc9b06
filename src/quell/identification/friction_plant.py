"""The identified plant with its Coulomb friction and delay, for simulations."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.identification.model.sampling import observable
from quell.identification.result import Identified
from quell.plants.delay import delayed
from quell.plants.nonlinear.plant import NonlinearPlant
from quell.types import Vector

# Width of the smooth sign of the speed, relative to the RMS speed in the record: by hand, so that
# creeping within it is far slower than motion.
_WIDTH = 0.02


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
    order = found.den.size - 1
    if (found.friction or 0.0) > 0.0 and found.num.size < order:  # else y' jumps with u
        plant = _with_friction(found)
    if late := round(found.delay / found.dt):
        plant = delayed(plant, late * found.dt, found.dt)
    return plant


def _with_friction(found: Identified) -> NonlinearPlant:
    order, force = found.den.size - 1, float(found.friction or 0.0)
    A = observable(found.den[:0:-1].copy())
    B = np.zeros(order)
    B[order - found.num.size :] = found.num
    speed = np.diff(found.simulated[: found.held_from]) / found.dt
    width = _WIDTH * float(np.sqrt(np.mean(speed**2)))

    def rate(t: float, x: Vector, u: float, w: Vector) -> Vector:
        dx = A @ x
        return dx + B * (u + w[0] - force * np.tanh(dx[0] / width))

    return NonlinearPlant(rate, order, lambda x: x[0], disturbances=1, name="identified plant")
