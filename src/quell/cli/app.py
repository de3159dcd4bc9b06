"""The command ``quell``: a thin layer over ``quell.experiments``.

Heavy imports stand inside the commands, so that ``quell --help`` answers at once.
"""

from __future__ import annotations

import sys
from pathlib import Path

from cyclopts import App, CycloptsError

from quell import __version__
from quell.cli import setups
from quell.cli.options import Figures, JsonFile, Whole, WholeOrNone

app = App(
    name="quell",
    help="Disturbance-rejection control that learns.",
    version=__version__,
    print_error=False,
    exit_on_error=False,
)
reproduce = App(name="reproduce", help="Run a published experiment again and judge its claims.")
app.command(reproduce)


@reproduce.command(name="two-mass")
def two_mass(
    *,
    dt: float = 1e-3,
    seed: Whole = 0,
    omega_o: float = 10.0,
    reset: bool = True,
    json: JsonFile = None,
    figures: Figures = Path("quell-figures"),
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
    from quell.cli.commands.two_mass import reproduce_two_mass

    reproduce_two_mass(
        dt=dt, seed=seed, omega_o=omega_o, reset=reset, json_file=json, figures=figures
    )


@reproduce.command(name="torsional")
def torsional(
    *,
    dt: float = 1e-3,
    seed: Whole = 0,
    json: JsonFile = None,
    figures: Figures = Path("quell-figures"),
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
    from quell.cli.commands.torsional import reproduce_torsional

    reproduce_torsional(dt=dt, seed=seed, json_file=json, figures=figures)


@reproduce.command(name="acc")
def acc(
    *,
    samples: Path | None = None,
    count: WholeOrNone = None,
    spread: float | None = None,
    seed: WholeOrNone = None,
    json: JsonFile = None,
    figures: Figures = Path("quell-figures"),
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
    from quell.cli.commands.acc import reproduce_acc

    reproduce_acc(
        samples=samples, count=count, spread=spread, seed=seed, json_file=json, figures=figures
    )


@app.command(name="stress")
def stress(
    *,
    runs: Whole = 600,
    honest: Whole = 100,
    seed: Whole = 0,
    guard: bool = True,
    json: JsonFile = None,
    figures: Figures = Path("quell-figures"),
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
    from quell.cli.commands.stress import run_stress

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
    seed: Whole = 0,
    json: JsonFile = None,
    figures: Figures = Path("quell-figures"),
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
    from quell.cli.commands.compare import run_compare
    from quell.experiments.compare.study import Benchmark

    settings = Benchmark(m1=m1, m2=m2, k=k, dt=dt, u_max=u_max, seed=seed)
    run_compare(controllers=controllers, settings=settings, json_file=json, figures=figures)


@app.command(name="identify")
def identify(
    data: Path,
    *,
    order: Whole = 4,
    zeros: Whole = 0,
    integrators: WholeOrNone = None,
    columns: str = "",
    dt: float | None = None,
    delay: float = 0.0,
    max_delay: float | None = None,
    friction: bool = False,
    held_out: float = 0.3,
    horizon: Whole = 10,
    json: JsonFile = None,
    figures: Figures = Path("quell-figures"),
) -> None:
    """Fit a continuous transfer function to recorded input and output.

    Parameters
    ----------
    data
        CSV file of the record, with or without a line of names; commas, semicolons or tabs between.
    order
        Number of poles.
    zeros
        Number of zeros.
    integrators
        How many poles lie at s = 0: by default one is put there if the slowest can't be told from it.
    columns
        Names or numbers (from 1 on) of the columns: t,u,y by default, or t,u,y,r with what was sent into a closed loop from outside.
    dt
        Sample time [s] of a record without times; columns are then u,y by default.
    delay
        How late u is [s].
    max_delay
        Look for the delay from --delay up to this [s].
    friction
        Find Coulomb friction along with the model.
    held_out
        Share of the record, its end, that the model is judged on.
    horizon
        How many samples ahead is predicted.
    json
        Write all results to this file, for programs.
    figures
        Put the figure into this folder, as PNG and SVG.
    """
    from quell.cli.commands.identify import run_identify

    run_identify(
        data=data,
        order=order,
        zeros=zeros,
        integrators=integrators,
        columns=columns,
        dt=dt,
        delay=delay,
        max_delay=max_delay,
        friction=friction,
        held_out=held_out,
        horizon=horizon,
        json_file=json,
        figures=figures,
    )


@app.command(name="excite")
def excite(
    out: Path,
    *,
    kind: str = "prbs",
    low: float = 0.5,
    high: float = 60.0,
    duration: float = 60.0,
    dt: float = 1e-3,
    u_min: float = -1.0,
    u_max: float = 1.0,
    seed: Whole = 0,
) -> None:
    """Design an input that excites a band within limits, for quell identify, and write it as CSV.

    Parameters
    ----------
    out
        CSV file to write, with columns t,u.
    kind
        multisine, prbs or chirp.
    low
        Lowest frequency of the band [rad/s].
    high
        Highest frequency of the band [rad/s].
    duration
        How long it takes [s].
    dt
        Sample time [s].
    u_min
        Lower limit of u.
    u_max
        Upper limit of u.
    seed
        Where a PRBS begins, or the phase of a multisine.
    """
    from quell.cli.commands.identify import run_excite

    run_excite(
        kind=kind,
        low=low,
        high=high,
        duration=duration,
        dt=dt,
        u_min=u_min,
        u_max=u_max,
        seed=seed,
        out=out,
    )


@app.command(name="rig")
def rig(
    *,
    device: str,
    plant: str = "torsional",
    dt: float = 1e-3,
    watchdog: Whole = 20,
    u_max: float = float("inf"),
    rest: bool = True,
    seconds: float | None = None,
    log: Path | None = None,
    priority: Whole = 50,
    cpu: WholeOrNone = None,
) -> None:
    """Be the device at the other end of a wire: a simulated plant with a clock and a watchdog of its own, until interrupted.

    Parameters
    ----------
    device
        Where it listens: udp://127.0.0.1:5005 (this computer only; another address of this computer for others to reach it), shm://NAME,
        or serial:///dev/ttyX.
    plant
        Name of the plant, for example torsional; the message for an unknown name lists all names.
    dt
        Its tick [s].
    watchdog
        After so many ticks in a row without a fresh command u is zero until a new session.
    u_max
        Larger commands are cut to this [V, N].
    rest
        Whether each session starts from rest, or from where the last one left the plant.
    seconds
        For how long [s]; until interrupted by default.
    log
        Write each tick to this CSV file: y, u as applied, the command as it came, state.
    priority
        SCHED_FIFO priority of the ticks, 1 to 99; 0 for ordinary scheduling. What is not permitted is said at the end.
    cpu
        Number of the processor that the ticks are to have; any by default.
    """
    from quell.cli.commands.rig import run_rig

    settings = {"dt": dt, "watchdog": watchdog, "u_max": u_max, "rest": rest}
    run_rig(
        device=device,
        plant=plant,
        settings=settings,
        seconds=seconds,
        log=log,
        priority=priority,
        cpu=cpu,
    )


app.command(setups.run, name="run")
app.command(setups.run_rig, name="run-rig")
app.command(setups.replay, name="replay")


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
    except ImportError as error:  # an extra is not installed: the message says which
        print(f"quell: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("quell: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
