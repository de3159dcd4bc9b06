"""Histograms of durations, against the durations themselves."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from quell.realtime.system import BINS, Histogram, count_duration, empty_counts


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=300))
def test_a_histograms_percentiles_are_those_of_what_was_counted(durations: list[int]) -> None:
    """Rounded up, by a thirty-second at most; the longest as it is."""
    counts = empty_counts()
    for duration in durations:
        count_duration(counts, duration)
    histogram = Histogram.of(counts)
    assert len(histogram) == len(durations)
    assert histogram.max == pytest.approx(1e-9 * max(durations))
    ordered = sorted(durations)
    for percent in (1.0, 50.0, 99.0, 99.9, 100.0):
        exact = 1e-9 * ordered[math.ceil(percent / 100.0 * len(ordered) - 1e-9) - 1]
        assert (
            exact - 1e-15 <= histogram.percentile(percent) <= exact * (1.0 + 1.0 / 32.0) + 1.001e-9
        )


def test_a_histogram_as_text_and_plot() -> None:
    """Text has a line for each quarter of a decade; an empty histogram has one line."""
    counts = empty_counts()
    for duration in [20_000] * 990 + [300_000] * 10:
        count_duration(counts, duration)
    histogram = Histogram.of(counts)
    assert (
        histogram.text("lateness")
        .splitlines()[0]
        .startswith("lateness: p50 20.5 µs, p99 20.5 µs, p99.9 300 µs, max 300 µs of 1000")
    )
    assert [int(line.split()[4]) for line in histogram.text().splitlines()[1:-1]] == [
        990,
        0,
        0,
        0,
        10,
    ]
    *_, lowest, scale = histogram.text().splitlines()
    assert [int(mark) for mark in scale.split("|")[1:]] == [1, 10, 100, 1000]
    # The mark of 10 is at the end of the bar of 10.
    assert scale.index("|10 ") == len(lowest) - 1
    ax = histogram.plot()
    assert ax.get_xlabel() == "duration [µs]"
    # Of 1000 all, then 10 took longer, and none: half a one stands for it on this scale.
    assert set(ax.lines[0].get_ydata()) == {1.0, 0.01, 0.0005}
    empty = Histogram.of(empty_counts())
    assert math.isnan(empty.p50)
    assert empty.text().endswith("of 0")
    with pytest.raises(ValueError, match="percent = 0"):
        histogram.percentile(0.0)
    assert len(histogram.edges) == BINS
