"""The step of the reference: overshoot, settling time, and a prefilter where it overshoots.

A design for loads takes what overshoot of the reference it may: M_s, M_t and the load say little
about it. A lag before the loop (``ReferenceModel``) changes the response to the reference alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from quell.controllers.base import Controller
from quell.controllers.prefilters.reference_model import ReferenceModel
from quell.tuning.optimiser.laws import law_of
from quell.tuning.optimiser.loops import PlantSet
from quell.tuning.optimiser.time_responses import Inputs, load_step, response
from quell.types import Vector

# Overshoot from which on a prefilter is offered, and that it leaves; the band of the settling time.
MOST_OVERSHOOT, _BAND = 0.05, 0.02
# Order of the prefilter, steps of the bisection for its bandwidth, and its range in 1/dt.
_ORDER, _BISECTIONS, _SLOWEST = 2, 30, 1e-6


class ReferenceStep(NamedTuple):
    """The response of the first plant to a step of the reference."""

    overshoot: float  #: share of the step
    settling: float  #: time until it stays within 2 % of the step [s]; NaN if it does not
    prefilter: ReferenceModel | None  #: the fastest with which it overshoots by 5 % at most
    settling_with_prefilter: float  #: [s]; NaN without one

    def __str__(self) -> str:
        """Return overshoot, settling time and the offer of a prefilter as a sentence."""
        if math.isnan(self.settling):
            return "step of the reference: it does not settle in the time that was looked at"
        text = (
            f"step of the reference: overshoots by {100.0 * self.overshoot:.1f} %, settles within "
            f"2 % in {self.settling:.3g} s"
        )
        if self.prefilter is None:
            return text
        return (
            f'{text}; with a prefilter ([prefilter] kind = "reference-model", order = {_ORDER}, '
            f"omega = {self.prefilter.omega:.4g}) it overshoots by 5 % and settles in "
            f"{self.settling_with_prefilter:.3g} s"
        )


def reference_step(plants: PlantSet, controller: Controller) -> ReferenceStep:
    """Return the response of the first plant with a linear controller."""
    size = load_step(plants).r.size
    law, one, none = law_of(controller), np.ones(size), np.zeros(size)
    y = response(plants.scaled()[0], law, Inputs(one, none))
    overshoot, settling = _measured(y, plants.dt)
    if not overshoot > MOST_OVERSHOOT:
        return ReferenceStep(overshoot, settling, None, math.nan)
    # With the pulse response any prefilter is a convolution.
    pulse = np.diff(y, prepend=0.0)
    low, high, best = _SLOWEST / plants.dt, 1.0 / plants.dt, None
    for _ in range(_BISECTIONS):
        omega = math.sqrt(low * high)
        after = _measured(_behind(ReferenceModel(omega, _ORDER), pulse, plants.dt), plants.dt)
        if after[0] <= MOST_OVERSHOOT:
            low, best = omega, (ReferenceModel(omega, _ORDER), after[1])
        else:
            high = omega
    if best is None:
        return ReferenceStep(overshoot, settling, None, math.nan)
    return ReferenceStep(overshoot, settling, *best)


def peak_of_u(plants: PlantSet, controller: Controller) -> float:
    """Return the largest ``|u|`` after a unit step of r [u-unit/y-unit], without limits of u."""
    size = load_step(plants).r.size
    one, none = np.ones(size), np.zeros(size)
    u = response(plants.scaled()[0], law_of(controller), Inputs(one, none), "u")
    return float(np.max(np.abs(u)))


def _behind(model: ReferenceModel, pulse: Vector, dt: float) -> Vector:
    """Return the response to a step through a prefilter (k,)."""
    # All its poles are at the same place: r_f is the step through that many equal lags.
    lag = math.exp(-model.omega * dt)
    found = np.cumsum(pulse)
    for _ in range(model.order):
        found = lfilter([1.0 - lag], [1.0, -lag], found)
    return np.asarray(found, dtype=np.float64)


def _measured(y: Vector, dt: float) -> tuple[float, float]:
    """Return overshoot and settling time of the response to a unit step, NaN if it does not."""
    if not np.all(np.isfinite(y)):
        return math.nan, math.nan
    off = np.flatnonzero(np.abs(y - 1.0) > _BAND)
    settled = off.size == 0 or off[-1] < y.size - 1
    settling = float((off[-1] + 1 if off.size else 0) * dt) if settled else math.nan
    return max(float(np.max(y)) - 1.0, 0.0), settling
