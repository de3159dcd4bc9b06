"""A DC motor with an encoder at an STM32, in the emulator: first motion, moves, a load, its log.

``target/stm32`` is the whole program. The emulator has the processor, the timer, the PWM registers
and the serial line; a simulated motor is behind the pins. It is compared with ``simulate``.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import quell as ql
from quell.identification import read_record

sys.path.insert(0, str(Path(__file__).parent / "target"))
import emulator

SETUP = emulator.HERE / "motor.toml"
LOAD, LOAD_AT = -0.02, 1050  # [N m], samples
COUNT = 2.0 * np.pi / 2048.0  # [rad]


def on_target(folder: Path, *flags: str) -> tuple[str, str]:
    """Build the program, run it; return what it says of its mode, and its log."""
    setup = ql.setup.load(SETUP)
    loop = {"plant": setup.plant, "scenario": setup.scenario}
    ql.export.c(setup.controller, folder, name="axis", precision="single", overwrite=True, **loop)
    plant = ql.export.plant_source(setup.plant, setup.controller.dt)
    (folder / "plant.h").write_text(plant.header)
    (folder / "plant.c").write_text(plant.source)
    behind = [emulator.HERE / "stm32" / "simulated_motor.c", folder / "plant.c"]
    program = folder / "motor.elf"
    # The timers of the emulator count at 1 GHz: a second of the motor takes a quarter of one.
    emulated = ("-DSIMULATED", "-DTIMER_CLOCK=250000000u", f"-I{folder}", *flags)
    emulator.build_stm32(program, folder, behind, *emulated)
    _, said = emulator.run_stm32(program)
    mode, _, log = said.partition("\n")
    return mode, log


def main() -> None:
    """Run it, and compare."""
    if tool := emulator.missing_tool():
        print(f"skipped: {tool} is not installed; {emulator.INSTALL}")
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mode, log = on_target(folder, f"-DLOAD=({LOAD})")
        print(f"STM32F405: {mode}")
        (folder / "log.csv").write_text(log)
        record = read_record(folder / "log.csv", ("t", "u", "y", "r"))
    setup = ql.setup.load(SETUP)
    dt, y, u, r = record.dt, record.y, record.u, record.reference
    moves = [ql.signals.Step(r[k + 1] - r[k], at=(k + 1) * dt) for k in np.flatnonzero(np.diff(r))]
    load = ql.signals.Step(LOAD, at=LOAD_AT * dt)
    scenario = ql.Scenario(sum(moves, 0.0), (y.size - 1) * dt, disturbances=(load, 0.0))
    run = ql.simulate(setup.plant, setup.controller, scenario, interpret=True)
    apart = np.max(np.abs(run["y"] - y)) / COUNT, np.max(np.abs(run["u"] - u))
    print(f"{y.size} samples: y differs from the simulation by {apart[0]:.1f} counts at most")
    print(f"u by {apart[1]:.3f} V of {np.max(np.abs(u)):.2f} V")
    found = ql.identify(u[:LOAD_AT], y[:LOAD_AT], dt, order=2, friction=True)
    print(f"identified from the log: {found.describe().splitlines()[0]}")


if __name__ == "__main__":
    main()
