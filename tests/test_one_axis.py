"""One axis is the case n = 1 of several: plants, loops, records and scenarios have one path."""

from __future__ import annotations

import importlib
import pkgutil
import re
from typing import Any

import numpy as np
import pytest

import quell as ql

DT = 1e-3


def adrc(b0: float) -> ql.ADRC:
    """A controller of a motor."""
    return ql.ADRC(ql.ESO.model_free(order=2, b0=b0, omega_o=60.0, dt=DT), omega_c=8.0)


def test_axes_of_one_adrc_have_its_bits() -> None:
    """The same samples of y and u under a load and noise: b0 is B0, and noise has the same seed."""
    plant = ql.plants.LinearPlant.of(([5.0], [1.0, 2.0, 0.0]))
    noise = ql.signals.BandLimitedNoise(power=1e-12, sample_time=DT)
    scenario = ql.Scenario(
        1.0, 0.2, disturbances=(ql.signals.Step(0.3, 0.05),), noise=noise, seed=4
    )
    alone = ql.simulate(plant, adrc(4.0), scenario, interpret=True)
    axes = ql.Axes({"x": adrc(1.0)}, B0=[[4.0]])
    machine = ql.simulate(plant, axes, scenario, interpret=True)
    for name in ("r", "y", "y_measured", "u", "w", "x"):
        np.testing.assert_array_equal(machine[name], alone[name])
    assert machine.axis("x").metrics()["rms"] == alone.metrics()["rms"]


def test_a_list_of_one_signal_is_that_signal() -> None:
    """Of the reference and of the noise."""
    plant, seconds = ([5.0], [1.0, 2.0, 0.0]), 0.05
    one = ql.simulate(plant, adrc(5.0), ql.Scenario(1.0, seconds, noise=1e-3), interpret=True)
    given = ql.Scenario([1.0], seconds, noise=[1e-3])
    other = ql.simulate(plant, adrc(5.0), given, interpret=True)
    np.testing.assert_array_equal(one.log, other.log)


def test_a_linear_plant_of_one_column_is_the_plant_of_vectors() -> None:
    """Its sampled model is the same, and it counts one input and one output."""
    A = [[0.0, 1.0], [-4.0, -0.5]]
    vectors = ql.plants.LinearPlant(A, [0.0, 2.0], [1.0, 0.0])
    matrices = ql.plants.LinearPlant(A, [[0.0], [2.0]], [[1.0, 0.0]])
    assert (matrices.inputs, matrices.outputs) == (1, 1)
    for one, other in zip(vectors.sampled(DT), matrices.sampled(DT), strict=True):
        np.testing.assert_array_equal(one, other)


def test_independent_axes_in_one_linear_plant_move_as_the_plants_alone() -> None:
    """Block-diagonal matrices: each output is that of its own block, bit for bit."""
    blocks = [([5.0], [1.0, 2.0, 0.0]), ([3.0], [1.0, 1.0, 4.0])]
    plants = [ql.plants.LinearPlant.of(block) for block in blocks]
    zero = np.zeros((2, 2))
    A = np.block([[plants[0].A, zero], [zero, plants[1].A]])
    B, C = np.zeros((4, 2)), np.zeros((2, 4))
    for i, plant in enumerate(plants):
        B[2 * i : 2 * i + 2, i], C[i, 2 * i : 2 * i + 2] = plant.B[:, 0], plant.C[0]
    whole = ql.plants.LinearPlant(A, B, C)
    gains = [5.0, 3.0]
    axes = ql.Axes([adrc(1.0), adrc(1.0)], B0=np.diag(gains))
    scenario = ql.Scenario((1.0, -0.5), 0.1)
    run = ql.simulate(whole, axes, scenario, interpret=True)
    for i, r in enumerate((1.0, -0.5)):
        alone = ql.simulate(plants[i], adrc(gains[i]), ql.Scenario(r, 0.1), interpret=True)
        np.testing.assert_allclose(run["y"][:, i], alone["y"], rtol=1e-12)


def test_a_nonlinear_plant_takes_a_number_or_an_array_for_u() -> None:
    """``inputs`` says which; with one input it is a number, also with several outputs."""
    both = np.eye(2)
    one = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u - x[0]), 2, both)
    two = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u[0] + u[1] - x[0]), 2, both, inputs=2)
    assert (one.inputs, one.outputs, two.inputs, two.outputs) == (1, 2, 2, 2)
    np.testing.assert_allclose(ql.plants.linearised(one, [0.0, 0.0]).B, [[0.0], [1.0]], atol=1e-9)
    found = ql.plants.linearised(two, [0.0, 0.0]).B
    np.testing.assert_allclose(found, [[0.0, 0.0], [1.0, 1.0]], atol=1e-9)


@pytest.mark.parametrize(
    ("of", "old", "new"),
    [
        (ql, "AxesTrajectory", "Trajectory"),
        (ql, "AxesBatch", "BatchTrajectory"),
        (ql.plants, "MultivariableLinearPlant", "LinearPlant"),
        (ql.plants, "MultivariableNonlinearPlant", "NonlinearPlant"),
        (
            importlib.import_module("quell.plants.multivariable"),
            "MultivariableLinearPlant",
            "LinearPlant",
        ),
        (importlib.import_module("quell.records.axes"), "AxesTrajectory", "Trajectory"),
        (ql.plants, "MultivariableFMU", "FMU"),
        (
            importlib.import_module("quell.controllers.single"),
            "SeveralInSingle",
            "SinglePrecision",
        ),
        (ql.analysis, "analyse_axes", "analyse"),
        (ql.analysis, "certify_axes", "certify"),
        (ql.setup, "load_axes", "load"),
        (ql.setup, "made_axes", "made"),
        (ql.tuning, "tune_axes", "tune"),
        (ql.tuning, "TunedAxes", "Tuned"),
        (ql.tuning, "AxisResult", "Design"),
        (ql.tuning, "AxesBound", "Reached"),
        (ql.tuning, "AxesCheck", "Check"),
    ],
)
def test_a_name_of_an_earlier_release_is_the_present_one(of: Any, old: str, new: str) -> None:
    """With a line that says it."""
    with pytest.warns(FutureWarning, match=rf"{old} is quell\S*\.{new} now"):
        found = getattr(of, old)
    known = [getattr(each, new) for each in (ql, ql.plants, of) if hasattr(each, new)]
    assert found is known[0]


# Public names that say how many axes there are: the machine, what spans its axes, and what still has
# a twin for one axis. No other one is added: a capability has one name for any number of axes.
SEVERAL = {
    "Axes",
    "AllAxes",  # features of the states of all axes
    "CoupledCertificate",  # of systems that act on each other
    "certify_coupled",
    "MultivariableLoop",
    "MultivariableESO",
    "axes_law",
    "AxesDescription",
}


def test_no_other_public_name_is_for_several_axes_only() -> None:
    """In any package; the list of those that there are has no name that is gone."""
    packages = [
        importlib.import_module(f"quell.{each.name}")
        for each in pkgutil.iter_modules(ql.__path__)
        if each.ispkg and each.name not in ("cli", "studio")
    ]
    public = {name for each in (ql, *packages) for name in getattr(each, "__all__", ())}
    words = re.compile("axes|several|multivariable|coupled", re.IGNORECASE)
    assert {name for name in public if words.search(name)} == SEVERAL
