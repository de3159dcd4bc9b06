"""A pytest plugin: all entry points run as plain Python, each test within a limit of CPU time.

    PYTHONPATH=benchmarks pytest -p interpret_all --cpu-limit 5

Tests of compilation itself fail under it. The mutation trial (``mutants.py``) uses it: nothing has
to be compiled for a mutant, and coverage sees the lines of the kernels.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import time
from collections.abc import Callable, Iterator
from types import FrameType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from waiting import waited

from quell.kernels import dispatch


class OutOfTime(BaseException):
    """A test has used its time; no ``except Exception`` stops it."""


def _plain(function: Callable[..., Any], **options: Any) -> Any:
    @functools.wraps(function)
    def entry(*args: Any) -> Any:
        with np.errstate(all="ignore"):  # compiled code does not warn
            return function(*args)

    vars(entry).update(py_func=function, plain=entry, uncached=entry, overloads={})
    vars(entry).update(stats=SimpleNamespace(cache_misses={}))
    return entry


dispatch._dispatcher = _plain  # for tests that call an entry point directly


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option ``--cpu-limit``."""
    parser.addoption("--cpu-limit", type=float, default=5.0, help="CPU time of a test [s]")


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Iterator[None]:
    """Interrupt a test that uses more CPU time than its limit, or ten times that in all.

    The time in which it waits for a core does not count.
    """
    with _limited(pyfuncitem.config):
        return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    """Look at the CPU clock."""
    _began[0] = _cpu_time()
    return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Report the CPU time of a test and its fixtures, the processes that it ran included."""
    try:
        return (yield)
    finally:
        item.user_properties.append(("cpu", _cpu_time() - _began[0]))


_began = [0.0]


def _cpu_time() -> float:
    return sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(request: pytest.FixtureRequest) -> Iterator[None]:
    """Interrupt a fixture in the same way."""
    with _limited(request.config):
        return (yield)


@contextlib.contextmanager
def _limited(config: pytest.Config) -> Iterator[None]:
    limit = config.getoption("--cpu-limit")
    began, delayed = time.monotonic(), waited()

    # Only the tests' own code is interrupted: coverage holds locks, which would stay closed.
    def interrupt(number: int, frame: FrameType | None) -> None:
        own = time.monotonic() - began - (waited() - delayed)
        if number == signal.SIGALRM and own < 10.0 * limit:
            signal.setitimer(signal.ITIMER_REAL, max(10.0 * limit - own, 0.01))
            return
        while frame is not None:
            if "/coverage/" in frame.f_code.co_filename:
                signal.setitimer(signal.ITIMER_REAL, 0.01)
                return
            frame = frame.f_back
        raise OutOfTime("it waits" if number == signal.SIGALRM else "it computes")

    dispatch.interpret_all = True  # for tests that are marked ``compiled``, too
    for number, timer, seconds in (
        (signal.SIGVTALRM, signal.ITIMER_VIRTUAL, limit),
        (signal.SIGALRM, signal.ITIMER_REAL, 10.0 * limit),  # for a test that waits for ever
    ):
        signal.signal(number, interrupt)
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
