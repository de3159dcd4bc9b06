"""Independent simulations on all cores."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from functools import cache
from typing import Any

_LIMITING = threading.Lock()


def in_parallel(
    jobs: Iterable[Callable[[], Any]],
    progress: Callable[[float], None] | None = None,
    workers: int | None = None,
) -> list[Any]:
    """Run jobs on all cores, or in so many threads, and return their results in order; compiled loops release the interpreter.

    ``progress`` is called with the share that is done. Where a job fails, or the run is
    interrupted, those not yet begun are dropped.
    """
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                if progress is not None:
                    progress(done / len(futures))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        return [future.result() for future in futures]


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Around many operations on small matrices: keep BLAS from starting threads for them.

    OpenBLAS splits even the solution of seven equations between its threads, and where another
    program has a core, each call then waits for the operating system: ten milliseconds instead of
    ten microseconds.
    """
    # What is set holds for the whole process, so two at a time could restore each other's setting.
    with _LIMITING, _blas().limit(limits=1, user_api="blas"):
        yield


@cache
def _blas() -> Any:
    import scipy.linalg  # noqa: F401  only libraries that are loaded are found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
