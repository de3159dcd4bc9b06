"""Learners whose model is a Python object, of any library or of none.

May import ``online``, ``features`` and the base files of ``learners``. The libraries themselves are
imported when a learner is made.
"""

from quell.learners.adapters.jax import JaxModel
from quell.learners.adapters.python import PythonModel
from quell.learners.adapters.river import RiverModel
from quell.learners.adapters.sklearn import SklearnModel
from quell.learners.adapters.torch import TorchModel

__all__ = ["JaxModel", "PythonModel", "RiverModel", "SklearnModel", "TorchModel"]
