"""Everything that controls also controls in single precision, nearly as in double."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers import LinearController, in_single_precision
from quell.controllers.baselines import AdaptiveNotch
from quell.controllers.stateful import named_arrays

from .examples import CHAIN, LEARNERS, OBSERVERS, PYTHON_LEARNERS
from .test_contracts import SCENARIO
from .test_controllers import CONTROLLERS, PLANTS

SHORT = dataclasses.replace(SCENARIO, duration=1.5, rest_at=(1.2,))


def check_single(plant: Any, controller: Any, tolerance: float) -> None:
    """Its state and u are single throughout; u is that of double precision within ``tolerance``."""
    single = in_single_precision(controller)
    double = ql.simulate(plant, controller, SHORT)
    run = ql.simulate(plant, single, SHORT)
    for name, array in named_arrays(run.final_state).items():
        assert array.dtype != np.float64, f"{name} is double"
    assert np.all(np.isfinite(run.log))
    assert np.array_equal(run["u"], run["u"].astype(np.float32)), "u is double"
    assert run.status == double.status
    deviation = run["u"] - double["u"]
    assert np.any(deviation != 0.0), "single precision has the bits of double precision"
    assert np.sqrt(np.mean(deviation**2)) < tolerance * np.sqrt(np.mean(double["u"] ** 2))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_controller_in_single_precision_does_what_it_does_in_double(name: str) -> None:
    """To a few units of the last of its 24 bits: laws and observers are in delta form.

    A law that differentiates r or y, as a torque feedforward does twice, has the rounding of r and
    y themselves, times what it does to a single sample. A filter that carries its covariance subtracts
    what a measurement says from it: ten times the rounding.
    """
    controller = CONTROLLERS[name]
    law = controller.law if isinstance(controller, LinearController) else None
    at_once = 0.0 if law is None else max(abs(law.D_r), abs(law.D_y))
    rounding = float(np.finfo(np.float32).eps) * at_once
    usual = 1e-5 if isinstance(controller, AdaptiveNotch) else 1e-6
    check_single(PLANTS.get(name, CHAIN), controller, usual + rounding)


@pytest.mark.parametrize("name", [name for name in OBSERVERS if "order 8" not in name])
def test_an_observer_in_single_precision_estimates_what_it_does_in_double(name: str) -> None:
    """Whatever its order, form and gains; f of order 4 differs by the rounding of y."""
    observer = OBSERVERS[name]
    plant = CHAIN
    if observer.order != CHAIN.order:
        chain = np.diag(np.ones(observer.order - 1), 1)
        last = np.eye(observer.order)[-1]
        plant = ql.plants.LinearPlant(chain, 1.5 * last, np.eye(observer.order)[0])
    check_single(plant, ql.ADRC(observer, omega_c=1.5), 1e-4)


@pytest.mark.parametrize("name", [name for name in LEARNERS if name not in PYTHON_LEARNERS])
def test_a_learner_in_single_precision_learns_what_it_does_in_double(name: str) -> None:
    """Without a guard, so that what it learns acts on u.

    No time of a start is a whole number of samples: rounding would decide between two.
    """
    observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.1, dt=0.01)
    check_single(CHAIN, ql.ADRC(observer, 1.5, learner=LEARNERS[name]), 1e-4)
