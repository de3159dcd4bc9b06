"""Independent simulations on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any


def in_parallel(jobs: Iterable[Callable[[], Any]], tell: Callable[[float], None] | None = None) -> list[Any]:
    """Run jobs on all cores and return their results in order; compiled loops release the interpreter.

    ``tell`` is called with the share that is done. Where a job fails, or the run is interrupted, those not yet begun are dropped.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                if tell is not None:
                    tell(done / len(futures))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        return [future.result() for future in futures]
