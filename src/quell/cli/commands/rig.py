"""``quell rig``."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from quell.cli.interrupt import exit_on_signal
from quell.cli.options import Overwrite, Trust, Whole, WholeOrNone
from quell.realtime.devices.registry import examples

if TYPE_CHECKING:
    from quell.realtime import Rig


_DEVICE = (
    f"Address to listen at, like {examples(listening=True)}. At 127.0.0.1 it serves this computer "
    "only; give another address of this computer to serve others."
)


def rig(
    *,
    device: Annotated[str, Parameter(help=_DEVICE)],
    plant: str = "torsional",
    dt: float = 1e-3,
    watchdog: Whole = 20,
    u_max: float = math.inf,
    rest: bool = True,
    wait: float = 0.0,
    seconds: float | None = None,
    log: Path | None = None,
    overwrite: Overwrite = False,
    priority: Whole = 50,
    cpu: WholeOrNone = None,
    trust: Trust = False,
) -> None:
    """Run a simulated plant as the device at the other end of a wire.

    It has a clock and a watchdog of its own.

    Parameters
    ----------
    plant
        The plant: a name as torsional or two-mass, a setup file with [plant] (setup.toml), an
        identified model (model.json), an FMU (motor.fmu), a Python function that returns a plant
        (file.py:name, with --trust), or a table, '{kind = "linear", num = [1], den = [1, 1]}'.
    dt
        Length of a tick [s].
    watchdog
        After so many ticks in a row without a new command u is zero until a new session.
    u_max
        Limit of the commands, either way [V, N].
    rest
        Start each session from rest, or where the last one left the plant; from rest in any case if
        that state is not finite, or beyond 1e9.
    wait
        How long a tick waits for the command that answers the measurement before it [s]. The plant
        stands still meanwhile, as no real one does: a loop that is late then does as in a
        simulation.
    seconds
        How long to run [s]; until interrupted by default.
    log
        Write each tick to this CSV file: y, u as applied, the command as it came, state.
    priority
        SCHED_FIFO priority of the ticks, 1 to 99; 0 for ordinary scheduling. A note at the end says
        what is not permitted.
    cpu
        Number of the processor for the ticks; any by default.
    """
    from quell.realtime.devices.registry import listen
    from quell.realtime.rig.server import Rig, checked_seconds
    from quell.realtime.system.interrupts import termination_handler
    from quell.realtime.system.scheduling import checked_cpu, checked_priority
    from quell.setup.plants import plant_given

    model = plant_given(plant, dt, argument="--plant", trust=trust)
    if seconds is not None:
        checked_seconds("--seconds", seconds)
    checked_priority(priority)
    checked_cpu(cpu)
    limits: dict[str, Any] = {
        "watchdog": watchdog,
        "u_max": u_max,
        "rest": rest,
        "log": log,
        "wait": wait,
        "overwrite": overwrite,
    }
    with closing(listen(device)) as listener, Rig(model, dt, listener=listener, **limits) as server:
        with exit_on_signal(listener.close):  # compiling may take a minute the first time
            server.prepare()
        with termination_handler(lambda *_: server.stop()):
            limit = f", |u| <= {u_max:g}" if math.isfinite(u_max) else ""
            rules = f"u = 0 after {watchdog} ticks without a command{limit}"
            start = ", from rest" if rest else ""
            start += f", waits up to {wait:g} s for each command" if wait > 0.0 else ""
            print(f"{plant} at {listener.url}: a tick every {dt:g} s, {rules}{start}", flush=True)
            notes = server.run(seconds, priority=priority, cpu=cpu)
    _print_counters(server)
    for note in notes:
        print(note)


def _print_counters(server: Rig) -> None:
    from quell.realtime.wire.frames import REFUSALS

    count = server.counters
    late = ", ".join(f"{key} {1e6 * value:.0f}" for key, value in server.lateness.summary().items())
    refused = ", ".join(f"{name} {count[name]}" for name in REFUSALS if count[name]) or "none"
    print(
        f"ticks: {count['ticks']}, of which late by more than one: {count['caught_up']}; lateness "
        f"[us]: {late}\n"
        f"sessions: {count['sessions']}, refused: {count['refused']}, ended by the watchdog: "
        f"{count['watchdog']}\n"
        f"commands: {count['accepted']}, largest |u| {server.largest:.6g}, "
        f"cut to the limit: {count['clipped']}, never used: {count['skipped']}\n"
        f"frames that were not accepted: {refused}"
    )
    if count["restored"]:
        print(
            f"sessions that began at rest because the plant's state was destroyed (not finite, or "
            f"beyond 1e9): {count['restored']}"
        )
    if server.unlogged:
        print(f"the log lacks {server.unlogged} ticks: it could not be written as quickly")
