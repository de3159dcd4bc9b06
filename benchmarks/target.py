"""Instructions, code, state and stack of exported controllers on a Cortex-M, in the emulator.

    python benchmarks/target.py [--optimise=-O2] [--samples 20000] [--only TEXT]

Each controller is exported to C, compiled by ``arm-none-eabi-gcc -O2 -fpeel-loops``, which unrolls
its short loops, or with other options, without FMA, and run in
``qemu-system-arm`` over r and y of a loop that quell has simulated before, with noise. Instructions
are those of a step with its call, counted by the emulated timer (``target.c``); they are no
cycles: a Cortex-M4 takes 1 for most, 1 to 3 for a load or a jump, 14 for a division or root. Code
and constants are those of the exported file, with all its functions, without the C library. The
stack is painted and measured. Then the RMS difference of u to quell's own in double precision,
relative to the RMS of u, and the largest difference in the golden vectors of the export, which are
of the same precision.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measured import not_run, options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.experiments import two_mass_spring as study
from quell.export import CSource, c_source

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "examples" / "target"))
import emulator  # noqa: E402

# An instruction takes 1024 ns of emulated time, 25.6 ticks of the timer (see target.c).
_COUNTING = ("-icount", "shift=10,sleep=off")
# The loop of known length in target.c.
_KNOWN = 1000.0
DRIVE = ql.plants.LinearPlant(A=[[0.0, 1.0], [0.0, -0.6]], B=[0.0, 5.0], C=[1.0, 0.0])

# The memory image, and instructions that it takes to save and to load it.
_MEMORY = ("image [B]", "save", "load")
OPTIMISE = "-O2 -fpeel-loops"
TYPES = {"single": ("float", np.float32), "double": ("double", np.float64)}


class Case(NamedTuple):
    """A controller on a processor, in a precision, with bars."""

    name: str
    board: str
    precision: str
    plant: Any
    controller: Any
    bars: dict[str, float] = {}  # nobody changes it


def cases() -> list[Case]:
    """Return the rows of the table."""
    two_mass, m4, m7 = ql.plants.two_mass_spring(), "Cortex-M4F", "Cortex-M7"
    limits = {"u_min": -10.0, "u_max": 10.0}
    observer = ql.ESO.model_free(order=2, b0=5.0, omega_o=50.0, dt=1e-3)
    mf = ql.ADRC(observer, omega_c=10.0, **limits)
    ramps = ql.ESO.model_free(2, b0=5.0, omega_o=50.0, dt=1e-3, disturbance_order=2)
    mf_2 = ql.ADRC(ramps, omega_c=10.0, **limits)
    # Tables over the reference, which moves through all cells; 60 instructions more are the bar.
    points, b0 = (-1.0, -0.5, 0.0, 0.5, 1.0), (2.0, 3.0, 4.0, 5.0, 20.0)
    bandwidths = (10.0, 11.0, 12.0, 13.0, 14.0), (50.0, 51.0, 52.0, 53.0, 54.0)

    def scheduled(schedule: Any) -> ql.ADRC:
        return ql.ADRC(observer, omega_c=10.0, schedule=schedule, **limits)

    of_b0 = scheduled(ql.Schedule(points, "reference", b0))
    of_all = scheduled(ql.Schedule(points, "reference", b0, *bandwidths))
    online = scheduled(ql.OnlineGain(2.0, 20.0))
    # The reference of the runs gives a new target in each sample: each step plans a move.
    moves = "MF-ESO, order 2, feedforward, moves"
    fed = ql.ADRC(observer, omega_c=10.0, feedforward=ql.Feedforward.of(DRIVE), **limits)
    moving = ql.controllers.Prefiltered(fed, ql.controllers.ProfileGenerator(2.0, 20.0, 500.0))
    pid = ql.baselines.PID(20.0, ki=30.0, kd=3.0, tf=0.01, dt=1e-3, **limits)
    on_top = ql.Compensator(observer, **limits)
    both = ql.Compensated(pid, on_top)
    bands = ql.SafeSet(-1.5, 1.5, alpha=8.0, f_rate=1.0)
    safe = ql.ADRC(observer, omega_c=10.0, safe_set=bands, **limits)
    learners = ql.learners
    guarded = law(learners.Kalman(), ql.Guard())
    network, process = law(learners.MLP(hidden=5)), law(learners.GaussianProcess(budget=20))
    l_eso = "L-ESO, order 4, Kalman, guard"
    small = {"instructions": 220.0, "state": 100.0}
    large = {"instructions": 2200.0, "state": 700.0, "stack": 250.0}
    return [
        Case("PID", m4, "single", DRIVE, pid),
        Case("MF-ESO, order 2", m4, "single", DRIVE, mf, small),
        Case("MF-ESO, order 2, table of b0", m4, "single", DRIVE, of_b0, {"instructions": 229.0}),
        Case("MF-ESO, order 2, three tables", m4, "single", DRIVE, of_all),
        Case("MF-ESO, order 2, b0 online", m4, "single", DRIVE, online),
        Case("MF-ESO, order 2", m7, "double", DRIVE, mf),
        Case("compensator, order 2", m4, "single", DRIVE, on_top),
        Case("PID with a compensator", m4, "single", DRIVE, both),
        Case("MF-ESO, order 2, safe set", m4, "single", DRIVE, safe),
        Case("MF-ESO, order 2, f and f'", m4, "single", DRIVE, mf_2),
        Case(moves, m4, "single", DRIVE, moving),
        Case(moves, m7, "double", DRIVE, moving),
        Case("MF-ESO, order 4", m4, "single", two_mass, law()),
        Case(l_eso, m4, "single", two_mass, guarded, large),
        Case(l_eso, m7, "single", two_mass, guarded),
        Case(l_eso, m7, "double", two_mass, guarded),
        Case(l_eso, m4, "double", two_mass, guarded),
        Case("L-ESO, order 4, MLP(hidden=5)", m4, "single", two_mass, network),
        Case("L-ESO, order 4, GaussianProcess(budget=20)", m4, "single", two_mass, process),
    ]


def law(learner: Any = None, guard: Any = None) -> ql.ADRC:
    """Return the controller of the two-mass study with limits, a learner and a guard."""
    settings = study.Settings()
    observer = study.controller(settings).observer
    limits = {"u_min": -10.0, "u_max": 10.0}
    return ql.ADRC(observer, settings.omega_c, learner=learner, guard=guard, **limits)


def simulated(case: Case, samples: int) -> ql.Trajectory:
    """Return a run with noise, a moving reference and a load."""
    scenario = ql.Scenario(
        reference=ql.signals.Sinusoid(amplitude=1.0, omega=1.0),
        noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=(samples - 1) * case.controller.dt,
    )
    return ql.simulate(case.plant, case.controller, scenario)


def export(controller: Any, precision: str, name: str, folder: Path) -> None:
    """Write header and source of a controller."""
    if precision == "single":
        controller = ql.controllers.in_single_precision(controller)
    write_source(c_source(controller, name), folder)


def write_source(source: CSource, folder: Path) -> None:
    """Write header and source."""
    (folder / f"{source.name}.h").write_text(source.header, encoding="utf-8")
    (folder / f"{source.name}.c").write_text(source.source, encoding="utf-8")


def measured(
    case: Case, run: ql.Trajectory, folder: Path, optimise: str = OPTIMISE
) -> dict[str, float]:
    """Return what a case costs on its target, in instructions and bytes."""
    board = emulator.BOARDS[case.board]
    export(case.controller, case.precision, "counted", folder)
    real, dtype = TYPES[case.precision]
    r, y, u = run["r"].astype(dtype), run["y_measured"].astype(dtype), run["u"]
    (folder / "samples.bin").write_bytes(r.tobytes() + y.tobytes() + u.tobytes())
    program, flags = folder / "target.elf", (f"-DREAL={real}", f"-DSAMPLES={len(run)}")
    sources = [HERE / "target.c", folder / "counted.c"]
    includes = (f"-I{folder}", f"-Wa,-I{folder}", *optimise.split())
    emulator.build(board, program, sources, *flags, *includes)
    code, output = emulator.run(board, program, *_COUNTING, timeout=600.0)
    if code:
        raise RuntimeError(f"{case.name}: the program has ended with {code}: {output}")
    found = {name: float(value) for name, value in (line.split() for line in output.splitlines())}
    if abs(found["known"] - _KNOWN) > 1.0:
        raise RuntimeError(f"{found['known']} instructions counted where there are {_KNOWN:.0f}")
    text, constants = emulator.sizes(board, folder / "counted.c", f"-I{folder}", *optimise.split())
    return {
        "instructions": found["mean"],
        "most": found["most"],
        "code": text,
        "constants": constants,
        "state": found["state"],
        "stack": found["stack"],
        "image": found["image"],
        "save": found["save"],
        "load": found["load"],
        "difference": found["difference"],
    }


def golden(case: Case, folder: Path) -> float:
    """Return the largest difference in the golden vectors, run on the board [ulp]."""
    ql.export.c(case.controller, folder, name="servo", precision=case.precision, accept=True)
    board, program, source = emulator.BOARDS[case.board], folder / "test.elf", folder / "src"
    parts = [folder / "test_servo.c", source / "servo.c"]
    emulator.build(board, program, parts, f"-I{source}")
    code, output = emulator.run(board, program)
    found = re.search(r"largest difference (\S+) ulp", output)
    if code or found is None:
        raise RuntimeError(f"{case.name}: {output}")
    return float(found[1])


def shown(case: Case, found: dict[str, float]) -> list[str]:
    """Return a row of the table."""

    def text(name: str) -> str:
        bar = case.bars.get(name)
        over = "" if bar is None else f" ≤ {bar:.0f}" if found[name] <= bar else f" > {bar:.0f} (!)"
        return f"{found[name]:.0f}{over}"

    names = ("instructions", "most", "code", "constants", "state", "stack", "image", "save", "load")
    last = (f"{found['difference']:.1e}", f"{found['golden']:.3g}")
    return [case.name, case.board, case.precision, *map(text, names), *last]


def main() -> None:
    """Measure all cases; print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--samples", type=int, default=20_000, help="steps of each run")
    parser.add_argument("--optimise", default=OPTIMISE, help="options of the compiler")
    parser.add_argument("--only", default="", help="controllers whose name has this text")
    arguments = options_of(parser, samples=500, only="table of b0")
    if tool := emulator.missing_tool():
        not_run(arguments, f"{tool} is not installed; {emulator.INSTALL}")
    figures, runs = {}, dict[str, ql.Trajectory]()
    heads = ("controller", "processor", "precision", "instructions, mean", "most", "code [B]")
    table = Table(
        *heads, "constants [B]", "state [B]", "stack [B]", *_MEMORY, "u − double", "golden [ulp]"
    )
    table.title = f"arm-none-eabi-gcc {arguments.optimise}"
    for case in cases():
        if arguments.only not in case.name:
            continue
        if case.name not in runs:
            runs[case.name] = simulated(case, arguments.samples)
        with tempfile.TemporaryDirectory() as folder:
            found = measured(case, runs[case.name], Path(folder), arguments.optimise)
            found["golden"] = golden(case, Path(folder) / "golden")
        table.add_row(*shown(case, found))
        figures[f"{case.name}, {case.board}, {case.precision}"] = found
    Console().print(table)
    write(arguments, figures)


if __name__ == "__main__":
    main()
