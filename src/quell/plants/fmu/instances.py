"""Instances of FMUs, and the function by which loops advance them.

The memory of a loop contains only numbers, so it contains the number of its instance. The instance
belongs to the array that holds its number: they are deleted together. No exception may leave the
function that compiled code calls: the error is kept, and y becomes NaN, which ends the run.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import sys
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from quell.plants.fmu.library import CALLS, FMUError, Library
from quell.plants.fmu.variables import Port, Ports, Start
from quell.types import Vector

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
