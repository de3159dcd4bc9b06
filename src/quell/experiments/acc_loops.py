"""Which loops of the benchmark are stable while no limit holds: for a thousand plants at once, ``analysis`` being for one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.analysis import linear_law
from quell.controllers.linear import LinearLaw
from quell.parallel import one_blas_thread
from quell.plants import CubicSpringPlant, LinearPlant
from quell.types import Matrix


def unstable(plants: Sequence[LinearPlant | CubicSpringPlant], controller: Any) -> NDArray[np.bool_]:
    """Tell for each plant whether its loop, with nothing learned, is unstable at rest, where a cubic spring does not show."""
    law = linear_law(controller)
    with one_blas_thread():
        loops = np.array([closed_loop(_at_rest(plant), law, controller.dt) for plant in plants])
        return np.asarray(np.max(np.abs(np.linalg.eigvals(loops)), axis=1) >= 1.0)


def closed_loop(plant: LinearPlant, law: LinearLaw, dt: float) -> Matrix:
    """Return the sampled loop's matrix, the plant's states first."""
    sampled = plant.sampled(dt)
    return np.block(
        [
            [sampled.transition + law.D_y * np.outer(sampled.input, sampled.output), np.outer(sampled.input, law.C)],
            [np.outer(law.B_y + law.B_u * law.D_y, sampled.output), law.A + np.outer(law.B_u, law.C)],
        ]
    )


def _at_rest(plant: LinearPlant | CubicSpringPlant) -> LinearPlant:
    return plant.linear if isinstance(plant, CubicSpringPlant) else plant
