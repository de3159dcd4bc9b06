"""The empirical frequency response: G(jω) of a record, with coherence, without a model.

Three estimates, all of the differences of u and y, which have the same ratio and in which the drift
of an integrator does not leak over all frequencies:

*Welch*: ``Ĝ = S_yu/S_uu`` over half-overlapping segments with a Hann window (Welch, *IEEE Trans.
Audio Electroacoustics* 15, 1967). Its resolution is that of a segment. The relative variance is
about ``(1 − γ²)/(2 γ² n)`` for the coherence γ² and n independent averages (Bendat & Piersol,
*Random Data*, 4th ed. 2010, sec. 9.2).

*Periods*: a u that repeats itself M times has each M-th line of the spectrum of all periods.
Between them are the noise and the transient of the start: this is a polynomial of second degree
over the nearest 12 of these lines, what they are off it is the noise, and its value is taken from Y
and U at the line (Pintelon & Schoukens, *System Identification*, 2nd ed. 2012, sec. 7.3).

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
# Half width of the window of local polynomials [lines], their degree, most samples of a
# segment, as more lines are more than a model needs, and lines near s = 0. Chosen by hand.
_HALF, _DEGREE, _LONGEST, _LOW = 6, 2, 16384, 64
# Least number of periods, and of samples of one; largest change from one to the next, as a share of
# the power; and least size of a line, as a share of the largest. Chosen by hand.
_PERIODS, _SHORTEST, _REPEATS, _LINE = 3, 16, 1e-8, 1e-3
# Relative singular value that counts as zero, and what may be lost by it.
_RANK, _DECIDED = 1e-10, 1e-6
# Variance relative to that of an even spectrum which is too much, and size of a spectrum, as a
# share of the largest, that is none. Chosen by hand.
_MULTIPLIED, _NO_POWER = 100.0, 1e-5
# Largest relative deviation of a point that is printed, and number of points. Chosen by hand.
KNOWN = 0.2
"""Relative deviation up to which a point of Ĝ is taken as known."""

_ROWS = 40
# Relative deviation of a response to the reference from which on it is lost: by hand.
_LOST = 0.15


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
        """Which points have a relative deviation of 0.2 at most."""
        return self.deviation <= KNOWN

    def describe(self) -> str:
        """Return how it was estimated, and how many points are known, as text."""
        names = {
            "welch": "averaged spectra",
            "periods": "periods of u",
            "local": "local polynomials",
        }
        share = f"{np.sum(self.known)} of {self.omega.size} frequencies"
        lines = [f"by {names[self.method]}: {share} are known within {100.0 * KNOWN:g} %"]
        if not np.any(self.known):
            lines.append(
                "NOT: noise hides the response at all frequencies; excite with more power, or "
                "record longer"
            )
        return "\n".join(lines)

    def rows(self, most: int = _ROWS) -> list[int]:
        """Return the places of some known points, evenly over the logarithm of frequency."""
        places = np.flatnonzero(self.known)
        if places.size <= most:
            return places.tolist()
        marks = np.geomspace(self.omega[places[0]], self.omega[places[-1]], most)
        near = np.abs(np.log(self.omega[places][:, None] / marks)).argmin(axis=0)
        return sorted({int(places[i]) for i in near})

    def save(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the known points as a table that ``frequency_table`` reads, or nothing at all.

        Raises
        ------
        ValueError
            if the file can't be written, or exists and ``overwrite`` is False.
        """
        lines = [
            f"{f:.9g},{g.real:.9g},{g.imag:.9g},{c:.6g},{d:.4g}\n"
            for f, g, c, d, known in zip(
                self.frequency.tolist(),
                self.response,
                self.coherence,
                self.deviation,
                self.known,
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
        for records that differ in length, are too short for the number of segments, have no
        periods, or a u that tells G from the transient at no frequency.

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
        return _periods(u, y, r, dt, reference is not None)
    if method == "local":
        return _local(u, y, r, dt, segments, reference is not None)
    return _welch(u, y, r, dt, 8 if segments is None else segments)


def hold_of(s: NDArray[Any], dt: float | None) -> NDArray[Any] | float:
    """Return the response of a hold of u for ``dt``, 1 without one."""
    if dt is None:
        return 1.0
    return np.asarray(np.exp(-0.5 * s * dt) * np.sinc(s.imag * dt / (2.0 * np.pi)))


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
    if not np.any(good) and method != "welch":
        raise ValueError(
            "u: no frequency is told apart from the transient of the start, as after one step; "
            "excite with a PRBS, a multisine or a chirp (quell excite)"
        )
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


def _periods(u: Vector, y: Vector, r: Vector, dt: float, closed: bool) -> FrequencyResponse:
    """Return the response at the lines of a periodic signal."""
    period = _period(r)
    if not period:
        raise ValueError(
            'method = "periods": u (or the reference) does not repeat itself three times; take '
            '"local"'
        )
    count = (u.size - 1) // period
    first = u.size - 1 - count * period
    U, Y, R = (np.fft.rfft(np.diff(x)[first:]) for x in (u, y, r))
    at = np.arange(count, R.size, count)
    at = at[(np.abs(R[at]) > _LINE * np.max(np.abs(R))) & (2 * at < count * period)]
    between = np.flatnonzero(np.arange(R.size) % count)
    at_line = np.zeros((at.size, 2), dtype=np.complex128)
    noise = np.zeros((at.size, 3))
    for i, k in enumerate(at.tolist()):
        near = between[np.argsort(np.abs(between - k), kind="stable")[: 2 * _HALF]]
        powers = ((near - k) / _HALF)[:, None] ** np.arange(_DEGREE + 1)
        both = np.column_stack([Y[near], U[near]])
        transients, *_ = np.linalg.lstsq(powers, both, rcond=None)
        at_line[i] = Y[k] - transients[0, 0], U[k] - transients[0, 1]
        error = both - powers @ transients
        # The transient at the line itself is not certain either.
        more = 1.0 + float(np.linalg.inv(powers.T @ powers)[0, 0])
        of_line = _powers(error[None], at_line[i : i + 1])
        noise[i] = of_line[0] * more / (near.size - _DEGREE - 1)
    omega = 2.0 * np.pi * at / (count * period * dt)
    return _found(omega, *_ratio(at_line, noise, 1.0, closed), "periods")


def _local(
    u: Vector, y: Vector, r: Vector, dt: float, segments: int | None, closed: bool
) -> FrequencyResponse:
    """Return the response by local polynomials, averaged over segments."""
    count = u.size - 2
    least = 4 * (2 * _HALF + 1)
    parts = -(-count // _LONGEST) if segments is None else checks.whole("segments", segments, 1)
    length = count // parts
    if length < least:
        raise ValueError(
            f"u has {u.size} samples: must have at least {parts * least + 2} for {parts} "
            f"segment{'s' * (parts > 1)}; take fewer, or record longer"
        )

    def spectra(x: Vector, times: int) -> Complex:
        blocks = np.diff(x, times)[: parts * length].reshape(parts, length)
        return np.asarray(np.fft.rfft(blocks, axis=1)[:, 1 : (length + 1) // 2])

    U, Y, R = (spectra(x, 1) for x in (u, y, r))
    lines = R.shape[1]
    omega = 2.0 * np.pi * np.arange(1, lines + 1) / (length * dt)
    size = np.sqrt(np.mean(np.abs(R) ** 2, axis=0))
    known = _polynomials(U, Y, R, np.arange(lines), _DEGREE, closed)
    # Between the lines of a multisine G has no slope that could be told; at a line it is known.
    spread = np.lib.stride_tricks.sliding_window_view(np.pad(size, _HALF), 2 * _HALF + 1)
    alone = np.median(spread, axis=1) < _LINE * size
    sparse = np.flatnonzero(np.isnan(known[0]) & alone & (size > _LINE * np.max(size)))
    if sparse.size:
        at_lines = _polynomials(U, Y, R, sparse, 0, closed)
        for values, new in zip(known, at_lines, strict=True):
            values[sparse] = new
    # Near s = 0 that of an integrator is no polynomial, but its product with (z − 1)^d is.
    low = np.arange(min(_LOW, lines))
    U, R = spectra(u, 0), spectra(r, 0)
    for d in (1, 2):
        other = _polynomials(U, spectra(y, d), R, low, _DEGREE, closed)
        other[0][:] /= (np.exp(1j * omega[low] * dt) - 1.0) ** d
        better = np.nan_to_num(other[2], nan=np.inf) < np.nan_to_num(known[2][low], nan=np.inf)
        better &= np.isfinite(other[0])
        for values, new in zip(known, other, strict=True):
            values[low[better]] = new[better]
    return _found(omega, *known, "local")


def _polynomials(
    U: Complex, Y: Complex, R: Complex, at: NDArray[np.int64], degree: int, closed: bool
) -> tuple[Complex, Vector, Vector]:
    """Return response, coherence and deviation at some lines; NaN where they are not determined.

    The spectra are (segments, lines). All segments have one G, of ``degree``, and each its own
    transient, which is projected out.
    """
    parts, lines = R.shape
    # At the ends the window is not symmetric: its centre moves.
    middle = np.clip(at, _HALF, lines - 1 - _HALF)
    places = middle[:, None] + np.arange(-_HALF, _HALF + 1)
    away = (places - at[:, None]) / _HALF
    powers = away[:, :, None] ** np.arange(_DEGREE + 1)
    Q = np.linalg.qr(powers)[0]

    def free(Z: Complex) -> Complex:
        return np.asarray(Z - Q @ (np.swapaxes(Q, 1, 2) @ Z))

    size = np.sqrt(np.mean(np.abs(R[:, places]) ** 2, axis=(0, 2)))
    scale = np.where(size > 0.0, size, 1.0)[:, None, None]
    width = degree + 1
    gram = np.zeros((at.size, width, width), dtype=np.complex128)
    right = np.zeros((at.size, width, 2), dtype=np.complex128)
    for of_u, of_y, of_r in zip(U, Y, R, strict=True):
        X = free(of_r[places][:, :, None] * powers[:, :, :width] / scale)
        Xh = np.conj(np.swapaxes(X, 1, 2))
        gram += Xh @ X
        right += Xh @ free(np.stack([of_y[places], of_u[places]], axis=2))
    inverse = np.linalg.pinv(gram, rcond=_RANK, hermitian=True)
    found = inverse @ right
    if not closed:  # u is its own response
        found[:, :, 1] = 0.0
        found[:, 0, 1] = scale[:, 0, 0]
    noise = np.zeros((at.size, 3))
    for of_u, of_y, of_r in zip(U, Y, R, strict=True):
        X = of_r[places][:, :, None] * powers[:, :, :width] / scale
        error = free(np.stack([of_y[places], of_u[places]], axis=2) - X @ found)
        noise += _powers(error, found[:, 0])
    noise /= parts * (2 * _HALF - _DEGREE) - width
    # Few lines tell the noise of one: with that of its neighbours none looks known by chance.
    noise = np.maximum(noise, _smoothed(noise))
    response, coherence, deviation = _ratio(found[:, 0], noise, np.abs(inverse[:, 0, 0]), closed)
    undecided = np.abs((inverse @ gram)[:, 0, 0] - 1.0) > _DECIDED
    # After a step u is as smooth over frequency as a transient: noise and curvature of G are
    # multiplied. Where u has no power there is nothing to tell either.
    worse = parts * (2 * _HALF + 1) * np.abs(inverse[:, 0, 0]) > _MULTIPLIED
    nothing = size <= _NO_POWER * np.max(np.abs(R))
    response[undecided | worse | nothing] = np.nan
    return response, coherence, deviation


def _powers(error: Complex, found: Complex) -> Vector:
    """Return the sums of |e_y|², |e_u|² and |e_y − G e_u|² (points, 3), with G = y/u.

    ``error`` (points, lines, 2) and the responses ``found`` (points, 2) are of y and u.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        G = (found[:, 0] / found[:, 1])[:, None]
    parts = error[:, :, 0], error[:, :, 1], error[:, :, 0] - G * error[:, :, 1]
    return np.column_stack([np.sum(np.abs(part) ** 2, axis=1) for part in parts])


def _ratio(
    found: Complex, noise: Vector, share: Vector | float, closed: bool
) -> tuple[Complex, Vector, Vector]:
    """Return the ratio of the responses y and u (points, 2), its coherence and its deviation.

    ``noise`` are the variances of ``_powers`` for a line, of which the responses have a ``share``.
    Where a response in a closed loop is lost in noise the ratio is minus the inverse of the
    controller, for which e_y − G e_u is small: then its own deviation counts.
    """
    y, u = found.T
    with np.errstate(divide="ignore", invalid="ignore"):
        response, power = y / u, np.abs(y) ** 2
        # Real and imaginary part have half of the variance each.
        of_y, of_u, deviation = np.sqrt(
            0.5 * share * noise.T / np.array([power, np.abs(u) ** 2, power])
        )
        own = np.maximum(of_y, of_u)
        if closed:
            deviation = np.where(own > _LOST, np.maximum(own, deviation), deviation)
        return response, power / (power + noise[:, 0 if closed else 2]), deviation


def _smoothed(noise: Vector) -> Vector:
    """Return the mean over 4 n + 1 points, of fewer at the ends (points, columns)."""
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(noise, 4 * _HALF + 1, axis=0, mode="nearest"))
