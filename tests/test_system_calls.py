"""What a real-time loop asks of the operating system, and what it notes; the axes' last words of a cycle."""

from __future__ import annotations

import errno
import gc
import os
import sys
import warnings
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from quell.realtime import cycle, proxy, recordings, system, transports, wire
from quell.realtime.supervisor import Mode


def asked(priority: int, cpu: int | None, error: Any = None) -> tuple[list[str], list[Any]]:
    """Return the notes of ``enter_real_time``, and what was asked."""
    calls: list[Any] = []

    def affinity(process: int, cpus: set[int]) -> None:
        calls.append((process, cpus))
        if isinstance(error, OSError) and not isinstance(error, PermissionError):
            raise error

    def scheduler(process: int, policy: int, parameters: Any) -> None:
        calls.append((process, policy, parameters.sched_priority))
        if error is not None:
            raise error

    notes: list[str] = []
    with (
        patch.object(system.os, "sched_setaffinity", affinity, create=True),
        patch.object(system.os, "sched_setscheduler", scheduler, create=True),
    ):
        system.enter_real_time(priority, cpu, notes)
    return notes, calls


def test_priority_and_processor_of_a_loop_are_set_and_noted() -> None:
    """With what to do where they are not permitted."""
    assert asked(0, None) == (["ordinary scheduling, as asked for by priority 0"], [])
    assert asked(7, 2) == (
        ["the loop has processor 2", "scheduling is SCHED_FIFO with priority 7"],
        [(0, {2}), (0, os.SCHED_FIFO, 7)],
    )
    notes, _ = asked(7, None, PermissionError())
    assert notes == [
        "priority 7 is not permitted: other processes may delay the loop; run as root, or raise "
        "ulimit -r to 7"
    ]
    notes, _ = asked(7, 2, OSError("no such call"))
    assert notes == [
        "the loop has no processor of its own (no such call)",
        "priority 7 is not available (no such call): other processes may delay the loop",
    ]


def test_the_threads_beside_a_loop_have_the_lowest_priority() -> None:
    """Of real time where permitted, else an ordinary one."""
    calls: list[Any] = []

    def scheduler(process: int, policy: int, parameters: Any) -> None:
        if policy == os.SCHED_FIFO and refuses:
            raise PermissionError
        calls.append((process, policy, parameters.sched_priority))

    for real_time, refuses, now, expected in (  # noqa: B007
        (
            True,
            False,
            os.SCHED_FIFO,
            [(0, os.SCHED_FIFO, os.sched_get_priority_min(os.SCHED_FIFO))],
        ),
        (True, True, os.SCHED_FIFO, [(0, os.SCHED_OTHER, 0)]),
        (False, False, os.SCHED_FIFO, [(0, os.SCHED_OTHER, 0)]),
        (False, False, os.SCHED_OTHER, []),
    ):
        calls.clear()
        with (
            patch.object(system.os, "sched_setscheduler", scheduler, create=True),
            patch.object(
                system.os, "sched_getscheduler", lambda process, now=now: now, create=True
            ),
        ):
            system.set_low_priority(real_time)
        assert calls == expected


def test_processors_stay_awake_as_long_as_a_file_is_open(tmp_path: Path) -> None:
    """It has a latency of zero; without the right the note says what to do."""
    file, notes = tmp_path / "latency", list[str]()
    file.write_bytes(b"")
    with patch.object(system, "_LATENCY", str(file)):
        opened = system._stay_awake(notes)
        assert opened is not None
        os.close(opened)
        assert file.read_bytes() == bytes(4)
        assert notes == ["processors stay awake"]
        file.unlink()
        notes.clear()
        assert system._stay_awake(notes) is None
        assert notes == [
            f"processors may sleep deeply ({os.strerror(errno.ENOENT)}) and then wake later; run as "
            f"root, or make {file} writable"
        ]


@pytest.mark.parametrize("code", [0, -1])
def test_memory_is_locked_or_the_note_says_how(code: int) -> None:
    """All that is there and all that comes."""
    notes, given = list[str](), []

    def lock(which: int) -> int:
        given.append(which)
        return code

    with (
        patch.object(system, "_mlockall", lock),
        patch.object(system.ctypes, "get_errno", lambda: errno.ENOMEM),
    ):
        assert system._lock_memory(notes) == (code == 0)
    assert given == [3]
    locked = "memory is locked"
    not_locked = (
        f"memory is not locked ({os.strerror(errno.ENOMEM)}): a page that was swapped out may delay "
        "the loop; run as root or raise ulimit -l"
    )
    assert notes == [locked if code == 0 else not_locked]


def test_a_real_time_process_leaves_all_as_it_was() -> None:
    """Collector, switch interval, locked memory and the file of the processors."""
    was, done = (gc.isenabled(), sys.getswitchinterval()), list[Any]()
    frozen: list[str] = []
    gc.enable()
    with (
        patch.object(system, "_lock_memory", lambda notes: done.append("locked") or True),
        patch.object(system, "_stay_awake", lambda notes: 77),
        patch.object(system.os, "close", lambda file: done.append(file)),
        patch.object(system, "_munlockall", lambda: done.append("unlocked")),
        patch.object(system.gc, "freeze", lambda: frozen.append("frozen")),
        patch.object(system.gc, "unfreeze", lambda: frozen.append("free")),
    ):
        with system.real_time_process(5, True) as notes:
            assert not gc.isenabled()
            assert sys.getswitchinterval() == pytest.approx(1e-4)
            assert notes == []
            assert frozen == ["frozen"]
        assert frozen == ["frozen", "free"]
        assert done == ["locked", 77, "unlocked"]
        assert gc.isenabled()
        assert sys.getswitchinterval() == was[1]
        done.clear()
        with system.real_time_process(0, False):
            assert sys.getswitchinterval() == was[1]
        assert done == []
        gc.disable()
        with system.real_time_process(0, False):
            pass
        assert not gc.isenabled()
    if was[0]:
        gc.enable()


def test_priorities_and_processors_out_of_range_are_named() -> None:
    """0 to 99; a processor that the process may use."""
    assert [system.checked_priority(each) for each in (0, 99)] == [0, 99]
    for wrong in (-1, 100):
        with pytest.raises(
            ValueError, match=f"priority = {wrong}: must be a whole number from 0 to 99"
        ):
            system.checked_priority(wrong)
    assert system.checked_cpu(None) is None
    with patch.object(system.os, "sched_getaffinity", lambda process: {3, 1}, create=True):
        assert system.checked_cpu(3) == 3
        with pytest.raises(
            ValueError, match="cpu = 0: must be one of 1, 3, which this process may use"
        ):
            system.checked_cpu(0)


def test_a_virtual_clock_is_as_late_as_its_script() -> None:
    """The last entry holds for all later waits; time passes where it is told."""
    clock = system.virtual_clock([5, 0, 7])
    assert [system._virtual_wait(clock, deadline) for deadline in (100, 200, 300, 400)] == [
        105,
        200,
        307,
        407,
    ]
    assert system._virtual_wait(clock, 50) == 407
    clock.time[0] = 1000
    assert system._virtual_wait(clock, 50) == 1000
    assert system._virtual_now(clock) == 1000


def test_the_table_of_checksums_is_that_of_zlib() -> None:
    """Of CRC-32, byte by byte."""
    table = wire._crc_table()
    for byte in (0, 1, 128, 255):
        assert int(table[byte]) ^ 0xFFFFFFFF ^ (0xFFFFFFFF >> 8) == zlib.crc32(bytes([byte ^ 0xFF]))


def test_channels_that_a_device_does_not_show_are_no_numbers() -> None:
    """The others are those of its newest frames."""
    handle: Any = SimpleNamespace(queue=SimpleNamespace(shown=np.array([1.5, 2.5])))
    values = np.zeros(3)
    wire._read_channels(handle, values)
    assert values[:2].tolist() == [1.5, 2.5]
    assert np.isnan(values[2])


def test_axes_are_told_of_a_u_that_acts_in_place_of_theirs() -> None:
    """Only where it differs, and not once they are stopped; the log has it in any case."""
    told: list[Any] = []

    def run(acting: list[float], mode: Any = Mode.RUN, u: float = 0.0) -> np.ndarray:
        told.clear()
        row = np.zeros(40)
        at = recordings.R + 3 * 2
        row[at : at + 2] = [1.0, 2.0]
        own = SimpleNamespace(y=np.zeros(2), u=np.zeros(2), acting=np.zeros(2))
        memory = np.rec.fromrecords([(int(mode),)], names="mode")
        controller: Any = SimpleNamespace(
            log=SimpleNamespace(row=row, controller=at + 2), design="design", state="state",
            supervisor=SimpleNamespace(memory=memory, signals=own),
        )  # fmt: skip
        with (
            patch.object(
                cycle, "read_acting", lambda handle, into: into.__setitem__(slice(None), acting)
            ),
            patch.object(cycle, "set_applied_controls", lambda *given: told.append(given[:2])),
            patch.object(cycle, "write_applied", lambda *given: told.append(given[2].tolist())),
        ):
            cycle._finish_signals(controller, None, u)
        return row[at : at + 2]

    assert run([1.0, 2.0]).tolist() == [1.0, 2.0]
    assert told == []
    assert run([1.0, 2.5]).tolist() == [1.0, 2.5]
    assert told == [("design", "state"), [1.0, 2.5]]
    assert run([0.5, 2.0]).tolist() == [0.5, 2.0]
    assert told
    assert run([0.5, 2.0], Mode.STOPPED).tolist() == [0.5, 2.0]
    assert told == []
    assert run([0.5, 2.0], u=float("nan")).tolist() == [1.0, 2.0]


def port_of(error: Any = None, latency_error: Any = None) -> tuple[Any, list[Any]]:
    """Return what opens ports, and what was asked of it."""
    calls: list[Any] = []

    def low_latency(mode: bool) -> None:
        calls.append(mode)
        if latency_error is not None:
            raise latency_error

    def opened(path: str, baud: int, **options: Any) -> Any:
        calls.append((path, baud, options))
        if error is not None:
            raise error
        return SimpleNamespace(set_low_latency_mode=low_latency)

    return SimpleNamespace(Serial=opened), calls


def test_a_serial_port_is_opened_alone_without_waiting_and_with_low_latency() -> None:
    """A driver that has no such mode is taken as it is; why a port is not opened is said."""
    options = {"timeout": 0.0, "write_timeout": 0.0, "exclusive": True}
    for refused in (None, NotImplementedError(), OSError(), ValueError()):
        module, calls = port_of(latency_error=refused)
        with patch.object(transports, "import_extra", lambda *_, module=module: module):
            transports._opened("serial:/dev/a", "/dev/a", 115200)
        assert calls == [("/dev/a", 115200, options), True]
    for code, reason in (
        (errno.EACCES, "no permission: join the group dialout, or the group that owns the port"),
        (errno.EBUSY, "another program uses it"),
        (errno.EAGAIN, "another program uses it"),
    ):
        module, _ = port_of(OSError(code, "no"))
        with (
            patch.object(transports, "import_extra", lambda *_, module=module: module),
            pytest.raises(ValueError) as caught,
        ):
            transports._opened("serial:/dev/a", "/dev/a", 9600)
        assert str(caught.value) == f"device = 'serial:/dev/a': can't be opened ({reason})"
    module, _ = port_of(ValueError("no such rate"))
    with (
        patch.object(transports, "import_extra", lambda *_: module),
        pytest.raises(ValueError, match="can't be opened .no such rate.$"),
    ):
        transports._opened("serial:/dev/a", "/dev/a", 9601)
    with (
        patch.object(transports.sys, "platform", "win32"),
        pytest.raises(ValueError, match="need Linux"),
    ):
        transports._opened("serial:COM1", "COM1", 9600)


def test_a_rate_is_high_enough_for_a_frame_each_way() -> None:
    """Else it is refused, or u acts a sample later, which is said; both limits from both sides."""
    bits = transports.FRAME_BITS + 80
    baud = 100_000
    frame = bits / baud
    with pytest.raises(ValueError) as caught:
        transports._check_rate(baud, 0.99 * frame, 2)
    assert str(caught.value) == (
        f"dt = {0.99 * frame!r} s: a frame takes {frame * 1e3:.3g} ms at {baud} baud, which is longer "
        f"than a sample; give at least {bits / (0.99 * frame):.0f} baud, or dt from {frame:.3g} s on"
    )
    with pytest.warns(UserWarning, match=f"each way; that is longer than a sample: u acts a sample later than "
                                         f"it could; it does not from {2.0 * bits / (1.5 * frame):.0f} baud on"):  # fmt: skip
        transports._check_rate(baud, 1.5 * frame, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        transports._check_rate(baud, 2.0 * frame, 2)


def test_a_drive_behind_a_proxy_has_the_sample_time_of_its_compensator() -> None:
    """To rounding; another one is refused."""
    stands: Any = SimpleNamespace(
        compensator=SimpleNamespace(dt=0.01), _handle="h", _controller="c", _drive="d"
    )
    for dt in (0.01, 0.01 * (1.0 + 5e-10)):
        design = proxy.CompensatedDrive.sampled(stands, dt)
        assert (design[0], design[2], design[3]) == ("h", "c", "d")
    for dt in (0.02, 0.01 * (1.0 + 2e-9)):
        with pytest.raises(ValueError) as caught:
            proxy.CompensatedDrive.sampled(stands, dt)
        assert str(caught.value) == f"dt = {dt!r} s: must be the compensator's, 0.01 s"


def test_a_hello_for_several_signals_has_the_sample_time_and_zeros() -> None:
    """As many numbers as a frame of so many measurements."""
    out = wire.buffer(wire.MOST_SIGNALS)
    out.doubles[:] = 7.0
    wire.write_hello(out, 5, 9, 0.01, 3, 2)
    assert out.doubles[3:6].tolist() == [0.01, 0.0, 0.0]
