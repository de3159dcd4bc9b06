"""Independent jobs on all cores."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar

R = TypeVar("R")
_BLAS_LOCK = threading.Lock()
_BLAS_LIMITS: list[Any] = []  # the first block's setting, and None for each further block


def in_parallel(
    jobs: Iterable[Callable[[], R]],
    progress: Callable[[float], None] | None = None,
    workers: int | None = None,
) -> list[R]:
    """Run jobs in ``workers`` threads, by default one a core; return their results in order.

    Compiled loops release the interpreter lock. ``progress`` is called with the share done. If a
    job fails or the run is interrupted, jobs that have not begun are dropped.
    """
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                if progress is not None:
                    progress(done / len(futures))
        except BaseException as error:
            pool.shutdown(cancel_futures=True)
            if isinstance(error, Exception):
                for future in futures:  # of several errors the first job's, whichever came first
                    if not future.cancelled():
                        future.result()
            raise
        return [future.result() for future in futures]


def part_of(
    progress: Callable[[float], None] | None, first: float, last: float, total: float
) -> Callable[[float], None] | None:
    """Return a callback for the share done of the part from ``first`` to ``last`` of ``total``."""
    if progress is None:
        return None
    return lambda share: progress((first + share * (last - first)) / total)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Make BLAS use one thread, for many operations on small matrices.

    OpenBLAS divides even the solution of seven equations among its threads. If another program uses
    a core, each call then waits for the operating system: ten milliseconds, not ten microseconds.
    Blocks may be nested, and in several threads.
    """
    # The setting holds for the whole process: the first block makes it, the last one restores it.
    with _BLAS_LOCK:
        first = not _BLAS_LIMITS
        _BLAS_LIMITS.append(_controlled().limit(limits=1, user_api="blas") if first else None)
    try:
        yield
    finally:
        with _BLAS_LOCK:
            limit = _BLAS_LIMITS.pop()
            if limit is not None:
                _controlled()
                limit.restore_original_limits()


def _controlled() -> Any:
    """Return the controller of the BLAS libraries, which the present thread may set from now on.

    threadpoolctl 3.8 lets only the thread that was the first to set OpenBLAS do it again, and
    ignores all others without a word. Here the lock, held by the caller, keeps them apart.
    """
    for library in _blas().lib_controllers:
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)
    return _blas()


@cache
def _blas() -> Any:
    import scipy.linalg  # noqa: F401  only libraries that are loaded are found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
