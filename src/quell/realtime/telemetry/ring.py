"""A ring between the loop and whoever records it: rows go in on one thread and come out on another, and neither waits.

One producer, one consumer, no lock (Lamport, "Specifying Concurrent Program Modules", ACM TOPLAS 5(2), 1983). ``head`` counts the rows that
went in, ``tail`` those that came out; each is written by one side only. The producer writes a row and then, as a *release*, the new head;
the consumer reads the head as an *acquire* and finds the row whole. The same the other way round keeps the producer off rows that are still
being read. Where the ring is full, the newest row is dropped and counted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.kernels.dispatch import compiled, kernel
from quell.realtime.system.atomics import load_acquire, store_release
from quell.types import Matrix, Vector

# Sixteen words apart: no two of them on one cache line, nor on the pair of lines that processors fetch together.
HEAD, TAIL, DROPPED = 0, 16, 32
_WORDS = 48

IntVector = NDArray[np.int64]


class Ring(NamedTuple):
    """Rows on their way from one thread to another."""

    rows: Matrix
    """(capacity, width); row number k lies at k modulo capacity."""
    ends: IntVector
    """At ``HEAD`` how many rows went in, at ``TAIL`` how many came out, at ``DROPPED`` how many found no place."""


def ring(capacity: int, width: int) -> Ring:
    """Return an empty ring for ``capacity`` rows of ``width`` numbers.

    Its memory is touched once, so that the first round is as quick as the others.

    Raises
    ------
    ValueError
        for a capacity or a width below one.
    """
    size = checks.whole("capacity", capacity, 1), checks.whole("width", width, 1)
    return Ring(np.full(size, np.nan), np.zeros(_WORDS, dtype=np.int64))


@kernel
def push(ring: Ring, row: Vector) -> bool:
    """Put a row in, on the producer's thread; return whether there was room. It neither waits nor allocates."""
    rows, ends = ring.rows, ring.ends
    head = ends[HEAD]  # nobody else writes it
    if head - load_acquire(ends, TAIL) >= rows.shape[0]:
        store_release(ends, DROPPED, ends[DROPPED] + 1)
        return False
    place = head % rows.shape[0]
    for i in range(rows.shape[1]):
        rows[place, i] = row[i]
    store_release(ends, HEAD, head + 1)
    return True


def drain(ring: Ring) -> Matrix:
    """Take all rows out that are in, on the consumer's thread: a copy (rows, width), oldest first."""
    out = np.empty((waiting(ring), ring.rows.shape[1]))
    _take(ring, out)
    return out


def waiting(ring: Ring) -> int:
    """Return how many rows are in; there may be more a moment later."""
    return int(ring.ends[HEAD] - ring.ends[TAIL])


def dropped(ring: Ring) -> int:
    """Return how many rows found the ring full."""
    return int(ring.ends[DROPPED])


@compiled
def _take(ring: Ring, out: Matrix) -> None:
    """Take ``out``'s number of rows out of the ring; they must be in."""
    rows, ends = ring.rows, ring.ends
    tail = ends[TAIL]
    count = min(out.shape[0], load_acquire(ends, HEAD) - tail)
    for k in range(count):
        place = (tail + k) % rows.shape[0]
        for i in range(rows.shape[1]):
            out[k, i] = rows[place, i]
    store_release(ends, TAIL, tail + count)
