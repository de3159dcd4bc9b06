"""Models of reduced order for a design: the poles and zeros up to a frequency.

A loop sees nothing of a zero or of a mode that is far beyond its bandwidth, but a design that
inverts it, or an observer that has its states, does. A factor ``1 − s/p`` or ``1 − s/z`` with a
large p or z is nearly 1 at the frequencies below: the reduced model leaves it out, so that the gain
at low frequencies is that of the plant::

    P_r(s) = b Π(s − z_kept) Π(−z_dropped) / (Π(s − p_kept) Π(−p_dropped))

(truncation of modes: Skogestad & Postlethwaite, *Multivariable Feedback Control*, 2nd ed. 2005,
section 11.2, with the gain at low frequencies of residualisation). What is left out belongs to the
total disturbance; margins have to be those of the whole plant.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.lti.canonical import Canonical, canonical, format_roots
from quell.types import Vector

# A zero is beyond all poles if it is so many times as large as the fastest.
_BEYOND = 3.0
# Two sizes of poles or zeros closer than this factor are not divided by a cut.
_GAP = 1.15
# A pair of poles with less damping is a resonance.
_RESONANT = 0.5


class Reduced(NamedTuple):
    """A model for a design, and what of the plant is not in it."""

    plant: Any  #: the transfer function (num, den); the plant as given, if nothing is left out
    zeros: Vector  #: zeros that are left out [rad/s]
    poles: Vector  #: poles that are left out [rad/s]

    @property
    def order(self) -> int:
        """Number of poles of the model."""
        return canonical(self.plant).a.size

    def __str__(self) -> str:
        """Return what is left out as text; empty if nothing is."""
        parts = []
        for name, roots in (("zero", self.zeros), ("pole", self.poles)):
            if roots.size:
                many = "s" if roots.size > 1 else ""
                parts.append(f"{name}{many} at {format_roots(roots)} rad/s")
        return " and ".join(parts)


def reduced_model(plant: Any, below: float) -> Reduced:
    """Return the model with the poles and zeros of a plant up to a frequency.

    Parameters
    ----------
    plant
        a linear model of any kind that ``LinearPlant.of`` accepts.
    below
        largest size of the poles and zeros that are kept [rad/s]; infinite keeps all.

    Returns
    -------
    Reduced
        ``plant``, a transfer function (numerator, denominator) for ``ESO.model_based`` and others,
        and the ``zeros`` and ``poles`` that are left out.

    Raises
    ------
    ValueError
        if no pole, or not more poles than zeros, would be left, or unstable poles would be left
        out.

    Examples
    --------
    >>> found = reduced_model(([1.0, 500.0], [1.0, 2.0, 0.0]), below=100.0)
    >>> [part.round(6).tolist() for part in found.plant], str(found)
    ([[500.0], [1.0, 2.0, 0.0]], 'zero at -500 rad/s')
    """
    if np.isnan(below) or below <= 0.0:
        checks.positive("below", below, "rad/s")
    return _reduced(plant, canonical(plant), float(below))


def without_far_zeros(plant: Any, beyond: float) -> Reduced:
    """Return the model without zeros that are far beyond all poles and beyond a frequency [rad/s].

    Zeros from 3 times the fastest pole on are far.
    """
    whole = canonical(plant)
    limit = max(beyond, _BEYOND * float(np.max(np.abs(_poles(whole)), initial=0.0)))
    return _reduced(plant, whole, limit)


def design_models(plant: Any) -> tuple[Reduced, ...]:
    """Return models for designs, the plant itself first, then those of reduced order.

    They are without zeros far beyond all poles, and without the fastest resonances and what is
    beyond them, down to one resonance. Models whose own zeros are not stable are left out, but the
    plant itself.
    """
    whole = canonical(plant)
    none = np.zeros(0)
    found = [Reduced(plant, none, none)]
    poles = _poles(whole)
    far = _BEYOND * float(np.max(np.abs(poles), initial=0.0))
    sizes = np.abs(np.concatenate([poles, whole.zeros]))
    sizes = np.unique(sizes[sizes > 0.0])[::-1]
    resonant = np.sort(
        np.abs(poles[(poles.imag > 0.0) & (-poles.real < _RESONANT * np.abs(poles))])
    )
    for upper, lower in itertools.pairwise(sizes):
        if upper < _GAP * lower or (resonant.size and lower < (1.0 - 1e-9) * resonant[0]):
            continue
        cut = float(np.sqrt(upper * lower))
        if lower > far:  # far zeros are left out together
            continue
        drops_zeros = upper > far
        drops_resonance = resonant.size > 1 and cut < resonant[-1]
        if not (drops_zeros or drops_resonance):
            continue
        try:
            one = _reduced(plant, whole, cut)
        except ValueError:
            continue
        if not canonical(one.plant).unstable_zeros.size:
            found.append(one)
    return tuple(found)


def _poles(whole: Canonical) -> Vector:
    """Return the poles; integrators, which the form has exactly, are exactly zero."""
    integrators = int(np.argmax(np.append(whole.a != 0.0, True)))
    rest = np.roots(np.append(1.0, whole.a[integrators:][::-1]))
    return np.concatenate([np.zeros(integrators), rest]).astype(complex)


def _reduced(plant: Any, whole: Canonical, limit: float) -> Reduced:
    poles = _poles(whole)
    is_fast, is_far = np.abs(poles) > limit, np.abs(whole.zeros) > limit
    dropped, zeros = poles[is_fast], whole.zeros[is_far]
    if not dropped.size and not zeros.size:
        return Reduced(plant, zeros, dropped)
    left = int(np.sum(~is_fast)), int(np.sum(~is_far))
    if left[0] <= left[1]:
        rule = f"leaves {left[0]} poles and {left[1]} zeros: must leave more poles than zeros"
        raise ValueError(f"below = {limit:.4g} rad/s: {rule}")
    if np.any(dropped.real > 0.0):
        rule = f"leaves out the unstable poles {format_roots(dropped[dropped.real > 0.0])} rad/s"
        raise ValueError(f"below = {limit:.4g} rad/s: {rule}; choose a larger one")
    gain = whole.b * float(np.real(np.prod(-zeros) / np.prod(-dropped)))
    num = gain * np.real(np.poly(whole.zeros[~is_far]))
    return Reduced((np.atleast_1d(num), np.real(np.poly(poles[~is_fast]))), zeros, dropped)
