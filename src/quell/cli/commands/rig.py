"""``quell rig``: be the device, until somebody says stop."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path
from typing import Any

from quell.cli.interrupt import ended_at_once
from quell.realtime.devices.registry import listen, plant_named
from quell.realtime.rig.server import Rig, checked_seconds
from quell.realtime.system.interrupts import termination_handler
from quell.realtime.system.scheduling import checked_cpu, checked_priority
from quell.realtime.wire.frames import REFUSALS


def run_rig(
    *,
    device: str,
    plant: str,
    settings: dict[str, Any],
    seconds: float | None,
    log: Path | None,
    priority: int,
    cpu: int | None,
) -> None:
    """Run the rig, and say at the end how it went.

    Raises
    ------
    ValueError
        for arguments out of range, a URL at which nothing can listen, or a log that can't be written.
    """
    model = plant_named(plant, "--plant")
    if seconds is not None:
        checked_seconds("--seconds", seconds)
    checked_priority(priority)
    checked_cpu(cpu)
    with (
        closing(listen(device)) as listener,
        Rig(model, listener=listener, log=log, **settings) as rig,
    ):
        with ended_at_once(listener.close):  # it may take a minute the first time
            rig.prepare()
        with termination_handler(lambda *_: rig.stop()):
            print(f"{plant} at {listener.url}: {_described(**settings)}", flush=True)
            notes = rig.run(seconds, priority=priority, cpu=cpu)
    _tell(rig)
    for note in notes:
        print(note)


def _described(dt: float, watchdog: int, u_max: float, rest: bool) -> str:
    limit = f", |u| <= {u_max:g}" if math.isfinite(u_max) else ""
    return f"a tick every {dt:g} s, u = 0 after {watchdog} ticks without a command{limit}{', from rest' if rest else ''}"


def _tell(rig: Rig) -> None:
    """Print what was counted."""
    counted = rig.counters
    late = ", ".join(f"{name} {1e6 * value:.0f}" for name, value in rig.lateness.summary().items())
    refused = ", ".join(f"{name} {counted[name]}" for name in REFUSALS if counted[name]) or "none"
    print(
        f"ticks: {counted['ticks']}, of which late by more than one: {counted['caught_up']}; lateness [us]: {late}"
    )
    print(
        f"sessions: {counted['sessions']}, refused: {counted['refused']}, ended by the watchdog: {counted['watchdog']}"
    )
    cut, unused = counted["clipped"], counted["skipped"]
    print(
        f"commands: {counted['accepted']}, largest |u| {rig.largest:.6g}, cut to the limit: {cut}, never used: {unused}"
    )
    print(f"frames that were not accepted: {refused}")
    if rig.unlogged:
        print(f"the log lacks {rig.unlogged} ticks: it could not be written as quickly")
