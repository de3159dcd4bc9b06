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

from typing import TYPE_CHECKING

from quell.lazy import imported_on_use, public_names

if TYPE_CHECKING:
    from quell.realtime.devices import Device, TwinDevice
    from quell.realtime.live import LiveSink
    from quell.realtime.memory_file import MemoryFile
    from quell.realtime.proxy import CompensatedDrive
    from quell.realtime.recordings import CsvSink, McapSink, load
    from quell.realtime.registry import open_device
    from quell.realtime.replaying import replay
    from quell.realtime.rig import Rig
    from quell.realtime.run import RigRun, run_rig
    from quell.realtime.safety import Safety
    from quell.realtime.target import record_target

_HOMES = {
    "CompensatedDrive": "proxy",
    "CsvSink": "recordings",
    "Device": "devices",
    "LiveSink": "live",
    "McapSink": "recordings",
    "MemoryFile": "memory_file",
    "Rig": "rig",
    "RigRun": "run",
    "Safety": "safety",
    "TwinDevice": "devices",
    "load": "recordings",
    "open_device": "registry",
    "record_target": "target",
    "replay": "replaying",
    "run_rig": "run",
}

__all__ = [
    "CompensatedDrive", "CsvSink", "Device", "LiveSink", "McapSink", "MemoryFile", "Rig", "RigRun",
    "Safety", "TwinDevice", "load", "open_device", "record_target", "replay", "run_rig",
]  # fmt: skip

__getattr__ = imported_on_use(__name__, _HOMES)

__dir__ = public_names(__name__)
