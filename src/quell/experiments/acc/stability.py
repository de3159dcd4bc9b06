"""Stability of the benchmark's loops without limits, for many plants at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quell.analysis.frozen_learner import frozen
from quell.analysis.linearise import linear_law
from quell.analysis.subsystems import closed_loop_matrix
from quell.controllers import Controller
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.linear.law import LinearLaw
from quell.parallel import one_blas_thread
from quell.plants import CubicSpringPlant, LinearPlant


def unstable(
    plants: Sequence[LinearPlant | CubicSpringPlant], controller: Controller
) -> NDArray[np.bool_]:
    """Return for each plant whether its loop is unstable at rest, before anything is learned."""
    return unstable_under(plants, law_before_learning(controller), controller.dt)


def law_before_learning(controller: Controller) -> LinearLaw:
    """Return the law of a controller whose learner knows nothing and does not learn."""
    at = frozen(controller) if isinstance(controller, ADRC) else None
    return linear_law(controller, at)


def unstable_under(
    plants: Sequence[LinearPlant | CubicSpringPlant], law: LinearLaw, dt: float
) -> NDArray[np.bool_]:
    """Return for each plant whether its loop with a linear law at a sample time is unstable."""
    inner = law.A + np.outer(law.B_u, law.C)
    linear = [p.linear if isinstance(p, CubicSpringPlant) else p for p in plants]
    with one_blas_thread():
        sampled = [plant.sampled(dt) for plant in linear]
        loops = np.array(
            [closed_loop_matrix(s.transition, s.input, s.output, law, inner) for s in sampled]
        )
        return np.asarray(np.max(np.abs(np.linalg.eigvals(loops)), axis=1) >= 1.0)
