"""Channels: numbers that a device measures beside y, for a schedule, and whether the plant is held.

A device may give further numbers with each measurement: the load of a crane, the extension of an
axis, the state of a brake. ``run_rig(channels=…)`` names them in the device's order. The first ones
are the external signals of the controller's schedule, as many as it follows; the one called
``held`` says whether the plant is held (above one half: it is); all are recorded.

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
from quell.controllers.base import is_usable, set_held, set_schedule_signals
from quell.controllers.compensated import can_be_held
from quell.kernels.dispatch import kernel
from quell.realtime.recordings import LOOP_CHANNELS
from quell.types import Vector

HELD = "held"
"""Name of the channel that says whether the plant is held."""

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
    missing: NDArray[np.int64]
    """Samples since ``held`` was usable, and whether a channel that is used is missing now (2,)."""
    external: int  #: how many of the first ones are signals of the schedule
    held: int  #: place of ``held``; −1 if there is none


def channel_inputs(controller: Any, names: Sequence[str]) -> ChannelInputs:
    """Return the channels of a controller, all missing; ``names`` as ``checked_channels`` does."""
    external = int(getattr(controller, "external_signals", 0))
    held = names.index(HELD) if HELD in names else -1
    values = np.full(len(names), np.nan)
    return ChannelInputs(values, np.zeros(2, dtype=np.int64), external, held)


@kernel
def pass_channels(inputs: ChannelInputs, design: Any, state: Any, hold: int) -> None:
    """Hand the channels of a sample over to a controller.

    ``held`` keeps its state for ``hold`` samples.
    """
    values, missing = inputs.values, inputs.missing
    missing[1] = 0
    for i in range(inputs.external):
        if not is_usable(values[i]):
            missing[1] = 1
    if inputs.external > 0:
        set_schedule_signals(design, state, values[: inputs.external])
    if inputs.held >= 0:
        value = values[inputs.held]
        if is_usable(value):
            missing[0] = 0
            set_held(design, state, value > _IS_HELD)
        else:
            missing[0] += 1
            missing[1] = 1
            if missing[0] > hold:
                set_held(design, state, False)


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
    taken = {name for name, _ in (*LOOP_CHANNELS, *controller.channels)} | {"time"}
    for name in found:
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            rule = "must be small letters, digits and _, a letter first"
            raise ValueError(f"channels: {name!r} {rule}")
        if name in taken or found.count(name) > 1:
            raise ValueError(f"channels: {name!r} is the name of another column; take another one")
    external = int(getattr(controller, "external_signals", 0))
    if found[:external].count(HELD) or len(found) < external:
        signals = "signal" if external == 1 else "signals"
        raise ValueError(
            f"channels = {list(found)!r}: the schedule of the controller follows {external} "
            f"external {signals}; name the device's channels, these first, or follow 'reference', "
            "'y' or 'speed', or take the controller at one point, controller.at(…)"
        )
    if HELD in found and not can_be_held(controller):
        raise ValueError(
            f"channels: {HELD!r} says nothing to a {type(controller).__name__}, which has no "
            "observer that knows the plant at rest; leave it out, or record it by another name"
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
    used = [*range(inputs.external), *([inputs.held] if inputs.held >= 0 else [])]
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
