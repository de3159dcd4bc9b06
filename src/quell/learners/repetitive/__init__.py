"""The learner of what repeats with a known period, over the phase of the cycle.

May import the base files of ``learners``.
"""
