"""What the driver asks of a controller.

A controller is an object with ``dt``, ``parameters`` (a NamedTuple), ``initial_state()`` (a NamedTuple of arrays) and ``channels`` (the
names of what it reports). For the type of its parameters the functions below are registered. A controller that wants derivatives of the
reference says how many with ``derivatives``.
"""

from __future__ import annotations

from typing import Any, Protocol

from quell.kernels.dispatch import generic
from quell.types import Vector


class Controller(Protocol):
    """The part of a controller that the driver uses."""

    @property
    def dt(self) -> float:
        """Sample time [s]."""

    @property
    def parameters(self) -> Any:
        """What the compiled functions need, a NamedTuple."""

    @property
    def features(self) -> tuple[str, ...]:
        """What the entries of the channel ``theta`` multiply, where there is one."""

    @property
    def channels(self) -> tuple[tuple[str, int], ...]:
        """Name and width of what ``report`` writes, in order."""

    def initial_state(self) -> Any:
        """Return the state before the first sample: a NamedTuple of arrays."""


def check_controller(value: Any, name: str = "controller") -> None:
    """Raise a ``ValueError`` if ``value``, the argument ``name``, is not a controller."""
    if isinstance(value, type) or not hasattr(value, "initial_state"):
        raise ValueError(f"{name} = {value!r}: must be a controller, for example quell.ADRC(...)")


@generic
def control(controller: Any, state: Any, r: float, y: float) -> float:
    """Take one sample: the control signal to apply for the reference ``r`` and the measurement ``y``."""
    raise TypeError


@generic
def set_reference_derivatives(controller: Any, state: Any, derivatives: Vector) -> None:
    """Take note of the reference's derivatives r', r'', … for the next sample; a controller without use for them does nothing."""
    raise TypeError


@set_reference_derivatives.register(object)
def _ignore_reference_derivatives(controller: Any, state: Any, derivatives: Vector) -> None:
    pass


@generic
def write_row(controller: Any, state: Any, row: Vector) -> None:
    """Write what the controller knows, as its ``channels`` say, into ``row``."""
    raise TypeError


@generic
def status_flags(controller: Any, state: Any) -> int:
    """Return the ``Status`` flags of the last sample."""
    raise TypeError


@generic
def reset_loop(controller: Any, state: Any) -> None:
    """Start from rest at the next sample, with what was learned."""
    raise TypeError


@generic
def set_applied_control(controller: Any, state: Any, u: float) -> None:
    """Say that ``u`` is applied until the next sample, not what the last ``control`` returned.

    A controller with wide limits that is told of narrower ones, sample after sample, is the controller with the narrower limits.
    """
    raise TypeError


@generic
def bumpless_transfer(controller: Any, state: Any) -> None:
    """Take over at the next sample from whoever applied u until now: u goes on from there as if the loop had been at rest.

    Where the reference then is elsewhere, it is a step of the reference. A controller that follows the applied u by itself does nothing.
    """
    raise TypeError


@bumpless_transfer.register(object)
def _follows_by_itself(controller: Any, state: Any) -> None:
    pass
