"""Plants: the systems to be controlled, each with an exact or numerical solution for a sample.

May import ``lti``, ``kernels`` and what stands before them. A new machine needs its own file in
``machines``, a line in ``registry.py`` and, if it is public, its name here.
"""

from quell.lazy import imported_on_use, public_names
from quell.plants.base import Flow, Plant, PlantBatch, batch, labelled, signals_of
from quell.plants.channels import delayed_inputs, encoded_outputs
from quell.plants.flexible import (
    CubicSpringPlant,
    NMassPlant,
    lagged_two_mass_spring,
    n_mass,
    two_mass_spring,
)
from quell.plants.fmu import FMU
from quell.plants.linear import LinearPlant, delayed, encoded, lagged
from quell.plants.linearise import linearised
from quell.plants.multibody import Arm, Craft, arm, quadrotor_attitude, rotor_levers
from quell.plants.nonlinear import NonlinearPlant
from quell.plants.testbeds import DcMotor, TorsionalPlant, dc_motor, torsional, torsional_identified

__all__ = [
    "FMU", "Arm", "Craft", "CubicSpringPlant", "DcMotor", "Flow", "LinearPlant", "NMassPlant",
    "NonlinearPlant", "Plant", "PlantBatch", "TorsionalPlant", "arm", "batch", "dc_motor",
    "delayed", "delayed_inputs", "encoded", "encoded_outputs", "labelled", "lagged",
    "lagged_two_mass_spring", "linearised", "n_mass", "quadrotor_attitude", "rotor_levers",
    "signals_of", "torsional", "torsional_identified", "two_mass_spring",
]  # fmt: skip

# Names of earlier releases.
_RENAMED = {
    "MultivariableFMU": "FMU",
    "MultivariableLinearPlant": "LinearPlant",
    "MultivariableNonlinearPlant": "NonlinearPlant",
}

__getattr__ = imported_on_use(__name__, {}, (), _RENAMED)

__dir__ = public_names(__name__)
