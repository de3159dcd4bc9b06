"""Short records: parameters against the truth and other programs, units, and what is said of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import pytest
from scipy import optimize, signal, stats

import quell as ql
from quell.identification import Identified, alternatives, free_swing, friction_search, structures
from quell.identification.given_records import delay_range, resolution_of
from quell.identification.model import Root, gain_interval, poles_of, zeros_of
from quell.identification.structures import _EQUAL, Alternative, not_told_apart
from quell.quantities import Quantity, Signals
from quell.tuning.plants import RecordModel, doubts, identified_plants

from .cases import cases

pytestmark = pytest.mark.compiled

DT = 0.1


@cache
def binary(count: int, seed: int = 1) -> np.ndarray:
    """Return a u of ±1 that holds each value for two samples."""
    rng = np.random.default_rng(seed)
    return np.sign(rng.standard_normal(count)).repeat(2)[:count]


def answer(plant: Any, u: np.ndarray, dt: float = DT, late: int = 0) -> np.ndarray:
    """Return y of a plant (num, den) to a held u, from rest, by SciPy's sampling."""
    num, den, _ = signal.cont2discrete(plant, dt)
    y = signal.lfilter(np.ravel(num), den, u)
    return np.concatenate([np.zeros(late), y[: y.size - late]]) if late else y


def noise(count: int, size: float = 0.01, seed: int = 5) -> np.ndarray:
    """Return white noise."""
    return size * np.random.default_rng(seed).standard_normal(count)


@cache
def noisy() -> Identified:
    """Return the model of a lag with 3/(s + 2) and noise."""
    u = binary(200)
    return ql.identify(u, answer(([3.0], [1.0, 2.0]), u) + noise(200), DT, 1, delay=0.0)


# ---- parameters


def test_a_lag_is_found_exactly_with_its_constant_force_and_the_start() -> None:
    """Of y' + 2 y = 3 (u + 0.5) from y = 4: seven digits, a gain of 1.5 and no doubts."""
    u, a = binary(200), math.exp(-0.2)
    y = np.empty(200)
    y[0] = 4.0
    for k in range(199):
        y[k + 1] = a * y[k] + 1.5 * (1.0 - a) * (u[k] + 0.5)
    found = ql.identify(u, y, DT, 1, delay=0.0)
    assert found.num.tolist() == pytest.approx([3.0], rel=1e-7)
    assert found.den.tolist() == pytest.approx([1.0, 2.0], rel=1e-7)
    assert found.bias == pytest.approx(0.5, rel=1e-6)
    assert found.gain == pytest.approx(1.5, rel=1e-7)
    assert found.gain_interval == pytest.approx((1.5, 1.5), rel=1e-5)
    assert (found.integrators, found.delay, found.rest) == (0, 0.0, False)
    assert found.fits["held out"] > 99.999
    assert found.held_from == 140
    assert found.shortcomings == ()
    (pole,) = found.poles
    assert pole.value == pytest.approx(-2.0)
    np.testing.assert_allclose(found.simulated, y, atol=1e-6)
    assert found.parameters == 4  # a, b, the force, the start


def test_a_fit_and_its_deviations_are_those_of_a_general_least_squares_program() -> None:
    """a, b, force and start by SciPy from the same samples; s² (JᵀJ)⁻¹ within a third."""
    found, u = noisy(), binary(200)
    y = found.y

    def error(theta: np.ndarray) -> np.ndarray:
        a, b, force, start = theta
        p = math.exp(-a * DT)
        x, out = start, []
        for k in range(140):
            out.append(x)
            x = p * x + (1.0 - p) * b / a * (u[k] + force)
        return y[:140] - np.array(out)

    best = optimize.least_squares(error, [1.5, 2.0, 0.0, 0.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert found.den[1] == pytest.approx(best.x[0], rel=1e-5)
    assert found.num[0] == pytest.approx(best.x[1], rel=1e-5)
    assert found.bias == pytest.approx(best.x[2], abs=1e-6)
    covariance = np.linalg.inv(best.jac.T @ best.jac) * float(best.fun @ best.fun) / 136
    assert found.covariance.shape == (2, 2)
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance)), np.sqrt(np.diag(covariance)[:2]), rtol=0.35
    )
    assert found.residuals.rms == pytest.approx(0.01, rel=0.15)
    assert found.noise_std == pytest.approx(0.01, rel=0.15)
    low, high = found.gain_interval
    assert low < 1.5 < high
    assert high - low < 0.02
    left = y - found.simulated
    held = 100.0 * (1.0 - np.linalg.norm(left[140:]) / np.linalg.norm(y[140:] - y[140:].mean()))
    assert found.fits["held out"] == pytest.approx(held, rel=1e-9)


@pytest.mark.parametrize(
    ("plant", "order", "zeros", "given"),
    [
        (([3.0], [1.0, 2.0]), 1, 0, {}),
        (([3.0], [1.0, 0.6, 4.0]), 2, 0, {}),
        (([0.5, 3.0], [1.0, 1.4, 4.0]), 2, 1, {}),
        (([3.0], [1.0, 1.0, 0.0]), 2, 0, {"integrators": 1}),
    ],
)
def test_a_model_has_the_units_of_its_record(
    plant: Any, order: int, zeros: int, given: Any
) -> None:
    """With y in mm, u in mA, t in ms: coefficients, deviations, delays and noise scale, tests stay."""
    u = binary(120)
    y = answer(plant, u) + noise(120)
    how: dict[str, Any] = {"order": order, "zeros": zeros, "delay": 0.0, "held_out": 0.0, **given}
    one = ql.identify(u, y, DT, **how)
    ky, ku, t = 1000.0, 4.0, 50.0
    other = ql.identify(ku * u, ky * y, t * DT, **how)
    n = order
    den = one.den / t ** np.arange(n + 1.0)
    num = one.num * ky / ku / t ** np.arange(n - zeros, n + 1.0)
    np.testing.assert_allclose(other.den, den, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(other.num, num, rtol=1e-5)
    np.testing.assert_allclose(one.num, plant[0], rtol=0.05, atol=0.05)
    np.testing.assert_allclose(one.den, plant[1], rtol=0.05, atol=0.05)
    assert other.integrators == one.integrators == int(bool(given))
    assert other.bias == pytest.approx(ku * one.bias, rel=1e-3, abs=1e-7)
    assert other.residuals.rms == pytest.approx(ky * one.residuals.rms, rel=1e-6)
    assert other.residuals.whiteness == pytest.approx(one.residuals.whiteness, rel=1e-3)
    assert other.residuals.white == one.residuals.white
    assert other.one_more_pole == pytest.approx(one.one_more_pole, rel=1e-2)
    assert other.noise_std == pytest.approx(ky * one.noise_std, rel=1e-4)
    assert other.gain == pytest.approx(one.gain * (ky / ku / (t if given else 1.0)), rel=1e-5)
    for name, fit in one.fits.items():
        assert other.fits[name] == pytest.approx(fit, abs=1e-4), name


@pytest.mark.trial
def test_a_delay_is_searched_in_whole_samples_and_in_parts() -> None:
    """Of 0.3 s between 0.2 and 0.4 s; the start of the record waits, so nothing is before it."""
    u = np.concatenate([np.zeros(6), binary(90)[6:]])
    y = answer(([3.0], [1.0, 2.0]), u, late=3) + noise(90)
    found = ql.identify(u, y, DT, 1, delay=(0.2, 0.4), held_out=0.0)
    assert found.delay == pytest.approx(0.3, abs=0.02)
    assert found.delays_searched == pytest.approx((0.2, 0.4))
    low, high = found.delay_interval
    assert low <= 0.3 + 1e-9 <= high + 0.02
    assert found.num[0] == pytest.approx(3.0, rel=0.02)
    given = ql.identify(u, y, DT, 1, delay=0.3, held_out=0.0)
    assert given.delay == pytest.approx(0.3)
    assert given.delay_interval == pytest.approx((0.3, 0.3))
    assert given.num[0] == pytest.approx(3.0, rel=0.02)


def test_several_records_have_one_model_each_its_own_start() -> None:
    """Two halves with other starts and forces give the coefficients of both."""
    u = binary(240)
    first, second = u[:120], u[120:]
    plant = ([3.0], [1.0, 2.0])
    y = [answer(plant, first), answer(plant, second) + 2.0 * np.exp(-0.2 * np.arange(120.0))]
    found = ql.identify([first, second], y, DT, 1, delay=0.0)
    assert found.num.tolist() == pytest.approx([3.0], rel=1e-6)
    assert found.den.tolist() == pytest.approx([1.0, 2.0], rel=1e-6)
    assert found.samples == (120, 120)
    u_back, y_back = found.records
    assert [part.size for part in u_back] == [120, 120]
    np.testing.assert_array_equal(y_back[1], y[1])
    assert found.parameters == 2 + 2 * 2
    with pytest.raises(ValueError, match="goes with one record"):
        ql.identify([first, second], y, DT, 1, held_out=0.2)
    with pytest.raises(ValueError, match="must both be arrays, or lists of as many arrays"):
        ql.identify([first, second], y[:1], DT, 1)


def test_another_record_judges_a_model() -> None:
    """Its fit is near 100 of the same plant, and below zero of one with the other sign."""
    u, other = binary(150), binary(150, seed=9)
    plant = ([3.0], [1.0, 2.0])
    y = answer(plant, u) + noise(150)
    right = (other, answer(plant, other) + noise(150, seed=8))
    found = ql.identify(u, y, DT, 1, delay=0.0, held_out=0.0, validation=right)
    assert found.fits["validation"] > 97.0
    assert "held out" not in found.fits
    assert not found.fails
    wrong = ql.identify(u, y, DT, 1, delay=0.0, held_out=0.0, validation=(other, -right[1]))
    assert wrong.fits["validation"] < 0.0
    assert wrong.fails
    assert any("worse than the mean of its y" in text for text in wrong.shortcomings)


@pytest.mark.trial
def test_instruments_from_the_reference_find_the_plant_in_a_loop() -> None:
    """With a load that drifts in the loop; the fit without reference is told another plant."""
    rng = np.random.default_rng(11)
    r = binary(400, seed=3)
    a, y, load = math.exp(-0.2), 0.0, 0.0
    u_log, y_log = [], []
    for k in range(400):
        u = 2.0 * (r[k] - y)
        u_log.append(u)
        y_log.append(y)
        load = 0.9 * load + 0.05 * rng.standard_normal()
        y = a * y + 1.5 * (1.0 - a) * (u + load)
    found = ql.identify(u_log, y_log, DT, 1, delay=0.0, reference=r, held_out=0.0)
    assert found.num[0] == pytest.approx(3.0, rel=0.06)
    assert found.den[1] == pytest.approx(2.0, rel=0.15)
    assert found.method.startswith("instrumental variables from the reference")


def test_coulomb_friction_of_a_speed_is_found() -> None:
    """Of y' = −y + 2 u − 0.6 sign y, integrated in 100 steps of a sample: 0.3 in units of u."""
    u, y, x = 1.5 * binary(200), [], 0.0
    u = u * (1.0 + 0.5 * np.sin(0.3 * np.arange(200)))
    for value in u.tolist():
        y.append(x)
        for _ in range(100):
            x += 1e-3 * (-x + 2.0 * value - 0.6 * math.copysign(1.0, x))
    found = ql.identify(u, y, DT, 1, delay=0.0, friction=True, held_out=0.0)
    assert found.num[0] == pytest.approx(2.0, rel=0.02)
    assert found.den[1] == pytest.approx(1.0, rel=0.05)
    assert found.friction == pytest.approx(0.3, rel=0.05)
    speed = float(np.sqrt(np.mean(found.simulated**2)))
    assert 0.0 < found.friction_width < speed
    assert found.parameters == 5
    assert "Coulomb friction 0." in found.describe()


@pytest.mark.trial
def test_coulomb_friction_of_a_position_is_found() -> None:
    """Of y'' = −0.5 y' + 2 u − 0.8 sign y', integrated in 20 steps of a sample: 0.4 in units of u."""
    u, y, x, v = 2.0 * binary(92), [], 0.0, 0.0
    for value in u.tolist():
        y.append(x)
        for _ in range(20):
            v += 0.005 * (-0.5 * v + 2.0 * value - 0.8 * math.copysign(1.0, v))
            x += 0.005 * v
    how: dict[str, Any] = {"delay": 0.0, "friction": True, "held_out": 0.0, "integrators": 1}
    with patch.multiple(friction_search, _PASSES=2, _MOST_RUNS=8):
        found = ql.identify(u, y, DT, 2, **how)
    assert found.num[0] == pytest.approx(2.0, rel=0.03)
    assert found.den[1] == pytest.approx(0.5, abs=0.05)
    assert found.friction == pytest.approx(0.4, rel=0.06)
    assert found.integrators == 1


# ---- free swings


@pytest.mark.trial
def test_a_free_swing_has_its_frequency_damping_and_amplitude() -> None:
    """A decaying cosine about 3: exactly, and with noise within the intervals."""
    t = np.arange(90) * DT
    zeta, omega = 0.05, 4.0
    swing = 0.8 * np.exp(-zeta * omega * t) * np.cos(omega * math.sqrt(1.0 - zeta**2) * t + 0.4)
    found = free_swing(3.0 + swing, DT, modes=1)
    (mode,) = found.modes
    assert mode.omega == pytest.approx(omega, rel=1e-7)
    assert mode.damping == pytest.approx(zeta, rel=1e-6)
    assert mode.amplitude == pytest.approx(0.8, rel=1e-6)
    assert mode.frequency == pytest.approx(omega / math.tau)
    assert found.at_rest == pytest.approx(3.0, rel=1e-9)
    assert found.fit == pytest.approx(100.0, abs=1e-4)
    seen = free_swing(3.0 + swing + noise(90, 0.02), DT, modes=1)
    (mode,) = seen.modes
    low, high = mode.omega_interval
    assert low < mode.omega < high
    assert 0.5 * (low + high) == pytest.approx(mode.omega)
    assert low - 0.01 < omega < high + 0.01
    assert high - low < 0.03
    low, high = mode.damping_interval
    assert low < zeta < high
    assert 0.5 * (low + high) == pytest.approx(mode.damping)
    assert str(mode).startswith(f"mode at {mode.frequency:.5g} Hz ({mode.omega:.5g} rad/s), 95 %: ")
    assert f" to {seen.at_rest:.5g} at rest, 95 %: " in str(seen)
    assert str(seen).endswith(f"; fit {seen.fit:.3f} %")
    assert json.loads(json.dumps(seen.to_json()))["modes"][0]["omega"] == mode.omega
    left = np.linalg.norm(seen.y - seen.simulated) / np.linalg.norm(seen.y - seen.y.mean())
    assert seen.fit == pytest.approx(100.0 * (1.0 - left))


@pytest.mark.trial
def test_two_modes_come_with_the_larger_one_first_and_in_any_unit() -> None:
    """4 and 9 rad/s; y in mm and t in ms scale amplitudes and frequencies, not damping."""
    t = np.arange(160) * DT
    y = np.exp(-0.2 * t) * np.cos(4.0 * t) + 0.4 * np.exp(-0.3 * t) * np.cos(9.0 * t + 1.0)
    found = free_swing(y, DT)
    assert [mode.omega for mode in found.modes] == pytest.approx(
        [math.hypot(4.0, 0.2), math.hypot(9.0, 0.3)], rel=1e-6
    )
    assert [mode.damping for mode in found.modes] == pytest.approx(
        [0.2 / math.hypot(4.0, 0.2), 0.3 / math.hypot(9.0, 0.3)], rel=1e-5
    )
    assert [mode.amplitude for mode in found.modes] == pytest.approx([1.0, 0.4], rel=1e-5)
    scaled = free_swing(1000.0 * y, 50.0 * DT)
    for one, other in zip(found.modes, scaled.modes, strict=True):
        assert other.omega == pytest.approx(one.omega / 50.0, rel=1e-6)
        assert other.damping == pytest.approx(one.damping, rel=1e-5)
        assert other.amplitude == pytest.approx(1000.0 * one.amplitude, rel=1e-5)


@cases(
    ("y", "modes", "message"),
    [
        (np.ones(100), None, "y is 1 all through: must ring"),
        (np.exp(-0.1 * np.arange(100)), 1, "y does not ring: no pole with a frequency"),
        (np.cos(np.arange(19.0)), None, "y has 19 samples: must have at least 20"),
        (np.cos(np.arange(39.0)), 2, "y has 39 samples: must have at least 20 for each mode"),
        (np.cos(np.arange(100.0)), 6, "modes"),
    ],
)
@pytest.mark.trial
def test_a_record_that_does_not_ring_is_refused(y: Any, modes: Any, message: str) -> None:
    """At rest, a mere decay, too short for its modes, more modes than five."""
    with pytest.raises(ValueError, match=message):
        free_swing(y, DT, modes)


# ---- small functions


def test_roots_have_the_deviations_of_a_first_order_expansion() -> None:
    """Of s² + a_1 s + a_0: by differences; frequency, damping and their conjugates."""
    a, P = np.array([4.0, 0.8]), np.array([[0.02, 0.003], [0.003, 0.01]])
    poles = poles_of(a, P, 0)
    assert len(poles) == 2
    for pole in poles:
        assert pole.omega == pytest.approx(2.0)
        assert pole.damping == pytest.approx(0.2)

        def root(a: np.ndarray, near: complex = pole.value) -> complex:
            found = np.roots([1.0, a[1], a[0]])
            return complex(found[np.argmin(np.abs(found - near))])

        slope = np.array([(root(a + h) - root(a - h)) / 2e-6 for h in 1e-6 * np.eye(2)])
        real, imag = slope.real, slope.imag
        assert pole.value == pytest.approx(root(a))
        assert pole.real_std == pytest.approx(math.sqrt(real @ P @ real), rel=1e-5)
        assert pole.imag_std == pytest.approx(math.sqrt(imag @ P @ imag), rel=1e-5)
    (zero,) = zeros_of(np.array([6.0, 2.0]), np.array([[0.04, 0.0], [0.0, 0.0]]))
    assert zero.value == pytest.approx(-3.0)
    assert zero.real_std == pytest.approx(0.1)
    integrating = poles_of(np.array([0.0, 0.5]), np.diag([0.0, 0.01]), 1)
    assert sorted(pole.value.real for pole in integrating) == pytest.approx([-0.5, 0.0])


def test_the_interval_of_a_gain_is_fieller_s() -> None:
    """At its ends g the value b − g a is 1.96 of its own deviations from zero."""
    a, b, P = 2.0, 3.0, np.array([[0.05, 0.03], [0.03, 0.1]])
    ends = gain_interval(np.array([a]), b, P)
    assert ends[0] < 1.5 < ends[1]
    for g in ends:
        variance = P[1, 1] - 2.0 * g * P[0, 1] + g * g * P[0, 0]
        assert abs(b - g * a) == pytest.approx(1.959964 * math.sqrt(variance), rel=1e-3)
    mirrored = gain_interval(np.array([a]), -b, P * [[1.0, -1.0], [-1.0, 1.0]])
    assert mirrored == pytest.approx((-ends[1], -ends[0]))
    # A pole that may be at zero: the gain has no upper end, and none at all if b may be zero, too.
    low, high = gain_interval(np.array([0.1]), 3.0, np.diag([0.01, 0.01]))
    assert (low > 0.0, high) == (True, math.inf)
    low, high = gain_interval(np.array([0.1]), -3.0, np.diag([0.01, 0.01]))
    assert (low, high < 0.0) == (-math.inf, True)
    assert gain_interval(np.array([0.1]), 0.1, np.diag([0.01, 0.01])) == (-math.inf, math.inf)
    half = 1.959964 * 0.2
    assert gain_interval(np.zeros(0), 3.0, np.array([[0.04]])) == pytest.approx(
        (3.0 - half, 3.0 + half), rel=1e-4
    )
    assert gain_interval(np.array([a]), b, np.full((2, 2), np.nan)) == (-math.inf, math.inf)


@cases(
    ("delay", "expected"),
    [
        (None, (0, 20)),
        (0.0, (0, 0)),
        (0.3, (3, 3)),
        (0.25, (2.5, 2.5)),
        ((0.0, 0.5), (0, 5)),
        ((0.11, 0.39), (2, 3)),
        ((0.12, 0.15), (2, 2)),
    ],
)
def test_delays_are_searched_in_samples_inside_their_range(delay: Any, expected: Any) -> None:
    """None up to 20 samples, of a short record a quarter of it; numbers stay what they are."""
    assert delay_range(delay, 0.1, 400) == pytest.approx(expected)
    assert delay_range(None, 0.1, 40) == (0, 10)
    for wrong in ((0.5, 0.1), (-0.1, 0.1), -0.1):
        with pytest.raises(ValueError, match="delay"):
            delay_range(wrong, 0.1, 400)


def test_the_step_of_a_rounded_record_is_found_and_noise_has_none() -> None:
    """Steps of 0.25, some of them several; none for white noise or a constant."""
    rng = np.random.default_rng(2)
    y = 0.25 * np.cumsum(rng.integers(-2, 3, 300))
    assert resolution_of(y) == pytest.approx(0.25)
    assert resolution_of(1e6 + y) == pytest.approx(0.25)
    assert resolution_of(rng.standard_normal(300)) == 0.0
    assert resolution_of(np.ones(300)) == 0.0


def test_what_is_simulated_follows_from_u_alone() -> None:
    """In both parts: x⁺ = p x + (1 − p) b/a (u + force), each from a start of its own."""
    found = noisy()
    a, b = found.den[1], found.num[0]
    p, u = math.exp(-a * DT), binary(200)
    for first, last in ((0, 140), (140, 200)):
        x = found.simulated[first]
        for k in range(first, last - 1):
            x = p * x + (1.0 - p) * b / a * (u[k] + found.bias)
            assert found.simulated[k + 1] == pytest.approx(x, abs=1e-9)


def test_the_response_of_a_model_has_its_delay_and_that_of_the_hold() -> None:
    """G exp(−s T) with half a sample more, and a sinc; at one frequency by hand."""
    found = replace(noisy(), delay=0.2)
    s = 2.0j
    x = 2.0 * DT / 2.0
    expected = found.num[0] / (s + found.den[1]) * np.exp(-s * (0.2 + DT / 2.0)) * math.sin(x) / x
    assert complex(found.response(2.0)) == pytest.approx(expected)
    direct = replace(noisy(), num=np.array([2.0, 1.0]))
    inner = (2.0 * s + 1.0) / (s + direct.den[1]) - 2.0
    expected = inner * np.exp(-s * DT / 2.0) * math.sin(x) / x + 2.0
    assert complex(direct.response(2.0)) == pytest.approx(expected)
    with pytest.raises(ValueError, match="direct feedthrough"):
        _ = direct.plant
    assert noisy().plant.A.tolist() == [[pytest.approx(-found.den[1])]]


# ---- what is said


@cases(
    ("changed", "text"),
    [
        ({"early": 1}, "y follows the u of the same sample, on which it can't depend: it is early by 1 sample,"),
        ({"early": 2}, "y follows the u of the next sample, on which it can't depend: it is early by 2 samples,"),
        ({"before": True, "delay": 0.3}, "u was another one before the record, which acts in its first samples (0.3 s"),
        ({"curvature": 0.93}, "the gain depends on the operating point or on the sign of u: the response to u² and |u| explains 93 % of the error of a linear model"),
        ({"rest": True, "rest_given": True, "rest_probability": 1e-9}, "the first samples contradict the start at rest (probability 1e-09)"),
        ({"one_more_pole": 30.0, "one_more_pole_limit": 10.0, "misfit": 0.5, "misfit_omega": 3.0}, "the response to u is not of this form: G may be off by 50 % at 3 rad/s (one more pole: 30, limit 10)"),
        ({"one_more_pole": 30.0, "one_more_pole_limit": 10.0, "misfit": 2.0}, "the response to u is not of this form: G may be off by more than itself"),
        ({"fits": {"estimation": 99.0, "held out": 1.0}}, "u explains hardly anything of y (fit 1.0 %)"),
        ({"fits": {"estimation": 99.0, "validation": -1.0}}, "on the record for validation the model is worse than the mean of its y (fit -1.0 %)"),
        ({"delays_searched": (0.0, 0.5), "delay": 0.5}, "the record does not decide the delay: 0.5 s is the longest one"),
        ({"rest": True, "rest_probability": 0.5}, "the record does not decide whether the plant was at rest before it"),
    ],
)  # fmt: skip
def test_each_shortcoming_is_said_with_what_to_do(changed: Any, text: str) -> None:
    """A good model has none; the report has it as a line that begins with NOT."""
    assert noisy().shortcomings == ()
    found = replace(noisy(), **changed)
    assert len(found.shortcomings) == 1
    assert found.shortcomings[0].startswith(text)
    assert f"NOT: {text}" in found.describe()


def test_what_is_no_shortcoming_is_not_said() -> None:
    """A misfit of no matter, a delay inside of its range, a start that is probable."""
    for changed in (
        {"one_more_pole": 30.0, "one_more_pole_limit": 10.0, "misfit": 1e-3},
        {"delays_searched": (0.0, 0.5), "delay": 0.4},
        {"rest": True, "rest_given": True, "rest_probability": 0.5},
        {"curvature": 0.1},
        {"fits": {"estimation": 99.0, "validation": 1.0}},
    ):
        assert replace(noisy(), **changed).shortcomings == ()


def test_poles_that_are_unstable_too_fast_or_cancelled_are_faults() -> None:
    """π/dt is the fastest that samples show; a zero within three deviations cancels one pole."""
    one = noisy()
    unstable = replace(one, poles=(Root(0.5 + 0j, 0.1, 0.0),))
    assert unstable.faults[0].startswith("the pole at 0.5")
    assert "is unstable; if the plant is stable, use a lower order" in unstable.faults[0]
    fast = replace(one, poles=(Root(-31.5 + 0j, 0.1, 0.0),))
    assert "is faster than samples show, 31.42 rad/s; use fewer poles" in fast.faults[0]
    assert replace(one, poles=(Root(-31.3 + 0j, 0.1, 0.0),)).faults == ()
    poles = (Root(-2.0 + 0j, 0.1, 0.0), Root(-2.1 + 0j, 0.1, 0.0))
    near = replace(one, poles=poles, zeros=(Root(-2.02 + 0j, 0.1, 0.0),))
    assert len(near.faults) == 1
    assert "the pole at -2" in near.faults[0].replace("−", "-")
    assert "nearly equals a zero" in near.faults[0]
    away = replace(one, poles=poles[:1], zeros=(Root(-3.5 + 0j, 0.1, 0.0),))
    assert away.faults == ()


def test_a_gain_that_the_record_does_not_decide_is_said() -> None:
    """Its sign where the interval has zero, its size beyond; unless the highest derivative is sure."""
    one = noisy()
    poor = np.diag([0.01, 1e4])
    assert (
        replace(one, gain_interval=(-1.0, 4.0), covariance=poor)
        .undecided[0]
        .startswith("the record does not decide the sign of the gain: it is ")
    )
    assert (
        replace(one, gain_interval=(0.5, 4.0), covariance=poor)
        .undecided[0]
        .startswith("the record does not decide the size of the gain: it is ")
    )
    sure = replace(one, gain_interval=(0.5, 4.0))
    assert sure.undecided == ()
    assert "as the slowest pole may be at s = 0" in sure.shortcomings[0]


def test_the_json_of_a_model_has_its_numbers() -> None:
    """Coefficients, poles, intervals and tests."""
    found = noisy()
    shown = json.loads(json.dumps(found.to_json()))
    assert shown["num"] == found.num.tolist()
    assert shown["den"] == found.den.tolist()
    assert shown["gain"] == found.gain
    assert shown["gain_interval"] == list(found.gain_interval)
    assert shown["dt"] == DT
    assert shown["samples"] == 200
    assert shown["friction"] is None
    assert repr(found).startswith("Identified(order=1, poles ")
    mm = replace(found, signals=Signals(Quantity("position", "mm"), Quantity("force", "N")))
    assert mm.plant.name == "identified plant"


# ---- other structures, and plants of a set


def test_a_second_pole_is_worse_where_one_was_left_out() -> None:
    """Of a record of two lags a model of one has an alternative that fits better, and is taken."""
    u = binary(120)
    y = answer(([6.0], [1.0, 5.0, 6.0]), u) + noise(120, 0.003)
    one = ql.identify(u, y, DT, 1, delay=0.0, held_out=0.0)
    assert not one.explained
    (found,) = [each for each in alternatives(one) if each.name == "order 2"]
    assert found.verdict == "better"
    assert not found.smaller
    assert found.options == "--order 2"
    assert found.model.den.tolist() == pytest.approx([1.0, 5.0, 6.0], rel=0.1)
    line = found.describe(one)
    assert line.startswith("NOT: order 2 (--order 2) fits better: ")
    assert line.endswith("; take it")


def alternative(**changed: Any) -> Alternative:
    """Return an alternative for the model of a lag."""
    given = {"name": "order 2", "smaller": False, "gain": 0.5, "z": 5.0, "limit": 3.0}
    rest = {"by_likelihood": False, "model": noisy(), "options": "--order 2"}
    return Alternative(**{**given, **rest, **changed})


def test_a_verdict_needs_both_significance_and_size() -> None:
    """|z| below its limit, or a gain that is too small, decides nothing; a likelihood does."""
    assert alternative().verdict == "better"
    assert alternative(z=-5.0).verdict == "worse"
    assert alternative(z=2.9).verdict == "undecided"
    assert alternative(gain=1e-9).verdict == "undecided"
    assert alternative(z=3.0).verdict == "better"  # at the limit it is decided
    assert alternative(gain=_EQUAL).verdict == "better"
    assert alternative(gain=-_EQUAL, z=-5.0).verdict == "worse"
    assert alternative(gain=1e-9, by_likelihood=True).verdict == "better"
    assert alternative(z=-2.9, by_likelihood=True).may_be_as_good
    assert not alternative(z=-3.0, by_likelihood=True).may_be_as_good
    assert not alternative(z=-2.9, gain=-0.5).may_be_as_good
    assert not alternative(z=-2.9, by_likelihood=True, in_delay=1.0).may_be_as_good
    assert alternative().usable
    stuck = alternative(model=replace(noisy(), converged=False))
    assert not stuck.usable
    assert stuck.describe(noisy()).endswith("but do NOT take it: its search did not converge")
    assert alternative(z=-5.0).describe(noisy()) == ""
    text = alternative(name="order 0", smaller=True, z=1.0).describe(noisy())
    assert text.startswith("the record cannot decide between order 1 and order 0: ")
    assert text.endswith("take order 0 (--order 2), which has fewer parameters, or record more")
    assert "z 5.0, limit 3.0" in alternative().describe(noisy())
    assert "likelihood ratio 5.0, limit 3.0" in alternative(by_likelihood=True).describe(noisy())
    assert alternative().to_json()["verdict"] == "better"


def test_a_model_that_explains_all_stays() -> None:
    """One pole has no smaller model, and the test finds no further one."""
    assert not_told_apart(noisy()) == (noisy(),)


def test_a_smaller_model_with_faults_is_a_step_and_not_the_result() -> None:
    """The last model without faults stays, and a smaller one behind the faulty one is reached."""
    good, faulty, small = noisy(), Mock(faults=("b",), converged=True), Mock(faults=())

    def fewer(model: Any) -> Any:
        one = alternative(model=model, smaller=True, z=-1.0, by_likelihood=True)
        return (one,)

    for steps, result in (
        ({id(good): fewer(faulty)}, (good,)),
        ({id(good): fewer(faulty), id(faulty): fewer(small)}, (small, good)),
    ):
        of = Mock(side_effect=lambda one, *_, steps=steps, **__: steps.get(id(one), ()))
        with patch.object(structures, "alternatives", of):
            assert not_told_apart(good) == result


def test_the_plants_of_a_model_are_the_ends_of_its_joint_intervals() -> None:
    """Two coefficients: ±√χ²(0.95, 2) deviations along each, and along the gain."""
    found = noisy()
    plants, delays = identified_plants(found)
    theta = np.array([found.den[1], found.num[0]])
    P, k = found.covariance, math.sqrt(stats.chi2.ppf(0.95, 2))
    assert len(plants) == 7
    assert delays == [0.0] * 7
    np.testing.assert_allclose(plants[0][0], found.num)
    np.testing.assert_allclose(plants[0][1], found.den)
    ends = np.array([[den[1], num[0]] for num, den in plants[1:]])
    for i in (0, 1):
        pair = ends[2 * i : 2 * i + 2]
        np.testing.assert_allclose(pair.mean(axis=0), theta, rtol=1e-12)
        np.testing.assert_allclose(pair[0] - theta, k * P[:, i] / math.sqrt(P[i, i]), rtol=1e-9)
    for point in ends:
        step = point - theta
        assert float(step @ np.linalg.solve(P, step)) == pytest.approx(k**2, rel=1e-6)
    gains = ends[:, 1] / ends[:, 0]
    assert np.argmax(np.abs(gains - found.gain)) in (4, 5)
    more = identified_plants(found, [replace(found, delay=0.2)])
    assert len(more[0]) == 8
    assert more[1][-1] == 0.2


def test_a_y_that_is_early_in_a_larger_model_is_the_refusal_of_a_smaller_one() -> None:
    """Only where the larger model explains more."""
    found = noisy()
    nearer = replace(found, simulated=found.y + 0.5 * (found.simulated - found.y), early=1)
    refusal = RecordModel(found, (), 0.3, nearer).refusal
    assert refusal.startswith("y follows the u of the same sample")
    assert "leave out the first 1 sample of u and the last of y" in refusal
    assert RecordModel(found, (), 0.3, replace(nearer, early=0)).refusal == ""
    assert RecordModel(found, (), 0.3, replace(found, early=1)).refusal == ""


def test_a_record_model_says_why_nothing_can_be_tuned_for_it() -> None:
    """Faults and what is undecided; a good one has the plants of its set."""
    good = RecordModel(noisy(), (), 0.3)
    assert good.refusal == ""
    assert len(good.plants[0]) == 7
    assert doubts(noisy()) == ()
    stuck = replace(noisy(), converged=False)
    assert doubts(stuck) == ("the search did not converge; record longer",)
    bad = RecordModel(replace(noisy(), poles=(Root(0.5 + 0j, 0.1, 0.0),)), (), 0.3)
    assert "is unstable" in bad.refusal
    with pytest.raises(ValueError, match="record: no plant to tune for: the pole at"):
        _ = bad.plants
    larger = RecordModel(noisy(), (), 0.3, stuck)
    text = "\n".join(larger.lines)
    assert "but does not hold: its search did not converge" in text
    assert "order 1 has a fit of " in text
    several = RecordModel(noisy(), (stuck,), 0.3)
    assert "the record does not tell it from Identified(order=1" in "\n".join(several.lines)
