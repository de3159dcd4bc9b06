"""Compilation: generic functions over NamedTuples, compiled by Numba and interpreted alike.

May import nothing else of quell. Kernels of other folders use it.
"""
