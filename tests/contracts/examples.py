"""An example of everything there is.

Learners are found in ``quell.learners`` and made with their defaults. Plants need arguments, so their examples stand here; a test
fails for a plant without one.
"""

from __future__ import annotations

import inspect
import math
from typing import Any

import quell as ql
from quell import learners as learner_room
from quell.observers.eso import ESO, FORMS

from .python_models import python_learners

PLANTS: dict[str, Any] = {
    "two_mass_spring": ql.plants.two_mass_spring(),
    "LinearPlant": ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0], [[0.0, 1.0], [1.0, 0.0]]),
    "NonlinearPlant": ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u + w[0] - math.sin(x[0]) - 0.1 * x[1]), order=2),
}
CHAIN = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])

PYTHON_LEARNERS = python_learners()
_NEED_A_MODEL = ("JaxModel", "Online", "PythonModel", "RiverModel", "SklearnModel", "TorchModel")
LEARNERS: dict[str, Any] = (
    {
        name: getattr(learner_room, name)()
        for name in learner_room.__all__
        if name not in _NEED_A_MODEL
        and inspect.isclass(getattr(learner_room, name))
        and not getattr(getattr(learner_room, name), "_is_protocol", False)
    }
    | {"Kalman with u": ql.learners.Kalman(u=True)}
    | PYTHON_LEARNERS
)

OBSERVERS: dict[str, ESO] = {
    f"{kind}, order {order}, {form}": (
        ESO.model_free(order=order, b0=1.5, omega_o=12.0, dt=0.01, form=form)
        if kind == "model-free"
        else ESO.model_based(([2.0, 0.3, 1.0, 0.5, 0.2, 0.1, 0.3, 0.4][:order], 1.5), omega_o=12.0, dt=0.01, form=form)
    )
    for kind in ("model-free", "model-based")
    for order in (1, 2, 4, 8)
    for form in FORMS
}
