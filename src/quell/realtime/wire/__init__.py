"""Devices at the other end of a wire: frames, UDP, shared memory and serial lines.

May import ``realtime.devices.base``, ``realtime.system`` and ``realtime.telemetry``.
"""
