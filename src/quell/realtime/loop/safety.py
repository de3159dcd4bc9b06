"""Safety rules: when a running loop goes to its safe state, and how."""

from __future__ import annotations

import math
from dataclasses import dataclass

from quell import checks
from quell.controllers.base import Controller
from quell.realtime.loop.supervisor import Rules

# More samples than any run has.
_NEVER = 1 << 60


@dataclass(frozen=True)
class Safety:
    """Safety rules of a loop; ``quell.realtime.loop.supervisor`` describes its states.

    Parameters
    ----------
    u_min, u_max
        limits of the u that is sent to the device [u-unit], with zero, the safe u, between them;
        the controller's own by default. If both are given, the narrower ones hold. A loop without
        any limit is refused.
    most_error
        largest ``|r − y|`` [y-unit]; beyond it u is ramped to zero.
    most_f
        largest ``|f̂|`` [y-unit/s^n], if the controller reports one; beyond it u is ramped to zero.
    most_saturated
        number of samples in a row for which u may lie at one of its limits; any by default.
    hold
        number of samples in a row for which u is held if no good measurement comes, the loop itself
        stands still, or the device can't be reached; after that u is ramped to zero.
    most_overruns
        number of cycles in a row that may take longer than a sample.
    ramp
        number of samples in which u goes to zero.
    settle
        number of samples for which the controller observes, with u at zero, before it takes over.

    Raises
    ------
    ValueError
        for limits without zero between them, or numbers out of range.
    """

    u_min: float = -math.inf
    u_max: float = math.inf
    most_error: float = math.inf
    most_f: float = math.inf
    most_saturated: int | None = None
    # Chosen by hand; not tuned further: hold must be shorter than the device's watchdog (20 ticks
    # for a rig), and settle as long as the observer needs.
    hold: int = 5
    most_overruns: int = 5
    ramp: int = 50
    settle: int = 200

    def __post_init__(self) -> None:
        _check_around_zero(*checks.interval("u_min", self.u_min, "u_max", self.u_max))
        for name in ("most_error", "most_f"):
            value = getattr(self, name)
            if value != math.inf:
                checks.positive(name, value)
        if self.most_saturated is not None:
            checks.whole("most_saturated", self.most_saturated, 1)
        for name, least in (("hold", 0), ("most_overruns", 0), ("ramp", 1), ("settle", 1)):
            checks.whole(name, getattr(self, name), least)

    def rules(self, controller: Controller) -> Rules:
        """Return the supervisor's rules for a controller, with the narrower limits of both.

        Raises
        ------
        ValueError
            if u has no finite limits, or zero is not between them.
        """
        own = getattr(controller, "limits", None)
        low = max(float(self.u_min), -math.inf if own is None else own.low)
        high = min(float(self.u_max), math.inf if own is None else own.high)
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ValueError(
                f"u_min = {low!r}, u_max = {high!r}: must be finite for a real device; "
                "give u_min and u_max to the controller or to quell.realtime.Safety"
            )
        _check_around_zero(low, high)
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


def _check_around_zero(low: float, high: float) -> None:
    if not low <= 0.0 <= high or low == high:
        raise ValueError(
            f"u_min = {low!r}, u_max = {high!r}: must have zero, the safe u, between them"
        )
