"""The interface of a plant: a protocol for its description and two functions for its kernels.

``Plant.sampled`` returns a NamedTuple of parameters. ``measure`` and ``advance`` are registered for
the type of that NamedTuple; ``linear.py`` is a complete example.
"""

from __future__ import annotations

from typing import Any, Protocol

from quell.described import Described
from quell.kernels.dispatch import generic, generic_with_default
from quell.types import Vector


class Plant(Protocol):
    """The part of a plant that the driver, the observers' design and the plots use."""

    @property
    def name(self) -> str:
        """Name for tables and plots."""

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
        """Return the parameters for a sample time ``dt`` [s].

        With ``interpret`` Python can run and debug them.
        """


class PlantWrapper(Described):
    """The properties that a wrapper takes over from the plant inside."""

    plant: Plant

    @property
    def order(self) -> int:
        """Number of states."""
        return self.plant.order

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs."""
        return self.plant.disturbances

    @property
    def compiled(self) -> bool:
        """Whether the driver can run it compiled."""
        return self.plant.compiled


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
    """Advance the state ``x`` (n,) by a sample from the time ``t`` [s], with held u and w (m,).

    ``scratch`` has room for 6 n numbers. It is the same array during a run, and zero before it.
    """
    raise TypeError


@generic_with_default
def begin_run(plant: Any, x: Vector, scratch: Vector) -> None:
    """Begin a run from the state ``x`` (n,), or begin it again.

    Loops call it, as Python, before the first sample and whenever they put the plant back to its
    initial state. Most plants need nothing.
    """


@generic_with_default
def check_run(plant: Any, scratch: Vector) -> None:
    """Raise the error that ended a run, if the plant met one; loops call it as Python."""
