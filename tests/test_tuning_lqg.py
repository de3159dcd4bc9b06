"""LQG as a structure of the tuner."""

from __future__ import annotations

import numpy as np
import pytest

import quell as ql
from quell.analysis import analyse
from quell.tuning import Constraints
from quell.tuning.plants import given_plants, model_of, plant_set
from quell.tuning.structures.base import Structure
from quell.tuning.structures.registry import make_structure

LAGS = ([1.0], [1.0, 3.0, 3.0, 1.0])


def structure(plant: object) -> Structure:
    """Return LQG for a plant at 10 ms."""
    given = given_plants(plant, 0.01)
    constraints = Constraints()
    return make_structure("lqg", model_of(given, plant_set(given, 0.01), constraints))


@pytest.mark.parametrize("plant", [LAGS, ql.plants.two_mass_spring()], ids=["lags", "two masses"])
def test_the_response_and_the_integral_gain_are_those_of_the_controller(plant: object) -> None:
    """With a nominal gain of twice the real one, which halves the controller."""
    lqg, omega = structure(plant), np.array([0.1, 1.0, 5.0, 40.0])
    values = np.array([[1.0, 1.0, 6.0], [2.0, 1.0, 6.0]])
    found = lqg.response(values, omega)
    for row, response in zip(values, found, strict=True):
        loop = analyse(plant, lqg.controller(row))
        np.testing.assert_allclose(response, loop.response("C_y", omega), rtol=1e-6)
    np.testing.assert_allclose(found[0], 2.0 * found[1], rtol=1e-12)
    load = analyse(plant, lqg.controller(values[0])).response("PS", [1e-4])[0]
    assert lqg.integral_gain(values)[0] == pytest.approx(1e-4 / abs(load), rel=1e-4)
    assert lqg.integral_gain(values)[1] == pytest.approx(0.5 * lqg.integral_gain(values)[0])


def test_its_table_describes_the_same_controller() -> None:
    """Read from a setup it has the same gains."""
    from quell.setup import made

    lqg, row = structure(LAGS), np.array([1.7, 1.0, 6.0])
    tables = {"dt": 0.01, "plant": {"kind": "linear", "A": [[-1.0]], "B": [1.0], "C": [1.0]}}
    built = made("tuned", tables | lqg.tables(row)).controller
    direct = lqg.controller(row)
    assert isinstance(built, ql.baselines.LQG)
    np.testing.assert_array_equal(built.K, direct.K)
    np.testing.assert_array_equal(built.L, direct.L)
