"""``FMU``: a plant that a co-simulation FMU computes, and the file it comes from.

FMU files as ZIP archives, unpacked within limits.

Instances of FMUs, and the function by which loops advance them.

The memory of a loop contains only numbers, so it contains the number of its instance. The instance
belongs to the array that holds its number: they are deleted together. No exception may leave the
function that compiled code calls: the error is kept, and y becomes NaN, which ends the run.

``FMU``: a plant that a co-simulation FMU computes.
"""

from __future__ import annotations

import copy
import ctypes
import itertools
import math
import os
import re
import shutil
import stat
import struct
import sys
import tempfile
import threading
import weakref
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.checks import Described, import_extra
from quell.files import MAX_SIZE, bytes_of, check_regular, check_size
from quell.kernels.user_functions import call
from quell.plants.base import advance, begin_run, check_run, measure
from quell.types import Vector, warn

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

    inputs: tuple[Port, ...]  # u, and then the disturbances
    outputs: tuple[Port, ...]  # y, and then the further states


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

    def ports(self, u: str | None, y: str | None, w: Sequence[str], states: Sequence[str]) -> Ports:
        """Return the variables of a loop; see ``FMU`` for the defaults.

        Raises
        ------
        ValueError
            for names that the FMU has not, or not with this purpose.
        """
        disturbances = [self._input(f"w[{i}]", name) for i, name in enumerate(w)]
        others = [name for name in self._named("input") if name not in w]
        first = self._input("u", self._only("u", u, others))
        inputs = (first, *disturbances)
        if len({port.reference for port in inputs}) < len(inputs):
            raise ValueError(f"{self._where}: u and w name one variable twice")
        output = self._output("y", self._only("y", y, self._named("output")))
        more = [self._output(f"states[{i}]", name) for i, name in enumerate(states)]
        return Ports(inputs, (output, *more))

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

    def _only(self, argument: str, name: str | None, candidates: list[str]) -> str:
        """Return the name that was given, the only candidate, or the one called as the argument."""
        if name is not None:
            return name
        if len(candidates) == 1:
            return candidates[0]
        if argument in candidates:
            return argument
        what = "input" if argument == "u" else "output"
        known = f"has {', '.join(candidates)}" if candidates else f"has no {what} that is a number"
        raise ValueError(f"{self._where}: {argument} is not given, and the FMU {known}: name one")

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


# ---- Instances of FMUs, and the function by which loops advance them ----

# Statuses of the standard: FMI 2.0.4, section 2.1.3, and FMI 3.0.1, section 2.2.4.
_DISCARD, _FATAL = 2, 4
_STATUS = ("ok", "warning", "discard", "error", "fatal", "pending")
_TERMINATED = 3  # kind of status (FMI 2.0.4, section 4.2.3)

INSTANCES: dict[int, Instance] = {}
_NUMBERS = itertools.count(1)


class Instance:
    """An instance of an FMU in one run, at its start; ``initial`` has the outputs there."""

    def __init__(
        self, library: Library, ports: Ports, starts: tuple[Start, ...], dt: float, substeps: int
    ) -> None:
        self.failed = False
        self._problem: BaseException | None = None
        self._library, self._dt, self._substeps, self._starts = library, dt, substeps, starts
        self._steps = 0
        self._inputs, self._outputs = _by_type(ports.inputs), _by_type(ports.outputs)
        self._values = np.empty(len(ports.outputs))
        self._start: Any = None  # the FMU's state at the start, if it can be taken
        self._usable = True
        with CALLS:
            self._fmu = library.instance()
            try:
                self._initialise()
                if library.has_state:
                    self._start = self._fmu.getFMUState()
                self.initial = self._read().copy()
            except BaseException as error:
                self._usable = getattr(error, "status", 0) != _FATAL
                self.free()
                raise self._described("its initialisation", error) from None

    def restart(self) -> None:
        """Go back to the start."""
        with CALLS:
            self._library.messages.clear()
            try:
                if self._start is not None:
                    self._fmu.setFMUState(self._start)
                else:
                    self._fmu.reset()
                    self._initialise()
                self.initial = self._read().copy()
            except Exception as error:
                raise self._described("its reset", error) from None
            self._steps, self.failed, self._problem = 0, False, None

    def _read(self) -> Vector:
        """Return y and the further states now; the next call overwrites them."""
        fmu, values = self._fmu, self._values
        for kind, references, places in self._outputs:
            values[places] = getattr(fmu, f"get{kind}")(references)
        return values

    def advance(self, inputs: Any) -> Vector:
        """Advance by a sample with held inputs, and return the outputs after it."""
        with CALLS:
            self._library.messages.clear()
            for kind, references, places in self._inputs:
                getattr(self._fmu, f"set{kind}")(references, [inputs[k] for k in places])
            step = self._dt / self._substeps
            for _ in range(self._substeps):
                done = self._fmu.doStep(self._steps * step, step)
                if done is not None:  # FMI 3.0
                    self._check(*done[1:])
                self._steps += 1
            return self._read()

    def fail(self, error: BaseException) -> None:
        """Keep an error of ``advance`` for the run's end."""
        self._usable = self._usable and getattr(error, "status", 0) != _FATAL
        time = self._steps * self._dt / self._substeps
        self.failed, self._problem = True, self._described(f"the step at {time:.9g} s", error)

    def raise_problem(self) -> None:
        """Raise the error that was kept, once."""
        # An error refers to the loop that raised it, which would then never be deleted.
        problem, self._problem = self._problem, None
        if problem is not None:
            raise problem

    def free(self) -> None:
        """Free the instance, unless its FMU has reported a fatal error: then nothing is allowed."""
        with CALLS:
            if self._usable:
                self._usable = False
                try:
                    self._library.free(self._fmu, self._start)
                except Exception as error:  # called while objects are deleted: none can handle it
                    print(f"quell: an FMU can't be freed ({error})", file=sys.stderr)

    def _initialise(self) -> None:
        """Set start values and take the FMU through its initialisation."""
        fmu = self._fmu
        structural = [start for start in self._starts if start.structural]
        if structural:
            fmu.fmi3EnterConfigurationMode(fmu.component)
            self._set(structural)
            fmu.fmi3ExitConfigurationMode(fmu.component)
        self._set([start for start in self._starts if not start.structural])
        if self._library.old:
            fmu.setupExperiment(startTime=0.0)
            fmu.enterInitializationMode()
        else:
            fmu.enterInitializationMode(startTime=0.0)
        fmu.exitInitializationMode()

    def _set(self, starts: list[Start]) -> None:
        for start in starts:
            getattr(self._fmu, f"set{start.port.type}")([start.port.reference], [start.value])

    def _check(self, terminate: bool, early: bool, reached: float) -> None:
        """Raise an ``FMUError`` if a step of FMI 3.0 did not do all that was asked for."""
        if terminate:
            raise FMUError("it asks to end the simulation")
        if early:
            raise FMUError(f"it returned early, at {reached:.9g} s, which it was not allowed to")

    def _described(self, when: str, error: BaseException) -> BaseException:
        """Return the error for the user."""
        if not isinstance(error, Exception):
            return error  # an interrupt
        name, status = self._library.name, getattr(error, "status", None)
        what = str(error)
        if status is not None:
            label = _STATUS[status] if 0 <= status < len(_STATUS) else f"status {status}"
            what = f"{getattr(error, 'function', 'a function')} returned {label}"
            if status == _DISCARD and self._library.old and self._ended():
                what = "it asks to end the simulation"
            if status == len(_STATUS) - 1:
                what += ": it works asynchronously, which is not supported"
        return FMUError(f"{name}: in {when}: {what}{self._library.said()}")

    def _ended(self) -> bool:
        try:
            return bool(self._fmu.getBooleanStatus(_TERMINATED))
        except Exception:
            return False


def _by_type(ports: tuple[Port, ...]) -> list[tuple[str, list[int], list[int]]]:
    """Return types with the references of their variables, and the places of these."""
    groups: dict[str, tuple[list[int], list[int]]] = {}
    for place, port in enumerate(ports):
        references, places = groups.setdefault(port.type, ([], []))
        references.append(port.reference)
        places.append(place)
    return [(kind, *group) for kind, group in groups.items()]


def begin(holder: Vector, make: Callable[[], Instance]) -> Instance:
    """Return the instance whose number is in ``holder[0]``, at its start; make it if needed."""
    instance = INSTANCES.get(int(holder[0]))
    if instance is not None:
        instance.restart()
        return instance
    instance = make()
    number = next(_NUMBERS)
    INSTANCES[number] = instance
    holder[0] = float(number)
    weakref.finalize(holder, _delete, number)
    return instance


def _delete(number: int) -> None:
    instance = INSTANCES.pop(number, None)
    if instance is not None:
        instance.free()


def _array(address: int, size: int) -> Any:
    """Return a view of the float64 numbers at an address."""
    buffer: Any = (ctypes.c_double * size).from_address(address)
    return np.frombuffer(buffer)


def _advance(holder: int, x: int, states: int, u: float, w: int, inputs: int) -> None:
    """Advance the instance of a loop, whose arrays are at these addresses."""
    state = instance = None
    try:
        state = _array(x, states)
        instance = INSTANCES[int(_array(holder, 1)[0])]
        if not instance.failed:
            state[:] = instance.advance([u, *(_array(w, inputs).tolist() if inputs else ())])
    except BaseException as error:
        if state is not None:
            state[0] = math.nan
        if instance is None:
            print(f"quell: no FMU to advance ({type(error).__name__}: {error})", file=sys.stderr)
        else:
            instance.fail(error)


_POINTER, _COUNT, _NUMBER = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_CALLBACK = ctypes.CFUNCTYPE(None, _POINTER, _POINTER, _COUNT, _NUMBER, _POINTER, _COUNT)(_advance)


def callback_address() -> int:
    """Return the address at which loops advance an instance; it differs between processes."""
    return int(ctypes.cast(_CALLBACK, ctypes.c_void_p).value or 0)


# ---- FMU ----

_PLANTS: weakref.WeakValueDictionary[int, FMU] = weakref.WeakValueDictionary()


class FMUModel(NamedTuple):
    """A plant from an FMU, sampled."""

    number: int  # of the plant, in ``_PLANTS``
    dt: float  # [s]
    address: int  # of the function that advances an instance


@measure.register(FMUModel)
def _measure(plant: FMUModel, x: Vector) -> float:
    return float(x[0])


@advance.register(FMUModel)
def _advance_plant(
    plant: FMUModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    call(plant.address, scratch, x, x.size, u, w, w.size)


@begin_run.register(FMUModel)
def _begin_run(plant: FMUModel, x: Vector, scratch: Vector) -> None:
    x[:] = begin(scratch, lambda: _PLANTS[plant.number].instance(plant.dt, x)).initial


@check_run.register(FMUModel)
def _check_run(plant: FMUModel, scratch: Vector) -> None:
    INSTANCES[int(scratch[0])].raise_problem()


@dataclass(frozen=True, eq=False, repr=False)
class FMU(Described):
    """A plant that a co-simulation FMU, of FMI 2.0 or 3.0, computes through FMPy.

    **An FMU is a program.** From the first run on, its binary runs in this process with all rights
    of the user: use only FMUs that you trust.

    In each sample the inputs are set and held, the FMU advances by ``dt`` of the loop, and its
    outputs are read. Each run has an instance of its own, which begins at the FMU's time 0;
    ``rest_at`` of a scenario puts it back there, by its saved state if it can save it, else by its
    reset. Numbers are in the FMU's own units. What is needed of the file lies in a temporary folder
    as long as the plant or a run of it exists.

    Parameters
    ----------
    path
        the FMU file.
    u
        name of the input that the controller sets. By default the only input that is a real number
        and not in ``w``, or the one called ``u``.
    y
        name of the variable that the controller sees. By default the only output that is a number,
        or the one called ``y``. If it follows u at once, the controller sees that a sample later.
    w
        names of the inputs that the disturbances of a scenario set, in their order. Other inputs
        keep their start values.
    states
        names of further variables to record: the plant's state x is (y, these).
    start
        start values by name: of parameters, inputs, and variables with an initial value.
    substeps
        communication steps in a sample.
    name
        for tables and plots; the name of the model by default.
    max_size
        what the FMU may unpack to [MB].

    Raises
    ------
    ValueError
        for a file that is no FMU, is damaged, unpacks to more than ``max_size`` or would write
        outside of its folder; an FMU without co-simulation, or without a binary for this machine;
        names and values that do not fit its variables. ``simulate`` raises it if ``x0`` is not
        zero (give ``start``), and where the FMU reports an error or asks to end the simulation.
    ImportError
        without FMPy; the message names the extra that installs it.

    Warns
    -----
    DesignWarning
        in ``simulate``, if ``dt/substeps`` is no multiple of the FMU's internal step.

    Examples
    --------
    >>> motor = FMU("motor.fmu", u="voltage", y="angle", w=["load"])  # doctest: +SKIP
    """

    path: str | os.PathLike[str]
    u: str | None = None
    y: str | None = None
    w: Sequence[str] = field(default=())
    states: Sequence[str] = field(default=())
    start: Mapping[str, float | int | bool | str] | None = None
    substeps: int = 1
    name: str = ""
    max_size: float = MAX_SIZE
    _library: Library = field(init=False, repr=False)
    _ports: Ports = field(init=False, repr=False)
    _starts: tuple[Start, ...] = field(init=False, repr=False)
    _number: int = field(init=False, repr=False)
    compiled = True

    def __post_init__(self) -> None:
        checks.whole("substeps", self.substeps, 1)
        for argument in ("w", "states"):
            names = getattr(self, argument)
            if not checks.is_sequence(names):
                raise ValueError(f"{argument} = {names!r}: must be a sequence of names")
        if not isinstance(self.start, Mapping | None):
            raise ValueError(f"start = {self.start!r}: must be a mapping of names to values")
        library = Library(Path(self.path), bytes_of(self.max_size))
        variables = Variables(library.description, library.name, library.old)
        own: dict[str, Any] = {
            "_library": library,
            "_ports": variables.ports(self.u, self.y, self.w, self.states),
            "_starts": variables.starts(self.start or {}),
            "_number": next(_NUMBERS),
            "name": self.name or library.description.modelName or library.name,
        }
        for key, value in own.items():
            object.__setattr__(self, key, value)
        _PLANTS[self._number] = self

    def __reduce__(self) -> Any:
        """Return what pickle and copy need: another process unpacks the file itself."""
        return FMU, tuple(getattr(self, each.name) for each in fields(self) if each.init)

    @property
    def order(self) -> int:
        """Number of recorded values: y and ``states``."""
        return len(self._ports.outputs)

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs."""
        return len(self._ports.inputs) - 1

    def sampled(self, dt: float, interpret: bool = False) -> FMUModel:
        """Return the parameters for a sample time ``dt`` [s]; see ``Plant.sampled``."""
        checks.positive("dt", dt, "s")
        warn_of_step(self._library.description, dt, self.substeps, self._library.name)
        return FMUModel(self._number, dt, callback_address())

    def instance(self, dt: float, x0: Vector) -> Instance:
        """Return an instance at its start; raise a ``ValueError`` unless x0 is zero."""
        if np.any(x0 != 0.0):
            raise ValueError(
                f"x0 = {x0.tolist()}: must be zero for an FMU, whose state is its own; give start "
                "values by name (start)"
            )
        return Instance(self._library, self._ports, self._starts, dt, self.substeps)
