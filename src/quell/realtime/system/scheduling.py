"""Scheduling of the loop: priority, processor, locked memory, no deep sleep of processors.

What the system refuses is noted in a sentence, and the run goes on without it.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from quell import checks
from quell.realtime.system.libc import external

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
