"""Times of records: even ones, faults that are repaired or refused, units; where a signal stands at its limit."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from quell.identification.record_times import on_even_grid, warn_of_another_unit
from quell.identification.saturation import Standing, standing

from .cases import cases

K = np.arange(101.0)
INSTEAD = "if the samples are evenly spaced although their times are not, give "
WHERE = "; u keeps its value until the next sample, y is interpolated linearly; " + INSTEAD


def even(t: Any) -> tuple[float, np.ndarray | None, str]:
    """Return dt, the samples of k, k², −k if they are not those given, and the warning or the error."""
    t = np.asarray(t, dtype=float)
    k = np.arange(float(t.size))
    given = np.column_stack([k, k**2, -k])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            dt, values = on_even_grid("f.csv", t, k + 2.0, given)
        except ValueError as error:
            return 0.0, None, str(error)
    assert len(said) <= 1
    return dt, None if values is given else values, "".join(str(each.message) for each in said)


def rising(values: Any) -> np.ndarray:
    """Return times with these steps, from 0."""
    return np.append(0.0, np.cumsum(values))


# ---- even times


def test_even_and_rounded_times_are_read_without_a_word() -> None:
    """Their mean rate in as few digits as it is known; also rounded to half a sample, and jitter."""
    assert even(0.1 * K) == (0.1, None, "")
    assert even(5.0 + 0.1 * K) == (0.1, None, "")
    assert even(np.round(0.4 * K)) == (0.4, None, SEEN_COARSE.format("1", "0.4"))
    assert even(np.round(0.8 * K)) == (0.8, None, "")
    jitter = 0.3 * np.cos(2.0 * np.arange(101.0) ** 2)
    dt, values, said = even(0.1 * (K + jitter))
    slope = np.polyfit(K, 0.1 * (K + jitter), 1)[0]
    assert (values, said) == (None, "")
    assert dt == pytest.approx(slope, rel=2e-3)
    assert dt == float(f"{dt:.4g}")


SEEN_COARSE = (
    "f.csv: the times have a resolution of {} s only, and are read as evenly spaced, {} s apart by "
    "the mean; a sample that is missing would not be seen. Give dt (--dt) if you know it better."
)


def test_several_samples_at_one_time_are_spaced_between_the_changes() -> None:
    """From half as many more samples than changes on; three changes are needed."""
    assert even(np.arange(40) // 4) == (0.25, None, SEEN_COARSE.format("1", "0.25"))
    assert even(0.5 * (np.arange(40) // 4)) == (0.125, None, SEEN_COARSE.format("0.5", "0.125"))
    pairs = np.repeat(np.arange(20), [2, 1] * 10)
    assert even(pairs) == (0.666, None, SEEN_COARSE.format("1", "0.666"))
    assert "resolution" not in even(np.repeat(np.arange(20), [2, 1, 1, 1] * 5))[2]
    assert even(np.arange(16) // 4) == (0.25, None, SEEN_COARSE.format("1", "0.25"))
    assert "resolution" not in even(np.arange(12) // 4)[2]
    # The first of each group is known to a sample.
    late = np.repeat([0, 1, 2, 3, 4], [4, 4, 7, 1, 4])
    assert "resolution" not in even(late)[2]


def test_a_clock_whose_rate_drifts_is_read_by_its_mean_up_to_half_a_percent() -> None:
    """0.2 % is said; 0.6 % is resampled, with as many samples as the time has."""
    assert even(rising(np.repeat([1.0, 1.004], 1000))) == (
        1.002,
        None,
        "f.csv: the steps of t drift by 0.2 %; samples are read as evenly spaced by the mean, "
        "1.002 s. Give dt (--dt) if you know it better.",
    )
    t = rising(np.repeat([1.0, 1.012], 1000))
    dt, values, said = even(t)
    assert dt == 1.01
    assert values is not None
    assert values.shape == (int(t[-1] / 1.01) + 1, 3)
    np.testing.assert_allclose(
        values[:, 1], np.interp(1.01 * np.arange(1993), t, np.arange(2001.0) ** 2)
    )
    assert said == (
        "f.csv, line 1034: t rises by 1.012 s where samples are 1.006 s apart (uneven steps): "
        f"resampled 1.01 s apart{WHERE}dt = 1.006 (--dt 1.006) in place of the times"
    )
    assert "drift" not in even(rising(np.repeat([1.0, 1.004], 99)))[2]


@cases(
    ("t", "message"),
    [
        ([-1e308, 0.0, 1e308], f"f.csv: t is beyond all numbers; {INSTEAD}dt (--dt) in place of the times"),
        (
            [0.0, 1.0, 2.0, 1.5, 3.0],
            "f.csv, line 5: t falls from 2 to 1.5: must rise evenly; cut the record there, where "
            f"another one may begin, or {INSTEAD}dt (--dt) in place of the times",
        ),
        (
            [0.0, 1.0, 0.5, 2.0, 1.5, 3.0],
            "f.csv, line 4: t falls from 1 to 0.5, and at 1 more lines: must rise evenly; cut the "
            f"record there, where another one may begin, or {INSTEAD}dt (--dt) in place of the times",
        ),
        (
            [3.0, 3.0, 3.0],
            "f.csv: t does not rise, it is 3 in all lines; say which column has the times "
            "(--columns), or give the sample time in their place (--dt)",
        ),
    ],
)  # fmt: skip
def test_times_that_do_not_rise_are_refused_with_line_and_remedy(t: Any, message: str) -> None:
    """Once, several times, and not at all."""
    assert even(t) == (0.0, None, message)


# ---- missing and repeated samples


def test_missing_samples_hold_u_and_interpolate_y() -> None:
    """Two in a row and one; all is told with the first line, and the mean for those who know better."""
    dt, values, said = even(0.1 * np.delete(K, [40, 41, 70]))
    assert dt == 0.1
    assert values is not None
    index = np.delete(K, [40, 41, 70])
    own = np.arange(98.0)
    held = own[np.searchsorted(index, K, side="right") - 1]
    np.testing.assert_array_equal(values[:, 0], held)
    np.testing.assert_array_equal(values[:, 2], -held)
    np.testing.assert_allclose(values[:, 1], np.interp(K, index, own**2), rtol=1e-12)
    assert said == (
        "f.csv, line 42: t rises by 0.3 s where samples are 0.1 s apart, one of 2 odd steps (3 "
        f"missing of 101 samples): resampled 0.1 s apart{WHERE}dt = 0.1043 (--dt 0.1043) in place "
        "of the times"
    )


def test_of_samples_at_one_time_the_last_one_counts() -> None:
    """One is repeated; or one is repeated and another one missing."""
    dt, values, said = even(0.1 * np.insert(K, 50, 50.0))
    assert dt == 0.1
    assert values is not None
    np.testing.assert_array_equal(values[:, 0], np.delete(np.arange(102.0), 50))
    assert said == (
        "f.csv, line 53: t rises by 0 s where samples are 0.1 s apart (1 repeated of 101 samples): "
        f"resampled 0.1 s apart{WHERE}dt = 0.0985 (--dt 0.0985) in place of the times"
    )
    assert even(0.1 * np.delete(np.insert(K, 50, 50.0), 20))[2] == (
        "f.csv, line 22: t rises by 0.2 s where samples are 0.1 s apart, one of 2 odd steps (1 "
        f"missing and 1 repeated of 101 samples): resampled 0.1 s apart{WHERE}dt = 0.0995 (--dt "
        "0.0995) in place of the times"
    )


def test_one_late_time_is_no_missing_sample() -> None:
    """As many samples as the time permits are there: none is put in, none left out."""
    late = 0.1 * K
    late[30] += 0.08
    assert even(late) == (
        0.1,
        None,
        "f.csv, line 32: t rises by 0.18 s where samples are 0.1 s apart, one of 2 odd steps; the "
        "samples are read as evenly spaced by the mean, as many of them as the time permits are "
        "there; if some are missing, interpolate the record on even times",
    )
    late[30] -= 0.03
    assert even(late) == (0.1, None, "")


def test_at_most_five_samples_in_a_row_may_be_missing() -> None:
    """Six are refused, with the sample time that remains."""
    dt, values, said = even(0.1 * np.delete(K, range(40, 45)))
    assert dt == 0.1
    assert values is not None
    assert values[38:47, 0].tolist() == [38, 39, 39, 39, 39, 39, 39, 40, 41]
    assert said.startswith(
        "f.csv, line 42: t rises by 0.6 s where samples are 0.1 s apart (5 missing of 101 samples)"
    )
    assert even(0.1 * np.delete(K, range(40, 46)))[2] == (
        "f.csv, line 42: t rises by 0.7 s where samples are 0.1 s apart: a gap of 6 samples; must "
        "be evenly sampled, with at most 5 missing in a row; cut the record there and read the "
        f"longer part, or, {INSTEAD}dt = 0.1 (--dt 0.1) in place of the times"
    )


def test_one_step_in_twenty_may_be_odd_and_two_in_a_short_record() -> None:
    """Of 97 samples four, of 95 five are too many; of 21 two."""
    assert even(np.delete(K, [10, 20, 30, 40]))[2].startswith(
        "f.csv, line 12: t rises by 2 s where samples are 1 s apart, one of 4 odd steps (4 missing "
        "of 101 samples): resampled 1 s apart;"
    )
    assert even(np.delete(K, [10, 20, 30, 31, 40, 50]))[2] == (
        "f.csv, line 30: t rises by 3 s where samples are 1 s apart, and 5 of 94 steps are odd: "
        "must be evenly sampled; interpolate the record on even times, or, "
        f"{INSTEAD}dt (--dt) in place of the times"
    )
    assert "resampled" in even(np.delete(K[:23], [5, 10]))[2]
    assert "3 of 19 steps are odd" in even(np.delete(K[:23], [5, 10, 15]))[2]


def test_times_that_stand_still_in_places_and_jump_are_cut_off_or_none() -> None:
    """More than one in twenty: with how many, and the first line."""
    t = np.sort(np.concatenate([K[:60], 5.0 * np.arange(6.0), [80.0]]))
    assert even(t)[2] == (
        "f.csv: t does not rise, or hardly, at 6 of 67 lines, the first is line 3, and rises "
        "unevenly at others: are its digits cut off, or is it another column (--columns)? Or "
        f"{INSTEAD}dt (--dt) in place of the times"
    )


def test_uneven_steps_are_believed_and_resampled() -> None:
    """A random walk of steps has no grid: the new one has three digits, y is between its neighbours."""
    steps = 1.0 + 0.4 * np.cos(3.0 * np.arange(100.0) ** 2)
    t = rising(steps)
    dt, values, said = even(t)
    assert dt == float(f"{dt:.3g}")
    assert values is not None
    grid = dt * np.arange(values.shape[0])
    assert t[-1] - dt < grid[-1] <= t[-1] + 1e-8
    np.testing.assert_allclose(values[:, 1], np.interp(grid, t, np.arange(101.0) ** 2))
    nearest = np.searchsorted(t / dt, np.arange(values.shape[0]) + 0.5, side="right") - 1
    np.testing.assert_array_equal(values[:, 0], nearest)
    assert "(uneven steps): resampled" in said


# ---- units of times


@cases(
    ("t", "named", "message"),
    [
        (0.1 * K, False, ""),
        (K, True, ""),
        (
            2.0 * K,
            False,
            "f.csv: the times are whole numbers, 2 apart, and are read as seconds: if they are "
            "milliseconds, give time_unit = 'ms' (--time-unit ms), or us, ns, min, h, and 's' if "
            "they are seconds; if they count samples, give the sample time dt in place of the "
            "column (--dt)",
        ),
        (1.7e9 + K, False, ""),
        (1.7e9 + 3600.0 * K, False, ""),
        (1.7e9 + 3601.0 * K, False, "f.csv: the times are whole numbers, 3601 apart, and are"),
        (0.9e9 + K, False, "f.csv: the times are whole numbers, 1 apart, and are read as seconds"),
        (
            1.7e12 + 2.5 * K,
            True,
            "f.csv: the times begin at 1.7e+12, which as seconds since 1970 is after the year 2286: "
            "they are plausible in ms: give time_unit = 'ms' (--time-unit ms), 's' if seconds",
        ),
        (1.7e15 + 2500.0 * K, True, "they are plausible in us: give time_unit = 'us' (--time-unit"),
        (1.7e18 + 2.5e6 * K, True, "they are plausible in ns: give time_unit = 'ns' (--time-unit"),
        (1e10 + 0.5 * K, True, ""),
        (1.1e10 + 0.5 * K, True, "2286: if they are milliseconds, give time_unit = 'ms'"),
        (
            5e-7 * K,
            True,
            "f.csv: the times rise by 5e-07 and are read as seconds, more than a million samples "
            "per second: if they are in another unit, give time_unit (--time-unit), 's' if they "
            "are seconds",
        ),
        (2e-6 * K, True, ""),
        (
            45_000.0 + 5.0 / 86400.0 * K,
            True,
            "f.csv: the times begin at 45000 and rise by 5.787e-05, and are read as seconds: if "
            "they are days, as spreadsheets count, give time_unit = 'd' (--time-unit d), 's' if "
            "seconds",
        ),
        (739_000.0 + 5.0 / 86400.0 * K, True, "f.csv: the times begin at 739000 and rise by 5.787"),
        (45_000.0 + 6e-05 * K, True, ""),
        (61_000.0 + 5.0 / 86400.0 * K, True, ""),
        (np.zeros(5), False, ""),
        (np.array([5.0, 6.0, 4.0]), False, ""),
    ],
)
def test_times_that_are_hardly_seconds_are_told_with_the_unit_that_they_may_have(
    t: Any, named: bool, message: str
) -> None:
    """Counts, milliseconds to nanoseconds since 1970, and days; seconds since 1970 are left alone."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_another_unit("f.csv", t, named)
    assert len(said) == bool(message)
    assert message in "".join(str(each.message) for each in said)


# ---- limits


def clipped(top: float, count: int = 200) -> np.ndarray:
    """Return a sine of 1 that is cut at ``top``."""
    return np.minimum(np.sin(0.1 * np.arange(count) + 0.05), top)


def test_a_sine_that_is_cut_stands_at_its_limit_in_the_samples_there() -> None:
    """Above, below, in both; a whole sine stands nowhere, though it has crests."""
    above = clipped(0.8)
    found = standing(above, 0.0)
    np.testing.assert_array_equal(found.upper, above == 0.8)
    assert not found.lower.any()
    below = standing(-above, 0.0)
    np.testing.assert_array_equal(below.lower, above == 0.8)
    assert not below.upper.any()
    both = np.maximum(above, -0.7)
    found = standing(both, 0.0)
    np.testing.assert_array_equal(found.upper, both == 0.8)
    np.testing.assert_array_equal(found.lower, both == -0.7)
    assert found.samples == int(np.sum(both == 0.8) + np.sum(both == -0.7))
    whole = standing(clipped(2.0), 0.0)
    assert whole.samples == 0
    assert not whole.is_usable
    step = 0.01
    rounded = np.round(above / step) * step
    np.testing.assert_array_equal(standing(rounded, step).upper, above >= 0.8 - 0.5 * step)


def test_ten_samples_at_a_limit_are_needed_beside_those_at_rest_at_either_end() -> None:
    """A record that begins or ends at the largest value rests there."""
    motion = np.sin(0.37 * np.arange(150)) * 0.9
    top = motion.copy()
    top[[20, 21, 22, 40, 41, 42, 60, 61, 62, 63]] = 1.0
    assert standing(top, 0.0).samples == 10
    nine = motion.copy()
    nine[[20, 21, 22, 40, 41, 42, 60, 61, 62]] = 1.0
    assert standing(nine, 0.0).samples == 0
    assert standing(np.concatenate([np.ones(20), motion]), 0.0).samples == 0
    assert standing(np.concatenate([motion, np.ones(20)]), 0.0).samples == 0
    assert standing(np.concatenate([np.ones(5), top, np.ones(4)]), 0.0).samples == 19


def test_what_is_held_or_has_twenty_values_has_levels_and_no_limits() -> None:
    """Also where one of them is the largest in many samples."""
    levels = np.round(clipped(0.6) * 12.0)
    assert np.unique(levels).size == 20
    assert standing(levels, 1.0).samples == 0
    finer = np.round(clipped(0.6) * 13.0)
    assert np.unique(finer).size == 21 + 1
    assert standing(finer, 1.0).samples > 0
    assert standing(np.repeat(clipped(0.6, 100), 3), 0.0).samples == 0


def test_a_signal_that_settles_at_its_largest_value_is_not_cut_there() -> None:
    """It comes there slowly, also in steps of a converter."""
    t = np.arange(300.0)
    settles = np.concatenate([1.0 - np.exp(-0.05 * t), np.exp(-0.05 * t)])
    assert standing(settles, 0.0).samples == 0
    assert standing(np.round(settles / 0.004) * 0.004, 0.004).samples == 0


def test_limits_are_of_use_where_a_tenth_of_the_samples_is_free() -> None:
    """At a limit the model counts where it is beyond."""
    upper = np.arange(10) < 9
    none = np.zeros(10, dtype=bool)
    assert Standing(upper, none).is_usable
    assert Standing(none, upper).is_usable
    assert not Standing(upper, np.arange(10) == 9).is_usable
    assert not Standing(none, none).is_usable
    y = np.array([1.0, 1.0, 0.5, -1.0, -1.0])
    places = Standing(np.array([1, 1, 0, 0, 0], dtype=bool), np.array([0, 0, 0, 1, 1], dtype=bool))
    model = np.array([1.5, 0.5, 9.0, -1.5, -0.5])
    assert places.bounded(y, model).tolist() == [1.5, 1.0, 0.5, -1.5, -1.0]
