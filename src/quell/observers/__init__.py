"""Extended state observers: estimates of the plant's state and of the total disturbance.

May import ``lti`` and what stands before it. ``eso.py`` has the class, ``forms.py``
parameters and kernels of each kind of observer, ``design.py`` the poles and gains.
"""

from quell.lti.canonical import Canonical, canonical
from quell.observers.design import continuous_gain
from quell.observers.eso import ESO

__all__ = ["ESO", "Canonical", "canonical", "continuous_gain"]
