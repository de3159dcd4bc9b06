"""The limits and numbers of samples that decide when a running loop goes to its safe state."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from quell import checks
from quell.realtime.loop.supervisor import Rules

# More than any run has.
_NEVER = 1 << 60


@dataclass(frozen=True)
class Safety:
    """When the loop goes to its safe state, and how; see ``quell.realtime.loop.supervisor`` for what the states are.

    Parameters
    ----------
    u_min, u_max
        limits of what is sent to the device [u-unit], around zero, which is the safe u; the controller's own by default. Where both are
        given, the narrower ones hold. Without any limit no loop is closed.
    most_error
        largest ``|r − y|`` [y-unit]; beyond it u is ramped to zero.
    most_f
        largest ``|f̂|`` [y-unit/s^n] of a controller that reports one; beyond it u is ramped to zero.
    most_saturated
        for how many samples in a row u may lie at one of its limits; without end by default.
    hold
        for how many samples in a row u is held, where no good measurement comes, the loop itself stands still, or the device can't be
        reached; after that u is ramped to zero.
    most_overruns
        how many cycles in a row may take longer than a sample.
    ramp
        in how many samples u goes to zero.
    settle
        for how many samples the controller watches, with u at zero, before it takes over.

    Raises
    ------
    ValueError
        for limits that do not lie around zero, or numbers out of range.
    """

    u_min: float = -math.inf
    u_max: float = math.inf
    most_error: float = math.inf
    most_f: float = math.inf
    most_saturated: int | None = None
    hold: int = 5
    most_overruns: int = 5
    ramp: int = 50
    settle: int = 200

    def __post_init__(self) -> None:
        _around_zero(*checks.interval("u_min", self.u_min, "u_max", self.u_max))
        for name in ("most_error", "most_f"):
            value = getattr(self, name)
            if value != math.inf:
                checks.positive(name, value)
        if self.most_saturated is not None:
            checks.whole("most_saturated", self.most_saturated, 1)
        for name, least in (("hold", 0), ("most_overruns", 0), ("ramp", 1), ("settle", 1)):
            checks.whole(name, getattr(self, name), least)

    def rules(self, controller: Any) -> Rules:
        """Return what the supervisor goes by around a controller.

        Raises
        ------
        ValueError
            where u has no finite limits, or they do not lie around zero.
        """
        own = getattr(controller, "limits", None)
        low = max(float(self.u_min), -math.inf if own is None else own.low)
        high = min(float(self.u_max), math.inf if own is None else own.high)
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ValueError(
                f"u_min = {low!r}, u_max = {high!r}: must be finite for a real device; "
                "give u_min and u_max to the controller or to quell.realtime.Safety"
            )
        _around_zero(low, high)
        return Rules(
            low=low,
            high=high,
            most_error=float(self.most_error),
            most_f=float(self.most_f),
            hold=self.hold,
            ramp=self.ramp,
            settle=self.settle,
            most_saturated=_NEVER if self.most_saturated is None else self.most_saturated,
            most_overruns=self.most_overruns,
        )


def _around_zero(low: float, high: float) -> None:
    if not low <= 0.0 <= high or low == high:
        raise ValueError(
            f"u_min = {low!r}, u_max = {high!r}: zero, which is what u goes to where something fails, must lie within"
        )
