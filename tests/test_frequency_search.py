"""The search for frequencies, sample by sample, against the equations that it follows."""

from __future__ import annotations

import numpy as np
import pytest

import quell as ql
from quell.learners.kalman import search as room
from quell.learners.kalman.oscillators import Oscillators
from quell.learners.kalman.search import advance_search, is_locked, start_search_again
from quell.learners.kalman.search_state import ENTRIES, FIT, SCAN, FrequencySearch, SearchMemory
from quell.learners.kalman.search_verdict import (
    ADOPT,
    LEARN_ANEW,
    NOTHING,
    _is_resolved,
    judge,
)
from quell.types import Vector

DT, STEP = 0.01, 0.1
TRUTH = np.array([6.0, 9.0])
OSCILLATORS = Oscillators(0, np.array([1.0, 3.0]), 0.5, 20.0, np.ones(1))
ONE = OSCILLATORS._replace(omega=np.array([1.0]))
OBSERVER = ql.ESO.model_free(1, 1.0, 20.0, DT)
LAGGED = room.frequency_search(OBSERVER, 4.0, OSCILLATORS)
SEARCH = LAGGED._replace(follow=1.0)  # f_plain itself, without the lag of 1/omega_c


def load(k: int, omega: Vector = TRUTH) -> float:
    """A constant and two sinusoids."""
    return 1.5 + 2.0 * np.sin(omega[0] * DT * k) + np.sin(omega[1] * DT * k + 1.0)


def searched(
    memory: SearchMemory, omega: Vector, samples: range, truth: Vector = TRUTH
) -> list[tuple[int, int, float, float]]:
    """Advance; return each result, its sample, its window, and the entries at the time."""
    results, loop = [], memory.loop[0]
    for k in samples:
        window = float(loop.window)
        result = advance_search(SEARCH, memory, load(k, truth), omega)
        if result != NOTHING:
            results.append((result, k, window, float(loop.entries)))
    return results


def started() -> tuple[SearchMemory, Vector]:
    """The state before the first sample, and the frequencies of the oscillators."""
    return room.search_memory(SEARCH, OSCILLATORS), OSCILLATORS.omega.copy()


def test_an_entry_is_a_mean_and_lasts_two_lags_of_a_pole() -> None:
    """2/omega_o; lines are 9 % apart between the limits; all entries pass in the time of one."""
    assert (SEARCH.spacing, SEARCH.step, SEARCH.rows) == (10.0, pytest.approx(STEP), 52)
    assert SEARCH.lines[[0, -1]] == pytest.approx([0.05, 2.0])
    np.testing.assert_allclose(SEARCH.lines[1:] / SEARCH.lines[:-1], 40.0 ** (1.0 / 63.0))
    assert SEARCH.shortest == pytest.approx(16.0 / (4.0 * STEP))
    memory, omega = started()
    searched(memory, omega, range(57))
    assert memory.past[:5] == pytest.approx(
        [np.mean([load(k) for k in range(10 * i, 10 * i + 10)]) for i in range(5)]
    )
    assert memory.loop[0].total == pytest.approx(sum(load(k) for k in range(50, 57)))


def test_a_search_for_one_order_sees_f_plain_through_a_lag_of_the_loop() -> None:
    """A first-order lag of 1/omega_c that begins at the first sample; with several orders there is none."""
    memory, omega = started()
    late, seen = load(0), []
    for k in range(20):
        advance_search(LAGGED, memory, load(k), omega)
        late += -np.expm1(-4.0 * DT) * (load(k) - late)
        seen.append(late)
    assert memory.past[:2] == pytest.approx([np.mean(seen[:10]), np.mean(seen[10:])])
    several = OSCILLATORS._replace(orders=np.array([1.0, 3.0]))
    assert room.frequency_search(OBSERVER, 4.0, several).follow == 1.0


@pytest.mark.parametrize(("search", "found"), [(LAGGED, True), (SEARCH, False)])
def test_the_lag_shows_a_slow_load_under_quick_motion(search: FrequencySearch, found: bool) -> None:
    """A fifth of the load's amplitude, at ten times its frequency."""
    memory = room.search_memory(search, ONE)
    omega = ONE.omega.copy()
    for k in range(1200):
        f_plain = np.sin(1.6 * DT * k) + 0.2 * np.sin(16.0 * DT * k)
        advance_search(search, memory, f_plain, omega)
    assert is_locked(search, memory, 0) == found
    assert (abs(omega[0] - 1.6) < 0.016) == found


def test_a_scan_correlates_what_is_left_with_all_lines() -> None:
    """Weighted by Hann's window; the strongest line begins the next fit, the second in what is left."""
    memory, omega = started()
    loop, scans, k = memory.loop[0], 0, 0
    while scans < 2:
        stage = loop.stage
        advance_search(SEARCH, memory, load(k), omega)
        k += 1
        finished = stage == SCAN and loop.stage == FIT
        if finished:
            scans += 1
            assert memory.fit.omega[scans - 1] == pytest.approx(TRUTH[scans - 1] * STEP, rel=0.1)
            assert loop.found == scans
        if finished and scans == 1:
            rows = np.arange(32)
            rest = memory.past[31 - rows] - np.mean(memory.past[:32])
            rest *= np.sin(np.pi * (rows + 0.5) / 32) ** 2
            angles = -np.outer(SEARCH.lines, rows)
            expected = np.column_stack([np.sin(angles) @ rest, np.cos(angles) @ rest])
            np.testing.assert_allclose(memory.score.reshape(-1, 2), expected, atol=1e-9)


def test_frequencies_are_adopted_from_a_window_that_resolves_them_and_it_grows() -> None:
    """Exactly, without noise; the deviation is that of the least squares, for 1/1000 of the variance."""
    memory, omega = started()
    results = searched(memory, omega, range(700))
    assert results[0] == (LEARN_ANEW, 410, 40.0, 41.0)
    # Two passes of a fit and a check; each takes a sample for its 41 rows, and one to conclude.
    assert [each[:2] for each in results[1:3]] == [(ADOPT, 416), (ADOPT, 422)]
    np.testing.assert_allclose(omega, TRUTH, rtol=1e-9)
    assert all(window in (entries, entries - 1.0) for _, _, window, entries in results)
    assert is_locked(SEARCH, memory, 0)
    assert is_locked(SEARCH, memory, 1)
    memory, omega = started()
    k = 0
    while not is_locked(SEARCH, memory, 0):
        searched(memory, omega, range(k, k + 1))
        k += 1
    times = -np.arange(40.0)
    values = memory.past[39::-1]
    phase = [np.outer(times, TRUTH[i : i + 1] * STEP)[:, 0] for i in range(2)]
    columns = [np.ones(40)] + [f(p) for p in phase for f in (np.sin, np.cos)]
    (_, *pairs), *_ = np.linalg.lstsq(np.column_stack(columns), values, rcond=None)
    for i, p in enumerate(phase):
        columns.append(times * (pairs[2 * i] * np.cos(p) - pairs[2 * i + 1] * np.sin(p)))
    matrix = np.column_stack(columns)
    covariance = np.linalg.inv(matrix.T @ matrix) * 1e-3 * np.var(values)
    np.testing.assert_allclose(memory.adopted, np.sqrt(np.diag(covariance)[-2:]), rtol=1e-4)


def test_a_changed_load_shortens_the_window_and_its_frequencies_are_found() -> None:
    """The fit is given up, the oscillators are free meanwhile, and take over the new frequencies."""
    memory, omega = started()
    searched(memory, omega, range(700))
    before, after = float(memory.loop[0].window), np.array([7.5, 4.0])
    free, windows, k = False, {before}, 700
    while not (free and is_locked(SEARCH, memory, 1)) and k < 6000:
        searched(memory, omega, range(k, k + 1), after)
        free = free or not is_locked(SEARCH, memory, 0)
        windows.add(float(memory.loop[0].window))
        k += 1
    assert before == 69.0
    assert min(windows) == 32.0
    assert windows >= {50.0, 40.0}  # shorter by a factor of 1.25 each time
    assert k < 2000
    np.testing.assert_allclose(np.sort(omega), np.sort(after), rtol=1e-6)


def test_without_an_oscillation_nothing_is_adopted() -> None:
    """Of noise a fit leaves too much: the window doubles up to the longest, and is the shortest again."""
    memory, omega = started()
    rng, windows = np.random.default_rng(0), []
    memory.past[:] = rng.normal(size=ENTRIES)
    memory.loop[0].entries = float(ENTRIES)
    for _ in range(9000):
        assert advance_search(SEARCH, memory, float(rng.normal()), omega) == NOTHING
        if not windows or windows[-1] != memory.loop[0].window:
            windows.append(float(memory.loop[0].window))
        if len(windows) > 6:
            break
    assert windows == [32.0, 64.0, 128.0, 256.0, 512.0, 32.0, 64.0]
    assert omega.tolist() == OSCILLATORS.omega.tolist()


def test_an_absurd_sample_and_a_start_from_rest_begin_with_an_empty_past() -> None:
    """Nothing is locked then; a large sample of 1e99 is one like others."""
    memory, omega = started()
    for bad in (1e101, -1e101, np.inf, np.nan, None):
        memory.loop[0].entries = 60.0
        memory.adopted[:] = 1e-3
        assert advance_search(SEARCH, memory, 1e99, omega) == NOTHING
        assert memory.loop[0].entries == 60.0
        assert is_locked(SEARCH, memory, 0)
        if bad is None:
            start_search_again(SEARCH, memory)
        else:
            assert advance_search(SEARCH, memory, bad, omega) == NOTHING
        assert not any(memory.loop[0].tolist())
        assert not memory.adopted.any()


def test_counts_of_entries_stay_small_and_their_reduction_changes_nothing() -> None:
    """By a multiple of the ring's length, at a number that single precision still has."""
    results = []
    for offset in (0.0, 2.0 * 4096.0 * ENTRIES):
        memory, omega = started()
        means = [np.mean([load(k) for k in range(10 * i, 10 * i + 10)]) for i in range(ENTRIES)]
        memory.past[:], memory.loop[0].entries = means, ENTRIES + offset
        found = searched(memory, omega, range(10 * ENTRIES, 10 * ENTRIES + 100))
        results.append(([each[:3] for each in found], omega, memory.adopted))
        assert memory.loop[0].entries == ENTRIES + 10.0 + 0.5 * offset < 2.0**24
    assert len(results[0][0]) > 2
    assert results[0][0] == results[1][0]
    np.testing.assert_allclose(results[1][1], TRUTH, rtol=1e-9)
    np.testing.assert_allclose(results[1][2], results[0][2], rtol=1e-6)


def test_a_frequency_is_resolved_by_a_window_that_is_long_enough() -> None:
    """A phase of 5 rad over it, 1.5 rad from any other, and a standard deviation of 0.2 rad."""

    def resolved(first: float, second: float, deviation: float, found: int = 2) -> bool:
        memory, _ = started()
        memory.loop[0].window, memory.loop[0].found = 50.0, found
        memory.fit.omega[:], memory.fit.deviation[:] = (first, second), deviation
        return _is_resolved(memory.loop[0], memory.fit, 0)

    assert resolved(0.101, 0.2, 0.0039)
    assert not resolved(0.099, 0.2, 0.0039)
    assert not resolved(0.101, 0.2, 0.0041)
    assert resolved(0.131, 0.1, 0.0039)
    assert not resolved(0.129, 0.1, 0.0039)
    assert resolved(0.129, 0.1, 0.0039, found=1)


def test_the_strongest_line_that_the_window_contains_is_added_without_amplitudes() -> None:
    """A whole period of it; the line is that of the lowest order, and others keep their amplitudes."""
    oscillators = OSCILLATORS._replace(orders=np.array([2.0, 5.0]))
    search = room.frequency_search(OBSERVER, 4.0, oscillators)
    memory = room.search_memory(search, oscillators)
    memory.loop[0].found, memory.loop[0].window = 1.0, 40.0
    memory.fit.amplitude[:] = 1.0
    memory.score[2 * 30 + 1], memory.score[2 * 31] = 3.0, -4.0
    memory.score[2 * 1] = 9.0  # 0.11 rad per entry: two thirds of a period
    room._add_strongest_line(search, memory)
    assert memory.fit.omega.tolist() == [0.0, pytest.approx(0.05 * 40.0 ** (31.0 / 63.0))]
    assert memory.fit.amplitude.tolist() == [1.0] * 4 + [0.0] * 4
    assert memory.loop[0].found == 2.0


def judged(**loop: float) -> tuple[SearchMemory, Vector]:
    """A fit of two frequencies that the oscillators have, in a window of 70 out of 300 entries."""
    memory, omega = started()
    given = {"entries": 300.0, "window": 70.0, "found": 2.0, "continues": 1.0, "variance": 1.0}
    for name, value in (given | loop).items():
        setattr(memory.loop[0], name, value)
    memory.adopted[:], memory.fit.omega[:], memory.fit.deviation[:] = 1e-3, TRUTH * STEP, 1.2e-3
    return memory, omega


def test_a_fit_that_does_not_go_on_shortens_the_window_then_frees_the_oscillators() -> None:
    """By a factor of 1.25 with the same frequencies; then a search from nothing, in twice the window."""
    memory, omega = judged(left=0.03)
    loop = memory.loop[0]
    assert judge(SEARCH, memory, 0.03, omega) == NOTHING
    assert (loop.window, loop.found, loop.continues, loop.stage) == (56.0, 2.0, 0.0, FIT)
    assert memory.adopted.all()
    for window, longer in ((150.0, 300.0), (151.0, 32.0)):
        loop.window, loop.found, loop.left, memory.adopted[:] = window, 1.0, 0.03, 1.0
        assert judge(SEARCH, memory, 0.03, omega) == NOTHING
        assert (loop.window, loop.found, loop.continues, loop.stage) == (longer, 0.0, 0.0, FIT)
        assert not memory.adopted.any()


def test_a_frequency_is_taken_over_if_it_is_better_known_or_the_old_one_is_wrong() -> None:
    """Better than 1.3 times the deviation it came with; wrong is what leaves four times as much."""
    for deviation, left, expected in (
        (1.2e-3, 3.9e-3, ADOPT), (1.4e-3, 3.9e-3, NOTHING), (1.4e-3, 4.1e-3, LEARN_ANEW)
    ):  # fmt: skip
        memory, omega = judged(left=1e-3, level=1e-3 / 70.0)
        memory.fit.deviation[:] = deviation
        assert judge(SEARCH, memory, left, omega) == expected
        taken = TRUTH if expected != NOTHING else OSCILLATORS.omega
        np.testing.assert_allclose(omega, taken)
        assert memory.loop[0].window == 87.0
