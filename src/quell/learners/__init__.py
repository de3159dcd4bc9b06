"""Learners: what feeds forward the disturbance that has been seen before."""

from quell.learners.base import Learner, NoLearner
from quell.learners.gradient import BatchGradient
from quell.learners.kalman import Kalman
from quell.learners.model import Model, infer, learn
from quell.learners.nlms import NLMS
from quell.learners.online import Online
from quell.learners.rls import RLS

__all__ = ["NLMS", "RLS", "BatchGradient", "Kalman", "Learner", "Model", "NoLearner", "Online", "infer", "learn"]
