"""A pytest plugin: all entry points run as plain Python, each test within a limit of CPU time.

    PYTHONPATH=benchmarks pytest -p interpret_all --cpu-limit 5

Tests of compilation itself fail under it. The mutation trial (``mutants.py``) uses it: nothing has
to be compiled for a mutant, and coverage sees the lines of the kernels.
"""

from __future__ import annotations

import contextlib
import functools
import signal
from collections.abc import Callable, Iterator
from types import FrameType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from quell.kernels import dispatch


class OutOfTime(BaseException):
    """A test has used its CPU time; no ``except Exception`` stops it."""


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
    """Interrupt a test that uses more CPU time than its limit, or ten times that in all."""
    with _limited(pyfuncitem.config):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(request: pytest.FixtureRequest) -> Iterator[None]:
    """Interrupt a fixture in the same way."""
    with _limited(request.config):
        return (yield)


@contextlib.contextmanager
def _limited(config: pytest.Config) -> Iterator[None]:
    # Only the tests' own code is interrupted: coverage holds locks, which would stay closed.
    def interrupt(number: int, frame: FrameType | None) -> None:
        while frame is not None:
            if "/coverage/" in frame.f_code.co_filename:
                signal.setitimer(signal.ITIMER_REAL, 0.01)
                return
            frame = frame.f_back
        raise OutOfTime

    dispatch.interpret_all = True  # for tests that are marked ``compiled``, too
    limit = config.getoption("--cpu-limit")
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
