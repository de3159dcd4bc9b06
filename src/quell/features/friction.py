"""Dry friction: features that depend on the direction of motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from quell import checks
from quell.features.base import (
    Features,
    dimensionless,
    unit,
    write,
    write_nothing,
    write_physical,
)
from quell.features.states import StateIndices, check_states, state_indices
from quell.kernels.functions import tanh
from quell.kernels.sized import Flag
from quell.types import Vector


class FrictionDesign(NamedTuple):
    """Parameters of ``Friction``."""

    states: StateIndices
    width: float
    sign: Flag


class FrictionAtSpeedDesign(NamedTuple):
    """Parameters of ``Friction`` with a ``speed``."""

    states: StateIndices
    width: float  # in the units of the velocities
    sign: Flag


@dataclass(frozen=True)
class Friction(Features):
    """Coulomb friction, smoothed: ``tanh(v/width)``, for each velocity v.

    Parameters
    ----------
    width
        velocity over which the friction reverses, as a share of the largest velocity. Because the
        estimated velocity lags and its noise must not flip the feature, choose it too wide rather
        than too narrow.
    sign
        whether ``sign(v)`` is a feature too.
    states
        numbers of the velocities among the states, from 1; x_2 by default.
    speed
        in place of ``width``, the velocity over which the friction reverses, in the units of the
        plant. Use it where y grows without bound, as the angle of a shaft does: the largest
        velocity that a learner expects grows with y.

    Raises
    ------
    ValueError
        for a width or speed that is not positive, or a plant without a velocity.

    References
    ----------
    Armstrong-Hélouvry, Dupont & Canudas de Wit, *A survey of models, analysis tools and
    compensation methods for the control of machines with friction*, Automatica 30 (1994), section
    2.
    """

    width: float = 0.05
    sign: bool = False
    states: Sequence[int] = (2,)
    speed: float | None = None

    def __post_init__(self) -> None:
        checks.positive("width", self.width)
        checks.optional(checks.positive, "speed", self.speed)
        checks.flag("sign", self.sign)
        check_states(self.states)

    @property
    def _width(self) -> float:
        return float(self.width if self.speed is None else self.speed)

    def design(self, order: int) -> FrictionDesign | FrictionAtSpeedDesign:
        """Return the indices of the velocities, the width and whether there are signs."""
        design = FrictionDesign if self.speed is None else FrictionAtSpeedDesign
        return design(state_indices(self.states, order), self._width, bool(self.sign))

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("tanh(x2/0.05)",)``, with ``"sign(x2)"`` after each if ``sign`` is set."""
        names: list[str] = []
        for i in state_indices(self.states, order):
            names.append(f"tanh(x{i + 1}/{self._width:g})")
            if self.sign:
                names.append(f"sign(x{i + 1})")
        return tuple(names)


@write.register(FrictionDesign)
@write_physical.register(FrictionAtSpeedDesign)
def _write(features: Any, x: Vector, u: float, out: Vector) -> None:
    at = 0
    for k in range(features.states.size):
        velocity = x[features.states[k]]
        out[at] = tanh(velocity / features.width)
        at += 1
        if features.sign:
            out[at] = 1.0 if velocity > 0.0 else (-1.0 if velocity < 0.0 else 0.0)
            at += 1


write.register(FrictionAtSpeedDesign)(write_nothing)
unit.register(FrictionDesign)(dimensionless)
unit.register(FrictionAtSpeedDesign)(dimensionless)
