"""The unpacked file of an FMU, its description and its binary, which FMPy loads."""

from __future__ import annotations

import copy
import os
import re
import shutil
import tempfile
import threading
import weakref
from pathlib import Path
from typing import Any

from quell.optional import import_extra
from quell.plants.fmu.archive import unpack

# FMUs are called one at a time: the standard demands no more of them, and FMPy changes the current
# folder while it loads a library.
CALLS = threading.RLock()

_DESCRIPTION = "modelDescription.xml"


class FMUError(ValueError):
    """An error that an FMU reports, or its wish to end the simulation."""


class Library:
    """An FMU file, unpacked; its binary is loaded for the first instance.

    Parameters
    ----------
    path
        the file.
    most
        largest number of bytes that it may unpack to.

    Raises
    ------
    ValueError, ImportError
        see ``FMU``.
    """

    def __init__(self, path: Path, most: int) -> None:
        self.name = path.name
        fmpy = import_extra("fmpy", "fmi", "ql.plants.FMU")
        self._fmpy = fmpy
        self._folder = Path(tempfile.mkdtemp(prefix="quell-fmu-"))
        self._loaded: list[Any] = []
        self._live = 0
        self.messages: list[str] = []
        remove = weakref.finalize(self, _remove, self._folder, self._loaded)
        places = {2: fmpy.platform, 3: fmpy.platform_tuple}

        def wanted(name: str) -> bool:
            own = (f"binaries/{place}/" for place in places.values())
            return name == _DESCRIPTION or name.startswith(("resources/", *own))

        try:
            names = unpack(path, self._folder, most, wanted)
            self.description = _read(fmpy, self._folder, self.name)
            self.old = _major(self.description) == 2
            slave = self.description.coSimulation
            self._check_binary(names, slave.modelIdentifier, places[2 if self.old else 3])
        except BaseException:
            remove()
            raise
        self.has_state = bool(slave.canGetAndSetFMUstate)
        self._only_one = bool(slave.canBeInstantiatedOnlyOncePerProcess)

    def _check_binary(self, names: list[str], identifier: str, place: str) -> None:
        """Raise a ``ValueError`` if there is no binary for this machine."""
        # Other names could lead to a file outside of the folder.
        if not re.fullmatch(r"[A-Za-z_]\w*", identifier or "", re.ASCII):
            raise ValueError(f"{self.name}: modelIdentifier = {identifier!r}: must be a C name")
        binary = f"binaries/{place}/{identifier}{self._fmpy.sharedLibraryExtension}"
        if binary in names:
            return
        found = sorted({name.split("/")[1] for name in names if name.startswith("binaries/")})
        others = f"has binaries for {', '.join(found)}" if found else "has no binaries"
        remedy = (
            "; it has sources: compile them with `fmpy compile`"
            if any(name.startswith("sources/") for name in names)
            else ""
        )
        raise ValueError(f"{self.name}: {others}, but {binary} is missing{remedy}")

    def _load(self) -> Any:
        """Return FMPy's object for the binary."""
        if not self._loaded:
            version = 2 if self.old else 3
            module = import_extra(f"fmpy.fmi{version}", "fmi", "ql.plants.FMU")
            here = Path.cwd()
            try:
                fmu = getattr(module, f"FMU{version}Slave")(
                    guid=self.description.guid,
                    modelIdentifier=self.description.coSimulation.modelIdentifier,
                    unzipDirectory=str(self._folder),
                    instanceName=Path(self.name).stem,
                )
            except Exception as error:  # FMPy raises plain exceptions, and ctypes several kinds
                raise ValueError(f"{self.name}: its binary can't be loaded ({error})") from None
            finally:
                os.chdir(here)  # FMPy does not come back from its folder after an error
            self._module = module
            self._log = self._logger()
            self._loaded.append(fmu)
        return self._loaded[0]

    def instance(self) -> Any:
        """Return FMPy's object for a new instance."""
        if self._only_one and self._live:
            raise ValueError(
                f"{self.name}: can be instantiated only once in a process, and another run of it "
                "is not over: run one after the other"
            )
        fmu = copy.copy(self._load())
        self.messages.clear()
        try:
            if self.old:
                fmu.instantiate(callbacks=self._log)
            else:
                fmu.instantiate(logMessage=self._log)
        except Exception as error:
            raise FMUError(f"{self.name}: can't be instantiated ({error}){self.said()}") from None
        self._live += 1
        return fmu

    def free(self, fmu: Any, state: Any) -> None:
        """Free an instance and its saved state."""
        self._live -= 1
        if state is not None:
            fmu.freeFMUState(state)
        (fmu.fmi2FreeInstance if self.old else fmu.fmi3FreeInstance)(fmu.component)

    def said(self) -> str:
        """Return the messages of the FMU since the last call, as the end of a sentence."""
        return f": {'; '.join(self.messages)}" if self.messages else ""

    def _logger(self) -> Any:
        """Return what FMPy passes to the FMU as its logger."""
        messages = self.messages

        def note(status: int, message: bytes | None) -> None:
            text = " ".join((message or b"").decode(errors="replace").split())
            if status > 0 and text and len(messages) < 3:  # more would hide the first ones
                messages.append(text[:200])

        if not self.old:
            return lambda environment, status, category, message: note(status, message)
        kinds, memory = self._module, self._fmpy
        callbacks = kinds.fmi2CallbackFunctions()
        # The arguments of a message, as of printf, stay out: ctypes can't receive them.
        callbacks.logger = kinds.fmi2CallbackLoggerTYPE(
            lambda environment, name, status, category, message: note(status, message)
        )
        callbacks.allocateMemory = kinds.fmi2CallbackAllocateMemoryTYPE(memory.calloc)
        callbacks.freeMemory = kinds.fmi2CallbackFreeMemoryTYPE(memory.free)
        return callbacks


def _read(fmpy: Any, folder: Path, name: str) -> Any:
    """Return the description of the FMU ``name``; it is one for co-simulation."""
    if not (folder / _DESCRIPTION).is_file():
        raise ValueError(f"{name}: is no FMU: it has no {_DESCRIPTION}")
    text = (folder / _DESCRIPTION).read_bytes()
    if b"<!DOCTYPE" in text or b"\0" in text:  # entities could expand to anything
        raise ValueError(f"{name}: {_DESCRIPTION}: must be in UTF-8, without a document type")
    try:
        description = fmpy.read_model_description(str(folder))
        version = _major(description)
    except Exception as error:  # FMPy raises plain exceptions, and lxml several kinds
        problems = getattr(error, "problems", None)
        what = " ".join(str(problems[0] if problems else error).split())
        more = f" and {len(problems) - 1} further errors" if problems and problems[1:] else ""
        raise ValueError(f"{name}: {_DESCRIPTION} can't be read: {what:.300}{more}") from None
    if version not in (2, 3):
        raise ValueError(f"{name}: is of FMI {description.fmiVersion}; must be of FMI 2.0 or 3.0")
    if description.coSimulation is None:
        raise ValueError(
            f"{name}: is not for co-simulation; export it for co-simulation from its tool"
        )
    return description


def _major(description: Any) -> int:
    """Return the version of FMI before the dot."""
    return int(description.fmiVersion.partition(".")[0])


def _remove(folder: Path, loaded: list[Any]) -> None:
    """Unload the binary, and delete the folder."""
    for fmu in loaded:
        fmu.freeLibrary()
    shutil.rmtree(folder, ignore_errors=True)
