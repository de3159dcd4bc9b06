"""The base class of signals, and how signals are combined."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np

from quell import checks
from quell.types import Vector

# Tolerance [s] by which an edge on a sample belongs to it if rounding makes k dt fall short of it.
# Chosen by hand, far below usable sample times; not tuned further.
EDGE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Signal:
    """Base class of signals; a new kind must define ``evaluate``."""

    def evaluate(self, t: Vector) -> Vector:
        """Return the values at the times ``t`` [s], an array of the same shape."""
        raise TypeError(f"{type(self).__name__} must define evaluate(t)")

    def __call__(self, t: Any) -> Vector:
        """Return the values at the times ``t`` [s]; a number gives a 0-d array."""
        times = np.asarray(t, dtype=np.float64)
        values = np.asarray(self.evaluate(times), dtype=np.float64)
        if values.shape != times.shape:
            raise ValueError(
                f"{type(self).__name__}.evaluate returned shape {values.shape} for times of shape "
                f"{times.shape}"
            )
        return values

    def seeded(self, seed: int) -> Signal:
        """Return this signal with its noise, if any, drawn from ``seed``."""
        return self

    def derivative(self) -> Signal:
        """Return the derivative in time, without the impulses of jumps.

        Raise a ``ValueError`` if it is not known in closed form.
        """
        raise ValueError(
            f"reference has no derivative known in closed form, {type(self).__name__} has none: "
            "take another signal, define derivative(), or use a prefilter"
        )

    def until(self, time: float, then: Signal | float) -> Signal:
        """Return this signal before ``time`` [s] and ``then``, a signal or a number, from it on."""
        return Switched((checks.finite("time", time),), (self, as_signal(then, "then")))

    def __add__(self, other: Signal | float) -> Signal:
        return Sum((self, as_signal(other)))

    def __sub__(self, other: Signal | float) -> Signal:
        return Sum((self, -1.0 * as_signal(other)))

    def __mul__(self, factor: float) -> Signal:
        return Scaled(checks.finite("factor", factor), self)

    def __neg__(self) -> Signal:
        return Scaled(-1.0, self)

    def __rsub__(self, other: Signal | float) -> Signal:
        return as_signal(other) - self

    def __truediv__(self, factor: float) -> Signal:
        factor = checks.nonzero("factor", factor, "a signal can't be divided by it")
        return Scaled(1.0 / factor, self)

    __radd__ = __add__
    __rmul__ = __mul__


@dataclass(frozen=True)
class Constant(Signal):
    """A constant ``value``."""

    value: float = 0.0

    def __post_init__(self) -> None:
        checks.finite("value", self.value)

    def evaluate(self, t: Vector) -> Vector:
        """Return the constant."""
        return np.full(t.shape, float(self.value))

    def derivative(self) -> Signal:
        """Return zero."""
        return Constant(0.0)


@dataclass(frozen=True)
class Scaled(Signal):
    """``factor`` times another signal; written ``factor * signal``."""

    factor: float
    signal: Signal

    def evaluate(self, t: Vector) -> Vector:
        """Return the scaled values."""
        return self.factor * self.signal(t)

    def derivative(self) -> Signal:
        """Return the scaled derivative."""
        return replace(self, signal=self.signal.derivative())

    def seeded(self, seed: int) -> Signal:
        """Return the signal with seeded noise."""
        return replace(self, signal=self.signal.seeded(seed))


@dataclass(frozen=True)
class Sum(Signal):
    """The sum of several signals; written ``a + b``."""

    terms: tuple[Signal, ...]

    def evaluate(self, t: Vector) -> Vector:
        """Return the sum."""
        total = np.zeros(t.shape)
        for term in self.terms:
            total += term(t)
        return total

    def derivative(self) -> Signal:
        """Return the sum of the derivatives."""
        return replace(self, terms=tuple(term.derivative() for term in self.terms))

    def seeded(self, seed: int) -> Signal:
        """Return the sum with independently seeded terms."""
        return replace(self, terms=seeded_apart(self.terms, seed))


@dataclass(frozen=True)
class Switched(Signal):
    """Signals one after the other: ``pieces[i]`` from ``times[i − 1]`` to ``times[i]`` [s].

    Each piece is evaluated at absolute time.
    """

    times: tuple[float, ...]
    pieces: tuple[Signal, ...]

    def __post_init__(self) -> None:
        times = checks.vector("times", self.times)
        if len(self.pieces) != times.size + 1:
            sizes = f"pieces has {len(self.pieces)} entries, times {times.size}"
            raise ValueError(f"{sizes}: there must be one piece more than times")
        if np.any(np.diff(times) <= 0.0):
            raise ValueError(f"times = {self.times!r}: must increase")

    def evaluate(self, t: Vector) -> Vector:
        """Return the values of the piece at each time."""
        edges = [time - EDGE_TOLERANCE for time in self.times]
        if t.size:
            first, last = bisect_right(edges, t.min()), bisect_right(edges, t.max())
            if first == last:
                return self.pieces[first](t)
        which = np.searchsorted(edges, t, side="right")
        values = np.empty(t.shape)
        for i, piece in enumerate(self.pieces):
            inside = which == i
            values[inside] = piece(t[inside])
        return values

    def derivative(self) -> Signal:
        """Return the derivatives of the pieces."""
        return replace(self, pieces=tuple(piece.derivative() for piece in self.pieces))

    def seeded(self, seed: int) -> Signal:
        """Return the signal with independently seeded pieces."""
        return replace(self, pieces=seeded_apart(self.pieces, seed))


def as_signal(value: Signal | float, name: str = "signal") -> Signal:
    """Return a signal as it is and a number as a constant; errors call the value ``name``."""
    return value if isinstance(value, Signal) else Constant(checks.finite(name, value))


def seeded_apart(signals: Sequence[Signal], seed: int) -> tuple[Signal, ...]:
    """Return the signals seeded from one seed, with independent streams."""
    if not signals:
        return ()
    seeds = _seeds(seed, len(signals))
    return tuple(signal.seeded(child) for signal, child in zip(signals, seeds, strict=True))


@lru_cache(maxsize=64)
def _seeds(seed: int, count: int) -> tuple[int, ...]:
    return tuple(np.random.SeedSequence(seed).generate_state(count, np.uint32).tolist())


def check_finite_fields(signal: Signal, *names: str) -> None:
    """Raise a ``ValueError`` if a parameter, by default any, is not a finite number."""
    for name in names or [f.name for f in fields(signal)]:
        checks.finite(name, getattr(signal, name))
