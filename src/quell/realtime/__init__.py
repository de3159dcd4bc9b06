"""Real time: a controller closed around a device at a fixed rate, with safe actions for faults.

May import ``simulation``, ``plants``, ``controllers`` and what they import.

The public names, imported when first used::

    from quell.realtime import Safety, open_device, run_rig

    device = open_device("udp://127.0.0.1:5005", dt=1e-3)
    safety = Safety(most_error=1.0)
    run    = run_rig(device, controller, scenario, safety=safety, telemetry=["run.mcap"])
    print(run.text())
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quell.realtime.devices.base import Device
    from quell.realtime.devices.registry import open_device
    from quell.realtime.devices.twin import TwinDevice
    from quell.realtime.loop.replay import replay
    from quell.realtime.loop.result import RigRun
    from quell.realtime.loop.run import run_rig
    from quell.realtime.loop.safety import Safety
    from quell.realtime.rig.server import Rig
    from quell.realtime.telemetry.csv_file import CsvSink
    from quell.realtime.telemetry.live import LiveSink
    from quell.realtime.telemetry.load import load
    from quell.realtime.telemetry.mcap_file import McapSink
    from quell.realtime.wire.target import record_target

_HOME = {
    "CsvSink": "telemetry.csv_file",
    "Device": "devices.base",
    "LiveSink": "telemetry.live",
    "McapSink": "telemetry.mcap_file",
    "Rig": "rig.server",
    "RigRun": "loop.result",
    "Safety": "loop.safety",
    "TwinDevice": "devices.twin",
    "load": "telemetry.load",
    "open_device": "devices.registry",
    "record_target": "wire.target",
    "replay": "loop.replay",
    "run_rig": "loop.run",
}

__all__ = [
    "CsvSink", "Device", "LiveSink", "McapSink", "Rig", "RigRun", "Safety", "TwinDevice",
    "load", "open_device", "record_target", "replay", "run_rig",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'quell.realtime' has no attribute {name!r}")
    home = importlib.import_module(f"quell.realtime.{_HOME[name]}")
    value = getattr(home, name)
    globals()[name] = value
    return value
