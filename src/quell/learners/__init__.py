"""Learners: what feeds forward the disturbance that has been seen before."""

from quell.learners.base import Learner, NoLearner
from quell.learners.gradient import BatchGradient
from quell.learners.kalman import Kalman

__all__ = ["BatchGradient", "Kalman", "Learner", "NoLearner"]
