"""The trial in loops of all kinds: orders 1 to 4, nonlinear, delayed, under loads of all kinds.

May import ``experiments.stress`` beside it and what that imports.
"""
