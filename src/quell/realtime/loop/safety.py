"""Safety rules: when a running loop goes to its safe state, and how."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from quell import checks
from quell.controllers.base import Controller
from quell.realtime.loop.bounds import inner_adrc, plausible_range, reach
from quell.realtime.loop.reference import reference_samples
from quell.realtime.loop.state import Rules
from quell.simulation.scenario import Scenario

# More samples than any run has.
_NEVER = 1 << 60


class _Count(NamedTuple):
    """A number of samples that is also given, by another field, as a time."""

    samples: str  # field that counts samples
    time: str  # field in seconds
    default: float  # [s]
    least: int  # least samples of the default
    fewest: int  # least value of the field that counts samples


# Defaults chosen by hand for 1 kHz: hold must be shorter than the device's watchdog (20 ticks for a
# rig), and settle as long as the observer needs. A slower loop gets at least so many samples that
# one late cycle ends no run (hold, most_overruns), u goes down in small steps (ramp), and an
# observer with omega_o dt = 0.3 has settled (settle).
_COUNTS = (
    _Count("hold", "hold_time", 0.005, 5, 0),
    _Count("most_overruns", "overrun_time", 0.005, 5, 0),
    _Count("ramp", "ramp_time", 0.05, 10, 1),
    _Count("settle", "settle_time", 0.2, 20, 1),
    _Count("most_saturated", "saturated_time", math.inf, _NEVER, 1),
)
# START may take ten times as long as settle and a second more, or ten samples: enough for a device
# that misses some. Chosen by hand; not tuned further.
_START_FACTOR, _START_MORE, _START_SAMPLES = 10, 1.0, 10


@dataclass(frozen=True)
class Safety:
    """Safety rules of a loop; ``quell.realtime.loop.supervisor`` describes its states.

    Times are rounded to whole samples, at least one. Their defaults are for 1 kHz and hold down to
    a number of samples, so that slow loops get enough of them.

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
    y_min, y_max
        plausible range of y [y-unit]; beyond it u is ramped to zero. By default the range of the
        reference and zero, wider by ten times the sum of that range and of the error at which the
        law puts u to its limit, ``b0 max|u| / omega_c^m``; for a controller without b0 by a million
        times the largest ``|r|`` or 1. Infinite for no limit.
    hold_time
        ``hold`` in seconds; 0.005 s by default, at least five samples.
    overrun_time
        ``most_overruns`` as the time that so many samples take [s]; 0.005 s by default, at least
        five samples.
    ramp_time
        ``ramp`` in seconds; 0.05 s by default, at least ten samples.
    settle_time
        ``settle`` in seconds; 0.2 s by default, at least twenty samples.
    saturated_time
        ``most_saturated`` in seconds; any time by default.
    check_direction
        whether u is ramped to zero if y first moves, and runs away, against the sign of b0 u
        (``quell.realtime.loop.direction``); only for controllers with a b0.

    Raises
    ------
    ValueError
        for limits without zero between them, numbers out of range, or a number given both in
        samples and in seconds.
    """

    u_min: float = -math.inf
    u_max: float = math.inf
    most_error: float = math.inf
    most_f: float = math.inf
    most_saturated: int | None = None
    hold: int | None = None
    most_overruns: int | None = None
    ramp: int | None = None
    settle: int | None = None
    y_min: float | None = None
    y_max: float | None = None
    hold_time: float | None = None
    overrun_time: float | None = None
    ramp_time: float | None = None
    settle_time: float | None = None
    saturated_time: float | None = None
    check_direction: bool = True

    def __post_init__(self) -> None:
        _check_around_zero(*checks.interval("u_min", self.u_min, "u_max", self.u_max))
        checks.interval(
            *("y_min", -math.inf if self.y_min is None else self.y_min),
            *("y_max", math.inf if self.y_max is None else self.y_max),
        )
        for name in ("most_error", "most_f"):
            value = getattr(self, name)
            if value != math.inf:
                checks.positive(name, value)
        for count in _COUNTS:
            samples, time = getattr(self, count.samples), getattr(self, count.time)
            checks.optional(checks.whole, count.samples, samples, count.fewest)
            checks.optional(checks.positive, count.time, time, "s")
            if samples is not None and time is not None:
                raise ValueError(
                    f"{count.samples} = {samples!r}, {count.time} = {time!r}: give one of them, "
                    f"{count.samples} in samples or {count.time} in seconds"
                )
        checks.flag("check_direction", self.check_direction)

    def rules(self, controller: Controller, scenario: Scenario | None = None) -> Rules:
        """Return the supervisor's rules for a controller, with the narrower limits of both.

        The default bounds of y come from the reference of ``scenario``; without one there are none.

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
        scale = reach(controller, low, high)
        y_low, y_high = -math.inf, math.inf
        if scenario is not None:
            r = reference_samples(scenario, controller.dt, 0, 0.0).r
            y_low, y_high = plausible_range(r, scale)
        adrc = inner_adrc(controller) if self.check_direction else None
        counts = {count.samples: self._samples(count, controller.dt) for count in _COUNTS}
        more = max(round(_START_MORE / controller.dt), _START_SAMPLES)
        return Rules(
            low=low,
            high=high,
            most_error=float(self.most_error),
            most_f=float(self.most_f),
            **counts,
            y_low=y_low if self.y_min is None else float(self.y_min),
            y_high=y_high if self.y_max is None else float(self.y_max),
            longest_start=_START_FACTOR * counts["settle"] + more,
            direction=0.0 if adrc is None else math.copysign(1.0, adrc.parameters.b0),
            reach=scale,
        )

    def _samples(self, count: _Count, dt: float) -> int:
        """Return a number of samples for the sample time ``dt`` [s]."""
        samples, time = getattr(self, count.samples), getattr(self, count.time)
        if samples is not None:
            return int(samples)
        if time is not None:
            return min(max(round(time / dt), 1), _NEVER)
        return (
            count.least
            if math.isinf(count.default)
            else max(round(count.default / dt), count.least)
        )


def _check_around_zero(low: float, high: float) -> None:
    if not low <= 0.0 <= high or low == high:
        raise ValueError(
            f"u_min = {low!r}, u_max = {high!r}: must have zero, the safe u, between them"
        )
