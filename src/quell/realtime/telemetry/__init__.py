"""Telemetry of the real-time loop: ring buffer, file formats, live connection, and loading of recordings.

May import ``records`` and ``realtime.system``.
"""
