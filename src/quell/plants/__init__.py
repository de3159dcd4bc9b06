"""Plants: what is to be controlled."""

from quell.plants.base import Plant
from quell.plants.batch import PlantBatch, batch
from quell.plants.delay import delayed
from quell.plants.linear import LinearPlant
from quell.plants.nonlinear import NonlinearPlant
from quell.plants.two_mass_spring import two_mass_spring

__all__ = ["LinearPlant", "NonlinearPlant", "Plant", "PlantBatch", "batch", "delayed", "two_mass_spring"]
