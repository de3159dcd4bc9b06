"""An excitation sent to a plant in open loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.controllers.linear.law import LinearLaw
from quell.controllers.linear.linear import LinearController
from quell.identification.excitation import Excitation
from quell.identification.measured import Measured
from quell.simulation import Scenario, simulate


def excited(plant: Any, design: Excitation) -> Measured:
    """Simulate a plant that is told a designed excitation, from rest, and return what is recorded.

    Parameters
    ----------
    plant
        any plant of ``quell.plants``.
    design
        from ``excitation``.

    Returns
    -------
    Measured
        u, y and dt, for ``identify``.

    Raises
    ------
    ValueError
        as ``simulate``.
    """
    nothing = np.zeros(0)
    through = LinearLaw(np.zeros((0, 0)), nothing, nothing, nothing, nothing, 1.0, 0.0)
    duration = (design.u.size - 1) * design.dt
    run = simulate(
        plant,
        LinearController(through, design.dt),
        Scenario(reference=design.signal, duration=duration),
    )
    return Measured(run["u"], run["y_measured"], design.dt, None)
