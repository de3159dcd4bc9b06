"""The optimiser of linear loops: exact responses, constraints, objectives, search.

May import ``tuning.constraints``, ``tuning.structures`` and what they import.
"""
