"""Learners that are linear regressions on features: NLMS and RLS.

May import ``features`` and the base files of ``learners``.
"""
