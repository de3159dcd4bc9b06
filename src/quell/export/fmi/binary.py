"""The binary of an FMU for this machine, from a C compiler."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from quell.export.library.toolchain import FLAGS, NoCompilerError

_COMPILERS = ("gcc", "clang", "cc")
_OPTIONS = (*FLAGS, "-fPIC", "-shared", "-fvisibility=hidden")
_SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib")}
# Else a function that is missing would be noticed only by the tool that loads the FMU.
_COMPLETE = {"linux": ("-Wl,-z,defs",)}
_MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
# A model of the largest learners takes some seconds. Chosen by hand.
_LONGEST = 300.0


def place(name: str) -> str:
    """Return the path of the binary of the model ``name`` in an FMU, for this machine."""
    if sys.platform not in _SYSTEMS:
        raise ValueError(
            f"binary = True: is not supported on {sys.platform}; give binary=False and compile the "
            "sources of the FMU there (fmpy compile)"
        )
    system, suffix = _SYSTEMS[sys.platform]
    machine = platform.machine().lower()
    return f"binaries/{_MACHINES.get(machine, machine)}-{system}/{name}{suffix}"


def compiler() -> str:
    """Return the C compiler: that of the environment variable CC, or the first that is found.

    Raises
    ------
    NoCompilerError
        if there is none.
    """
    candidates = (os.environ["CC"],) if os.environ.get("CC") else _COMPILERS
    for candidate in candidates:
        if shutil.which(candidate):
            return candidate
    raise NoCompilerError(
        f"binary = True: no C compiler was found ({', '.join(candidates)}); install one, set CC, "
        "or give binary=False for an FMU of sources only"
    )


def compiled(folder: Path, files: Sequence[str], name: str) -> bytes:
    """Return the shared library of C files in ``folder``.

    Raises
    ------
    NoCompilerError
        without a compiler, and with its first message if it fails.
    """
    library = folder / f"{name}.library"
    last = (*_COMPLETE.get(sys.platform, ()), "-lm", "-o", library.name)
    command = [compiler(), *_OPTIONS, *files, *last]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=_LONGEST, check=False
    )
    if done.returncode != 0:
        lines, marks = done.stderr.splitlines(), ("undefined", "error")
        said = [line for mark in marks for line in lines if mark in line] or [done.stderr]
        raise NoCompilerError(f"binary = True: {command[0]} failed: {said[0].strip()[:300]}")
    return library.read_bytes()
