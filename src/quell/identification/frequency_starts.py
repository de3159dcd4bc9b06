"""Starts of the search from the spectra of the record: poles by vector fitting.

The output error has a local minimum beside each resonance, which no model without that resonance
leads to. In the spectra of u and y a resonance is a peak of their ratio, and a rational function
with a transient (``vector_fitting``) has a pair of poles for it, wherever the search begins.

A record *shows a resonance* if such a pair has little damping and explains more than chance.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.identification.vector_fitting import (
    Rational,
    Spectra,
    fit_of_record,
    pair_beside,
)
from quell.types import Vector

Complex = NDArray[Any]

DAMPED = 0.3
"""Damping up to which a pair of poles is a resonance: there it rises by a factor of 1.75."""

# Most samples that are looked at. Chosen by hand.
_SAMPLES = 8192
# Rounds of vector fitting at each delay, and poles besides those that are wanted, for what noise
# adds and to find a resonance from any start. Chosen by hand.
_ROUNDS, _EXTRA = 8, 2
# Delays that are tried [samples]; between them the poles differ little. By hand.
_DELAYS = (0, 1, 2, 4, 7, 12, 20)
# Slowest and fastest pole that is passed on [1/sample]: beyond any that samples show.
_SLOWEST, _FASTEST = 1e-6, 10.0


def poles_of_record(u: Vector, y: Vector, order: int) -> list[Complex]:
    """Return sets of ``order`` poles [1/sample] that a record shows; none if it is short."""
    if not _is_long(u, order + _EXTRA):
        return []
    return [continuous(fit_of_record(u, y, order, extra).poles) for extra in (0, _EXTRA)]


def resonant_poles(u: Vector, y: Vector, order: int, longest: int) -> Vector | None:
    """Return a (n,) of a polynomial with the poles of a record that shows a resonance, else None.

    ``u`` may be late by up to ``longest`` samples.
    """
    if not _is_long(u, order + _EXTRA):
        return None
    part = moving_part(u)
    u, y = u[part], y[part]

    def best(order: int) -> tuple[Vector, Rational]:
        fits = []
        for late in (late for late in _DELAYS if late <= longest):
            delayed = np.concatenate([np.full(late, u[0]), u[: u.size - late]])
            for extra in (0, _EXTRA):
                fits.append((delayed, fit_of_record(delayed, y, order, extra, _ROUNDS)))
        return min(fits, key=lambda one: one[1].error)

    later, without = best(order - 2)
    of = Spectra.of(later, y)
    upper, weight = pair_beside(of, without.poles)
    beside = of.fitted(np.append([upper, upper.conjugate()], without.poles), weight)
    least = of.fitted(without.poles, weight).error
    later, all_at_once = best(order)
    fits = [beside, Spectra.of(later, y).fitted(all_at_once.poles, weight)]
    found = min(fits, key=lambda one: one.error)
    poles = continuous(found.poles)
    pairs = poles[(poles.imag > 0.0) & (-poles.real < DAMPED * np.abs(poles))]
    if not pairs.size:
        return None
    # Frequency, damping and two numbers of the numerator: a start, which the fit then has to prove.
    ratio = u.size * math.log(least / max(found.error, 1e-300))
    if ratio < 4.0 * math.log(u.size):
        return None
    return np.asarray(np.poly(poles).real[:0:-1], dtype=np.float64)


def moving_part(u: Vector) -> slice:
    """Return the part of a long record in which u moves most: it is a record as well."""
    if u.size <= _SAMPLES:
        return slice(0, u.size)
    moved = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(u)))])
    first = int(np.argmax(moved[_SAMPLES - 1 :] - moved[: u.size - _SAMPLES + 1]))
    return slice(first, first + _SAMPLES)


def _is_long(u: Vector, order: int) -> bool:
    """Return whether a record has enough samples for the equations, and moves."""
    return bool(u.size > 12 * (order + 1) and np.ptp(u) > 0.0)


def continuous(z: Complex, every: int = 1) -> Complex:
    """Return stable poles [1/sample] of poles z of averages over ``every`` samples."""
    with np.errstate(all="ignore"):
        p = np.log(z) / every
    # A real z that is not positive has no real logarithm: a pole at half the sampling rate.
    p = np.where((z.imag == 0.0) & (z.real <= 0.0), -np.pi / every, p)
    return np.asarray(-np.clip(np.abs(p.real), _SLOWEST, _FASTEST) + 1j * p.imag)
