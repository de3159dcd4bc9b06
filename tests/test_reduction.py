"""Models of reduced order for designs, and model-based tuning of flexible axes with them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.lti.canonical import canonical, design_models, reduced_model, without_far_zeros
from quell.types import DesignWarning

from .cases import cases

DT, LATE = 2.5e-4, 2.5e-4
BOUNDS = ql.tuning.Constraints(noise_over_pi=None)


def axis(sensor: int = 2, damping: float = 0.02) -> ql.plants.LinearPlant:
    """Motor and load on a damped coupling: a zero at −k/c = −9000 rad/s from motor to load."""
    return ql.plants.n_mass([3.2e-4, 9.5e-4], [180.0], [damping], sensor=sensor)


def three(sensor: int) -> ql.plants.LinearPlant:
    """Motor, gear and load on damped couplings."""
    return ql.plants.n_mass([3.2e-4, 1e-4, 9.6e-4], [300.0, 180.0], [0.02, 0.02], sensor=sensor)


def response(model: Any, omega: float) -> complex:
    """P(jω) of a linear model."""
    plant = ql.plants.LinearPlant.of(model)
    states = np.linalg.solve(1j * omega * np.eye(plant.order) - plant.A, plant.B)
    return complex((plant.C @ states)[0, 0])


def test_a_reduced_model_has_the_response_of_the_plant_at_low_frequencies() -> None:
    """Gain and phase agree far below what is left out, and the order is that of what is kept."""
    plant = three(3)
    found = reduced_model(plant, below=1500.0)
    assert found.order == 4
    assert found.poles.size == 2
    assert response(found.plant, 20.0) == pytest.approx(response(plant, 20.0), rel=3e-3)


def test_an_integrator_of_a_chain_stays_exactly_one() -> None:
    """The double integrator of a free axis has no poles beside zero after a reduction."""
    found = reduced_model(axis(), below=5000.0)
    assert found.plant[1][-2:].tolist() == [0.0, 0.0]
    assert canonical(found.plant).degree == 4
    assert found.zeros.real == pytest.approx([-9000.0], rel=1e-6)


def test_with_no_limit_nothing_is_left_out() -> None:
    """The plant is returned as it is, and the text is empty."""
    plant = axis()
    found = reduced_model(plant, below=math.inf)
    assert found.plant is plant
    assert str(found) == ""


@cases(
    ("model", "below", "message"),
    [
        (([1.0, 1.0], [1.0, 50.0, 0.0]), 10.0, "leaves 1 poles and 1 zeros"),
        (([1.0], [1.0, -50.0, 0.0]), 10.0, "leaves out the unstable poles 50"),
        (([1.0], [1.0, 50.0, 0.0]), -1.0, "below = -1"),
        (([1.0], [1.0, 50.0, 0.0]), math.nan, "below = nan"),
    ],
)
def test_a_reduction_that_leaves_no_model_is_refused(
    model: Any, below: float, message: str
) -> None:
    """The error says what would be left, or left out."""
    with pytest.raises(ValueError, match=message):
        reduced_model(model, below)


def test_the_models_for_a_design_go_down_to_one_resonance() -> None:
    """The plant first; without far zeros; without the second resonance; no others if simple."""
    assert [each.order for each in design_models(three(3))] == [6, 6, 4]
    assert [each.order for each in design_models(axis(2))] == [4, 4]
    assert len(design_models(axis(1))) == 1
    assert len(design_models(([1.0], [1.0, 3.0, 3.0, 1.0]))) == 1


def test_an_observer_leaves_out_a_far_zero_and_says_so() -> None:
    """The warning names the zero; b0 is that of the relative degree without it, k/(J_m J_l)."""
    with pytest.warns(DesignWarning, match=r"zero at -9000 rad/s.*belongs to f"):
        observer = ql.ESO.model_based(axis(), omega_o=400.0, dt=DT)
    assert observer.degree == 4
    assert observer.b0 == pytest.approx(180.0 / (3.2e-4 * 9.5e-4), rel=1e-6)
    with pytest.warns(DesignWarning):
        half = ql.ESO.model_based(axis(), 400.0, DT, b0=0.5 * canonical(axis()).b)
    assert half.b0 == pytest.approx(0.5 * observer.b0, rel=1e-6)


def test_all_zeros_stay_where_they_are_near_or_wanted(recwarn: Any) -> None:
    """No warning for ``far=math.inf``, nor for a zero within the reach of the observer."""
    assert ql.ESO.model_based(axis(), 400.0, DT, far=math.inf).degree == 3
    assert ql.ESO.model_based(axis(), 1000.0, DT).degree == 3
    assert ql.ESO.model_based(axis(1), 400.0, DT).degree == 2
    assert not without_far_zeros(axis(1), 10.0).zeros.size
    assert not recwarn.list


@pytest.mark.trial
@pytest.mark.parametrize("plant", [axis(2), three(1)], ids=["load encoder", "three inertias"])
def test_a_flexible_axis_is_tuned_with_a_model_of_reduced_order(plant: Any) -> None:
    """M_s of the whole plant keeps its bound; the report says what is left out; the file runs."""
    structure = "model-based-poles"
    tuned = ql.tune(plant, DT, structure=structure, compare=(), delay=LATE, constraints=BOUNDS)
    loop = ql.analysis.analyse(plant, tuned.controller, delay=LATE)
    assert loop.stable
    assert 1.0 / loop.margins.modulus <= 1.6 * 1.002
    assert "not in the observer's model of order 4" in tuned.summary()
    assert "belongs to f" in tuned.toml()
    table = tuned.design.tables["observer"]["plant"]
    again = ql.ESO.model_based((table["num"], table["den"]), table_omega(tuned), DT)
    assert again.order == 4


def table_omega(tuned: Any) -> float:
    """The bandwidth of the tuned observer [rad/s]."""
    return float(tuned.design.tables["observer"]["omega_o"])
