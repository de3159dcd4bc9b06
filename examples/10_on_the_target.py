"""A controller that was tuned in Python runs on an emulated Cortex-M, compared with the simulation.

It has the feedforward of the drive's model, and plans moves within limits of speed, acceleration
and jerk to the targets that it gets. It is exported to C, joined with the device of the serial
line, and compiled for two boards with the C compiler for ARM. The emulator runs it; quell sends the
targets over its serial line and records the telemetry. The plant is simulated on the target, too.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from target import emulator

import quell as ql
from quell.controllers import Prefiltered, ProfileGenerator
from quell.realtime import open_device, record_target

DT = 1e-3
DRIVE = ql.plants.LinearPlant(A=[[0.0, 1.0], [0.0, -0.6]], B=[0.0, 5.0], C=[1.0, 0.0])
# The second target comes while the drive moves to the first one.
REFERENCE = ql.signals.Step(0.3, at=0.05) - ql.signals.Step(0.1, at=0.2)
LIMITS = {"v_max": 2.0, "a_max": 20.0, "j_max": 500.0}
LOAD_AT, LOAD, DURATION = 0.4, -3.0, 0.8


def on_target(board: emulator.Board, controller: Prefiltered, precision: str) -> ql.Trajectory:
    """Run the exported controller on a board; return its telemetry."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # Single precision is compared with double in a run before it is exported.
        loop = {"plant": DRIVE, "scenario": scenario} if precision == "single" else {}
        ql.export.c(controller, folder, name="servo", precision=precision, **loop)
        plant = ql.export.plant_source(DRIVE, DT)
        (folder / "plant.h").write_text(plant.header)
        (folder / "plant.c").write_text(plant.source)
        parts = [emulator.HERE / part for part in ("serial_target.c", "mps2_uart.c")]
        parts += [folder / "plant.c", folder / "src" / "servo.c"]
        program = folder / "servo.elf"
        flags = (f"-DLOAD_AT={round(LOAD_AT / DT)}", f"-DLOAD=({LOAD})", "-DMOST_WAIT=60000")
        emulator.build(board, program, parts, f"-I{folder}", f"-I{folder}/src", *flags)
        channels = (("r", 1), ("u", 1), *controller.channels)  # as serial_target.c sends them
        line = emulator.serial_line(board, program)
        with line as url, open_device(url, DT) as device:
            return record_target(device, REFERENCE, channels, DURATION, timeout=60.0)


if tool := emulator.missing_tool():
    print(f"skipped: {tool} is not installed; {emulator.INSTALL}")
    sys.exit()

constraints = ql.tuning.Constraints(m_ks=500.0)
how = {"feedforward": True, "compare": (), "constraints": constraints}
tuned = ql.tune(DRIVE, DT, u_min=-10.0, u_max=10.0, **how)
# The tuned controller is behind a generator of its own, for the limits of u: here are others.
controller = Prefiltered(tuned.design.controller, ProfileGenerator(**LIMITS))
print(tuned.summary().splitlines()[1])
load = ql.signals.Step(height=LOAD, at=LOAD_AT)
scenario = ql.Scenario(reference=REFERENCE, disturbances=(load,), duration=DURATION)
simulated = ql.simulate(DRIVE, controller, scenario, interpret=True)
for name, precision in (("Cortex-M4F", "single"), ("Cortex-M7", "double")):
    run = on_target(emulator.BOARDS[name], controller, precision)
    print(f"{name} in {precision} precision, {len(run)} samples, y = {run['y'][-1]:.6f} at the end")
    for channel in ("y", "u", "r_shaped", "u_feedforward", "f_residual"):
        largest, apart = np.max(np.abs(simulated[channel])), run[channel] - simulated[channel]
        print(
            f"    {channel}: differs from the simulation by {np.max(np.abs(apart)) / largest:.1e}"
        )
