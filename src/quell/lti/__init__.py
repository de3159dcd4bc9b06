"""Linear time-invariant models: reading, sampling and transforming them.

May import ``types`` and ``checks``.
"""
