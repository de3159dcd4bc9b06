"""Devices: the interface to the loop, and a plant in this process as a device.

The interface between the loop and a device: a plant in hardware, simulated, or behind a wire.

A device is an object with ``read() -> y``, ``write(u)`` and ``close()``. A device that can be used
from compiled code also has a ``handle``: a NamedTuple for whose type ``read_measurement`` and
``write_signals`` are registered. Any other device gets a ``PythonHandle``; its loop runs as Python.

A device with its own clock sends a numbered measurement at each of its ticks; its attribute
``paced`` is True, and ``read_tick`` waits for the next one. Other devices answer at any time.

A device of several axes has an attribute ``signal_counts``; its ``read`` returns an array (p,), its
``write`` takes one (m,). For a handle ``read_measurement`` and ``read_tick`` then return the first
number if all are finite and NaN if one is not, and ``read_signals`` gives them all.

A device that measures more than y has ``read_channels() -> numbers``, those of the last ``read``;
for a handle ``read_channels`` is registered (``realtime/channels.py``).

A plant in this process as a device: it has no clock, and advances by a sample at each write.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quell import checks
from quell.kernels.dispatch import (
    call_specialised,
    compiled,
    generic,
    generic_with_default,
    interpreted,
    is_finite,
    kernel,
)
from quell.plants.base import (
    Plant,
    advance,
    as_input,
    begin_run,
    check_plant,
    check_run,
    inputs_of,
    is_destroyed,
    is_several,
    measure_all,
    outputs_of,
    signals_of,
)
from quell.types import Matrix, Vector

# ---- The interface between the loop and a device ----


class SignalCounts(NamedTuple):
    """How many signals a device of several axes has."""

    outputs: int  #: measurements p
    inputs: int  #: control signals m


@runtime_checkable
class Device(Protocol):
    """A plant that can be read and written, one sample at a time."""

    def read(self) -> float:
        """Return the newest measurement [y-unit], NaN if none has come in time."""

    def write(self, u: float) -> None:
        """Apply the control signal ``u`` [u-unit] until the next one."""

    def close(self) -> None:
        """Set u to zero and release the device; a second call does nothing."""


class Listener(Protocol):
    """The device's end of a wire, made from a URL by ``listen`` of the registry.

    Constructors raise a ``ValueError`` for a wrong URL, and if it is in use or can't be opened.
    """

    url: str
    transport: Any  # its type has the functions of ``quell.realtime.wire``

    def close(self) -> None:
        """Release the wire."""


@generic
def read_measurement(handle: Any, clock: Any, until: int) -> tuple[float, int]:
    """Return the newest measurement [y-unit] and the time spent waiting for it [ns].

    Each measurement is returned once. If there is no new one, the handle of a paced device waits
    until the time ``until`` [ns] of ``clock``. NaN if none has come, or if the device has sent NaN.
    """
    raise TypeError


class Tick(NamedTuple):
    """A tick of a device with its own clock."""

    y: float  #: measurement [y-unit]; NaN if none came, or if the device has sent NaN
    steps: int  #: ticks since the last one that was returned; 0 if none came in time
    u: float  #: control signal from this tick on [u-unit]; NaN if it is not known
    left: int  #: number of newer ticks that have come already
    waited: int  #: time spent waiting [ns]


@generic
def read_tick(handle: Any, clock: Any, until: int) -> Tick:
    """Return the next tick of a paced device in order, however late it comes.

    If there is none, wait for it until the time ``until`` [ns] of ``clock``.
    """
    raise TypeError


@generic
def write_signals(handle: Any, u: Vector) -> int:
    """Apply ``u`` (m,) [u-unit].

    Return 0, 1 if it can't be sent, more if the device keeps u at zero.
    """
    raise TypeError


def __getattr__(name: str) -> Any:
    if name == "write_command":
        raise ImportError("write_command is write_signals now, with an array u (m,) for one u, too")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@generic_with_default
def ask(handle: Any) -> None:
    """Ask a paced device, which sends only as long as it hears from the loop, for measurements."""


@generic_with_default
def read_channels(handle: Any, values: Vector) -> None:
    """Write what the device gave beside the last measurement into ``values``, in its order.

    NaN for what has not come, or is too old. The default is a device that gives y only.
    """
    for i in range(values.size):
        values[i] = math.nan


@generic_with_default
def read_signals(handle: Any, y: Vector) -> None:
    """Write all measurements of the last read or tick into ``y`` (p,); NaN for one without.

    ``y`` has the first: a device of one y needs no implementation.
    """


@generic_with_default
def read_acting(handle: Any, u: Vector) -> None:
    """Write the control signals from the last tick of a paced device on into ``u`` (m,).

    ``u`` has the first: a device of one u needs no implementation.
    """


@generic_with_default
def drop_signals(handle: Any) -> None:
    """Forget the measurements of the last tick: it is an old one."""


def counts_of(plant: Any) -> SignalCounts | None:
    """Return how many signals a plant, or a controller, has; None for one y and one u."""
    of_arrays = hasattr(plant, "inputs") if hasattr(plant, "initial_state") else is_several(plant)
    return SignalCounts(plant.outputs, plant.inputs) if of_arrays else None


def checked_counts(signals: Any, most: int) -> SignalCounts | None:
    """Return numbers of signals if they are from 1 to ``most``; None as it is."""
    if signals is None:
        return None
    if not checks.is_sequence(signals) or len(signals) != 2:
        rule = "must be the numbers of measurements and of control signals"
        raise ValueError(f"signals = {signals!r:.60}: {rule}")
    names = ("signals[0]", "signals[1]")
    return SignalCounts(*map(checks.whole, names, signals, (1, 1), (most, most)))


def counts_text(counts: SignalCounts | None) -> str:
    """Return numbers of signals as words."""
    if counts is None or counts == (1, 1):
        return "one measurement and one control signal"
    outputs = "one measurement" if counts.outputs == 1 else f"{counts.outputs} measurements"
    inputs = "one control signal" if counts.inputs == 1 else f"{counts.inputs} control signals"
    return f"{outputs} and {inputs}"


def other_counts(device: str, theirs: SignalCounts | None, ours: SignalCounts | None) -> str:
    """Return the message for a device with other numbers of signals than the controller.

    ``None`` is one y and one u as numbers, and (1, 1) a list of one number each.
    """
    if counts_text(theirs) == counts_text(ours) and ours is None:
        return (
            f"device = {device}: gives y and takes u as lists of one number, the controller as "
            "numbers: must be the same; leave out signals of the device (a device in Python: "
            "signal_counts), or take quell.Axes of this controller"
        )
    if counts_text(theirs) == counts_text(ours):
        return (
            f"device = {device}: gives y and takes u as numbers, the controller, an Axes of one "
            "axis, as lists of one number: must be the same; open the device with signals=(1, 1) "
            "(a device in Python: the attribute signal_counts = (1, 1)), or take the controller of "
            "the axis"
        )
    return (
        f"device = {device}: has {counts_text(theirs)}, the controller {counts_text(ours)}: must "
        "be as many; take the device of this machine, or a setup with a table [[axis]] for each "
        "measurement and limits in [axes] for each actuator"
    )


def check_counts(device: Any, ours: SignalCounts | None) -> None:
    """Raise a ``ValueError`` unless a device has as many signals as the controller, ``ours``."""
    given = getattr(device, "signal_counts", None)
    theirs = None if given is None else SignalCounts(*given)
    if theirs != ours:
        raise ValueError(other_counts(type(device).__name__, theirs, ours))


@kernel
def first_if_finite(y: Vector) -> float:
    """Return the first number if all are finite, else NaN."""
    for i in range(y.size):
        if not is_finite(y[i]):
            return math.nan
    return y[0]


class PythonHandle(NamedTuple):
    """A device that only Python can use."""

    device: Device
    errors: list[Exception]  #: the exception that it raised last, if any
    faults: NDArray[np.int64]  #: number of exceptions that it raised (1,)
    y: Vector  #: last measurements of a device of several axes (p,); (0,) for one y and one u


def handle_of(device: Device) -> Any:
    """Return the handle of a device, a ``PythonHandle`` if it has none."""
    if isinstance(device, type) or not isinstance(device, Device):
        raise ValueError(
            f"device = {device!r}: must have read(), write(u) and close(), "
            "for example quell.realtime.TwinDevice(plant, dt)"
        )
    handle = getattr(device, "handle", None)
    if handle is not None:
        return handle
    counts = getattr(device, "signal_counts", None)
    room = np.full(0 if counts is None else counts[0], math.nan)
    return PythonHandle(device, [], np.zeros(1, dtype=np.int64), room)


@read_measurement.register(PythonHandle)
def _read_measurement(handle: PythonHandle, clock: Any, until: int) -> tuple[float, int]:
    handle.y[:] = math.nan
    try:
        found: Any = handle.device.read()
        if not handle.y.size:
            return float(found), 0
        values = [float(value) for value in found]
        if len(values) != handle.y.size:  # a list of one number would be taken for all
            raise ValueError(f"read() gave {len(values)} numbers: must give {handle.y.size}")
        handle.y[:] = values
        return first_if_finite(handle.y), 0
    except Exception as error:  # whatever a driver raises, the loop must go on to its safe action
        _count_error(handle, error)
        return math.nan, 0


@read_channels.register(PythonHandle)
def _read_channels(handle: PythonHandle, values: Vector) -> None:
    values[:] = math.nan
    try:
        given: Any = handle.device
        found = [float(value) for value in given.read_channels()][: values.size]
        values[: len(found)] = found
    except Exception as error:
        _count_error(handle, error)


@read_signals.register(PythonHandle)
def _read_signals(handle: PythonHandle, y: Vector) -> None:
    if handle.y.size:
        y[:] = handle.y


@write_signals.register(PythonHandle)
def _write_signals(handle: PythonHandle, u: Vector) -> int:
    try:
        given: Any = handle.device
        given.write(u.copy() if handle.y.size else float(u[0]))
    except Exception as error:
        _count_error(handle, error)
        return 1
    return 0


def _count_error(handle: PythonHandle, error: Exception) -> None:
    handle.faults[0] += 1
    handle.errors[:] = [error]


# ---- A plant in this process as a device ----


class TwinHandle(NamedTuple):
    """A sampled plant and its state."""

    plant: Any
    x: Vector  # state of the plant (n,)
    scratch: Vector
    w: Vector  # disturbances: zero (q,)
    t: Vector  # samples since the start, and the sample time [s] (2,)
    channels: Matrix  # of each sample; the last row holds for all later ones (N, c)
    y: Vector  # last measurements (p,)
    u: Vector  # last control signals (m,)


@read_measurement.register(TwinHandle)
def _read_measurement_twin(handle: TwinHandle, clock: Any, until: int) -> tuple[float, int]:
    measure_all(handle.plant, handle.x, handle.y)
    return first_if_finite(handle.y), 0


@read_signals.register(TwinHandle)
def _read_signals_twin(handle: TwinHandle, y: Vector) -> None:
    for i in range(y.size):
        y[i] = handle.y[i]


@read_channels.register(TwinHandle)
def _read_channels_twin(handle: TwinHandle, values: Vector) -> None:
    row = min(int(handle.t[0]), handle.channels.shape[0] - 1)
    for i in range(values.size):
        values[i] = handle.channels[row, i] if i < handle.channels.shape[1] else math.nan


@write_signals.register(TwinHandle)
def _write_signals_twin(handle: TwinHandle, u: Vector) -> int:
    acting = as_input(handle.plant, u)
    advance(handle.plant, handle.x, handle.scratch, handle.t[0] * handle.t[1], acting, handle.w)
    handle.t[0] += 1.0
    return 0


@compiled
def _read(handle: TwinHandle) -> None:
    measure_all(handle.plant, handle.x, handle.y)


@compiled
def _write(handle: TwinHandle) -> None:
    write_signals(handle, handle.u)


class TwinDevice:
    """A simulated plant: ``read`` measures it, ``write(u)`` advances it by a sample ``dt`` [s].

    A plant of several signals is measured as an array (p,), and takes one (m,).

    It starts from the state ``x0`` (n,), zero by default. u acts at once. Over a wire it acts a
    sample later; ``quell.plants.delayed(plant, dt, dt)`` adds the same delay to this device. It
    gives ``channels`` beside y: c constants, or a row for each sample (N, c), of which the last one
    stays.

    Raises
    ------
    ValueError
        if ``plant`` is not a plant, dt is not positive, x0 has the wrong size, or channels are no
        numbers.

    Examples
    --------
    >>> import quell as ql
    >>> from quell.realtime.devices import TwinDevice
    >>> twin = TwinDevice(ql.plants.two_mass_spring(), dt=0.01)
    >>> twin.write(1.0)
    >>> f"{twin.read():.3g}"
    '4.17e-10'
    """

    paced = False
    lost = False

    def __init__(
        self, plant: Plant, dt: float, x0: ArrayLike | None = None, *, channels: ArrayLike = ()
    ) -> None:
        check_plant(plant)
        self.dt = checks.positive("dt", dt, "s")
        order = plant.order
        x = np.zeros(order) if x0 is None else checks.vector("x0", x0, order)
        scratch, w = np.zeros(6 * order), np.zeros(plant.disturbances)
        model = plant.sampled(dt, not plant.compiled)
        self._x0 = x.copy()
        self.signals = signals_of(plant)
        begin_run(model, x, scratch)
        try:
            rows = np.atleast_2d(np.array(channels, dtype=np.float64))
        except (TypeError, ValueError):
            rows = np.zeros(0)
        if rows.ndim != 2 or rows.shape[0] == 0:
            rule = "must be numbers, or a row of numbers for each sample"
            raise ValueError(f"channels = {channels!r:.60}: {rule}")
        given, t = np.ascontiguousarray(rows), np.array([0.0, dt])
        self.signal_counts, self._channels = counts_of(plant), given
        y, u = np.full(outputs_of(plant), np.nan), np.zeros(inputs_of(plant))
        self._handle = TwinHandle(model, x, scratch, w, t, given, y, u)
        # Without a public handle the loop runs as Python.
        self.handle = self._handle if plant.compiled else None

    @property
    def counters(self) -> dict[str, int]:
        """Number of samples written."""
        return {"written": int(self._handle.t[0])}

    @property
    def x(self) -> Vector:
        """State of the plant, as a copy (n,)."""
        return self._handle.x.copy()

    def read(self) -> Any:
        """Return y [y-unit]."""
        self._run(_read)
        y = self._handle.y
        return float(y[0]) if self.signal_counts is None else y.copy()

    def _run(self, entry: Any) -> None:
        """Run a compiled function of the handle, or as Python."""
        if self.handle is None:
            interpreted(entry)(self._handle)
        else:
            call_specialised(entry, self.handle)

    def read_channels(self) -> list[float]:
        """Return the channels of this sample."""
        rows = self._channels
        return rows[min(int(self._handle.t[0]), len(rows) - 1)].tolist()

    def write(self, u: Any) -> None:
        """Apply u [u-unit] for a sample."""
        if self.signal_counts is None:
            self._handle.u[0] = float(u)
        else:
            self._handle.u[:] = checks.vector("u", u, self.signal_counts.inputs)
        self._run(_write)
        check_run(self._handle.plant, self._handle.scratch)

    def close(self) -> None:
        """Put a plant whose state is destroyed back to ``x0``, so that the device can be reused."""
        handle = self._handle
        if is_destroyed(handle.x, self._x0):
            handle.x[:], handle.t[0] = self._x0, 0.0
            begin_run(handle.plant, handle.x, handle.scratch)


def twin_device(url: str, dt: float, trust: bool = False) -> TwinDevice:
    """Return the device ``twin:PLANT``; PLANT is what ``quell.setup.schema.plant_given`` takes."""
    from quell.setup.schema import plant_given

    text = url.partition(":")[2]
    plant = plant_given(text, dt, argument="device", trust=trust, several=True)
    return TwinDevice(plant, dt)
