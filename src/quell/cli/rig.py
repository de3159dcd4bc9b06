"""``quell rig``, ``quell run-rig`` and ``quell replay``: real time."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from cyclopts import Parameter

from quell.cli import output, report
from quell.cli.exit_codes import ExitCode, exit_on_signal
from quell.cli.options import (
    RUN_OUTPUTS,
    MaxSize,
    Overwrite,
    RunOutputs,
    Switch,
    Trust,
    Whole,
    WholeOrNone,
    options_of,
    refuse,
)
from quell.files import MAX_SIZE
from quell.realtime.registry import examples

if TYPE_CHECKING:
    from quell.controllers import Axes, Compensator
    from quell.monitoring import WatchSink
    from quell.realtime import Rig, RigRun
    from quell.realtime.run import ModeChange
    from quell.records.trajectory import Trajectory
    from quell.setup import Setup

# ---- quell rig ----

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
    channel: list[float] | None = None,
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
        (file.py:name, with --trust), or a table, '{kind = "linear", num = [1], den = [1, 1]}'. It
        may have several signals, as that of a setup with [[axis]].
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
    channel
        A number that is sent beside y in each tick, for the schedule of a loop or its channel held;
        repeat it for more.
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
    from quell.realtime.devices import counts_text
    from quell.realtime.registry import listen
    from quell.realtime.rig import Rig
    from quell.setup.schema import plant_given

    model = plant_given(plant, dt, argument="--plant", trust=trust, several=True)
    _check_pace(seconds, priority, cpu)
    limits: dict[str, Any] = {
        "watchdog": watchdog,
        "u_max": u_max,
        "rest": rest,
        "log": log,
        "wait": wait,
        "channels": channel or (),
        "overwrite": overwrite,
    }
    with closing(listen(device)) as listener, Rig(model, dt, listener=listener, **limits) as server:
        with exit_on_signal(listener.close):  # compiling may take a minute the first time
            server.prepare()
        limit = f", |u| <= {u_max:g}" if math.isfinite(u_max) else ""
        counts = server.signal_counts
        several = "" if counts is None else f", with {counts_text(counts)}"
        rules = f"u = 0 after {watchdog} ticks without a command{limit}"
        start = ", from rest" if rest else ""
        start += f", waits up to {wait:g} s for each command" if wait > 0.0 else ""
        line = f"{plant} at {listener.url}{several}: a tick every {dt:g} s, {rules}{start}"
        notes = _served(server, line, seconds, priority, cpu)
    _print_counters(server)
    for note in notes:
        print(note)


def _check_pace(seconds: float | None, priority: int, cpu: int | None) -> None:
    """Check how long, and how, a rig is to tick."""
    from quell.realtime.rig import checked_seconds
    from quell.realtime.system import checked_cpu, checked_priority

    if seconds is not None:
        checked_seconds("--seconds", seconds)
    checked_priority(priority)
    checked_cpu(cpu)


def _served(
    server: Rig,
    line: str,
    seconds: float | None,
    priority: int,
    cpu: int | None,
    watch: Callable[[], Any] | None = None,
) -> list[str]:
    """Print a line and tick until the time is over or a signal comes; return the notes."""
    from quell.realtime.system import termination_handler

    with termination_handler(lambda *_: server.stop()):
        print(line, flush=True)
        return server.run(seconds, priority=priority, cpu=cpu, watch=watch)


def _print_counters(server: Rig) -> None:
    from quell.realtime.wire import REFUSALS

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
        print(f"the log lacks {server.unlogged} ticks: it could not be written, or not as quickly")


# ---- quell proxy ----

_HOST = (
    f"Address at which the host finds the drive, like {examples(listening=True)}. At 127.0.0.1 it "
    "serves this computer only."
)


def proxy(
    setup: Path,
    *,
    host: Annotated[str, Parameter(help=_HOST)],
    device: Annotated[str | None, Parameter(help="Drive in place of the file's [rig].")] = None,
    seconds: float | None = None,
    log: Path | None = None,
    overwrite: Overwrite = False,
    priority: WholeOrNone = None,
    cpu: WholeOrNone = None,
    trust: Trust = False,
) -> None:
    """Put a compensator between a host and a drive that both stay as they are.

    The host's commands are u_0; to the host the proxy is the drive, to the drive it is the host. A
    setup with [[axis]] stands between a host and a drive of as many measurements and control
    signals.

    It has the supervisor of `quell run-rig`, with the rules of [rig.safety]. Without a host that
    commands, u is zero. Where the host falls silent, the drive is lost or a limit is exceeded, u is
    ramped to zero, the compensation as well, and the proxy ends with exit code 3 and a line with
    NOT: the drive then stays at rest until the proxy is started again. Where the host ends its
    session u is ramped to zero and the proxy waits for the next one.

    Parameters
    ----------
    setup
        The file, in TOML, with [controller] kind = "compensator", limits of u, and the drive in
        [rig]; of several axes with a compensator in each [[axis]].
    seconds
        How long to run [s]; until interrupted by default. Then u is ramped to zero.
    log
        Write each tick to this CSV file: y, u_0, the command as it came, state of the session,
        mode of the supervisor, u as sent to the drive.
    priority
        SCHED_FIFO priority of the ticks in place of the file's, 1 to 99; 0 for ordinary scheduling.
    cpu
        Number of the processor for the ticks in place of the file's; any by default.
    """
    from quell.realtime import CompensatedDrive
    from quell.realtime.devices import counts_text
    from quell.realtime.registry import listen
    from quell.realtime.rig import Rig
    from quell.setup import made, read
    from quell.setup.schema import SetupError, with_path

    loaded = made(*read(setup), trust)
    options = dict(loaded.needed("rig"))
    url = str(options.pop("device")) if device is None else device
    for name, value in options.items():
        if value is not None and name not in (*_OF_PROXY, "signals"):
            rule = f"has no effect in quell proxy, which uses device, {', '.join(_OF_PROXY)}"
            raise SetupError([f"{loaded.file}: rig.{name}: {rule}; leave it out"])
    priority = options.get("priority", 50) if priority is None else priority
    cpu = options.get("cpu") if cpu is None else cpu
    given = {name: options[name] for name in ("channels", "safety") if name in options}
    _check_pace(seconds, priority, cpu)
    compensator, dt = cast("Compensator | Axes", loaded.controller), float(loaded.controller.dt)
    limits: dict[str, Any] = {"log": log, "overwrite": overwrite}

    def behind(device: Any) -> CompensatedDrive:
        try:
            return CompensatedDrive(device, compensator, **given)
        except ValueError as error:
            raise with_path(loaded.file, "rig", error, ["device", *options]) from None

    with (
        closing(_device(url, loaded)) as opened,
        closing(behind(opened)) as drive,
        closing(listen(host)) as listener,
        Rig(drive, dt, listener=listener, **limits) as server,
    ):
        with exit_on_signal(listener.close):
            server.prepare()
        if hasattr(drive.device, "restart_session"):
            drive.device.restart_session()  # compiling may have taken longer than it waits
        between = f"compensator between {listener.url} and {url}"
        of = "" if server.signal_counts is None else f", with {counts_text(server.signal_counts)}"
        print(f"Safety: {drive.rules.text(dt)}.")
        line = f"{between}{of}: a tick every {dt:g} s, u = 0 without a host that commands"
        shown = 0

        def show_changes() -> None:
            nonlocal shown
            for change in drive.changes(shown):
                shown += 1
                if change.cause.name not in ("MISSED", "RECOVERED"):
                    print(change, flush=True)

        notes = _served(server, line, seconds, priority, cpu, show_changes)
        _print_counters(server)
        several, found = hasattr(drive, "inputs"), drive.estimate
        for axis, each in found.items() if several else (("", found),):
            of_axis, of = (f"{axis}: ", "v") if several else ("", "u")
            text = f"{of} = {each.u:.6g}, f = {each.f:.6g}, {each.status!r}"
            print(f"last tick: {of_axis}{text}")
        count = drive.counters
        missing = f"ticks without a measurement of it: {count['missing']}"
        print(f"drive: {missing}, commands that could not be sent to it: {count['unsent']}")
        fault = drive.fault
    for note in notes:
        print(note)
    if fault:
        print(
            f"NOT driving {url} any more: {fault}. u was ramped to zero, the compensation as well, "
            "and the host's session was ended; start the proxy again when the cause is gone"
        )
        sys.exit(ExitCode.ENDED_BY_SAFETY)


# Keys of [rig] that ``quell proxy`` uses.
_OF_PROXY = ("channels", "safety", "priority", "cpu")


# ---- quell run-rig ----

_DEVICE_RUN_RIG = f"Device in place of the file's, like {examples()}."


def run_rig(
    setup: Path | None = None,
    *,
    example: Switch = False,
    device: Annotated[str | None, Parameter(help=_DEVICE_RUN_RIG)] = None,
    seconds: float | None = None,
    omega_c: float | None = None,
    omega_o: float | None = None,
    spin: float | None = None,
    priority: WholeOrNone = None,
    mcap: Path | None = None,
    csv: Path | None = None,
    memory: Path | None = None,
    live: WholeOrNone = None,
    live_origin: list[str] | None = None,
    watch: Path | None = None,
    trust: Trust = False,
    outputs: RunOutputs = RUN_OUTPUTS,
) -> None:
    """Run a setup in real time around a device, for instance the twin that quell rig is.

    A setup with [[axis]] runs several axes around a device with as many measurements and control
    signals.

    The exit code is 0 where the scenario was run to its end, 3 where a limit or a fault ended it,
    130 after Ctrl-C, SIGTERM or SIGHUP; u was ramped to zero in each case. It is 2 for an error in
    the arguments.

    Parameters
    ----------
    setup
        The file, in TOML; by default the paper's torsional experiment with an L-ESO, at
        udp://127.0.0.1:5005.
    example
        Print that file, and do no more.
    seconds
        Duration in place of the scenario's [s].
    omega_c
        Controller bandwidth in place of the file's [rad/s].
    omega_o
        Observer bandwidth in place of the file's [rad/s].
    spin
        Keep the processor busy for so long before each deadline [s].
    priority
        Real-time priority, 1 to 99, where permitted; 0 for none.
    mcap
        Write the record to this file, ending in .mcap, while the loop runs; Foxglove and
        PlotJuggler read it.
    csv
        The same, ending in .csv.
    memory
        File in which what the controller learns outlives the run: it begins with what is there, and
        replaces it at the end, unless a fault has ended the run, and at SIGUSR1.
    live
        Port for Foxglove and PlotJuggler to watch at.
    live_origin
        Web page that may watch, too, such as https://app.foxglove.dev; by default only programs and
        pages of this computer may.
    watch
        State of the machine, as `quell watch` keeps it, to which each minute of this run is added
        while it runs: an alarm is printed at once. A new file is a new state; make it with quell
        watch for other windows.
    """
    from quell.setup import EXAMPLES, made, read
    from quell.setup.description import is_of_axes

    numbers: dict[str, Any] = {
        "seconds": seconds,
        "omega_c": omega_c,
        "omega_o": omega_o,
        "spin": spin,
    }
    others: dict[str, Any] = {
        "device": device,
        "priority": priority,
        "mcap": mcap,
        "csv": csv,
        "memory": memory,
        "live": live,
        "watch": watch,
    }
    others |= numbers | {"live_origin": live_origin}
    file = setup or EXAMPLES / "torsional_rig.toml"
    if example:
        unused = options_of(outputs, RUN_OUTPUTS) | {"setup": (setup, None)}
        unused |= {name: (value, None) for name, value in others.items()}
        refuse(unused, "has no effect beside --example, which only prints a file")
        print((EXAMPLES / "torsional_rig.toml").read_text(encoding="utf-8"), end="")
        return
    changes = {
        ("rig", "device"): device,
        ("rig", "spin"): spin,
        ("rig", "priority"): priority,
        ("rig", "memory"): memory if memory is None else str(memory),
        ("scenario", "duration"): seconds,
        ("controller", "omega_c"): omega_c,
        ("observer", "omega_o"): omega_o,
    }
    files = [path for path in (mcap, csv) if path is not None]
    name, data = read(file)
    several = is_of_axes(data)
    if several:
        rule = "is for one axis; change the bandwidths of each [[axis]] in the file"
        refuse({"omega_c": (omega_c, None), "omega_o": (omega_o, None)}, rule)
    tables = _changed(data, changes)
    if seconds is not None and isinstance(windows := tables.get("metrics"), list):
        # A shorter run is not judged after its end.
        tables["metrics"] = [each for each in windows if not _begins_after(each, seconds)]
    given = made(name, tables, trust)
    if code := _run(given, files, (live, live_origin or []), watch, outputs):
        sys.exit(code)


def _run(
    setup: Setup,
    files: list[Path],
    viewers: tuple[int | None, list[str]],
    watch: Path | None,
    outputs: RunOutputs,
) -> int:
    """Run the loop, print and write its results; return the exit code."""
    from quell.realtime import LiveSink

    scenario, options = setup.needed("scenario"), dict(setup.needed("rig"))
    files = [*map(Path, options.pop("telemetry", ())), *files]
    check_recordings(files, outputs.overwrite)
    outputs = output.check_outputs(outputs, [Path(setup.file).stem, "timing"], files)
    options["overwrite"] = outputs.overwrite
    (port, origins), live = viewers, options.pop("live")
    port = live if port is None else port
    url, dt = options.pop("device"), setup.controller.dt
    console = output.Console()
    what = f"{setup.title}: {url}, dt = {dt:g} s, for {scenario.duration:g} s"
    output.print_line(console, f"{what}. Ctrl-C ramps u to zero.")
    if port is None:
        refuse({"live_origin": (origins, [])}, "goes with --live, a port to watch at")
    # The port first: if it is in use no file is created.
    sinks = files if port is None else [LiveSink(port, origins=origins), *files]
    watching = None if watch is None else _watching(console, watch, setup)
    sinks = sinks if watching is None else [*sinks, watching]
    run = _close_loop(console, setup, url, options, sinks)
    if run is None:
        return ExitCode.ENDED_BY_SAFETY
    record = run.trajectory
    _print_timing(console, run)
    title = f"{setup.title}: the scenario"
    scores, learned = report.print_run(console, record, setup, title)
    code = exit_code(run)
    if watching is not None:
        output.print_line(console, watching.describe())
    results = {
        "title": setup.title,
        "device": url,
        "dt": dt,
        "verdict": run.verdict,
        "exit_code": int(code),
        **_as_json(run),
        "metrics": scores,
        "learned": learned,
        "setup": setup.as_json(),
    }
    try:
        _write(console, run, setup, results, outputs)
    except OSError as error:  # the disk is full: the code of a run that safety ended goes first
        if code == ExitCode.DONE:
            raise
        print(f"quell: {error}", file=sys.stderr)
    return code


def _watching(console: output.Console, path: Path, setup: Setup) -> WatchSink:
    """Return the sink that watches the machine."""
    from quell.monitoring import Machine, WatchSink

    parts = getattr(setup.controller, "axes", (setup.controller,))
    observers = [getattr(each, "observer", None) for each in parts]
    orders = [min(getattr(observer, "degree", 2), 2) for observer in observers]
    machine = Machine(order=orders[0] if len(set(orders)) == 1 else orders)
    return WatchSink(path, machine, lambda alarm: output.print_line(console, alarm.describe()))


def _write(
    console: output.Console, run: RigRun, setup: Setup, results: dict[str, Any], outputs: RunOutputs
) -> None:
    """Write figures, record and results where they are asked for."""
    record, paths = run.trajectory, []
    if outputs.figures and len(record):
        paths = report.save_run_figure(record, setup.title, outputs, Path(setup.file).stem)
        paths += _save_timing_figure(run, setup, outputs.figures, outputs.overwrite)
    output.write_record(console, record, outputs, "Record")
    output.write_results(console, results, outputs, paths)


def _close_loop(
    console: output.Console, setup: Setup, url: str, options: dict[str, Any], sinks: list[Any]
) -> RigRun | None:
    """Run the loop and print each change of mode; return None if the device failed."""
    from quell.realtime import LiveSink, Safety, run_rig
    from quell.setup.schema import with_path

    began = False

    def print_change(change: ModeChange) -> None:
        nonlocal began
        live = () if began else [sink for sink in sinks if isinstance(sink, LiveSink)]
        for sink in live:
            console.print(f"Live: {sink.url}")
        began = True
        output.print_line(console, str(change))

    settings = {"telemetry": sinks, "on_change": print_change, **options}
    controller, scenario = setup.controller, setup.needed("scenario")
    try:
        rules = (options.get("safety") or Safety()).rules(controller, scenario)
        output.print_line(console, f"Safety: {rules.text(controller.dt)}.")
        device = _device(url, setup)
        with exit_on_signal(device.close):
            return run_rig(device, controller, scenario, **settings)
    except ValueError as error:
        raise with_path(setup.file, "rig", error, ["device", *options]) from None
    except ConnectionError as error:
        if not began:
            raise
        print(f"quell: {error}", file=sys.stderr)
        return None


def _device(url: str, setup: Setup) -> Any:
    """Return the device; ``twin:`` is the plant of the setup itself.

    It gives the signals of its scenario's schedule, from when it is opened.
    """
    from quell import realtime
    from quell.simulation.scenario import sampled_schedule

    if url == "twin:":
        dt, scenario = setup.controller.dt, setup.scenario
        rows: Any = ()
        if scenario is not None and scenario.schedule:
            rows = sampled_schedule(scenario, setup.controller)
        return realtime.TwinDevice(setup.needed("plant"), dt, channels=rows)
    controller: Any = setup.controller
    several = hasattr(controller, "inputs")
    counts = (controller.outputs, controller.inputs) if several else None
    return realtime.open_device(url, controller.dt, setup.trust, counts)


def _changed(data: Mapping[str, Any], changes: Mapping[tuple[str, str], Any]) -> dict[str, Any]:
    """Return a file's tables with other values for some keys; None changes nothing."""
    tables = {k: dict(v) if isinstance(v, Mapping) else v for k, v in data.items()}
    for (table_name, key), value in changes.items():
        if value is not None and isinstance(tables.setdefault(table_name, {}), dict):
            tables[table_name][key] = value
    return tables


def _begins_after(window: Any, seconds: float) -> bool:
    start = window.get("start") if isinstance(window, Mapping) else None
    return isinstance(start, int | float) and start >= seconds


def check_recordings(files: Iterable[Path], overwrite: bool) -> None:
    """Check suffixes and places of recordings, before the device is opened."""
    from quell.realtime.recordings import file_sink

    for file in files:
        file_sink(file, overwrite).check()


def exit_code(run: RigRun) -> int:
    """Return the exit code of a run."""
    from quell.realtime.supervisor import Ending

    if run.completed:
        return ExitCode.DONE
    asked = any(change.cause.ending is Ending.REQUESTED for change in run.changes)
    return ExitCode.INTERRUPTED if asked else ExitCode.ENDED_BY_SAFETY


def _print_timing(console: output.Console, run: RigRun) -> None:
    from quell.realtime.run import counters_text

    histograms = {"lateness": run.timing.lateness, "step time": run.timing.step}
    rows = output.table("Punctuality", "[µs]", "p50", "p99", "p99.9", "max")
    for label, histogram in histograms.items():
        values = [1e6 * value for value in histogram.summary().values()]
        rows.add_row(label, *("–" if value != value else f"{value:.1f}" for value in values))
    console.print(rows)
    for label, histogram in histograms.items():
        bars = "\n".join(histogram.text().splitlines()[1:])
        heading = f"{label.capitalize()}, cycles (bars are logarithmic):"
        console.print(f"{heading}\n{bars}\n", highlight=False)
    output.print_line(console, f"Loop: {counters_text(run.tally._asdict())}")
    if run.counters:
        output.print_line(console, f"Device: {counters_text(run.counters)}")
    for note in run.notes:
        if not note.startswith("telemetry: "):  # these were logged at once
            output.print_line(console, f"Note: {note}")


def _save_timing_figure(run: RigRun, setup: Setup, folder: Path, overwrite: bool) -> list[Path]:
    import matplotlib.pyplot as plt

    from quell.experiments.common import save_figure

    figure, axes = plt.subplots(figsize=(8.0, 4.0), layout="constrained")
    run.timing.plot(axes)
    axes.axvline(1e6 * setup.controller.dt, color="0.3", linestyle="--", linewidth=1.0, label="dt")
    axes.legend()
    axes.set_title(f"{setup.title}: {run.tally.cycles} cycles, {run.overruns} overruns")
    return save_figure(figure, folder, "timing", overwrite)


def _as_json(run: RigRun) -> dict[str, Any]:
    from quell.files import nonfinite_to_none

    timing = {"lateness": run.timing.lateness.summary(), "step": run.timing.step.summary()}
    results = {
        "completed": run.completed,
        "rules": run.rules._asdict(),
        "timing": timing,
        "tally": run.tally._asdict(),
        "counters": run.counters,
        "changes": [
            {"t": c.t, "mode": c.mode.name, "cause": c.cause.text}
            | ({"signal": c.signal} if c.signal else {})
            for c in run.changes
        ],
        "notes": list(run.notes),
    }
    return dict(nonfinite_to_none(results))


# ---- quell replay ----

_HEADINGS = ("RMS of f̂", "RMS of residual", "learned share\n[%]", "RMS of x̂1 − y")
_FACTORS = (1.0, 1.0, 100.0, 1.0)


def replay(
    record: Path,
    setup: Path | None = None,
    *,
    max_size: MaxSize = MAX_SIZE,
    trust: Trust = False,
    outputs: RunOutputs = RUN_OUTPUTS,
) -> None:
    """Run a setup's observer and learner on a recorded run, and compare the estimates.

    A record of several axes needs a setup with the same [[axis]] and actuators, in their order. A
    record in other units than the plant of the setup is converted, or refused.

    Parameters
    ----------
    record
        File that `quell run-rig` recorded, ending in .mcap or .csv.
    setup
        The file of the controller, in TOML, with the record's sample time; by default that of
        `quell run-rig`.
    """
    from quell.commissioning import controlled
    from quell.plants.base import signals_of
    from quell.quantities import UNKNOWN
    from quell.realtime import load as load_record
    from quell.realtime import replay as replay_record
    from quell.records import metrics
    from quell.records.units import runs_in_common_units
    from quell.setup import EXAMPLES, made, read
    from quell.setup.axes import signals_in
    from quell.setup.description import is_of_axes
    from quell.setup.schema import with_path

    file, data = read(setup or EXAMPLES / "torsional_rig.toml")
    several = is_of_axes(data)
    given = made(file, data, trust)
    name = f"{record.stem}-replayed"
    outputs = output.check_outputs(outputs, [name])
    console = output.Console()
    # The controller is made for the units of the setup's plant, if it has some.
    plant = UNKNOWN if given.plant is None else signals_of(given.plant)
    known = signals_in(given.description, given.controller) if several else plant
    of_record = {record.name: load_record(record, max_size)}
    alike, notes = runs_in_common_units(of_record, known, given.file)
    recorded = alike[record.name]
    for note in notes:
        output.print_line(console, note)
    try:  # replay refuses a controller that is no ADRC
        names = (given.rig or {}).get("channels", ())
        if several:
            _check_actuators(recorded, given)
        replayed = replay_record(recorded, given.controller, channels=names)
    except ValueError as error:
        raise with_path(given.file, "", error, ()) from None
    part, title = controlled(recorded), f"{record.name} through {given.title}"
    scores: dict[str, Any] = {}
    learned: dict[str, Any] = {}
    for i, axis in enumerate(replayed.axis_names if several else ("",)):
        pair = (recorded.axis(i), replayed.axis(axis)) if several else (recorded, replayed)
        scores[axis] = _print_scores(console, f"{title}{': ' * several}{axis}", *pair, part)
        learned[axis] = report.print_outcome(console, pair[1])
    _print_gaps(console, recorded)
    apart = (replayed["u_wished"] - replayed["u"])[part]
    each_u = [metrics.rms(u) for u in apart.reshape(len(apart), -1).T]
    difference: Any = each_u[0] if apart.ndim == 1 else each_u
    text = ", ".join(f"{each:.4g}" for each in each_u)
    console.print(
        f"Wished u less applied u, RMS: {text}. Judged: the {part.stop - part.start} "
        "samples under control."
    )
    draw = None if several else _draw_wished
    paths = report.save_run_figure(replayed, given.title, outputs, name, draw)
    output.write_record(console, replayed, outputs, "Replay")
    results = {
        "record": str(record),
        "title": given.title,
        "dt": recorded.dt,
        "scores": scores if several else scores[""],
        "u_wished_rms": difference,
        "learned": learned if several else learned[""],
        "setup": given.as_json(),
    }
    output.write_results(console, results, outputs, paths)


def _check_actuators(recorded: Any, given: Setup) -> None:
    """Check that the actuators of a recorded run are those of a setup, as far as both name them."""
    from quell.quantities import AxesSignals
    from quell.realtime.replaying import check_same_names
    from quell.setup.axes import signals_in

    if isinstance(recorded.signals, AxesSignals):
        ours: Any = signals_in(given.description, given.controller)
        both = ([each.name for each in one.u] for one in (recorded.signals, ours))
        check_same_names("actuators", *both)


def _print_scores(
    console: output.Console, title: str, recorded: Trajectory, replayed: Trajectory, part: slice
) -> dict[str, dict[str, float | None]]:
    """Print and return the measures of a recorded run and of its replay."""
    scores = {"recorded": _scores(recorded, part), "replayed": _scores(replayed, part)}
    rows = output.table(title, "", *_HEADINGS)
    for name, values in scores.items():
        pairs = zip(values.values(), _FACTORS, strict=True)
        rows.add_row(name, *(output.number(value, ".4g", factor) for value, factor in pairs))
    console.print(rows)
    return scores


def _scores(run: Trajectory, part: slice) -> dict[str, float | None]:
    """Return the RMS of the estimate of f, of the observer's part of it, and of the innovation."""
    from quell.records import metrics

    def rms(name: str) -> float | None:
        return metrics.rms(run[name][part]) if name in run.names else None

    f, residual = rms("f_hat"), rms("f_residual")
    known = "x_hat" in run.names
    return {
        "f": f,
        "residual": residual,
        "share_learned": 1.0 - (residual or 0.0) / f if f else None,
        "innovation": metrics.rms(run["x_hat"][part, 0] - run["y"][part]) if known else None,
    }


def _print_gaps(console: output.Console, recorded: Trajectory) -> None:
    from quell.realtime.recordings import Event

    if "events" not in recorded.names:
        return
    gaps = (recorded["events"].astype(int) & Event.GAP).nonzero()[0]
    if gaps.size:
        first = f"the first at {recorded.t[gaps[0]]:.3f} s"
        skipped = f"{gaps.size} of {len(recorded)} samples were skipped by the loop, {first}"
        meaning = "to the replay, as to the loop, they are samples without a measurement."
        output.print_line(console, f"{skipped}: {meaning}")


def _draw_wished(run: Trajectory, axes: Any) -> None:
    from quell.records.plotting import draw_line

    draw_line(axes[1], run.t, run["u_wished"], label="u wished", color="C3", linewidth=0.8)
    axes[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize="small", frameon=False)
