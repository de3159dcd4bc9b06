"""The interface of a controller to the simulation and to the real-time loop.

A controller is an object with ``dt``, ``parameters`` (a NamedTuple), ``initial_state()`` (a
NamedTuple of arrays) and ``channels`` (names and widths of what it records). The functions below
are registered for the type of its parameters. A controller that uses derivatives of the reference
has their number as ``derivatives``.
"""

from __future__ import annotations

from typing import Any, Protocol

from quell.kernels.dispatch import generic, generic_with_default
from quell.types import Channels, Vector


class Controller(Protocol):
    """The part of a controller that simulation and real-time loop use."""

    @property
    def dt(self) -> float:
        """Sample time [s]."""

    @property
    def parameters(self) -> Any:
        """Parameters of the compiled functions, a NamedTuple."""

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the features whose coefficients are in the channel ``theta``."""

    @property
    def channels(self) -> Channels:
        """Name and width of each recorded channel, in order."""

    def initial_state(self) -> Any:
        """Return the state before the first sample: a NamedTuple of arrays."""


def check_controller(value: Any, name: str = "controller") -> None:
    """Raise a ``ValueError`` if ``value``, the argument ``name``, is not a controller."""
    if isinstance(value, type) or not hasattr(value, "initial_state"):
        raise ValueError(f"{name} = {value!r}: must be a controller, for example quell.ADRC(...)")


@generic
def control(controller: Any, state: Any, r: float, y: float) -> float:
    """Take one sample: return the control signal for reference ``r`` and measurement ``y``."""
    raise TypeError


@generic_with_default
def set_reference_derivatives(controller: Any, state: Any, derivatives: Vector) -> None:
    """Set r', r'', … for the next sample; ignored by a controller that does not use them."""


@generic
def write_row(controller: Any, state: Any, row: Vector) -> None:
    """Write the controller's ``channels`` into ``row``."""
    raise TypeError


@generic
def status_flags(controller: Any, state: Any) -> int:
    """Return the ``Status`` flags of the last sample."""
    raise TypeError


@generic
def reset_loop(controller: Any, state: Any) -> None:
    """Start from rest at the next sample; what was learned is kept."""
    raise TypeError


@generic
def set_applied_control(controller: Any, state: Any, u: float) -> None:
    """Replace the control signal of the last ``control`` by the applied ``u``.

    A controller with wide limits that receives, in every sample, what narrower limits leave of its
    control signal is equal to a controller with those narrower limits.
    """
    raise TypeError


@generic_with_default
def bumpless_transfer(controller: Any, state: Any) -> None:
    """Continue from the applied u at the next sample, as if the loop had been at rest until now.

    If the reference differs from y, the difference acts as a step of the reference. A controller
    whose state always follows the applied u needs no implementation.
    """
