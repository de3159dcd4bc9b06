"""The projects for boards: an STM32 in the emulator, an Arduino on this machine, an ESP32 compiled."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import quell as ql
from quell.export import plant_source
from quell.identification import Measured, read_record
from quell.setup import load

ROOT, HERE = Path(__file__).parents[1], Path(__file__).with_name("boards")
TARGET = ROOT / "examples" / "target"
COUNT = 2.0 * np.pi / 2048.0  # [rad]
WARNINGS = ("-Wall", "-Wextra", "-Werror")
FAULTS = {
    "-DFAULT=1": "the encoder counts down under a positive voltage",
    "-DFAULT=2": "the motor does not move, or the encoder does not count",
    "-DFAULT=3": "u is at its limit and nothing moves",
    "-DMOTOR_TRAVEL=5.0f": "it is beyond MOTOR_TRAVEL",
}
pytestmark = pytest.mark.skipif(not TARGET.exists(), reason="there are no examples here")


@pytest.fixture(scope="module")
def example() -> ModuleType:
    """Return the example of the STM32, which builds and runs its program."""
    spec = importlib.util.spec_from_file_location("example", ROOT / "examples/17_stm32_motor.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the exported controller and the plant of the projects."""
    folder = tmp_path_factory.mktemp("firmware")
    setup = load(TARGET / "motor.toml")
    ql.export.c(setup.controller, folder, name="axis", precision="single", accept=True)
    plant = plant_source(setup.plant, setup.controller.dt)
    (folder / "plant.h").write_text(plant.header)
    (folder / "plant.c").write_text(plant.source)
    return folder


def simulated(record: Measured, load_at: int | None = None) -> ql.Trajectory:
    """Return the simulation of the loop of a log, perhaps with a load from a sample on."""
    setup, r, dt = load(TARGET / "motor.toml"), record.reference, record.dt
    assert r is not None
    steps = [ql.signals.Step(r[k + 1] - r[k], at=(k + 1) * dt) for k in np.flatnonzero(np.diff(r))]
    reference = ql.signals.Sum(tuple(steps))
    torque = 0.0 if load_at is None else ql.signals.Step(-0.02, at=load_at * dt)
    duration = (record.y.size - 1) * dt
    scenario = ql.Scenario(reference, duration, disturbances=(torque, 0.0))
    return ql.simulate(setup.plant, setup.controller, scenario, interpret=True)


def compiled(*command: str | Path) -> None:
    """Run a compiler; it must say nothing."""
    done = subprocess.run([*command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.trial
def test_the_stm32_moves_and_bears_a_load_as_simulated(example: ModuleType, tmp_path: Path) -> None:
    """Its timer, its PWM registers and its serial line are the emulator's; y of 1500 samples is within 3 counts."""
    if tool := example.emulator.missing_tool():
        pytest.skip(f"{tool} is not installed")
    mode, log = example.on_target(tmp_path, "-DLOAD=(-0.02)")
    assert mode.startswith("runs, y = 6.")
    (tmp_path / "log.csv").write_text(log)
    record = read_record(tmp_path / "log.csv", ("t", "u", "y", "r"))
    assert (record.y.size, record.signals.y.unit, record.signals.u.unit) == (1500, "rad", "V")
    run = simulated(record, 1050)
    assert np.max(np.abs(run["y"] - record.y)) < 3.0 * COUNT
    assert np.max(np.abs(run["u"] - record.u)) < 0.1
    assert np.max(np.abs(record.u)) > 1.0


@pytest.mark.trial
@pytest.mark.parametrize(("flag", "said"), FAULTS.items())
def test_a_first_motion_that_goes_wrong_ends_without_voltage(
    flag: str, said: str, example: ModuleType, tmp_path: Path
) -> None:
    """Wires of the encoder that are changed, a dead supply, a blocked shaft, a run beyond the travel; it says which."""
    if tool := example.emulator.missing_tool():
        pytest.skip(f"{tool} is not installed")
    mode, _ = example.on_target(tmp_path, flag)
    assert mode.startswith(f"fault: {said}")


@pytest.mark.trial
@pytest.mark.skipif(shutil.which("arm-none-eabi-gcc") is None, reason="no compiler for Arm")
def test_the_program_of_the_board_is_built_as_its_page_says(firmware: Path, tmp_path: Path) -> None:
    """Without the simulation, at the address of the flash memory; the command is the page's."""
    page = (ROOT / "docs" / "target_stm32.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"arm-none-eabi-gcc -.*?motor\.elf", page, re.DOTALL)
    words = command.replace("\\\n", " ").replace("firmware", str(firmware)).split()
    words[-1] = str(tmp_path / "motor.elf")
    done = subprocess.run([*words, *WARNINGS], cwd=TARGET, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    header = subprocess.run(
        ["arm-none-eabi-objdump", "-h", words[-1]], capture_output=True, text=True, check=True
    )
    assert re.search(r"\.text\s+\w+\s+08000000", header.stdout)


@pytest.mark.trial
@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is missing")
def test_the_sketch_moves_a_motor(firmware: Path, tmp_path: Path) -> None:
    """Compiled for this machine with a stand-in for Arduino: each edge of the encoder, 8 bits of PWM; y is within 8 counts, and off when its log is written."""
    sketch = TARGET / "arduino" / "motor" / "motor.ino"
    (tmp_path / "Arduino.h").write_text("")
    sources = HERE / "simulated_arduino.cpp", TARGET / "motor.c", firmware / "src" / "axis.c"
    include = [f"-I{each}" for each in (tmp_path, firmware, firmware / "src", TARGET)]
    program = tmp_path / "sketch"
    define = f'-DSKETCH="{sketch}"'
    plant = firmware / "plant.c"
    compiled("g++", *WARNINGS, "-O1", *include, define, *sources, plant, "-o", program)
    said = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    mode, _, log = said.partition("\n")
    assert mode.startswith("runs, y = 6.")
    (tmp_path / "log.csv").write_text(log)
    record = read_record(tmp_path / "log.csv", ("t", "u", "y", "r"))
    assert record.y.size > 1000
    run = simulated(record)
    assert np.max(np.abs(run["y"] - record.y)) < 8.0 * COUNT


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is missing")
def test_the_projects_with_vendors_code_compile(tmp_path: Path) -> None:
    """ESP-IDF and the HAL are not here: their types are stand-ins. The common part is C and C++."""
    names = ("gpio", "gptimer", "ledc", "pulse_cnt")
    headers = [*(f"driver/{name}.h" for name in names), "freertos/FreeRTOS.h", "freertos/task.h"]
    for name in (*headers, "esp_attr.h", "esp_err.h"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f'#include "{HERE}/esp_idf.h"\n')
    (tmp_path / "axis.h").write_text("#define AXIS_SAMPLE_TIME 1e-3\n")
    for source in ("esp32/main/main.c", "stm32/hal.c"):
        include = [f"-I{each}" for each in (tmp_path, HERE, TARGET)]
        options = ("-std=gnu11", "-fsyntax-only", "-Wno-int-to-pointer-cast")
        compiled("gcc", *WARNINGS, *options, *include, TARGET / source)
