"""Recorded samples as a signal, with their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from quell import checks
from quell.signals.base import EDGE_TOLERANCE, Constant, Signal
from quell.types import Vector
from quell.warn import warn

# Degree of the spline: r to r'''' are continuous, as the feedforward of a flexible axis needs them.
_DEGREE = 5


@dataclass(frozen=True, eq=False)
class Samples(Signal):
    """Recorded samples, interpolated or held; beyond the ends the first and last value hold.

    Parameters
    ----------
    times
        times of the samples [s], increasing.
    values
        of the same size.
    hold
        ``"linear"`` interpolates, ``"previous"`` holds each value until the next, ``"spline"`` lays
        a spline of degree 5 through the samples, at rest (r' = r'' = 0) at both ends: its first
        four derivatives are continuous inside. It smooths no noise.
    derivatives
        samples of r', r'', … [y-unit/s^i], as many as are known, each of the size of ``values``;
        for ``"linear"`` and ``"previous"``. Else those of lines are their slopes, and there is no
        second one: a controller with feedforward is warned.

    Raises
    ------
    ValueError
        for times that do not increase, other sizes, and derivatives beside a spline, which has its
        own.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.linspace(0.0, 1.0, 11)
    >>> move = Samples(t, 10 * t**3 - 15 * t**4 + 6 * t**5, hold="spline")
    >>> round(float(move.derivative()(0.5)), 6)
    1.875
    """

    times: Any
    values: Any
    hold: str = "linear"
    derivatives: Sequence[Any] = ()

    def __post_init__(self) -> None:
        times = checks.vector("times", self.times)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", checks.vector("values", self.values, times.size))
        checks.one_of("hold", self.hold, ("linear", "previous", "spline"))
        if times.size == 0 or np.any(np.diff(times) <= 0.0):
            raise ValueError("times: must hold at least one sample and increase")
        if not checks.is_sequence(self.derivatives) and np.ndim(self.derivatives) != 2:
            raise ValueError(f"derivatives = {self.derivatives!r}: must be a list of samples")
        if self.hold == "spline" and len(self.derivatives):
            raise ValueError(
                "derivatives: are those of the spline; leave them out, or take hold = 'linear'"
            )
        if self.hold == "spline" and times.size < 2:
            raise ValueError(f"times has {times.size} sample: a spline needs two")
        known = [
            checks.vector(f"derivatives[{i}]", each, times.size)
            for i, each in enumerate(self.derivatives)
        ]
        object.__setattr__(self, "derivatives", tuple(known))

    def evaluate(self, t: Vector) -> Vector:
        """Return the samples at ``t``."""
        if self.hold == "linear":
            return np.asarray(np.interp(t, self.times, self.values))
        if self.hold == "spline":
            return np.asarray(self._spline(np.clip(t, self.times[0], self.times[-1])))
        index = np.searchsorted(self.times - EDGE_TOLERANCE, t, side="right") - 1
        return np.asarray(self.values[np.maximum(index, 0)])

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import make_interp_spline

        rest = [(1, 0.0), (2, 0.0)]
        return make_interp_spline(self.times, self.values, k=_DEGREE, bc_type=(rest, rest))

    def derivative(self) -> Signal:
        """Return the derivative: as given, of the spline, or the slope between samples."""
        first, last = float(self.times[0]), float(self.times[-1])
        if self.hold == "spline":
            inside: Signal = _SplineDerivative(self._spline.derivative(), last)
            return Constant(0.0).until(first, then=inside)
        if len(self.derivatives):
            own, *rest = self.derivatives
            inside = replace(self, values=own, derivatives=tuple(rest))
            return Constant(0.0).until(first, then=inside.until(last, then=0.0))
        if self.hold == "previous" or self.times.size < 2:
            return Constant(0.0)
        slopes = np.diff(self.values) / np.diff(self.times)
        lines = Samples(self.times, np.append(slopes, 0.0), hold="previous")
        return Constant(0.0).until(first, then=lines)


def check_derivative(signal: Signal) -> None:
    """Warn if the derivative of a signal is zero because held samples in it have no other one."""
    parts: list[Any] = [signal]
    while parts:
        part = parts.pop()
        if isinstance(part, tuple):
            parts += part
        elif isinstance(part, Samples):
            if part.hold == "previous" and not part.derivatives and np.ptp(part.values) > 0.0:
                message = (
                    "the reference has samples that are held, or joined by lines, without another "
                    "derivative: feedforward gets zero; give Samples(derivatives=...), or take "
                    'hold="spline"'
                )
                warn(message)
                return
        elif isinstance(part, Signal):
            parts += [getattr(part, each.name) for each in fields(part)]


@dataclass(frozen=True, eq=False)
class _SplineDerivative(Signal):
    """A derivative of a spline, zero from ``last`` [s] on."""

    spline: Any
    last: float

    def evaluate(self, t: Vector) -> Vector:
        """Return the values."""
        inside = t < self.last - EDGE_TOLERANCE
        return np.where(inside, self.spline(np.minimum(t, self.last)), 0.0)

    def derivative(self) -> Signal:
        """Return the next derivative; zero beyond the degree."""
        if self.spline.k == 0:
            return Constant(0.0)
        return replace(self, spline=self.spline.derivative())
