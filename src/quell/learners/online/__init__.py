"""Learners made of a model that learns in each sample: network, Gaussian process, a user's own.

May import ``features`` and the base files of ``learners``.
"""
