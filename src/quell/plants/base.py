"""Plants: their interface, states that end a run, names of signals, batches.

The interface of a plant: a protocol for its description and two functions for its kernels.

``Plant.sampled`` returns a NamedTuple of parameters. ``measure`` and ``advance`` are registered for
the type of that NamedTuple; ``linear.py`` is a complete example.
"""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.checks import Described
from quell.kernels.dispatch import generic, generic_with_default, kernel
from quell.quantities import UNKNOWN, Quantity, Signals
from quell.types import Vector

# ---- The interface of a plant ----


class Plant(Protocol):
    """The part of a plant that the driver, the observers' design and the plots use."""

    @property
    def name(self) -> str:
        """Name for tables and plots."""

    @property
    def order(self) -> int:
        """Number of states."""

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs."""

    @property
    def compiled(self) -> bool:
        """Whether the driver can run it compiled."""

    def sampled(self, dt: float, interpret: bool = False) -> Any:
        """Return the parameters for a sample time ``dt`` [s].

        With ``interpret`` Python can run and debug them.
        """


class PlantWrapper(Described):
    """The properties that a wrapper takes over from the plant inside."""

    plant: Plant

    @property
    def order(self) -> int:
        """Number of states."""
        return self.plant.order

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs."""
        return self.plant.disturbances

    @property
    def inputs(self) -> int:
        """Number of control signals."""
        return inputs_of(self.plant)

    @property
    def outputs(self) -> int:
        """Number of measured outputs."""
        return outputs_of(self.plant)

    @property
    def compiled(self) -> bool:
        """Whether the driver can run it compiled."""
        return self.plant.compiled


def one_at_a_time(plant: Any) -> bool:
    """Return whether only one run of a plant can be under way in a process, as of some FMUs."""
    while isinstance(plant, PlantWrapper):
        plant = plant.plant
    return bool(getattr(plant, "one_at_a_time", False))


def check_plant(value: Any, name: str = "plant") -> None:
    """Raise a ``ValueError`` if ``value``, the argument ``name``, is not a plant."""
    if isinstance(value, type) or not hasattr(value, "sampled"):
        raise ValueError(
            f"{name} = {value!r}: must be a plant, for example quell.plants.two_mass_spring() "
            "or quell.plants.LinearPlant.of(model)"
        )


def check_one_input(plant: Any, several: str, name: str = "plant") -> None:
    """Raise a ``ValueError`` for a plant with several signals; ``several`` is what takes those."""
    if hasattr(plant, "sampled") and is_several(plant):
        raise ValueError(
            f"{name} = {plant.name!r} has {checks.counted(inputs_of(plant), 'control signal')} and "
            f"{checks.counted(outputs_of(plant), 'output')}, here there is one of each; several: "
            f"{several}"
        )


@generic
def measure(plant: Any, x: Vector) -> float:
    """Return the output y for the state ``x`` (n,)."""
    raise TypeError


@generic_with_default
def measure_all(plant: Any, x: Vector, y: Vector) -> None:
    """Write the outputs for the state ``x`` (n,) into ``y`` (p,).

    A plant with one output has ``measure`` instead.
    """
    y[0] = measure(plant, x)


@generic_with_default
def as_input(plant: Any, u: Vector) -> Any:
    """Return control signals (m,) as ``advance`` takes them: of one the number, else the array."""
    return u[0]


@kernel
def all_signals(plant: Any, u: Vector) -> Vector:
    """Return control signals as they are: ``as_input`` of a plant with several."""
    return u


def inputs_of(plant: Any) -> int:
    """Return the number of control signals of a plant."""
    return int(getattr(plant, "inputs", 1))


def outputs_of(plant: Any) -> int:
    """Return the number of outputs of a plant."""
    return int(getattr(plant, "outputs", 1))


def is_several(plant: Any) -> bool:
    """Return whether a plant has more than one control signal or output."""
    return max(inputs_of(plant), outputs_of(plant)) > 1


@generic
def advance(plant: Any, x: Vector, scratch: Vector, t: float, u: Any, w: Vector) -> None:
    """Advance the state ``x`` (n,) by a sample from the time ``t`` [s], with held u and w (m,).

    u is a number, or an array for a plant with several control signals.

    ``scratch`` has room for 6 n numbers. It is the same array during a run, and zero before it.
    """
    raise TypeError


@generic_with_default
def begin_run(plant: Any, x: Vector, scratch: Vector) -> None:
    """Begin a run from the state ``x`` (n,), or begin it again.

    Loops call it, as Python, before the first sample and whenever they put the plant back to its
    initial state. Most plants need nothing.
    """


@generic_with_default
def check_run(plant: Any, scratch: Vector) -> None:
    """Raise the error that ended a run, if the plant met one; loops call it as Python."""


# ---- States from which a simulated plant can't go on ----

# Largest entry of a state, times the largest of 1 and |x0|: at 100 rad/s an angle needs four months
# to get there, and an unstable loop less than a second.
_LARGEST = 1e9


@kernel
def is_destroyed(x: Vector, x0: Vector) -> bool:
    """Return whether a state is not finite or beyond a thousand million times ``x0`` or 1."""
    largest = 1.0
    for i in range(x0.size):
        largest = max(largest, abs(x0[i]))
    for i in range(x.size):  # noqa: SIM110  kernels keep to loops
        if not abs(x[i]) <= _LARGEST * largest:
            return True
    return False


# ---- Plants with names and units for their signals ----

P = TypeVar("P")


class Flow(NamedTuple):
    """What the control signal moves: times u it is the power that u puts into the plant [W].

    For a force [N] it is the speed of the point where it acts [m/s], for a torque [N m] that of its
    shaft [rad/s], for a voltage [V] the current [A]: effort and flow of a bond graph (Karnopp,
    Margolis & Rosenberg, *System Dynamics*, chapter 2).
    """

    state: tuple[float, ...]  #: weights of the states (n,)
    direct: float = 0.0  #: weight of u itself, as of a current that follows the voltage at once
    largest: float = math.inf  #: the largest ``|u|`` that acts; what is beyond is cut off [u-unit]


def labelled(
    plant: P,
    y: str | Quantity = "",
    u: str | Quantity = "",
    w: str | Sequence[str | Quantity] = (),
    flow: Flow | Sequence[float] | None = None,
) -> P:
    """Return a plant whose output, input and disturbances have names and units.

    Plots, tables, files and telemetry of its runs show them. The numbers are the same.

    Parameters
    ----------
    plant
        any plant; it is not changed.
    y, u
        name and unit of output and control signal: ``angle [rad]``; one of both may be left out.
    w
        name and unit of each disturbance.
    flow
        what u times gives power in W, for the energy in comparisons: weights of the states (n,),
        which give the speed where a force or torque u acts, or a ``Flow``; by default what the
        plant has.

    Raises
    ------
    ValueError
        for a text that is not like ``name [unit]``, more names than disturbances, and another
        number of weights than states.

    Examples
    --------
    >>> import quell as ql
    >>> motor = ql.plants.LinearPlant.of(([50.0], [1.0, 22.0, 40.0, 0.0]))
    >>> motor = ql.plants.labelled(motor, y="angle [rad]", u="voltage [V]")
    >>> str(ql.plants.signals_of(motor).y)
    'angle [rad]'
    """
    check_plant(plant)
    signals = Signals.of(y, u, w)
    count = plant.disturbances  # type: ignore[attr-defined]
    if len(signals.w) > count:
        raise ValueError(f"w has {len(signals.w)} names: the plant has {count} disturbances")
    made = copy.copy(plant)
    object.__setattr__(made, "signals", signals)
    if flow is not None:
        given = flow if isinstance(flow, Flow) else Flow(flow)  # type: ignore[arg-type]
        weights = checks.vector("flow", given.state, plant.order)  # type: ignore[attr-defined]
        object.__setattr__(made, "flow", given._replace(state=tuple(weights.tolist())))
    return made


def signals_of(plant: Any) -> Signals:
    """Return names and units of a plant's signals, also behind delays and encoders."""
    while plant is not None:
        found = getattr(plant, "signals", None)
        if isinstance(found, Signals):
            return found
        plant = getattr(plant, "plant", None)
    return UNKNOWN


# ---- Batches of plants of one kind ----


class PlantBatch(Described, Sequence[Plant]):
    """Plants of one kind, order and number of disturbances.

    ``batch[i]`` is a plant, ``batch[i:j]`` a batch again.

    Parameters
    ----------
    plants
        at least one.
    parameters
        arrays (runs,) of the parameters in which the plants differ, by name.

    Raises
    ------
    ValueError
        if an entry is no plant, or of another kind, order or number of disturbances.
    """

    def __init__(
        self, plants: Sequence[Plant], parameters: Mapping[str, Any] | None = None
    ) -> None:
        given: Any = plants
        if isinstance(given, str | bytes) or not isinstance(given, Iterable):
            raise ValueError(f"plants = {plants!r}: must be a sequence of plants")
        self._plants = tuple(plants)
        if not self._plants:
            raise ValueError("plants has no entries: a batch must hold at least one plant")
        for i, plant in enumerate(self._plants):
            check_plant(plant, f"plant[{i}]")
            for what, own, common in (
                ("kind", type(plant).__name__, type(self[0]).__name__),
                ("order", plant.order, self.order),
                ("disturbances", plant.disturbances, self.disturbances),
            ):
                if own != common:
                    raise ValueError(
                        f"plant[{i}] has {what} {own}, plant[0] {common}: must be the same"
                    )
        arrays = {name: np.array(values) for name, values in (parameters or {}).items()}
        for name, array in arrays.items():
            if array.shape != (len(self._plants),):
                raise ValueError(
                    f"parameters[{name!r}] has shape {array.shape}: must be "
                    f"({len(self._plants)},), one value for each plant"
                )
            array.flags.writeable = False
        self.parameters: Mapping[str, NDArray[Any]] = MappingProxyType(arrays)

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints: how many plants of which kind, and what they differ in."""
        parameters = dict(self.parameters)
        found: dict[str, Any] = {"plants": f"{len(self)} of {self.name}", "order": self.order}
        return found | ({"parameters": parameters} if parameters else {})

    @property
    def name(self) -> str:
        """Common name of the plants, or their number if the names differ."""
        names = {plant.name for plant in self._plants}
        return names.pop() if len(names) == 1 else f"{len(self)} plants"

    @property
    def order(self) -> int:
        """Number of states of each."""
        return self._plants[0].order

    @property
    def disturbances(self) -> int:
        """Number of disturbance inputs of each."""
        return self._plants[0].disturbances

    def __len__(self) -> int:
        return len(self._plants)

    @overload
    def __getitem__(self, which: int) -> Plant: ...
    @overload
    def __getitem__(self, which: slice) -> PlantBatch: ...
    def __getitem__(self, which: int | slice) -> Plant | PlantBatch:
        if isinstance(which, slice):
            parameters = {name: values[which] for name, values in self.parameters.items()}
            return PlantBatch(self._plants[which], parameters)
        return self._plants[which]


def batch(factory: Callable[..., Plant], **parameters: Any) -> PlantBatch:
    """Return a batch with a plant for each entry of the parameters' arrays.

    Parameters
    ----------
    factory
        function that makes a plant from numbers, for example ``quell.plants.two_mass_spring``; use
        ``functools.partial`` for arguments that are not numbers. If it makes a new function for
        each ``NonlinearPlant``, each function is compiled.
    parameters
        numbers or vectors (runs,), broadcast against each other.

    Raises
    ------
    ValueError
        for vectors of different lengths, and if the factory raises one; it names the run.

    Examples
    --------
    >>> import numpy as np
    >>> from quell.plants import two_mass_spring
    >>> plants = batch(two_mass_spring, m1=np.linspace(0.5, 2.0, 4), k=1.0)
    >>> len(plants), plants.parameters["m1"][3]
    (4, np.float64(2.0))
    """
    arrays = {name: _numbers(name, value) for name, value in parameters.items()}
    lengths = {name: array.size for name, array in arrays.items() if array.ndim}
    runs = max(lengths.values(), default=1)
    for name, length in lengths.items():
        if length not in (1, runs) or length == 0:
            longest = max(lengths, key=lambda name: lengths[name])
            sizes = f"{name} has {length} entries, {longest} {runs}"
            raise ValueError(f"{sizes}: must be numbers or vectors of one length, at least 1")
    whole = {name: np.broadcast_to(array, (runs,)) for name, array in arrays.items()}
    columns = {name: values.tolist() for name, values in whole.items()}
    try:
        takes = inspect.signature(factory).parameters
        named = all(parameter.kind is not parameter.VAR_KEYWORD for parameter in takes.values())
        for name in parameters:
            if named and name not in takes:
                raise TypeError(f"{name!r} is unknown, {checks.nearest(name, [*takes])}")
        inspect.signature(factory).bind(**columns)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"parameters = {', '.join(parameters) or 'none'}: the factory can't be called with "
            f"them: {error}"
        ) from None
    plants = []
    for i in range(runs):
        try:
            plants.append(factory(**{name: values[i] for name, values in columns.items()}))
        except ValueError as error:
            raise ValueError(f"run {i}: {error}") from error
    return PlantBatch(plants, whole)


def _numbers(name: str, value: Any) -> NDArray[Any]:
    rule = "must be a number or a vector of numbers, one for each run"
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        array = np.empty((), dtype=object)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name}: {rule}, got {value!r:.60}")
    if array.ndim > 1:
        raise ValueError(f"{name} has shape {array.shape}: {rule}")
    return array
