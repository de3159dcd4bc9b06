"""Services of the operating system: clocks, scheduling, signals, atomic words, histograms of durations.

May import ``kernels`` and ``checks`` only.
"""
