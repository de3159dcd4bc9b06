"""Devices by their URL, in one table.

A new device needs its own file and an entry in ``SCHEMES``. The entries name modules as text, so
that only the device in use is imported; the command line reads the table for its help.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from quell.realtime.devices import Device, Listener


class Scheme(NamedTuple):
    """The devices whose URLs begin with one word."""

    example: str
    description: str
    module: str  # module below ``quell.realtime``
    device: str  # name there of the loop's end, which is called with URL and sample time
    listener: str = ""  # name there of the device's end, called with the URL; empty if none


# fmt: off
SCHEMES = {
    "udp": Scheme("udp://127.0.0.1:5005", "network", "transports", "UdpDevice", "UdpListener"),
    "serial": Scheme("serial:///dev/ttyACM0", "serial port",
                     "transports", "SerialDevice", "SerialListener"),
    "ni": Scheme("ni://Dev1/ctr0+Dev2/ao0", "NI cards", "ni", "ni_device"),
    "twin": Scheme("twin:torsional", "simulation", "devices", "twin_device"),
}
# fmt: on


def examples(listening: bool = False) -> str:
    """Return an example of each URL; if ``listening``, of those at which a rig can listen."""
    schemes = [scheme for scheme in SCHEMES.values() if scheme.listener or not listening]
    return ", ".join(f"{scheme.example} ({scheme.description})" for scheme in schemes)


def open_device(
    device: str | Device, dt: float, trust: bool = False, signals: tuple[int, int] | None = None
) -> Any:
    """Return the device of a URL.

    Parameters
    ----------
    device
        a URL: ``udp://HOST:PORT``, ``serial:///dev/…``, ``ni://…``, or
        ``twin:PLANT`` for a plant in this process, on which u acts at once: ``twin:torsional``,
        ``twin:setup.toml``, ``twin:model.json`` and whatever else ``quell.setup.plant_given``
        takes. An object with ``read``, ``write`` and ``close`` is returned as it is.
    dt
        sample time [s].
    trust
        whether the Python file of ``twin:file.py:name`` may be run.
    signals
        numbers of measurements and of control signals of a device of several axes, as many as the
        controller has: ``signals=(axes.outputs, axes.inputs)``. A twin has those of its plant.

    Raises
    ------
    ValueError
        for a URL of no known device, an object that is not a device, and a device with other
        numbers of signals.
    ConnectionError
        if the device does not answer.
    """
    from quell.realtime.devices import handle_of

    if not isinstance(device, str):
        handle_of(device)
        return device
    more: dict[str, Any] = {"trust": trust} if device.startswith("twin:") else {}
    made = _end(device, listening=False)
    if signals is not None and not more:
        more = {"signals": signals}
    return made(device, dt, **more)


def listen(url: str) -> Listener:
    """Return the device's end of the wire with this URL, for a ``Rig``."""
    return _end(url, listening=True)(url)


def _end(url: str, listening: bool) -> Any:
    scheme = SCHEMES.get(url.partition(":")[0])
    if scheme is None or (listening and not scheme.listener):
        raise ValueError(f"device = {url!r}: must be like {examples(listening)}")
    module = importlib.import_module(f"quell.realtime.{scheme.module}")
    return getattr(module, scheme.listener if listening else scheme.device)
