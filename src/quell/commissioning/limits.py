"""The limits of an experiment at a rig."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from quell import checks


@dataclass(frozen=True)
class Limits:
    """Limits of an experiment; beyond those of y, u is ramped to zero.

    Parameters
    ----------
    u_min, u_max
        limits of u, with zero, the safe u, between them [u-unit].
    y_min, y_max
        limits of y [y-unit].
    duration
        time of the whole experiment under control, without the waiting before each part [s].
    u_rest
        u at the operating point, within its limits [u-unit].

    Raises
    ------
    ValueError
        for numbers out of range.
    """

    u_min: float
    u_max: float
    y_min: float
    y_max: float
    duration: float
    u_rest: float = 0.0

    def __post_init__(self) -> None:
        for low, high in (("u_min", "u_max"), ("y_min", "y_max")):
            values = checks.interval(low, getattr(self, low), high, getattr(self, high))
            if not all(map(math.isfinite, values)):
                raise ValueError(f"{low}, {high} = {values}: must be finite for an experiment")
        if not self.u_min <= 0.0 <= self.u_max:
            raise ValueError(
                f"u_min = {self.u_min!r}, u_max = {self.u_max!r}: must have zero, the safe u, "
                "between them"
            )
        checks.positive("duration", self.duration, "s")
        if not self.u_min < checks.finite("u_rest", self.u_rest) < self.u_max:
            raise ValueError(f"u_rest = {self.u_rest!r}: must be between u_min and u_max")

    @property
    def of_u(self) -> dict[str, Any]:
        """``u_min`` and ``u_max``, as arguments of controllers and of ``Safety``."""
        return {"u_min": self.u_min, "u_max": self.u_max}

    @property
    def u_room(self) -> float:
        """Amplitude of u around the operating point that both limits leave [u-unit]."""
        return min(self.u_max - self.u_rest, self.u_rest - self.u_min) or max(
            self.u_max - self.u_rest, self.u_rest - self.u_min
        )

    def y_room(self, y: float) -> float:
        """Return the distance of ``y`` to its nearer limit [y-unit], negative outside."""
        return min(self.y_max - y, y - self.y_min)

    def __str__(self) -> str:
        """Return the limits as text."""
        return (
            f"u from {self.u_min:g} to {self.u_max:g}, y from {self.y_min:g} to {self.y_max:g}, "
            f"{self.duration:g} s"
        )
