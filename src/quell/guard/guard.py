"""The guard: limits a learner's output to what its past outputs have proved useful.

**Known exactly.** ``f_plain = Δf̂ + f_L^F = f^F`` is the estimate of an ESO without learner from the
same y and u (``learners/lag.py``). One lag of the observer later its error q is known, and also the
share p of that error that the learner's output g was meant to remove:

    q = F (f − f^F) = f_plain − f_plain^F,        p = (1 − F) F g = g^F − g^FF

Low frequencies count little in both, because any ESO estimates them well without help.

**Authority.** Products of q and p are divided by their size in each sample, so that one shock does
not outweigh minutes, and averaged over T seconds of activity:

    m_xy ← m_xy + (dt/T) a (x y / s − m_xy),        s = q² + p²,        a = min(1, s / (0.4 e)²)

e is the typical size of q, in which an outlier counts for no more than five times e. The share of
the plain ESO's error that the learner would have removed, ``η = (2 m_qp − m_pp) / m_qq``, decides:

    β = min( clip(η / 0.2, 0, 1),  1.2 m_qq / m_pp )

The second term is for learners with the right sign and too much gain: they can destabilise the loop
although η is positive. At the start and after it was cut off, a learner has the averages of one
whose output is as large as f and uncorrelated with it. It then has to be right for 0.7 T before it
has any authority, and for 0.9 T before it has full authority.

**Bounds in each sample.** ``f − f^F`` has the size e, so f is close to f_plain:

    bounded = g clipped to f_plain ± κe, and reduced to zero between κe and 3κe from it
    f_L     = β bounded

f_L changes by 2 omega_o e per second at most, unless the bound itself moves it. An output that is
not finite, or a hundred times larger than f, is cut off within the sample.

docs/theory, "The guard", gives proofs, measurements and the reason for each part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.guard.base import (
    assess,
    limit,
    record_output,
    reset_filters,
    start_again,
    write_channels,
)
from quell.guard.certified import certified_bound
from quell.guard.reason import Reason
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.scalars import Scalars, clear
from quell.learners.lag import lag_memory, lag_of, lag_push
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# These values were chosen by hand, and are judged as a set by `quell stress` (docs/theory).
# T in lags N/omega_o of the observer: 15 s in the two-mass study.
_AVERAGING_LAGS = 30.0
# e follows a growing |q| within this many lags, and decays over this many.
_RISE_LAGS, _DECAY_LAGS = 2.0, 200.0
# An outlier counts for so many times e.
_OUTLIER = 5.0
# Samples below this share of e count less, because q at rest is noise.
_NOISE = 0.4
# η from which the authority is full.
_FULL_AUTHORITY = 0.2
# Largest energy of p in units of that of q.
_MOST_ENERGY = 1.2
# The output is reduced to zero at this distance from f_plain, in units of the bound κe.
_ZERO_AT = 3.0
# Fastest change of f_L, in units of omega_o e per second.
_FASTEST = 2.0
# An output that is so many times larger than f is cut off.
_CUT_OFF = 100.0
# Avoids division by zero; squares of f are larger in any unit.
_TINY = 1e-200

_TRUSTED, _UNPROVEN, _TOO_LOUD, _OUT_OF_BOUNDS, _TOO_FAST, _EXPLODED, _NOT_FINITE = map(int, Reason)


class GuardDesign(NamedTuple):
    """Parameters of the guard."""

    lag: Any  # lag filter of the observer
    forget: float  # dt/T
    rise: float  # share by which e follows a larger |q| in a sample
    decay: float  # share by which e decays in a sample
    bound: float  # κ
    fastest: float  # largest change of f_L in a sample, in units of e
    least_slope: float  # least ∂f_L/∂u that is used; beyond it the output counts as a constant
    largest_slope: float  # largest ∂f_L/∂u that is used


class GuardAverages(Scalars):
    """Averages over past samples."""

    qq: float  # m_qq
    qp: float  # m_qp
    pp: float  # m_pp
    error_plain: float  # mean square of q [(y-unit/s^n)²]
    error_learned: float  # mean square of q − p [(y-unit/s^n)²]


class GuardSample(Scalars):
    """Values of the newest sample."""

    authority: float  # β
    typical_error: float  # e [y-unit/s^n]
    output: float  # g [y-unit/s^n]
    f_learned: float  # f_L [y-unit/s^n]
    reason: float  # a Reason
    samples: float  # number of samples so far


class GuardMemory(NamedTuple):
    """State of the guard."""

    chain: Matrix  # lag filters of f_plain, g and g^F (3, …)
    shown: Vector  # their outputs: f_plain^F, g^F and g^FF (3,)
    averages: NDArray[GuardAverages]  # (1,)
    sample: NDArray[GuardSample]  # (1,)


# Rows of GuardMemory.chain and entries of GuardMemory.shown.
_F_PLAIN, _G, _GF = range(3)


@assess.register(GuardDesign)
def _assess(guard: GuardDesign, memory: GuardMemory, f_plain: float) -> None:
    shown, averages, sample = memory.shown, memory.averages[0], memory.sample[0]
    q, p = f_plain - shown[_F_PLAIN], shown[_G] - shown[_GF]
    qq, pp = q * q, p * p
    if not is_finite(qq + pp):
        # For example after a measurement near the largest float: its filters hold nothing useful.
        reset_filters(guard, memory)
        return
    shown[_F_PLAIN] = lag_push(guard.lag, memory.chain, _F_PLAIN, f_plain)
    shown[_GF] = lag_push(guard.lag, memory.chain, _GF, shown[_G])
    size = sample.typical_error
    # After T an outlier counts for 5 e at most: one bad measurement must not open all bounds.
    sample.samples += 1.0
    large = abs(q) if sample.samples * guard.forget < 1.0 else min(abs(q), _OUTLIER * size)
    size += guard.rise * (large - size) if large > size else -guard.decay * size
    sample.typical_error = max(size, _TINY)
    energy, noise = qq + pp, (_NOISE * size) ** 2
    if energy < _TINY:
        return
    rate = guard.forget * (energy / noise if energy < noise else 1.0)
    each = rate / energy
    averages.qq += each * qq - rate * averages.qq
    averages.qp += each * q * p - rate * averages.qp
    averages.pp += each * pp - rate * averages.pp
    averages.error_plain += guard.forget * (qq - averages.error_plain)
    averages.error_learned += guard.forget * ((q - p) * (q - p) - averages.error_learned)


@limit.register(GuardDesign)
def _limit(
    guard: GuardDesign,
    memory: GuardMemory,
    f_plain: float,
    constant: float,
    slope: float,
    u_before: float,
) -> tuple[float, float, bool]:
    averages, sample = memory.averages[0], memory.sample[0]
    output = constant + slope * u_before
    most = _CUT_OFF * max(abs(f_plain), sample.typical_error)
    if not (abs(output) <= most and is_finite(slope)):
        finite = is_finite(output) and is_finite(slope)
        sample.output = min(max(output, -most), most) if finite else 0.0
        sample.authority = 0.0
        sample.reason = _EXPLODED if finite else _NOT_FINITE
        _withdraw_authority(averages)
        return 0.0, 0.0, not finite
    sample.output = output
    authority, reason = _authority(averages)
    sample.authority = authority
    bound, distance = guard.bound * sample.typical_error, abs(output - f_plain)
    inside = distance <= bound
    bounded = output
    if not inside:
        reason = _OUT_OF_BOUNDS
        bounded = (
            min(max(output, f_plain - bound), f_plain + bound)
            * max(_ZERO_AT - distance / max(bound, _TINY), 0.0)
            / (_ZERO_AT - 1.0)
        )
    target, change = authority * bounded, guard.fastest * sample.typical_error
    f_learned = min(max(target, sample.f_learned - change), sample.f_learned + change)
    f_learned = min(max(f_learned, min(f_plain - bound, 0.0)), max(f_plain + bound, 0.0))
    steady = f_learned == target
    if not steady:
        reason = _TOO_FAST
    sample.reason = reason
    if inside and steady and guard.least_slope <= authority * slope <= guard.largest_slope:
        return authority * constant, authority * slope, False
    return f_learned, 0.0, False


@kernel
def _authority(averages: GuardAverages) -> tuple[float, int]:
    """Return β and the reason for it."""
    if not averages.qq > _TINY:
        return 0.0, _UNPROVEN
    explained = (2.0 * averages.qp - averages.pp) / averages.qq
    earned = explained / _FULL_AUTHORITY
    if earned <= 0.0:
        return 0.0, _UNPROVEN
    scaled = _MOST_ENERGY * averages.qq / averages.pp  # m_pp > 0, since η > 0
    if scaled < min(earned, 1.0):
        return scaled, _TOO_LOUD
    return (earned, _UNPROVEN) if earned < 1.0 else (1.0, _TRUSTED)


@kernel
def _withdraw_authority(averages: GuardAverages) -> None:
    """Set the averages of a learner whose output is as large as f and uncorrelated with it."""
    averages.qq = averages.pp = 0.5
    averages.qp = 0.0


@record_output.register(GuardDesign)
def _record_output(guard: GuardDesign, memory: GuardMemory, f_learned: float) -> None:
    memory.shown[_G] = lag_push(guard.lag, memory.chain, _G, memory.sample[0].output)
    memory.sample[0].f_learned = f_learned


@write_channels.register(GuardDesign)
def _write_channels(guard: GuardDesign, memory: GuardMemory, row: Vector) -> int:
    row[0] = memory.sample[0].authority
    row[1] = math.sqrt(memory.averages[0].error_plain)
    row[2] = math.sqrt(memory.averages[0].error_learned)
    row[3] = memory.sample[0].reason
    return 4


@reset_filters.register(GuardDesign)
def _reset_filters(guard: GuardDesign, memory: GuardMemory) -> None:
    for i in range(memory.chain.shape[0]):
        memory.shown[i] = 0.0
        for j in range(memory.chain.shape[1]):
            memory.chain[i, j] = 0.0
    memory.sample[0].output = memory.sample[0].f_learned = 0.0


@start_again.register(GuardDesign)
def _start_again(guard: GuardDesign, memory: GuardMemory) -> None:
    reset_filters(guard, memory)
    clear(memory.averages)
    clear(memory.sample)
    _withdraw_authority(memory.averages[0])


@dataclass(frozen=True)
class Guard:
    """Limits a learner to the authority that it has earned: ``ADRC(…, learner=…, guard=Guard())``.

    The module's docstring has the equations. They do not depend on the units of y and u.

    Parameters
    ----------
    bound
        largest distance of a learner's output from the plain observer's estimate, in units of that
        estimate's typical error e: κ. With κ = 1 a perfect learner is clipped at its peaks, because
        e is a little less than the peaks of q.
    time
        time T [s] over which a learner's output is averaged; by default 30 lags
        ``(n + 1)/omega_o`` of the observer.
    certified_for
        a linear plant, a list of plants or ``{name: plant}``, for which κ is made small enough that
        no learner can make q larger than ten times what it is without learner: κΓ ≤ 0.9, see
        ``quell.analysis.certify``. A retune computes it again, in about 50 ms a plant.

    Raises
    ------
    ValueError
        for a parameter that is not positive.
    """

    bound: float = 1.2
    time: float | None = None
    certified_for: Any = None

    def __post_init__(self) -> None:
        checks.positive("bound", self.bound)
        if self.time is not None:
            checks.positive("time", self.time, "s")

    def design(self, observer: ESO, law: Vector | None = None) -> GuardDesign:
        """Return the parameters for an observer and the gains k of the law (n,).

        Only ``certified_for`` needs the gains.

        Raises
        ------
        ValueError
            for a loop of ``certified_for`` that is unstable without learner, or without gains.
        """
        bound = float(self.bound)
        if self.certified_for is not None:
            if law is None:
                raise ValueError("law = None: certified_for needs the gains k of the law")
            bound = certified_bound(bound, self.certified_for, observer, law)
        dt, lag_time = observer.dt, observer.lag_time
        time = _AVERAGING_LAGS * lag_time if self.time is None else self.time
        # b0 + ∂f_L/∂u stays between b0/2 and 2 b0, as with the default gain_interval of Kalman.
        least_slope, largest_slope = sorted([-0.5 * observer.b0, observer.b0])
        return GuardDesign(
            lag=lag_of(observer),
            forget=-math.expm1(-dt / time),
            rise=-math.expm1(-dt / (_RISE_LAGS * lag_time)),
            decay=-math.expm1(-dt / (_DECAY_LAGS * lag_time)),
            bound=bound,
            fastest=_FASTEST * observer.omega_o * dt,
            least_slope=least_slope,
            largest_slope=largest_slope,
        )

    def memory(self, parameters: GuardDesign) -> GuardMemory:
        """Return the state before the first sample, without authority."""
        averages = GuardAverages.zeros()
        _withdraw_authority(averages[0])
        chain = lag_memory(parameters.lag, 3)
        return GuardMemory(chain, np.zeros(3), averages, GuardSample.zeros())
