"""The other end of a wire: a simulated plant in a process of its own, and injected faults.

May import ``realtime.wire``, ``realtime.system``, ``realtime.telemetry`` and ``plants``.
"""
