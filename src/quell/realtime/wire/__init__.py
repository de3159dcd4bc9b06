"""Devices at the other end of a wire: frames, sessions and transports.

May import ``realtime.devices.base``, ``realtime.system`` and ``realtime.telemetry``.
"""
