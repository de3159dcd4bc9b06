"""A servo on an emulated Cortex-M4F learns its cogging, loses its power, and knows it again.

The motor has cogging of five orders, up to 0.08 N m, and an encoder without index pulse. The
controller is exported in single precision. On the first day the axis turns and learns, and saves
its memory to flash: here a file. The emulator is then ended, and started again: on the second day
the program loads the image, the encoder counts from another angle, and the map is found again,
shifted, within half a revolution. The same image then tells Python what was learned, and a new
firmware is exported that begins with it.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from target import emulator

import quell as ql
from quell.controllers import in_single_precision
from quell.features import Bias, Friction, Periodic
from quell.learners import RLS

DT, SPEED = 1e-3, np.pi  # [s], [rad/s]: half a revolution a second
COGGING = [(7, 0.043), (12, 0.013, 1.0), (14, 0.017, 2.0), (28, 0.028, 0.5), (36, 0.014, 2.5)]
INERTIA = 2e-4  # [kg m²]
MOTOR = ql.plants.dc_motor(cogging=COGGING, inertia=INERTIA)


def controller(learner: RLS | None) -> ql.ADRC:
    """Return the servo's controller."""
    b0 = float(MOTOR.linear.B[1, 0])
    observer = ql.ESO.model_free(order=2, b0=b0, omega_o=150.0, dt=DT)
    limits = {"u_min": -24.0, "u_max": 24.0}
    return ql.ADRC(observer, omega_c=30.0, learner=learner, feedforward=True, **limits)


def day(folder: Path, law: ql.ADRC, halves: int, start: float) -> tuple[str, list[float]]:
    """Run the emulated board from power-on to power-off; return what it has printed."""
    source = ql.export.c_source(in_single_precision(law), "servo")
    plant = ql.export.plant_source(MOTOR, DT)
    for each in (source, plant):
        (folder / f"{each.name}.h").write_text(each.header)
        (folder / f"{each.name}.c").write_text(each.source)
    parts = [emulator.HERE / "power_cycle.c", folder / "servo.c", folder / "plant.c"]
    numbers = {"HALVES": halves, "HALF": round(np.pi / SPEED / DT), "START": start, "SPEED": SPEED}
    flags = [f"-D{name}=({value})" for name, value in numbers.items()]
    board = emulator.BOARDS["Cortex-M4F"]
    emulator.build(board, folder / "servo.elf", parts, f"-I{folder}", *flags)
    command = emulator.emulated(board, folder / "servo.elf", "-serial", "none")
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stdout + done.stderr)
    first, *errors = done.stdout.split("\n")
    return first, [1e3 * float(each) for each in errors if each]


if tool := emulator.missing_tool():
    print(f"skipped: {tool} is not installed; {emulator.INSTALL}")
    sys.exit()

orders = [order for order, *_ in COGGING]
learner = RLS(Periodic(orders=orders) + Friction(speed=0.05) + Bias(), recall=True)
with tempfile.TemporaryDirectory() as name:
    folder, law = Path(name), controller(learner)
    plain = day(folder, controller(None), 4, 0.0)[1]
    (folder / "flash.bin").unlink()  # of another controller
    print(f"without learner: {plain[-1]:.2f} mrad RMS over half a revolution")
    said, first = day(folder, law, 12, 0.0)
    print(f"first day, {said}: {first[0]:.2f} mrad, at the end {first[-1]:.2f} mrad")
    said, second = day(folder, law, 4, 2.0)
    shown = ", ".join(f"{each:.2f}" for each in second)
    print(f"second day, {said}: {shown} mrad in halves of a revolution")
    image = (folder / "flash.bin").read_bytes()
    reader = in_single_precision(law)
    reader.restore(image, running=True)
    amplitudes = np.hypot(*np.array([*reader.estimate.theta.values()][:10]).reshape(5, 2).T)
    torques = np.round(INERTIA * amplitudes, 3)
    print(f"image of {len(image)} bytes; amplitudes that were learned [N m]: {torques}")
    assert said == "loaded"
    assert second[1] < 0.1 * plain[-1]
    assert second[2] < 1.2 * first[-1]
    firmware = ql.export.c_source(reader, "servo").source
    print("new firmware begins with the map:", "initial_1" in firmware)
