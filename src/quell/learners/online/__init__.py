"""Learners made of a model that predicts and learns sample by sample: networks, Gaussian processes, a user's own.

May import ``features`` and the base files of ``learners``.
"""
