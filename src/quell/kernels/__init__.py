"""Compilation by Numba: generic functions over NamedTuples, disk cache, user-defined functions.

May import ``types`` only. Kernels of all other folders use it.
"""
