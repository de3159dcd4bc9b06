"""Generated C code, compiled by gcc and called from Python."""

from __future__ import annotations

import ctypes
import itertools
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

needs_gcc = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="gcc, which compiles exported code, is missing"
)
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
EXACT = ("-O1", "-ffp-contract=off")
"""Flags with which the code gives the bits of the interpreted kernels."""

# ctypes finds a library that it has loaded by its path, so each has another.
_numbers = itertools.count()


def built(result: Path, sources: Iterable[Path], *flags: str | Path) -> Path:
    """Compile C files, without a warning; return the program or library ``result``."""
    command = ["gcc", *STRICT, *EXACT, *flags, *sources, "-o", result, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return result


class InC:
    """Exported code with a state; ``run("step", 1.0, 0.0)`` calls ``NAME_step(state, 1.0, 0.0)``.

    ``more`` is C code that is appended to the source.
    """

    def __init__(self, source: Any, folder: Path, more: str = "") -> None:
        folder = folder / f"in_c_{next(_numbers)}"
        folder.mkdir()
        name = source.name
        (folder / f"{name}.h").write_text(source.header)
        size = f"\nextern const unsigned long size;\nconst unsigned long size = sizeof({name}_state);\n"
        (folder / f"{name}.c").write_text(source.source + size + more)
        library = built(folder / f"{folder.name}.so", [folder / f"{name}.c"], "-shared", "-fPIC")
        self.name, self.library = name, ctypes.CDLL(str(library))
        self.real = ctypes.c_float if source.precision == "single" else ctypes.c_double
        self.state = ctypes.create_string_buffer(ctypes.c_ulong.in_dll(self.library, "size").value)
        self.run("init")

    def run(self, operation: str, *arguments: Any) -> float:
        """Call an operation with numbers and arrays; return a real number."""
        function = getattr(self.library, f"{self.name}_{operation}")
        function.restype = self.real
        given = [each.ctypes.data_as(ctypes.c_void_p) if hasattr(each, "ctypes") else self.real(each)
                 for each in arguments]  # fmt: skip
        return float(function(self.state, *given))
