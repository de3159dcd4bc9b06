"""Learners: what feeds forward the disturbance that has been seen before."""

from quell.learners.adapters import JaxModel, PythonModel, RiverModel, SklearnModel, TorchModel
from quell.learners.base import Learner, NoLearner
from quell.learners.gradient import BatchGradient
from quell.learners.harmonic import Harmonic
from quell.learners.kalman import Kalman
from quell.learners.model import Model, infer, learn
from quell.learners.network import MLP
from quell.learners.nlms import NLMS
from quell.learners.online import Online
from quell.learners.process import GaussianProcess
from quell.learners.rls import RLS

__all__ = [
    "MLP",
    "NLMS",
    "RLS",
    "BatchGradient",
    "GaussianProcess",
    "Harmonic",
    "JaxModel",
    "Kalman",
    "Learner",
    "Model",
    "NoLearner",
    "Online",
    "PythonModel",
    "RiverModel",
    "SklearnModel",
    "TorchModel",
    "infer",
    "learn",
]
