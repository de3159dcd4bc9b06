"""Learners: feedforward of the disturbance that was learned from the observer's estimates.

Files of this folder itself are the base of its subfolders. May import ``features`` and what it
imports.
"""

from quell.lazy import imported_on_use, public_names
from quell.learners.adapters import JaxModel, PythonModel, RiverModel, SklearnModel, TorchModel
from quell.learners.base import Learner, NoLearner
from quell.learners.batch_gradient import BatchGradient
from quell.learners.gaussian_process import GaussianProcess
from quell.learners.kalman import Harmonic, Kalman
from quell.learners.online import MLP, Model, Online, infer, learn
from quell.learners.regression import NLMS
from quell.learners.repetitive import Repetitive
from quell.learners.rls import RLS

__all__ = [
    "MLP", "NLMS", "RLS", "BatchGradient", "GaussianProcess", "Harmonic", "JaxModel", "Kalman",
    "Learner", "Model", "NoLearner", "Online", "PythonModel", "Repetitive", "RiverModel",
    "SklearnModel", "TorchModel", "infer", "learn"
]  # fmt: skip

__getattr__ = imported_on_use(__name__, {})

__dir__ = public_names(__name__)
