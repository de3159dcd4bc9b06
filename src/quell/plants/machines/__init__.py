"""Machines with models of their own: inertias in a chain, the torsional testbed, a motor.

May import ``lti``, ``kernels`` and what stands before them, and the files of ``plants`` for linear
plants, delays and encoders.
"""
