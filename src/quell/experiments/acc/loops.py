"""Which loops of the benchmark are stable while no limit holds: for a thousand plants at once, ``analysis`` being for one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.analysis.linearise import closed_loop_matrix, linear_law
from quell.parallel import one_blas_thread
from quell.plants import CubicSpringPlant, LinearPlant


def unstable(
    plants: Sequence[LinearPlant | CubicSpringPlant], controller: Any
) -> NDArray[np.bool_]:
    """Tell for each plant whether its loop, with nothing learned, is unstable at rest, where a cubic spring does not show."""
    law = linear_law(controller)
    with one_blas_thread():
        sampled = [_at_rest(plant).sampled(controller.dt) for plant in plants]
        inner = law.A + np.outer(law.B_u, law.C)
        loops = np.array(
            [
                closed_loop_matrix(part.transition, part.input, part.output, law, inner)
                for part in sampled
            ]
        )
        return np.asarray(np.max(np.abs(np.linalg.eigvals(loops)), axis=1) >= 1.0)


def _at_rest(plant: LinearPlant | CubicSpringPlant) -> LinearPlant:
    return plant.linear if isinstance(plant, CubicSpringPlant) else plant
