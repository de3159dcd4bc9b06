"""A free swing: frequency and damping of the modes of a y that rings while u rests.

The motion of a linear plant with m modes after a knock, about a constant y_0, is::

    y(t) = y_0 + Σ_i exp(−ζ_i ω_i t) (α_i cos ω_di t + β_i sin ω_di t) + e,  ω_di = ω_i √(1 − ζ_i²)

with the poles ``p_i = −ζ_i ω_i ± j ω_di``. These are the only parameters that are not linear. They
start at the matrix pencil (Hua & Sarkar, *IEEE Trans. Acoustics, Speech & Signal Processing* 38,
1990) of the signal, averaged to some samples per period, and are refined to the least output error
by variable projection (``output_error``), which also gives their covariance, with noise that may be
coloured. With the slope ∂p/∂a of a pole by the coefficients of A the deviations are those of ::

    δω = Re(p̄ δp)/ω,        δζ = −(Re δp + ζ δω)/ω

Each mode must pass the ratio of likelihoods of ``alternatives``, the first one against a y that is
constant or decays as ``y_∞ + (y_0 − y_∞) exp(−t/T)``: a coast-down, or a heat-up under a steady u,
which ``free_decay`` fits in the same way. With 1/T = a the interval of T is that of 1/a, and y_∞ is
a ratio of two parameters, with Fieller's interval (``model.gain_interval``). What rings is taken as
linear: friction makes the damping of a small swing larger than that of a large one.
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
from quell.types import Vector

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


class FreeSwing(NamedTuple):
    """The modes of a free swing, large amplitudes first, and how well they describe it."""

    modes: tuple[Mode, ...]
    at_rest: float  #: y_0 [y-unit]
    fit: float  #: NRMSE [%]
    dt: float  #: sample time [s]
    y: Vector  #: as measured (N,) [y-unit]
    simulated: Vector  #: (N,) [y-unit]

    def __str__(self) -> str:
        """Return the report."""
        lines = [str(mode) for mode in self.modes]
        return "\n".join([*lines, f"at rest y is {self.at_rest:.5g}; fit {self.fit:.3f} %"])

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
        """Return the modes for JSON."""
        return {
            "modes": [mode._asdict() for mode in self.modes],
            "at_rest": self.at_rest,
            "fit": self.fit,
        }


class FreeDecay(NamedTuple):
    """A y that decays to where it rests, with one time constant."""

    time_constant: float  #: T [s]
    interval: tuple[float, float]  #: 95 % interval of it [s]; infinite if the record is too short
    at_rest: float  #: y_∞ [y-unit]
    at_rest_interval: tuple[float, float]  #: 95 % interval of it [y-unit]
    begin: float  #: y_0 [y-unit]
    fit: float  #: NRMSE [%]
    dt: float  #: sample time [s]
    y: Vector  #: as measured (N,) [y-unit]
    simulated: Vector  #: (N,) [y-unit]

    def __str__(self) -> str:
        """Return the report."""
        (low, high), (least, most) = self.interval, self.at_rest_interval
        lines = [
            f"y decays with a time constant of {self.time_constant:.5g} s, 95 %: {low:.5g} to "
            f"{high:.5g} s",
            f"from {self.begin:.5g} to {self.at_rest:.5g}, 95 %: {least:.5g} to {most:.5g}; "
            f"fit {self.fit:.3f} %",
        ]
        if not high < math.inf:
            lines.append(
                "NOT: the record does not decide the time constant: y may be a straight line; "
                "record longer"
            )
        return "\n".join(lines)

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw y as measured and simulated, and the error, as ``FreeSwing.plot``."""
        drawn = FreeSwing((), self.at_rest, self.fit, self.dt, self.y, self.simulated)
        return drawn.plot(axes, ax=ax)

    def to_json(self) -> dict[str, Any]:
        """Return the results for JSON; None for numbers that are not finite."""
        names = ("time_constant", "interval", "at_rest", "at_rest_interval", "begin", "fit")
        return dict(nonfinite_to_none({name: getattr(self, name) for name in names}))


def free_decay(y: Any, dt: float) -> FreeDecay:
    """Return time constant and end of a y that decays while u is steady.

    Parameters
    ----------
    y
        record (N,) of a coast-down, or of a heat-up under a steady u [y-unit]; 12 samples at least.
    dt
        sample time [s].

    Raises
    ------
    ValueError
        for a y that does not decay, and for a record that is too short.

    Examples
    --------
    >>> import numpy as np
    >>> import quell as ql
    >>> t = np.arange(20) * 5.0
    >>> found = ql.identification.free_decay(150.0 - 130.0 * np.exp(-t / 40.0), dt=5.0)
    >>> round(found.time_constant, 3), round(found.at_rest, 3)
    (40.0, 150.0)
    """
    y, dt = checks.vector("y", y), checks.positive("dt", dt, "s")
    if y.size < _LEAST_DECAY:
        raise ValueError(f"y has {y.size} samples: must have at least {_LEAST_DECAY}; record more")
    structure = Structure(1, 0, (0,))
    with one_blas_thread(), np.errstate(all="ignore"):
        estimate = _decay(y)
        centred = y - np.mean(y)
        simulated = output(structure, estimate.theta, np.ones((y.size, 1)))
        ratio = likelihood_ratio((centred, y - simulated), _ROUNDING * float(centred @ centred))
    a = float(estimate.theta[0])
    if not math.isfinite(estimate.cost) or a >= math.pi or ratio < 4.0 * math.log(y.size):
        raise ValueError(
            "y does not decay: no time constant explains more of it than chance; begin the record "
            "where u was switched, and keep u steady"
        )
    if a * y.size <= _STRAIGHT:
        raise ValueError(
            "y does not decay: it moves on as a straight line or faster; record longer, until it "
            "comes to rest"
        )
    half = WITHIN_95 * math.sqrt(max(float(estimate.covariance[0, 0]), 0.0))
    spread = float(np.linalg.norm(centred))
    low, high = gain_interval(
        estimate.theta[:1], float(estimate.theta[1]), estimate.covariance[:2, :2]
    )
    return FreeDecay(
        dt / a,
        (dt / (a + half), dt / (a - half) if half < a else math.inf),
        float(estimate.theta[1]) / a,
        (low, high),
        float(simulated[0]),
        100.0 * (1.0 - float(np.linalg.norm(y - simulated)) / spread),
        dt,
        y,
        simulated,
    )


def _decay(y: Vector) -> ParameterEstimate:
    """Return the best exponential from several time constants."""
    structure, v = Structure(1, 0, (0,)), np.ones((y.size, 1))
    rates = np.geomspace(0.3 / y.size, 1.0, _RATES)
    tried = [refine(structure, with_poles(structure, np.array([a])), v, y, _STEPS) for a in rates]
    return min(tried, key=lambda one: one.cost)


def free_swing(y: Any, dt: float, modes: int | None = None) -> FreeSwing:
    """Return frequency and damping of the modes of a y that rings while u rests.

    Parameters
    ----------
    y
        record (N,) from soon after the knock on [y-unit].
    dt
        sample time [s].
    modes
        number of modes, 1 to 5; by default as many as the record tells apart.

    Raises
    ------
    ValueError
        for a y that does not ring, and for a record that is too short.

    Examples
    --------
    >>> import numpy as np
    >>> import quell as ql
    >>> t = np.arange(800) * 0.002
    >>> y = 3.0 + np.exp(-0.02 * 50.0 * t) * np.cos(50.0 * t)
    >>> (mode,) = ql.identification.free_swing(y, dt=0.002).modes
    >>> round(mode.omega, 3), round(mode.damping, 4)
    (50.01, 0.02)
    """
    y, dt = checks.vector("y", y), checks.positive("dt", dt, "s")
    most = _MOST_MODES if modes is None else checks.whole("modes", modes, 1, _MOST_MODES)
    if y.size < _PER_MODE * (modes or 1):
        raise ValueError(
            f"y has {y.size} samples: must have at least {_PER_MODE} for each mode; record longer"
        )
    if np.ptp(y) == 0.0:
        raise ValueError(f"y is {y[0]:g} all through: must ring; record it from the knock on")
    v, found, error = np.ones((y.size, 1)), None, y - np.mean(y)
    with one_blas_thread(), np.errstate(all="ignore"):
        least = _ROUNDING * float(np.sum(error**2))
        poles = _pencil(y)
        decay = _decay(y)
        left = y - output(Structure(1, 0, (0,)), decay.theta, v)
        # What decays is no mode that is damped so much that it hardly swings.
        if math.isfinite(decay.cost) and likelihood_ratio((error, left), least) > 3.0 * math.log(
            y.size
        ):
            error = left
        for count in range(modes or 1, most + 1):
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
        if found is None:
            raise ValueError(
                "y does not ring: no pole with a frequency that its samples show was found; is it "
                "a free swing, after a knock, while u rests? A heat-up or coast-down is for "
                "free_decay"
            )
        return _result(*found, y, dt)


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
    covariance = estimate.covariance[:n, :n]
    roots = np.roots(np.append(1.0, a[::-1]))
    upper = roots[roots.imag > 0.0]
    simulated = output(structure, estimate.theta, np.ones((y.size, 1)))
    at_rest = float(estimate.theta[n] / a[0])
    t = np.arange(float(y.size))
    shapes = np.exp(np.outer(t, upper))
    columns = np.column_stack([shapes.real, shapes.imag])
    sizes = np.linalg.lstsq(columns, simulated - at_rest, rcond=None)[0]
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
    modes.sort(key=lambda mode: -mode.amplitude)
    spread = float(np.linalg.norm(y - np.mean(y)))
    fit = 100.0 * (1.0 - float(np.linalg.norm(y - simulated)) / spread)
    return FreeSwing(tuple(modes), at_rest, fit, dt, y, simulated)
