"""Stability of the benchmark's loops without limits, for many plants at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quell.analysis.linearise import linear_law
from quell.analysis.subsystems import closed_loop_matrix
from quell.controllers import Controller
from quell.parallel import one_blas_thread
from quell.plants import CubicSpringPlant, LinearPlant


def unstable(
    plants: Sequence[LinearPlant | CubicSpringPlant], controller: Controller
) -> NDArray[np.bool_]:
    """Return for each plant whether its loop is unstable at rest, with nothing learned."""
    law = linear_law(controller)
    inner = law.A + np.outer(law.B_u, law.C)
    linear = [p.linear if isinstance(p, CubicSpringPlant) else p for p in plants]
    with one_blas_thread():
        sampled = [plant.sampled(controller.dt) for plant in linear]
        loops = np.array(
            [closed_loop_matrix(s.transition, s.input, s.output, law, inner) for s in sampled]
        )
        return np.asarray(np.max(np.abs(np.linalg.eigvals(loops)), axis=1) >= 1.0)
