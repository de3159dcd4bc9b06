"""The ring buffer between loop and telemetry writer."""

from threading import Thread
from typing import Any

import numpy as np
import pytest

from quell.kernels.dispatch import compiled, interpreted
from quell.realtime.telemetry import drain, dropped, push, ring, waiting

pytestmark = pytest.mark.compiled

WIDTH = 7


@compiled
def _produce(out: Any, row: Any, count: int) -> int:
    """Push ``count`` rows (k, k, …), repeatedly if the ring is full; return the repetitions."""
    again = 0
    for k in range(count):
        for i in range(row.size):
            row[i] = k
        while not push(out, row):
            again += 1
    return again


@compiled
def _try_all(out: Any, row: Any, count: int) -> int:
    """Push ``count`` rows once each; return how many found room."""
    went = 0
    for k in range(count):
        for i in range(row.size):
            row[i] = k
        went += push(out, row)
    return went


@pytest.fixture(
    params=[
        pytest.param(_produce, id="compiled", marks=pytest.mark.trial),
        pytest.param(interpreted(_produce), id="interpreted"),
    ]
)
def produce(request: pytest.FixtureRequest) -> Any:
    """The producer, compiled and interpreted."""
    return request.param


def test_rows_come_out_in_order_as_they_went_in(produce: Any) -> None:
    """Also after the ring has wrapped around."""
    shared = ring(8, WIDTH)
    for start in (0, 8, 16):
        produce(shared, np.empty(WIDTH), 5)
        assert waiting(shared) == 5
        np.testing.assert_array_equal(
            drain(shared), np.repeat(np.arange(5.0)[:, None], WIDTH, axis=1)
        )
        assert waiting(shared) == 0, start
    assert drain(shared).shape == (0, WIDTH)


@pytest.mark.trial(cases="compiled")
@pytest.mark.parametrize(
    "attempt", [_try_all, interpreted(_try_all)], ids=["compiled", "interpreted"]
)
def test_a_full_ring_drops_the_newest_rows_and_counts_them(attempt: Any) -> None:
    """The producer never waits; dropped rows are counted."""
    shared = ring(4, WIDTH)
    assert attempt(shared, np.empty(WIDTH), 10) == 4
    assert dropped(shared) == 6
    np.testing.assert_array_equal(drain(shared)[:, 0], [0, 1, 2, 3])


@pytest.mark.trial
def test_no_row_is_torn_lost_or_repeated_between_two_threads() -> None:
    """A compiled producer at full speed on a small ring."""
    count, shared, pushed = 20_000, ring(61, WIDTH), []
    producer = Thread(target=lambda: pushed.append(_produce(shared, np.empty(WIDTH), count)))
    parts = []
    producer.start()
    while producer.is_alive() or waiting(shared):
        parts.append(drain(shared))
    producer.join()
    rows = np.concatenate(parts)
    np.testing.assert_array_equal(rows, np.repeat(np.arange(float(count))[:, None], WIDTH, axis=1))
    assert dropped(shared) == pushed[0]


@pytest.mark.trial
def test_every_lost_row_is_counted() -> None:
    """Rows read and rows dropped add up; rows read are whole and in order."""
    count, shared, pushed = 10_000_000, ring(1024, WIDTH), []
    producer = Thread(target=lambda: pushed.append(_try_all(shared, np.empty(WIDTH), count)))
    parts = []
    producer.start()
    while producer.is_alive() or waiting(shared):
        parts.append(drain(shared))
    rows = np.concatenate(parts)
    assert rows.shape[0] == pushed[0] == count - dropped(shared)
    assert np.all(rows == rows[:, :1])
    assert np.all(np.diff(rows[:, 0]) > 0)


@pytest.mark.parametrize(
    ("capacity", "width", "named"),
    [(0, 3, "capacity = 0"), (3, 0, "width = 0"), (2.5, 3, "capacity = 2.5")],
)
def test_a_ring_without_room_is_refused(capacity: Any, width: Any, named: str) -> None:
    """The message names the argument and its value."""
    with pytest.raises(ValueError, match=named):
        ring(capacity, width)
