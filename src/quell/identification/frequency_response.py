"""The frequency response as the record itself has it, without a model."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.types import Vector


class FrequencyResponse(NamedTuple):
    """Ratios of spectra."""

    omega: Vector
    """[rad/s] (points,)."""
    response: Any
    """complex [y-unit/u-unit] (points,)."""
    coherence: Vector
    """the share of y that is explained by u (by ``reference`` where that was given), 0 to 1 (points,)."""
    deviation: Vector
    """relative standard deviation of ``response`` (points,)."""


def frequency_response(
    u: Any, y: Any, dt: float, *, reference: Any = None, segments: int = 8
) -> FrequencyResponse:
    """Estimate the frequency response from u to y by averaged spectra, without a model.

    ``Ĝ = S_yu/S_uu`` over half-overlapping segments with a Hann window (Welch, *IEEE Trans. Audio Electroacoustics* 15, 1967), of the
    differences of u and y: that leaves the ratio as it is, and an integrator's drift does not leak over all frequencies. In a closed loop
    it is biased, as u answers to the noise in y too; with what was sent into the loop from outside it is not: ``Ĝ = S_yr/S_ur``
    (Söderström & Stoica, *System Identification*, 1989, sec. 10.3). Its relative variance is about ``(1 − γ²)/(2 γ² n)`` for the
    coherence γ² and n independent averages (Bendat & Piersol, *Random Data*, 4th ed. 2010, sec. 9.2).

    Parameters
    ----------
    u, y
        the record (N,) [u-unit], [y-unit].
    dt
        sample time [s].
    reference
        what was sent into the loop from outside (N,), of data from a closed loop.
    segments
        how many segments the record is cut into, 2 or more: more are smoother and blur resonances.

    Returns
    -------
    FrequencyResponse
        at frequencies up to half the sampling rate, zero not among them.

    Raises
    ------
    ValueError
        for records that are not of one length, or too short for so many segments.
    """
    from scipy.signal import csd, welch

    u, y = checks.vector("u", u), checks.vector("y", y)
    checks.vector("y", y, u.size)
    r = u if reference is None else checks.vector("reference", reference, u.size)
    length = (u.size - 1) // checks.whole("segments", segments, 2)
    if length < 16:
        raise ValueError(
            f"u has {u.size} samples: must have at least {17 * segments} for {segments} segments; take fewer"
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
    return FrequencyResponse(
        2.0 * np.pi * frequency[good],
        response[good],
        np.minimum(coherence[good], 1.0),
        deviation[good],
    )
