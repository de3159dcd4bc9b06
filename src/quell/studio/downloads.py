"""Exported controllers as files that the browser saves: C files in a ZIP archive, and FMUs.

They are what ``quell export`` writes. The files are made in a temporary folder, which is removed.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from quell import checks
from quell.setup.loading import Setup

C_NAME = "controller"
"""Begins the names of the files and functions, as by default on the command line."""

# The least date that a ZIP archive can have: the same setup gives the same bytes.
_DATE = (1980, 1, 1, 0, 0, 0)


def exported(setup: Setup, message: Mapping[str, Any]) -> tuple[str, bytes]:
    """Return name and content of the file that a message asks for with ``to`` and ``precision``."""
    to = checks.one_of("to", message.get("to"), ("c", "fmu"))
    precision = checks.one_of("precision", message.get("precision", "double"), ("double", "single"))
    with TemporaryDirectory(prefix="quell-studio-") as folder:
        if to == "fmu":
            return _fmu(setup, Path(folder))
        return _c(setup, Path(folder) / C_NAME, precision)


def _fmu(setup: Setup, folder: Path) -> tuple[str, bytes]:
    from quell.export import fmu

    path = folder / f"{C_NAME}.fmu"
    fmu(setup.controller, path, dt=setup.controller.dt)
    return path.name, path.read_bytes()


def _c(setup: Setup, folder: Path, precision: str) -> tuple[str, bytes]:
    from quell.export import c

    found = c(
        setup.controller,
        folder,
        name=C_NAME,
        precision=precision,
        plant=setup.plant,
        scenario=setup.scenario,
    )
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        for path in sorted(found.files):
            name = f"{C_NAME}/{path.relative_to(folder).as_posix()}"
            entry = zipfile.ZipInfo(name, _DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            packed.writestr(entry, path.read_bytes())
    return f"{C_NAME}.zip", archive.getvalue()
