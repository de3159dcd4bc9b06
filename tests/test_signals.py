"""Signals against their closed forms."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quell import signals as s

from .cases import cases

T = np.linspace(0.0, 12.0, 1201)


class Short(s.Signal):
    """A signal of the wrong shape."""

    def evaluate(self, t: np.ndarray) -> np.ndarray:
        """Return one value for all times."""
        return np.zeros(1)


def test_a_step_begins_at_its_sample() -> None:
    """An edge on a sample belongs to it, even where k·dt falls short of it by rounding."""
    t = np.arange(5) * 0.1
    np.testing.assert_array_equal(s.Step(height=2.0, at=0.3)(t), [0.0, 0.0, 0.0, 2.0, 2.0])


def test_a_ramp_rises_between_start_and_stop() -> None:
    """Slope times the time since the start, held afterwards."""
    np.testing.assert_allclose(
        s.Ramp(slope=2.0, start=1.0, stop=3.0)([0.0, 1.0, 2.0, 3.0, 9.0]), [0.0, 0.0, 2.0, 4.0, 4.0]
    )


def test_a_sinusoid_is_a_sine_from_its_start() -> None:
    """Zero before, phase counted from the start."""
    wave = s.Sinusoid(amplitude=3.0, omega=2.0, phase=0.5, start=4.0)(T)
    np.testing.assert_allclose(wave[T >= 4.0], 3.0 * np.sin(2.0 * (T[T >= 4.0] - 4.0) + 0.5))
    assert np.all(wave[T < 4.0] == 0.0)


def test_a_chirp_has_the_frequency_it_names_at_both_ends() -> None:
    """The frequency between its zero crossings goes from the first to the last value and stays."""
    t = np.linspace(0.0, 40.0, 400_001)
    wave = s.Chirp(omega_start=2.0, omega_end=10.0, duration=20.0)(t)
    crossings = t[1:][(wave[:-1] < 0.0) & (wave[1:] >= 0.0)]
    frequency = 2.0 * np.pi / np.diff(crossings)
    middle = 0.5 * (crossings[1:] + crossings[:-1])
    np.testing.assert_allclose(frequency, np.minimum(2.0 + 8.0 * middle / 20.0, 10.0), rtol=0.02)


@given(distance=st.floats(-5.0, 5.0), duration=st.floats(0.5, 5.0), share=st.floats(0.05, 0.5))
def test_a_trapezoid_starts_and_ends_at_rest_and_covers_its_distance(
    distance: float, duration: float, share: float
) -> None:
    """Its speed is continuous, its largest is distance/(duration − ramp)."""
    ramp = share * duration
    move = s.Trapezoid(distance=distance, duration=duration, ramp_time=ramp, start=1.0)
    t = np.linspace(0.0, duration + 2.0, 20_001)
    position = move(t)
    speed = np.gradient(position, t)
    assert position[0] == 0.0
    assert position[-1] == pytest.approx(distance)
    assert np.max(np.abs(speed)) == pytest.approx(
        abs(distance) / (duration - ramp), rel=1e-3, abs=1e-9
    )
    assert (
        np.max(np.abs(np.diff(speed)))
        <= 1.01 * abs(distance) / (duration - ramp) / ramp * (t[1] - t[0]) + 1e-9
    )


@pytest.mark.parametrize("logarithmic", [False, True])
def test_the_phase_of_a_chirp_is_the_integral_of_its_frequency(logarithmic: bool) -> None:
    """Before its start, along the sweep, and beyond it, where the last frequency stays."""
    chirp = s.Chirp(2.0, 0.5, 8.0, duration=4.0, start=1.0, logarithmic=logarithmic)
    t = np.linspace(1.0, 7.0, 60_001)
    phase = np.concatenate(
        [[0.0], np.cumsum(0.5 * np.diff(t) * (chirp.omega(t)[1:] + chirp.omega(t)[:-1]))]
    )
    np.testing.assert_allclose(chirp(t), 2.0 * np.sin(phase), atol=1e-6)
    assert chirp(0.3) == 0.0
    middle = math.sqrt(0.5 * 8.0) if logarithmic else 0.5 * (0.5 + 8.0)
    np.testing.assert_allclose(chirp.omega([0.0, 1.0, 3.0, 5.0, 9.0]), [0.5, 0.5, middle, 8.0, 8.0])
    same = s.Chirp(2.0, 3.0, 3.0, duration=4.0, start=1.0, logarithmic=logarithmic)
    np.testing.assert_allclose(same(t), 2.0 * np.sin(3.0 * (t - 1.0)), atol=1e-12)


def test_moves_have_the_values_of_their_formulas() -> None:
    """By hand: ramps of a third by default; 3σ² − 2σ³ and its derivatives for a smooth move."""
    third = s.Trapezoid(distance=-4.0, duration=3.0, start=1.0)
    np.testing.assert_allclose(
        third(np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 9.0])),
        [0.0, 0.0, -0.25, -1.0, -2.0, -3.0, -3.75, -4.0, -4.0],
    )
    triangle = s.Trapezoid(distance=2.0, duration=2.0, ramp_time=1.0)
    np.testing.assert_allclose(triangle([0.5, 1.0, 1.5, 2.0]), [0.25, 1.0, 1.75, 2.0])
    move, t = (
        s.SmoothMove(distance=2.0, duration=4.0, smoothness=1, start=1.0),
        np.array([1.5, 2.0, 4.5]),
    )
    sigma = (t - 1.0) / 4.0
    np.testing.assert_allclose(move(t), 2.0 * (3.0 * sigma**2 - 2.0 * sigma**3))
    speed = move.derivative()
    np.testing.assert_allclose(speed(t), 2.0 * (6.0 * sigma - 6.0 * sigma**2) / 4.0)
    np.testing.assert_allclose(speed.derivative()(t), 2.0 * (6.0 - 12.0 * sigma) / 16.0)
    assert (move(0.9), move(5.0), move(7.0), speed(0.9), speed(5.1)) == (0.0, 2.0, 2.0, 0.0, 0.0)
    assert speed.derivative()(1.0) == pytest.approx(0.75)
    assert speed.derivative()(5.0) == 0.0


def test_edges_of_ramps_sinusoids_and_samples() -> None:
    """At the edge, before and after it; derivatives are those of the pieces."""
    ramp = s.Ramp(slope=2.0, start=1.0, stop=3.0)
    np.testing.assert_allclose(ramp([0.0, 1.0, 2.0, 3.0, 5.0]), [0.0, 0.0, 2.0, 4.0, 4.0])
    np.testing.assert_allclose(ramp.derivative()([0.5, 1.0, 2.9, 3.0]), [0.0, 2.0, 2.0, 0.0])
    np.testing.assert_allclose(s.Ramp(2.0, 1.0).derivative()([0.5, 9.0]), [0.0, 2.0])
    wave = s.Sinusoid(amplitude=3.0, omega=2.0, phase=0.4, start=1.0)
    np.testing.assert_allclose(wave([0.9, 1.0, 2.0]), [0.0, 3 * math.sin(0.4), 3 * math.sin(2.4)])
    np.testing.assert_allclose(wave([1.5, 2.0]), 3.0 * np.sin([1.4, 2.4]))
    np.testing.assert_allclose(wave([0.1, 0.2]), [0.0, 0.0])
    held = s.Samples([1.0, 2.0, 4.0], [5.0, 7.0, 1.0], hold="previous")
    np.testing.assert_allclose(held([0.0, 1.0, 1.999, 2.0, 3.0, 4.0, 9.0]), [5, 5, 5, 7, 7, 1, 1])
    assert held.derivative()(1.5) == 0.0
    joined = s.Samples([1.0, 2.0, 4.0], [5.0, 7.0, 1.0])
    np.testing.assert_allclose(joined([0.0, 1.5, 3.0, 9.0]), [5.0, 6.0, 4.0, 1.0])
    slopes = joined.derivative()
    np.testing.assert_allclose(
        slopes([0.0, 1.0, 1.5, 2.0, 3.9, 4.0]), [0.0, 2.0, 2.0, -3.0, -3.0, 0.0]
    )
    assert s.Samples([1.0], [5.0]).derivative()(1.0) == 0.0
    two = s.Samples([0.0, 1.0], [0.0, 3.0]).derivative()
    assert two(0.5) == 3.0


def test_pieces_without_duration_are_refused_and_a_constant_is_zero_by_default() -> None:
    """Two switches at one time have nothing between them."""
    with pytest.raises(ValueError, match="must increase"):
        s.Switched((1.0, 1.0), (s.Step(), s.Ramp(), s.Constant()))
    assert s.Constant()(3.0) == 0.0


def test_parameters_of_moves_have_their_documented_defaults_and_limits() -> None:
    """Two seconds over a distance of 1; durations must be positive."""
    assert s.Trapezoid() == s.Trapezoid(1.0, 2.0, None, 0.0)
    assert s.SmoothMove() == s.SmoothMove(1.0, 2.0, 4, 0.0, 0)
    assert s.Chirp() == s.Chirp(1.0, 0.1, 10.0, 10.0, 0.0, False)
    for kind in (s.Trapezoid, s.SmoothMove, s.Chirp):
        with pytest.raises(ValueError, match="duration = 0.0: must be finite and greater"):
            kind(duration=0.0)
    with pytest.raises(ValueError, match="smoothness = 13"):
        s.SmoothMove(smoothness=13)


def test_arithmetic_has_the_signs_of_numbers() -> None:
    """With signals and numbers on both sides."""
    one, t = s.Ramp(), 3.0
    assert ((one - 1.0)(t), (1.0 - one)(t), (-one)(t), (one / 2.0)(t)) == (2.0, -2.0, -3.0, 1.5)
    assert ((one + one)(t), (2.0 * one)(t), (one - s.Step(0.5))(t)) == (6.0, 6.0, 2.5)
    assert (one * -2.0).derivative()(t) == -2.0


def test_signals_add_subtract_and_scale() -> None:
    """The algebra is that of functions; numbers are constants."""
    both = 2.0 * s.Sinusoid() - s.Step(at=3.0) + 1.0
    np.testing.assert_allclose(both(T), 2.0 * np.sin(T) - (T >= 3.0 - 1e-9) + 1.0)
    np.testing.assert_allclose((-s.Sinusoid())(T), -np.sin(T))
    np.testing.assert_allclose((1.0 - s.Sinusoid() / 2.0)(T), 1.0 - 0.5 * np.sin(T))


def test_pieces_switch_at_their_times() -> None:
    """Each piece holds from its time on, as a function of absolute time."""
    pieces = s.Switched((3.0, 6.0), (s.Constant(1.0), s.Sinusoid(), s.Constant(-1.0)))
    expected = np.where(T < 3.0 - 1e-9, 1.0, np.where(T < 6.0 - 1e-9, np.sin(T), -1.0))
    np.testing.assert_allclose(pieces(T), expected)
    np.testing.assert_allclose(
        s.Constant(1.0).until(3.0, then=s.Sinusoid()).until(6.0, then=s.Constant(-1.0))(T), expected
    )


def test_recorded_samples_are_interpolated_or_held() -> None:
    """Both ways go through the samples; the ends hold."""
    times, values = [0.0, 1.0, 3.0], [0.0, 2.0, -2.0]
    np.testing.assert_allclose(
        s.Samples(times, values)([-1.0, 0.5, 1.0, 2.0, 9.0]), [0.0, 1.0, 2.0, 0.0, -2.0]
    )
    np.testing.assert_allclose(
        s.Samples(times, values, hold="previous")([-1.0, 0.5, 1.0, 2.9, 3.0]),
        [0.0, 0.0, 2.0, 2.0, -2.0],
    )


def test_noise_has_the_variance_power_over_sample_time_and_is_held() -> None:
    """As Simulink's Band-Limited White Noise: power is the height of the spectrum."""
    noise = s.BandLimitedNoise(power=1e-4, sample_time=0.01, seed=1)
    t = np.arange(1_000_000) * 1e-3
    values = noise(t)
    draws = values[::10]
    assert np.var(draws) == pytest.approx(1e-4 / 0.01, rel=0.02)
    np.testing.assert_array_equal(values, np.repeat(draws, 10))
    assert abs(np.corrcoef(draws[1:], draws[:-1])[0, 1]) < 0.02


@given(
    cuts=st.lists(st.integers(1, 49_999), max_size=6), dt=st.sampled_from([1e-3, 7e-4, 1e-2, 0.033])
)
def test_noise_does_not_depend_on_how_time_is_cut(cuts: list[int], dt: float) -> None:
    """The same bits come out in pieces of any size, in any order."""
    t = np.arange(50_000) * dt
    noise = s.BandLimitedNoise(power=1.0, sample_time=0.01, seed=3)
    edges = sorted({0, *cuts, t.size})
    pieces = [noise(t[a:b]) for a, b in pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate(pieces), noise(t))


def drawn(t: np.ndarray, seed: int) -> np.ndarray:
    """Standard normal draws that are held for 7 ms, one time after the other."""
    held = (t * (1.0 / 0.007) + (1.0 + 1e-6)).astype(np.int64) - 1
    blocks = {b: np.random.default_rng([seed, b]).standard_normal(4096) for b in range(5)}
    return np.array([blocks[k // 4096][k % 4096] if k >= 0 else 0.0 for k in held.tolist()])


def smooth(t: np.ndarray) -> np.ndarray:
    """The acceleration of the move of least jerk, along 3 in 4 s."""
    position = np.polynomial.Polynomial([0.0, 0.0, 1.0, -2.0, 1.0]).integ()
    sigma = np.clip(t / 4.0, 0.0, 1.0)
    value = position.deriv(2)(np.where(sigma > 0.5, 1.0 - sigma, sigma))
    value = np.where(sigma > 0.5, -1.0, 1.0) * (value / (position(0.5) * 2.0) * 3.0 / 4.0**2)
    return np.where((t >= -1e-9) & (t < 4.0 - 1e-9), value, 0.0)


# Signals, and their values by formulas for all times at once.
WAVE, NOISE = s.Sinusoid(2.0, 3.0, 0.4, start=1.5), s.BandLimitedNoise(1e-3, 0.007, seed=4)
FORMULAS = {
    "sinusoid": (
        WAVE,
        lambda t: np.where(t - 1.5 >= -1e-9, 2.0 * np.sin(3.0 * (t - 1.5) + 0.4), 0.0),
    ),
    "noise": (NOISE, lambda t: math.sqrt(1e-3 / 0.007) * drawn(t, 4)),
    "sum": (
        WAVE + s.Ramp(0.3, 0.1, 5.0) - 0.1,
        lambda t: 0.0 + WAVE(t) + 0.3 * (np.clip(t, 0.1, 5.0) - 0.1) + -1.0 * 0.1,
    ),
    "switched": (
        WAVE.until(7.0, then=s.Step(5.0)).until(9.0, then=0.25),
        lambda t: np.where(t < 7.0 - 1e-9, WAVE(t), np.where(t < 9.0 - 1e-9, 5.0, 0.25)),
    ),
    "smooth": (s.SmoothMove(3.0, 4.0, 2).derivative().derivative(), smooth),
}


@pytest.mark.parametrize("kind", FORMULAS)
@pytest.mark.parametrize("size", [1, 7, 512, 10**6])
def test_a_signal_has_the_bits_of_its_formula_in_blocks_of_any_size(kind: str, size: int) -> None:
    """From −1 s on, over edges and blocks of draws, and in any order of times."""
    signal, formula = FORMULAS[kind]
    t = np.arange(-100, 4000) * 1e-2
    expected = formula(t)
    blocks = [signal(t[first : first + size]) for first in range(0, t.size, size)]
    np.testing.assert_array_equal(np.concatenate(blocks), expected)
    mixed = np.random.default_rng(0).permutation(t.size)[:size]
    np.testing.assert_array_equal(signal(t[mixed]), expected[mixed])


NEEDED: dict[str, dict[str, Any]] = {
    "samples": {"times": [0.0, 1.0, 4.0], "values": [1.0, -2.0, 3.0]},
    "repeated": {"cycle": s.Trapezoid(), "period": 3.0},
}


@cases("kind", s.KINDS)
def test_a_signal_of_each_kind_has_the_same_bits_in_blocks_and_alone(kind: str) -> None:
    """A run makes its signals in blocks; whoever plots them asks for all times at once."""
    signal = s.make(kind, **NEEDED.get(kind, {}))
    t = np.arange(-3, 20_000) * 1e-3
    for size in (1000, 8192):
        blocks = [signal(t[first : first + size]) for first in range(0, t.size, size)]
        np.testing.assert_array_equal(np.concatenate(blocks), signal(t))
    some = range(0, t.size, 777)
    np.testing.assert_array_equal([signal(t[k]) for k in some], signal(t)[some])


def test_a_repeated_cycle_starts_again_every_period() -> None:
    """Also where rounding puts a sample just before it; before the start and after the last it goes on."""
    move = s.Trapezoid(2.0, 1.0, start=0.5)
    signal = s.Repeated(move, period=0.7 * 3.0, count=3, start=1.0)
    t = np.arange(1000) * 0.01
    k = np.minimum(np.maximum((np.arange(1000) - 100) // 210, 0), 2)
    np.testing.assert_allclose(
        signal(t), move((np.arange(1000) - 100 - 210 * k) * 0.01), atol=1e-12
    )
    assert signal(0.0) == 0.0
    assert signal(100.0) == 2.0
    np.testing.assert_allclose(
        signal.derivative()(t),
        move.derivative()((np.arange(1000) - 100 - 210 * k) * 0.01),
        atol=1e-9,
    )
    square = s.Repeated(s.Constant(1.0).until(0.5, then=-1.0), period=1.0)
    np.testing.assert_array_equal(
        square([0.0, 0.5, 0.99, 1.0, 1e4, 1e4 + 0.5]), [1, -1, -1, 1, 1, -1]
    )
    noise = s.Repeated(s.BandLimitedNoise(1.0, 0.1), period=1.0)
    np.testing.assert_array_equal(noise(t[:100] + 0.05), noise(t[:100] + 7.05))
    assert np.any(noise.seeded(1)(t) != noise.seeded(2)(t))
    assert s.Repeated(3.0, 1.0)(2.5) == 3.0
    for wrong in ({"period": 0.0}, {"count": 0}, {"count": 1.5}, {"start": np.inf}, {"cycle": "x"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            s.Repeated(**({"cycle": move, "period": 1.0} | wrong))


def test_a_seed_gives_the_same_draws_for_ever() -> None:
    """4096 from each generator, whose seeds are those of the noise and of the block."""
    noise = s.BandLimitedNoise(power=0.5, sample_time=2.0, seed=3)
    for k in (0, 1, 4095, 4096, 12_287):
        draws = np.random.default_rng([3, k // 4096]).standard_normal(4096)
        assert noise(2.0 * k) == pytest.approx(0.5 * draws[k % 4096], rel=1e-15)


@cases("bits", range(2, 15))
def test_a_prbs_of_each_length_has_the_longest_period(bits: int) -> None:
    """Its autocorrelation over a period is 1 at lag zero and ``−1/(2^bits − 1)`` at all others."""
    size = 2**bits - 1
    period = s.PRBS(bits=bits, step=1.0)(np.arange(size) + 0.5)
    lags = np.fft.irfft(np.abs(np.fft.rfft(period)) ** 2, size) / size
    np.testing.assert_allclose(lags, [1.0] + [-1.0 / size] * (size - 1), atol=1e-9)


def test_noise_can_be_asked_for_anywhere() -> None:
    """Far apart, before the start, and nowhere."""
    noise = s.BandLimitedNoise(power=1.0, sample_time=0.01)
    sparse = noise(np.array([-1.0, 0.0, 1e5, 50.0]))
    assert sparse[0] == 0.0
    assert sparse[1] == noise(0.0)
    assert sparse[2] == noise(1e5)
    assert noise(np.zeros(0)).size == 0


def test_two_noises_in_one_sum_are_seeded_apart() -> None:
    """The scenario's seed reaches every noise, and no two share a stream."""
    both = s.BandLimitedNoise(power=1.0) + s.BandLimitedNoise(power=1.0)
    first, second = (term(T) for term in both.seeded(5).terms)
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.2
    np.testing.assert_array_equal(both.seeded(5)(T), both.seeded(5)(T))
    assert np.any(both.seeded(5)(T) != both.seeded(6)(T))


def test_every_kind_is_made_by_its_name() -> None:
    """The names of scenario files give the same signals as the classes."""
    assert s.make("sinusoid", omega=2.0) == s.Sinusoid(omega=2.0)
    for kind, cls in s.KINDS.items():
        assert isinstance(s.make(kind, **NEEDED.get(kind, {})), cls)


@cases(
    ("make", "message"),
    [
        (lambda: s.make("sine"), "signal = 'sine': must be one of constant, step, ramp"),
        (
            lambda: s.make("sinusoid", frequency=1.0),
            "parameter of signal 'sinusoid' = 'frequency': must be one of amplitude",
        ),
        (lambda: s.Step(at=np.nan), "at = nan: must be a finite number"),
        (lambda: s.Sinusoid(omega="fast"), "omega = 'fast': must be a number"),
        (
            lambda: s.Trapezoid(duration=-1.0),
            "duration = -1.0: must be finite and greater than zero",
        ),
        (
            lambda: s.Trapezoid(duration=1.0, ramp_time=0.6),
            r"ramp_time = 0.6: must be in \(0, duration / 2 = 0.5\]",
        ),
        (
            lambda: s.Samples([0.0, 0.0], [1.0, 2.0]),
            "times: must hold at least one sample and increase",
        ),
        (lambda: s.Samples([0.0, 1.0], [1.0]), r"values has shape \(1,\): must be a vector of 2"),
        (lambda: s.Samples([0.0], [np.nan]), r"values: entry \(0,\) is nan"),
        (lambda: s.Switched((1.0,), (s.Step(),)), "there must be one piece more than times"),
        (lambda: s.BandLimitedNoise(power=-1.0), "power = -1.0: must be finite and not negative"),
        (lambda: s.BandLimitedNoise(seed=-1), "seed = -1: must be a whole number of at least 0"),
        (lambda: s.Sinusoid() * np.inf, "factor = inf: must be a finite number"),
        (lambda: s.Signal()(0.0), "must define evaluate"),
        (lambda: s.make("samples"), "signal 'samples': missing 2 required"),
        (lambda: s.Step().until(3.0, then="ramp"), "then = 'ramp': must be a number"),
        (lambda: s.BandLimitedNoise(1e-12, 1e-13)(1000.0), "sample_time = 1e-13: too short"),
        (lambda: Short()(T), r"Short.evaluate returned shape \(1,\) for times of shape \(1201,\)"),
    ],
)
def test_a_mistake_is_named_with_its_value_and_the_rule(make: object, message: str) -> None:
    """Nothing wrong gets as far as a run."""
    with pytest.raises((ValueError, TypeError), match=message):
        make()  # type: ignore[operator]


@cases(
    "signal",
    [
        s.Constant(3.0),
        s.Ramp(slope=2.0, start=1.0, stop=3.0),
        s.Ramp(slope=2.0),
        s.Sinusoid(amplitude=2.0, omega=1.7, phase=0.3),
        s.Trapezoid(distance=-2.0, duration=5.0, start=1.0),
        s.SmoothMove(distance=2.0, duration=6.0, smoothness=3, start=1.0),
        s.SmoothMove(distance=2.0, duration=6.0, smoothness=4).derivative(),
        s.Samples([0.0, 2.0, 3.0], [1.0, -1.0, 4.0]),
        2.0 * s.Sinusoid(omega=0.8).until(4.0, then=s.Ramp(slope=0.3)) - s.Trapezoid(start=6.0),
    ],
    ids=lambda signal: type(signal).__name__,
)
def test_a_derivative_is_the_slope_of_the_signal(signal: s.Signal) -> None:
    """Its integral gives the signal back, but for jumps, which are no part of it."""
    t = np.linspace(-1.0, 12.0, 260_001)
    smooth = signal(t)
    slope = np.diff(smooth) / np.diff(t)
    known = signal.derivative()(t[:-1] + 0.5 * (t[1] - t[0]))
    jumps = np.abs(np.diff(smooth)) > 0.1
    kinks = np.abs(slope - known) > 2e-3 * (1.0 + np.abs(known))
    assert np.sum(jumps) <= 1
    assert np.sum(kinks & ~jumps) <= 8, "more than the corners differ"


def test_a_smooth_move_has_the_derivatives_it_promises() -> None:
    """The first m are continuous and zero at both ends; for m = 2 it is 10σ³ − 15σ⁴ + 6σ⁵."""
    sigma = np.linspace(0.0, 1.0, 101)
    np.testing.assert_allclose(
        s.SmoothMove(1.0, 1.0, smoothness=2)(sigma),
        10 * sigma**3 - 15 * sigma**4 + 6 * sigma**5,
        atol=1e-14,
    )
    move = s.SmoothMove(distance=-3.0, duration=2.0, smoothness=4, start=1.0)
    assert move([0.0, 1.0, 2.0, 3.0, 9.0]).tolist() == pytest.approx([0.0, 0.0, -1.5, -3.0, -3.0])
    for _ in range(4):
        move = move.derivative()
        near = move([1.0 - 1e-9, 1.0 + 1e-9, 3.0 - 1e-9, 3.0 + 1e-9])
        np.testing.assert_allclose(near, 0.0, atol=1e-4)


def test_a_signal_without_a_known_derivative_says_so() -> None:
    """And what to do."""
    with pytest.raises(ValueError, match="Chirp has none: take another signal"):
        s.Chirp().derivative()


@cases(
    ("distance", "v_max", "a_max", "j_max"),
    [
        (1.6, 20.0, 500.0, 2e4),  # all seven parts
        (1.0, 20.0, 500.0, 2e4),  # without cruise
        (0.01, 20.0, 500.0, 2e4),  # jerk alone
        (-3.0, 2.0, 5.0, 9.0),  # the largest acceleration is not reached
        (0.0, 1.0, 1.0, 1.0),
    ],
)
def test_a_limited_move_reaches_its_limits_and_no_more(
    distance: float, v_max: float, a_max: float, j_max: float
) -> None:
    """Where the distance leaves room; it ends at rest at the distance, and the derivatives are exact."""
    move: Any = s.LimitedMove(distance, v_max, a_max, j_max, start=0.5)
    t = np.linspace(0.5, 0.5 + move.duration, 100_001)
    assert move(0.4) == 0.0
    assert move(t[-1]) == distance == move(9.0)
    reached, signal = [], move
    for i, limit in enumerate((math.inf, v_max, a_max, j_max)):
        reached.append(float(np.max(np.abs(signal(t)))) / limit)
        assert np.max(np.abs(signal(t))) <= limit * (1.0 + 1e-9)
        following = signal.derivative()
        if distance and i < 2:  # the jerk jumps
            slope = np.diff(signal(t)) / np.diff(t)
            known = following(0.5 * (t[1:] + t[:-1]))
            np.testing.assert_allclose(slope, known, atol=1e-4 * np.max(np.abs(known)))
        signal = following
    assert np.all(signal(t) == 0.0)
    if distance:
        assert reached[3] == pytest.approx(1.0)
        jerk, acceleration, cruise = phases(abs(distance), v_max, a_max, j_max)
        assert move.duration == pytest.approx(4.0 * jerk + 2.0 * acceleration + cruise, rel=1e-12)
        assert cruise == 0.0 or reached[1] == pytest.approx(1.0)
        assert acceleration == 0.0 or reached[2] == pytest.approx(1.0)


def phases(distance: float, v_max: float, a_max: float, j_max: float) -> tuple[float, float, float]:
    """Durations of jerk, constant acceleration and constant speed, in closed form.

    Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots, 2008, sect. 3.4.
    """
    reaches = v_max * j_max >= a_max**2
    jerk = a_max / j_max if reaches else math.sqrt(v_max / j_max)
    acceleration = v_max / a_max - jerk if reaches else 0.0
    cruise = distance / v_max - (2.0 * jerk + acceleration)
    if cruise >= 0.0:
        return jerk, acceleration, cruise
    ramp = a_max / j_max
    speed = 0.5 * a_max * (math.sqrt(ramp**2 + 4.0 * distance / a_max) - ramp)
    if speed >= a_max * ramp:
        return ramp, max(speed / a_max - ramp, 0.0), 0.0
    return (0.5 * distance / j_max) ** (1.0 / 3.0), 0.0, 0.0


def test_samples_along_a_spline_have_four_continuous_derivatives() -> None:
    """Those of the move that they are from, zero before and after; a spline needs no others."""
    move: Any = s.SmoothMove(2.0, 1.0, smoothness=4, start=0.5)
    times = np.linspace(0.5, 1.5, 101)
    spline: Any = s.Samples(times, move(times), hold="spline")
    t = np.linspace(0.0, 2.0, 1237)
    for tolerance in (1e-9, 1e-7, 1e-5, 1e-3, 0.05):
        np.testing.assert_allclose(
            spline(t), move(t), atol=tolerance * max(float(np.max(np.abs(move(t)))), 1.0)
        )
        spline, move = spline.derivative(), move.derivative()
    for _ in range(3):
        spline = spline.derivative()
    assert spline(t).tolist() == np.zeros(t.size).tolist()
    with pytest.raises(ValueError, match="derivatives: are those of the spline"):
        s.Samples(times, times, hold="spline", derivatives=[times])


def test_samples_have_the_derivatives_that_are_given() -> None:
    """And zero where the samples are held."""
    times = np.linspace(1.0, 2.0, 11)
    samples = s.Samples(times, times**2, derivatives=[2.0 * times, np.full(11, 2.0)])
    first = samples.derivative()
    assert first([0.5, 1.0, 1.55, 2.5]).tolist() == pytest.approx([0.0, 2.0, 3.1, 0.0])
    assert first.derivative()([0.5, 1.2, 2.5]).tolist() == [0.0, 2.0, 0.0]
    with pytest.raises(ValueError, match=r"derivatives\[0\]"):
        s.Samples(times, times, derivatives=[[1.0]])


def test_a_controller_with_feedforward_is_warned_of_samples_without_derivatives() -> None:
    """Once, by simulate; without feedforward there is nothing to warn of."""
    import quell as ql

    times = np.linspace(0.0, 1.0, 11)
    scenario = ql.Scenario(reference=s.Samples(times, times**2), duration=0.1)
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
    observer = ql.ESO.model_free(2, 1.0, 20.0, 0.01)
    with pytest.warns(UserWarning, match="feedforward gets zero"):
        ql.simulate(plant, ql.ADRC(observer, 5.0, feedforward=True), scenario, interpret=True)
    ql.simulate(plant, ql.ADRC(observer, 5.0), scenario, interpret=True)
