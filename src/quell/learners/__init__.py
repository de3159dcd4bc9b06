"""Learners: feedforward of the disturbance that was learned from the observer's estimates.

Files of this folder itself are the base of its subfolders. May import ``features`` and what it
imports.
"""

from quell.learners.adapters import JaxModel, PythonModel, RiverModel, SklearnModel, TorchModel
from quell.learners.base import Learner, NoLearner
from quell.learners.gradient.batch_gradient import BatchGradient
from quell.learners.kalman.harmonic import Harmonic
from quell.learners.kalman.kalman import Kalman
from quell.learners.online.gaussian_process import GaussianProcess
from quell.learners.online.learner import Online
from quell.learners.online.model import Model, infer, learn
from quell.learners.online.network import MLP
from quell.learners.regression.nlms import NLMS
from quell.learners.regression.rls import RLS
from quell.learners.repetitive.repetitive import Repetitive

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
    "Repetitive",
    "RiverModel",
    "SklearnModel",
    "TorchModel",
    "infer",
    "learn",
]
