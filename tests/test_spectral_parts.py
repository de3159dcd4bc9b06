"""Frequency responses, spectra and free swings against short computations of their equations."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import optimize, signal

from quell.identification import frequency_response
from quell.identification.frequencies import FrequencyResponse, _period
from quell.identification.model import WITHIN_95
from quell.identification.spectra import SpectralMode, SpectralModes, _model, modes_of_spectrum
from quell.identification.swings import Decay, FreeSwing, Mode, _pencil, free_swing

from .cases import cases

pytestmark = pytest.mark.compiled

DT = 0.1
A_1 = 0.9


def signs(count: int, seed: int = 3) -> np.ndarray:
    """Return ±1 at random."""
    return np.sign(np.random.default_rng(seed).standard_normal(count))


def noise(count: int, size: float, seed: int = 5) -> np.ndarray:
    """Return white noise."""
    return size * np.random.default_rng(seed).standard_normal(count)


def answer(u: np.ndarray, size: float = 0.02) -> np.ndarray:
    """Return y = 0.1/(z − 0.9) u, from 2, and noise."""
    y = signal.lfilter([0.0, 0.1], [1.0, -A_1], u) + 2.0 * A_1 ** np.arange(u.size)
    return y + noise(u.size, size)


def exact(omega: np.ndarray) -> np.ndarray:
    """Return the response of that plant."""
    return 0.1 / (np.exp(1j * omega * DT) - A_1)


# ---- averaged spectra


def test_averaged_spectra_are_those_of_scipy_with_the_deviation_of_their_coherence() -> None:
    """S_yu/S_uu of the differences over eight segments, or as many as are given."""
    u = signs(401)
    y = answer(u)
    for segments, length in ((None, 50), (4, 100)):
        found = frequency_response(u, y, DT, segments=segments)
        how: Any = {"fs": 1.0 / DT, "nperseg": length, "detrend": False}
        du, dy = np.diff(u), np.diff(y)
        f, uy = signal.csd(du, dy, **how)
        uu, yy = signal.welch(du, **how)[1], signal.welch(dy, **how)[1]
        share = np.abs(uy) ** 2 / uu / yy
        np.testing.assert_allclose(found.omega, 2.0 * np.pi * f[1:], rtol=1e-12)
        np.testing.assert_allclose(found.response, (uy / uu)[1:], rtol=1e-9)
        np.testing.assert_allclose(found.coherence, share[1:], rtol=1e-9)
        n = 400 // length
        deviation = np.sqrt((1.0 - share) / (2.0 * share * n))[1:]
        np.testing.assert_allclose(found.deviation, deviation, rtol=1e-6)
        assert found.method == "welch"
        np.testing.assert_allclose(found.frequency, f[1:])
    assert frequency_response(u[:129], y[:129], DT).omega.size == 8
    with pytest.raises(
        ValueError, match="u has 128 samples: must have at least 136 for 8 segments"
    ):
        frequency_response(u[:128], y[:128], DT)
    with pytest.raises(ValueError, match="segments = 1: must be a whole number of at least 2"):
        frequency_response(u, y, DT, segments=1)


# ---- local polynomials


def by_hand(
    records: tuple[np.ndarray, ...],
    differences: tuple[int, int],
    parts: int,
    count: int,
    closed: bool,
) -> tuple[np.ndarray, ...]:
    """Return G, coherence and deviation of the first lines by one least-squares problem for each.

    ``records`` are u, y and r; ``differences`` how often u and r, and y, are differenced.
    """
    u, y, r = records
    length = (u.size - 2) // parts
    lines = (length + 1) // 2 - 1

    def spectra(x: np.ndarray, times: int) -> np.ndarray:
        blocks = np.diff(x, times)[: parts * length].reshape(parts, length)
        return np.fft.rfft(blocks, axis=1)[:, 1 : lines + 1]

    U, Y, R = spectra(u, differences[0]), spectra(y, differences[1]), spectra(r, differences[0])
    found, share, noise = np.zeros((count, 2), complex), np.zeros(count), np.zeros((count, 3))
    for k in range(count):
        middle = min(max(k, 6), lines - 7)
        near = np.arange(middle - 6, middle + 7)
        powers = ((near - k) / 6.0)[:, None] ** np.arange(3)
        rows = []
        for p in range(parts):
            row = [R[p, near, None] * powers, *[np.zeros((13, 3))] * parts]
            row[1 + p] = powers
            rows.append(np.hstack(row))
        X = np.vstack(rows)
        targets = np.column_stack([Y[:, near].ravel(), U[:, near].ravel()])
        theta = np.linalg.lstsq(X, targets, rcond=None)[0]
        error = targets - X @ theta
        if not closed:
            theta[0, 1], error[:, 1] = 1.0, 0.0
        scale = np.mean(np.abs(R[:, near]) ** 2)
        found[k] = theta[0] * np.sqrt(scale)
        share[k] = np.linalg.inv(X.conj().T @ X)[0, 0].real * scale
        left = [*error.T, error[:, 0] - theta[0, 0] / theta[0, 1] * error[:, 1]]
        noise[k] = [np.sum(np.abs(each) ** 2) / (13 * parts - 3 * parts - 3) for each in left]
    wide = np.pad(noise, ((12, 12), (0, 0)), mode="edge")
    noise = np.maximum(noise, [np.mean(wide[k : k + 25], axis=0) for k in range(count)])
    return ratio(found, noise, share, closed)


def ratio(
    found: np.ndarray, noise: np.ndarray, share: Any, closed: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return G, coherence and deviation; beyond 15 % in a closed loop that of y or u alone counts."""
    power = np.abs(found) ** 2
    of_y, of_u, both = np.sqrt(
        0.5 * share * noise.T / np.array([power[:, 0], power[:, 1], power[:, 0]])
    )
    own = np.maximum(of_y, of_u)
    lost = closed & (own > 0.15)
    coherence = power[:, 0] / (power[:, 0] + noise[:, 0 if closed else 2])
    return found[:, 0] / found[:, 1], coherence, np.where(lost, np.maximum(own, both), both)


def loop(count: int) -> tuple[np.ndarray, ...]:
    """Return u, y and r of that plant with u = 2 (r − y), and noise in y."""
    r, e = np.repeat(signs(count), 2)[:count], noise(count, 0.05)
    x, u, y = 0.0, np.zeros(count), np.zeros(count)
    for k in range(count):
        y[k] = x + e[k]
        u[k] = 2.0 * (r[k] - y[k])
        x = A_1 * x + 0.1 * u[k]
    return u, y, r


@cases("closed", [False, True])
@cases("parts", [1, 2])
def test_local_polynomials_are_least_squares_at_each_line(parts: int, closed: bool) -> None:
    """Of the differences, and near s = 0 of y and its differences, where their noise is less."""
    count = 162 * parts
    u, y, r = loop(count) if closed else (signs(count), answer(signs(count)), signs(count))
    how: Any = {"reference": r} if closed else {}
    found = frequency_response(u, y, DT, method="local", segments=parts, **how)
    length = (count - 2) // parts
    lines = (length + 1) // 2 - 1
    expected = by_hand((u, y, r), (1, 1), parts, lines, closed)
    omega = 2.0 * np.pi * np.arange(1, lines + 1) / (length * DT)
    turn = np.exp(1j * omega[:64] * DT) - 1.0
    for d in (1, 2):
        other = by_hand((u, y, r), (0, d), parts, 64, closed)
        better = other[2] < expected[2][:64]
        for values, new in zip(expected, (other[0] / turn**d, *other[1:]), strict=True):
            values[:64][better] = new[better]
    at = np.round(found.omega * length * DT / (2.0 * np.pi)).astype(int) - 1
    assert at.size > 0.95 * lines  # without those at which u has no power
    np.testing.assert_allclose(found.omega, omega[at], rtol=1e-12)
    np.testing.assert_allclose(found.response, expected[0][at], rtol=1e-7)
    np.testing.assert_allclose(found.coherence, expected[1][at], rtol=1e-7)
    np.testing.assert_allclose(found.deviation, expected[2][at], rtol=1e-6)
    assert found.method == "local"
    if not closed:
        off = np.abs(found.response / exact(found.omega) - 1.0)
        assert np.median(off / found.deviation) < 1.6


def test_a_segment_of_local_polynomials_has_four_windows_of_lines() -> None:
    """54 samples; one less is refused, with how many there must be."""
    u = signs(108)
    y = answer(u)
    assert frequency_response(u[:54], y[:54], DT, method="local").omega.size == 25
    for count, parts, message in (
        (
            53,
            1,
            "u has 53 samples: must have at least 54 for 1 segment; take fewer, or record longer",
        ),
        (105, 2, "u has 105 samples: must have at least 106 for 2 segments; take fewer, or"),
    ):
        with pytest.raises(ValueError, match=message):
            frequency_response(u[:count], y[:count], DT, method="local", segments=parts)
    assert frequency_response(u[:106], y[:106], DT, method="local", segments=2).omega.size == 25


def test_lines_that_u_does_not_have_are_left_out_and_single_ones_are_ratios() -> None:
    """Of a multisine: at each line Y/U less a transient, and none between them."""
    k = np.arange(802)
    lines = [20, 60, 100, 140]
    u = sum(np.cos(2.0 * np.pi * line * k / 800 + line) for line in lines)
    y = np.asarray(signal.lfilter([0.0, 0.1], [1.0, -A_1], u))
    found = frequency_response(u, y, DT, method="local", segments=1)
    at = np.round(found.omega * 80.0 / (2.0 * np.pi)).astype(int)
    assert at.tolist() == lines
    np.testing.assert_allclose(found.response, exact(found.omega), rtol=1e-3)


# ---- periods


def test_a_period_is_the_first_lag_from_sixteen_samples_on_that_repeats() -> None:
    """Three are needed; a change of a hundred millionth of the power is none."""
    one = signs(20)
    assert _period(np.tile(one, 3)) == 20
    assert _period(np.tile(one, 4)) == 20
    assert _period(np.tile(one, 3)[:-1]) == 0
    assert _period(np.tile(signs(8), 9)) == 16
    assert _period(np.tile(signs(16), 3)) == 16
    assert _period(np.tile(signs(15), 4)) == 0
    assert _period(np.tile(signs(15), 6)) == 30
    assert _period(np.ones(90)) == 0
    almost = np.tile(one, 4)
    assert _period(almost + noise(80, 5e-5)) == 20
    assert _period(almost + noise(80, 5e-4)) == 0
    assert _period(5.0 + np.tile(one, 4)) == 20


@cases("closed", [False, True])
def test_lines_of_periods_are_ratios_less_the_polynomial_between_them(closed: bool) -> None:
    """The noise is what the 12 nearest lines between are off it."""
    period, extra = 24, 7
    size = 6 * period + extra
    r = np.tile(signs(period, 8), 7)[:size]
    if closed:
        e = noise(size, 0.05)
        x, u, y = 0.0, np.zeros(size), np.zeros(size)
        for k in range(size):
            y[k] = x + e[k]
            u[k] = 2.0 * (r[k] - y[k])
            x = A_1 * x + 0.1 * u[k]
    else:
        u, y = r, answer(r)
    how: Any = {"reference": r} if closed else {}
    found = frequency_response(u, y, DT, method="periods", **how)
    count = 6
    U, Y, R = (np.fft.rfft(np.diff(x)[size - 1 - count * period :]) for x in (u, y, r))
    at = [k for k in range(count, R.size, count) if abs(R[k]) > 1e-3 * np.max(np.abs(R))]
    at = np.array([k for k in at if 2 * k < count * period])
    between = np.array([k for k in range(R.size) if k % count])
    both, of_noise = np.zeros((at.size, 2), complex), np.zeros((at.size, 3))
    for i, k in enumerate(at):
        near = sorted(between.tolist(), key=lambda line: (abs(line - k), line))[:12]
        V = np.vander((np.array(near) - k) / 6.0, 3, increasing=True)
        data = np.column_stack([Y[near], U[near]])
        fit = np.linalg.lstsq(V, data, rcond=None)[0]
        both[i] = Y[k] - fit[0, 0], U[k] - fit[0, 1]
        error = data - V @ fit
        left = [*error.T, error[:, 0] - both[i, 0] / both[i, 1] * error[:, 1]]
        more = 1.0 + np.linalg.inv(V.T @ V)[0, 0]
        of_noise[i] = [more * np.sum(np.abs(each) ** 2) / 9.0 for each in left]
    G, coherence, deviation = ratio(both, of_noise, 1.0, closed)
    np.testing.assert_allclose(found.omega, 2.0 * np.pi * at / (count * period * DT), rtol=1e-12)
    np.testing.assert_allclose(found.response, G, rtol=1e-8)
    np.testing.assert_allclose(found.coherence, coherence, rtol=1e-8)
    np.testing.assert_allclose(found.deviation, deviation, rtol=1e-7)
    assert frequency_response(u, y, DT, method="auto", **how).method == "periods"
    assert frequency_response(u, y, DT, method="auto", segments=1, **how).method == "local"
    with pytest.raises(ValueError, match="segments = 2: has no effect on periods; leave it out"):
        frequency_response(u, y, DT, method="periods", segments=2, **how)


# ---- what is printed, saved and drawn of a response


def known(count: int) -> FrequencyResponse:
    """Return a response whose every second deviation is too large."""
    omega = np.geomspace(1.0, 100.0, count)
    deviation = np.where(np.arange(count) % 2, 0.21, 0.2)
    return FrequencyResponse(
        omega, 2.0 / (1.0 + 1j * omega), np.full(count, 0.9), deviation, "periods"
    )


def test_points_are_known_up_to_a_deviation_of_a_fifth(tmp_path: Path) -> None:
    """They are counted, saved and listed; without any the report says so."""
    found = known(6)
    assert found.known.tolist() == [True, False] * 3
    assert found.describe() == "by periods of u: 3 of 6 frequencies are known within 20 %"
    none = found._replace(deviation=np.full(6, 0.3), method="local")
    assert none.describe() == (
        "by local polynomials: 0 of 6 frequencies are known within 20 %\nNOT: noise hides the "
        "response at all frequencies; excite with more power, or record longer"
    )
    found.save(tmp_path / "g.csv")
    head, *lines = (tmp_path / "g.csv").read_text().splitlines()
    assert head == "f [Hz],real,imag,coherence,deviation"
    g = found.response[2]
    f = found.omega[2] / (2.0 * np.pi)
    assert lines[1] == f"{f:.9g},{g.real:.9g},{g.imag:.9g},0.9,0.2"
    assert len(lines) == 3
    with pytest.raises(ValueError, match="exists"):
        found.save(tmp_path / "g.csv")
    found.save(tmp_path / "g.csv", overwrite=True)
    value = found.to_json()
    assert value["omega"] == found.omega.tolist()
    assert value["real"] == found.response.real.tolist()
    assert value["imag"] == found.response.imag.tolist()
    assert (value["coherence"], value["deviation"]) == ([0.9] * 6, [0.2, 0.21] * 3)
    assert value["method"] == "periods"


def test_rows_are_even_over_the_logarithm_of_frequency() -> None:
    """All known ones up to the number, else the ones nearest to marks."""
    found = known(20)
    assert found.rows() == list(range(0, 20, 2))
    assert found.rows(10) == list(range(0, 20, 2))
    places = np.arange(0, 20, 2)
    marks = np.geomspace(found.omega[0], found.omega[18], 4)
    nearest = [places[np.argmin(np.abs(np.log(found.omega[places] / mark)))] for mark in marks]
    assert found.rows(4) == nearest
    assert known(400).rows() == sorted(set(known(400).rows(40)))
    assert len(known(400).rows()) == 40


# ---- power spectra


OMEGA = np.linspace(5.0, 100.0, 160)
PLACE = np.log(OMEGA / math.sqrt(500.0))
THETA = np.array([-3.0, 0.7, *np.log([4e-3, 40.0, 0.05])])


def spectrum(theta: np.ndarray) -> np.ndarray:
    """Return S by its formula."""
    S = np.exp(theta[0]) * (OMEGA / math.sqrt(500.0)) ** theta[1]
    for A, w, z in np.exp(theta[2:]).reshape(-1, 3):
        S = S + A / ((1.0 - OMEGA**2 / w**2) ** 2 + (2.0 * z * OMEGA / w) ** 2)
    return S


def test_a_model_of_a_spectrum_is_its_formula_and_its_slopes_are_differences() -> None:
    """With two modes."""
    theta = np.array([*THETA, *np.log([1e-3, 70.0, 0.02])])
    value, slopes = _model(theta, OMEGA, PLACE)
    np.testing.assert_allclose(value, np.log(spectrum(theta)), rtol=1e-12)
    for k in range(theta.size):
        step = 1e-6 * np.eye(theta.size)[k]
        by_hand = (np.log(spectrum(theta + step)) - np.log(spectrum(theta - step))) / 2e-6
        np.testing.assert_allclose(slopes[:, k], by_hand, atol=1e-7)


def test_a_mode_in_a_spectrum_has_the_values_and_intervals_of_least_squares() -> None:
    """By SciPy with differences; neighbours that err alike make intervals wider."""
    e = signal.lfilter([1.0], [1.0, -0.5], noise(OMEGA.size, 0.08))
    power = spectrum(THETA) * np.exp(e)
    found = modes_of_spectrum(OMEGA, power)
    (mode,) = found.modes
    best = optimize.least_squares(
        lambda theta: np.log(spectrum(theta) / power), THETA, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    A, w, z = np.exp(best.x[2:])
    assert mode.omega == pytest.approx(w, rel=1e-6)
    assert mode.damping == pytest.approx(z, rel=1e-5)
    left = -best.fun - np.mean(-best.fun)
    rho = float(left[1:] @ left[:-1] / (left @ left))
    assert 0.3 < rho < 0.7
    factor = float(best.fun @ best.fun) / (OMEGA.size - 5) * (1.0 + rho) / (1.0 - rho)
    half = WITHIN_95 * np.sqrt(factor * np.diag(np.linalg.inv(best.jac.T @ best.jac))[3:])
    assert mode.omega_interval == pytest.approx(
        (w * np.exp(-half[0]), w * np.exp(half[0])), rel=1e-5
    )
    assert mode.damping_interval == pytest.approx(
        (z * np.exp(-half[1]), z * np.exp(half[1])), rel=1e-4
    )
    background = np.exp(best.x[0]) * (w / math.sqrt(500.0)) ** best.x[1]
    assert mode.height == pytest.approx(1.0 + A / (4.0 * z * z) / background, rel=1e-3)
    np.testing.assert_allclose(found.model, spectrum(best.x), rtol=1e-4)
    np.testing.assert_array_equal(found.power, power)


def test_modes_of_a_spectrum_are_told_in_hertz_and_without_gain() -> None:
    """A damping of at most so much where the lines are as wide."""
    turn = 2.0 * math.pi
    mode = SpectralMode(turn * 5.0, (turn * 4.5, turn * 5.5), 0.02, (0.01, 0.03), 12.0)
    assert str(mode) == (
        "mode at 5 Hz (31.416 rad/s), 95 %: 4.5 to 5.5 Hz; damping 0.02, 95 %: 0.01 to 0.03; 12 "
        "times the background"
    )
    wide = mode._replace(damping_interval=(0.0, 0.03))
    assert "; damping at most 0.03, as the lines of the table are not closer; 12" in str(wide)
    both = SpectralModes((mode, wide), OMEGA, OMEGA, OMEGA)
    assert str(both) == f"{mode}\n{wide}\na power spectrum has no gain and no phase"
    value = both.to_json()["modes"][1]
    assert (value["omega"], value["damping"], value["height"]) == (turn * 5.0, 0.02, 12.0)
    assert value["damping_interval"] == [0.0, 0.03]


@cases(
    ("omega", "power", "message"),
    [
        (OMEGA[:19], OMEGA[:19], "omega has 19 frequencies: must have at least 20"),
        (OMEGA[::-1], OMEGA, "omega: must rise from above zero on"),
        (OMEGA - 5.0, OMEGA, "omega: must rise from above zero on"),
        (OMEGA, OMEGA - 5.0, "power: must be positive; leave the other frequencies out"),
        (OMEGA, OMEGA**2, "power has no peak that stands out of its background: no mode is found;"),
    ],
)
def test_what_is_no_spectrum_is_refused(omega: Any, power: Any, message: str) -> None:
    """With the rule; straight lines have no peak."""
    with pytest.raises(ValueError, match=message):
        modes_of_spectrum(omega, power)


def test_as_many_modes_as_are_given_come_highest_first() -> None:
    """Two, or one of them."""
    theta = np.array([*THETA, *np.log([1e-3, 70.0, 0.02])])
    found = modes_of_spectrum(OMEGA, spectrum(theta)).modes
    assert [mode.omega for mode in found] == pytest.approx([70.0, 40.0], rel=1e-6)
    assert [mode.damping for mode in found] == pytest.approx([0.02, 0.05], rel=1e-5)
    heights = [1.0 + np.exp(theta[k] - 2.0 * theta[k + 2]) / 4.0 for k in (5, 2)]
    grounds = [math.exp(-3.0) * (w / math.sqrt(500.0)) ** 0.7 for w in (70.0, 40.0)]
    assert [mode.height for mode in found] == pytest.approx(
        [1.0 + (height - 1.0) / ground for height, ground in zip(heights, grounds, strict=True)],
        rel=1e-4,
    )
    assert len(modes_of_spectrum(OMEGA, spectrum(theta), modes=1).modes) == 1


# ---- free swings and decays


T = np.arange(45.0) * 0.12


@cache
def swing() -> FreeSwing:
    """Return the swing of one mode, with noise."""
    y = 2.0 + 1.5 * np.exp(-0.15 * T) * np.cos(3.0 * T + 0.4) + noise(T.size, 0.02)
    return free_swing(y, 0.12)


def test_a_swing_has_the_values_and_intervals_of_least_squares() -> None:
    """Frequency, damping, amplitude, the offset and the fit of one mode, by SciPy."""
    found, y = swing(), swing().y
    (mode,) = found.modes

    def curve(t: np.ndarray, *p: float) -> np.ndarray:
        w, z, a, b, rest = p
        swing = a * np.cos(w * math.sqrt(1.0 - z * z) * t) + b * np.sin(
            w * math.sqrt(1.0 - z * z) * t
        )
        return np.exp(-z * w * t) * swing + rest

    best, covariance = optimize.curve_fit(curve, T, y, [3.0, 0.05, 1.4, -0.6, 2.0])
    assert (mode.omega, mode.damping) == pytest.approx(best[:2].tolist(), rel=1e-5)
    assert mode.amplitude == pytest.approx(math.hypot(*best[2:4]), rel=1e-5)
    assert found.at_rest == pytest.approx(best[4], rel=1e-6)
    left = y - curve(T, *best)
    spread = np.linalg.norm(y - np.mean(y))
    assert found.fit == pytest.approx(100.0 * (1.0 - np.linalg.norm(left) / spread), rel=1e-6)
    np.testing.assert_allclose(found.simulated, y - left, atol=1e-5)
    for k, (value, interval) in enumerate(
        ((mode.omega, mode.omega_interval), (mode.damping, mode.damping_interval))
    ):
        low, high = interval
        assert value - low == pytest.approx(high - value, rel=1e-9)
        assert high - value == pytest.approx(1.96 * math.sqrt(covariance[k, k]), rel=0.3)


def test_a_swing_is_told_in_hertz() -> None:
    """With intervals; the report ends with the rest and the fit."""
    turn = 2.0 * math.pi
    mode = Mode(turn * 4.0, (turn * 3.0, turn * 5.0), 0.1, (0.05, 0.15), 0.7)
    assert mode.frequency == pytest.approx(4.0)
    assert str(mode) == (
        "mode at 4 Hz (25.133 rad/s), 95 %: 3 to 5 Hz; damping 0.1, 95 %: 0.05 to 0.15; amplitude 0.7"
    )
    found = swing()._replace(begin=3.0, at_rest=1.0, at_rest_interval=(0.5, 1.5), fit=99.0)
    *modes, last = str(found).splitlines()
    assert modes == [str(found.modes[0])]
    assert last == "from 3 to 1 at rest, 95 %: 0.5 to 1.5; fit 99.000 %"
    value = found.to_json()
    known = found.modes[0]
    assert value["modes"] == [
        known._asdict()
        | {
            "omega_interval": list(known.omega_interval),
            "damping_interval": list(known.damping_interval),
        }
    ]
    assert (value["at_rest"], value["fit"], value["decay"]) == (found.at_rest, found.fit, None)
    decay = found._replace(modes=(), decay=Decay(8.0, (7.0, math.inf)))
    first, said, rest = str(decay).splitlines()
    assert first == "y decays with a time constant of 8 s, 95 %: 7 to inf s"
    assert said.startswith("NOT: the record does not decide the time constant")
    assert rest == last
    assert decay.to_json()["decay"] == {"time_constant": 8.0, "interval": [7.0, None]}


def test_the_pencil_has_the_poles_of_the_swing_strong_ones_first() -> None:
    """Per sample; also where samples are averaged, as at a high rate."""
    k = np.arange(300.0)
    poles = np.array([-0.004 + 0.2j, -0.01 + 0.55j])
    y = 5.0 + np.exp(np.outer(k, poles)).real @ [1.0, 0.4]
    np.testing.assert_allclose(_pencil(y)[:2], poles, rtol=1e-6)
    y = 5.0 + np.exp(np.outer(k, poles)).real @ [0.2, 1.0]
    np.testing.assert_allclose(_pencil(y)[:2], poles[::-1], rtol=1e-6)
    slow = np.exp(np.outer(np.arange(1200.0), [-0.001 + 0.02j])).real[:, 0]
    assert _pencil(slow)[0] == pytest.approx(-0.001 + 0.02j, rel=1e-3)


def test_twenty_samples_are_needed_for_each_mode() -> None:
    """And of two that are given each."""
    y = np.cos(0.9 * np.arange(40.0))
    for count, modes, fails in ((19, 1, True), (20, None, False), (39, 2, True)):
        if fails:
            with pytest.raises(
                ValueError, match=f"y has {count} samples: must have at least 20 for"
            ):
                free_swing(y[:count], 1.0, modes)
        else:
            (mode,) = free_swing(np.exp(-0.02 * np.arange(20.0)) * y[:20], 1.0, modes).modes
            assert mode.omega == pytest.approx(abs(-0.02 + 0.9j), rel=1e-6)


def test_a_decay_has_the_values_and_intervals_of_least_squares() -> None:
    """Time constant, end, begin and fit; twelve samples at least, and no straight line."""
    t = 0.5 * np.arange(30.0)
    y = 20.0 - 15.0 * np.exp(-t / 8.0) + noise(30, 0.05)
    found = free_swing(y, 0.5)
    decay = found.decay
    assert decay is not None
    best, covariance = optimize.curve_fit(
        lambda t, a, end, begin: end + (begin - end) * np.exp(-a * t), t, y, [0.1, 20.0, 5.0]
    )
    assert decay.time_constant == pytest.approx(1.0 / best[0], rel=1e-5)
    assert (found.at_rest, found.begin) == pytest.approx(best[1:].tolist(), rel=1e-5)
    half = 1.96 * math.sqrt(covariance[0, 0])
    low, high = decay.interval
    assert 1.0 / low - 1.0 / decay.time_constant == pytest.approx(half, rel=0.35)
    assert 1.0 / low + 1.0 / high == pytest.approx(2.0 / decay.time_constant, rel=1e-9)
    low, high = found.at_rest_interval
    assert low < found.at_rest < high
    assert high - low == pytest.approx(2.0 * 1.96 * math.sqrt(covariance[1, 1]), rel=0.4)
    left = np.linalg.norm(y - found.simulated) / np.linalg.norm(y - np.mean(y))
    assert found.fit == pytest.approx(100.0 * (1.0 - left), rel=1e-9)
    value = found.to_json()
    assert (value["decay"]["time_constant"], value["begin"]) == (decay.time_constant, found.begin)
    assert tuple(value["at_rest_interval"]) == found.at_rest_interval
    exact_y = 20.0 - 15.0 * np.exp(-t / 8.0)
    short = free_swing(exact_y[:12], 0.5).decay
    assert short is not None
    assert short.time_constant == pytest.approx(8.0, rel=1e-5)
    for record, message in (
        (exact_y[:11], "y has 11 samples: must have at least 12; record longer"),
        (t, "y does not decay: it moves on as a straight line or faster; record longer"),
        (np.exp(0.05 * t), "y does not decay: it moves on as a straight line or faster"),
        (
            noise(30, 1.0),
            "y does not decay: no frequency and no time constant explains more of it than chance;",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            free_swing(record, 0.5, 0)
