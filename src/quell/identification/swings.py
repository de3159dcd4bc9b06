"""A free swing: the modes of a y that rings while u rests, or the time constant of its decay.

The motion of a linear plant with m modes after a knock, about a constant y_0, is::

    y(t) = y_0 + Σ_i exp(−ζ_i ω_i t) (α_i cos ω_di t + β_i sin ω_di t) + e,  ω_di = ω_i √(1 − ζ_i²)

with the poles ``p_i = −ζ_i ω_i ± j ω_di``. These are the only parameters that are not linear. They
start at the matrix pencil (Hua & Sarkar, *IEEE Trans. Acoustics, Speech & Signal Processing* 38,
1990) of the signal, averaged to some samples per period, and are refined to the least output error
by variable projection (``output_error``), which also gives their covariance, with noise that may be
coloured. With the slope ∂p/∂a of a pole by the coefficients of A the deviations are those of ::

    δω = Re(p̄ δp)/ω,        δζ = −(Re δp + ζ δω)/ω

Each mode must pass the ratio of likelihoods of ``alternatives``, the first one against a y that is
constant or decays as ``y_∞ + (y_0 − y_∞) exp(−t/T)``. Where none does, that is the model: of a
coast-down, or a heat-up under a steady u. With 1/T = a the interval of T is that of 1/a, and y_∞,
where y rests, is a ratio of two parameters, with Fieller's interval (``model.gain_interval``). What
rings is taken as linear: friction makes the damping of a small swing larger than that of a large
one.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.files import nonfinite_to_none
from quell.identification.model import (
    WITHIN_95,
    Structure,
    gain_interval,
    output,
    pole_slope,
)
from quell.identification.output_error import ParameterEstimate, likelihood_ratio, refine
from quell.identification.starts import with_poles
from quell.parallel import one_blas_thread
from quell.records.plotting import draw_line, given_axes, grid_of_axes, new_figure
from quell.types import Matrix, Vector

# Most modes, samples of the pencil, and samples per period of the fastest frequency that matters.
_MOST_MODES, _PENCIL, _PER_PERIOD = 5, 600, 8.0
# Share of the spectrum's power below the frequency that is called the fastest.
_POWER = 0.999
# Steps of the refinement, and the least number of samples for a mode: chosen by hand.
_STEPS, _PER_MODE = 40, 20
# Samples of a decay at least, and time constants from which its search begins: chosen by hand.
_LEAST_DECAY, _RATES = 12, 7
# Relative mean square that counts as zero, and samples over time constant of a straight line: an
# exact one has a time constant of rounding.
_ROUNDING, _STRAIGHT = 1e-24, 1e-9
_FIRST_ORDER = Structure(1, 0, (0,))


class Mode(NamedTuple):
    """A mode that rings."""

    omega: float  #: undamped frequency ω [rad/s]
    omega_interval: tuple[float, float]  #: 95 % interval of it [rad/s]
    damping: float  #: damping ratio ζ
    damping_interval: tuple[float, float]  #: 95 % interval of it
    amplitude: float  #: at the first sample [y-unit]

    @property
    def frequency(self) -> float:
        """Undamped frequency [Hz]."""
        return self.omega / (2.0 * math.pi)

    def __str__(self) -> str:
        """Return it as a line."""
        low, high = (end / (2.0 * math.pi) for end in self.omega_interval)
        zeta = self.damping_interval
        return (
            f"mode at {self.frequency:.5g} Hz ({self.omega:.5g} rad/s), 95 %: {low:.5g} to "
            f"{high:.5g} Hz; damping {self.damping:.4g}, 95 %: {zeta[0]:.4g} to {zeta[1]:.4g}; "
            f"amplitude {self.amplitude:.4g}"
        )


class Decay(NamedTuple):
    """The time constant of a y that decays."""

    time_constant: float  #: T [s]
    interval: tuple[float, float]  #: 95 % interval of it [s]; infinite if the record is too short

    def __str__(self) -> str:
        """Return it as a line, and one with NOT where the record does not decide it."""
        low, high = self.interval
        line = (
            f"y decays with a time constant of {self.time_constant:.5g} s, 95 %: {low:.5g} to "
            f"{high:.5g} s"
        )
        if high < math.inf:
            return line
        return (
            f"{line}\nNOT: the record does not decide the time constant: y may be a straight line; "
            "record longer"
        )


class FreeSwing(NamedTuple):
    """The modes of a free swing, large amplitudes first, or its decay, and how well they fit."""

    modes: tuple[Mode, ...]  #: none for a y that decays without ringing
    decay: Decay | None  #: None for a y that rings
    begin: float  #: y_0, of the first sample [y-unit]
    at_rest: float  #: y_∞ [y-unit]
    at_rest_interval: tuple[float, float]  #: 95 % interval of it [y-unit]
    fit: float  #: NRMSE [%]
    dt: float  #: sample time [s]
    y: Vector  #: as measured (N,) [y-unit]
    simulated: Vector  #: (N,) [y-unit]

    def __str__(self) -> str:
        """Return the report."""
        found = self.modes if self.decay is None else (self.decay,)
        low, high = self.at_rest_interval
        last = (
            f"from {self.begin:.5g} to {self.at_rest:.5g} at rest, 95 %: {low:.5g} to {high:.5g}; "
            f"fit {self.fit:.3f} %"
        )
        return "\n".join([*(str(each) for each in found), last])

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw y as measured and simulated, and the error; return the two axes.

        ``axes`` are two matplotlib axes, those of a new figure by default.
        """
        figure = partial(new_figure, 8.0, 5.0)
        axes = np.ravel(grid_of_axes(given_axes(axes, ax), figure, 2, sharex="all"))
        shown, error = axes
        t = np.arange(float(self.y.size)) * self.dt
        draw_line(shown, t, self.y, color="0.6", linewidth=2.5, label="measured")
        draw_line(shown, t, self.simulated, color="C0", linewidth=1.0, label="simulated")
        draw_line(error, t, self.y - self.simulated, color="C0", linewidth=0.8)
        shown.set_ylabel("y")
        shown.legend(fontsize="small")
        error.set(xlabel="time [s]", ylabel="error")
        for each in (shown, error):
            each.grid(alpha=0.3)
        return axes

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON; None for numbers that are not finite."""
        value = {name: getattr(self, name) for name in ("begin", "at_rest", "at_rest_interval")}
        decay = None if self.decay is None else self.decay._asdict()
        value |= {"fit": self.fit, "modes": [mode._asdict() for mode in self.modes]}
        return dict(nonfinite_to_none(value | {"decay": decay}))


def free_swing(y: Any, dt: float, modes: int | None = None) -> FreeSwing:
    """Return frequency and damping of the modes of a y that rings while u rests, or its decay.

    Parameters
    ----------
    y
        record (N,) from soon after the knock on, of a coast-down, or of a heat-up under a steady u
        [y-unit]; 12 samples at least, and 20 for each mode.
    dt
        sample time [s].
    modes
        number of modes, 0 to 5; 0 for a decay. By default as many as the record tells apart, and a
        decay where y does not ring.

    Raises
    ------
    ValueError
        for a y that neither rings nor decays, and for a record that is too short.

    Examples
    --------
    >>> import numpy as np
    >>> import quell as ql
    >>> t = np.arange(800) * 0.002
    >>> y = 3.0 + np.exp(-0.02 * 50.0 * t) * np.cos(50.0 * t)
    >>> (mode,) = ql.identification.free_swing(y, dt=0.002).modes
    >>> round(mode.omega, 3), round(mode.damping, 4)
    (50.01, 0.02)
    >>> t = np.arange(20) * 5.0
    >>> found = ql.identification.free_swing(150.0 - 130.0 * np.exp(-t / 40.0), dt=5.0)
    >>> round(found.decay.time_constant, 3), round(found.at_rest, 3)
    (40.0, 150.0)
    """
    y, dt = checks.vector("y", y), checks.positive("dt", dt, "s")
    if modes is not None:
        modes = checks.whole("modes", modes, 0, _MOST_MODES)
    least = _LEAST_DECAY if modes == 0 else _PER_MODE * (modes or 1)
    short = y.size < least
    if short and (modes is not None or y.size < _LEAST_DECAY):
        each = " for each mode" * (modes != 0)
        raise ValueError(
            f"y has {y.size} samples: must have at least {_PER_MODE if modes != 0 else least}"
            f"{each}; record longer"
        )
    if np.ptp(y) == 0.0:
        raise ValueError(f"y is {y[0]:g} all through: must ring or decay; record it from the begin")
    with one_blas_thread(), np.errstate(all="ignore"):
        decay = _decay(y)
        found = None if modes == 0 or short else _ringing(y, decay, modes)
        if found is None and modes:
            raise ValueError(
                "y does not ring: no pole with a frequency that its samples show was found; is it "
                "a free swing, after a knock, while u rests?"
            )
        return _result(*(found or (_FIRST_ORDER, _checked(y, decay, modes))), y, dt)


def _ringing(
    y: Vector, decay: ParameterEstimate, modes: int | None
) -> tuple[Structure, ParameterEstimate] | None:
    """Return the model of modes; None if y does not ring."""
    v, found, error = np.ones((y.size, 1)), None, y - np.mean(y)
    least = _ROUNDING * float(np.sum(error**2))
    poles = _pencil(y)
    left = y - output(_FIRST_ORDER, decay.theta, v)
    # What decays is no mode that is damped so much that it hardly swings.
    if math.isfinite(decay.cost) and likelihood_ratio((error, left), least) > 3.0 * math.log(
        y.size
    ):
        error = left
    for count in range(modes or 1, (modes or _MOST_MODES) + 1):
        if poles.size < count or y.size < _PER_MODE * count:
            break
        structure = Structure(2 * count, 0, (0,))
        pairs = np.concatenate([poles[:count], poles[:count].conjugate()])
        start = with_poles(structure, np.asarray(np.poly(pairs).real[:0:-1], np.float64))
        model = structure, refine(structure, start, v, y, _STEPS)
        if not _rings(*model):
            continue
        left = y - output(structure, model[1].theta, v)
        more = 2 * (structure.order - (0 if found is None else found[0].order))
        if likelihood_ratio((error, left), least) >= (more + 2) * math.log(y.size):
            found, error = model, left
    return found


def _checked(y: Vector, decay: ParameterEstimate, modes: int | None) -> ParameterEstimate:
    """Return the model of a decay; a ``ValueError`` refuses a y that does not decay."""
    centred = y - np.mean(y)
    left = y - output(_FIRST_ORDER, decay.theta, np.ones((y.size, 1)))
    ratio = likelihood_ratio((centred, left), _ROUNDING * float(centred @ centred))
    a = float(decay.theta[0])
    which = "y does not decay" if modes == 0 else "y does not ring, nor does it decay"
    if modes != 0 and y.size < _PER_MODE:
        least = f"must have at least {_PER_MODE} for each mode"
        which = f"y has {y.size} samples: {least}, and it does not decay"
    if not math.isfinite(decay.cost) or a >= math.pi or ratio < 4.0 * math.log(y.size):
        raise ValueError(
            f"{which}: no frequency and no time constant explains more of it than chance; begin "
            "the record at the knock, or where u was switched, and keep u steady"
        )
    if a * y.size <= _STRAIGHT:
        raise ValueError(
            f"{which}: it moves on as a straight line or faster; record longer, until it comes to "
            "rest"
        )
    return decay


def _decay(y: Vector) -> ParameterEstimate:
    """Return the best exponential from several time constants."""
    v, rates = np.ones((y.size, 1)), np.geomspace(0.3 / y.size, 1.0, _RATES)
    starts = [with_poles(_FIRST_ORDER, np.array([a])) for a in rates]
    tried = [refine(_FIRST_ORDER, start, v, y, _STEPS) for start in starts]
    return min(tried, key=lambda one: one.cost)


def _pencil(y: Vector) -> Any:
    """Return poles [rad/sample] with positive frequency, strong ones first."""
    centred = y - np.mean(y[y.size // 2 :])
    power = np.cumsum(np.abs(np.fft.rfft(centred - np.mean(centred))) ** 2)
    top = int(np.searchsorted(power, _POWER * power[-1])) + 1
    every = max(int(y.size / (_PER_PERIOD * top)), 1)
    mean = centred[: centred.size // every * every].reshape(-1, every).mean(axis=1)[:_PENCIL]
    rows = mean.size // 2
    H = np.lib.stride_tricks.sliding_window_view(mean, rows)
    U, S, _ = np.linalg.svd(H.T, full_matrices=False)
    rank = min(2 * _MOST_MODES + 1, S.size - 1, rows - 1)
    z = np.linalg.eigvals(np.linalg.lstsq(U[:-1, :rank], U[1:, :rank], rcond=None)[0])
    z = z[(z.imag > 1e-6) & (np.abs(z) > 0.1)]
    p = np.log(z) / every
    p = -np.abs(p.real) + 1j * p.imag
    if not p.size:
        return p
    k = np.arange(mean.size) * every
    shapes = np.exp(np.outer(k, p))
    columns = np.column_stack([shapes.real, shapes.imag, np.ones(k.size)])
    sizes = np.linalg.lstsq(columns, mean, rcond=None)[0]
    amplitude = np.hypot(sizes[: p.size], sizes[p.size : 2 * p.size])
    energy = amplitude**2 * np.sum(np.abs(shapes) ** 2, axis=0)
    return p[np.argsort(-energy)]


def _rings(structure: Structure, estimate: ParameterEstimate) -> bool:
    """Return whether all poles are pairs that decay, within what samples show."""
    p = np.roots(np.append(1.0, structure.denominator(estimate.theta)[::-1]))
    inside = np.all(p.real < 0.0) and np.all(np.abs(p) < math.pi)
    return bool(math.isfinite(estimate.cost) and inside and np.all(p.imag != 0.0))


def _result(structure: Structure, estimate: ParameterEstimate, y: Vector, dt: float) -> FreeSwing:
    a, n = structure.denominator(estimate.theta), structure.order
    simulated = output(structure, estimate.theta, np.ones((y.size, 1)))
    at_rest, decay = float(estimate.theta[n] / a[0]), None
    modes: tuple[Mode, ...] = ()
    if n == 1:
        half = WITHIN_95 * math.sqrt(max(float(estimate.covariance[0, 0]), 0.0))
        rate = float(a[0])
        ends = dt / (rate + half), dt / (rate - half) if half < rate else math.inf
        decay = Decay(dt / rate, ends)
    else:
        modes = _modes(a, estimate.covariance[:n, :n], simulated - at_rest, dt)
    spread = float(np.linalg.norm(y - np.mean(y)))
    return FreeSwing(
        modes=modes,
        decay=decay,
        begin=float(simulated[0]),
        at_rest=at_rest,
        at_rest_interval=gain_interval(
            estimate.theta[:n], float(estimate.theta[n]), estimate.covariance[: n + 1, : n + 1]
        ),
        fit=100.0 * (1.0 - float(np.linalg.norm(y - simulated)) / spread),
        dt=dt,
        y=y,
        simulated=simulated,
    )


def _modes(a: Vector, covariance: Matrix, swing: Vector, dt: float) -> tuple[Mode, ...]:
    """Return the modes, large amplitudes first, of the coefficients a of A and the swing itself."""
    roots = np.roots(np.append(1.0, a[::-1]))
    upper = roots[roots.imag > 0.0]
    shapes = np.exp(np.outer(np.arange(float(swing.size)), upper))
    columns = np.column_stack([shapes.real, shapes.imag])
    sizes = np.linalg.lstsq(columns, swing, rcond=None)[0]
    modes = []
    for i, p in enumerate(upper):
        slope, omega = pole_slope(a, p), abs(p)
        zeta = -p.real / omega
        by_omega = (p.conjugate() * slope).real / omega
        by_zeta = -(slope.real + zeta * by_omega) / omega
        half = [
            WITHIN_95 * math.sqrt(max(float(row @ covariance @ row), 0.0))
            for row in (by_omega, by_zeta)
        ]
        modes.append(
            Mode(
                float(omega / dt),
                (float((omega - half[0]) / dt), float((omega + half[0]) / dt)),
                float(zeta),
                (float(zeta - half[1]), float(zeta + half[1])),
                float(np.hypot(sizes[i], sizes[upper.size + i])),
            )
        )
    return tuple(sorted(modes, key=lambda mode: -mode.amplitude))
