"""The command ``quell``: a thin layer over ``quell.experiments``.

Heavy imports stand inside the commands, so that ``quell --help`` answers at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, CycloptsError, Parameter, Token

from quell import __version__

app = App(
    name="quell",
    help="Disturbance-rejection control that learns.",
    version=__version__,
    print_error=False,
    exit_on_error=False,
)
reproduce = App(name="reproduce", help="Run a published experiment again and judge its claims.")
app.command(reproduce)


def _whole(kind: Any, tokens: Sequence[Token]) -> int:
    """Read a whole number; the parser's own conversion would round 1.5 to 2 without a word."""
    text = tokens[0].value
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{tokens[0].keyword} = {text!r}: must be a whole number") from None


@reproduce.command(name="two-mass")
def two_mass(
    *,
    dt: float = 1e-3,
    seed: Annotated[int, Parameter(converter=_whole)] = 0,
    omega_o: float = 10.0,
    reset: bool = True,
    json: Annotated[Path | None, Parameter(name="--json")] = None,
    figures: Annotated[Path | None, Parameter(negative_none="no-")] = Path("quell-figures"),
) -> None:
    """Run the two-mass-spring study: MF-ESO, MB-ESO and L-ESO, with every claim judged.

    Parameters
    ----------
    dt
        Sample time [s].
    seed
        Seed of the measurement noise.
    omega_o
        Observer bandwidth [rad/s].
    reset
        Start the loop from rest at 110 s, before the step.
    json
        Write all results to this file, for programs.
    figures
        Put the figures into this folder, as PNG and SVG.
    """
    from quell.commands.two_mass import reproduce_two_mass

    reproduce_two_mass(dt=dt, seed=seed, omega_o=omega_o, reset=reset, json_file=json, figures=figures)


@reproduce.command(name="torsional")
def torsional(
    *,
    dt: float = 1e-3,
    seed: Annotated[int, Parameter(converter=_whole)] = 0,
    json: Annotated[Path | None, Parameter(name="--json")] = None,
    figures: Annotated[Path | None, Parameter(negative_none="no-")] = Path("quell-figures"),
) -> None:
    """Run the torsional testbed's experiment on its twin: MF-ESO, MB-ESO and L-ESO at three pairs of bandwidths, with every claim judged.

    Parameters
    ----------
    dt
        Sample time [s].
    seed
        Seed of where the runs start between two edges of the encoder.
    json
        Write all results to this file, for programs.
    figures
        Put the figures into this folder, as PNG and SVG.
    """
    from quell.commands.torsional import reproduce_torsional

    reproduce_torsional(dt=dt, seed=seed, json_file=json, figures=figures)


@reproduce.command(name="acc")
def acc(
    *,
    samples: Path | None = None,
    count: Annotated[int | None, Parameter(converter=_whole)] = None,
    spread: float | None = None,
    seed: Annotated[int | None, Parameter(converter=_whole)] = None,
    json: Annotated[Path | None, Parameter(name="--json")] = None,
    figures: Annotated[Path | None, Parameter(negative_none="no-")] = Path("quell-figures"),
) -> None:
    """Run the ACC robust-control benchmark: published designs and ours, each one fixed controller for a thousand uncertain plants.

    Parameters
    ----------
    samples
        Read the plants from this CSV file (columns m1, m2, k_lin, k_nonlin, lambda, tau) instead of drawing them.
    count
        How many plants are drawn: 1000 by default.
    spread
        How uncertain those are: 1, the default, is the published small uncertainty, 3 about where the best published design fails half of
        them.
    seed
        Seed of the plants: 0 by default.
    json
        Write all results to this file, for programs.
    figures
        Put the figures into this folder, as PNG and SVG.
    """
    from quell.commands.acc import reproduce_acc

    reproduce_acc(samples=samples, count=count, spread=spread, seed=seed, json_file=json, figures=figures)


@app.command(name="stress")
def stress(
    *,
    runs: Annotated[int, Parameter(converter=_whole)] = 600,
    honest: Annotated[int, Parameter(converter=_whole)] = 100,
    seed: Annotated[int, Parameter(converter=_whole)] = 0,
    guard: bool = True,
    json: Annotated[Path | None, Parameter(name="--json")] = None,
    figures: Annotated[Path | None, Parameter(negative_none="no-")] = Path("quell-figures"),
) -> None:
    """Put the guard on trial: hostile learners and an honest one in random loops, each beside plain MF-ESO.

    Parameters
    ----------
    runs
        How many runs with hostile learners, all kinds in turn.
    honest
        How many runs with the honest learner.
    seed
        Seed of all that is random.
    guard
        With the guard, or without, to see what it is good for.
    json
        Write all results to this file, for programs.
    figures
        Put the figure into this folder, as PNG and SVG.
    """
    from quell.commands.stress import run_stress

    run_stress(runs=runs, honest=honest, seed=seed, guarded=guard, json_file=json, figures=figures)


@app.command(name="compare")
def compare(
    *,
    controllers: str = "mf-eso,mb-eso,l-eso,pid,pi-notch,lqg,resonance-ratio",
    m1: float = 1.0,
    m2: float = 1.0,
    k: float = 1.0,
    dt: float = 1e-3,
    u_max: float = float("inf"),
    seed: Annotated[int, Parameter(converter=_whole)] = 0,
    json: Annotated[Path | None, Parameter(name="--json")] = None,
    figures: Annotated[Path | None, Parameter(negative_none="no-")] = Path("quell-figures"),
) -> None:
    """Compare controllers, designed for m1 = m2 = k = 1, on two masses and a spring: a step, a force on the load, noise.

    Parameters
    ----------
    controllers
        Which ones, with commas between; zv+ or zvd+ before a name shapes its reference, as in zv+lqg.
    m1
        Mass that is pushed, as it really is [kg].
    m2
        Mass that is measured [kg].
    k
        Stiffness of the spring [N/m].
    dt
        Sample time [s].
    u_max
        Limit of the control force, either way [N].
    seed
        Seed of the measurement noise.
    json
        Write all results to this file, for programs.
    figures
        Put the figure into this folder, as PNG and SVG.
    """
    from quell.commands.compare import run_compare
    from quell.experiments.compare import Benchmark

    settings = Benchmark(m1=m1, m2=m2, k=k, dt=dt, u_max=u_max, seed=seed)
    run_compare(controllers=controllers, settings=settings, json_file=json, figures=figures)


@app.command(name="run")
def run(
    setup: Path | None = None,
    *,
    example: Annotated[bool, Parameter(negative="")] = False,
    json: Annotated[Path | None, Parameter(name="--json")] = None,
    figures: Annotated[Path | None, Parameter(negative_none="no-")] = Path("quell-figures"),
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
    from quell.commands.run import run_setup

    run_setup(path=setup, json_file=json, figures=figures, save=save)


@app.command(name="run-rig")
def run_rig(
    setup: Path | None = None,
    *,
    example: Annotated[bool, Parameter(negative="")] = False,
    device: str | None = None,
    seconds: float | None = None,
    omega_c: float | None = None,
    omega_o: float | None = None,
    spin: float | None = None,
    priority: Annotated[int | None, Parameter(converter=_whole)] = None,
    mcap: Path | None = None,
    csv: Path | None = None,
    live: Annotated[int | None, Parameter(converter=_whole)] = None,
    json: Annotated[Path | None, Parameter(name="--json")] = None,
    figures: Annotated[Path | None, Parameter(negative_none="no-")] = Path("quell-figures"),
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
    from quell.commands.run_rig import run_setup

    changes = {
        ("rig", "device"): device,
        ("rig", "spin"): spin,
        ("rig", "priority"): priority,
        ("scenario", "duration"): seconds,
        ("controller", "omega_c"): omega_c,
        ("observer", "omega_o"): omega_o,
    }
    telemetry = tuple(path for path in (mcap, csv) if path is not None)
    code = run_setup(path=setup, changes=changes, telemetry=telemetry, live=live, json_file=json, figures=figures, save=save)
    if code:
        sys.exit(code)


def _print_example(name: str) -> None:
    from quell.setup import EXAMPLES

    print((EXAMPLES / name).read_text(encoding="utf-8"), end="")


def main() -> None:
    """Run the command line; each mistake in what was asked gives one line, and the exit code is 2."""
    try:
        app()
    except (CycloptsError, ValueError) as error:
        for mistake in getattr(error, "mistakes", (str(error),)):
            print(f"quell: {' '.join(mistake.split())}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # whoever was reading has read enough
        sys.stdout = None
        sys.exit(0)
    except (OSError, MemoryError) as error:
        print(f"quell: {type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("quell: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
