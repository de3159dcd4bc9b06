"""Design of excitations for identification, for a frequency band, a duration and limits of u."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.files import written_atomically
from quell.signals.excitation import PRBS, Multisine, schroeder_phases
from quell.signals.shapes import Chirp, Signal
from quell.types import Vector

KINDS = ("multisine", "prbs", "chirp")
# Least and most bits of a PRBS, those of ``signals.PRBS``.
_BITS = (2, 20)
# The spectrum of a PRBS, sinc², is 3 dB down at 0.443 of the rate of its values.
_HALF_POWER = 2.0 * math.pi * 0.443
# Most lines of a multisine: chosen by hand, as more lines look like one in a plot and have less
# power each.
_LINES = 120
# Rounds of clipping: chosen by hand; not tuned further.
_ROUNDS = 400


_Design = tuple[Signal, float, tuple[float, float], str, tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class Excitation:
    """A designed excitation."""

    kind: str
    signal: Signal  #: the excitation for a scenario or a rig; equals ``u`` if sampled and held
    dt: float  #: [s]
    u: Vector  #: samples (N,) [u-unit]
    period: float  #: period [s]; infinite for a chirp
    band: tuple[float, float]  #: lowest and highest frequency that is really excited [rad/s]
    crest: float  #: peak of ``u − mean`` over its RMS: 1 at least, 1.41 for a sinusoid
    rms: float  #: RMS of ``u − mean`` [u-unit]
    details: str  #: the design in a sentence
    shortcomings: tuple[str, ...]  #: requirements that cannot be met; each with a remedy

    @property
    def t(self) -> Vector:
        """Times of the samples [s]."""
        return np.arange(float(self.u.size)) * self.dt

    def describe(self) -> str:
        """Return the design as text."""
        lines = [
            self.details,
            f"excites {self.band[0]:.4g} to {self.band[1]:.4g} rad/s; "
            f"crest factor {self.crest:.3f}, RMS {self.rms:.4g}, "
            f"from {np.min(self.u):.4g} to {np.max(self.u):.4g}",
        ]
        return "\n".join([*lines, *(f"NOT: {text}" for text in self.shortcomings)])

    __str__ = describe

    def save(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write ``t,u`` as CSV, completely or not at all.

        Raises
        ------
        ValueError
            if the file can't be written, or exists and ``overwrite`` is False.
        """
        samples = zip(self.t.tolist(), self.u.tolist(), strict=True)
        rows = "".join(f"{t:.9g},{u:.9g}\n" for t, u in samples)
        with written_atomically(path, overwrite) as part:
            part.write_text("t,u\n" + rows, encoding="utf-8")


def excitation(
    kind: str,
    band: tuple[float, float],
    duration: float,
    dt: float,
    u_min: float = -1.0,
    u_max: float = 1.0,
    *,
    seed: int = 0,
) -> Excitation:
    """Design an excitation that uses the whole range of u.

    Parameters
    ----------
    kind
        * ``"multisine"``: up to 120 lines of equal size, logarithmically spread over the band, all
          with whole numbers of periods, so that a steady response has no leakage. The phases are
          Schroeder's, improved by repeatedly clipping the peaks and keeping the resulting phases
          (van der Ouderaa, Schoukens & Renneboog, *IEEE Trans. Instrumentation and Measurement* 37,
          1988).
        * ``"prbs"``: two values, the least crest factor. The upper end of the band determines how
          long values are held (the spectrum is 3 dB down there), the lower end the length of the
          register.
        * ``"chirp"``: a sinusoid that sweeps once through the band, with equal time per octave.
    band
        lowest and highest frequency [rad/s], the highest below π/dt.
    duration
        [s].
    dt
        sample time [s].
    u_min, u_max
        limits of u, which are reached. With both of the same sign a motor does not turn back: then
        Coulomb friction is a constant force, and does not disturb the identification
        (docs/identification_friction).
    seed
        start of a PRBS, and phase of the first line of a multisine.

    Returns
    -------
    Excitation
        with ``shortcomings`` if not all requirements can be met.

    Raises
    ------
    ValueError
        for a kind, a band, a duration or limits out of range.

    Examples
    --------
    >>> design = excitation("prbs", band=(0.5, 60.0), duration=30.0, dt=1e-3, u_min=-2.0, u_max=2.0)
    >>> round(design.period, 3), round(design.crest, 2)
    (23.506, 1.0)
    """
    checks.one_of("kind", kind, KINDS)
    designs = {"multisine": _multisine, "prbs": _prbs, "chirp": _chirp}
    return _designed(kind, designs[kind], band, duration, dt, u_min, u_max, seed)


def interleaved_excitations(
    actuators: int,
    band: tuple[float, float],
    duration: float,
    dt: float,
    u_min: float | Sequence[float] = -1.0,
    u_max: float | Sequence[float] = 1.0,
    *,
    seed: int = 0,
) -> tuple[Excitation, ...]:
    """Design multisines for actuators that act at the same time, each with lines of its own.

    The lines of the band are dealt out in turn, so no two actuators have one in common. Over whole
    periods their signals are uncorrelated, at any delay, and the responses of coupled axes to each
    can be told apart (Pintelon & Schoukens, *System Identification*, 2nd ed. 2012, sec. 3.7).

    Parameters
    ----------
    actuators
        number of actuators m.
    band, duration, dt
        as for ``excitation``.
    u_min, u_max
        limits, which are reached: one for all, or one for each.
    seed
        phase of the first line.

    Raises
    ------
    ValueError
        as ``excitation``; and for a band with fewer lines than actuators.

    Examples
    --------
    >>> one, other = interleaved_excitations(2, band=(1.0, 50.0), duration=20.0, dt=1e-3)
    >>> bool(abs(one.u @ other.u) / one.u.size < 1e-2)
    True
    """
    m = checks.whole("actuators", actuators, 1)
    low, high = (
        checks.vector(name, given, m) if checks.is_sequence(given) else np.full(m, given)
        for name, given in (("u_min", u_min), ("u_max", u_max))
    )

    def designed(i: int) -> Excitation:
        design = partial(_multisine, part=(i, m))
        limits = float(low[i]), float(high[i])
        return _designed("multisine", design, band, duration, dt, *limits, seed)

    return tuple(map(designed, range(m)))


def save_excitations(
    designs: Sequence[Excitation], path: str | os.PathLike[str], overwrite: bool = False
) -> None:
    """Write ``t,u1,u2,…`` of excitations of several actuators as CSV, or nothing at all.

    Raises
    ------
    ValueError
        if the file can't be written, or exists and ``overwrite`` is False.
    """
    columns = [designs[0].t, *(design.u for design in designs)]
    samples = zip(*(column.tolist() for column in columns), strict=True)
    rows = "".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in samples)
    names = ",".join(["t", *(f"u{i + 1}" for i in range(len(designs)))])
    with written_atomically(path, overwrite) as part:
        part.write_text(f"{names}\n{rows}", encoding="utf-8")


def _designed(
    kind: str,
    design: Callable[..., _Design],
    band: tuple[float, float],
    duration: float,
    dt: float,
    u_min: float,
    u_max: float,
    seed: int,
) -> Excitation:
    """Return a design that uses the whole range of u, with checked arguments."""
    dt, duration = checks.positive("dt", dt, "s"), checks.positive("duration", duration, "s")
    low, high = checks.vector("band", band, 2).tolist()
    if not 0.0 < low < high < math.pi / dt:
        raise ValueError(
            f"band = {band!r}: must rise from above 0 to below pi / dt = {math.pi / dt:.4g} rad/s"
        )
    checks.interval("u_min", checks.finite("u_min", u_min), "u_max", checks.finite("u_max", u_max))
    checks.whole("seed", seed, 0)
    count = math.floor(duration / dt + 1e-9)
    if count < 16 or count * dt * low < 2.0 * math.pi * 0.1:
        raise ValueError(
            f"duration = {duration!r} s: must be at least 16 samples and a tenth of the slowest "
            f"period, {2.0 * math.pi / low:.4g} s"
        )
    signal, period, reached, details, shortcomings = design(low, high, count, dt, seed)
    raw = signal(np.arange(count) * dt)
    bottom, top = float(np.min(raw)), float(np.max(raw))
    scale = (u_max - u_min) / (top - bottom)
    u = np.clip(u_min + scale * (raw - bottom), u_min, u_max)
    away = u - np.mean(u)
    rms = float(np.sqrt(np.mean(away**2)))
    if count * dt * low < 2.0 * math.pi:
        short = f"{duration:g} s is less than one period of {low:.4g} rad/s"
        shortcomings = (*shortcomings, f"{short}; take longer, or begin the band higher")
    crest, signal = float(np.max(np.abs(away))) / rms, scale * signal + (u_min - scale * bottom)
    return Excitation(kind, signal, dt, u, period, reached, crest, rms, details, shortcomings)


def _chirp(low: float, high: float, count: int, dt: float, seed: int) -> _Design:
    sweep = Chirp(1.0, low, high, count * dt, logarithmic=True)
    octaves = math.log2(high / low)
    details = (
        f"chirp from {low:.4g} to {high:.4g} rad/s in {count * dt:.6g} s, "
        f"{count * dt / octaves:.3g} s an octave"
    )
    # A resonance is excited for only as many periods as the sweep stays near it.
    periods = low * count * dt / octaves / (2.0 * math.pi)
    few = f"the lowest octave gets {periods:.2g} periods of its lowest frequency"
    short = f"{few}; take longer, or a multisine"
    return sweep, math.inf, (low, high), details, () if periods >= 1.0 else (short,)


def _prbs(low: float, high: float, count: int, dt: float, seed: int) -> _Design:
    samples = max(1, math.floor(_HALF_POWER / high / dt + 1e-9))
    step, short = samples * dt, []
    wanted = max(math.ceil(math.log2(2.0 * math.pi / (low * step) + 1.0) - 1e-9), _BITS[0])
    fits = math.floor(math.log2(count / samples + 1.0) + 1e-9)
    bits = min(wanted, max(fits, _BITS[0]), _BITS[1])
    signal = PRBS(1.0, bits, step, seed=seed)
    reached = (2.0 * math.pi / signal.period, min(_HALF_POWER / step, math.pi / dt))
    if bits < wanted:
        short.append(
            f"the lowest line is {reached[0]:.4g} rad/s, not {low:.4g}: {wanted} bits take "
            f"{(2**wanted - 1) * step:.4g} s, "
            f"{'more than there are' if bits == fits else 'and 20 bits are the most'}; "
            "take longer, or begin the band higher"
        )
    if reached[1] < high:
        down = f"at {high:.4g} rad/s it is more than 3 dB down, from {reached[1]:.4g} on"
        short.append(f"{down}; sample faster, or end the band lower")
    if signal.period > count * dt + 1e-9:
        times = f"{signal.period:.4g} s fits into {count * dt:.4g} s"
        short.append(f"not one whole period of {times}; take longer")
    hold = f"each held for {samples} samples ({step:.4g} s)"
    details = f"PRBS of {bits} bits, {hold}, period {signal.period:.4g} s"
    return signal, signal.period, reached, details, tuple(short)


def _multisine(
    low: float, high: float, count: int, dt: float, seed: int, part: tuple[int, int] = (0, 1)
) -> _Design:
    """Return the design of a multisine; of ``part`` (i, m) the lines of the i-th of m actuators."""
    # As many periods as the lowest frequency, which needs at least one period itself, allows.
    periods = max(1, math.floor(low * count * dt / (2.0 * math.pi) + 1e-9))
    length = count // periods
    base = 2.0 * math.pi / (length * dt)
    first, last = max(1, math.floor(low / base + 1e-9)), math.floor(high / base + 1e-9)
    last = min(last, (length - 1) // 2)
    if last < first:
        raise ValueError(
            f"band = {(low, high)!r}: has no multiple of {base:.4g} rad/s, "
            "the lowest frequency of the duration; take longer"
        )
    which, parts = part
    spread = np.geomspace(first, last, min(_LINES * parts, last - first + 1))
    every = np.unique(np.round(spread).astype(int))
    if every.size < parts:
        raise ValueError(
            f"band = {(low, high)!r}: has {every.size} lines: must have one for each of {parts} "
            "actuators at least; take longer, or a wider band"
        )
    lines = every[which::parts]
    phases = _flattened(lines, schroeder_phases(np.ones(lines.size)))
    phases = phases + float(seed % 360) * math.pi / 180.0 * (seed > 0)
    signal = Multisine(lines * base, np.ones(lines.size), np.mod(phases, 2.0 * math.pi))
    times = f"{periods} time{'s' if periods > 1 else ''}"
    details = f"multisine of {lines.size} lines, period {length * dt:.6g} s, {times}"
    short = []
    if periods == 1:
        short.append(
            "there is only one period, so the transient of the start is not separated from the "
            "response; take longer for two"
        )
    if every.size < last - first + 1:
        gap = float(np.max(np.diff(lines), initial=0)) * base
        short.append(
            f"lines are up to {gap:.3g} rad/s apart: a narrower resonance may lie between; "
            "take a PRBS or a narrower band"
        )
    reached = (float(lines[0] * base), float(lines[-1] * base))
    return signal, length * dt, reached, details, tuple(short)


def _flattened(lines: NDArray[np.int64], phases: Vector) -> Vector:
    """Return phases with a lower peak: the best after rounds of clipping and keeping the phases."""
    from scipy.fft import irfft, next_fast_len, rfft

    # Eight samples per period of the highest line show its peaks.
    size = next_fast_len(max(8 * int(lines[-1]), 64), real=True)
    best, lowest = phases, math.inf
    spectrum = np.zeros(size // 2 + 1, dtype=complex)
    for level in np.linspace(0.6, 0.95, _ROUNDS).tolist():
        spectrum[lines] = -1j * np.exp(1j * phases)
        wave = irfft(spectrum, size)
        peak = float(np.max(np.abs(wave)))
        if peak < lowest:
            best, lowest = phases, peak
        phases = np.angle(rfft(np.clip(wave, -level * peak, level * peak))[lines]) + 0.5 * math.pi
    return best
