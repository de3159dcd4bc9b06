"""The choice of an executor, and tasks on it."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from quell.parallel import completed, executor_on


def test_tasks_give_their_results_on_threads_and_on_a_given_executor() -> None:
    """A given executor is not shut down."""
    with executor_on() as threads:
        assert dict(completed(threads, abs, range(-5, 0))) == {-i: i for i in range(1, 6)}
    with ThreadPoolExecutor(1) as own:
        with executor_on(own) as same:
            assert same is own
        assert own.submit(abs, -1).result() == 1


def test_a_worker_process_that_is_killed_is_one_clear_error() -> None:
    """It is no error of the depths of the standard library."""
    with (
        executor_on("processes", workers=1) as processes,
        pytest.raises(
            ChildProcessError, match="a task could not be done: the machine may have too little"
        ),
    ):
        list(completed(processes, signal.raise_signal, [signal.SIGKILL]))


def test_tasks_that_have_not_begun_are_dropped_after_an_error() -> None:
    """The error is the task's own."""
    done: list[int] = []

    def task(i: int) -> None:
        done.append(i)
        if i == 0:
            raise ArithmeticError

    with executor_on(workers=1) as one, pytest.raises(ArithmeticError):
        list(completed(one, task, range(10_000)))
    assert len(done) < 10_000


@pytest.mark.parametrize("where", ["foo", 3, "http://127.0.0.1:80"])
def test_what_is_no_executor_is_named(where: object) -> None:
    """The error says what there is to choose from."""
    with pytest.raises(ValueError, match="must be threads, processes, the address tcp://"):  # noqa: SIM117
        with executor_on(where):  # type: ignore[arg-type]
            pass


def test_a_scheduler_that_does_not_answer_is_one_clear_error() -> None:
    """It names the address, and how to start a scheduler."""
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for address in (f"tcp://127.0.0.1:{port}", "tcp://127.0.0.1"):
        with pytest.raises(ValueError, match=f"dask = '{address}': no scheduler answers there"):  # noqa: SIM117
            with executor_on(address):
                pass


def test_an_executor_of_ones_own_has_its_own_workers() -> None:
    """The number of workers is for threads and processes."""
    with ThreadPoolExecutor(1) as own, pytest.raises(ValueError, match="workers = 2"):  # noqa: SIM117
        with executor_on(own, workers=2):
            pass


def test_worker_processes_end_with_a_parent_that_is_killed() -> None:
    """A parent that is killed can't tell them to end."""
    code = (
        "import os, time\n"
        "from quell.parallel import executor_on\n"
        "if __name__ == '__main__':\n"
        "    with executor_on('processes', workers=1) as one:\n"
        "        print(one.submit(os.getpid).result(), flush=True)\n"
        "        one.submit(time.sleep, 60.0).result()\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    os.kill(worker, 0)
    parent.kill()
    parent.wait()
    # The worker has the same output: it ends when both have ended.
    ended, _, _ = select.select([parent.stdout], [], [], 30.0)
    assert ended, "the worker is still there"
    assert parent.stdout.read() == ""
    parent.stdout.close()
