"""Results of runs: recorded samples, trajectories, metrics and their plots.

May import ``types``, ``checks``, ``files``, and ``guard`` for its reasons.
"""
