"""Code, constants, state and stack of an exported controller and its functions, as gcc tells."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

# Compilers for targets, of which the first that is here measures; then that of this machine.
_ARM = ("-mthumb", "-mfloat-abi=hard")
_TARGETS = {
    "single": ("Cortex-M4F", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", *_ARM)),
    "double": ("Cortex-M7", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", *_ARM)),
}
_CROSS = "arm-none-eabi-"
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off")
"""Flags with which the golden vectors hold bit for bit."""
# A compiler that takes longer hangs: the largest learners take some seconds.
_LONGEST = 120.0
# gcc 10 and later write the calls of functions, with the stack of each.
_CALLS = "-fcallgraph-info=su"


class Sizes(NamedTuple):
    """Bytes that a controller takes on a processor.

    Attributes
    ----------
    processor, compiler
        for which, and by which compiler (with ``-O2``).
    code, constants
        of all functions, without the C library.
    state, parameters
        of one ``NAME_state``, and of one ``NAME_parameters``, which is part of the constants.
    stack
        of ``NAME_step`` and all it calls, without the C library; None if the compiler can't tell.
    """

    processor: str
    compiler: str
    code: int
    constants: int
    state: int
    parameters: int
    stack: int | None


class FunctionSize(NamedTuple):
    """What a public function of an exported controller takes on a processor.

    Attributes
    ----------
    name
        of the function.
    stack
        bytes at most, with all it calls, without the C library; None if the compiler can't tell.
    instructions
        of its code and that of all functions it calls, each counted once; not how many run.
    """

    name: str
    stack: int | None
    instructions: int


class NoCompilerError(ValueError):
    """There is no C compiler for what is asked, or it fails."""


def measured_sizes(name: str, header: str, source: str, precision: str) -> Sizes:
    """Return the sizes of a controller, whose files are given as texts.

    Raises
    ------
    NoCompilerError
        if there is no gcc; and if it fails, with its first message.
    """
    processor, prefix, flags = _compiler(precision)
    with tempfile.TemporaryDirectory(prefix="quell-sizes-") as folder:
        place = Path(folder)
        (place / f"{name}.h").write_text(header, encoding="utf-8")
        (place / f"{name}.c").write_text(source, encoding="utf-8")
        structs = f'#include "{name}.h"\nchar of_state[sizeof({name}_state)];\n'
        structs += f"char of_parameters[sizeof({name}_parameters)];\n"
        (place / "structs.c").write_text(structs, encoding="utf-8")
        _run(place, f"{prefix}gcc", *FLAGS, *flags, _CALLS, "-c", f"{name}.c", "structs.c")
        sections = _run(place, f"{prefix}size", "-A", f"{name}.o")
        symbols = _run(place, f"{prefix}nm", "-S", "structs.o")
        calls = place / f"{name}.ci"
        stack = stack_of(f"{name}_step", calls.read_text(encoding="utf-8"))
    return Sizes(
        processor,
        f"{prefix}gcc",
        _sum(sections, ".text"),
        _sum(sections, ".rodata"),
        _size_of("of_state", symbols),
        _size_of("of_parameters", symbols),
        stack,
    )


def function_sizes(
    name: str, header: str, source: str, precision: str, operations: Iterable[str]
) -> tuple[str, tuple[FunctionSize, ...]]:
    """Return a text that names processor and compiler, and what each public function takes.

    Arguments and errors are those of ``measured_sizes``; ``operations`` are the names of the
    functions without prefix.
    """
    processor, prefix, flags = _compiler(precision)
    if shutil.which(f"{prefix}objdump") is None:
        raise NoCompilerError(f"there is no {prefix}objdump here")
    with tempfile.TemporaryDirectory(prefix="quell-sizes-") as folder:
        place = Path(folder)
        (place / f"{name}.h").write_text(header, encoding="utf-8")
        (place / f"{name}.c").write_text(source, encoding="utf-8")
        _run(place, f"{prefix}gcc", *FLAGS, *flags, _CALLS, "-c", f"{name}.c")
        code = _run(place, f"{prefix}objdump", "-d", "--no-show-raw-insn", f"{name}.o")
        calls = (place / f"{name}.ci").read_text(encoding="utf-8")
    counts = _instructions(code)
    edges = _edges(calls)
    found = []
    for function in (f"{name}_{each}" for each in operations):
        reached, waiting = {function}, [function]
        while waiting:
            more = edges.get(waiting.pop(), set()) - reached
            reached |= more
            waiting += more
        total = sum(counts.get(each, 0) for each in reached)
        found.append(FunctionSize(function, stack_of(function, calls), total))
    return f"{processor}, {prefix}gcc {' '.join(FLAGS[1:])}", tuple(found)


def _instructions(code: str) -> dict[str, int]:
    """Return the number of instructions of each function in a listing of objdump."""
    counts: dict[str, int] = {}
    function = ""
    for line in code.splitlines():
        head = re.fullmatch(r"[0-9a-f]+ <([\w.]+)>:", line)
        if head:
            function = head[1]
        elif re.match(r"\s+[0-9a-f]+:\t", line) and not re.search(r"\t\.(word|short|byte)", line):
            counts[function] = counts.get(function, 0) + 1
    return counts


def _compiler(precision: str) -> tuple[str, str, tuple[str, ...]]:
    """Return the processor, the prefix of the compiler's programs, and its flags."""
    processor, flags = _TARGETS[precision]
    for found in ((processor, _CROSS, flags), (platform.machine(), "", ())):
        if all(shutil.which(found[1] + program) for program in ("gcc", "size", "nm")):
            return found
    raise NoCompilerError("there is no gcc here")


def _run(folder: Path, *command: str) -> str:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=_LONGEST, check=False
    )
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line]
        raise NoCompilerError(f"{command[0]} fails: {(lines or [done.stderr.strip()])[0]}")
    return done.stdout


def _sum(sections: str, kind: str) -> int:
    pattern = rf"^{re.escape(kind)}\S*\s+(\d+)"
    return sum(int(size) for size in re.findall(pattern, sections, re.MULTILINE))


def _size_of(symbol: str, symbols: str) -> int:
    found = re.search(rf"^\S+ (\S+) \w {symbol}$", symbols, re.MULTILINE)
    if found is None:
        raise NoCompilerError("the output of nm is not known")
    return int(found[1], 16)


def stack_of(function: str, calls: str) -> int | None:
    """Return the stack of a function and the deepest of its calls, from the graph of gcc.

    ``calls`` is the content of the ``.ci`` file, in the format VCG. Functions of other files count
    as zero. None if the graph lacks the function.
    """
    own = {
        found[1].rpartition(":")[2]: int(found[2])
        for found in re.finditer(
            r'node: \{ title: "([^"]+)" label: "[^"]*?(\d+) bytes', calls.replace("\\n", " ")
        )
    }
    edges = _edges(calls)

    def depth(name: str) -> int:
        return own.get(name, 0) + max((depth(each) for each in edges.get(name, ())), default=0)

    return depth(function) if function in own else None


def _edges(calls: str) -> dict[str, set[str]]:
    """Return the functions that each function calls, from the graph of gcc."""
    edges: dict[str, set[str]] = {}
    for found in re.finditer(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', calls):
        caller, called = (found[i].rpartition(":")[2] for i in (1, 2))
        edges.setdefault(caller, set()).add(called)
    return edges
