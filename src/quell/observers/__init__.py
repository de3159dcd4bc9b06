"""Extended state observers: estimates of the plant's state and of the total disturbance.

May import ``lti`` and what stands before it. ``eso.py`` has the class, ``forms.py``
parameters and kernels of each kind of observer, ``design.py`` the poles and gains; likewise
``multivariable.py``, ``multivariable_forms.py`` and ``gains.py`` for several outputs.
"""

from quell.lazy import public_names
from quell.lti.canonical import Canonical, canonical
from quell.observers.design import continuous_gain
from quell.observers.eso import ESO
from quell.observers.multivariable import Estimator, MultivariableESO

__all__ = ["ESO", "Canonical", "Estimator", "MultivariableESO", "canonical", "continuous_gain"]

__dir__ = public_names(__name__)
