"""What keeps the loop's thread from being made to wait: priority, a processor of its own, memory that stays, processors that do not sleep.

Each is tried; what is refused is said in a sentence, and the run goes on without it.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from quell import checks
from quell.realtime.system.libc import external

_CURRENT_AND_FUTURE = 3
_LATENCY = "/dev/cpu_dma_latency"
# An interpreted loop gets the interpreter back after so long [s].
_SWITCH = 1e-4

_mlockall = external("mlockall", "int", "int")
_munlockall = external("munlockall", "int")


def checked_priority(priority: int) -> int:
    """Return a priority of 0 (ordinary) or 1 to 99 (real time)."""
    return checks.whole("priority", priority, 0, 99)


def checked_cpu(cpu: int | None) -> int | None:
    """Return the number of a processor that this process may use, or None."""
    if cpu is None:
        return None
    number = checks.whole("cpu", cpu, 0)
    allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if number not in allowed:
        raise ValueError(
            f"cpu = {cpu!r}: must be one of {', '.join(map(str, allowed))}, which this process may use"
        )
    return number


@contextmanager
def real_time_process(priority: int, interpreted: bool) -> Iterator[list[str]]:
    """Around the loop, in the main thread: lock the memory, keep processors awake and the garbage collector out.

    Yields a list for what is to be told.

    With a priority of 0 nothing but the collector is touched.
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
        refused = _mlockall(_CURRENT_AND_FUTURE) != 0
        reason = os.strerror(ctypes.get_errno())
    except OSError as error:
        refused, reason = True, str(error)
    if refused:
        notes.append(
            f"memory is not locked ({reason}): a page that was swapped out may hold the loop up; run as root or raise ulimit -l"
        )
    else:
        notes.append("memory is locked")
    return not refused


def _stay_awake(notes: list[str]) -> int | None:
    """Ask that no processor goes to a sleep from which it takes time to wake, as long as the file that is returned is open.

    See the Linux kernel's *PM Quality Of Service Interface*: the file takes the longest latency that is tolerated [µs].
    """
    try:
        file = os.open(_LATENCY, os.O_WRONLY)
        os.write(file, (0).to_bytes(4, sys.byteorder))
    except OSError as error:
        notes.append(
            f"processors may sleep deeply ({error.strerror}): they wake later; run as root, or make {_LATENCY} writable"
        )
        return None
    notes.append("processors stay awake")
    return file


def enter_real_time(priority: int, cpu: int | None, notes: list[str]) -> None:
    """Give the calling thread its priority and its processor; it keeps them until it ends."""
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
            f"priority {priority} is not permitted: others may hold the loop up; run as root, or raise ulimit -r to {priority}"
        )
    except (OSError, AttributeError) as error:
        notes.append(f"priority {priority} could not be had ({error}): others may hold the loop up")
