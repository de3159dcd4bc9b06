"""The search for frequencies, sample by sample, against the equations that it follows."""

from __future__ import annotations

import numpy as np
import pytest

import quell as ql
from quell.learners import frequency_search as room
from quell.learners.base import lag_memory, lag_push
from quell.learners.frequency_search import (
    ADOPT,
    ENTRIES,
    FIT,
    LEARN_ANEW,
    NOTHING,
    REFINE,
    SCAN,
    FrequencySearch,
    SearchMemory,
    _is_resolved,
    advance_search,
    is_locked,
    judge,
    start_search_again,
)
from quell.learners.oscillators import Oscillators
from quell.types import Vector

DT, STEP = 0.01, 0.1
TRUTH = np.array([6.0, 9.0])
OSCILLATORS = Oscillators(0, np.array([1.0, 3.0]), 0.5, 20.0, np.ones(1))
ONE = OSCILLATORS._replace(omega=np.array([1.0]))
OBSERVER = ql.ESO.model_free(1, 1.0, 20.0, DT)
LAGGED = room.frequency_search(OBSERVER, 4.0, OSCILLATORS, 0)
SEARCH = LAGGED._replace(follow=1.0)  # f_plain itself, without the lag of the signals
NO_STATE = np.zeros(0)


def load(k: int, omega: Vector = TRUTH) -> float:
    """A constant and two sinusoids."""
    return 1.5 + 2.0 * np.sin(omega[0] * DT * k) + np.sin(omega[1] * DT * k + 1.0)


def advance(
    search: FrequencySearch,
    memory: SearchMemory,
    f_plain: float,
    omega: Vector,
    state: Vector = NO_STATE,
    u: float = 0.0,
) -> int:
    """Continue with a sample; without state and u there are only sinusoids."""
    return int(advance_search(search, memory, f_plain, state, u, omega))


def f_plain_of(memory: SearchMemory) -> Vector:
    """The averages of f_plain in the ring."""
    return memory.past[:: memory.late.size]


def searched(
    memory: SearchMemory, omega: Vector, samples: range, truth: Vector = TRUTH
) -> list[tuple[int, int, float, float]]:
    """Advance; return each result, its sample, its window, and the entries at the time."""
    results, loop = [], memory.loop[0]
    for k in samples:
        window = float(loop.window)
        result = advance(SEARCH, memory, load(k, truth), omega)
        if result != NOTHING:
            results.append((result, k, window, float(loop.entries)))
    return results


def started() -> tuple[SearchMemory, Vector]:
    """The state before the first sample, and the frequencies of the oscillators."""
    return room.search_memory(SEARCH, OSCILLATORS), OSCILLATORS.omega.copy()


def test_an_entry_is_a_mean_and_lasts_two_lags_of_a_pole() -> None:
    """2/omega_o; lines are 9 % apart between the limits; all entries pass in the time of one."""
    assert (SEARCH.spacing, SEARCH.step, SEARCH.rows) == (10.0, pytest.approx(STEP), 52)
    assert SEARCH.shortest == pytest.approx(16.0 / (4.0 * STEP))
    assert SEARCH.lines[[0, -1]] == pytest.approx([0.05, 2.0])
    np.testing.assert_allclose(SEARCH.lines[1:] / SEARCH.lines[:-1], 40.0 ** (1.0 / 63.0))
    memory, omega = started()
    searched(memory, omega, range(57))
    assert f_plain_of(memory)[:5] == pytest.approx(
        [np.mean([load(k) for k in range(10 * i, 10 * i + 10)]) for i in range(5)]
    )
    assert memory.total[0] == pytest.approx(sum(load(k) for k in range(50, 57)))


@pytest.mark.parametrize(("omega_c", "expected"), [(0.01, 512.0), (0.5, 320.0), (19.0, 32.0)])
def test_the_shortest_window_fits_into_the_ring(omega_c: float, expected: float) -> None:
    """16/omega_c where that is possible."""
    assert room.frequency_search(OBSERVER, omega_c, OSCILLATORS, 0).shortest == expected


def test_state_and_u_are_in_the_ring_beside_f_plain() -> None:
    """The state as it is given, lag-filtered; u through the lag of an estimate of f."""
    search = room.frequency_search(OBSERVER, 4.0, OSCILLATORS, 2)._replace(follow=1.0)
    memory, omega = room.search_memory(search, OSCILLATORS), OSCILLATORS.omega.copy()
    chain, u_filtered = lag_memory(search.lag, 1), []
    for k in range(20):
        u_filtered.append(lag_push(search.lag, chain, 0, float(k**2)))
        advance(search, memory, 5.0, omega, np.array([2.0 * k, -1.0]), float(k**2))
    assert memory.past[:8].tolist() == pytest.approx(
        [5.0, 9.0, -1.0, np.mean(u_filtered[:10]), 5.0, 29.0, -1.0, np.mean(u_filtered[10:])]
    )


def test_a_search_for_one_order_sees_the_signals_through_a_lag() -> None:
    """A first-order lag of 1/(3 omega_c) that begins at the first sample; with several orders none."""
    memory, omega = started()
    late, seen = load(0), []
    for k in range(20):
        advance(LAGGED, memory, load(k), omega)
        late += -np.expm1(-3.0 * 4.0 * DT) * (load(k) - late)
        seen.append(late)
    assert f_plain_of(memory)[:2] == pytest.approx([np.mean(seen[:10]), np.mean(seen[10:])])
    several = OSCILLATORS._replace(orders=np.array([1.0, 3.0]))
    assert room.frequency_search(OBSERVER, 4.0, several, 0).follow == 1.0


@pytest.mark.parametrize(("states", "found"), [(1, True), (0, False)])
def test_the_motion_of_the_loop_does_not_hide_a_load(states: int, found: bool) -> None:
    """f_plain contains a transient of the state that is three times as large as the load."""
    search = room.frequency_search(OBSERVER, 4.0, ONE, states)
    memory, omega = room.search_memory(search, ONE), ONE.omega.copy()
    rng, x = np.random.default_rng(4), 0.0
    for k in range(800):
        x += DT * (rng.normal(0.0, 3.0 / DT**0.5) - x)
        f_plain = -2.0 * x + np.sin(3.0 * DT * k)
        advance(search, memory, f_plain, omega, np.array([x])[:states])
    assert is_locked(search, memory, 0) == found
    assert (abs(omega[0] - 3.0) < 0.03) == found


@pytest.mark.trial
def test_frequencies_are_found_where_the_state_contains_them_alone() -> None:
    """In the steady state a combination of state and u is f_plain itself, and says nothing."""
    search = room.frequency_search(OBSERVER, 4.0, OSCILLATORS, 3)
    memory, omega = room.search_memory(search, OSCILLATORS), OSCILLATORS.omega.copy()
    for k in range(800):
        later = [load(k - delay) for delay in (20, 45, 80)]
        advance(search, memory, load(k), omega, np.array(later), load(k - 10))
    assert [is_locked(search, memory, j) for j in range(2)] == [True, True]
    np.testing.assert_allclose(np.sort(omega), TRUTH, rtol=1e-3)


def test_a_scan_correlates_what_is_left_with_all_lines() -> None:
    """Weighted by Hann's window; the strongest line begins the next fit, the second in what is left."""
    memory, omega = started()
    loop, scans, k = memory.loop[0], 0, 0
    while scans < 2:
        stage = loop.stage
        advance(SEARCH, memory, load(k), omega)
        k += 1
        finished = stage == SCAN and loop.stage == FIT
        if finished:
            scans += 1
            assert memory.fit.omega[scans - 1] == pytest.approx(TRUTH[scans - 1] * STEP, rel=0.1)
            assert loop.found == scans
        if finished and scans == 1:
            rows, values = np.arange(40), f_plain_of(memory)
            rest = values[39 - rows] - np.mean(values[:40])
            rest *= np.sin(np.pi * (rows + 0.5) / 40) ** 2
            angles = -np.outer(SEARCH.lines, rows)
            expected = np.column_stack([np.sin(angles) @ rest, np.cos(angles) @ rest])
            np.testing.assert_allclose(memory.score.reshape(-1, 2), expected, atol=1e-9)


@pytest.mark.trial
def test_frequencies_are_adopted_from_a_window_that_resolves_them_and_it_grows() -> None:
    """Exactly, without noise; the deviation is that of the least squares for what the fit leaves."""
    memory, omega = started()
    results = searched(memory, omega, range(900))
    assert results[0][0] == LEARN_ANEW
    size = int(results[0][2])
    assert size == 40
    assert {each[0] for each in results[1:]} == {ADOPT}
    np.testing.assert_allclose(omega, TRUTH, rtol=1e-7)
    windows = [window for _, _, window, _ in results]
    assert windows == sorted(windows)
    assert windows[-1] > 80.0  # of 90: all that there is, but for the time of a fit
    assert is_locked(SEARCH, memory, 0)
    assert is_locked(SEARCH, memory, 1)
    memory, omega = started()
    k = 0
    while not is_locked(SEARCH, memory, 0):
        searched(memory, omega, range(k, k + 1))
        k += 1
    times, start = -np.arange(float(size)), int(memory.loop[0].start)
    values = f_plain_of(memory)[start : start + size][::-1]
    phase = [np.outer(times, TRUTH[i : i + 1] * STEP)[:, 0] for i in range(2)]
    columns = [np.ones(size)] + [f(p) for p in phase for f in (np.sin, np.cos)]
    (_, *pairs), *_ = np.linalg.lstsq(np.column_stack(columns), values, rcond=None)
    for i, p in enumerate(phase):
        columns.append(times * (pairs[2 * i] * np.cos(p) - pairs[2 * i + 1] * np.sin(p)))
    matrix = np.column_stack(columns)
    rounding = 1e-9 * np.var(values)
    covariance = np.linalg.inv(matrix.T @ matrix) * rounding
    np.testing.assert_allclose(memory.adopted, np.sqrt(np.diag(covariance)[-2:]), rtol=1e-4)


@pytest.mark.trial
def test_a_changed_load_is_found_and_takes_the_place_of_the_old_one() -> None:
    """A fit with both does not go on; the first good one after it has the new frequencies alone."""
    memory, omega = started()
    searched(memory, omega, range(700))
    after = np.array([7.5, 4.0])
    results = searched(memory, omega, range(700, 1500), after)
    assert LEARN_ANEW in [each[0] for each in results]
    np.testing.assert_allclose(np.sort(omega), np.sort(after), rtol=1e-6)
    window, entries = results[-1][2:]
    assert entries - window >= 70.0  # nothing of the old load


@pytest.mark.trial
def test_without_an_oscillation_nothing_is_adopted() -> None:
    """Of noise a fit leaves too much: the window is 1.5 times as long, up to the longest, then the shortest."""
    memory, omega = started()
    rng, windows = np.random.default_rng(0), []
    memory.past[:] = rng.normal(size=memory.past.size)
    memory.loop[0].entries = float(ENTRIES)
    for _ in range(9000):
        assert advance(SEARCH, memory, float(rng.normal()), omega) == NOTHING
        if not windows or windows[-1] != memory.loop[0].window:
            windows.append(float(memory.loop[0].window))
        if len(windows) > 8:
            break
    assert windows == [40.0, 60.0, 90.0, 135.0, 202.0, 303.0, 454.0, 40.0, 60.0]
    assert omega.tolist() == OSCILLATORS.omega.tolist()


def test_an_absurd_sample_and_a_start_from_rest_begin_with_an_empty_past() -> None:
    """Nothing is locked then; a large sample of 1e99 is one like others."""
    memory, omega = started()
    for bad in (1e101, -1e101, np.inf, np.nan, None):
        memory.loop[0].entries = 60.0
        memory.adopted[:] = 1e-3
        assert advance(SEARCH, memory, 1e99, omega) == NOTHING
        assert memory.loop[0].entries == 60.0
        assert is_locked(SEARCH, memory, 0)
        if bad is None:
            start_search_again(SEARCH, memory)
        else:
            assert advance(SEARCH, memory, bad, omega) == NOTHING
        assert not any(memory.loop[0].tolist())
        assert not any(each.any() for each in (memory.adopted, memory.total, memory.chain))
    memory.adopted[:] = 1e-3
    assert advance(SEARCH, memory, 1.0, omega, u=np.nan) == NOTHING
    assert not memory.adopted.any()


def test_counts_of_entries_stay_small_and_their_reduction_changes_nothing() -> None:
    """By a multiple of the ring's length, at a number that single precision still has."""
    results = []
    for offset in (0.0, 2.0 * 4096.0 * ENTRIES):
        memory, omega = started()
        means = [np.mean([load(k) for k in range(10 * i, 10 * i + 10)]) for i in range(ENTRIES)]
        memory.past[:: memory.late.size], memory.loop[0].entries = means, ENTRIES + offset
        found = searched(memory, omega, range(10 * ENTRIES, 10 * ENTRIES + 100))
        results.append(([each[:3] for each in found], omega, memory.adopted))
        assert memory.loop[0].entries == ENTRIES + 10.0 + 0.5 * offset < 2.0**24
    assert len(results[0][0]) > 2
    assert results[0][0] == results[1][0]
    np.testing.assert_allclose(results[1][1], TRUTH, rtol=1e-7)
    np.testing.assert_allclose(results[1][2], results[0][2], rtol=1e-6)


def test_a_frequency_is_resolved_by_a_window_that_is_long_enough() -> None:
    """A phase of 4 rad over it, 3 rad from any other, and a standard deviation of 0.3 rad."""

    def resolved(first: float, second: float, deviation: float, found: int = 2) -> bool:
        memory, _ = started()
        memory.loop[0].window, memory.loop[0].found = 50.0, found
        memory.fit.omega[:], memory.fit.deviation[:] = (first, second), deviation
        return _is_resolved(memory.loop[0], memory.fit, 0)

    assert resolved(0.081, 0.2, 0.0059)
    assert not resolved(0.079, 0.2, 0.0059)
    assert not resolved(0.081, 0.2, 0.0061)
    assert resolved(0.161, 0.1, 0.0059)
    assert not resolved(0.159, 0.1, 0.0059)
    assert resolved(0.159, 0.1, 0.0059, found=1)


def test_the_strongest_line_that_the_window_contains_is_added_without_amplitudes() -> None:
    """A whole period of it; the line is that of the lowest order, and others keep their amplitudes."""
    oscillators = OSCILLATORS._replace(orders=np.array([2.0, 5.0]))
    search = room.frequency_search(OBSERVER, 4.0, oscillators, 0)
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
    """A refined fit of two frequencies that the oscillators have, in a window of 70 out of 300 entries."""
    memory, omega = started()
    given = {
        "entries": 300.0, "newest": 298.0, "window": 70.0, "found": 2.0, "continues": 1.0,
        "without": 1.0, "share": 0.09, "rest": 0.01, "level": 0.01 / 70.0,
    }  # fmt: skip
    for name, value in (given | loop).items():
        setattr(memory.loop[0], name, value)
    memory.adopted[:], memory.fit.omega[:], memory.fit.deviation[:] = 1e-3, TRUTH * STEP, 1.2e-3
    omega[:] = TRUTH
    return memory, omega


def test_a_good_fit_goes_on_in_a_longer_window() -> None:
    """By a factor of 1.25; what was good is remembered."""
    memory, omega = judged()
    loop = memory.loop[0]
    assert judge(SEARCH, memory, omega) == ADOPT
    assert (loop.window, loop.found, loop.continues, loop.stage) == (87.0, 2.0, 1.0, REFINE)
    assert (loop.start, loop.good_found, loop.level) == (228.0, 2.0, 0.01 / 70.0)
    assert memory.good.tolist() == memory.fit.omega.tolist()


@pytest.mark.parametrize("bad", [{"share": 0.11}, {"rest": 0.0131}])
def test_a_fit_that_does_not_go_on_returns_to_where_the_last_good_one_began(
    bad: dict[str, float],
) -> None:
    """With its frequencies; if that fails, too, a search begins from nothing in a longer window."""
    memory, omega = judged(start=200.0, good_found=1.0, **bad)
    loop, memory.good[:] = memory.loop[0], (0.5, 0.0)
    assert judge(SEARCH, memory, omega) == NOTHING
    assert (loop.window, loop.found, loop.continues, loop.stage) == (100.0, 1.0, 0.0, FIT)
    assert memory.fit.omega[0] == 0.5
    loop.share = 0.11
    for window, longer in ((100.0, 150.0), (200.0, 300.0), (201.0, SEARCH.shortest)):
        assert memory.adopted.all()
        loop.window = window
        assert judge(SEARCH, memory, omega) == NOTHING
        assert (loop.window, loop.found, loop.continues, loop.stage) == (longer, 0.0, 0.0, FIT)
    assert not memory.adopted.any(), "where no window fits, the oscillators are free"


def test_a_frequency_is_taken_over_if_it_is_better_known_or_the_old_one_is_wrong() -> None:
    """Better than 1.3 times the deviation it came with; wrong by 0.3 rad over the window."""
    for deviation, wrong_by, expected in (
        (1.2e-3, 0.29, ADOPT), (1.4e-3, 0.29, NOTHING), (1.4e-3, 0.31, LEARN_ANEW)
    ):  # fmt: skip
        memory, omega = judged()
        memory.fit.deviation[:] = deviation
        omega[:] = was = TRUTH + wrong_by / 70.0 / STEP
        assert judge(SEARCH, memory, omega) == expected
        np.testing.assert_allclose(omega, TRUTH if expected != NOTHING else was)


def test_an_oscillator_keeps_its_frequency_whatever_the_order_of_the_fit() -> None:
    """Its amplitude belongs to it; a free oscillator has a frequency that no other one has."""
    memory, omega = judged()
    memory.fit.omega[:] = TRUTH[::-1] * STEP
    assert judge(SEARCH, memory, omega) == ADOPT
    np.testing.assert_allclose(omega, TRUTH)
    for adopted, expected in (((0.0, 1e-3), TRUTH), ((1e-3, 0.0), TRUTH[::-1])):
        memory, omega = judged()
        memory.fit.omega[:] = TRUTH * STEP
        omega[:] = np.where(np.array(adopted) > 0.0, TRUTH[1], 1.0)
        memory.adopted[:] = adopted
        assert judge(SEARCH, memory, omega) == LEARN_ANEW
        np.testing.assert_allclose(omega, expected)
