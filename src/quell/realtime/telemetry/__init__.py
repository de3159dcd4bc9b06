"""Telemetry of the real-time loop: ring buffer, writer thread, file formats, live connection, loading of recordings.

May import ``records`` and ``realtime.system``.
"""
