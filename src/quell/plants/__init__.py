"""Plants: the systems to be controlled, each with an exact or numerical solution for a sample.

May import ``lti``, ``kernels`` and what stands before them. A new machine needs its own file in
``machines``, a line in ``registry.py`` and, if it is public, its name here.
"""

from quell.plants.base import Plant
from quell.plants.batch import PlantBatch, batch
from quell.plants.delay import delayed
from quell.plants.encoder import encoded
from quell.plants.fmu.plant import FMU
from quell.plants.labelled import labelled, signals_of
from quell.plants.linear import LinearPlant
from quell.plants.linearise import linearised
from quell.plants.machines.cubic_spring import CubicSpringPlant, lagged_two_mass_spring
from quell.plants.machines.dc_motor import DcMotor, dc_motor
from quell.plants.machines.n_mass import NMassPlant, n_mass
from quell.plants.machines.torsional import TorsionalPlant, torsional, torsional_identified
from quell.plants.machines.two_mass_spring import two_mass_spring
from quell.plants.nonlinear.plant import NonlinearPlant

__all__ = [
    "FMU", "CubicSpringPlant", "DcMotor", "LinearPlant", "NMassPlant", "NonlinearPlant", "Plant",
    "PlantBatch", "TorsionalPlant", "batch", "dc_motor", "delayed", "encoded", "labelled",
    "lagged_two_mass_spring", "linearised", "n_mass", "signals_of", "torsional",
    "torsional_identified", "two_mass_spring",
]  # fmt: skip
