"""Faults of frames by a plan."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from quell.realtime import wire, wire_device

from .benchmark_module import benchmark
from .cases import cases
from .rig_bench import DT, Bench, packed

faults = benchmark("frame_faults")
KINDS, Fault, FaultInjector = faults.KINDS, faults.Fault, faults.FaultInjector
Relay, random_faults = faults.Relay, faults.random_faults


@cases(
    ("fault", "expected"),
    [
        (Fault("drop", "rig", 1, 2), [1, 4, 5, 6]),
        (Fault("burst", "rig", 1, 2), [1, 2, 3, 4, 5, 6]),
        (Fault("duplicate", "rig", 1, 2), [1, 2, 2, 3, 3, 4, 5, 6]),
        (Fault("delay", "rig", 1, 1, late=2), [1, 3, 4, 2, 5, 6]),
        (Fault("drop", "loop", 1, 2), [1, 2, 3, 4, 5, 6]),
    ],
)
def test_a_fault_does_what_its_name_says(fault: Any, expected: list[int]) -> None:
    """Frames one to six go in; hello passes, and is not counted."""
    spoiler = FaultInjector([fault], "rig")
    assert spoiler.frames(packed(wire.HELLO, 0, 0, DT)) == [packed(wire.HELLO, 0, 0, DT)]
    out = [frame for k in range(1, 7) for frame in spoiler.frames(packed(wire.COMMAND, k, k, 0.0))]
    assert [struct.unpack_from("<I", frame, 8)[0] for frame in out] == expected


@cases(
    ("kind", "rule"),
    [
        ("nan", "not_finite"),
        ("flip", "malformed"),
        ("short", "malformed"),
        ("long", "malformed"),
        ("foreign", "session"),
        ("version", "version"),
    ],
)
def test_spoiled_frames_break_the_rule_they_are_meant_to(kind: str, rule: str) -> None:
    """Each time."""
    spoiler = FaultInjector([Fault(kind, "rig", 0, 50)], "rig")
    own = wire.endpoint(wire.COMMAND, 0x5EED0001, 20)
    for k in range(1, 51):
        (data,) = spoiler.frames(packed(wire.COMMAND, k, 0, 1.0))
        frame = wire.buffer()
        frame.bytes[: len(data)] = np.frombuffer(data[:48], dtype=np.uint8)[: frame.bytes.size]
        if wire.is_well_formed(frame, min(len(data), 48), own.counters):
            wire.accept(frame, own)
    assert wire.counts_by_name(own.counters)[rule] == 50


def test_random_plans_have_all_kinds_and_are_the_same_again() -> None:
    """For a seed."""
    plan = random_faults(300, 10_000, seed=4)
    assert plan == random_faults(300, 10_000, seed=4)
    assert plan != random_faults(300, 10_000, seed=5)
    assert {fault.kind for fault in plan} == set(KINDS)


def test_through_a_relay_every_fault_is_counted_and_no_wrong_number_gets_through(
    bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both ways: lost frames are missed, corrupted ones refused; the rig applies commands only."""
    here = bench("udp", watchdog=30)
    plan = [
        Fault("nan", "rig", 10, 2),
        Fault("flip", "rig", 20, 3),
        Fault("duplicate", "rig", 30, 4),
        Fault("delay", "rig", 40, 1),
        Fault("foreign", "loop", 45, 1),
        Fault("drop", "loop", 50, 2),
        Fault("short", "loop", 60, 1),
    ]
    with Relay("udp://127.0.0.1:0", here.url, plan) as relay:
        device = here.open(relay.url)
        monkeypatch.setattr(wire_device, "_MOST_AGE", 10)  # how long it waits for a lost frame
        sent, applied = {0.0}, set()
        for k in range(100):
            here.rig.tick()
            applied.add(here.applied)
            y = device.read()
            u = 0.01 * k
            sent.add(u)
            device.write(u)
            assert np.isnan(y) or abs(y) < 10.0
        assert applied <= sent
        assert relay.done["rig"]["nan"] == 2
        device.close()
    theirs, ours = here.rig.counters, device.counters
    assert (theirs["not_finite"], theirs["malformed"]) == (2, 3)
    assert theirs["duplicated"] == 4
    assert theirs["reordered"] == 1
    assert (ours["session"], ours["malformed"]) == (1, 1)
