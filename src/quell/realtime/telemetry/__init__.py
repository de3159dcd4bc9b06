"""Telemetry of the loop: ring buffer, writer thread, file formats, live viewers, loading.

May import ``records`` and ``realtime.system``.
"""
