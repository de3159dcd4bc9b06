"""The features of a linear model: the state, the control signal, a constant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from quell import checks
from quell.features.base import Features, dimensionless, unit, write
from quell.kernels.sized import Size
from quell.types import Vector


class StateDesign(NamedTuple):
    """Parameters of ``State``."""

    width: Size


@dataclass(frozen=True)
class State(Features):
    """The estimated output and its derivatives, ``x̂_1 … x̂_count``.

    Parameters
    ----------
    count
        number of states; all n by default.
    """

    count: int | None = None

    def __post_init__(self) -> None:
        checks.optional(checks.whole, "count", self.count, 1)

    def design(self, order: int) -> StateDesign:
        """Return the number of states."""
        if self.count is not None and self.count > order:
            raise ValueError(f"count = {self.count}: a plant of order {order} has {order} states")
        return StateDesign(order if self.count is None else self.count)

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …)``."""
        return tuple(f"x{i + 1}" for i in range(self.design(order).width))


@write.register(StateDesign)
def _write_state(features: StateDesign, x: Vector, u: float, out: Vector) -> None:
    for i in range(features.width):
        out[i] = x[i]


@unit.register(StateDesign)
def _unit_state(features: StateDesign, scale: Vector, out: Vector) -> None:
    for i in range(features.width):
        out[i] = 1.0 / scale[i]


class BiasDesign(NamedTuple):
    """Parameters of ``Bias``: none."""


@dataclass(frozen=True)
class Bias(Features):
    """The constant 1."""

    def design(self, order: int) -> BiasDesign:
        """Return no parameters."""
        return BiasDesign()

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("bias",)``."""
        return ("bias",)

    def constant(self, order: int) -> int:
        """Return 0, the index of the only feature."""
        return 0


@write.register(BiasDesign)
def _write_bias(features: BiasDesign, x: Vector, u: float, out: Vector) -> None:
    out[0] = 1.0


unit.register(BiasDesign)(dimensionless)


class InputDesign(NamedTuple):
    """Parameters of ``Input``: none."""


@dataclass(frozen=True)
class Input(Features):
    """The applied control signal u. It must be the last block.

    A linear learner solves the loop through u exactly and keeps the effective gain in an interval;
    other learners get the u of the sample before.
    """

    def design(self, order: int) -> InputDesign:
        """Return no parameters."""
        return InputDesign()

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("u",)``."""
        return ("u",)

    @property
    def has_input(self) -> bool:
        """True: the last feature is u."""
        return True


@write.register(InputDesign)
def _write_input(features: InputDesign, x: Vector, u: float, out: Vector) -> None:
    out[0] = u


@unit.register(InputDesign)
def _unit_input(features: InputDesign, scale: Vector, out: Vector) -> None:
    out[0] = 1.0 / scale[scale.size - 2]
