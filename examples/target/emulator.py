"""Programs for a Cortex-M, built with ``arm-none-eabi-gcc`` and run in ``qemu-system-arm``.

The machines are models of ARM's MPS2 boards.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
COMPILER, EMULATOR = "arm-none-eabi-gcc", "qemu-system-arm"
INSTALL = (
    "on Debian and Ubuntu: "
    "apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
)


class Board(NamedTuple):
    """A board: the emulator's name of it, and the flags of its processor."""

    machine: str
    flags: tuple[str, ...]


STM32 = Board("netduinoplus2", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16"))
"""A Netduino Plus 2: the STM32F405 of ``stm32/board.c``, with its timers and its serial line."""
BOARDS = {
    "Cortex-M4F": Board("mps2-an386", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16")),
    "Cortex-M7": Board("mps2-an500", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16")),
}
"""The M4F computes single precision in hardware, double in software; the M7 both in hardware."""

# Without FMA, so that the target computes what the host computes.
FLAGS = (
    *("-std=c99", "-mthumb", "-mfloat-abi=hard", "-ffp-contract=off", "-O2"),
    *("-Wall", "-Wextra", "-Werror"),
)
# newlib's semihosting, kept by -u: the emulator prints and takes the result of main.
LINK = (
    *("-nostartfiles", "--specs=rdimon.specs", "-T", str(HERE / "target.ld")),
    *("-L", str(HERE)),
    "-Wl,--gc-sections,-u,exit,-u,initialise_monitor_handles",
)


def missing_tool() -> str:
    """Return the tool that is not installed, or an empty string."""
    return next((tool for tool in (COMPILER, EMULATOR) if shutil.which(tool) is None), "")


def build(board: Board, program: Path, sources: Sequence[Path], *flags: str) -> None:
    """Compile and link a program; ``RuntimeError`` has the messages of the compiler."""
    parts = ["-I", str(HERE), str(HERE / "startup.c"), *map(str, sources), "-lm"]
    command = [COMPILER, *board.flags, *FLAGS, *LINK, *flags, *parts, "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}:\n{done.stderr}")


def build_stm32(program: Path, firmware: Path, sources: Sequence[Path], *flags: str) -> None:
    """Compile and link ``stm32/board.c`` with a controller in ``firmware``, as its page does.

    It has nothing of the emulator: semihosting neither, so that it runs without a debugger.
    """
    parts = [HERE / "startup.c", HERE / "stm32" / "board.c", HERE / "motor.c"]
    parts += [firmware / "src" / "axis.c", *sources]
    folders = (f"-I{HERE}", f"-I{firmware / 'src'}", f"-L{HERE}", f"-T{HERE}/stm32/stm32f405.ld")
    link = ("-nostartfiles", "--specs=nosys.specs", "-Wl,--gc-sections")
    command = [COMPILER, *STM32.flags, *FLAGS, *link, *folders, *flags, *map(str, parts), "-lm"]
    done = subprocess.run([*command, "-o", str(program)], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}:\n{done.stderr}")


def sizes(board: Board, source: Path, *flags: str) -> tuple[int, int]:
    """Return the bytes of code and of constants of a source, without libraries."""
    with tempfile.TemporaryDirectory() as folder:
        object_ = f"{folder}/object.o"
        command = [COMPILER, *board.flags, *FLAGS, *flags, "-c", str(source), "-o", object_]
        subprocess.run(command, check=True)
        command = ["arm-none-eabi-size", "-A", object_]
        lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    sections = re.findall(r"^(\.\S+)\s+(\d+)", lines, re.MULTILINE)
    code, constants = (
        sum(int(size) for name, size in sections if name.startswith(kind))
        for kind in (".text", ".rodata")
    )
    return code, constants


def emulated(board: Board, program: Path, *options: str) -> list[str]:
    """Return the command that runs a program: printf and exit() are those of this machine."""
    return [
        *(EMULATOR, "-M", board.machine, "-nographic", "-monitor", "none", "-semihosting"),
        *("-kernel", str(program), *options),
    ]


def run(board: Board, program: Path, *options: str, timeout: float = 60.0) -> tuple[int, str]:
    """Run a program until it exits; return its exit code and what it has printed."""
    command = emulated(board, program, "-serial", "none", *options)
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    return done.returncode, done.stdout + done.stderr


def run_stm32(program: Path, timeout: float = 60.0) -> tuple[int, str]:
    """Run a program for the STM32 until it exits; return its exit code and its serial line."""
    command = emulated(STM32, program, "-serial", "stdio")
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    return done.returncode, done.stdout


@contextmanager
def serial_line(board: Board, program: Path) -> Iterator[str]:
    """Run a program while the context lasts; yield the URL of its serial line."""
    command = emulated(board, program, "-serial", "pty")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"/dev/\S+", line)
        if found is None:
            raise RuntimeError(f"{EMULATOR}: {line}")
        yield f"serial://{found[0]}"
    finally:
        process.terminate()
        process.wait()
        process.stdout.close()
