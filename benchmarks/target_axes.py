"""Instructions of a step of three coupled axes over those of three single controllers.

    python benchmarks/target_axes.py [--optimise=-O2] [--samples 2000] [--only TEXT]

The axes have a constant B0, limits of u, and the learners in the row, each with a guard; the single
controllers have the same observers, laws, learners and guards, and the same limits. Both run in the
emulator (``target.py``, ``target_axes.c``) over r and y of a loop of the axes with a coupled plant
that quell has simulated. The bar of the ratio is 1.15 for axes with learners on a Cortex-M4F.

u stays within limits of 20, and is at those of 1.5 in nearly all samples; "at limits" is their
share.
"""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from measured import not_run, options_of, parser_of, write
from rich.console import Console
from rich.table import Table
from target import HERE, OPTIMISE, TYPES, emulator, export, write_source

import quell as ql
from quell.export import c_source

B0 = np.array([[1.0, 0.3, 0.1], [0.2, 2.0, 0.1], [0.0, 0.3, 0.5]])
WIDE_LIMIT, NARROW_LIMIT = 20.0, 1.5
BAR, _KNOWN = 1.15, 1000.0
ROWS: dict[str, tuple[Any, ...]] = {
    "three without learner": (None, None, None),
    "three Kalman": (ql.learners.Kalman(), ql.learners.Kalman(), ql.learners.Kalman()),
    "Harmonic, Kalman, RLS": (ql.learners.Harmonic(), ql.learners.Kalman(), ql.learners.RLS()),
    "three NLMS": (ql.learners.NLMS(), ql.learners.NLMS(), ql.learners.NLMS()),
}
RULES = {"each": "each", "direction": "direction", "priority": ["axis2", "axis1", "axis3"]}


def joint(learner: Any, **limits: float) -> ql.ADRC:
    """Return the controller of an axis."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3)
    guard = None if learner is None else ql.Guard()
    return ql.ADRC(observer, 8.0, learner=learner, guard=guard, **limits)


def simulated(controller: ql.Axes, samples: int) -> Any:
    """Return a run with a plant that couples the axes, with friction and springs."""
    A, B = np.zeros((6, 6)), np.zeros((6, 3))
    A[:3, 3:] = np.eye(3)
    A[3:] = [[-4, 1, 0, -0.5, 0, 0], [1, -9, 1, 0, -1.0, 0.2], [0, 1, -2, 0, 0.2, -0.3]]
    B[3:] = 1.2 * B0
    plant = ql.plants.LinearPlant(A, B, np.eye(6)[:3])
    references = tuple(ql.signals.Sinusoid(0.5, omega) for omega in (2.0, 3.0, 5.0))
    noise = ql.signals.BandLimitedNoise(power=1e-12, sample_time=1e-3)
    duration = (samples - 1) * controller.dt
    scenario = ql.Scenario(references, duration=duration, noise=noise)
    return ql.simulate(plant, controller, scenario, interpret=True)  # compiling takes longer


def axes_with(learners: tuple[Any, ...], rule: Any, limit: float) -> ql.Axes:
    """Return the axes with learners and a rule for saturation."""
    axes = [joint(each) for each in learners]
    return ql.Axes(axes, B0, saturation=rule, u_min=-limit, u_max=limit)


def measured(
    learners: tuple[Any, ...],
    rule: Any,
    limit: float,
    run: Any,
    board: str,
    precision: str,
    optimise: str,
) -> dict[str, float]:
    """Return the instructions of a step of the axes, and of the single controllers together."""
    axes = axes_with(learners, rule, limit)
    real, dtype = TYPES[precision]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_source(c_source(axes, "axes", precision=precision), folder)
        for name, learner in zip(("one", "two", "three"), learners, strict=True):
            export(joint(learner, u_min=-limit, u_max=limit), precision, name, folder)
        numbers = run["r"].astype(dtype).tobytes() + run["y_measured"].astype(dtype).tobytes()
        (folder / "samples.bin").write_bytes(numbers)
        program = folder / "target.elf"
        names = ("axes", "one", "two", "three")
        sources = [HERE / "target_axes.c", *(folder / f"{name}.c" for name in names)]
        flags = (f"-DREAL={real}", f"-DSAMPLES={len(run)}", f"-I{folder}", f"-Wa,-I{folder}")
        chip = emulator.BOARDS[board]
        emulator.build(chip, program, sources, *flags, *optimise.split())
        code, output = emulator.run(chip, program, "-icount", "shift=10,sleep=off", timeout=600.0)
    if code:
        raise RuntimeError(f"the program has ended with {code}: {output}")
    found = {name: float(value) for name, value in (line.split() for line in output.splitlines())}
    if abs(found["known"] - _KNOWN) > 1.0:
        raise RuntimeError(f"{found['known']} instructions counted where there are {_KNOWN:.0f}")
    return found


def main() -> None:
    """Measure all rows; print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--samples", type=int, default=2000, help="steps of each run")
    parser.add_argument("--only", default="", help="rows whose name has this text")
    parser.add_argument("--optimise", default=OPTIMISE, help="options of the compiler")
    parser.add_argument("--rules", nargs="+", choices=RULES, default=[*RULES])
    parser.add_argument("--limits", type=float, nargs="+", default=[WIDE_LIMIT, NARROW_LIMIT])
    options = options_of(
        parser, samples=100, only="without", rules=["direction"], limits=[WIDE_LIMIT]
    )
    if tool := emulator.missing_tool():
        not_run(options, f"{tool} is not installed; {emulator.INSTALL}")
    title = f"instructions of a step, arm-none-eabi-gcc {options.optimise}"
    table = Table("axes", "saturation", "limits", "at limits", "processor", "precision",
                  "three axes", "most", "three single ones", "ratio", "state [B]",
                  "states of the single ones [B]", title=title)  # fmt: skip
    figures = {}
    for (name, learners), limit in itertools.product(ROWS.items(), options.limits):
        if options.only not in name:
            continue
        run = simulated(axes_with(learners, "each", limit), options.samples)
        for rule in options.rules:
            given = RULES[rule]
            for board, precision in (("Cortex-M4F", "single"), ("Cortex-M7", "double")):
                if precision == "double" and (rule != "each" or limit != WIDE_LIMIT):
                    continue
                found = measured(learners, given, limit, run, board, precision, options.optimise)
                ratio = found["together"] / found["alone"]
                mark = " (!)" if ratio > BAR and learners[0] is not None else ""
                cells = (f"{found[key]:.0f}" for key in ("together", "most", "alone"))
                sizes = (f"{found[key]:.0f}" for key in ("state", "states"))
                table.add_row(name, rule, f"{limit:g}", f"{100 * found['limited']:.0f} %", board,
                              precision, *cells, f"{ratio:.3f}{mark}", *sizes)  # fmt: skip
                label = f"{name}, {rule}, limits {limit:g}, {board}, {precision}"
                figures[label] = {"ratio": ratio, **found}
    Console(width=160).print(table)
    write(options, figures)


if __name__ == "__main__":
    main()
