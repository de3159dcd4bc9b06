"""The empirical frequency response: averaged spectra of a record, without a model."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.types import Vector


class FrequencyResponse(NamedTuple):
    """An empirical frequency response."""

    omega: Vector  #: [rad/s] (points,)
    response: NDArray[np.complex128]  #: complex [y-unit/u-unit] (points,)
    coherence: Vector  #: share of y's power that u or ``reference`` explains, 0 to 1 (points,)
    deviation: Vector  #: relative standard deviation of ``response`` (points,)


def frequency_response(
    u: Any, y: Any, dt: float, *, reference: Any = None, segments: int = 8
) -> FrequencyResponse:
    """Estimate the frequency response from u to y by averaged spectra, without a model.

    ``Ĝ = S_yu/S_uu`` over half-overlapping segments with a Hann window (Welch, *IEEE Trans. Audio
    Electroacoustics* 15, 1967). The spectra are those of the differences of u and y, which have the
    same ratio, and in which the drift of an integrator does not leak over all frequencies. In a
    closed loop the ratio is biased, as u reacts to the noise in y; with the external signal ``Ĝ =
    S_yr/S_ur`` is not (Söderström & Stoica, *System Identification*, 1989, sec. 10.3). The relative
    variance is about ``(1 − γ²)/(2 γ² n)`` for the coherence γ² and n independent averages (Bendat
    & Piersol, *Random Data*, 4th ed. 2010, sec. 9.2).

    Parameters
    ----------
    u, y
        the record (N,) [u-unit], [y-unit].
    dt
        sample time [s].
    reference
        external signal of a closed loop (N,).
    segments
        number of segments, 2 or more: with more the response is smoother, and resonances are
        blurred.

    Returns
    -------
    FrequencyResponse
        at frequencies up to half the sampling rate, without zero.

    Raises
    ------
    ValueError
        for records that differ in length, or are too short for the number of segments.
    """
    from scipy.signal import csd, welch

    u, y = checks.vector("u", u), checks.vector("y", y)
    checks.vector("y", y, u.size)
    r = u if reference is None else checks.vector("reference", reference, u.size)
    length = (u.size - 1) // checks.whole("segments", segments, 2)
    if length < 16:
        raise ValueError(
            f"u has {u.size} samples: must have at least {17 * segments} for {segments} segments; "
            "take fewer"
        )
    settings = {"fs": 1.0 / checks.positive("dt", dt, "s"), "nperseg": length, "detrend": False}
    du, dy, dr = np.diff(u), np.diff(y), np.diff(r)
    frequency, ry = csd(dr, dy, **settings)
    ru = csd(dr, du, **settings)[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.abs(ry) ** 2 / (welch(dr, **settings)[1] * welch(dy, **settings)[1])
        response = ry / ru
        deviation = np.sqrt(np.maximum(1.0 - coherence, 0.0) / (2.0 * coherence * segments))
    good = np.isfinite(response) & np.isfinite(deviation) & (frequency > 0.0)
    omega, coherence = 2.0 * np.pi * frequency[good], np.minimum(coherence[good], 1.0)
    return FrequencyResponse(omega, response[good], coherence, deviation[good])
