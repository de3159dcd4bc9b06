"""Plants that co-simulation FMUs compute, with one control signal or several.

Instances of FMUs, and the functions by which loops advance them.

The memory of a loop contains only numbers, so it contains the number of its instance. The instance
belongs to the array that holds its number: they are deleted together. No exception may leave the
function that compiled code calls: the error is kept, and y becomes NaN, which ends the run.

``FMU``: the plant.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import os
import sys
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.checks import Described
from quell.files import MAX_SIZE, bytes_of
from quell.kernels.user_functions import call
from quell.plants.base import (
    advance,
    all_signals,
    as_input,
    begin_run,
    check_run,
    is_several,
    measure,
    measure_all,
)
from quell.plants.channels import ChannelNames
from quell.plants.fmu_file import (
    CALLS,
    FMUError,
    Library,
    Port,
    Ports,
    Start,
    Variables,
    warn_of_step,
)
from quell.types import Vector

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


def _numbers(address: int, size: int) -> list[float]:
    """Return the float64 numbers at an address, none of an empty array."""
    return _array(address, size).tolist() if size else []


def _advance(holder: int, x: int, states: int, u: float, w: int, inputs: int) -> None:
    """Advance the instance of a loop, whose arrays are at these addresses."""
    _advance_instance(holder, x, states, lambda: [u, *_numbers(w, inputs)])


def _advance_several(
    holder: int, x: int, states: int, u: int, controls: int, w: int, inputs: int
) -> None:
    """Advance the instance of a loop of several signals."""
    _advance_instance(holder, x, states, lambda: _numbers(u, controls) + _numbers(w, inputs))


def _advance_instance(holder: int, x: int, states: int, read: Callable[[], list[float]]) -> None:
    state = instance = None
    try:
        state = _array(x, states)
        instance = INSTANCES[int(_array(holder, 1)[0])]
        if not instance.failed:
            state[:] = instance.advance(read())
    except BaseException as error:
        if state is not None:
            state[0] = math.nan
        if instance is None:
            print(f"quell: no FMU to advance ({type(error).__name__}: {error})", file=sys.stderr)
        else:
            instance.fail(error)


_POINTER, _COUNT, _NUMBER = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_ARRAY = (_POINTER, _COUNT)
_CALLBACK = ctypes.CFUNCTYPE(None, _POINTER, *_ARRAY, _NUMBER, *_ARRAY)(_advance)
_CALLBACK_SEVERAL = ctypes.CFUNCTYPE(None, _POINTER, *_ARRAY, *_ARRAY, *_ARRAY)(_advance_several)


def callback_address(several: bool = False) -> int:
    """Return the address at which loops advance an instance; it differs between processes."""
    callback: Any = _CALLBACK_SEVERAL if several else _CALLBACK
    return int(ctypes.cast(callback, ctypes.c_void_p).value or 0)


# ---- A sampled FMU ----

_PLANTS: weakref.WeakValueDictionary[int, FMU] = weakref.WeakValueDictionary()


def _begin(plant: Any, x: Vector, scratch: Vector) -> None:
    """Begin a run with an instance of its own."""
    x[:] = begin(scratch, lambda: _PLANTS[plant.number].instance(plant.dt, x)).initial


def _check(plant: Any, scratch: Vector) -> None:
    """Raise the error that ended a run."""
    INSTANCES[int(scratch[0])].raise_problem()


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


begin_run.register(FMUModel)(_begin)
check_run.register(FMUModel)(_check)


class FMUModelOfMany(NamedTuple):
    """A plant of several signals from an FMU, sampled."""

    number: int  # of the plant, in ``_PLANTS``
    dt: float  # [s]
    address: int  # of the function that advances an instance


@measure_all.register(FMUModelOfMany)
def _measure_all(plant: FMUModelOfMany, x: Vector, y: Vector) -> None:
    for i in range(y.size):
        y[i] = x[i]


@advance.register(FMUModelOfMany)
def _advance_all(
    plant: FMUModelOfMany, x: Vector, scratch: Vector, t: float, u: Any, w: Vector
) -> None:
    call(plant.address, scratch, x, x.size, u, u.size, w, w.size)


as_input.register(FMUModelOfMany)(all_signals)
begin_run.register(FMUModelOfMany)(_begin)
check_run.register(FMUModelOfMany)(_check)


# ---- A plant that an FMU computes ----


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
        name of the input that the controller sets; of several names in the order of its control
        signals (m,). By default the one called ``u``, else all inputs that are real numbers and not
        in ``w``, in the order of the FMU.
    y
        name of the variable that the controller sees; of several names in the order of its axes
        (p,). By default the one called ``y``, else all outputs that are numbers, in the order of
        the FMU. If it follows u at once, the controller sees that a sample later.
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
        names and values that do not fit its variables; a variable that ``u`` and ``w``, or ``y``,
        name twice. ``simulate`` raises it if ``x0`` is not zero (give ``start``), where the FMU
        reports an error or asks to end the simulation, and naming the variables if they are more
        or fewer than the signals of the controller.
    ImportError
        without FMPy; the message names the extra that installs it.

    Warns
    -----
    DesignWarning
        in ``simulate``, if ``dt/substeps`` is no multiple of the FMU's internal step.

    Examples
    --------
    >>> motor = FMU("motor.fmu", u="voltage", y="angle", w=["load"])  # doctest: +SKIP
    >>> robot = FMU("robot.fmu", u=["tau1", "tau2"], y=["q1", "q2"])  # doctest: +SKIP
    """

    path: str | os.PathLike[str]
    u: str | Sequence[str] | None = None
    y: str | Sequence[str] | None = None
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
        return type(self), tuple(getattr(self, each.name) for each in fields(self) if each.init)

    @property
    def order(self) -> int:
        """Number of recorded values: y and ``states``."""
        return len(self._ports.outputs)

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs."""
        return len(self._ports.inputs) - self._ports.controls

    @property
    def inputs(self) -> int:
        """Number of control signals."""
        return self._ports.controls

    @property
    def outputs(self) -> int:
        """Number of measured outputs."""
        return self._ports.measured

    @property
    def channel_names(self) -> ChannelNames:
        """The FMU's names of the signals."""
        inputs = [port.name for port in self._ports.inputs]
        measured = [port.name for port in self._ports.outputs[: self.outputs]]
        return ChannelNames(
            tuple(inputs[: self.inputs]), tuple(measured), tuple(inputs[self.inputs :])
        )

    @property
    def one_at_a_time(self) -> bool:
        """Whether the FMU permits only one instance, so one run at a time, in a process."""
        return self._library.only_one

    def sampled(self, dt: float, interpret: bool = False) -> FMUModel | FMUModelOfMany:
        """Return the parameters for a sample time ``dt`` [s]; see ``Plant.sampled``."""
        checks.positive("dt", dt, "s")
        warn_of_step(self._library.description, dt, self.substeps, self._library.name)
        several = is_several(self)
        of = FMUModelOfMany if several else FMUModel
        return of(self._number, dt, callback_address(several))

    def instance(self, dt: float, x0: Vector) -> Instance:
        """Return an instance at its start; raise a ``ValueError`` unless x0 is zero."""
        if np.any(x0 != 0.0):
            raise ValueError(
                f"x0 = {x0.tolist()}: must be zero for an FMU, whose state is its own; give start "
                "values by name (start)"
            )
        return Instance(self._library, self._ports, self._starts, dt, self.substeps)
