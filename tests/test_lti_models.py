"""A plant in any of its forms is the same plant, wherever it is given."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest
import scipy.signal

import quell as ql
from quell.analysis import analyse
from quell.lti.models import leading_gain
from quell.plants import LinearPlant, two_mass_spring

from .cases import cases

NUM, DEN = [2.0, 3.0], [1.0, 1.5, 4.0, 0.5]
LAW = ql.ADRC(ql.ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=1e-2), omega_c=2.0)
STEP = ql.Scenario(reference=1.0, disturbances=(ql.signals.Step(at=1.0),), duration=2.0)


def forms() -> dict[str, Any]:
    """Return (2 s + 3)/(s³ + 1.5 s² + 4 s + 0.5) in all forms."""
    A, B, C, _ = scipy.signal.tf2ss(NUM, DEN)
    return {
        "transfer function": (NUM, DEN),
        "in a list": [np.array(NUM), np.array(DEN)],
        "matrices": (A, B, C),
        "matrices in a list, as lists": [A.tolist(), B[:, 0].tolist(), C[0].tolist()],
        "with a channel": (A, B, B, C),
        "control.tf": control.tf(NUM, DEN),
        "control.ss": control.ss(A, B, C, 0.0),
        "scipy's TransferFunction": scipy.signal.TransferFunction(NUM, DEN),
        "scipy's StateSpace": scipy.signal.StateSpace(A, B, C, [[0.0]]),
        "scipy's ZerosPolesGain": scipy.signal.ZerosPolesGain([-1.5], np.roots(DEN), 2.0),
    }


@pytest.mark.parametrize("form", forms())
def test_every_form_is_taken_everywhere_and_is_the_same_plant(form: str) -> None:
    """Observer, loop, state feedback and run agree with those of the companion matrix."""
    model, by_hand = (
        forms()[form],
        LinearPlant([[0, 1, 0], [0, 0, 1], [-0.5, -4.0, -1.5]], [0, 0, 1.0], [3.0, 2.0, 0]),
    )
    found = ql.canonical(model)
    np.testing.assert_allclose([*found.a, found.b], [0.5, 4.0, 1.5, 2.0], rtol=1e-9)
    np.testing.assert_allclose(
        ql.ESO.model_based(model, 20.0, 1e-2).a,
        ql.ESO.model_based(by_hand, 20.0, 1e-2).a,
        rtol=1e-9,
    )
    omega = np.geomspace(0.01, 100.0, 50)
    np.testing.assert_allclose(
        analyse(model, LAW).response("L", omega),
        analyse(by_hand, LAW).response("L", omega),
        rtol=1e-7,
    )
    one, other = (ql.baselines.LQG(plant, 1.0, 5.0, 0.01) for plant in (model, by_hand))
    np.testing.assert_allclose(
        [one.N, *np.linalg.eigvals(one.law.A)],
        [other.N, *np.linalg.eigvals(other.law.A)],
        rtol=1e-5,
    )
    run, expected = ql.simulate(model, LAW, STEP), ql.simulate(by_hand, LAW, STEP)
    np.testing.assert_allclose(run["y"], expected["y"], atol=1e-10)


def test_the_states_of_a_transfer_function_are_said_and_its_coefficients_kept() -> None:
    """Without zeros y and its derivatives; with zeros y first. No coefficient is rounded."""
    motor = LinearPlant.of(([50.0], [1.0, 22.0, 40.0, 0.0]))
    np.testing.assert_array_equal(motor.A, [[0, 1, 0], [0, 0, 1], [0, -40.0, -22.0]])
    np.testing.assert_array_equal(motor.B, [[0], [0], [50.0]])
    np.testing.assert_array_equal(LinearPlant.of(([0.0, 40.0, 22.0], 50.0)).A, motor.A)
    np.testing.assert_array_equal(ql.canonical(motor).S, np.eye(3))
    plant = LinearPlant.of((NUM, DEN))
    np.testing.assert_array_equal(plant.A, [[-1.5, 1, 0], [-4.0, 0, 1], [-0.5, 0, 0]])
    np.testing.assert_array_equal(plant.B[:, 0], [0.0, 2.0, 3.0])
    found, again = ql.canonical((NUM, DEN)), ql.canonical(plant)
    for name in ("a", "B", "E"):
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), rtol=1e-12)


def test_a_fast_pole_costs_no_digits_of_slow_zeros() -> None:
    """Zeros at 0.1 and 0.2 rad/s, a lag of 0.1 ms: the plant is its partial fractions to 1e-12."""
    zeros, poles, dt = np.array([-0.1, -0.2]), np.array([-1.0, -2.0, -3.0, -1e4]), LAW.dt
    omega = np.geomspace(1e-3, 100.0, 30)
    z = np.exp(1j * omega * dt)
    residues = [
        np.prod(pole - zeros) / np.prod(pole - np.delete(poles, i)) for i, pole in enumerate(poles)
    ]
    exact = sum(
        r * np.expm1(p * dt) / p / (z - np.exp(p * dt))
        for r, p in zip(residues, poles, strict=True)
    )
    np.testing.assert_allclose(
        analyse((np.poly(zeros), np.poly(poles)), LAW).response("P", omega), exact, rtol=1e-11
    )


def test_a_plant_stays_as_it_is_and_a_channel_replaces_its_own() -> None:
    """Its disturbance inputs too; E takes one of them, or a column."""
    plant = two_mass_spring()
    assert LinearPlant.of(plant) is plant
    np.testing.assert_array_equal(LinearPlant.of(plant, E=1).E, plant.E[:, 1:])
    matrices = (plant.A, plant.B, plant.C)
    np.testing.assert_array_equal(
        LinearPlant.of(matrices, E=[0, 0, 0, 2.0]).E, [[0], [0], [0], [2.0]]
    )
    assert (
        ql.canonical(([[0.0, 1.0], [-4.0, -0.4]], [1.0, 1.0], [1.0, 0.0]), E=[0.0, 1.0]).f_degree
        == 2
    )
    np.testing.assert_array_equal(LinearPlant.of(matrices).E, plant.B)
    assert LinearPlant.of((NUM, DEN), name="axis").name == "axis"


def test_numbers_are_one_plant_and_plants_are_many() -> None:
    """A pair of polynomials is one run; a pair of plants, in a tuple or a list, two."""
    one = ql.simulate((NUM, DEN), LAW, STEP)
    plant = LinearPlant.of((NUM, DEN))
    for pair in ((plant, plant), [plant, plant]):
        runs = ql.simulate(pair, LAW, STEP)
        np.testing.assert_array_equal(runs["y"], [one["y"], one["y"]])
    many = ql.simulate((NUM, DEN), [LAW, LAW], STEP)
    np.testing.assert_array_equal(many["y"][1], one["y"])


def test_a_sampled_system_is_analysed_at_the_controllers_sample_time() -> None:
    """As matrices and as polynomials in z: the loop of the plant that was sampled."""
    plant = control.tf(NUM, DEN)
    expected, omega = analyse(plant, LAW), np.geomspace(0.1, 300.0, 40)
    for sampled in (control.c2d(plant, 0.01), control.ss(control.c2d(plant, 0.01))):
        np.testing.assert_allclose(
            analyse(sampled, LAW).response("L", omega), expected.response("L", omega), rtol=1e-5
        )


def test_the_leading_gain_is_the_first_markov_parameter() -> None:
    """1/(m1 m2 …) of a chain, in any unit of time; none where u does not reach y."""
    plant = two_mass_spring(m1=2.0, m2=4.0, k=3.0)
    for scale in (1e-4, 1.0, 1e4):
        found = leading_gain(plant.A * scale, plant.B * scale, plant.C)
        assert found is not None
        assert found[1] == 4
        assert found[0] == pytest.approx(3.0 / 8.0 * scale**4, rel=1e-12)
    assert (
        leading_gain(np.diag([-1.0, -2.0]), np.array([[1.0], [0.0]]), np.array([[0.0, 1.0]]))
        is None
    )


A2, B2, C2 = [[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0]


@cases(
    ("model", "message"),
    [
        (
            (A2, B2, C2, [[0.0]]),
            r"C, the last of four, has shape \(1, 1\): four entries are \(A, B, E, C\), "
            r"not \(A, B, C, D\)",
        ),
        (
            ([[-1.0]], [1.0], [1.0], [0.0]),
            r"C, the last of four, is zero: four entries are \(A, B, E, C\)",
        ),
        (([1.0, 1.0], [1.0, 2.0]), "transfer function is biproper"),
        (([1.0, 0.0, 1.0], [1.0, 2.0]), "transfer function is improper"),
        (([0.0], [1.0, 2.0]), "numerator is zero"),
        (scipy.signal.ZerosPolesGain([-1.0], [-2.0], 1.0), "transfer function is biproper"),
        (scipy.signal.StateSpace(-1.0, 1.0, 1.0, 1.0), "D = .*: must be zero"),
        (
            scipy.signal.TransferFunction([1.0], [1.0, 0.5], dt=0.1),
            "plant has a sample time.*0.1: must be",
        ),
        ((1.0, 2.0, 3.0, 4.0, 5.0), "plant = .*: must be a linear plant"),
    ],
)
def test_what_can_not_be_read_is_said_in_a_line(model: Any, message: str) -> None:
    """The same line from all that take a plant."""
    for take in (
        LinearPlant.of,
        lambda model: analyse(model, LAW),
        lambda model: ql.baselines.LQG(model, 1.0, 5.0, 0.01),
        lambda model: ql.simulate(model, LAW, STEP),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            take(model)  # type: ignore[no-untyped-call]
        assert "\n" not in str(caught.value)
