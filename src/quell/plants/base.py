"""What the driver asks of a plant.

A plant is an object with ``order`` (number of states), ``disturbances`` (number of disturbance inputs), ``name``, and
``compiled`` and ``sampled(dt)``, which returns a NamedTuple of parameters. For the type of that NamedTuple two functions are registered:
``measure`` and ``advance``. See ``linear.py`` for a complete example.
"""

from __future__ import annotations

from typing import Any, Protocol

from quell.kernels.dispatch import generic
from quell.types import Vector


class Plant(Protocol):
    """The part of a plant that the driver, the observers' design and the plots use."""

    @property
    def name(self) -> str:
        """What tables and plots call it."""

    @property
    def order(self) -> int:
        """Number of states."""

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs."""

    @property
    def compiled(self) -> bool:
        """Whether the driver can run it compiled."""

    def sampled(self, dt: float, interpret: bool = False) -> Any:
        """Return the parameters for a sample time ``dt`` [s]; with ``interpret``, such that Python can run and debug them."""


class PlantWrapper:
    """What a plant that is put around another one has of that one."""

    plant: Any

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.plant.order)

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs; they act as ever."""
        return int(self.plant.disturbances)

    @property
    def compiled(self) -> bool:
        """Whether the driver can run it compiled."""
        return bool(self.plant.compiled)


def check_plant(value: Any, name: str = "plant") -> None:
    """Raise a ``ValueError`` if ``value``, the argument ``name``, is not a plant."""
    if isinstance(value, type) or not hasattr(value, "sampled"):
        raise ValueError(
            f"{name} = {value!r}: must be a plant, for example quell.plants.two_mass_spring() "
            "or quell.plants.LinearPlant.of(model)"
        )


@generic
def measure(plant: Any, x: Vector) -> float:
    """Return the output y for the state ``x`` (n,)."""
    raise TypeError


@generic
def advance(plant: Any, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
    """Move the state ``x`` (n,) on by a sample from the time ``t`` [s]; ``u`` and ``w`` (m,) hold. ``scratch`` has room for 6 n."""
    raise TypeError
