"""Results of a tuning: designs with their measures, text, figures, setup files, checks.

May import ``tuning.optimiser`` and what stands before it.
"""
