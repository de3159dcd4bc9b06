"""Windows of a record: the numbers of a machine in each, which ``watch`` compares over months.

Each window of a record, a minute or an hour of operation, gives a row of numbers. They come from
what every log has, u and y, by one regression without phase lag::

    order 1    y'  = b_0 u − stiffness y + load
    order 2    y'' = b_0 u − viscous y' − coulomb sign(y') − stiffness y + load

Derivatives are central differences, and all terms, u and sign(y') too, pass the same low-pass
filter forwards and backwards. In a loop the regression is biased by the noise that u contains; as
the loop and the noise are those of the other windows, so is the bias, and a change shows all the
same. The numbers are for comparison: use ``quell b0`` for a gain with an honest interval.

Of several axes each has its own numbers, with v = B0 u in the place of u.

Beside them: the noise of y, from its third differences; the frequency and the height of the highest
peak of y's spectrum above its trend, a resonance of the mechanics; the RMS error r − y and the RMS
u; and of a recorded run of an ADRC the mean and the RMS value of f̂, and the learner's coefficients.
A number that a window does not show, such as b_0 where nothing moved, is NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.commissioning import by_axis, controlled, measured, measured_run, run_in
from quell.files import MAX_SIZE
from quell.identification.record_file import in_common_units
from quell.quantities import Conversion
from quell.realtime.recordings import Event
from quell.records.trajectory import Trajectory
from quell.types import Vector

# A gain whose standard error is above this share of it is not known. Chosen by hand.
_KNOWN = 0.3
# A speed above this share of the fastest is a motion. Chosen by hand.
_MOVES = 0.1
# Band of the regression's filter by default [1/dt]. Chosen by hand: twelve samples of time
# constant leave little of an encoder's steps, and the speed of a move.
_BAND = 0.03
# Segments of the spectrum, its first line, and the factor around a frequency that gives the trend;
# the height above it from which on a peak is one, and lines to both sides that belong to it. Chosen
# by hand (benchmarks/watch.py).
_SEGMENTS, _FIRST, _AROUND, _HIGH, _LINES = 24, 4, 1.6, 2.0, 8
# Least samples of a window: the regression, and a spectrum of a few lines. Chosen by hand.
LEAST_SAMPLES = 200
# A number is rounding, and zero, up to this share of the signals that it is a difference of.
_ROUNDING = 1e-12
# Share of samples that a window may lack. Chosen by hand: it hardly moves the numbers.
MOST_MISSING = 1e-3


class Signals(NamedTuple):
    """The samples of a window, or of a record."""

    u: Vector
    y: Vector  # NaN where nothing was measured
    r: Vector | None
    f: Vector | None  # total disturbance as the controller estimated it
    theta: Mapping[str, Vector]  # the learner's coefficients by name
    dt: float
    y_unit: str = ""
    u_unit: str = ""  # of an axis of several none: its u is v, in the unit of a derivative of y

    def part(self, begin: int, end: int) -> Signals:
        """Return the samples from ``begin`` to before ``end``."""
        cut = slice(begin, end)
        r, f = (None if one is None else one[cut] for one in (self.r, self.f))
        theta = {name: value[cut] for name, value in self.theta.items()}
        return self._replace(u=self.u[cut], y=self.y[cut], r=r, f=f, theta=theta)

    def converted(self, of_y: Conversion, of_u: Conversion) -> Signals:
        """Return the samples in other units, f with y, and without the learner's coefficients."""
        if not (of_y.changes or of_u.changes):
            return self
        r = None if self.r is None else of_y.of(self.r)
        f = None if self.f is None else of_y.factor * self.f
        return self._replace(u=of_u.of(self.u), y=of_y.of(self.y), r=r, f=f, theta={})


def signals_of(
    path: Path,
    columns: str = "",
    dt: float | None = None,
    time_unit: str | None = None,
    max_size: float = MAX_SIZE,
) -> dict[str, Signals]:
    """Read a record of any kind; of a run under control the part in which the loop ran.

    Parameters
    ----------
    path, columns, dt, time_unit, max_size
        as for ``quell.commissioning.measured``.

    Returns
    -------
    dict
        the signals of each axis by its name; of a record of one y and one u the name is empty.

    Raises
    ------
    ValueError
        as ``quell.commissioning.measured``.
    """
    run = run_in(path, columns, dt, time_unit, max_size)
    if run is None:
        record = measured(path, columns, dt, time_unit, max_size)
        found = in_common_units({path.name: record}, error=True)[0][path.name]
        units = found.signals.y.unit, found.signals.u.unit
        return {"": Signals(found.u, found.y, found.reference, None, {}, found.dt, *units)}
    # The u of an axis of several is v, in the unit of a derivative of y.
    return {
        name: _signals_in(each, "" if name else each.signals.u.unit)
        for name, each in by_axis(run).items()
    }


def _signals_in(run: Trajectory, u_unit: str) -> Signals:
    """Return the signals of a run while it was under control."""
    part, known = controlled(run), measured_run(run)
    # As received: NaN where nothing was, or where the loop skipped the deadline.
    y = run["y_measured"][part].copy()
    if "events" in run.names:
        y[(run["events"][part].astype(np.int64) & int(Event.GAP)) != 0] = math.nan
    f = run["f_hat"][part] if "f_hat" in run.names else None
    theta: dict[str, Vector] = {}
    if "theta" in run.names:
        table = run["theta"][part].reshape(known.y.size, -1)
        theta = {name: table[:, i] for i, name in enumerate(run.features)}
    units = run.signals.y.unit, u_unit
    return Signals(known.u, y, known.reference, f, theta, known.dt, *units)


def windows_of(signals: Signals, length: float) -> Iterator[Signals]:
    """Yield the windows of ``length`` [s]; what is left at the end is left out."""
    samples = round(length / signals.dt)
    for begin in range(0, signals.y.size - samples + 1, samples):
        yield signals.part(begin, begin + samples)


def features_of(signals: Signals, order: int, band: float | None = None) -> dict[str, float]:
    """Return the numbers of a window by name; NaN where it does not show one.

    Parameters
    ----------
    signals
        samples of the window, ``LEAST_SAMPLES`` or more.
    order
        1 or 2: u acts on this derivative of y.
    band
        band of the regression [rad/s], above that of the moves and below that of a resonance;
        0.08/dt by default.

    Raises
    ------
    ValueError
        for an order or a band out of range, too few samples, or values that are not finite.
    """
    order = checks.whole("order", order, 1, 2)
    dt = checks.positive("dt", signals.dt, "s")
    y, u = checks.vector("y", signals.y), checks.vector("u", signals.u)
    check_window(y.size)
    band = _BAND / dt if band is None else checks.positive("band", band, "rad/s")
    if band * dt >= 0.5 * math.pi:
        raise ValueError(f"band = {band!r} rad/s: must be below {0.5 * math.pi / dt:.4g} (pi/2/dt)")
    found = _regression(u, y, dt, order, band)
    largest = float(np.max(np.abs(y)))
    found["noise"] = _above_rounding(_noise(y), largest)
    found |= _resonance(y, dt)
    found["u_rms"] = _rms(u)
    if signals.r is not None:
        r = checks.vector("r", signals.r, y.size)
        found["error"] = _above_rounding(_rms(r - y), max(largest, float(np.max(np.abs(r)))))
    if signals.f is not None:
        f = checks.vector("f", signals.f, y.size)
        size = _rms(f)
        found["f_mean"], found["f_rms"] = _above_rounding(float(np.mean(f)), size), size
    for name, value in signals.theta.items():
        found[f"theta {name}"] = float(np.mean(value))
    return found


def without_gaps(signals: Signals) -> Signals | None:
    """Return a window with its missing measurements interpolated; None if they are too many."""
    missing = ~np.isfinite(signals.y)
    if not np.any(missing):
        return signals
    if np.mean(missing) > MOST_MISSING:
        return None
    places = np.arange(signals.y.size)
    y = signals.y.copy()
    y[missing] = np.interp(places[missing], places[~missing], y[~missing])
    return signals._replace(y=y)


def check_window(samples: int) -> None:
    """Raise ``ValueError`` for a window with too few samples."""
    if samples < LEAST_SAMPLES:
        rule = f"must have {LEAST_SAMPLES}; take longer windows"
        raise ValueError(f"a window of {samples} samples: {rule}")


def _rms(values: Vector) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _above_rounding(value: float, size: float) -> float:
    """Return a value, or zero where it is rounding of numbers of this size."""
    return value if abs(value) > _ROUNDING * size else 0.0


def _noise(y: Vector) -> float:
    """Return the deviation of white noise in y: third differences are (1, 3, 3, 1) times it."""
    return _rms(np.diff(y, 3)) / math.sqrt(20.0)


def _regression(u: Vector, y: Vector, dt: float, order: int, band: float) -> dict[str, float]:
    """Return gain, friction, stiffness and load."""
    from scipy.signal import butter, sosfiltfilt

    filtered = butter(2, band * dt / math.pi, output="sos")
    smooth = sosfiltfilt(filtered, y)
    speed = (smooth[2:] - smooth[:-2]) / (2.0 * dt)
    # A held u acts on the central differences at k from k − 1 to k + 1.
    acting = sosfiltfilt(filtered, 0.5 * (u[:-1] + u[1:]))[:-1]
    names, columns = ["b0", "stiffness", "load"], [acting, -smooth[1:-1], np.ones(speed.size)]
    target = speed
    if order == 2:
        target = (smooth[2:] - 2.0 * smooth[1:-1] + smooth[:-2]) / dt**2
        names += ["viscous", "coulomb"]
        columns += [-speed, -sosfiltfilt(filtered, np.sign(speed))]
    # Friction is known where the axis moves; at rest it is what holds it.
    moves = np.abs(speed) > _MOVES * float(np.quantile(np.abs(speed), 0.95))
    edge = min(round(3.0 / (band * dt)), speed.size // 8)  # where the filter begins and ends
    moves |= order == 1
    moves[:edge] = moves[moves.size - edge :] = False
    regressors, target = np.column_stack(columns)[moves], target[moves]
    size = np.linalg.norm(regressors, axis=0)
    nothing = dict.fromkeys((*names, "unexplained"), math.nan)
    if not np.all(size > 0.0):
        return nothing
    theta, _, rank, _ = np.linalg.lstsq(regressors / size, target, rcond=1e-10)
    if rank < len(names):
        return nothing
    rest = target - (regressors / size) @ theta
    # The filter leaves so many independent samples.
    free = max(target.size * band * dt / math.pi - len(names), 1.0)
    inverse = np.linalg.inv((regressors / size).T @ (regressors / size))
    spread = np.sqrt(np.diag(inverse) * float(rest @ rest) / target.size * target.size / free)
    if not spread[0] < _KNOWN * abs(theta[0]):
        return nothing
    found = dict(zip(names, (theta / size).tolist(), strict=True))
    return found | {"unexplained": _rms(rest)}


def _resonance(y: Vector, dt: float) -> dict[str, float]:
    """Return frequency [rad/s] and height of the highest peak of y's spectrum above its trend.

    In a loop it is the mechanics' resonance as the loop leaves it. |Y/U| would not show it: where
    noise moves u, it is the inverse of the controller.
    """
    from scipy.signal import welch

    length = min(max(2 * y.size // (_SEGMENTS + 1), 64), y.size)
    omega, power = welch(y, fs=2.0 * math.pi / dt, nperseg=length, detrend="linear")
    omega, power = omega[_FIRST:-1], power[_FIRST:-1]
    nothing = {"resonance": math.nan, "peak": math.nan}
    if omega.size < 16 or not np.all(power > 0.0):
        return nothing
    # The trend: the mean of the logarithm at a factor below and above each frequency.
    places, shift, size = np.log(omega), math.log(_AROUND), 0.5 * np.log(power)
    sides = np.interp(places - shift, places, size) + np.interp(places + shift, places, size)
    above = size - 0.5 * sides
    inside = (omega > _AROUND * omega[0]) & (omega < omega[-1] / _AROUND)
    above[~inside] = -math.inf
    k = int(np.argmax(above))
    if not above[k] > math.log(_HIGH):
        return nothing
    # The mean of the lines down to a quarter of the peak's power: finer than a line.
    near = slice(max(k - _LINES, 0), k + _LINES + 1)
    weight = np.where(power[near] > 0.25 * power[k], power[near], 0.0)
    frequency = float(weight @ omega[near] / np.sum(weight))
    return {"resonance": frequency, "peak": math.exp(float(above[k]))}
