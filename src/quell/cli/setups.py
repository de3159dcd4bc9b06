"""The commands of ``quell`` that take a setup file; what they do stands in ``quell.cli.commands``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from quell.cli.options import Figures, JsonFile, WholeOrNone


def run(
    setup: Path | None = None,
    *,
    example: Annotated[bool, Parameter(negative="")] = False,
    json: JsonFile = None,
    figures: Figures = Path("quell-figures"),
    save: Path | None = None,
) -> None:
    """Simulate what a setup file describes: a plant, a controller, what happens to them.

    Parameters
    ----------
    setup
        The file, in TOML; docs/setup has all keys.
    example
        Print such a file, and do no more.
    json
        Write metrics and settings to this file, for programs.
    figures
        Put the figure into this folder, as PNG and SVG.
    save
        Write the whole record to this file, which `Trajectory.load` reads.
    """
    if example:
        _print_example("two_mass.toml")
        return
    if setup is None:
        raise ValueError("setup: missing; must be a TOML file, and quell run --example prints one")
    from quell.cli.commands.run import run_setup

    run_setup(path=setup, json_file=json, figures=figures, save=save)


def run_rig(
    setup: Path | None = None,
    *,
    example: Annotated[bool, Parameter(negative="")] = False,
    device: str | None = None,
    seconds: float | None = None,
    omega_c: float | None = None,
    omega_o: float | None = None,
    spin: float | None = None,
    priority: WholeOrNone = None,
    mcap: Path | None = None,
    csv: Path | None = None,
    live: WholeOrNone = None,
    json: JsonFile = None,
    figures: Figures = Path("quell-figures"),
    save: Path | None = None,
) -> None:
    """Run a setup in real time around a device, for instance the twin that `quell rig` is.

    Ends with exit code 0 where the scenario was run to its end, 3 where a limit or a fault ended it, 130 after Ctrl-C; u was ramped to
    zero in each case. 2 is for a mistake in what was asked.

    Parameters
    ----------
    setup
        The file, in TOML; by default the paper's torsional experiment with an L-ESO, at udp://127.0.0.1:5005.
    example
        Print that file, and do no more.
    device
        Another device than the file's: udp://HOST:PORT, shm://NAME, serial:///dev/ttyACM0, ni://, twin:torsional.
    seconds
        Another duration of the scenario [s].
    omega_c
        Another controller bandwidth [rad/s].
    omega_o
        Another observer bandwidth [rad/s].
    spin
        Keep the processor busy for so long before each deadline [s].
    priority
        Real-time priority, 1 to 99, where permitted; 0 for none.
    mcap
        Write the record to this file, ending in .mcap, while it runs; Foxglove and PlotJuggler read it.
    csv
        The same, ending in .csv.
    live
        Let Foxglove and PlotJuggler watch at this port.
    json
        Write metrics, timing, events and settings to this file, for programs.
    figures
        Put the figures into this folder, as PNG and SVG.
    save
        Write the scenario's part of the record to this file, which `Trajectory.load` reads.
    """
    if example:
        _print_example("torsional_rig.toml")
        return
    from quell.cli.commands.run_rig import run_setup

    changes = {
        ("rig", "device"): device,
        ("rig", "spin"): spin,
        ("rig", "priority"): priority,
        ("scenario", "duration"): seconds,
        ("controller", "omega_c"): omega_c,
        ("observer", "omega_o"): omega_o,
    }
    telemetry = tuple(path for path in (mcap, csv) if path is not None)
    code = run_setup(
        path=setup,
        changes=changes,
        telemetry=telemetry,
        live=live,
        json_file=json,
        figures=figures,
        save=save,
    )
    if code:
        sys.exit(code)


def replay(
    record: Path,
    setup: Path | None = None,
    *,
    json: JsonFile = None,
    figures: Figures = Path("quell-figures"),
    save: Path | None = None,
) -> None:
    """Let a setup's observer and learner follow a recorded run: what they would have known, and what u the controller would have wished.

    Parameters
    ----------
    record
        What `quell run-rig` recorded, ending in .mcap or .csv.
    setup
        The file of the controller, in TOML, with the record's sample time; by default that of `quell run-rig`.
    json
        Write what came of it to this file, for programs.
    figures
        Put the figure into this folder, as PNG and SVG.
    save
        Write the whole replay to this file, which `Trajectory.load` reads.
    """
    from quell.cli.commands.replay import run_replay

    run_replay(record=record, path=setup, json_file=json, figures=figures, save=save)


def _print_example(name: str) -> None:
    from quell.setup import EXAMPLES

    print((EXAMPLES / name).read_text(encoding="utf-8"), end="")
