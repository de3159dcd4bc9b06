"""The operating system: clock, scheduling, signals, and histograms of times.

May import ``kernels``, ``checks`` and ``types``.
"""
