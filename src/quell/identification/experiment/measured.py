"""Records of input and output."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quell.controllers.linear.law import LinearLaw
from quell.controllers.linear.linear import LinearController
from quell.identification.experiment.excitation import Excitation
from quell.plants import Plant
from quell.quantities import UNKNOWN, Signals
from quell.simulation import Scenario, simulate
from quell.types import Vector


class Measured(NamedTuple):
    """An evenly sampled record."""

    u: Vector
    y: Vector
    dt: float  #: [s]
    reference: Vector | None
    signals: Signals = UNKNOWN  #: names and units of u and y


def excited(plant: Plant, design: Excitation) -> Measured:
    """Return the simulated record of a plant at rest that gets a designed excitation as u.

    Raises
    ------
    ValueError
        as ``simulate``.
    """
    none = np.zeros(0)
    law = LinearLaw(np.zeros((0, 0)), none, none, none, none, 1.0, 0.0)  # u = r
    scenario = Scenario(reference=design.signal, duration=(design.u.size - 1) * design.dt)
    run = simulate(plant, LinearController(law, design.dt), scenario)
    return Measured(run["u"], run["y_measured"], design.dt, None, run.signals)
