"""``FMU``: a plant that a co-simulation FMU computes."""

from __future__ import annotations

import itertools
import os
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.described import Described
from quell.kernels.function_pointers import call
from quell.plants.base import advance, begin_run, check_run, measure
from quell.plants.fmu.instances import INSTANCES, Instance, begin, callback_address
from quell.plants.fmu.library import Library
from quell.plants.fmu.variables import Ports, Start, Variables, warn_of_step
from quell.reading import MAX_SIZE, bytes_of
from quell.types import Vector

_NUMBERS = itertools.count(1)
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
def _advance(plant: FMUModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector) -> None:
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
