"""A ring buffer between the threads of loop and telemetry writer; neither of them waits.

One producer, one consumer, no lock (Lamport, "Specifying Concurrent Program Modules", ACM TOPLAS
5(2), 1983). ``HEAD`` counts the rows written, ``TAIL`` those read; each has one writer. The
producer writes a row and then, as a *release*, the new head; the consumer reads the head as an
*acquire* and finds the row complete. The tail keeps the producer off rows that are still being read
in the same way. If the ring is full, the newest row is dropped and counted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.kernels.dispatch import call_specialised, compiled, kernel
from quell.kernels.sized import Buffer
from quell.realtime.system.atomics import load_acquire, store_release
from quell.types import Matrix, Vector

# Indices of ``Ring.ends``, 16 words = 128 bytes apart: processors fetch cache lines of 64 bytes,
# some of them in pairs.
HEAD, TAIL, DROPPED = 0, 16, 32
_WORDS = 48


class Ring(NamedTuple):
    """Rows on their way from one thread to another."""

    rows: Buffer  #: (capacity, width); row number k is stored at k modulo capacity
    ends: NDArray[np.int64]  #: rows written (at ``HEAD``), read (``TAIL``), dropped (``DROPPED``)


def ring(capacity: int, width: int) -> Ring:
    """Return an empty ring for ``capacity`` rows of ``width`` values.

    All its memory is written once, so that no page is missing when the loop first uses it.
    """
    size = checks.whole("capacity", capacity, 1), checks.whole("width", width, 1)
    return Ring(np.full(size, np.nan), np.zeros(_WORDS, dtype=np.int64))


@kernel
def push(ring: Ring, row: Vector) -> bool:
    """Write a row, on the producer's thread, without waiting; return whether there was room."""
    rows, ends = ring.rows, ring.ends
    head = ends[HEAD]  # only this thread writes it
    if head - load_acquire(ends, TAIL) >= rows.shape[0]:
        store_release(ends, DROPPED, ends[DROPPED] + 1)
        return False
    index = head % rows.shape[0]
    for i in range(rows.shape[1]):
        rows[index, i] = row[i]
    store_release(ends, HEAD, head + 1)
    return True


def drain(ring: Ring) -> Matrix:
    """Remove all rows, on the consumer's thread, and return a copy (rows, width), oldest first."""
    out = np.empty((waiting(ring), ring.rows.shape[1]))
    call_specialised(_read_rows, ring, out)
    return out


def waiting(ring: Ring) -> int:
    """Return the number of rows in the ring; the producer may add more meanwhile."""
    return int(ring.ends[HEAD] - ring.ends[TAIL])


def dropped(ring: Ring) -> int:
    """Return how many rows were dropped because the ring was full."""
    return int(ring.ends[DROPPED])


@compiled
def _read_rows(ring: Ring, out: Matrix) -> None:
    """Move the oldest rows of the ring to ``out``."""
    rows, ends = ring.rows, ring.ends
    tail = ends[TAIL]
    count = min(out.shape[0], load_acquire(ends, HEAD) - tail)
    for k in range(count):
        index = (tail + k) % rows.shape[0]
        for i in range(rows.shape[1]):
            out[k, i] = rows[index, i]
    store_release(ends, TAIL, tail + count)
