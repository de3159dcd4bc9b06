"""A resonance is found in the spectra of a record, with its transient, and no missing one is unsaid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import quell as ql
from quell.identification.frequency_starts import continuous, poles_of_record, resonant_poles
from quell.identification.given_records import Records, first_held_out
from quell.identification.saturation import standing
from quell.identification.vector_fitting import Spectra, fit_of_record, pair_beside, vector_fit

DT = 1e-3
# A motor with its encoder before a flexible coupling: 32 Hz, 22 Hz, a pole of 5 rad/s.
OMEGA, FIXED = 200.0, 140.0
NUM = 300.0 * np.array([1.0 / FIXED**2, 0.02 / FIXED, 1.0])
DEN = np.polymul([1.0, 5.0, 0.0], [1.0 / OMEGA**2, 0.02 / OMEGA, 1.0])


def answer(num: Any, den: Any, u: Any, late: int = 0) -> Any:
    """Return y at the samples for a held u."""
    b, a, _ = cont2discrete((num, den), DT)
    return lfilter(b.ravel(), a, np.append(np.zeros(late), u)[: u.size])


def binary(size: int, hold: int = 4) -> Any:
    """Return a binary u."""
    rng = np.random.default_rng(5)
    return np.repeat(np.sign(rng.standard_normal(size // hold + 1)), hold)[:size]


def test_vector_fitting_finds_the_poles_of_a_rational_function() -> None:
    """Exactly, from its values at frequencies."""
    s = 1j * np.geomspace(0.1, 10.0, 60)
    H = (s + 3.0) / (s**2 + 0.1 * s + 1.0) / (s + 0.5)
    found = vector_fit(s, H, 1.0 / np.abs(H), 3)
    poles = np.sort_complex(found.poles)
    np.testing.assert_allclose(poles, np.sort_complex(np.roots([1.0, 0.6, 1.05, 0.5])), rtol=1e-6)
    assert found.error < 1e-18


@pytest.mark.parametrize("extra", [0, 2])
def test_the_spectra_of_a_record_give_its_poles_whatever_it_begins_and_ends_with(
    extra: int,
) -> None:
    """Of a part of a record, in motion at both ends, without a window."""
    u = binary(900)
    y = answer(NUM, DEN, u)
    found = fit_of_record(u[200:], y[200:], 4, extra)
    poles = continuous(found.poles) / DT
    assert np.min(np.abs(poles - np.roots(DEN)[0])) < 0.02 * OMEGA
    assert np.min(np.abs(np.abs(poles) - OMEGA)) < 1e-3 * OMEGA


def test_poles_are_shown_by_records_that_are_long_enough() -> None:
    """A short record, and a u that rests, show none."""
    u = binary(40)
    assert poles_of_record(u, answer(NUM, DEN, u), 4) == []
    assert resonant_poles(u, answer(NUM, DEN, u), 4, 0) is None
    assert poles_of_record(np.ones(400), np.ones(400), 4) == []
    u = binary(400)
    assert [poles.size for poles in poles_of_record(u, answer(NUM, DEN, u), 4)] == [4, 4]


def test_a_resonance_is_shown_and_a_lag_shows_none() -> None:
    """With noise and a delay; the polynomial has the resonance."""
    u = binary(800)
    rng = np.random.default_rng(3)
    y = answer(NUM, DEN, u, late=2) + 1e-4 * rng.standard_normal(u.size)
    a = resonant_poles(u, y, 4, 2)
    assert a is not None
    poles = np.roots(np.append(1.0, a[::-1])) / DT
    assert np.min(np.abs(np.abs(poles) - OMEGA)) < 0.01 * OMEGA
    lag = answer([50.0], [1.0, 50.0], u) + 1e-2 * rng.standard_normal(u.size)
    assert resonant_poles(u, lag, 4, 2) is None


def test_a_resonance_hardly_above_the_noise_is_found_beside_the_poles_that_are_known() -> None:
    """Steps move it by as much as the noise: vector fitting of all poles at once misses it."""
    u = binary(1500, 200)
    noise = 0.02 * np.random.default_rng(3).standard_normal(u.size)
    y = answer(NUM, DEN, u) + noise
    at_once = continuous(fit_of_record(u, y, 4).poles) / DT
    assert np.min(np.abs(np.abs(at_once) - OMEGA)) > 0.2 * OMEGA
    rigid = np.exp(np.array([-1e-6, -5.0 * DT]))
    upper, weight = pair_beside(Spectra.of(u, y), rigid)
    assert abs(continuous(np.array([upper]))[0]) / DT == pytest.approx(OMEGA, rel=0.03)
    assert np.std(np.log(weight)) < 0.3  # the noise is white
    a = resonant_poles(u, y, 4, 2)
    assert a is not None
    poles = np.roots(np.append(1.0, a[::-1])) / DT
    assert np.min(np.abs(np.abs(poles) - OMEGA)) < 0.03 * OMEGA
    assert resonant_poles(u, answer([300.0], [1.0, 5.0, 0.0], u) + noise, 4, 2) is None


def test_a_pair_is_found_where_slow_noise_is_much_larger() -> None:
    """The error is weighted by its own level in each band."""
    u = binary(2000, 50)
    rng = np.random.default_rng(4)
    drift = lfilter([1.0], [1.0, -0.999], rng.standard_normal(u.size))
    swing = answer([100.0], [1.0 / OMEGA**2, 0.02 / OMEGA, 1.0], u)
    y = 0.02 * swing + drift + 0.05 * rng.standard_normal(u.size)
    upper, weight = pair_beside(Spectra.of(u, y), np.zeros(0, dtype=complex))
    assert abs(continuous(np.array([upper]))[0]) / DT == pytest.approx(OMEGA, rel=0.03)
    assert weight[500] > 10.0 * weight[3]


def test_the_end_of_a_chirp_and_a_standing_end_are_not_held_out_by_default() -> None:
    """A share that is given is held out; a binary u is held out."""
    t = np.arange(1000.0)
    chirp = np.sin(2e-4 * t**2)
    y = np.cumsum(chirp)
    assert first_held_out(Records(chirp, y, ()), 1, None, 10, 10) == 1000
    assert first_held_out(Records(chirp, y, ()), 1, 0.3, 10, 10) == 700
    u = binary(1000)
    assert first_held_out(Records(u, np.cumsum(u), ()), 1, None, 10, 10) == 700
    stands = np.where(t < 600, np.cumsum(u), 500.0)
    assert first_held_out(Records(u, stands, ()), 1, None, 10, 10) == 1000


def test_a_word_in_the_place_of_a_delay_is_refused_with_the_one_that_is_meant() -> None:
    """``"if need"`` is none."""
    with pytest.raises(ValueError, match='delay = .if need.*"if needed"'):
        ql.identify(binary(100), np.cumsum(binary(100)), DT, 1, delay="if need")  # type: ignore[arg-type]


def test_a_y_that_does_not_answer_at_its_begin_stands_at_a_limit() -> None:
    """Where u moves meanwhile; a plant that rests under a steady u stands at none."""
    rng = np.random.default_rng(1)
    u = binary(300, 5)
    k = np.arange(300)
    y = np.where(k < 80, -6.0, -6.0 - (k - 79) / 20.0 + 0.01 * rng.standard_normal(300))
    y = np.minimum(y, -6.0)
    found = standing(y, 0.0, u)
    assert found.upper[:80].all()
    assert found.longest_free.start >= 80
    assert standing(y, 0.0, np.where(k < 80, 0.0, u)).samples == 0


@pytest.mark.trial
@pytest.mark.parametrize("how", ["binary", "chirp", "steps"])
def test_the_resonance_of_an_axis_is_found_with_default_options(how: str) -> None:
    """At the motor, with a delay; without zeros the report says that something is missing."""
    t = np.arange(3000)
    u = {
        "binary": binary(3000),
        "chirp": np.sin(0.0042 * t[-1] / 4.6 * (100.0 ** (t / t[-1]) - 1.0)),
        "steps": binary(3000, 300),
    }[how]
    y = answer(NUM, DEN, u, late=1)
    y = y + 1e-4 * np.ptp(y) * np.random.default_rng(2).standard_normal(u.size)
    found = ql.identify(u, y, DT)
    assert found.shortcomings == ()
    assert len(found.zeros) == 2
    assert min(abs(pole.omega - OMEGA) for pole in found.poles) < 0.01 * OMEGA
    assert ql.identify(u, y, DT, zeros=0).shortcomings
