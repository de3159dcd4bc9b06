"""The batch gradient learner of the paper (Algorithm 1).

May import ``features`` and the base files of ``learners``.
"""
