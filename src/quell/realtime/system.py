"""The operating system: clocks, scheduling, signals, atomic words, histograms of durations.

Atomic loads and stores of int64 words that two threads or two processes share.

The writer stores data first and then, as a *release*, a word that announces it. A reader that loads
this word as an *acquire* and finds the new value also finds the data.

Clocks of the loop: the operating system's monotonic clock, and a virtual one for tests.

All times are integers in nanoseconds [ns]. A clock is a NamedTuple for which ``now`` and
``wait_until`` are registered.

Functions of the C library, called from Python and from compiled code alike.

Compiled code refers to them by name, so that it can be cached on disk; Python calls them through
``ctypes``. Pointers are passed as addresses: ``array.ctypes.data`` of an array that lives at least
as long as the call.

Scheduling of the loop: priority, processor, locked memory, no deep sleep of processors.

What the system refuses is noted in a sentence, and the run goes on without it.

Histograms of durations, which the loop fills without allocating memory.

The width of the bins grows with the duration, as in Gil Tene's HdrHistogram: each power of two is
divided into 32 bins, so that a bin is at most 3.1 % wide. Up to 64 ns a bin is 1 ns wide. The
longest duration is stored exactly.
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
from numba import types as nb_types
from numba.extending import intrinsic, overload
from numpy.typing import ArrayLike, NDArray

from quell import checks
from quell.kernels.dispatch import generic, kernel
from quell.kernels.numba_internals import get_item_pointer
from quell.types import Vector

# ---- Atomic loads and stores of int64 words that two threads or two processes share ----


def load_acquire(words: NDArray[np.int64], index: int) -> int:
    """Read ``words[index]``, which another thread writes with ``store_release``.

    Interpreted it is a plain read: there the interpreter's lock keeps the order.
    """
    return int(words[index])


def store_release(words: NDArray[np.int64], index: int, value: int) -> None:
    """Write ``words[index]``, which another thread reads with ``load_acquire``."""
    words[index] = value


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return get_item_pointer(
        context, builder, kind, context.make_array(kind)(context, builder, array), [index]
    )


@intrinsic
def _load_acquire(typing_context: Any, words: Any, index: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        word = _address(context, builder, signature.args[0], values[0], values[1])
        return builder.load_atomic(word, "acquire", align=8)

    return nb_types.int64(words, nb_types.int64), generate


@intrinsic
def _store_release(typing_context: Any, words: Any, index: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        word = _address(context, builder, signature.args[0], values[0], values[1])
        builder.store_atomic(values[2], word, "release", align=8)
        return context.get_dummy_value()

    return nb_types.void(words, nb_types.int64, nb_types.int64), generate


@overload(load_acquire, strict=False)
def _compiled_load(words: Any, index: Any) -> Any:
    return lambda words, index: _load_acquire(words, index)


@overload(store_release, strict=False)
def _compiled_store(words: Any, index: Any, value: Any) -> Any:
    return lambda words, index, value: _store_release(words, index, value)


# ---- Handling of the signals that end programs ----


@contextmanager
def termination_handler(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Call ``handler`` on Ctrl-C, SIGTERM, and SIGHUP unless that is ignored (nohup).

    Use it in the main thread only. At the end the previous handlers are restored.
    """
    numbers = [signal.SIGINT, signal.SIGTERM]
    hang_up = getattr(signal, "SIGHUP", None)
    if hang_up is not None and signal.getsignal(hang_up) is not signal.SIG_IGN:
        numbers.append(hang_up)
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in previous.items():
            with suppress(TypeError):  # a handler that Python did not install is None here
                signal.signal(number, old)


# ---- Functions of the C library, called from Python and from compiled code alike ----

_KINDS = {
    "int": (ctypes.c_int, nb_types.int32),
    "long": (ctypes.c_int64, nb_types.int64),
    "address": (ctypes.c_void_p, nb_types.uintp),
}


def external(name: str, returns: str, *arguments: str) -> Callable[..., int]:
    """Return the C library's function ``name``; a call raises an ``OSError`` if there is none.

    The types of the arguments and of the result are ``"int"``, ``"long"`` or ``"address"``.
    """

    @cache
    def found() -> Any:
        try:
            function = getattr(ctypes.CDLL(None, use_errno=True), name)
        except (AttributeError, TypeError):
            raise OSError(
                f"{name}: the C library has no such function; the real-time loop needs Linux"
            ) from None
        function.restype = _KINDS[returns][0]
        function.argtypes = [_KINDS[argument][0] for argument in arguments]
        return function

    def call(*values: int) -> int:
        return int(found()(*values))

    symbol = nb_types.ExternalFunction(
        name, _KINDS[returns][1](*[_KINDS[argument][1] for argument in arguments])
    )

    @overload(call, strict=False)
    def _compiled(*values: Any) -> Any:
        return lambda *values: symbol(*values)

    return call


# ---- Clocks of the loop ----

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


# ---- Scheduling of the loop ----

# MCL_CURRENT | MCL_FUTURE of <sys/mman.h> on Linux.
_CURRENT_AND_FUTURE = 3
_LATENCY = "/dev/cpu_dma_latency"
# Python's switch interval while the loop is interpreted [s]: as long as a burst of the telemetry
# writer. CPython's default, 5 ms, is five cycles at 1 kHz.
_SWITCH = 1e-4

_mlockall = external("mlockall", "int", "int")
_munlockall = external("munlockall", "int")


def checked_priority(priority: int) -> int:
    """Return a priority of 0 (ordinary) or 1 to 99 (SCHED_FIFO)."""
    return checks.whole("priority", priority, 0, 99)


def checked_cpu(cpu: int | None) -> int | None:
    """Return the number of a processor that this process may use, or None."""
    if cpu is None:
        return None
    number = checks.whole("cpu", cpu, 0)
    allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if number not in allowed:
        choice = ", ".join(map(str, allowed))
        raise ValueError(f"cpu = {cpu!r}: must be one of {choice}, which this process may use")
    return number


@contextmanager
def real_time_process(priority: int, interpreted: bool) -> Iterator[list[str]]:
    """Lock the memory, keep processors awake and the garbage collector off; for the main thread.

    Yield notes on what the system permitted. A priority of 0 touches only the collector.
    """
    notes: list[str] = []
    collecting, interval = gc.isenabled(), sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    gc.disable()
    if interpreted:
        sys.setswitchinterval(_SWITCH)
    locked = priority > 0 and _lock_memory(notes)
    awake = _stay_awake(notes) if priority > 0 else None
    try:
        yield notes
    finally:
        if awake is not None:
            os.close(awake)
        if locked:
            _munlockall()
        sys.setswitchinterval(interval)
        gc.unfreeze()
        if collecting:
            gc.enable()


def _lock_memory(notes: list[str]) -> bool:
    try:
        locked = _mlockall(_CURRENT_AND_FUTURE) == 0
        reason = os.strerror(ctypes.get_errno())
    except OSError as error:
        locked, reason = False, str(error)
    notes.append(
        "memory is locked"
        if locked
        else f"memory is not locked ({reason}): a page that was swapped out may delay the loop; "
        "run as root or raise ulimit -l"
    )
    return locked


def _stay_awake(notes: list[str]) -> int | None:
    """Forbid the processors deep sleep as long as the returned file is open.

    See the Linux kernel's *PM Quality Of Service Interface*: the file takes the largest tolerated
    latency [µs].
    """
    try:
        file = os.open(_LATENCY, os.O_WRONLY)
        os.write(file, (0).to_bytes(4, sys.byteorder))
    except OSError as error:
        notes.append(
            f"processors may sleep deeply ({error.strerror}) and then wake later; "
            f"run as root, or make {_LATENCY} writable"
        )
        return None
    notes.append("processors stay awake")
    return file


def enter_real_time(priority: int, cpu: int | None, notes: list[str]) -> None:
    """Set priority and processor of the calling thread until it ends."""
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
            notes.append(f"the loop has processor {cpu}")
        except (OSError, AttributeError) as error:
            notes.append(f"the loop has no processor of its own ({error})")
    if priority == 0:
        notes.append("ordinary scheduling, as asked for by priority 0")
        return
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        notes.append(f"scheduling is SCHED_FIFO with priority {priority}")
    except PermissionError:
        notes.append(
            f"priority {priority} is not permitted: other processes may delay the loop; "
            f"run as root, or raise ulimit -r to {priority}"
        )
    except (OSError, AttributeError) as error:
        notes.append(
            f"priority {priority} is not available ({error}): other processes may delay the loop"
        )


def set_low_priority(real_time: bool) -> None:
    """Set this thread to the lowest priority of SCHED_FIFO if permitted, or to an ordinary one."""
    if not hasattr(os, "sched_setscheduler"):
        return
    if real_time:
        with suppress(OSError):
            lowest = os.sched_param(os.sched_get_priority_min(os.SCHED_FIFO))
            os.sched_setscheduler(0, os.SCHED_FIFO, lowest)
            return
    if os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


# ---- Histograms of durations, which the loop fills without allocating memory ----

# Bins per power of two; a percentile is rounded by at most 1/32 = 3.1 %. Chosen by hand.
_PARTS = 32
# Below this duration [ns] a bin is 1 ns wide.
_LINEAR = 2 * _PARTS
# Powers of two above that: up to 2^44 ns, which is 4.9 hours.
_OCTAVES = 38
BINS = _LINEAR + _PARTS * _OCTAVES
# The entry after the bins is the longest duration.
LONGEST = BINS

# Width of the longest bar in text, in characters: a line then fits into 80 columns.
_BAR = 48


def empty_counts() -> NDArray[np.int64]:
    """Return the counts of an empty histogram (BINS + 1,), for ``count_duration``."""
    return np.zeros(BINS + 1, dtype=np.int64)


@kernel
def count_duration(counts: NDArray[np.int64], nanoseconds: int) -> None:
    """Add a duration [ns] to a histogram."""
    size, index = max(nanoseconds, 0), 0
    while size >= _LINEAR:
        size >>= 1
        index += _PARTS
    counts[min(index + size, BINS - 1)] += 1
    if nanoseconds > counts[LONGEST]:
        counts[LONGEST] = nanoseconds


def _edges() -> Vector:
    """Return the upper edges of the bins [s]."""
    first = np.arange(1, _LINEAR + 1, dtype=np.float64)
    upper = np.arange(_PARTS, 2 * _PARTS) + 1.0
    rest = [upper * 2.0**octave for octave in range(1, _OCTAVES + 1)]
    return np.concatenate([first, *rest]) * 1e-9


def _scale(total: int) -> str:
    """Return marks below logarithmic bars: 1, 10, 100, …, at the ends of bars of as many."""
    line = ""
    for power in range(int(math.log10(total)) + 1):
        at = math.ceil(_BAR * math.log1p(10**power) / math.log1p(total)) - 1
        if at >= len(line) + (power > 0):  # else there is no room for it
            line = f"{line:<{at}}|{10**power}"
    return line


@dataclass(frozen=True, eq=False)
class Histogram:
    """Durations of many cycles."""

    counts: NDArray[np.int64]  #: number of durations in each bin (bins,)
    edges: Vector  #: upper edge of each bin [s] (bins,)
    max: float  #: longest duration [s]; NaN for an empty histogram

    @classmethod
    def of(cls, counts: NDArray[np.int64]) -> Histogram:
        """Return the histogram of what ``count_duration`` counted."""
        bins = counts[:BINS].copy()
        return cls(bins, _edges(), float(counts[LONGEST]) * 1e-9 if bins.any() else math.nan)

    def __len__(self) -> int:
        """Return the number of durations."""
        return int(self.counts.sum())

    def percentile(self, percent: float) -> float:
        """Return a percentile [s], rounded up by at most 3.1 %; NaN for an empty histogram."""
        if not 0.0 < checks.finite("percent", percent) <= 100.0:
            raise ValueError(f"percent = {percent!r}: must be above 0 and at most 100")
        if not len(self):
            return math.nan
        rank = math.ceil(round(percent / 100.0 * len(self), 6))
        return min(float(self.edges[np.searchsorted(np.cumsum(self.counts), rank)]), self.max)

    @property
    def p50(self) -> float:
        """Median [s]."""
        return self.percentile(50.0)

    @property
    def p99(self) -> float:
        """99th percentile [s]."""
        return self.percentile(99.0)

    @property
    def p999(self) -> float:
        """99.9th percentile [s]."""
        return self.percentile(99.9)

    def summary(self) -> dict[str, float]:
        """Return p50, p99, p99.9 and the longest duration [s]."""
        return {"p50": self.p50, "p99": self.p99, "p99.9": self.p999, "max": self.max}

    def text(self, title: str = "") -> str:
        """Return the histogram as text, a line for each quarter of a decade."""
        head = ", ".join(f"{name} {1e6 * value:.3g} µs" for name, value in self.summary().items())
        lines = [f"{title + ': ' if title else ''}{head} of {len(self)}"]
        if not len(self):
            return lines[0]
        filled = np.flatnonzero(self.counts)
        step = np.floor(4.0 * np.log10(self.edges) - 1e-9).astype(int)
        for part in range(step[filled[0]], step[filled[-1]] + 1):
            inside = int(self.counts[step == part].sum())
            bar = "#" * math.ceil(_BAR * math.log1p(inside) / math.log1p(len(self)))
            lines.append(f"  up to {1e6 * 10 ** ((part + 1) / 4):9.3g} µs {inside:9d} {bar}")
        return "\n".join([*lines, f"{'number:':>30} {_scale(len(self))}"])

    def plot(self, ax: Any = None, label: str | None = None) -> Any:
        """Plot the share of cycles that took longer than a duration, both logarithmic.

        Return the matplotlib axes, by default of a new figure; ``label`` is for the legend.
        """
        if ax is None:
            import matplotlib.pyplot as plt

            _, ax = plt.subplots()
        longer = len(self) - np.cumsum(self.counts)
        first = max(int(np.argmax(self.counts > 0)) - 1, 0)
        shown = slice(first, int(np.searchsorted(-longer, 0)) + 1)
        share = np.maximum(longer[shown], 0.5) / max(len(self), 1)
        ax.loglog(1e6 * self.edges[shown], share, drawstyle="steps-post", label=label)
        ax.set(xlabel="duration [µs]", ylabel="share of cycles that took longer")
        ax.grid(True, which="both", alpha=0.3)
        return ax


@dataclass(frozen=True, eq=False)
class Timing:
    """Punctuality of a run."""

    lateness: Histogram  #: time from a deadline until the loop woke
    step: Histogram  #: time from then until u was written, without waiting for the device

    def text(self) -> str:
        """Return both histograms as text."""
        return f"{self.lateness.text('lateness')}\n{self.step.text('step time')}"

    def plot(self, ax: Any = None) -> Any:
        """Plot both histograms and return the axes."""
        ax = self.step.plot(self.lateness.plot(ax, "lateness"), "step time")
        ax.legend()
        return ax
