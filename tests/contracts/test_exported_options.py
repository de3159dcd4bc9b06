"""Every option of all parts of a controller is exported to C, and the C code repeats the kernels.

``PARTS`` has each learner, feature, observer, law, baseline and prefilter with another value for
each of its options. A test fails for a part or an option without one. What only changes numbers is
known by the form of parameters and state, from which the translator makes the code; every other
value is a program of its own, which is compiled and compared with the interpreted kernels.
"""

from __future__ import annotations

import functools
import inspect
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell import controllers as room
from quell import features as feature_room
from quell import learners as learner_room
from quell.controllers import baselines as baseline_room
from quell.export import TranslationError
from quell.export.controller_source import parameters_of
from quell.features import RBF, Bias, Input, Periodic, State
from quell.kernels.sized import constant_fields
from quell.kernels.user_functions import origin_of
from quell.observers.design import FORMS
from tests import gain_functions
from tests.cases import cases
from tests.in_c import built, needs_gcc

from .examples import OwnModel
from .python_models import python_learners

DT = 0.01
LIMITS = {"u_min": -2.0, "u_max": 3.0}
OBSERVER = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=DT)
PID = baseline_room.PID(4.0, 2.0, 1.0, tf=0.05, dt=DT, **LIMITS)
PLANT = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])
NOTCH = baseline_room.Notch.at(9.0)


class Part(NamedTuple):
    """How a part is made, where it is used, what it needs, and another value for each option.

    A value may be a ``With``, for an option that needs others.
    """

    make: Callable[..., Any]
    use: Callable[[Any], Any]
    needs: dict[str, Any]
    options: dict[str, Any]


class With(NamedTuple):
    """A value of an option, and those of others without which it is refused."""

    value: Any
    others: dict[str, Any]


class Several(NamedTuple):
    """Values of an option, each of which is a row."""

    values: tuple[Any, ...]


def _learning(learner: Any) -> Any:
    return ql.ADRC(OBSERVER, 1.5, learner=learner, guard=ql.Guard(), **LIMITS)


def _with_features(features: Any) -> Any:
    return _learning(ql.learners.RLS(features + Bias()))


def _observing(observer: Any) -> Any:
    return ql.ADRC(observer, 1.5, **LIMITS)


def _shaped(prefilter: Any) -> Any:
    return room.Prefiltered(ql.ADRC(OBSERVER, 1.5, feedforward=True, **LIMITS), prefilter)


def _fed(feedforward: Any) -> Any:
    return ql.ADRC(OBSERVER, 1.5, feedforward=feedforward, **LIMITS)


def _itself(controller: Any) -> Any:
    return controller


def _products(x: Any, u: float) -> tuple[float, float]:
    return x[0] * x[1], u * x[1]


def _squares(x: Any, u: float) -> tuple[float, float]:
    return x[0] * x[0], u * u


def _axis(order: int = 2, **parts: Any) -> Any:
    return ql.ADRC(ql.ESO.model_free(order=order, b0=1.0, omega_o=12.0, dt=DT), 1.5, **parts)


_OF_ALL = ql.learners.RLS(feature_room.AllAxes(State()) + feature_room.Bias())


def _fed_back(observer: Any) -> Any:
    gain = room.state_feedback(observer.A, observer.B, 1.5, observer.dt)
    return room.StateFeedback(observer, gain, controlled=_LOAD, **LIMITS)


_LOAD = [[0.0, 0.0, 1.0, 0.0]]
_COUPLED: dict[str, Any] = {
    "A": [[0, 1, 0, 0], [-5, -0.1, 5, 0.1], [0, 0, 0, 1], [5, 0.1, -5, -0.1]], "B": [0, 1.5, 0, 0],
    "C": [[1, 0, 0, 0], [0, 0, 1, 0]], "E": [0, 0, 0, 1.0], "dt": DT, "noise_variance": [1e-6, 1e-6],
    "drift": [1.0],
}  # fmt: skip
_BY_POLES = {**_COUPLED, "noise_variance": None, "drift": None, "omega_o": 12.0}
_WIDE = [[1.0, 0.3, 0.2], [0.2, 1.0, -0.3]]
_RANGE: dict[str, Any] = {"u_min": -1.0, "u_max": 1.0, "rate_limit": Several((60.0, (-40.0, 60.0)))}
_SCALED = {"frequency": 2.0, "scale": (1.0, 2.0, 5.0, 3.0), "bias_bandwidth": 0.2}
_FEATURES = {"features": State() + Input()}
_LINEAR = {
    "state": False, "bias": False, "u": True, "bias_bandwidth": 0.2,
    "state_bandwidth": Several((0.1, (0.1, 0.2))), "frequency": 2.0, "prior": 5.0,
    "gain_interval": With((0.7, 1.4), {"u": True}),
}  # fmt: skip
_TABLE = ql.Schedule((0.0, 0.5), "y", (0.8, 2.0))
_ESO = {"order": 2, "b0": 1.5, "omega_o": 12.0, "dt": DT}
_EXTENDED = {"disturbance_order": Several((2, 3))}
_ORDERS = {
    "order": Several((1, 3, 8)),
    "b0": 2.0,
    "omega_o": 10.0,
    "dt": 0.02,
    "delay": 0.02,
    **_EXTENDED,
}
_FREQUENCIES = {"frequencies": Several(((2.0,), (2.0, 5.0)))}
PARTS: dict[str, Part] = {
    # Learners.
    "Kalman": Part(ql.learners.Kalman, _learning, {}, _LINEAR),
    "Harmonic": Part(ql.learners.Harmonic, _learning, {}, {
        **_LINEAR, "count": Several((2, 3)), "omegas": (1.0,), "limits": (0.5, 6.0), "pair_bandwidth": 0.1,
        "orders": Several(((1, 3), (2,))), "search": Several((True, With(True, {"count": 2, "orders": (1, 3), "bias": False}))),
    }),
    "RLS": Part(ql.learners.RLS, _learning, {}, {
        "features": Several((State() + Bias(), State() + Input(), RBF(4), Periodic())), "memory_time": 20.0, "prior": 5.0, "strongest": With(3, {"features": State() + RBF(4) + Bias()}),
        "relearn": 5.0, "recall": With(True, {"features": Periodic(orders=(1, 2)) + Bias()}), **_SCALED, "gain_interval": With((0.7, 1.4), {"features": State() + Input()}),
    }),
    "NLMS": Part(ql.learners.NLMS, _learning, {}, {
        **_FEATURES, "rate": 0.1, "regularisation": 0.02, **_SCALED, "gain_interval": With((0.7, 1.4), {"features": State() + Input()}),
    }),
    "BatchGradient": Part(ql.learners.BatchGradient, _learning, {}, {**_FEATURES, "rate": 1e-5, "batch": 3, "u": False}),
    "MLP": Part(ql.learners.MLP, _learning, {"hidden": 3}, {
        **_FEATURES, "hidden": 2, "memory_time": 20.0, "every": 2, "noise": 0.2, "seed": 1, **_SCALED,
    }),
    "GaussianProcess": Part(ql.learners.GaussianProcess, _learning, {"budget": 5}, {
        **_FEATURES, "budget": 4, "length": 0.7, "memory_time": 20.0, "every": 1, "noise": 0.2, "novelty": 0.1, **_SCALED,
    }),
    "Repetitive": Part(ql.learners.Repetitive, _learning, {}, {"period": 0.5, "gain": 0.4}),
    "Online": Part(ql.learners.Online, _learning, {"model": OwnModel()}, {"model": OwnModel(), **_FEATURES, **_SCALED}),
    "NoLearner": Part(ql.learners.NoLearner, lambda learner: ql.ADRC(OBSERVER, 1.5, learner=learner, **LIMITS), {}, {}),
    "Guard": Part(ql.Guard, lambda guard: ql.ADRC(OBSERVER, 1.5, learner=ql.learners.Kalman(), guard=guard, **LIMITS), {}, {
        "bound": 2.0, "time": 5.0, "certified_for": PLANT, "every": Several((2, None)),
    }),
    # Features.
    "State": Part(feature_room.State, _with_features, {}, {"count": 1}),
    "Input": Part(feature_room.Input, lambda u: _learning(ql.learners.RLS(State() + u)), {}, {}),
    "Bias": Part(feature_room.Bias, lambda bias: _learning(ql.learners.RLS(State() + bias)), {}, {}),
    "RBF": Part(RBF, _with_features, {}, {
        "count": 4, "width": 0.4, "states": Several(((1,), (2,), (1, 2))), "centers": Several(([[0.0, 0.0], [0.5, -0.5]],)),
    }),
    "RandomFourier": Part(feature_room.RandomFourier, _with_features, {"count": 6}, {"count": 4, "length": 0.5, "seed": 1, "states": (2,)}),
    "Periodic": Part(Periodic, _with_features, {}, {
        "period": 2.0, "orders": Several(((1, 3), (2,))), "highest": 3, "state": 2,
    }),
    "Polynomial": Part(feature_room.Polynomial, _with_features, {}, {"degree": Several((2, 4)), "states": (2,)}),
    "Friction": Part(feature_room.Friction, _with_features, {}, {
        "width": 0.1, "sign": True, "states": Several(((1,), (1, 2))), "speed": 0.5,
    }),
    "Custom": Part(feature_room.Custom, _with_features, {"function": _products, "names": ("a", "b")}, {
        "function": _squares, "names": ("c", "d"),
    }),
    "AllAxes": Part(feature_room.AllAxes, lambda block: ql.Axes([_axis(), _axis()], learner=ql.learners.RLS(block + feature_room.Bias()), **LIMITS), {"features": State()}, {
        "features": feature_room.Polynomial(2), "inputs": True,
    }),
    # Observers.
    "ESO.model_free": Part(ql.ESO.model_free, _observing, _ESO, {
        **_ORDERS, **_FREQUENCIES, "form": Several(FORMS), "half_gain": True, "poles": Several(([-1.0, -1.2, -1.5], [-1.0, (-1.5, 0.8)])),
    }),
    "ESO.model_based": Part(ql.ESO.model_based, _observing, {"plant": ([2.0, 0.3], 1.5), "omega_o": 12.0, "dt": DT}, {
        "plant": Several((PLANT, ([1.0, 2.0, 0.5], 1.5), ([1.5, 6.0], [1.0, 0.5, 2.0, 1.0]))), "omega_o": 10.0, "dt": 0.02, "b0": 2.0,
        "E": With([0.0, 1.0], {"plant": PLANT}), "form": Several(FORMS), "keep_zeros": With(True, {"plant": ([1.5, 6.0], [1.0, 0.5, 2.0, 1.0])}),
        "half_gain": True, "delay": 0.02, **_EXTENDED, **_FREQUENCIES, "poles": Several(([-1.0, -1.2, -1.5],)), "far": With(2.0, {"plant": ([1.5, 60.0], [1.0, 0.5, 2.0, 1.0])}),
    }),
    "ESO.kalman": Part(ql.ESO.kalman, _observing, {"order": 2, "b0": 1.5, "dt": DT, "noise_variance": 1e-6, "drift": 0.03}, {
        "order": Several((1, 3)), "b0": 2.0, "dt": 0.02, "noise_variance": 1e-5, "drift": 0.1, "jitter": 0.1, "form": Several(FORMS[:2]), "delay": 0.02, **_EXTENDED,
    }),
    "ESO.cascade": Part(ql.ESO.cascade, _observing, _ESO, {**_ORDERS, "order": Several((1, 3)), "levels": 3, "ratio": 3.0}),
    "ESO.nonlinear": Part(ql.ESO.nonlinear, _observing, {**_ESO, "delta": 0.05}, {
        **_ORDERS, "order": Several((1, 3)), "delta": 0.1, "alpha": Several(((1.0, 0.7, 0.4),)),
    }),
    # Laws.
    "ADRC": Part(ql.ADRC, _itself, {"observer": OBSERVER, "omega_c": 1.5, **LIMITS}, {
        "observer": ql.ESO.model_free(order=3, b0=1.5, omega_o=12.0, dt=DT), "omega_c": 2.0, "learner": ql.learners.Kalman(),
        "guard": With(ql.Guard(), {"learner": ql.learners.Kalman()}), "feedforward": Several((True, ql.Feedforward((0.3, 0.1, 0.7)))),
        **_RANGE, "safe_set": ql.SafeSet(-0.9, 0.9, alpha=4.0), "held": ql.HeldPlant(),
        "schedule": Several((
            _TABLE, ql.OnlineGain(0.8, 3.0, bandwidth=30.0), With(_TABLE, {"learner": ql.learners.Kalman(u=True), "guard": ql.Guard()}),
            With(_TABLE, {"learner": ql.learners.BatchGradient(), "observer": ql.ESO.model_free(2, 1.5, 12.0, DT, delay=DT)}),
            With(_TABLE, {"safe_set": ql.SafeSet(-0.9, 0.9, alpha=4.0), "held": ql.HeldPlant()}), With(_TABLE, {"feedforward": ql.Feedforward.rigid(0.7, coulomb=0.1)}),
        )), "half_gain": True, "feedback": room.NonlinearFeedback((0.75, 1.25), 0.05), "law_poles": [-1.0, -2.0],
    }),
    "Compensator": Part(ql.Compensator, _itself, {"observer": OBSERVER, **LIMITS}, {
        "observer": Several((ql.ESO.model_free(order=3, b0=1.5, omega_o=12.0, dt=DT), ql.ESO.model_based(([2.0, 0.3], 1.5), 12.0, DT))),
        "omega_c": With(2.0, {"learner": ql.learners.Kalman()}), "learner": With(ql.learners.Kalman(), {"omega_c": 1.5}),
        "guard": With(ql.Guard(), {"learner": ql.learners.Kalman(), "omega_c": 1.5}), **_RANGE, "safe_set": ql.SafeSet(-0.9, 0.9, alpha=4.0), "held": ql.HeldPlant(),
        "schedule": Several((_TABLE, With(_TABLE, {"learner": ql.learners.Kalman(u=True), "omega_c": 1.5}))),
    }),
    "Compensated": Part(room.Compensated, _itself, {"controller": PID, "compensator": ql.Compensator(OBSERVER, **LIMITS)}, {
        "controller": baseline_room.LQG(PLANT, omega_c=3.0, omega_o=12.0, dt=DT),
        "compensator": ql.Compensator(OBSERVER, omega_c=1.5, learner=ql.learners.Kalman(), guard=ql.Guard(), **LIMITS),
    }),
    "Axes": Part(ql.Axes, _itself, {"axes": [_axis(), _axis()], "u_min": -2.0, "u_max": 3.0}, {
        "axes": Several(({"x": _axis(), "tool": _axis(3)}, [_axis(), _axis(learner=ql.learners.RLS(), guard=ql.Guard())], [_axis(safe_set=ql.SafeSet(-0.9, 0.9, alpha=4.0)), _axis()])),
        "B0": Several(([[1.0, 0.3], [0.2, 1.0]], gain_functions.nested_tuples)), "M": Several(([[1.0, 0.3], [0.3, 1.0]], gain_functions.array)),
        "u_min": (-1.0, -2.0), "u_max": (1.0, 2.0), "rate_limit": Several((60.0, [60.0, (-40.0, 60.0)])), "saturation": Several(("direction", [1, 0])),
        "weights": With([1.0, 2.0, 1.0], {"B0": _WIDE}), "wished": With([0.1, 0.0, -0.1], {"B0": _WIDE}),
        "drives": With([baseline_room.PID(4.0, 2.0, 1.0, tf=0.05, dt=DT), baseline_room.PPI(3.0, 2.0, 0.5, dt=DT)], {"axes": [ql.Compensator(_axis().observer)] * 2}),
        "learner": Several((_OF_ALL, [_OF_ALL, None], ql.learners.NLMS(_OF_ALL.features))), "guard": With(ql.Guard(), {"learner": _OF_ALL}),
    }),
    "SafeSet": Part(ql.SafeSet, lambda safe: ql.ADRC(OBSERVER, 1.5, safe_set=safe, **(LIMITS if safe.largest_u == np.inf else {})), {"y_max": 0.9}, {
        "y_min": -0.9, "y_max": 0.5, "rate_min": -2.0, "rate_max": 2.0, "alpha": 5.0, "f_rate": 0.1, "noise": 1e-5, "gain_error": 0.1, "largest_u": With(2.0, {"gain_error": 0.1}),
    }),
    "HeldPlant": Part(ql.HeldPlant, lambda held: ql.ADRC(OBSERVER, 1.5, held=held, **LIMITS), {}, {"noise": 1e-5}),
    "Schedule": Part(ql.Schedule, lambda schedule: ql.ADRC(OBSERVER, 1.5, schedule=schedule, **LIMITS), {"points": (-0.5, 0.5), "signal": "reference", "b0": (0.8, 2.0)}, {
        "points": (-0.3, 0.2), "signal": Several(("y", "speed", "external")), "b0": (1.0, 3.0),
        "omega_c": (1.0, 2.0), "omega_o": (9.0, 15.0),
    }),
    "OnlineGain": Part(ql.OnlineGain, lambda online: ql.ADRC(OBSERVER, 1.5, schedule=online, **LIMITS), {"low": 0.8, "high": 3.0, "bandwidth": 30.0}, {
        "low": 1.0, "high": 2.0, "memory_time": 20.0, "tolerance": 0.2, "bandwidth": 20.0,
    }),
    "NonlinearFeedback": Part(room.NonlinearFeedback, lambda law: ql.ADRC(OBSERVER, 1.5, feedback=law, **LIMITS), {"alpha": (0.75, 1.25), "delta": 0.05}, {
        "alpha": Several(((0.5, 1.0),)), "delta": Several(((0.05, 0.1),)),
    }),
    "Feedforward": Part(ql.Feedforward, _fed, {"coefficients": (0.3, 0.1, 0.7)}, {
        "coefficients": Several(((0.3,), (0.0, 0.1), (0.3, 0.1, 0.7, 0.2))), "coulomb": 0.2, "coulomb_speed": With(0.5, {"coulomb": 0.2}),
        "constant": -0.1, "delay": 0.03, "derivatives": Several((1, 4)), "numerator": Several(((1.0, 0.2, 0.05),)),
    }),
    "Feedforward.rigid": Part(ql.Feedforward.rigid, _fed, {"inertia": 0.7}, {
        "inertia": 0.5, "viscous": 0.1, "coulomb": 0.2, "coulomb_speed": With(0.5, {"coulomb": 0.2}), "constant": -0.1, "delay": 0.03, "derivatives": 2,
    }),
    "Feedforward.of": Part(ql.Feedforward.of, _fed, {"plant": PLANT}, {
        "plant": ql.plants.LinearPlant([[-1.0]], [1.5], [1.0]), "terms": 1, "coulomb": 0.2, "coulomb_speed": With(0.5, {"coulomb": 0.2}),
        "constant": -0.1, "delay": 0.03, "derivatives": 2, "flat": With(True, {"plant": ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -1.0]], [0.5, 1.0], [1.0, 0.0])}),
    }),
    "LinearController": Part(room.LinearController, _itself, {"law": PID.law, "dt": DT, **LIMITS}, {
        "law": baseline_room.PID(4.0, dt=DT).law, "dt": 0.02, **_RANGE, "name": "law",
    }),
    "LinearController.from_transfer_function": Part(room.LinearController.from_transfer_function, _itself, {"num": [2.0, 3.0], "den": [1.0, 0.0], "dt": DT, **LIMITS}, {
        "num": Several(([2.0],)), "den": Several(([1.0, 2.0, 0.0],)), "dt": 0.02, "feedback": "output", "method": "zoh", "prewarp": 2.0,
        "tracking_time": 0.3, **_RANGE, "name": "law",
    }),
    "PID": Part(baseline_room.PID, _itself, {"kp": 4.0, "ki": 2.0, "kd": 1.0, "tf": 0.05, "dt": DT, **LIMITS}, {
        "kp": 2.0, "ki": 0.0, "kd": 0.0, "tf": Several(((0.05, 0.02),)), "b": 0.5, "c": 1.0, "tt": 0.3, "dt": 0.02, "setpoint": Several(([1.0, 2.0, 1.0],)),
        **_RANGE, "name": "axis",
    }),
    "PPI": Part(baseline_room.PPI, _itself, {"kv": 2.0, "kp": 1.5, "tn": 0.8, "dt": DT, **LIMITS}, {
        "kv": 1.0, "kp": 2.0, "tn": 0.5, "dt": 0.02, "tf": 0.05, "notches": Several(((NOTCH,),)), "inertia": 0.5, "viscous": With(0.1, {"inertia": 0.5}),
        **_RANGE, "name": "axis",
    }),
    "NotchPID": Part(baseline_room.NotchPID, _itself, {"notch": NOTCH, "kp": 2.0, "ki": 1.0, "dt": DT, **LIMITS}, {
        "notch": baseline_room.Notch.at(7.0), "kp": 1.0, "ki": 0.0, "kd": With(0.5, {"tf": 0.05}), "dt": 0.02,
    }),
    "LQG": Part(baseline_room.LQG, _itself, {"plant": PLANT, "omega_c": 3.0, "omega_o": 12.0, "dt": DT, **LIMITS}, {
        "plant": ql.plants.LinearPlant([[-1.0]], [1.5], [1.0]), "omega_c": 2.0, "omega_o": 10.0, "dt": 0.02,
        "Q": Several(([[2.0, 0.0], [0.0, 1.0]],)), "rho": 0.5, "process_noise": Several(([[1.0, 0.0], [0.0, 2.0]],)),
    }),
    "AdaptiveNotch": Part(baseline_room.AdaptiveNotch, _itself, {"plant": PLANT, "omega_c": 3.0, "omega_o": 12.0, "dt": DT, **LIMITS}, {
        "plant": ql.plants.LinearPlant([[-1.0]], [1.5], [1.0]), "omega_c": 2.0, "omega_o": 10.0, "dt": 0.02, "bandwidth": 0.3, "count": Several((2, With(0, {"waves": (3.0,)}))),
        "band": (0.5, 6.0), "listening": 2.0, "frequencies": (1.0,), "waves": (5.0,), **_RANGE, "name": "axis",
    }),
    "ResonanceRatio": Part(baseline_room.ResonanceRatio, _itself, {"omega_o": 5.0, "dt": DT, **LIMITS}, {
        "m1": 2.0, "m2": 2.0, "k": 2.0, "omega_o": 6.0, "dt": 0.02, "omega_d": 8.0, "ratio": 2.0, "measured": "motor",
    }),
    "StateFeedback": Part(room.StateFeedback, _itself, {
        "observer": ql.ESO.state_space(**_COUPLED), "gain": [2.0, 1.5, 1.0, 0.5], "controlled": _LOAD, **LIMITS,
    }, {
        "observer": ql.ESO.state_space(**_BY_POLES), "gain": Several(([1.0, 1.0, 0.5, 0.5],)), "controlled": Several(([[1.0, 0.0, 0.0, 0.0]],)),
        "u_min": -1.0, "u_max": 1.0, "rate_limit": Several((60.0, ((-40.0, 60.0),))),
    }),
    "ESO.state_space": Part(ql.ESO.state_space, _fed_back, _COUPLED, {
        "A": Several(([[0, 1, 0, 0], [-3, 0, 3, 0], [0, 0, 0, 1], [3, 0, -3, 0]],)), "B": Several(([[0, 0], [1.5, 0], [0, 0], [0, 1.0]],)),
        "C": Several(([[1, 0, 0, 0], [0, 0, 0, 1]],)), "E": Several(([0, 1.0, 0, 0],)),
        "dt": 0.02, "omega_o": With(10.0, {"noise_variance": None, "drift": None}), "noise_variance": Several(([1e-6, 1e-4],)), "drift": Several(([2.0],)),
        "jitter": Several(([1e-3],)), "D": Several(([[0.0], [0.0]],)), "disturbance_order": Several((2, 3)), "form": "current", "every": Several(((1, 3),)),
        "time_varying": False, "accept_zeros": True,
    }),
    # Prefilters.
    "Prefiltered": Part(room.Prefiltered, _itself, {"controller": PID, "prefilter": room.ReferenceModel(3.0)}, {
        "controller": ql.ADRC(OBSERVER, 1.5, feedforward=True, **LIMITS), "prefilter": Several((baseline_room.ZV(3.0), baseline_room.ZVD(3.0, 0.1))),
    }),
    "Shaper": Part(baseline_room.Shaper, lambda shaper: room.Prefiltered(PID, shaper), {"times": (0.0, 0.5), "amplitudes": (0.5, 0.5)}, {
        "times": Several(((0.0, 0.305),)), "amplitudes": Several(((0.4, 0.6), With((0.3, 0.4, 0.3), {"times": (0.0, 0.3, 0.6)}))),
    }),
    "ReferenceModel": Part(room.ReferenceModel, _shaped, {"omega": 3.0}, {"omega": 2.0, "order": Several((1, 3)), "rate_limit": 0.5}),
    "TrackingDifferentiator": Part(room.TrackingDifferentiator, _shaped, {"acceleration": 2.0}, {"acceleration": 1.0, "horizon": 0.05}),
    "ProfileGenerator": Part(room.ProfileGenerator, _shaped, {"v_max": 0.5, "a_max": 2.0, "j_max": 5.0}, {"v_max": 0.4, "a_max": 1.0, "j_max": 4.0, "smoothing": 0.05}),
}  # fmt: skip
# Public classes that are no part of a controller: protocols and base classes, values that parts
# return, sums of features (the rows of learners), and learners that call Python, which are refused.
NO_PARTS = {
    "Controller",
    "DeadTimeTuning",
    "Estimate",
    "Features",
    "GainEstimate",
    "Joined",
    "Learner",
    "LinearLaw",
    "Model",
    "Notch",
    "PidEqual",
    "Prefilter",
    "Regulator",
}
IN_PYTHON = {"JaxModel", "PythonModel", "RiverModel", "SklearnModel", "TorchModel"}
# A function in C, with which Custom code is linked: ``test_export`` and ``test_plants_in_c`` have one.
ELSEWHERE = {("Custom", "c_function")}


def public_classes() -> set[str]:
    """Return the names of all classes in the rooms of learners, features and laws."""
    rooms = (learner_room, feature_room, room, baseline_room)
    return {name for each in rooms for name in each.__all__ if inspect.isclass(getattr(each, name))}


def constructors() -> set[str]:
    """Return the names of the ways in which an observer is made."""
    made = [name for name, each in vars(ql.ESO).items() if isinstance(each, classmethod)]
    return {f"ESO.{name}" for name in made if not name.startswith("_")}


def test_every_part_is_here() -> None:
    """All public learners, features, laws, baselines and prefilters, and all constructors of observers."""
    assert public_classes() | constructors() | {"Guard", "Feedforward"} <= {
        *PARTS,
        *NO_PARTS,
        *IN_PYTHON,
    }
    assert not {*NO_PARTS, *IN_PYTHON} - public_classes()


@cases("name", PARTS)
def test_every_option_has_another_value(name: str) -> None:
    """An option that is added to a part fails here until it has a row."""
    part = PARTS[name]
    signature = inspect.signature(part.make).parameters.values()
    options = {each.name for each in signature if each.kind is not each.VAR_KEYWORD}
    assert options - {option for owner, option in ELSEWHERE if owner == name} <= set(part.options)
    assert set(part.options) <= options


def values_of(option: Any) -> tuple[Any, ...]:
    """Return the values of an option, one or several."""
    return option.values if isinstance(option, Several) else (option,)


def rows(part: Part) -> Iterator[tuple[str, Any]]:
    """Yield a part in a controller: as it is, and with every other value of each option."""
    yield "as it is", part.use(part.make(**part.needs))
    for option, given in part.options.items():
        for value in values_of(given):
            chosen, others = value if isinstance(value, With) else (value, {})
            made = part.make(**{**part.needs, **others, option: chosen})
            yield f"{option} = {chosen!r}", part.use(made)


def form(value: Any, name: str = "") -> Any:
    """Return what the code for a parameter or a part of a state depends on.

    That is types, shapes, what is constant in the code, and the initial values of records.
    """
    if isinstance(value, np.ndarray):
        if issubclass(value.dtype.type, np.void):
            return value.dtype.type.__name__, *(each.item() for each in value)
        return value.shape, value.dtype.kind
    if isinstance(value, tuple):
        constant = constant_fields(type(value))
        names = getattr(value, "_fields", [""] * len(value))
        fields = zip(names, value, strict=True)
        return type(value).__name__, *(
            part if name in constant else form(part, name) for name, part in fields
        )
    origin = origin_of(value)
    return type(value).__name__ if origin is None else origin.function.__name__


@functools.cache
def programs() -> dict[str, dict[str, Any]]:
    """Return the rows of each part whose code is not that of an earlier row of any part."""
    found: dict[str, dict[str, Any]] = {name: {} for name in PARTS}
    seen = set()
    for name, part in PARTS.items():
        for row, controller in rows(part):
            key = repr((form(parameters_of(controller)), form(controller.initial_state())))
            if key not in seen:
                seen.add(key)
                found[name][row] = controller
    return found


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize("name", PARTS)
@pytest.mark.filterwarnings("ignore::quell.types.DesignWarning")
def test_every_program_repeats_the_kernels_bit_for_bit(tmp_path: Path, name: str) -> None:
    """Of every option that changes the code; with noise, NaN, saturation, manual operation and restarts."""
    for i, (row, controller) in enumerate(programs()[name].items()):
        folder = tmp_path / str(i)
        ql.export.c(controller, folder, name="servo")
        source = folder / "src"
        sources = (folder / "test_servo.c", source / "servo.c")
        program = built(folder / "test", sources, "-O0", "-I", source)
        done = subprocess.run([program, "0"], capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{row}: {done.stdout}"
        assert "largest difference 0 ulp" in done.stdout, row


@pytest.mark.trial
@pytest.mark.filterwarnings("ignore::quell.types.DesignWarning")
def test_what_changes_the_code_is_seen() -> None:
    """A number alone is no program of its own; a search for frequencies, another feature and another order are."""
    found = programs()
    assert "bias_bandwidth = 0.2" not in found["Kalman"]
    assert {"search = True", "orders = (1, 3)", "bias = False"} <= set(found["Harmonic"]) | set(
        found["Kalman"]
    )
    assert "order = 8" in found["ESO.model_free"]


def test_a_learner_in_python_is_refused() -> None:
    """C has no Python: the message says so, of each library that is installed."""
    learners = {type(each).__name__: each for each in python_learners().values()}
    assert {"PythonModel"} <= {*learners} <= IN_PYTHON
    for learner in learners.values():
        with pytest.raises(TranslationError, match="calls Python at each"):
            ql.export.c_source(_learning(learner))
