"""Excitations against their closed forms, and the designer within its limits."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from quell import signals as s
from quell.identification import excitation
from quell.signals.excitation import schroeder_phases

from .cases import cases


@cases("bits", range(2, 15))
def test_a_prbs_correlates_as_a_sequence_of_greatest_length(bits: int) -> None:
    """One at lag 0, −1/L at all others, with L = 2^bits − 1: so the register goes through all its states."""
    length = 2**bits - 1
    values = s.PRBS(amplitude=1.0, bits=bits, step=0.25)(np.arange(length) * 0.25)
    spectrum = np.abs(np.fft.fft(values)) ** 2
    correlation = np.fft.ifft(spectrum).real / length
    assert set(values.tolist()) == {-1.0, 1.0}
    assert correlation[0] == pytest.approx(1.0)
    np.testing.assert_allclose(correlation[1:], -1.0 / length, atol=1e-12)


@pytest.mark.parametrize("bits", [16, 18, 20])
def test_a_long_prbs_does_not_repeat_within_its_period(bits: int) -> None:
    """One more +1 than −1, and no shift by a divisor of the length is the same: the taps are those of a primitive polynomial."""
    signal = s.PRBS(bits=bits, step=1.0)
    values = signal(np.arange(2**bits - 1.0))
    assert np.sum(values) == pytest.approx(1.0)
    for prime in (3, 5, 7, 11, 13, 17, 19, 31, 41, 73, 127, 151, 257):
        if values.size % prime == 0:
            assert np.any(values != np.roll(values, values.size // prime))


def test_a_prbs_is_held_starts_and_can_begin_elsewhere() -> None:
    """Each value for a step, zero before the start; a seed shifts it; it repeats."""
    signal = s.PRBS(amplitude=2.0, bits=5, step=0.1, start=1.0)
    t = np.arange(400) * 0.025
    values = signal(t)
    assert np.all(values[t < 1.0 - 1e-9] == 0.0)
    np.testing.assert_array_equal(
        values[40:].reshape(-1, 4), np.repeat(values[40::4], 4).reshape(-1, 4)
    )
    np.testing.assert_array_equal(
        s.PRBS(2.0, 5, 0.1, 1.0, seed=3)(t[40:200]), signal(t[40:200] + 0.3)
    )
    np.testing.assert_array_equal(signal(t[40:] + signal.period), values[40:])
    assert np.all(signal.derivative()(t) == 0.0)


def test_a_multisine_has_the_lines_it_names_and_no_others() -> None:
    """Over a whole period its spectrum is the amplitudes and phases given; its derivative is ω times as large."""
    lines, amplitudes, phases = (
        np.array([2, 5, 9]),
        np.array([1.0, 0.5, 2.0]),
        np.array([0.1, 1.0, -2.0]),
    )
    count, base = 256, 0.3
    signal = s.Multisine(lines * base, amplitudes, phases)
    t = np.arange(count) * 2.0 * math.pi / base / count
    spectrum = np.fft.rfft(signal(t)) / count * 2.0
    expected = np.zeros(count // 2 + 1, dtype=complex)
    expected[lines] = -1j * amplitudes * np.exp(1j * phases)
    np.testing.assert_allclose(spectrum, expected, atol=1e-12)
    np.testing.assert_allclose(
        signal.derivative()(t[1:-1]),
        (signal(t[1:-1] + 1e-6) - signal(t[1:-1] - 1e-6)) / 2e-6,
        atol=1e-6,
    )
    assert np.all(s.Multisine(lines * base, start=5.0)(t[t < 4.9]) == 0.0)


def test_schroeders_phases_make_the_crest_factor_of_a_sweep() -> None:
    """A hundred lines of one size: 1.7, where phases that are all the same have 14."""
    t = np.arange(4096) / 4096.0 * 2.0 * math.pi
    signal = s.Multisine(np.arange(1.0, 101.0), np.ones(100), schroeder_phases(np.ones(100)))(t)
    assert np.max(np.abs(signal)) / np.sqrt(np.mean(signal**2)) == pytest.approx(1.68, abs=0.06)


def test_a_logarithmic_chirp_gives_each_octave_the_same_time() -> None:
    """Its frequency, seen through its zero crossings, is ``ω₀ (ω₁/ω₀)^(t/T)``, and stays at the end."""
    chirp = s.Chirp(omega_start=2.0, omega_end=32.0, duration=20.0, logarithmic=True)
    t = np.linspace(0.0, 24.0, 480_001)
    wave = chirp(t)
    crossings = t[1:][(wave[:-1] < 0.0) & (wave[1:] >= 0.0)]
    middle = 0.5 * (crossings[1:] + crossings[:-1])
    np.testing.assert_allclose(2.0 * np.pi / np.diff(crossings), chirp.omega(middle), rtol=0.02)
    np.testing.assert_allclose(
        chirp.omega([0.0, 5.0, 10.0, 20.0, 30.0]), [2.0, 4.0, 8.0, 32.0, 32.0]
    )


@pytest.mark.parametrize("kind", ["multisine", "prbs", "chirp"])
def test_a_design_reaches_its_limits_and_is_what_it_says(kind: str) -> None:
    """From u_min to u_max; crest factor and RMS are those of its samples; the signal gives the same samples."""
    design = excitation(kind, (1.0, 50.0), duration=20.0, dt=2e-3, u_min=-0.5, u_max=2.5)
    assert design.u.size == 10_000
    assert (design.u.min(), design.u.max()) == pytest.approx((-0.5, 2.5))
    away = design.u - design.u.mean()
    assert design.rms == pytest.approx(np.sqrt(np.mean(away**2)))
    assert design.crest == pytest.approx(np.max(np.abs(away)) / design.rms)
    np.testing.assert_allclose(design.signal(design.t), design.u, atol=1e-12)
    assert design.crest < {"multisine": 2.2, "prbs": 1.05, "chirp": 1.6}[kind]


@pytest.mark.parametrize("kind", ["multisine", "prbs", "chirp"])
def test_a_design_has_its_power_in_the_band(kind: str) -> None:
    """All of a multisine; of a PRBS 72 %, the integral of sinc² up to 0.443."""
    design = excitation(kind, (1.0, 50.0), duration=40.0, dt=2e-3)
    count = design.u.size if kind == "chirp" else round(design.period / design.dt)
    spectrum = np.abs(np.fft.rfft(design.u[:count] - design.u[:count].mean())) ** 2
    omega = 2.0 * math.pi * np.fft.rfftfreq(count, design.dt)
    inside = (omega > design.band[0] * 0.999) & (omega < design.band[1] * 1.001)
    assert (
        np.sum(spectrum[inside]) / np.sum(spectrum)
        > {"multisine": 0.999, "prbs": 0.71, "chirp": 0.9}[kind]
    )


def test_a_prbs_is_within_3_db_over_its_band() -> None:
    """The lines of one period, against the lowest."""
    design = excitation("prbs", (1.0, 50.0), duration=40.0, dt=1e-3)
    count = round(design.period / design.dt)
    spectrum = np.abs(np.fft.rfft(design.u[:count]))
    omega = 2.0 * math.pi * np.fft.rfftfreq(count, design.dt)
    inside = (omega > 0.999 * design.band[0]) & (omega < 1.001 * design.band[1])
    assert np.min(spectrum[inside]) > 0.7 * np.max(spectrum)


def test_what_can_not_be_had_is_said() -> None:
    """Too slow for the duration, too fast for the sampling, one period only."""
    assert any(
        "not 0.05" in text for text in excitation("prbs", (0.05, 50.0), 20.0, 1e-3).shortcomings
    )
    assert any(
        "3 dB down" in text for text in excitation("prbs", (1.0, 300.0), 20.0, 0.01).shortcomings
    )
    assert any(
        "one period" in text
        for text in excitation("multisine", (0.5, 50.0), 20.0, 1e-3).shortcomings
    )
    assert any(
        "octave" in text for text in excitation("chirp", (0.5, 50.0), 20.0, 1e-3).shortcomings
    )
    assert excitation("prbs", (1.0, 50.0), 20.0, 1e-3).shortcomings == ()


def test_a_design_is_written_as_csv(tmp_path: Path) -> None:
    """Columns t and u, all samples."""
    design = excitation("prbs", (1.0, 50.0), 5.0, 1e-3, -2.0, 2.0)
    design.save(tmp_path / "u.csv")
    read = np.loadtxt(tmp_path / "u.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(read, np.column_stack([design.t, design.u]), atol=1e-9)
    assert design.describe().startswith("PRBS of ")


@cases(
    ("arguments", "message"),
    [
        (
            ("noise", (1.0, 50.0), 20.0, 1e-3),
            "kind = 'noise': must be one of multisine, prbs, chirp",
        ),
        (("prbs", (50.0, 1.0), 20.0, 1e-3), "band = (50.0, 1.0): must rise"),
        (("prbs", (1.0, 4000.0), 20.0, 1e-3), "below pi / dt"),
        (("chirp", (1.0, 50.0), 0.01, 1e-3), "duration = 0.01 s: must be at least"),
        (
            ("chirp", (1.0, 50.0), 20.0, 1e-3, 1.0, -1.0),
            "u_min = 1.0, u_max = -1.0: u_min must be less",
        ),
        (("prbs", (1.0, 50.0), 20.0, 0.0), "dt = 0.0: must be finite and greater than zero"),
    ],
)
def test_a_wrong_argument_is_named(arguments: tuple[object, ...], message: str) -> None:
    """Value and rule."""
    with pytest.raises(ValueError) as caught:
        excitation(*arguments)  # type: ignore[arg-type]
    assert message in str(caught.value)


def test_wrong_signals_are_named() -> None:
    """Bits out of the table, a line at zero."""
    with pytest.raises(ValueError, match="bits = 40: must be a whole number from 2 to 20"):
        s.PRBS(bits=40)
    with pytest.raises(ValueError, match="omegas = .*must be positive"):
        s.Multisine([0.0, 1.0])
    with pytest.raises(ValueError, match="^omegas is empty: must have at least one frequency"):
        s.Multisine([])
    with pytest.raises(ValueError, match="omega_start = 0.0: must be finite and greater than zero"):
        s.Chirp(omega_start=0.0, logarithmic=True)
