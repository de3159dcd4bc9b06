"""Metrics against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quell.records import metrics

from .cases import cases

T = np.linspace(0.0, 40.0, 400_001)
FIRST = 1.0 - np.exp(-T)


def test_overshoot_of_a_second_order_step_is_exp_minus_pi_zeta_over_root() -> None:
    """The textbook formula, for ζ = 0.5, whatever the size and sign of the step."""
    zeta = 0.5
    damped = math.sqrt(1.0 - zeta**2)
    y = 1.0 - np.exp(-zeta * T) * (np.cos(damped * T) + zeta / damped * np.sin(damped * T))
    expected = math.exp(-math.pi * zeta / damped)
    assert metrics.overshoot(y, 1.0) == pytest.approx(expected, rel=1e-6)
    assert metrics.overshoot(2.0 - 3.0 * y, -1.0, initial=2.0) == pytest.approx(expected, rel=1e-6)


def test_overshoot_is_zero_where_the_target_is_not_passed() -> None:
    """Never negative."""
    assert metrics.overshoot(FIRST, 1.0) == 0.0


@pytest.mark.parametrize(
    "y",
    [
        1.0 - np.exp(-0.05 * T),  # still on its way
        -13.0 * T,  # away from the target, as with a b0 of the wrong sign
        13.0 * T,  # beyond it
        1.0 - np.exp(0.1 * T) * np.cos(3.0 * T),  # grows
        1.0 + 0.3 * np.sin(3.0 * T),  # a limit cycle, whatever it is at the last sample
        1.0 + 0.3 * np.sin(3.0 * (T - T[-1])),
    ],
)
def test_what_does_not_rest_at_the_target_has_neither_overshoot_nor_settling_time(
    y: np.ndarray,
) -> None:
    """0 would be the best there is; the last sample may be at the target by chance."""
    assert math.isnan(metrics.overshoot(y, 1.0))
    assert math.isnan(metrics.settling_time(T, y, 1.0))


def test_overshoot_is_known_in_noise_and_in_a_wide_band() -> None:
    """White noise of 3 % of the step; with a band of 20 % an error of 10 % is rest."""
    noise = 0.03 * np.random.default_rng(2).normal(size=T.size)
    assert metrics.overshoot(FIRST + noise, 1.0) == pytest.approx(0.13, abs=0.03)
    assert math.isnan(metrics.overshoot(0.9 * FIRST, 1.0))
    assert metrics.overshoot(0.9 * FIRST, 1.0, band=0.2) == 0.0


def test_a_step_that_runs_away_beyond_its_target_has_no_rise_time() -> None:
    """It would be a short one; a lasting error of 8 % leaves it as it is."""
    assert math.isnan(metrics.rise_time(T, 13.0 * T, 1.0))
    y = 0.92 * FIRST
    assert metrics.rise_time(T, y, 1.0) == pytest.approx(math.log(0.82 / 0.02), abs=0.01)


CLOCK = np.arange(1000) / 100.0
STEP_AT_1 = (CLOCK >= 1.0) * 1.0
LIMITED = -10.0 * (CLOCK >= 1.0)
SMOOTH = 1.0 - np.exp(-np.maximum(CLOCK - 1.0, 0.0))


@pytest.mark.parametrize(
    ("r", "y", "u"),
    [
        (STEP_AT_1, -5.0 * np.maximum(CLOCK - 1.0, 0.0), LIMITED),  # a limited motor, wrong sign
        (STEP_AT_1, -30.0 * SMOOTH, LIMITED),  # a limited plant that rests there
        (STEP_AT_1, STEP_AT_1 * 0.1 * np.exp(CLOCK) * np.cos(5.0 * CLOCK), None),
        (STEP_AT_1, STEP_AT_1 * (1.0 + 1e-9 * np.exp(4.0 * CLOCK)), None),  # it begins late
        (0.0 * CLOCK, 1e-9 * np.exp(2.0 * CLOCK) * np.sin(9.0 * CLOCK), None),  # no task
        (0.0 * CLOCK, -0.1 * np.maximum(CLOCK - 3.0, 0.0), LIMITED),  # a load above the limit
        (0.0 * CLOCK, np.exp(0.5 * CLOCK), None),  # from an initial state
    ],
)
def test_y_that_leaves_r_for_good_runs_away(
    r: np.ndarray, y: np.ndarray, u: np.ndarray | None
) -> None:
    """Whatever direction it takes, at limits of u and without."""
    given = np.zeros((1, CLOCK.size, 0)) if u is None else u[None, :, None]
    assert metrics.runs_away(r[None], y[None], given).tolist() == [True]
    both = np.stack([y, r]), np.concatenate([given, given])
    assert metrics.runs_away(np.stack([r, r]), *both).tolist() == [True, False]


@pytest.mark.parametrize(
    ("r", "y", "u"),
    [
        (STEP_AT_1, SMOOTH, 10.0 * STEP_AT_1),  # u at its limit until the end, but on its way
        (10.0 * CLOCK, 9.0 * CLOCK, None),  # r is quicker than the limit of u
        (STEP_AT_1, SMOOTH * (1.0 + 0.3 * np.sin(CLOCK)), None),  # a limit cycle
        (0.0 * CLOCK, np.sin(0.15 * CLOCK), None),  # a slow load that only rises
        (0.0 * CLOCK, CLOCK**2, None),  # it grows, but no loop does so by itself
        (1e-3 * STEP_AT_1, np.sin(3.0 * CLOCK), None),  # a load that is large beside the step
        (0.0 * CLOCK, np.maximum(CLOCK - 6.0, 0.0), None),  # a load that came late
        (0.0 * CLOCK, np.maximum(CLOCK - 5.1, 0.0) ** 2, None),
        (0.0 * CLOCK, 0.0 * CLOCK, 0.0 * CLOCK),
        (STEP_AT_1, 3.0 * np.exp(-CLOCK) * np.sin(9.0 * CLOCK) + STEP_AT_1, None),
    ],
)
def test_y_that_is_late_or_disturbed_does_not_run_away(
    r: np.ndarray, y: np.ndarray, u: np.ndarray | None
) -> None:
    """A line that is always there is not read."""
    given = np.zeros((1, CLOCK.size, 0)) if u is None else u[None, :, None]
    assert metrics.runs_away(r[None], y[None], given).tolist() == [False]
    assert metrics.runs_away(r[None, :9], y[None, :9], given[:, :9]).tolist() == [False]


def test_settling_time_of_a_first_order_step_is_minus_log_of_the_band() -> None:
    """``exp(−t) = band`` at ``t = −ln band``."""
    for band in (0.02, 0.002):
        assert metrics.settling_time(T, FIRST, 1.0, band) == pytest.approx(
            -math.log(band), abs=2e-4
        )


def test_settling_time_counts_from_the_first_sample_and_may_be_zero_or_nan() -> None:
    """The window sets the origin; never leaving gives 0, not arriving NaN."""
    late = slice(10_000, None)
    assert metrics.settling_time(T[late], FIRST[late], 1.0, 0.02) == pytest.approx(
        -math.log(0.02) - 1.0, abs=2e-4
    )
    assert metrics.settling_time(T, np.ones_like(T), 1.0) == 0.0
    assert math.isnan(metrics.settling_time(T[:100], FIRST[:100], 1.0))


def test_settling_counts_the_sample_after_the_last_one_outside() -> None:
    """Not that one, nor the next; a tie with the edge of the band is inside."""
    t = np.array([5.0, 5.1, 5.2, 5.3, 5.4])
    y = np.array([0.0, 1.75, 0.5, 1.25, 1.0])  # a band of a quarter: all are exact in binary
    assert metrics.settling_time(t, y, 1.0, band=0.25) == t[3] - t[0]
    assert metrics.settling_time(t, y, 1.0, band=0.2499) == t[4] - t[0]
    assert metrics.settling_time(t, y, 1.0, band=0.5) == t[2] - t[0]
    assert metrics.settling_time(t, 2.0 - y, 1.0, band=0.5, initial=2.0) == t[2] - t[0]
    assert metrics.settling_time(t, y, 1.0, band=1.0) == 0.0
    assert math.isnan(metrics.settling_time(t[:2], y[:2], 1.0, band=0.25))
    assert math.isnan(metrics.settling_time(t[:1], y[:1], 1.0))


def test_the_default_band_is_two_per_cent() -> None:
    """Of the step, whatever its size."""
    t, y = np.arange(3.0), np.array([1.0, 5.0 - 4.0 * 0.021, 5.0 - 4.0 * 0.019])
    assert metrics.SETTLING_BAND == 0.02
    assert metrics.settling_time(t, y, 5.0, initial=1.0) == 2.0
    assert metrics.settling_time(t, y, 5.0) == 1.0  # of a step of 5


def test_a_record_that_starts_beyond_its_target_overshoots_at_once() -> None:
    """Measured from ``initial``; a step down is the mirror image of one up."""
    t, y = np.arange(4.0), np.array([1.5, 1.2, 1.0, 1.0])
    assert metrics.overshoot(y, 1.0) == 0.5
    assert metrics.rise_time(t, y, 1.0) == 0.0
    assert metrics.settling_time(t, y, 1.0) == 2.0
    assert metrics.overshoot(y, 1.0, initial=1.5) == 0.0  # a step down that is not passed
    assert metrics.overshoot(y - [0, 0, 0.25, 0], 1.0, initial=1.5) == 0.5
    assert metrics.rise_time(t, y, 1.0, initial=1.5) == pytest.approx(1.75 - 1 / 6)


def test_rise_time_takes_the_first_crossings_and_ties_are_crossings() -> None:
    """A fall back below 90 % does not count; a sample at exactly 10 or 90 % is a crossing."""
    t = np.arange(6.0)
    assert metrics.rise_time(t, np.array([0.0, 0.1, 0.9, 0.5, 0.95, 1.0]), 1.0) == 1.0
    assert metrics.rise_time(t, np.array([0.0, 0.2, 0.2, 0.05, 0.8, 1.0]), 1.0) == 4.0
    assert metrics.rise_time(t + 7.0, np.array([0.0, 0.2, 0.2, 0.05, 0.8, 1.0]), 1.0) == 4.0
    assert math.isnan(metrics.rise_time(t, np.full(6, 0.5), 1.0))
    assert metrics.rise_time(t[:3] + 7.0, np.array([0.5, 0.7, 1.1]), 1.0) == pytest.approx(1.5)


def test_integrals_of_few_samples_are_trapezoids() -> None:
    """By hand; times count from the first sample, and a record of one sample has no area."""
    t, e = np.array([2.0, 3.0, 5.0]), np.array([1.0, -3.0, 2.0])
    assert metrics.iae(t, e) == 2.0 + 5.0
    assert metrics.ise(t, e) == 5.0 + 13.0
    assert metrics.itae(t, e) == 1.5 + 9.0
    assert metrics.iae(t[:1], e[:1]) == 0.0
    assert (metrics.peak(e), metrics.rms(e)) == (3.0, pytest.approx(math.sqrt(14.0 / 3.0)))


def test_total_variation_has_the_first_jump_and_control_variation_has_not() -> None:
    """From the u before the record, zero if the loop starts from rest."""
    u = np.array([3.0, 5.0, -1.0])
    assert metrics.control_variation(u) == 8.0
    assert metrics.total_variation(u) == 11.0
    assert metrics.total_variation(u, before=4.0) == 9.0
    assert (metrics.control_variation(u[:1]), metrics.total_variation(u[:1])) == (0.0, 3.0)


def test_rise_time_of_a_first_order_step_is_log_nine() -> None:
    """From 10 % to 90 %."""
    assert metrics.rise_time(T, FIRST, 1.0) == pytest.approx(math.log(9.0), abs=1e-6)
    assert math.isnan(metrics.rise_time(T[:100], FIRST[:100], 1.0))


def test_integrals_of_an_exponential_error_are_one_a_half_and_one() -> None:
    """``∫e⁻ᵗ = 1``, ``∫e⁻²ᵗ = ½``, ``∫t e⁻ᵗ = 1``."""
    error = np.exp(-T)
    assert metrics.iae(T, -error) == pytest.approx(1.0, rel=1e-6)
    assert metrics.ise(T, error) == pytest.approx(0.5, rel=1e-6)
    assert metrics.itae(T + 7.0, error) == pytest.approx(1.0, rel=1e-6)


def test_peak_and_rms_of_a_sinusoid_are_its_amplitude_and_that_over_root_two() -> None:
    """Over whole periods."""
    wave = 3.0 * np.sin(2.0 * np.pi * T[:-1])
    assert metrics.peak(-wave) == pytest.approx(3.0)
    assert metrics.rms(wave) == pytest.approx(3.0 / math.sqrt(2.0))


def test_variation_of_a_sinusoid_is_four_amplitudes_a_period() -> None:
    """Up, down twice as far, up again."""
    assert metrics.control_variation(np.sin(2.0 * np.pi * T)) == pytest.approx(4.0 * 40.0, rel=1e-6)


@cases(
    ("measure", "message"),
    [
        (
            lambda: metrics.settling_time(T[:3], np.array([0.0, 1.0, np.nan]), 1.0),
            "a value that is not finite at sample 2",
        ),
        (lambda: metrics.rms(np.zeros(0)), "must be a vector of at least one sample"),
        (lambda: metrics.rms(np.zeros((2, 3))), r"record has shape \(2, 3\): must be a vector"),
        (lambda: metrics.rms(np.float64(1.0)), r"record has shape \(\): must be a vector"),
        *(
            (lambda measure=measure: measure(T, T[1:]), "t has 400001 samples, the record 400000")
            for measure in (metrics.iae, metrics.ise, metrics.itae)
        ),
        (lambda: metrics.overshoot(T, 1.0, initial=1.0), "there is no move to overshoot"),
        (
            lambda: metrics.settling_time(T, T, 1.0, band=0.0),
            "band = 0.0: must be finite and greater than zero",
        ),
    ],
)
def test_a_mistake_is_named(measure: object, message: str) -> None:
    """With the argument and the rule."""
    with pytest.raises(ValueError, match=message):
        measure()  # type: ignore[operator]


def test_a_verdict_names_all_that_is_worse_by_more_than_a_tenth() -> None:
    """Lower and higher is better; what does not exist any more is worse; what is new is not judged."""
    before = {
        **{"rms": 1.0, "control_variation": 4.0, "noise_to_control": 6.0, "overshoot": 0.001},
        **{"delay_margin": 0.042, "m_s": 1.4, "settling_time": 2.0, "gain_margin": math.inf},
        **{"peak_error": None, "largest_pole": 0.9},
    }
    now = {
        **{"rms": 0.2, "control_variation": 746.0, "noise_to_control": 633.0, "overshoot": 0.009},
        **{"delay_margin": 0.0055, "m_s": 1.53, "settling_time": math.nan, "gain_margin": 9.0},
        **{"peak_error": 5.0, "largest_pole": 0.99},
    }
    found = {each.name: each for each in metrics.worsened(before, now)}
    names = {
        "control_variation",
        "noise_to_control",
        "delay_margin",
        "settling_time",
        "gain_margin",
    }
    assert found.keys() == names
    assert found["control_variation"].text == "activity of u, Σ|Δu| 4 → 746"
    assert found["settling_time"].text == "settling time [s] 2 → none any more"
    assert metrics.worsened(now, now) == ()
    assert metrics.worsened({"overshoot": 0.1}, {"overshoot": 0.12})[0].name == "overshoot"
