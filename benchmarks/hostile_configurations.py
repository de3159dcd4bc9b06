"""Controllers and plants for ``hostile_steps.py``: observers, laws, learners, prefilters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import quell as ql
from quell import baselines, features, learners
from quell.controllers import Prefiltered, ReferenceModel, TrackingDifferentiator
from quell.plants import registry

DT, LOW, HIGH = 0.01, -12.0, 15.0
LIMITS = {"u_min": LOW, "u_max": HIGH}

PLANT = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.6]], [0.0, 1.5], [1.0, 0.0])


def observer(order: int = 2, omega_o: float = 20.0, **options: Any) -> ql.ESO:
    """Return a model-free observer."""
    return ql.ESO.model_free(order, 1.5, omega_o, DT, **options)


def adrc(eso: ql.ESO | None = None, omega_c: float = 3.0, **options: Any) -> ql.ADRC:
    """Return an ADRC with limits."""
    return ql.ADRC(observer() if eso is None else eso, omega_c, **(LIMITS | options))


def chain(order: int) -> Any:
    """Return a stable plant of the order, with the gain 1.5."""
    A = np.diag(np.ones(order - 1), 1)
    A[-1] = -np.poly([-1.0] * order)[:0:-1]
    return ql.plants.LinearPlant(A, 1.5 * np.eye(order)[-1], np.eye(order)[0])


def own_channel() -> ql.ESO:
    """Return an observer of a plant where f enters through a channel of its own."""
    A, B, C = [[0.0, 1.0], [-2.0, -0.6]], [0.0, 1.5], [1.0, 0.0]
    return ql.ESO.model_based((A, B, [0.0, 1.0], C), 20.0, DT)


ZERO = ([1.5, 4.5], [1.0, 1.6, 2.6, 2.0])  # a zero at −3 rad/s
WITH_ZERO = registry.PLANTS["linear"](num=ZERO[0], den=ZERO[1])

LEARNERS: dict[str, Callable[[], Any]] = {
    "Kalman": learners.Kalman,
    "Kalman with u": lambda: learners.Kalman(u=True),
    "Harmonic": lambda: learners.Harmonic(count=2),
    "NLMS": learners.NLMS,
    "RLS": learners.RLS,
    "RLS with u": lambda: learners.RLS(
        features.State() + features.Polynomial(3) + features.Bias() + features.Input()
    ),
    "MLP": lambda: learners.MLP(hidden=5),
    "GaussianProcess": lambda: learners.GaussianProcess(budget=15),
    "BatchGradient": learners.BatchGradient,
    "BatchGradient, scaled": lambda: learners.BatchGradient(
        features.State() + features.Bias(), 1e-3
    ),
}
CONTROLLERS: dict[str, tuple[Callable[[], Any], Any]] = {
    "order 1": (lambda: adrc(observer(1)), chain(1)),
    "order 2, no limits": (lambda: ql.ADRC(observer(), 3.0), PLANT),
    "order 2, rate limit": (lambda: adrc(rate_limit=200.0), PLANT),
    "order 3, predictor": (lambda: adrc(observer(3, form="predictor")), chain(3)),
    "order 4, Kalman": (lambda: adrc(observer(4), 2.0, learner=learners.Kalman()), chain(4)),
    "order 8": (lambda: adrc(ql.ESO.model_based(chain(8), 5.0, DT), 1.0), chain(8)),
    "reduced": (lambda: adrc(observer(form="reduced")), PLANT),
    "half gain": (lambda: adrc(observer(half_gain=True), half_gain=True), PLANT),
    "delay, Kalman": (
        lambda: adrc(observer(delay=0.03), learner=learners.Kalman()),
        ql.plants.delayed(PLANT, 0.03, DT),
    ),
    "cascade": (lambda: adrc(ql.ESO.cascade(2, 1.5, 20.0, DT)), PLANT),
    "nonlinear": (lambda: adrc(ql.ESO.nonlinear(2, 1.5, 20.0, DT, delta=0.05)), PLANT),
    "Kalman gains": (
        lambda: adrc(ql.ESO.kalman(2, 1.5, DT, noise_variance=1e-6, drift=1.0)),
        PLANT,
    ),
    "model-based, zero": (lambda: adrc(ql.ESO.model_based(ZERO, 20.0, DT)), WITH_ZERO),
    "own channel for f": (lambda: adrc(own_channel()), PLANT),
    "feedforward": (lambda: adrc(feedforward=True), PLANT),
    "prefiltered": (
        lambda: Prefiltered(adrc(feedforward=True), ReferenceModel(4.0)),
        PLANT,
    ),
    "Han's differentiator": (
        lambda: Prefiltered(adrc(feedforward=True), TrackingDifferentiator(20.0)),
        PLANT,
    ),
    "input shaper": (lambda: Prefiltered(adrc(), baselines.ZVD(3.0, 0.1)), PLANT),
    "PID": (lambda: baselines.PID(8.0, 6.0, 3.0, tf=0.05, dt=DT, **LIMITS), PLANT),
    "LQG": (lambda: baselines.LQG(PLANT, 3.0, 12.0, DT, **LIMITS), PLANT),
} | {
    name: (lambda make=make: adrc(learner=make()), PLANT)  # type: ignore[misc]
    for name, make in LEARNERS.items()
}


def configurations() -> dict[str, tuple[Callable[[], Any], Any]]:
    """Return all configurations, those with a learner also with a guard."""
    found = dict(CONTROLLERS)
    for name, (make, plant) in CONTROLLERS.items():
        if not isinstance(getattr(make(), "learner", None), learners.base.NoLearner | None):
            found[f"{name}, guarded"] = (lambda make=make: guarded(make()), plant)
    return found


def guarded(controller: ql.ADRC) -> ql.ADRC:
    """Return the same controller with a guard."""
    limits = controller.limits
    return ql.ADRC(
        controller.observer,
        controller.omega_c,
        learner=controller.learner,
        guard=ql.Guard(),
        u_min=limits.low,
        u_max=limits.high,
    )
