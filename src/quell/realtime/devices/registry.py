"""Devices and rigs by their URL."""

from __future__ import annotations

import importlib
from typing import Any

from quell import checks
from quell.plants.base import Plant
from quell.plants.registry import TESTBEDS
from quell.realtime.devices.base import handle_of

# Scheme: where it is, the loop's end and the device's end of it, and an example.
_SCHEMES: dict[str, tuple[str, str, str | None, str]] = {
    "udp": ("quell.realtime.wire.udp", "UdpDevice", "UdpListener", "udp://127.0.0.1:5005"),
    "shm": ("quell.realtime.wire.shared_memory", "SharedDevice", "SharedListener", "shm://rig"),
    "serial": (
        "quell.realtime.wire.serial_line",
        "SerialDevice",
        "SerialListener",
        "serial:///dev/ttyACM0",
    ),
    "ni": ("quell.realtime.devices.ni", "ni_device", None, "ni://Dev1/ctr0+Dev2/ao0"),
    "twin": ("quell.realtime.devices.registry", "twin", None, "twin:torsional"),
}


def open_device(device: Any, dt: float) -> Any:
    """Return the device that a URL names.

    Parameters
    ----------
    device
        ``udp://HOST:PORT``, ``shm://NAME``, ``serial:///dev/…``, ``ni://…``, or ``twin:NAME`` for
        a plant in this process, on which u acts at once (``twin:torsional``; the names are in
        ``quell.plants.registry.TESTBEDS``); an object with ``read``, ``write`` and ``close`` is
        returned as it is.
    dt
        sample time [s].

    Raises
    ------
    ValueError
        for a URL that names no device, or something that is none.
    ConnectionError
        where the device does not answer.
    """
    if not isinstance(device, str):
        handle_of(device)
        return device
    return _part(device, 1)(device, dt)


def listen(url: str) -> Any:
    """Return the device's end of the wire that a URL names, for a ``Rig``.

    Raises
    ------
    ValueError
        for a URL at which nothing can listen.
    """
    return _part(url, 2)(url)


def twin(url: str, dt: float) -> Any:
    """Return ``twin:NAME``, a plant in this process as a device."""
    from quell.realtime.devices.twin import TwinDevice

    return TwinDevice(plant_named(url.partition(":")[2], "device"), dt)


def plant_named(name: str, argument: str = "plant") -> Plant:
    """Return the plant of this name, with its own parameters.

    Raises
    ------
    ValueError
        for a name that is not known.
    """
    return TESTBEDS[checks.one_of(argument, name, tuple(TESTBEDS))]()


def _part(url: str, which: int) -> Any:
    known = {scheme: entry for scheme, entry in _SCHEMES.items() if entry[which] is not None}
    scheme = url.partition(":")[0]
    if scheme not in known:
        raise ValueError(
            f"device = {url!r}: must be like {', '.join(entry[3] for entry in known.values())}"
        )
    home = known[scheme]
    return getattr(importlib.import_module(home[0]), str(home[which]))
