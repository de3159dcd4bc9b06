"""Plants and functions of the user become C code that calculates the same, bit for bit."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.base import control
from quell.export import TranslationError, c_source, plant_source
from quell.features import Custom, State
from quell.plants.base import advance, measure

from .contracts.examples import PLANTS
from .in_c import InC, needs_gcc

DT = 0.01
TRANSLATED = {name: plant for name, plant in PLANTS.items() if name != "fmu"}


@pytest.mark.trial(cases="NonlinearPlant")
@needs_gcc
@pytest.mark.parametrize("name", TRANSLATED)
def test_a_plant_in_c_moves_as_in_the_simulation(tmp_path: Path, name: str) -> None:
    """Under a moving u and moving disturbances, from a state that is not at rest."""
    plant = TRANSLATED[name]
    x, scratch, m = np.full(plant.order, 0.1), np.zeros(6 * plant.order), plant.disturbances
    model, in_c = plant.sampled(DT), InC(plant_source(plant, DT, x0=x), tmp_path)
    for k in range(60):
        assert in_c.run("measure") == float(measure(model, x))
        t, u, w = k * DT, 3.0 * math.sin(0.3 * k), 0.3 * np.cos(0.05 * k + np.arange(float(m)))
        with np.errstate(all="ignore"):
            advance(model, x, scratch, t, u, w)
        in_c.run("advance", t, u, *([w] if m else []))


STIFFNESS = 2.5


def pendulum(x: Any, u: float) -> tuple[float, float]:
    """Return what pulls at a pendulum, and a switch."""
    pull = STIFFNESS * math.sin(x[0])
    if u > 0.0:
        return pull, 1.0
    return pull, -1.0


def listed(x: Any, u: float) -> Any:
    """Return the features in a way that is not written as a tuple."""
    found = (x[0] * x[0], u)
    return found  # noqa: RET504


C_PENDULUM = """
void my_pendulum(const double *x, double u, double *out)
{
    out[0] = 2.5 * sin(x[0]);
    out[1] = u > 0.0 ? 1.0 : -1.0;
}
"""


def learner_on(features: Custom) -> ql.ADRC:
    """A controller with a learner on features of the user."""
    observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=DT)
    learner = ql.learners.RLS(State() + features)
    return ql.ADRC(observer, omega_c=2.0, learner=learner, u_min=-5.0, u_max=5.0)


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize(
    ("features", "more"),
    [
        (Custom(pendulum, ("pull", "switch")), ""),
        (Custom(lambda x, u: (math.cos(x[0]), u * u), ("cos", "square")), ""),
        (Custom(pendulum, ("pull", "switch"), c_function="my_pendulum"), C_PENDULUM),
    ],
    ids=["function", "lambda", "function in C"],
)
def test_features_of_the_user_are_in_the_c_code(
    tmp_path: Path, features: Custom, more: str
) -> None:
    """A Python function is translated; one that the user has in C is called."""
    controller = learner_on(features)
    source, state = c_source(controller, "servo"), controller.initial_state()
    assert ("my_pendulum(const double *" in source.source) == bool(more)
    in_c, rng = InC(source, tmp_path, more), np.random.default_rng(1)
    for k in range(300):
        r, y = math.sin(0.05 * k), math.sin(0.05 * k - 0.3) + 1e-3 * rng.standard_normal()
        assert in_c.run("step", r, y) == float(control(controller.parameters, state, r, y))
    assert abs(float(state.loop[0].f_learned)) > 0.0


def test_a_function_that_can_not_be_translated_is_named() -> None:
    """The error says what to write instead."""
    with pytest.raises(TranslationError, match=r"listed: must return a tuple of numbers"):
        c_source(learner_on(Custom(listed, ("a", "b"))))


def test_the_name_of_a_c_function_must_be_one() -> None:
    """It would make code that does not compile."""
    with pytest.raises(ValueError, match="c_function = 'my-features'"):
        Custom(pendulum, ("pull", "switch"), c_function="my-features")


def test_what_is_no_controller_plant_or_state_is_named() -> None:
    """One error each, that names the argument."""
    motor = ql.plants.LinearPlant([[-1.0]], [1.0], [1.0])
    for given in (5, ql.ADRC):
        with pytest.raises(ValueError, match="controller = .*must be a controller"):
            c_source(given)
    with pytest.raises(ValueError, match="plant = 5: must be a plant"):
        plant_source(5, DT)  # type: ignore[arg-type]
    for x0 in ([1.0, 2.0], [math.nan], "x"):
        with pytest.raises(ValueError, match="x0"):
            plant_source(motor, DT, x0=x0)
    with pytest.raises(TranslationError, match="c_function = 'int': is a keyword"):
        c_source(learner_on(Custom(pendulum, ("pull", "switch"), c_function="int")))
