"""Safety rules of a run, its default bounds, and the samples of its reference.

Safety rules: when a running loop goes to its safe state, and how.

The reference of a run: its samples, and the approach to it from the first y.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quell import checks
from quell.controllers import ADRC, Axes
from quell.controllers.base import Controller
from quell.controllers.compensated import takes_control
from quell.controllers.prefilters import without_prefilters
from quell.controllers.several import axes_of, inputs_of, outputs_of, references_of
from quell.kernels.sized import Buffer
from quell.realtime.supervisor import Rules, RunLimits
from quell.records.record import in_steps
from quell.signals import as_signal
from quell.simulation.scenario import Scenario, derivatives_in
from quell.types import Matrix, Vector

# ---- Default bounds of y, derived from the reference and from what the control signal can do ----

# Default distance from the reference's range to a bound of y, in units of that range plus the reach
# of u. In 1500 random stable loops with loads of up to 0.9 of u's limit, y left the range by at
# most 6.5 of these units (two seeds of benchmarks/direction.py).
_MARGIN = 10.0
# The same without a known b0, times the largest of 1 and |r|: as the limit of ``simulate``.
_MARGIN_WITHOUT_MODEL = 1e6


def reach(controller: Controller, v_low: float, v_high: float) -> float:
    """Return the error at which the law ``k1 e`` alone puts v = b0 u to its limit [y-unit].

    With all poles at −omega_c it is ``max|v| / omega_c^m``. It is the scale of motions of y that
    are within the power of u: a load that u can hold moves y by a part of it. NaN for a controller
    that is not an ADRC, possibly behind prefilters.
    """
    adrc = inner_adrc(controller)
    if adrc is None:
        return float("nan")
    return float(max(abs(v_low), abs(v_high)) / adrc.parameters.law[0])


def inner_adrc(controller: Any) -> ADRC | None:
    """Return the ADRC behind all prefilters; None for another controller."""
    while not isinstance(controller, ADRC):
        controller = getattr(controller, "controller", None)
        if controller is None:
            return None
    return controller


# Score at which the check of a compensator's b0 ends the run, in lag times of its observer
# (``quell.realtime.supervisor``): honest loops came to 5.8.
_OPPOSED = 8.0


def _gain_of(controller: Any) -> float:
    """Return b0 of an ADRC or a compensator, also behind prefilters; 1 of another controller."""
    found: Any = inner_adrc(controller)
    inner = getattr(controller, "controller", controller)
    if found is None and takes_control(inner):
        found = inner
    return 1.0 if found is None else float(found.observer.b0)


def most_opposed(controller: Any) -> float:
    """Return the largest score of the check of b0 [samples]; infinite for none.

    That is of a compensator alone, without a table of b0.
    """
    inner = getattr(controller, "controller", controller)
    if not takes_control(inner) or getattr(inner.schedule, "b0", inner.schedule) is not None:
        return math.inf
    return float(_OPPOSED * inner.observer.lag_time / inner.dt)


def plausible_range(reference: ArrayLike, reach: float) -> tuple[float, float]:
    """Return bounds of y that a good run does not come near to [y-unit].

    ``reference`` are the samples of the reference, and ``reach`` is that of ``reach``. Zero counts
    as a value of the reference because a run usually begins there.
    """
    r = np.append(np.asarray(reference, dtype=float), 0.0)
    low, high = float(np.min(r)), float(np.max(r))
    if np.isfinite(reach):
        margin = _MARGIN * (high - low + reach)
    else:
        margin = _MARGIN_WITHOUT_MODEL * max(1.0, -low, high)
    return low - margin, high + margin


# ---- The reference of a run ----

# A record of so many samples with twenty channels takes 1.6 GB.
_MOST_SAMPLES = 10_000_000
# s(τ) of the least jerk from rest at 0 to rest at 1 (Flash & Hogan, J. Neuroscience 5, 1985, (3)).
_LEAST_JERK = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])


def check_takes_reference(controller: Any) -> None:
    """Raise a ``ValueError`` for compensators alone, which take u_0 in the place of a reference."""
    if isinstance(controller, Axes):
        if controller.takes_u_0:
            raise ValueError(
                "controller = Axes of Compensators: takes u_0 of a host, not a reference; give it "
                "the controllers of u_0 as quell.Axes(…, drives=…)"
            )
    elif takes_control(without_prefilters(getattr(controller, "controller", controller))):
        raise ValueError(
            "controller = Compensator: takes u_0 of a host, not a reference; run it between "
            "host and drive (quell proxy), or with its controller as quell.Compensated"
        )


class ReferenceSamples(NamedTuple):
    """The references for all samples of a run: code is not compiled for each duration."""

    r: Buffer  # (samples, n) [y-unit]
    derivatives: Buffer  # (samples, d): those of the first axis, r', r'', …, then of the second …
    approach: Buffer  # (·, 1 + most of an axis): ``approach_curve`` for a distance of 1
    current: Vector  # work array: derivatives of one sample (d,)
    given: Vector  # what the controller gets in one sample (n,)
    counts: NDArray[np.int64]  # derivatives of each axis (n,)


def reference_samples(scenario: Scenario, controller: Any, approach: float) -> ReferenceSamples:
    """Return a controller's references for every sample, and their approach [s]."""
    r, derivatives = reference_columns(scenario, controller)
    own: Any = getattr(controller, "derivatives", 0)
    counts = np.array(own if isinstance(own, tuple) else (own,), dtype=np.int64)
    time = checks.non_negative("approach", approach, "s")
    curve = approach_curve(controller.dt, time, int(np.max(counts)))
    current, given = np.zeros(derivatives.shape[1]), np.zeros(r.shape[1])
    return ReferenceSamples(r, derivatives, curve, current, given, counts)


def reference_columns(scenario: Scenario, controller: Any) -> tuple[Matrix, Matrix]:
    """Return a controller's references (samples, n), and their derivatives (samples, d)."""
    dt = controller.dt
    if scenario.duration / dt > _MOST_SAMPLES:
        times = f"duration = {scenario.duration!r} s with dt = {dt!r} s"
        raise ValueError(f"{times}: must be at most {_MOST_SAMPLES:.0e} samples")
    t = np.asarray(np.arange(math.floor(in_steps(scenario.duration, dt)) + 1) * dt)
    counts = references_of(controller), len(scenario.disturbances), outputs_of(controller)
    signals, _, _ = scenario.seeded(*counts)
    derivatives = derivatives_in(signals, controller)
    columns = [
        np.column_stack([each(t) for each in part]) if part else np.zeros((t.size, 0))
        for part in (signals, derivatives)
    ]
    names = getattr(controller, "names", None)
    for i in range(len(signals)):
        _check_finite(f"reference of {names[i]}" if names else "reference", columns[0][:, [i]], t)
    _check_finite("reference", columns[1], t)
    return columns[0], columns[1]


def _check_finite(name: str, columns: Matrix, t: Vector) -> None:
    finite = np.isfinite(columns).all(axis=1)
    if not finite.all():
        raise ValueError(
            f"{name}: it or one of its derivatives is not finite at {t[np.argmin(finite)]:.6g} s"
        )


def as_scenario(value: Any, duration: float | None) -> Scenario:
    """Return a scenario, or make one of a reference that takes ``duration`` [s]."""
    if not isinstance(value, Scenario):
        if duration is None:
            raise ValueError("duration = None: give the duration [s], or a quell.Scenario")
        if checks.is_sequence(value):
            many = tuple(as_signal(each, f"scenario[{i}]") for i, each in enumerate(value))
            return Scenario(many, duration)
        return Scenario(as_signal(value, "scenario"), duration)
    if value.rest_at:
        raise ValueError(
            f"rest_at = {value.rest_at!r}: a real plant can't be put back to rest; leave it out"
        )
    return value if duration is None else Scenario(value.reference, duration, seed=value.seed)


def approach_curve(dt: float, time: float, derivatives: int) -> Matrix:
    """Return ``1 − s(t / time)`` and its derivatives before ``time`` [s], (·, 1 + derivatives)."""
    scale = time or 1.0
    tau = np.arange(math.ceil(in_steps(time, dt)) if time else 0) * dt / scale
    rest = 1.0 - _LEAST_JERK
    return np.column_stack(
        [(rest.deriv(i) if i else rest)(tau) / scale**i for i in range(derivatives + 1)]
    )


# ---- Safety rules ----

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


# Fields of ``Safety`` that may have a number for each signal, in the order of their checks.
_FOR_EACH = ("u_min", "u_max", "most_error", "most_f", "y_min", "y_max")
Limit: TypeAlias = float | Sequence[float]
"""A number, or of several axes a list of numbers."""


@dataclass(frozen=True)
class Safety:
    """Safety rules of a loop; ``quell.realtime.supervisor`` describes its states.

    Of several axes, limits of u may be lists with one for each actuator, and those of y, of the
    error and of f̂ lists with one for each axis; a number holds for all.

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
        (``quell.realtime.supervisor``); only for controllers with a b0. Of a compensator: if y goes
        against b0 u while u is at a limit.

    Raises
    ------
    ValueError
        for limits without zero between them, numbers out of range, or a number given both in
        samples and in seconds.
    """

    u_min: Limit = -math.inf
    u_max: Limit = math.inf
    most_error: Limit = math.inf
    most_f: Limit = math.inf
    most_saturated: int | None = None
    hold: int | None = None
    most_overruns: int | None = None
    ramp: int | None = None
    settle: int | None = None
    y_min: Limit | None = None
    y_max: Limit | None = None
    hold_time: float | None = None
    overrun_time: float | None = None
    ramp_time: float | None = None
    settle_time: float | None = None
    saturated_time: float | None = None
    check_direction: bool = True

    def __post_init__(self) -> None:
        for name in _FOR_EACH:
            if checks.is_sequence(value := getattr(self, name)):
                if not value or None in value:
                    rule = "must be a number, or a list of numbers, one for each"
                    raise ValueError(f"{name} = {value!r}: {rule}; infinite ones are no limits")
                object.__setattr__(self, name, tuple(value))  # lists have no hash
        lists = [value for name in _FOR_EACH if isinstance(value := getattr(self, name), tuple)]
        for i in range(max(map(len, lists), default=1)):
            u_min, u_max, most_error, most_f, y_min, y_max = (
                self._of(i, name) for name in _FOR_EACH
            )
            _check_around_zero(*checks.interval("u_min", u_min, "u_max", u_max))
            checks.interval(
                *("y_min", -math.inf if y_min is None else y_min),
                *("y_max", math.inf if y_max is None else y_max),
            )
            for name, value in (("most_error", most_error), ("most_f", most_f)):
                checks.positive_or_infinite(name, value)
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

    def _of(self, i: int, name: str) -> Any:
        """Return a limit of the i-th signal; a list that is shorter says no more there."""
        value = getattr(self, name)
        if not isinstance(value, tuple):
            return value
        return value[min(i, len(value) - 1)]

    def rules(self, controller: Any, scenario: Scenario | None = None) -> Rules:
        """Return the supervisor's rules for a controller, with the narrower limits of both.

        The default bounds of y come from the reference of ``scenario``; without one there are none.

        Raises
        ------
        ValueError
            if u has no finite limits, zero is not between them, or a list is not as long as there
            are signals.
        """
        axes = controller if isinstance(controller, Axes) else None
        own: Any = getattr(controller, "limits", None)
        n, m = outputs_of(controller), inputs_of(controller)
        low, high = self._each("u_min", m, axes), self._each("u_max", m, axes)
        if own is not None:
            low, high = np.maximum(low, own.low), np.minimum(high, own.high)
        if not np.all(np.isfinite([low, high])):
            u_min, u_max = (each.tolist() if axes else float(each[0]) for each in (low, high))
            raise ValueError(
                f"u_min = {u_min!r}, u_max = {u_max!r}: must be finite for a real device; "
                "give u_min and u_max to the controller or to quell.realtime.Safety"
            )
        for pair in zip(low.tolist(), high.tolist(), strict=True):
            _check_around_zero(*pair)
        parts = list(axes_of(controller).values())
        adrcs = [inner_adrc(part) for part in parts]
        opposed = np.full(n, math.inf)
        if self.check_direction and getattr(controller, "takes_u_0", True):
            opposed = np.array([most_opposed(part) for part in parts])
        b0 = np.array([_gain_of(part) for part in parts])
        ends = np.diag(b0) if axes is None else axes.first_gain
        ends = np.sort([ends * low, ends * high], axis=0)  # what each u does at its limits
        v_low, v_high = ends[0].sum(axis=1), ends[1].sum(axis=1)
        scale = np.array([reach(*each) for each in zip(parts, v_low, v_high, strict=True)])
        bounds = np.tile([[-math.inf], [math.inf]], n)
        if scenario is not None:
            columns = reference_columns(scenario, controller)[0].T
            ranges = [plausible_range(*pair) for pair in zip(columns, scale, strict=True)]
            bounds = np.array(ranges).T
        y_low, y_high = (
            bounds[i] if getattr(self, name) is None else self._each(name, n, axes)
            for i, name in enumerate(("y_min", "y_max"))
        )
        watched = [self.check_direction and adrc is not None for adrc in adrcs]
        counts = {count.samples: self._samples(count, controller.dt) for count in _COUNTS}
        more = max(round(_START_MORE / controller.dt), _START_SAMPLES)
        return Rules(
            axes.names if axes else (),
            RunLimits(
                low=low,
                high=high,
                most_error=self._each("most_error", n, axes),
                most_f=self._each("most_f", n, axes),
                y_low=y_low,
                y_high=y_high,
                direction=np.array(watched, dtype=float),
                reach=scale,
                b0=b0,
                v_low=v_low,
                v_high=v_high,
                most_opposed=opposed,
                **counts | {"longest_start": _START_FACTOR * counts["settle"] + more},
            ),
        )

    def _each(self, name: str, count: int, axes: Axes | None) -> Vector:
        """Return a limit of each signal, of several ``axes`` or of one."""
        value = getattr(self, name)
        if not isinstance(value, tuple):
            return np.full(count, float(value))
        if axes is None:
            raise ValueError(
                f"{name} = {list(value)!r}: must be one number; lists are for several axes"
            )
        if len(value) != count:
            what = "actuators" if name in ("u_min", "u_max") else "axes"
            raise ValueError(
                f"{name} = {list(value)!r}: there are {count} {what}; must be one number for all, "
                "or one for each"
            )
        return np.array(value, dtype=float)

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


def default_hold(dt: float) -> int:
    """Return the default of ``Safety.hold`` for a sample time ``dt`` [s]."""
    return Safety()._samples(_COUNTS[0], dt)


def _check_around_zero(low: float, high: float) -> None:
    if not low <= 0.0 <= high or low == high:
        raise ValueError(
            f"u_min = {low!r}, u_max = {high!r}: must have zero, the safe u, between them"
        )
