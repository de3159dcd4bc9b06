"""The plants that setup files, rigs and twins know by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from quell.plants.base import Plant
from quell.plants.delay import delayed
from quell.plants.encoder import encoded
from quell.plants.fmu.plant import FMU
from quell.plants.identified_file import identified
from quell.plants.linear import LinearPlant
from quell.plants.machines.cubic_spring import lagged_two_mass_spring
from quell.plants.machines.dc_motor import dc_motor
from quell.plants.machines.n_mass import n_mass
from quell.plants.machines.torsional import torsional, torsional_identified
from quell.plants.machines.two_mass_spring import two_mass_spring
from quell.plants.nonlinear.python_file import python_plant


def linear(
    num: Any = None, den: Any = None, A: Any = None, B: Any = None, C: Any = None, E: Any = None
) -> LinearPlant:
    """Return a linear plant: a transfer function ``num/den``, or matrices.

    Parameters
    ----------
    num, den
        coefficients of the transfer function, highest power of s first.
    A, B, C
        in place of num and den, matrices as lists of rows; B and C may be lists of numbers.
    E
        how disturbances enter, with a column for each; as u does by default.
    """
    values = {"num": num, "den": den, "A": A, "B": B, "C": C}
    given = [name for name, value in values.items() if value is not None]
    if given == ["num", "den"]:
        return LinearPlant.of((num, den), E)
    if given == ["A", "B", "C"]:
        return LinearPlant(A, B, C, E)
    raise ValueError(f"given: {', '.join(given) or 'nothing'}; must be num and den, or A, B and C")


TESTBEDS: Mapping[str, Callable[[], Plant]] = {
    "torsional": torsional,
    "torsional-identified": torsional_identified,
    "two-mass": two_mass_spring,
}
"""Plants of testbeds, which are made without arguments."""

PLANTS: Mapping[str, Callable[..., Plant]] = {
    **TESTBEDS,
    "dc-motor": dc_motor,
    "lagged-two-mass": lagged_two_mass_spring,
    "linear": linear,
    "n-mass": n_mass,
    "delayed": delayed,
    "encoded": encoded,
    "fmu": FMU,
    "identified": identified,
    "python": python_plant,
}
"""Plants that a setup file can have, by their ``kind``."""

RUN_CODE: tuple[Callable[..., Plant], ...] = (FMU,)
"""Plants that are programs: a setup file can only have them if the user trusts it."""
