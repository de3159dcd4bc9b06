"""An example of everything there is.

Learners are found in ``quell.learners`` and plants in their registry; both are made with their
defaults. What needs arguments has an example here; a test fails for a plant without one.
"""

from __future__ import annotations

import inspect
import math
from collections import ChainMap
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import quell as ql
from quell import learners as learner_room
from quell.features import RBF, Bias, Input, Periodic, Polynomial, RandomFourier, State
from quell.learners.online import infer, learn
from quell.observers.design import FORMS
from quell.observers.eso import ESO
from quell.plants import registry

from .python_models import python_learners

_LAG = ql.plants.LinearPlant([[-1.0]], [1.5], [1.0])
_ARGUMENTS: dict[str, dict[str, Any]] = {
    "linear": {"num": [1.5], "den": [1.0, 1.0]},
    "delayed": {"plant": _LAG, "delay": 0.02, "dt": 0.01},
    "encoded": {"plant": _LAG, "counts": 16_000},
    "lagged": {"plant": _LAG, "lag": 0.02},
    "n-mass": {"inertias": [1.0, 0.5, 2.0], "stiffnesses": [3.0, 2.0], "sensor": 3},
}


def _swing(
    t: float, x: Any, u: float, w: Any, m: float, friction: Any, length: float = 0.5
) -> tuple[float, float]:
    return x[1], (u + w[0]) / (m * length) - math.sin(x[0]) - friction[1] * x[1] - friction[0]


def _mixed(x: Any, gain: float, rows: Any) -> float:
    value: float = gain * x[0] + rows[1, 0] * x[1] + rows[0, 2]
    return value


FROM_FILES = ("fmu", "identified", "python")
PLANTS: dict[str, Any] = {
    name: make(**_ARGUMENTS.get(name, {}))
    for name, make in registry.PLANTS.items()
    if name not in FROM_FILES
} | {
    "delayed, by part of a sample": ql.plants.delayed(_LAG, delay=0.0125, dt=0.01),
    "lagged, not linear": ql.plants.lagged(ql.plants.torsional(late=2), lag=0.003),
    "torsional, late": ql.plants.torsional(late=2),
    "torsional, not rounded": ql.plants.torsional(dac_bits=None, counts=None),
    "n-mass, play": ql.plants.n_mass(
        [1.0, 0.5, 2.0], [3.0, 2.0], [0.01, 0.02], play=[0.1, 0.0], loads=[1, 3]
    ),
    "CubicSpringPlant": ql.plants.lagged_two_mass_spring(k_cubic=0.3),
    "LinearPlant": ql.plants.LinearPlant(
        [[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0], [[0.0, 1.0], [1.0, 0.0]]
    ),
    "NonlinearPlant": ql.plants.NonlinearPlant(
        lambda t, x, u, w: (x[1], u + w[0] - math.sin(x[0]) - 0.1 * x[1]), order=2
    ),
    "NonlinearPlant, parameters": ql.plants.NonlinearPlant(
        _swing,
        2,
        _mixed,
        parameters={
            "m": 2.0,
            "gain": 1.5,
            "friction": [0.0, 0.1],
            "rows": [[0.0, 3.0, 0.0], [0.02, 1.0, 2.0]],
        },
    ),
}
CHAIN = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])


class OwnDesign(NamedTuple):
    """Parameters of a model from outside of the package."""

    size: int
    gain: float


class OwnMemory(NamedTuple):
    """Its state."""

    weights: Any
    last: Any


class OwnModel:
    """A model as a user would write it: a leaky normalised gradient step."""

    def design(self, features: int, dt: float) -> OwnDesign:
        """Return the parameters."""
        return OwnDesign(features, dt)

    def memory(self, parameters: OwnDesign) -> OwnMemory:
        """Return the state."""
        return OwnMemory(np.zeros(parameters.size), np.zeros((1, 2)))


@infer.register(OwnDesign)
def _infer(model: OwnDesign, memory: OwnMemory, features: Any) -> float:
    total = 0.0
    for i in range(model.size):
        total += memory.weights[i] * features[i]
    return total


@learn.register(OwnDesign)
def _learn(model: OwnDesign, memory: OwnMemory, features: Any, target: float) -> None:
    error, power = target - infer(model, memory, features), 1.0
    for i in range(model.size):
        power += features[i] * features[i]
    for i in range(model.size):
        memory.weights[i] += model.gain * (error * features[i] / power - 1e-3 * memory.weights[i])
    memory.last[0, 0] = error


PYTHON_LEARNERS = python_learners()
_NEED_A_MODEL = ("JaxModel", "Online", "PythonModel", "RiverModel", "SklearnModel", "TorchModel")
# Their order is that of the second part, and then of the first.
LEARNERS: ChainMap[str, Any] = ChainMap(
    PYTHON_LEARNERS,
    {
        name: getattr(learner_room, name)()
        for name in learner_room.__all__
        if inspect.isclass(getattr(learner_room, name))
        and not getattr(getattr(learner_room, name), "_is_protocol", False)
        and name not in _NEED_A_MODEL
    }
    | {
        "Kalman with u": ql.learners.Kalman(u=True),
        "Harmonic with search": ql.learners.Harmonic(count=2, orders=(1, 3), search=True),
        "a model of one's own": ql.learners.Online(OwnModel(), State() + Input()),
        "RLS with u": ql.learners.RLS(State() + Polynomial() + Bias() + Input()),
        "RLS on the strongest": ql.learners.RLS(
            State() + RBF(8) + Periodic(highest=4) + Bias(), strongest=9
        ),
        "RLS with a map": ql.learners.RLS(Periodic(orders=(1, 3)) + Bias(), recall=True),
        "NLMS on random features": ql.learners.NLMS(features=RandomFourier(20)),
        "gradient on radial features": ql.learners.BatchGradient(
            features=RBF(16, states=(1,)) + Bias()
        ),
    },
)

OBSERVERS: dict[str, ESO] = {
    f"{kind}, order {order}, {form}": (
        ESO.model_free(order=order, b0=1.5, omega_o=12.0, dt=0.01, form=form)
        if kind == "model-free"
        else ESO.model_based(
            ([2.0, 0.3, 1.0, 0.5, 0.2, 0.1, 0.3, 0.4][:order], 1.5),
            omega_o=12.0,
            dt=0.01,
            form=form,
        )
    )
    for kind in ("model-free", "model-based")
    for order in (1, 2, 4, 8)
    for form in FORMS
} | {
    "model-based, order 3, with a zero": ESO.model_based(
        ([1.5, 6.0], [1.0, 0.5, 2.0, 1.0]), omega_o=12.0, dt=0.01
    ),
    "half gain": ESO.model_free(2, 1.5, 12.0, 0.01, half_gain=True),
    "Kalman": ESO.kalman(2, 1.5, 0.01, noise_variance=1e-6, drift=3e-2),
    "cascade": ESO.cascade(2, 1.5, 12.0, 0.01),
    "nonlinear": ESO.nonlinear(2, 1.5, 12.0, 0.01, delta=0.05),
    "delay": ESO.model_free(2, 1.5, 12.0, 0.01, delay=0.02),
}


def extended(m: int) -> dict[str, ESO]:
    """Every form with m extended states; a test finds a form without an example."""
    chain, more = partial(ESO.model_free, 2, 1.5, 12.0, 0.01), {"disturbance_order": m}
    plant = ([2.0, 0.3, 1.0, 0.5], 1.5)
    zero = ([1.5, 6.0], [1.0, 0.5, 2.0, 1.0])
    drift = 3e-2 * 12.0 ** (2 * m - 2)
    return {f"{name}, m = {m}": observer for name, observer in {
        **{f"model_free, form={form}": chain(form=form, **more) for form in FORMS},
        "model_free, half_gain": chain(half_gain=True, **more),
        "model_free, delay": chain(delay=0.02, **more),
        "model_free, poles": chain(poles=[(-0.8, 0.6), *[-1.0] * m], **more),
        **{
            f"model_based, form={form}": ESO.model_based(plant, 12.0, 0.01, form=form, **more)
            for form in FORMS
        },
        "model_based": ESO.model_based(zero, 12.0, 0.01, **more),
        "model_based, keep_zeros": ESO.model_based(zero, 12.0, 0.01, keep_zeros=True, **more),
        "cascade": ESO.cascade(2, 1.5, 12.0, 0.01, **more),
        "nonlinear": ESO.nonlinear(2, 1.5, 12.0, 0.01, delta=0.05, **more),
        "kalman": ESO.kalman(2, 1.5, 0.01, noise_variance=1e-6, drift=drift, **more),
    }.items()}  # fmt: skip


EXTENDED = extended(2) | extended(3)
OBSERVERS |= EXTENDED
