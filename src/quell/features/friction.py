"""Dry friction: what depends on the direction of motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from quell import checks
from quell.features.base import Features, unit, write
from quell.features.states import StateIndices, check_states, state_indices
from quell.types import Vector


class FrictionDesign(NamedTuple):
    """Parameters of ``Friction``."""

    states: StateIndices
    width: float
    sign: bool


@dataclass(frozen=True)
class Friction(Features):
    """Coulomb friction, smoothed: ``tanh(v/width)``, for each velocity v.

    Parameters
    ----------
    width
        over which the friction reverses, as a share of the largest velocity. The estimated velocity lags the true one, and its noise
        must not flip the feature: rather too wide than too narrow.
    sign
        whether ``sign(v)`` is a feature too.
    states
        the velocities, counted from 1; x_2 by default.

    Raises
    ------
    ValueError
        for a width that is not positive, or a plant without a velocity.

    References
    ----------
    Armstrong-Hélouvry, Dupont & Canudas de Wit, *A survey of models, analysis tools and compensation methods for the control of machines
    with friction*, Automatica 30 (1994), section 2.
    """

    width: float = 0.05
    sign: bool = False
    states: Sequence[int] = (2,)

    def __post_init__(self) -> None:
        checks.positive("width", self.width)
        checks.flag("sign", self.sign)
        check_states(self.states)

    def design(self, order: int) -> FrictionDesign:
        """Return where the velocities are, and how friction reverses."""
        return FrictionDesign(state_indices(self.states, order), float(self.width), bool(self.sign))

    def names(self, order: int) -> tuple[str, ...]:
        """Return ``("tanh(x2/0.05)",)``, and ``"sign(x2)"`` after each where that is a feature."""
        return tuple(
            name
            for i in state_indices(self.states, order)
            for name in (
                f"tanh(x{i + 1}/{self.width:g})",
                *([f"sign(x{i + 1})"] if self.sign else []),
            )
        )


@write.register(FrictionDesign)
def _write(features: FrictionDesign, x: Vector, u: float, out: Vector) -> None:
    at = 0
    for k in range(features.states.size):
        velocity = x[features.states[k]]
        out[at] = math.tanh(velocity / features.width)
        at += 1
        if features.sign:
            out[at] = 1.0 if velocity > 0.0 else (-1.0 if velocity < 0.0 else 0.0)
            at += 1


@unit.register(FrictionDesign)
def _unit(features: FrictionDesign, scale: Vector, out: Vector) -> None:
    for j in range(features.states.size * (2 if features.sign else 1)):
        out[j] = 1.0
