"""Kalman filters as learners: linear in the state, with and without sinusoids of unknown frequency.

May import ``features`` and the base files of ``learners``.
"""
