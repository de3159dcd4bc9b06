"""The search for the model that fits best: starts, refinement, delay, orders, closed loop.

May import ``identification.experiment``, ``identification.model`` and what they import.
"""
