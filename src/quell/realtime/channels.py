"""Channels: numbers that a device measures beside y, for a schedule, and whether the plant is held.

A device may give further numbers with each measurement: the load of a crane, the extension of an
axis, the state of a brake. ``run_rig(channels=…)`` names them in the device's order. The first ones
are the external signals of the controller's schedule, as many as it follows; the one called
``held`` says whether the plant is held (above one half: it is); all are recorded. Of several axes
``held`` says it of all, ``elbow.held`` of the axis called elbow, and any other name may begin with
that of an axis: it is then in the record of that axis.

What is missing, that is not finite or not there, is held: the schedule keeps its last value
(``Status.SCHEDULE_HELD``), and ``held`` keeps its last state for ``Safety.hold`` samples. After
that the plant counts as free, because an observer that rests while the plant moves sees no load. In
the record such samples have ``Event.CHANNEL``.

A loop does not begin before each channel that the controller uses has come.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import is_usable, set_axis_held, set_schedule_signals
from quell.controllers.compensated import can_be_held
from quell.controllers.several import axes_of
from quell.kernels.dispatch import kernel
from quell.realtime.devices import read_channels
from quell.realtime.recordings import LOOP_CHANNELS
from quell.types import Vector

HELD = "held"
"""Name of the channel that says whether the plant is held; ``elbow.held`` says it of an axis."""

# A channel above it says that the plant is held: it is sent as 0 or 1.
_IS_HELD = 0.5
# Names of columns, also in ROS messages.
_NAME = re.compile(r"[a-z][a-z0-9_]*")
# Time that a device has to send each channel that is used [s]; at least so many samples, as long as
# a channel of a wire counts as fresh. Chosen by hand; not tuned further.
_FIRST, _FIRST_SAMPLES = 2.0, 50.0


class ChannelInputs(NamedTuple):
    """The channels of a sample, and what they are for; make it with ``channel_inputs``."""

    values: Vector  #: in this sample, in the device's order (c,)
    missing: NDArray[np.int64]  #: whether a channel that is used is missing now (1,)
    external: int  #: how many of the first ones are signals of the schedule
    held: NDArray[np.int64]
    """Of each channel that says what is held: its place, the axis (−1 for all), samples since it
    was usable, and what it says (h, 4)."""
    axes: int  #: how many the controller has


_PLACE, _AXIS, _SINCE, _SAYS = range(4)


def channel_inputs(controller: Any, names: Sequence[str]) -> ChannelInputs:
    """Return the channels of a controller, all missing; ``names`` as ``checked_channels`` does."""
    external = int(getattr(controller, "external_signals", 0))
    held = [(place, axis, 0, 0) for place, axis in _places_of_held(controller, names)]
    return ChannelInputs(
        values=np.full(len(names), np.nan),
        missing=np.zeros(1, dtype=np.int64),
        external=external,
        held=np.array(held, dtype=np.int64).reshape(-1, 4),
        axes=len(axes_of(controller)),
    )


def _places_of_held(controller: Any, names: Sequence[str]) -> list[tuple[int, int]]:
    """Return the place of each channel that says what is held, and its axis; −1 for all."""
    of = {HELD: -1} | {f"{name}.{HELD}": i for i, name in enumerate(axes_of(controller))}
    return [(place, of[name]) for place, name in enumerate(names) if name in of]


@kernel
def read_inputs(inputs: ChannelInputs, handle: Any) -> None:
    """Read the channels of a device, if there are some."""
    if inputs.values.size > 0:
        read_channels(handle, inputs.values)


@kernel
def record_channels(inputs: ChannelInputs, row: Vector) -> None:
    """Write the channels of a sample into ``row`` (c,)."""
    for i in range(inputs.values.size):
        row[i] = inputs.values[i]


@kernel
def pass_channels(inputs: ChannelInputs, design: Any, state: Any, hold: int) -> None:
    """Hand the channels of a sample over to a controller.

    ``held`` keeps its state for ``hold`` samples.
    """
    values, missing = inputs.values, inputs.missing
    missing[0] = 0
    for i in range(inputs.external):
        if not is_usable(values[i]):
            missing[0] = 1
    if inputs.external > 0:
        set_schedule_signals(design, state, values[: inputs.external])
    if inputs.held.shape[0] > 0:
        for each in range(inputs.held.shape[0]):
            value = values[inputs.held[each, _PLACE]]
            if is_usable(value):
                inputs.held[each, _SINCE] = 0
                inputs.held[each, _SAYS] = 1 if value > _IS_HELD else 0
            else:
                missing[0] = 1
                inputs.held[each, _SINCE] += 1
                if inputs.held[each, _SINCE] > hold:
                    inputs.held[each, _SAYS] = 0
        for axis in range(inputs.axes):
            held = 0
            for each in range(inputs.held.shape[0]):
                of = inputs.held[each, _AXIS]
                if of == axis or of < 0:
                    held |= inputs.held[each, _SAYS]
            set_axis_held(design, state, axis, held != 0)


def checked_channels(controller: Any, names: Any) -> tuple[str, ...]:
    """Return the names of the channels if they are all that the controller needs.

    Raises
    ------
    ValueError
        for what is no list of names, a name that is not unique in the record, a schedule without
        its signals, and ``held`` for a controller to which it says nothing.
    """
    if isinstance(names, str) or not checks.is_sequence(names):
        rule = "must be a list of names, in the order in which the device gives them"
        raise ValueError(f"channels = {names!r}: {rule}")
    found = tuple(names)
    axes = [name for name in axes_of(controller) if name]
    taken = {name for name, _ in (*LOOP_CHANNELS, *controller.channels)} | {"time"}
    for name in found:
        axis, dot, own = str(name).rpartition(".")
        if not isinstance(name, str) or not _NAME.fullmatch(own) or (dot and axis not in axes):
            rule = "must be small letters, digits and _, a letter first"
            before = f"; before it may be an axis and a dot, {axes[0]}.{HELD}" if axes else ""
            raise ValueError(f"channels: {name!r} {rule}{before}")
        if name in taken or (dot and own in taken) or found.count(name) > 1:
            raise ValueError(f"channels: {name!r} is the name of another column; take another one")
    external = int(getattr(controller, "external_signals", 0))
    if found[:external].count(HELD) or len(found) < external:
        signals = "signal" if external == 1 else "signals"
        raise ValueError(
            f"channels = {list(found)!r}: the schedule of the controller follows {external} "
            f"external {signals}; name the device's channels, these first, or follow 'reference', "
            "'y' or 'speed', or take the controller at one point, controller.at(…)"
        )
    for place, of in _places_of_held(controller, found):
        for i, part in enumerate(axes_of(controller).values()):
            if of in (i, -1) and not can_be_held(part):
                axis = f"axis {axes[i]}, a " if axes else ""
                raise ValueError(
                    f"channels: {found[place]!r} says nothing to {axis or 'a '}"
                    f"{type(part).__name__}, which has no observer that knows the plant at rest; "
                    "leave it out, or record it by another name"
                )
    return found


def await_channels(device: Any, inputs: ChannelInputs, names: Sequence[str], dt: float) -> None:
    """Read a device until each channel that the controller uses has come.

    Raises
    ------
    ValueError
        for a device that gives y only.
    ConnectionError
        if one does not come.
    """
    if not names:
        return
    if not hasattr(device, "read_channels"):
        raise ValueError(
            f"channels = {list(names)!r}: {type(device).__name__} gives y only; a device with "
            "channels has read_channels()"
        )
    used = [*range(inputs.external), *inputs.held[:, _PLACE].tolist()]
    device.read()  # the first one may compile, which must not count as waiting
    end = time.monotonic() + max(_FIRST, _FIRST_SAMPLES * dt)
    while True:
        values = [float(value) for value in device.read_channels()]
        values += [np.nan] * (len(names) - len(values))
        missing = [i for i in used if not is_usable(values[i])]
        if not missing:
            return
        if time.monotonic() > end or not getattr(device, "paced", False):
            which = ", ".join(f"{names[i]!r} (number {i})" for i in missing)
            raise ConnectionError(
                f"device: the channel {which} has not come; the device must send it with its "
                "measurements, see docs/devices"
            )
        device.read()
