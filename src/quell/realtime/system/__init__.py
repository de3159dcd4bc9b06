"""Operating system: clocks, scheduling, signals, atomic words, and histograms of durations.

May import ``kernels`` and ``checks`` only.
"""
