"""The largest omega_c with which a loop keeps a phase margin, and the ratio of omega_o to it.

The observer, with ``omega_o = r omega_c``, costs phase: the loop of y'' = b u has a margin of 41°
with r = 5, at any omega_c, and 60° from r = 30 on. But a larger r meets the delay and the sample
time at a lower omega_c. So r is searched for, too: the omega_c of each r of a grid is found, and
the least r is taken whose omega_c comes near to the largest, because the noise in u grows with
omega_o.

An unstable plant needs an omega_c above a least one, so the range that keeps the margin is searched
from its upper end.

Beside it stands the PI or, for n = 2, PID controller of the same margin. With the crossover ω
the phase that the plant leaves to ``K (1 + 1/(s T_i))``, or to ``K (1 + 2 s T_d)²/(4 s T_d F(s))``
with ``T_i = 4 T_d`` and a filter of T_d/10, gives its time, and ``|L| = 1`` its gain. Of all ω the
one with the largest ``k_i = K/T_i`` is taken, as 1/k_i is ``∫ y dt`` after a step of the load
(Åström & Hägglund, *Advanced PID Control*, 2006, secs. 4.2, 7.4). Margins are those of the sampled
controllers.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from quell.analysis.linearise import linear_law
from quell.analysis.loop import LoopAnalysis
from quell.controllers.adrc import ADRC
from quell.observers.eso import ESO
from quell.plants.linear import SampledPlant, sampled_plant
from quell.types import DesignWarning, Vector

# Range of omega_c relative to 1/dt: omega_o is 0.5/dt at most, below the limit of 1/dt that designs
# warn of; and trials for each factor of ten. Chosen by hand.
_LOWEST, _MOST_OBSERVER, _PER_DECADE = 1e-4, 0.5, 8
# Relative errors of omega_c: to compare ratios, and of the result.
_ROUGH, _TOLERANCE = 1e-2, 1e-6
# Factors by which a neighbour of a rough omega_c is sought on the other side of the edge.
_STEPS = (1.01, 1.05, 1.2, 1.5)
# Ratios omega_o/omega_c that are tried: from the usual range of 3 to 10 (Gao 2003; Herbst 2013) to
# where the observer costs hardly any phase. A double integrator has 60° from 30 on.
RATIOS = tuple(np.geomspace(3.0, 100.0, 9).tolist())
# Share of the largest omega_c that is enough for a smaller ratio: chosen by hand.
_ENOUGH = 0.9
# Loss of phase at an edge that is more than rounding [degrees].
_JUMP = 1e-3
# Most order with a simple controller; crossovers that are tried, and the margin that sampling may
# take [degrees]. Chosen by hand.
_MOST_SIMPLE, _CROSSOVERS, _NEARLY_KEPT = 2, 120, 0.5
# Phase margin that stands for an unstable loop [degrees].
_UNSTABLE_BANDWIDTH = -180.0


class Reach(NamedTuple):
    """The largest omega_c that keeps a margin; if none does, the one of the largest margin."""

    omega_c: float  #: [rad/s]; NaN if no loop is stable
    ratio: float  #: omega_o/omega_c
    phase: float  #: phase margin there [degrees]; −180 if no loop is stable
    keeps: bool  #: whether it keeps the margin


class Candidate:
    """Loops of a sampled plant ``b/den`` behind a lag and a delay, and ADRC, by omega_c and ratio.

    Parameters
    ----------
    b
        gain of the plant.
    den
        its denominator of degree n, the first coefficient 1.
    lag, delay
        time constant of the lag, and the delay [s].
    b0
        gain that the model-free ESO assumes.
    dt
        sample time [s].
    """

    def __init__(
        self, b: float, den: Vector, lag: float, delay: float, *, b0: float, dt: float
    ) -> None:
        self.order, self.b0, self.dt = den.size - 1, b0, dt
        self.plant: SampledPlant = sampled_plant((np.array([b]), den), dt, delay, lag)

    def loop(self, omega_c: float, ratio: float) -> LoopAnalysis:
        """Return the loop."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DesignWarning)
            controller = ADRC(
                ESO.model_free(self.order, self.b0, ratio * omega_c, self.dt), omega_c
            )
        return LoopAnalysis(self.plant, linear_law(controller), self.dt)

    def exact(self, omega_c: float, ratio: float) -> float:
        """Return the phase margin [degrees]."""
        loop = self.loop(omega_c, ratio)
        return loop.margins.phase if loop.stable else _UNSTABLE_BANDWIDTH

    def rough(self, omega_c: float, ratio: float) -> float:
        """Return the phase margin to 0.1 degrees, by lines between frequencies: a third as long."""
        loop = self.loop(omega_c, ratio)
        if not loop.stable:
            return _UNSTABLE_BANDWIDTH
        with np.errstate(all="ignore"):  # a pole at a frequency
            L = loop.response("L", loop.omega)
            size = np.log(np.abs(L))
            at = np.flatnonzero(np.signbit(size[:-1]) != np.signbit(size[1:]))
            at = at[np.isfinite(size[at]) & np.isfinite(size[at + 1])]
            share = size[at] / (size[at] - size[at + 1])
            lead = np.angle(-L[at]) + share * np.angle(L[at + 1] / L[at])
        if not at.size:
            return math.inf
        return math.degrees(np.min(np.abs(np.remainder(lead + np.pi, 2.0 * np.pi) - np.pi)))


def bandwidth(loops: Candidate, margin: float, ratio: float | None = None) -> Reach:
    """Return the largest omega_c with which ADRC keeps a phase margin [degrees].

    Without a ``ratio`` that is searched for, too: of those of ``RATIOS`` whose omega_c is at least
    0.9 times the largest, the least.
    """
    tried = [_reach(loops, margin, one) for one in (RATIOS if ratio is None else (ratio,))]
    kept = [one for one in tried if one.keeps]
    if not kept:
        return max(tried, key=lambda one: one.phase)
    enough = _ENOUGH * max(one.omega_c for one in kept)
    found = next(one for one in kept if one.omega_c >= enough)
    omega_c = near(loops, margin, found.omega_c, found.ratio)
    if math.isnan(omega_c):  # kept by less than the error of the rough value
        return found._replace(keeps=False, phase=loops.exact(found.omega_c, found.ratio))
    return Reach(omega_c, found.ratio, loops.exact(omega_c, found.ratio), True)


class SimpleController(NamedTuple):
    """A PI or PID controller that keeps a phase margin."""

    kp: float  #: [u-unit/y-unit]
    ki: float  #: [u-unit/y-unit/s]
    kd: float  #: [u-unit s/y-unit]; zero of a PI controller
    tf: float  #: filter time of ``PID`` [s]
    phase: float  #: phase margin of the sampled loop [degrees]
    over_adrc: float  #: k_i over that of the ADRC beside it: above 1 it rejects a load better

    @property
    def name(self) -> str:
        """PI or PID."""
        return "PID" if self.kd else "PI"


def pid_of_margin(loops: Candidate, margin: float, reach: Reach) -> SimpleController | None:
    """Return the PI or PID controller with the largest k_i that keeps a margin; None if none does.

    ``reach`` is the ADRC beside it, of order 1 or 2.
    """
    from quell.controllers.baselines.pid import PID

    if loops.order > _MOST_SIMPLE:
        return None
    adrc = loops.loop(reach.omega_c, reach.ratio)
    low = np.array([1e-4 * reach.omega_c])
    k_adrc = float(np.abs(adrc.response("C_y", low))[0] * low[0])
    omega = np.geomspace(_LOWEST, 0.9 * math.pi, _CROSSOVERS) / loops.dt
    plant = np.sign(loops.b0) * adrc.response("P", omega)
    left = np.radians(margin) - np.pi - np.angle(plant)
    left = np.remainder(left + np.pi, 2.0 * np.pi) - np.pi  # phase that the controller needs
    x = np.geomspace(1e-2, 1e2, _CROSSOVERS)  # ω T_i, or ω T_d
    # PID filters on P, I and D alike: 1 + T_f s + (T_f s)²/2 with T_f = T_d/10.
    of_pid = (1.0 + 2j * x) ** 2 / (4j * x) / (1.0 + 0.1j * x - 0.005 * x**2)
    tried: list[tuple[float, float, float, bool]] = []
    for shape, is_pid in ((1.0 + 1.0 / (1j * x), False), (of_pid, True))[: loops.order]:
        # The phase rises with x up to where the filter takes over.
        top = int(np.argmax(np.angle(shape))) + 1
        phase, size = np.angle(shape)[:top], np.abs(shape)[:top]
        inside = (left > phase[0]) & (left < phase[-1])
        at = np.interp(left[inside], phase, np.log(x[:top]))
        times = np.exp(at) / omega[inside]
        gains = 1.0 / np.abs(plant[inside]) / np.exp(np.interp(at, np.log(x[:top]), np.log(size)))
        ki = gains / times / (4.0 if is_pid else 1.0)
        rows = zip(ki.tolist(), gains.tolist(), times.tolist(), strict=True)
        tried += [(*row, is_pid) for row in rows]
    sign = float(np.sign(loops.b0))
    for ki, gain, time, is_pid in sorted(tried, reverse=True):
        kd, tf = (sign * gain * time, 0.1 * time) if is_pid else (0.0, 0.0)
        if 0.0 < tf < 0.5 * loops.dt:  # faster than samples show
            continue
        law = linear_law(PID(sign * gain, sign * ki, kd, tf=tf, dt=loops.dt))
        loop = LoopAnalysis(loops.plant, law, loops.dt)
        if loop.stable and loop.margins.phase >= margin - _NEARLY_KEPT:
            return SimpleController(sign * gain, sign * ki, kd, tf, loop.margins.phase, ki / k_adrc)
    return None


def near(loops: Candidate, margin: float, omega_c: float, ratio: float) -> float:
    """Return the largest omega_c near a given one that keeps the margin, exactly; NaN for none."""
    top = _MOST_OBSERVER / (ratio * loops.dt)

    def excess(omega_c: float) -> float:
        return min(loops.exact(omega_c, ratio), 180.0) - margin

    keeps = excess(omega_c) >= 0.0
    inside, outside = omega_c, omega_c
    for factor in _STEPS:
        if keeps and inside >= top:
            return top
        other = min(omega_c * factor, top) if keeps else omega_c / factor
        if (excess(other) >= 0.0) != keeps:
            inside, outside = (inside, other) if keeps else (other, outside)
            return _edge(excess, inside, outside, _TOLERANCE)
        inside, outside = (other, outside) if keeps else (inside, other)
    return inside if keeps else math.nan


def _reach(loops: Candidate, margin: float, ratio: float) -> Reach:
    """Return the largest omega_c for a ratio, roughly."""
    from scipy.optimize import minimize_scalar

    def excess(omega_c: float) -> float:
        return min(loops.rough(omega_c, ratio), 180.0) - margin

    low, high = _LOWEST / loops.dt, _MOST_OBSERVER / (ratio * loops.dt)
    count = max(round(math.log10(high / low) * _PER_DECADE) + 1, 3)
    grid = np.geomspace(low, high, count)[::-1].tolist()
    values: list[float] = []
    for at, omega_c in enumerate(grid):
        values.append(excess(omega_c))
        if values[-1] >= 0.0:
            edge = omega_c if at == 0 else _edge(excess, omega_c, grid[at - 1], _ROUGH)
            return Reach(edge, ratio, margin, True)
    best = int(np.argmax(values))
    if values[best] + margin <= _UNSTABLE_BANDWIDTH:
        return Reach(math.nan, ratio, _UNSTABLE_BANDWIDTH, False)
    # A range that keeps it may lie between two trials.
    ends = grid[min(best + 1, count - 1)], grid[max(best - 1, 0)]
    top = minimize_scalar(
        lambda x: -excess(math.exp(x)), bounds=np.log(ends), options={"xatol": _ROUGH}
    )
    omega_c, value = (grid[best], values[best])
    if -float(top.fun) > value:
        omega_c, value = math.exp(float(top.x)), -float(top.fun)
    if value < 0.0:
        return Reach(omega_c, ratio, value + margin, False)
    return Reach(_edge(excess, omega_c, ends[1], _ROUGH), ratio, margin, True)


def _edge(
    excess: Callable[[float], float], inside: float, outside: float, tolerance: float
) -> float:
    """Return the last omega_c from ``inside``, which keeps the margin, to ``outside``."""
    from scipy.optimize import brentq

    if excess(outside) >= 0.0:
        return outside
    root = brentq(
        lambda x: excess(math.exp(x)), math.log(inside), math.log(outside), xtol=tolerance
    )
    found = math.exp(float(root))
    if excess(found) >= -_JUMP:
        return found
    # Where the gain comes to 1 at another frequency the margin jumps: the side that keeps it.
    while outside > inside * (1.0 + tolerance):
        middle = math.sqrt(inside * outside)
        inside, outside = (middle, outside) if excess(middle) >= 0.0 else (inside, middle)
    return inside
