"""Plants: what is to be controlled."""

from quell.plants.base import Plant
from quell.plants.batch import PlantBatch, batch
from quell.plants.cubic_spring import CubicSpringPlant, lagged_two_mass_spring
from quell.plants.delay import delayed
from quell.plants.linear import LinearPlant
from quell.plants.nonlinear import NonlinearPlant
from quell.plants.two_mass_spring import two_mass_spring

__all__ = [
    "CubicSpringPlant",
    "LinearPlant",
    "NonlinearPlant",
    "Plant",
    "PlantBatch",
    "batch",
    "delayed",
    "lagged_two_mass_spring",
    "two_mass_spring",
]
