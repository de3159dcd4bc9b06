"""Clocks of the loop: the operating system's monotonic clock, and a virtual one for tests.

All times are integers in nanoseconds [ns]. A clock is a NamedTuple for which ``now`` and
``wait_until`` are registered.
"""

from __future__ import annotations

import sys
import time
from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload
from numpy.typing import ArrayLike, NDArray

from quell import checks
from quell.kernels.dispatch import generic, kernel
from quell.realtime.system.libc import external

# Constants of Linux: CLOCK_MONOTONIC and TIMER_ABSTIME of <time.h>, EINTR of <errno.h>.
_MONOTONIC = 1
_ABSOLUTE = 1
_INTERRUPTED = 4

_SECOND = 1_000_000_000

_clock_gettime = external("clock_gettime", "int", "int", "address")
_clock_nanosleep = external("clock_nanosleep", "int", "int", "int", "address", "address")


@generic
def now(clock: Any) -> int:
    """Return the time [ns] since the clock's own origin."""
    raise TypeError


@generic
def wait_until(clock: Any, deadline: int) -> int:
    """Wait until ``deadline`` [ns], not at all if it is past; return the time then [ns]."""
    raise TypeError


class SystemClock(NamedTuple):
    """The operating system's monotonic clock; ``system_clock`` makes it."""

    spin: int  #: time before a deadline from which on it polls the time instead of sleeping [ns]
    timespec: NDArray[np.int64]  #: work array: seconds and nanoseconds (2,)
    address: int  #: address of ``timespec``


def system_clock(spin: float = 0.0) -> SystemClock:
    """Return the system's clock, which polls for the last ``spin`` [s] before a deadline."""
    timespec = np.zeros(2, dtype=np.int64)
    nanoseconds = round(checks.non_negative("spin", spin, "s") * 1e9)
    return SystemClock(nanoseconds, timespec, timespec.ctypes.data)


def _read(clock: SystemClock) -> int:
    return time.monotonic_ns()


@overload(_read, strict=False)
def _compiled_read(clock: Any) -> Any:
    def read(clock: SystemClock) -> int:
        _clock_gettime(_MONOTONIC, clock.address)
        return clock.timespec[0] * _SECOND + clock.timespec[1]

    return read


def _sleep(clock: SystemClock, deadline: int) -> None:
    """Sleep until ``deadline``, which lies in the future."""
    if sys.platform == "linux":
        clock.timespec[0], clock.timespec[1] = divmod(deadline, _SECOND)
        while _clock_nanosleep(_MONOTONIC, _ABSOLUTE, clock.address, 0) == _INTERRUPTED:
            pass
    else:
        time.sleep(max(deadline - time.monotonic_ns(), 0) * 1e-9)


@overload(_sleep, strict=False)
def _compiled_sleep(clock: Any, deadline: Any) -> Any:
    def sleep(clock: SystemClock, deadline: int) -> None:
        clock.timespec[0] = deadline // _SECOND
        clock.timespec[1] = deadline % _SECOND
        while _clock_nanosleep(_MONOTONIC, _ABSOLUTE, clock.address, 0) == _INTERRUPTED:
            pass

    return sleep


@now.register(SystemClock)
def _now(clock: SystemClock) -> int:
    return _read(clock)


@wait_until.register(SystemClock)
def _wait_until(clock: SystemClock, deadline: int) -> int:
    time_now = _read(clock)
    if time_now < deadline - clock.spin:
        _sleep(clock, deadline - clock.spin)
        time_now = _read(clock)
    while time_now < deadline:
        time_now = _read(clock)
    return time_now


class VirtualClock(NamedTuple):
    """A clock for tests: time passes only while it waits, and each wait is as late as scripted."""

    time: NDArray[np.int64]  #: the time [ns], and the number of waits so far (2,)
    late: NDArray[np.int64]  #: lateness of each wait [ns]; the last entry holds for all later ones


def virtual_clock(late: ArrayLike = (0,)) -> VirtualClock:
    """Return a clock at zero whose k-th wait ends ``late[k]`` nanoseconds after its deadline."""
    return VirtualClock(np.zeros(2, dtype=np.int64), np.array(late, dtype=np.int64))


@now.register(VirtualClock)
def _virtual_now(clock: VirtualClock) -> int:
    return clock.time[0]


@wait_until.register(VirtualClock)
def _virtual_wait(clock: VirtualClock, deadline: int) -> int:
    k = min(clock.time[1], clock.late.size - 1)
    clock.time[0] = max(clock.time[0], deadline + clock.late[k])
    clock.time[1] += 1
    return clock.time[0]


@kernel
def pass_time(clock: VirtualClock, nanoseconds: int) -> None:
    """Advance a virtual clock."""
    clock.time[0] += nanoseconds
