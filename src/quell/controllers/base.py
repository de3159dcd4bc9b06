"""The interface of a controller to the simulation and to the real-time loop.

A controller is an object with ``dt``, ``parameters`` (a NamedTuple), ``initial_state()`` (a
NamedTuple of arrays) and ``channels`` (names and widths of what it records). The functions below
are registered for the type of its parameters. A controller that uses derivatives of the reference
has their number as ``derivatives``.

Replacement of references and measurements that are not numbers of any physical quantity.

What is not finite, or beyond 1e60, counts as missing. Arithmetic with larger numbers would overflow
in squares, and an observer would need longer to return from them. In single precision, whose
numbers end at 3.4e38, the limit is 1e12.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

from quell import checks
from quell.checks import LARGEST_SIGNAL
from quell.kernels.dispatch import generic, generic_with_default, is_finite, kernel
from quell.kernels.functions import is_single
from quell.types import Channels, Status, Vector

# ---- The interface of a controller to the simulation and to the real-time loop ----


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


def check_controller(value: Any, name: str = "controller", *, several: bool = False) -> None:
    """Raise a ``ValueError`` if ``value``, the argument ``name``, is not a controller.

    It must have one control signal and one output, unless ``several`` are allowed.
    """
    if isinstance(value, type) or not hasattr(value, "initial_state"):
        raise ValueError(f"{name} = {value!r}: must be a controller, for example quell.ADRC(...)")
    if not several and hasattr(value, "inputs"):
        raise ValueError(
            f"{name} = {type(value).__name__}(…) has {value.inputs} control signals and "
            f"{value.outputs} outputs: NOT possible here yet, one of each is; quell.simulate, "
            "quell.analysis.analyse and quell.export.c take several"
        )
    check_runs_alone(name, value)


def check_runs_alone(name: str, controller: Any) -> None:
    """Raise a ``ValueError`` for an axis of ``quell.Axes`` whose learner sees all axes."""
    if hasattr(getattr(controller, "learner", None), "of_axes"):
        raise ValueError(
            f"{name}: is an axis of quell.Axes, whose learner needs the signals of all axes: NOT "
            "possible alone; give the Axes, or an ADRC with a learner of its own"
        )


@generic
def control(controller: Any, state: Any, r: float, y: float) -> float:
    """Take one sample: return the control signal for reference ``r`` and measurement ``y``."""
    raise TypeError


@generic_with_default
def set_reference_derivatives(controller: Any, state: Any, derivatives: Vector) -> None:
    """Set r', r'', … for the next sample; ignored by a controller that does not use them."""


@generic_with_default
def set_schedule_signals(controller: Any, state: Any, values: Vector) -> None:
    """Set the external signals of a schedule for the next sample; ignored if there is none.

    The simulation hands them over behind the derivatives of the reference.
    """


@generic_with_default
def set_held(controller: Any, state: Any, held: bool) -> None:
    """Set whether the plant is held: u does not act until it is not.

    Ignored by a controller without observer, which does not know it.
    """


@generic_with_default
def set_axis_held(controller: Any, state: Any, axis: int, held: bool) -> None:
    """Set whether an axis is held: its share of u does not act until it is not.

    A controller of one axis has that of the plant.
    """
    set_held(controller, state, held)


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
def change_parameters(old: Any, new: Any, state: Any) -> None:
    """Continue with other parameters of the same structure, without a jump of u.

    By default the state stays as it is: its meaning does not depend on the parameters.
    """


@generic_with_default
def hold_integrators(controller: Any, state: Any, u_before: float) -> None:
    """Undo what the last ``control`` added to integrators: u does not act while a plant is held.

    By default the controller is told that ``u_before`` was applied, which it was told before; so
    its integrators stay within what its anti-windup leaves.
    """
    set_applied_control(controller, state, u_before)


@generic_with_default
def bumpless_transfer(controller: Any, state: Any) -> None:
    """Continue from the applied u at the next sample, as if the loop had been at rest until now.

    If the reference differs from y, the difference acts as a step of the reference. A controller
    whose state always follows the applied u needs no implementation.
    """


# ---- Limits of the control signal ----

_SATURATED = int(Status.SATURATED)
_RATE_LIMITED = int(Status.RATE_LIMITED)
_OVERFLOWED = int(Status.OVERFLOWED)

RateLimit = float | tuple[float, float]
"""Largest rate of u, in either direction; or its range (lowest, highest) [u-unit/s]."""

# A law that asks for so many times its limits has a state that absurd samples have left: an
# integrator would need 28 times its tracking time to return, and no signal spans such a range.
_LARGEST_WISH = 2.0**40


class Limits(NamedTuple):
    """Limits of magnitude and rate; infinite if there are none."""

    low: float
    high: float
    most_change: float  # largest increase in a sample
    least_change: float  # largest decrease in a sample, as a negative number


NO_LIMITS = Limits(-math.inf, math.inf, math.inf, -math.inf)


def limits_of(controller: Any) -> tuple[float, float]:
    """Return the limits of u of a controller, also behind a prefilter; infinite if it has none."""
    limits = getattr(controller, "limits", None)
    return (-math.inf, math.inf) if limits is None else (float(limits.low), float(limits.high))


def checked_limits(u_min: float, u_max: float, rate_limit: RateLimit, dt: float) -> Limits:
    """Check and return limits; ``rate_limit`` in u-units a second."""
    low, high = checks.interval("u_min", u_min, "u_max", u_max)
    slowest, fastest = _rates(rate_limit)
    return Limits(low, high, fastest * dt, slowest * dt)


def _rates(rate_limit: Any) -> tuple[float, float]:
    """Return the lowest rate, at most zero, and the highest, at least zero."""
    if not checks.is_sequence(rate_limit):
        fastest = checks.positive_or_infinite("rate_limit", rate_limit, "u-unit/s")
        return -fastest, fastest
    rule = "must be a number, or (lowest, highest) with lowest <= 0 <= highest, not both zero"
    try:
        lowest, highest = map(float, rate_limit)
    except (TypeError, ValueError):
        raise ValueError(f"rate_limit = {rate_limit!r}: {rule}") from None
    if not (lowest <= 0.0 <= highest and lowest < highest):
        raise ValueError(f"rate_limit = {rate_limit!r}: {rule}")
    return lowest, highest


def changed_limits(
    limits: Limits,
    dt: float,
    u_min: float | None,
    u_max: float | None,
    rate_limit: RateLimit | None,
) -> Limits:
    """Return ``limits`` with new values for what is not None."""
    u_min = limits.low if u_min is None else u_min
    u_max = limits.high if u_max is None else u_max
    new = checked_limits(u_min, u_max, math.inf if rate_limit is None else rate_limit, dt)
    if rate_limit is None:
        changes = {"most_change": limits.most_change, "least_change": limits.least_change}
        new = new._replace(**changes)
    return new


@kernel
def largest_magnitude(limits: Limits) -> float:
    """Return the largest ``|u|`` within the limits; infinite without limits."""
    return max(abs(limits.low), abs(limits.high))


@kernel
def largest_wish(limits: Limits) -> float:
    """Return the u beyond which the state of a law is of no use; infinite without limits."""
    return _LARGEST_WISH * largest_magnitude(limits)


@kernel
def control_at_rest(limits: Limits) -> float:
    """Return u where nothing gives one: zero, or the limit nearest to it."""
    return min(max(0.0, limits.low), limits.high)


@kernel
def apply_limits(limits: Limits, unlimited: float, before: float) -> tuple[float, int]:
    """Return the control signal that is possible after ``before``, and the status flags.

    The limits of magnitude are applied last: u is always within them, even if it has to change
    faster for that, and always a number: without one it is that of rest.
    """
    status = 0
    applied = unlimited
    if applied > before + limits.most_change:
        applied = before + limits.most_change
        status = _RATE_LIMITED
    elif applied < before + limits.least_change:
        applied = before + limits.least_change
        status = _RATE_LIMITED
    if applied > limits.high:
        applied = limits.high
        status |= _SATURATED
    elif applied < limits.low:
        applied = limits.low
        status |= _SATURATED
    if not is_finite(applied):
        applied = control_at_rest(limits)
        status |= _OVERFLOWED
    return applied, status


# ---- Replacement of references and measurements that are not numbers of any physical quantity ----

_MEASUREMENT_HELD = int(Status.MEASUREMENT_HELD)
_REFERENCE_HELD = int(Status.REFERENCE_HELD)

# f is larger than y by the power of omega_o with the order of the plant, and squares of f must be
# finite: so they are up to 2e7 y-units/s^n for each of y. No sensor has so many steps. Where
# they overflow all the same, learner and guard start again.
LARGEST_SINGLE_SIGNAL = 1e12


@kernel
def is_usable(value: float) -> bool:
    """Return whether ``value`` can be a reference, one of its derivatives or a measurement."""
    return abs(value) <= (LARGEST_SINGLE_SIGNAL if is_single(value) else LARGEST_SIGNAL)


@kernel
def is_usable_control(limits: Limits, unlimited: float) -> bool:
    """Return whether a law's output is finite and, where no limit cuts it, not out of range.

    Without limits a larger u would drive y to where measurements count as missing, and the
    controller would never see it again.
    """
    if is_usable(unlimited):
        return True
    return is_finite(unlimited) and is_finite(largest_magnitude(limits))


@kernel
def hold_last_good(loop: Any, r: float, y: float) -> int:
    """Store the usable values of a sample in ``loop``; return the status flags of the others.

    The fields ``r``, ``y`` and ``has_reference`` of ``loop`` are set. Before the first usable
    reference r is the last y, so that the loop stays where it is.
    """
    status = 0
    if is_usable(y):
        loop.y = y
    else:
        status |= _MEASUREMENT_HELD
    if is_usable(r):
        loop.r = r
        loop.has_reference = 1.0
    else:
        status |= _REFERENCE_HELD
        if loop.has_reference == 0.0:
            loop.r = loop.y
    return status


# ---- The controller bandwidth for a given settling time ----


def omega_c_for(settling_time: float, order: int, band: float = 0.02) -> float:
    """Return the controller bandwidth [rad/s] with which the ideal loop settles in a given time.

    The unit step response of the ideal loop ``omega_c^n / (s + omega_c)^n`` is the regularised
    incomplete gamma function ``P(n, omega_c t)``. It rises without overshoot, so the loop settles
    when ``P(n, omega_c t) = 1 − band``. For 2 % and n = 1, 2 that is 3.91/t and 5.83/t, which
    Herbst (*Electronics* 2, 2013) rounds to 4/t and 6/t. A real loop, with an observer and a plant
    that differs from its model, settles in another time.

    Parameters
    ----------
    settling_time
        time after which y stays in the band [s].
    order
        order n of the plant.
    band
        half width of the band, as a fraction of the step.

    Raises
    ------
    ValueError
        for a time that is not positive, an order below 1, or a band outside of (0, 1).

    Examples
    --------
    >>> round(omega_c_for(settling_time=2.0, order=2), 3)
    2.917
    """
    from scipy.special import gammainccinv

    settling_time = checks.positive("settling_time", settling_time, "s")
    order = checks.whole("order", order, 1)
    if not checks.positive("band", band) < 1.0:
        raise ValueError(f"band = {band!r}: must be below 1, it is a fraction of the step")
    return float(gammainccinv(order, band)) / settling_time
