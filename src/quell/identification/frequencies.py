"""The empirical frequency response: G(jω) of a record, with coherence, without a model.

Three estimates, all of the differences of u and y, which have the same ratio and in which the drift
of an integrator does not leak over all frequencies:

*Welch*: ``Ĝ = S_yu/S_uu`` over half-overlapping segments with a Hann window (Welch, *IEEE Trans.
Audio Electroacoustics* 15, 1967). Its resolution is that of a segment. The relative variance is
about ``(1 − γ²)/(2 γ² n)`` for the coherence γ² and n independent averages (Bendat & Piersol,
*Random Data*, 4th ed. 2010, sec. 9.2).

*Periods*: of a u that repeats itself, all periods but the first are averaged. There is no leakage,
and what differs between them is noise (Pintelon & Schoukens, *System Identification*, 2nd ed. 2012,
sec. 2.4): with the errors ``e_m = Y_m − Ĝ U_m`` of M periods the variance of Ĝ is ``Σ|e_m|²/(M (M −
1) |Ū|²)``.

*Local polynomials*: leakage is a transient that is as smooth over frequency as G. Around each
frequency both are polynomials of second degree over 2 n + 1 lines (Pintelon, Schoukens,
Vandersteen & Barbé, *Mechanical Systems and Signal Processing* 24, 2010)::

    Y(k + r) = U(k + r) Σ g_i r^i + Σ t_i r^i + E,     |r| ≤ n,     Ĝ = g_0

by least squares; what is left over gives the variance of E, and with it that of Ĝ. So a resonance
that is narrower than the lines of a segment of Welch's method keeps its height.

In a closed loop the ratio of y to u is biased, as u reacts to the noise in y. With an external
signal both are estimated as responses to it, ``Ĝ = G_yr/G_ur`` (Söderström & Stoica, *System
Identification*, 1989, sec. 10.3).

``γ² = |Ĝ|² S_uu/(|Ĝ|² S_uu + S_ee)`` is the share of y's power that u explains.
"""

from __future__ import annotations

import math
import os
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.files import nonfinite_to_none, written_atomically
from quell.records.plotting import draw_line, given_axes, grid_of_axes, new_figure
from quell.types import Vector

Complex = NDArray[np.complex128]

METHODS = ("welch", "periods", "local", "auto")
# Half width of the window of local polynomials [lines], their degree, and most samples of a
# segment: with more the lines would be more than a plot or a model needs. Chosen by hand.
_HALF, _DEGREE, _LONGEST = 6, 2, 16384
# Least number of periods, and of samples of one; largest change from one to the next, as a share of
# the power; and least size of a line, as a share of the largest. Chosen by hand.
_PERIODS, _SHORTEST, _REPEATS, _LINE = 3, 16, 1e-8, 1e-3
# Largest relative deviation of a point that is printed, and number of points. Chosen by hand.
KNOWN = 0.3
"""Relative deviation up to which a point of Ĝ is taken as known."""

_ROWS = 40


class FrequencyResponse(NamedTuple):
    """An empirical frequency response."""

    omega: Vector  #: [rad/s] (points,)
    response: Complex  #: complex [y-unit/u-unit] (points,)
    coherence: Vector  #: share of y's power that u or ``reference`` explains, 0 to 1 (points,)
    deviation: Vector  #: relative standard deviation of ``response`` (points,)
    method: str = "welch"  #: how it was estimated

    @property
    def frequency(self) -> Vector:
        """Frequencies [Hz]."""
        return self.omega / (2.0 * math.pi)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which points have a relative deviation of 0.3 at most."""
        return self.deviation <= KNOWN

    def rows(self, most: int = _ROWS) -> list[int]:
        """Return the places of some known points, evenly over the logarithm of frequency."""
        places = np.flatnonzero(self.known)
        if places.size <= most:
            return places.tolist()
        marks = np.geomspace(self.omega[places[0]], self.omega[places[-1]], most)
        near = np.abs(np.log(self.omega[places][:, None] / marks)).argmin(axis=0)
        return sorted({int(places[i]) for i in near})

    def save(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the known points as a table that ``read_frequencies`` reads, or nothing at all.

        Raises
        ------
        ValueError
            if the file can't be written, or exists and ``overwrite`` is False.
        """
        lines = [
            f"{f:.9g},{g.real:.9g},{g.imag:.9g},{c:.6g},{d:.4g}\n"
            for f, g, c, d, known in zip(
                self.frequency.tolist(), self.response, self.coherence, self.deviation, self.known,
                strict=True,
            )
            if known
        ]
        with written_atomically(path, overwrite) as part:
            head = "f [Hz],real,imag,coherence,deviation\n"
            part.write_text(head + "".join(lines), encoding="utf-8")

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw size and phase of the known points, and the coherence; return the three axes.

        ``axes`` are three matplotlib axes, those of a new figure by default.
        """
        figure = partial(new_figure, 8.0, 6.0)
        axes = np.ravel(grid_of_axes(given_axes(axes, ax), figure, 3, sharex="all"))
        f, known = self.frequency, self.known
        size = np.where(known, np.abs(self.response), np.nan)
        phase = np.full(f.size, np.nan)
        phase[known] = np.degrees(np.unwrap(np.angle(self.response[known])))
        for each, values, label in (
            (axes[0], size, "|G|"),
            (axes[1], phase, "phase of G [°]"),
            (axes[2], self.coherence, "coherence"),
        ):
            draw_line(each, f, values, color="C0", marker=".", markersize=2.0, linewidth=0.8)
            each.set_ylabel(label)
            each.grid(alpha=0.3)
        axes[0].set(xscale="log", yscale="log")
        axes[2].set(xlabel="frequency [Hz]", ylim=(0.0, 1.05))
        return axes

    def to_json(self) -> dict[str, Any]:
        """Return all points for JSON; None for numbers that are not finite."""
        value = {
            "method": self.method,
            "omega": self.omega.tolist(),
            "real": self.response.real.tolist(),
            "imag": self.response.imag.tolist(),
            "coherence": self.coherence.tolist(),
            "deviation": self.deviation.tolist(),
        }
        return dict(nonfinite_to_none(value))


def frequency_response(
    u: Any,
    y: Any,
    dt: float,
    *,
    reference: Any = None,
    segments: int | None = None,
    method: str = "welch",
) -> FrequencyResponse:
    """Estimate the frequency response from u to y, without a model.

    The equations are in ``quell.identification.frequencies``.

    Parameters
    ----------
    u, y
        the record (N,) [u-unit], [y-unit].
    dt
        sample time [s].
    reference
        external signal of a closed loop (N,).
    segments
        number of segments: 2 or more for ``"welch"``, 8 by default; with more the response is
        smoother, and resonances are blurred. For ``"local"`` 1 or more; by default as many as give
        16384 samples each at most.
    method
        ``"welch"``, ``"periods"`` of a u that repeats itself three times at least, ``"local"``
        polynomials, or ``"auto"``: periods where u (or the reference) has them, else local
        polynomials.

    Returns
    -------
    FrequencyResponse
        at frequencies up to half the sampling rate, without zero; of periods at those that u has.

    Raises
    ------
    ValueError
        for records that differ in length, are too short for the number of segments, or have no
        periods.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> u = np.sign(np.random.default_rng(0).standard_normal(4000))
    >>> y = lfilter([0.0, 0.1], [1.0, -0.9], u)
    >>> found = frequency_response(u, y, dt=0.01, method="local")
    >>> at = np.argmin(np.abs(found.omega - 10.0))
    >>> exact = 0.1 / (np.exp(1j * found.omega[at] * 0.01) - 0.9)
    >>> bool(abs(found.response[at] / exact - 1.0) < 1e-3)
    True
    """
    u, y = checks.vector("u", u), checks.vector("y", y)
    checks.vector("y", y, u.size)
    r = u if reference is None else checks.vector("reference", reference, u.size)
    dt = checks.positive("dt", dt, "s")
    checks.one_of("method", method, METHODS)
    if method == "auto":
        method = "local" if segments is not None or not _period(r) else "periods"
    if method == "periods":
        if segments is not None:
            raise ValueError(f"segments = {segments!r}: has no effect on periods; leave it out")
        return _periods(u, y, r, dt)
    if method == "local":
        return _local(u, y, r, dt, segments, reference is not None)
    return _welch(u, y, r, dt, 8 if segments is None else segments)


def _welch(u: Vector, y: Vector, r: Vector, dt: float, segments: int) -> FrequencyResponse:
    from scipy.signal import csd, welch

    length = (u.size - 1) // checks.whole("segments", segments, 2)
    if length < 16:
        raise ValueError(
            f"u has {u.size} samples: must have at least {17 * segments} for {segments} segments; "
            "take fewer"
        )
    settings = {"fs": 1.0 / dt, "nperseg": length, "detrend": False}
    du, dy, dr = np.diff(u), np.diff(y), np.diff(r)
    frequency, ry = csd(dr, dy, **settings)
    ru = csd(dr, du, **settings)[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.abs(ry) ** 2 / (welch(dr, **settings)[1] * welch(dy, **settings)[1])
        response = ry / ru
        deviation = np.sqrt(np.maximum(1.0 - coherence, 0.0) / (2.0 * coherence * segments))
    return _found(2.0 * np.pi * frequency, response, coherence, deviation, "welch")


def _found(
    omega: Vector, response: Complex, coherence: Vector, deviation: Vector, method: str
) -> FrequencyResponse:
    """Return the points that are numbers, without the frequency zero."""
    good = np.isfinite(response) & np.isfinite(deviation) & (omega > 0.0)
    coherence = np.clip(coherence[good], 0.0, 1.0)
    return FrequencyResponse(omega[good], response[good], coherence, deviation[good], method)


def _period(r: Vector) -> int:
    """Return the period of a signal [samples] that has three at least; 0 if it has none."""
    from scipy.fft import irfft, next_fast_len, rfft

    e = r - np.mean(r)
    power = float(e @ e)
    if power == 0.0 or r.size < _PERIODS * _SHORTEST:
        return 0
    longest = r.size // _PERIODS
    size = next_fast_len(r.size + longest, real=True)
    spectrum = np.abs(rfft(e, size)) ** 2
    both = irfft(spectrum, size)[: longest + 1]
    square = np.concatenate([[0.0], np.cumsum(e * e)])
    lags = np.arange(longest + 1)
    # The power of the difference of the signal and the same later.
    change = square[r.size - lags] + (square[-1] - square[lags]) - 2.0 * both
    for lag in np.flatnonzero(change <= 1e-4 * power):
        if lag >= _SHORTEST:
            away = r[lag:] - r[:-lag]
            if float(away @ away) <= _REPEATS * power:
                return int(lag)
    return 0


def _periods(u: Vector, y: Vector, r: Vector, dt: float) -> FrequencyResponse:
    """Return the response at the lines of a periodic signal; the first period is left out."""
    period = _period(r)
    if not period:
        raise ValueError(
            'method = "periods": u (or the reference) does not repeat itself three times; take '
            '"local"'
        )
    count = (u.size - 1) // period - 1
    first = u.size - 1 - count * period

    def spectra(x: Vector) -> Complex:
        return np.asarray(np.fft.rfft(np.diff(x)[first:].reshape(count, period), axis=1))

    U, Y, R = spectra(u), spectra(y), np.mean(spectra(r), axis=0)
    lines = np.flatnonzero(np.abs(R) > _LINE * np.max(np.abs(R)))
    lines = lines[(lines > 0) & (2 * lines < period)]
    # With one period there is nothing to compare: ``_PERIODS`` leaves two at least.
    U, Y = U[:, lines], Y[:, lines]
    with np.errstate(divide="ignore", invalid="ignore"):
        of_u, of_y = np.mean(U, axis=0), np.mean(Y, axis=0)
        response = of_y / of_u
        noise = np.sum(np.abs(Y - response * U) ** 2, axis=0) / (count - 1)
        variance = noise / count / np.abs(of_y) ** 2
        coherence = np.abs(of_y) ** 2 / (np.abs(of_y) ** 2 + noise)
        # Real and imaginary part have half of it each.
        deviation = np.sqrt(0.5 * variance)
    return _found(2.0 * np.pi * lines / (period * dt), response, coherence, deviation, "periods")


def _local(
    u: Vector, y: Vector, r: Vector, dt: float, segments: int | None, closed: bool
) -> FrequencyResponse:
    """Return the response by local polynomials, averaged over segments."""
    count = u.size - 1
    least = 4 * (2 * _HALF + 1)
    parts = -(-count // _LONGEST) if segments is None else checks.whole("segments", segments, 1)
    length = count // parts
    if length < least:
        raise ValueError(
            f"u has {u.size} samples: must have at least {parts * least + 1} for {parts} "
            f"segment{'s' * (parts > 1)}; take fewer, or record longer"
        )
    signals = [np.diff(x)[: parts * length].reshape(parts, length) for x in (u, y, r)]
    U, Y, R = (np.fft.rfft(x, axis=1)[:, 1 : (length + 1) // 2] for x in signals)
    lines = R.shape[1]
    # At the ends the window is not symmetric: its centre moves.
    middle = np.clip(np.arange(lines), _HALF, lines - 1 - _HALF)
    places = middle[:, None] + np.arange(-_HALF, _HALF + 1)
    away = (places - np.arange(lines)[:, None]) / _HALF
    powers = away[:, :, None] ** np.arange(_DEGREE + 1)
    size = np.sqrt(np.mean(np.abs(R[:, places]) ** 2, axis=(0, 2)))
    size = np.where(size > 0.0, size, 1.0)
    rows = 2 * _HALF + 1
    # All segments have one G and each its own transient.
    width = _DEGREE + 1
    X = np.zeros((lines, parts * rows, width * (1 + parts)), dtype=np.complex128)
    for m in range(parts):
        block = slice(m * rows, (m + 1) * rows)
        X[:, block, :width] = (R[m][places] / size[:, None])[:, :, None] * powers
        X[:, block, width * (m + 1) : width * (m + 2)] = powers
    targets = [np.concatenate([Z[m][places] for m in range(parts)], axis=1) for Z in (Y, U)]
    gram = np.conj(np.swapaxes(X, 1, 2)) @ X
    inverse = np.linalg.pinv(gram, rcond=1e-12, hermitian=True)
    gain = inverse @ np.conj(np.swapaxes(X, 1, 2))
    of_y, of_u = (np.einsum("kij,kj->ki", gain, target) for target in targets)
    free = parts * rows - width * (1 + parts)
    with np.errstate(divide="ignore", invalid="ignore"):
        if closed:
            response = of_y[:, 0] / of_u[:, 0]
            error = targets[0] - response[:, None] * targets[1]
            error = error - np.einsum("kij,kj->ki", X, of_y - response[:, None] * of_u)
            drive = of_u[:, 0]
        else:
            response = of_y[:, 0] / size
            error = targets[0] - np.einsum("kij,kj->ki", X, of_y)
            drive = size.astype(np.complex128)
        noise = np.sum(np.abs(error) ** 2, axis=1) / free
        variance = noise * np.abs(inverse[:, 0, 0]) / np.abs(response * drive) ** 2
        power = np.abs(response * drive) ** 2
        coherence = power / (power + noise)
        deviation = np.sqrt(0.5 * variance)
    # Without any r in the window G is not determined.
    response[np.all(np.abs(R[:, places]) == 0.0, axis=(0, 2))] = np.nan
    omega = 2.0 * np.pi * np.arange(1, lines + 1) / (length * dt)
    return _found(omega, response, coherence, deviation, "local")
