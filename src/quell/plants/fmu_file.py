"""FMU files: unpacked within limits, their description, binary and variables.

A loop needs of an FMU an instance, which ``fmu.py`` makes; here is what is known before: the file
as a ZIP archive, the description and the binary, which FMPy loads, and the variables by name.
"""

from __future__ import annotations

import copy
import math
import os
import re
import shutil
import stat
import struct
import tempfile
import threading
import weakref
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from quell import checks
from quell.checks import import_extra
from quell.files import check_regular, check_size
from quell.types import warn

# ---- FMU files as ZIP archives, unpacked within limits ----

# An FMU of a large tool has some hundred files. Chosen by hand.
_MOST_FILES = 10_000
# What the library raises for archives that are damaged.
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, LookupError, OSError),
    *(NotImplementedError, RuntimeError, UnicodeError),
)
_ENCRYPTED = 1  # bit of a file's flags (ZIP specification, 4.4.4)


def unpack(path: Path, folder: Path, most: int, wanted: Callable[[str], bool]) -> list[str]:
    """Unpack the wanted files of an FMU into ``folder``, and return the names of all its files.

    Nothing is written outside of ``folder``, and nothing at all if the archive is bad.

    Parameters
    ----------
    path
        the FMU.
    folder
        an empty folder.
    most
        largest number of bytes that the wanted files unpack to.
    wanted
        whether a file is unpacked, by its name in the archive.

    Raises
    ------
    FileNotFoundError
        if there is no such file.
    ValueError
        if it is no ZIP archive, is damaged, is too large, or has names that lead out of ``folder``.
    """
    where = path.name
    check_regular(path, str(path))
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [each for each in archive.infolist() if not each.filename.endswith("/")]
            _check(entries, where)
            chosen = [entry for entry in entries if wanted(entry.filename)]
            _check_once([entry.filename for entry in chosen], where)
            check_size(sum(entry.file_size for entry in chosen), most, where)
            for entry in chosen:
                target = folder / entry.filename
                target.parent.mkdir(parents=True, exist_ok=True)
                # Reading ends at the size that was checked, even if the data goes on.
                with archive.open(entry) as source, target.open("xb") as file:
                    shutil.copyfileobj(source, file)
            return [entry.filename for entry in entries]
    except _DAMAGE as error:
        raise ValueError(f"{where}: is no FMU, or is damaged ({error})") from None


def _check(entries: list[zipfile.ZipInfo], where: str) -> None:
    """Raise a ``ValueError`` for entries that must not be unpacked."""
    if len(entries) > _MOST_FILES:
        raise ValueError(f"{where}: has {len(entries)} files; at most {_MOST_FILES} are permitted")
    for entry in entries:
        name = entry.filename
        parts = PurePosixPath(name).parts
        leads_out = not parts or parts[0] == "/" or ".." in parts
        if leads_out or "\\" in name or ":" in name or stat.S_ISLNK(entry.external_attr >> 16):
            raise ValueError(f"{where}: contains {name!r}, a link or a path out of its folder")
        if entry.flag_bits & _ENCRYPTED:
            raise ValueError(f"{where}: {name!r} is encrypted; must be readable")


def _check_once(names: list[str], where: str) -> None:
    """Raise a ``ValueError`` if a name is there twice: it is not clear which file is meant."""
    name, count = Counter(names).most_common(1)[0] if names else ("", 0)
    if count > 1:
        raise ValueError(f"{where}: contains {name!r} twice")


# ---- The unpacked file of an FMU, its description and its binary, which FMPy loads ----

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
        self.only_one = bool(slave.canBeInstantiatedOnlyOncePerProcess)

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
        if self.only_one and self._live:
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


# ---- The variables of an FMU that a loop reads and writes ----

_REAL = ("Real", "Float32", "Float64")
_WHOLE = ("Integer", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
_SETTABLE = ("parameter", "structuralParameter", "input")


class Port(NamedTuple):
    """A variable with the functions of FMPy that get and set its type."""

    name: str
    reference: int
    type: str  # part of FMPy's names: getFloat64, setFloat64


class Ports(NamedTuple):
    """Variables that a loop reads and writes at each sample."""

    inputs: tuple[Port, ...]  # those of u, and then the disturbances
    outputs: tuple[Port, ...]  # those of y, and then the further states
    controls: int = 1  # how many of the inputs are u
    measured: int = 1  # how many of the outputs are y


class Start(NamedTuple):
    """A start value, of a type that FMPy sets."""

    port: Port
    value: Any
    structural: bool  # only to be set in configuration mode


class Variables:
    """The variables of an FMU, of FMI 2.0 if ``old``, by name; errors begin with ``where``."""

    def __init__(self, description: Any, where: str, old: bool) -> None:
        self._where = where
        self._old = old
        self._by_name = {variable.name: variable for variable in description.modelVariables}

    def ports(self, u: Any, y: Any, w: Sequence[str], states: Sequence[str]) -> Ports:
        """Return the variables of a loop; see ``FMU`` for the defaults.

        Raises
        ------
        ValueError
            for names that the FMU has not, or not with this purpose, or none; and for a variable
            that u and w, or y, have twice.
        """
        others = [name for name in self._named("input") if name not in w]
        controls = [self._input(*each) for each in self._names("u", u, others)]
        measured = [self._output(*each) for each in self._names("y", y, self._named("output"))]
        self._check_once("y names", measured)
        inputs = [*controls, *(self._input(f"w[{i}]", name) for i, name in enumerate(w))]
        self._check_once("u and w name", inputs)
        more = [self._output(f"states[{i}]", name) for i, name in enumerate(states)]
        return Ports(tuple(inputs), (*measured, *more), len(controls), len(measured))

    def _check_once(self, who: str, ports: Sequence[Port]) -> None:
        """Raise a ``ValueError`` if two ports are one variable."""
        # In FMI 2.0 each type has references of its own (section 2.2.7, valueReference).
        seen: dict[tuple[str, int], str] = {}
        for port in ports:
            key = port.type, port.reference
            if key in seen:
                both = f"{seen[key]!r} and {port.name!r}"
                raise ValueError(f"{self._where}: {who} one variable twice: {both}")
            seen[key] = port.name

    def _names(
        self, argument: str, given: str | Sequence[str] | None, candidates: list[str]
    ) -> list[tuple[str, str]]:
        """Return names with what messages call them: those given, the one called so, or all."""
        if isinstance(given, str) or (given is None and argument in candidates):
            return [(argument, argument if given is None else given)]
        found = candidates if given is None else given
        if not checks.is_sequence(found):
            raise ValueError(f"{argument} = {given!r}: must be a name, or a sequence of names")
        if not found:
            what = "input that is a real number" if argument == "u" else "output that is a number"
            lacks = f"has no {what}{' beside w' if argument == 'u' else ''}"
            lacks = lacks if given is None else f"{argument} is empty"
            raise ValueError(f"{self._where}: {lacks}: {argument} must have at least one variable")
        return [(f"{argument}[{i}]", name) for i, name in enumerate(found)]

    def starts(self, values: Mapping[str, Any]) -> tuple[Start, ...]:
        """Return start values, of the types of their variables.

        Raises
        ------
        ValueError
            for names that the FMU has not, variables that can't be set, and values of other types.
        """
        return tuple(self._start(name, value) for name, value in values.items())

    def _named(self, causality: str) -> list[str]:
        """Return the names of the numbers with a causality."""
        kinds = _REAL if causality == "input" else (*_REAL, *_WHOLE)
        return [
            name
            for name, variable in self._by_name.items()
            if variable.causality == causality and variable.type in kinds and not variable.shape
        ]

    def _variable(self, argument: str, name: Any) -> Any:
        if not isinstance(name, str) or name not in self._by_name:
            rule = checks.nearest(str(name), [*self._by_name]) if self._by_name else "it has none"
            raise ValueError(f"{self._where}: {argument} = {name!r}: no variable of it; {rule}")
        variable = self._by_name[name]
        if variable.shape:
            raise ValueError(f"{self._where}: {argument} = {name!r}: must be one number, no array")
        return variable

    def _input(self, argument: str, name: Any) -> Port:
        variable = self._variable(argument, name)
        if variable.causality != "input" or variable.type not in _REAL:
            raise ValueError(
                f"{self._where}: {argument} = {name!r}: is {variable.causality} of type "
                f"{variable.type}; must be an input that is a real number"
            )
        return self._port(variable)

    def _output(self, argument: str, name: Any) -> Port:
        variable = self._variable(argument, name)
        if variable.type not in (*_REAL, *_WHOLE):
            raise ValueError(
                f"{self._where}: {argument} = {name!r}: is of type {variable.type}; must be a "
                "number"
            )
        return self._port(variable)

    def _port(self, variable: Any) -> Port:
        kind = variable.type
        if kind == "Enumeration":
            kind = "Integer" if self._old else "Int64"
        return Port(variable.name, variable.valueReference, kind)

    def _start(self, name: str, value: Any) -> Start:
        argument = f"start[{name!r}]"
        variable = self._variable("start", name)
        settable = variable.causality in _SETTABLE or variable.initial in ("exact", "approx")
        if variable.variability == "constant" or not settable:
            raise ValueError(
                f"{self._where}: {argument}: is {variable.variability} {variable.causality}; must "
                "be a parameter, an input, or a variable with a start value"
            )
        structural = variable.causality == "structuralParameter"
        port = self._port(variable)
        return Start(port, self._value(argument, variable.type, value), structural)

    def _value(self, argument: str, kind: str, value: Any) -> Any:
        if kind in _REAL:
            return checks.finite(argument, value)
        if kind in (*_WHOLE, "Enumeration"):
            return checks.whole(argument, value, *_range(kind))
        if kind == "Boolean":
            return checks.flag(argument, value)
        if kind != "String":
            raise ValueError(f"{self._where}: {argument}: is of type {kind}, which can't be set")
        if not isinstance(value, str):
            raise ValueError(f"{argument} = {value!r}: must be a text")
        return value


def _range(kind: str) -> tuple[int, int]:
    """Return the least and the largest number of a type such as ``UInt8``."""
    digits = kind.removeprefix("U").removeprefix("Int")
    bits = int(digits) if digits.isdigit() else 32  # Integer of FMI 2, Enumeration
    return (0, 2**bits - 1) if kind.startswith("U") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def warn_of_step(description: Any, dt: float, substeps: int, where: str) -> None:
    """Warn if ``dt/substeps`` [s] is no multiple of the internal step of an FMU of FMI 3.0."""
    fixed = getattr(description.coSimulation, "fixedInternalStepSize", None)
    try:
        internal = float(fixed or 0.0)
    except ValueError:
        internal = 0.0
    if not internal > 0.0:
        return
    ratio = dt / substeps / internal
    if round(ratio) < 1 or not math.isclose(ratio, round(ratio), rel_tol=1e-9):
        warn(
            f"{where}: dt/substeps = {dt / substeps!r} s is no multiple of the FMU's internal step "
            f"of {internal!r} s: its outputs are then those of an earlier time"
        )
