"""Independent jobs on all cores.

The choice of an executor for independent tasks: threads, processes or a Dask cluster.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    as_completed,
    wait,
)
from contextlib import contextmanager
from functools import cache
from multiprocessing import get_context, parent_process
from multiprocessing.reduction import ForkingPickler
from typing import Any, TypeAlias, TypeVar
from urllib.parse import urlsplit

from quell import checks
from quell.checks import import_extra
from quell.types import DesignWarning

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


T = TypeVar("T")
Where: TypeAlias = Executor | str | None
"""Where tasks run, for ``executor_on``."""

_SCHEMES = ("tcp://", "tls://")
# A scheduler on the same network answers within milliseconds. Chosen by hand, so that a wrong
# address is reported soon.
_SECONDS_TO_ANSWER = 10
# Tasks that are handed to the executor before the first of them is done: more than any usual
# cluster has cores, few enough that their arguments fit into memory. Chosen by hand.
_TASKS_AHEAD = 1000


@contextmanager
def executor_on(where: Where = None, workers: int | None = None) -> Iterator[Executor]:
    """Yield an executor; at the end it is shut down, unless it was given.

    Parameters
    ----------
    where
        * None or ``"threads"``: threads of this process. Compiled loops release the interpreter
          lock, all else takes turns.
        * ``"processes"``: processes on this machine. Tasks must be picklable, and a script needs
          ``if __name__ == "__main__"``, because each process imports it.
        * ``"tcp://HOST:PORT"`` or ``"tls://…"``: the Dask cluster of the scheduler at this address
          (extra ``cluster``). Dask transports pickles: use only clusters that you trust.
        * an ``Executor`` of ``concurrent.futures``, such as ``Client.get_executor()`` of Dask.
    workers
        number of threads or processes; by default that of the machine's cores.

    Raises
    ------
    ValueError
        for anything else, a scheduler that does not answer, or ``workers`` for an executor that has
        its own.
    ImportError
        if Dask is needed and not installed.
    """
    own = where is None or where in ("threads", "processes")
    if workers is not None:
        checks.whole("workers", workers, 1)
        if not own:
            raise ValueError(f"workers = {workers}: an executor or a cluster has its own workers")
    if own:
        kind = _processes if where == "processes" else ThreadPoolExecutor
        # A limit that another thread than the main one sets does not hold in OpenBLAS 0.3.31:
        # threads that waited for each other took 1 to 5 ms for each matrix exponential.
        with one_blas_thread(), kind(workers or os.cpu_count() or 1) as executor:
            yield executor
    elif isinstance(where, str) and where.startswith(_SCHEMES):
        with _dask(where) as executor:
            yield executor
    elif isinstance(where, Executor):
        yield where
    else:
        rule = "must be threads, processes, the address tcp://HOST:PORT of a Dask scheduler, or "
        raise ValueError(f"executor = {where!r}: {rule}a concurrent.futures.Executor")


def completed(
    executor: Executor, function: Callable[[T], R], tasks: Iterable[T]
) -> Generator[tuple[T, R], None, None]:
    """Yield each task and ``function(task)``, in the order in which they are done.

    If a task raises an error, or the caller closes the generator, tasks that have not begun are
    dropped.

    Raises
    ------
    ChildProcessError
        if a worker ended, and its executor does not repeat its tasks; Dask does.
    """
    coming, pending = iter(tasks), dict[Future[R], T]()
    try:
        while True:
            for task in coming:
                pending[executor.submit(function, task)] = task
                if len(pending) >= _TASKS_AHEAD:
                    break
            if not pending:
                return
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                yield pending.pop(future), result_of(future)
    finally:
        for future in pending:
            future.cancel()


def result_of(future: Future[R]) -> R:
    """Return the result of a task; errors of its executor are one line.

    Raises
    ------
    ChildProcessError
        if a worker or the scheduler ended.
    """
    try:
        return future.result()
    except BrokenExecutor:
        why = "the machine may have too little memory for so many workers"
    except CancelledError:
        why = "the scheduler of the cluster does not answer any more"
    except Exception as error:
        if type(error).__name__ != "KilledWorker":  # Dask's, after four workers died at one task
            raise
        why = "it ended several workers of the cluster; they may have too little memory"
    raise ChildProcessError(f"a task could not be done: {why}")


def check_sendable(what: str, value: Any) -> None:
    """Raise a ``ValueError`` if ``value`` can't be sent to another process."""
    try:
        ForkingPickler.dumps(value)
    except Exception as error:  # it calls functions of the user's
        raise ValueError(
            f"executor = 'processes': {what} must be functions of a module that other "
            f"processes can import ({' '.join(str(error).split())}); or take executor='threads'"
        ) from None


def _processes(workers: int) -> ProcessPoolExecutor:
    # Spawned, not forked: a fork of a process with threads may wait for a lock forever.
    return ProcessPoolExecutor(workers, get_context("spawn"), _begin_worker)


def _begin_worker() -> None:
    """Prepare a worker process: Ctrl-C is for its parent, and it does not outlive its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore", DesignWarning)  # the status of the run says it
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _dask(address: str) -> Iterator[Executor]:
    distributed: Any = import_extra("distributed", "cluster", "a Dask cluster")
    try:
        _check_answers(address)
        client = distributed.Client(address, timeout=_SECONDS_TO_ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"dask = {address!r}: no scheduler answers there "
            f"({' '.join(str(error).split()) or type(error).__name__}); start one with "
            "`dask scheduler`, which prints its address"
        ) from None
    with client:
        # Not "pure": two tasks are never taken for the same one.
        yield client.get_executor(pure=False)


def _check_answers(address: str) -> None:
    """Raise an ``OSError`` or ``ValueError`` if nothing accepts connections at an address.

    Dask's client would report it later, and leave threads behind.
    """
    parts = urlsplit(address)
    if not parts.hostname or parts.port is None:
        raise ValueError("must be tcp://HOST:PORT")
    socket.create_connection((parts.hostname, parts.port), _SECONDS_TO_ANSWER).close()
