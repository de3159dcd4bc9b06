"""Inertias in a chain: against closed forms, Newton's law by a solver, and other plants."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import quell as ql
from quell.plants.base import advance, measure

from .cases import cases

J, K, D, GROUND = [3e-4, 2e-4, 9e-4], [300.0, 180.0], [0.02, 0.01], [1e-3, 0.0, 2e-3]


def moved(plant: Any, u: Any, x0: Any, dt: float = 1e-3, w: Any = (0.0,)) -> np.ndarray:
    """The states before each sample and after the last one, interpreted."""
    model, x = plant.sampled(dt), np.array(x0, dtype=float)
    scratch, states = np.zeros(6 * plant.order), [x.copy()]
    for k, torque in enumerate(u):
        advance(model, x, scratch, k * dt, float(torque), np.array(w, dtype=float))
        states.append(x.copy())
    return np.array(states)


def newton(t: float, x: Any, u: float, w: float, play: Any) -> Any:
    """The equations of motion of three inertias as the module's docstring has them."""
    theta, speed = x[:3], x[3:]
    torque = [u, 0.0, w]
    for i in range(3):
        torque[i] -= GROUND[i] * speed[i]
    for i in range(2):
        twist, rate, free = theta[i] - theta[i + 1], speed[i] - speed[i + 1], 0.5 * play[i]
        if play[i] == 0.0:
            through = K[i] * twist + D[i] * rate
        elif abs(twist) <= free:
            through = 0.0
        elif twist > free:
            through = max(K[i] * (twist - free) + D[i] * rate, 0.0)
        else:
            through = min(K[i] * (twist + free) + D[i] * rate, 0.0)
        torque[i] -= through
        torque[i + 1] += through
    return np.concatenate([speed, np.array(torque) / J])


@pytest.mark.parametrize("play", [(0.0, 0.0), (0.0, 0.02), (0.01, 0.02)])
def test_it_obeys_newton(play: tuple[float, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a solver of high order, with play in no, one or both couplings, leaving contact.

    Contacts multiply small errors, so it is the limit of short sub-steps that is compared.
    """
    monkeypatch.setattr("quell.plants.flexible._TURN", 0.0125)
    plant = ql.plants.n_mass(J, K, D, GROUND, play)
    u, dt, x0 = 0.5 * np.sign(np.sin(0.3 * np.arange(20))), 1e-3, np.zeros(6)
    found = moved(plant, u, x0, dt, w=(0.05,))
    expected, x = [x0], x0
    for torque in u:
        how: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-12, "max_step": 1e-4}
        x = solve_ivp(newton, (0.0, dt), x, args=(torque, 0.05, play), **how).y[:, -1]
        expected.append(x)
    swing = np.ptp(np.array(expected), axis=0)
    worst = np.max(np.abs(found - expected) / swing)
    assert worst < (1e-6 if not any(play) else 5e-3)


def test_an_undamped_coupling_in_contact_is_exact() -> None:
    """Wound up beyond its play and held there, the chain moves as the linear one with an offset."""
    free, soft = 0.02, ql.plants.n_mass([1e-3, 2e-3], [50.0], play=[0.02])
    linear = ql.plants.n_mass([1e-3, 2e-3], [50.0])
    u = np.full(40, 3.0)
    # Under a steady torque the spring carries 2 N m and never less than 0.
    start = np.array([0.04 + 0.5 * free, 0.0, 0.0, 0.0])
    shifted = moved(linear, u, start - [0.5 * free, 0.0, 0.0, 0.0])
    shifted[:, 0] += 0.5 * free
    np.testing.assert_allclose(moved(soft, u, start), shifted, rtol=1e-10, atol=1e-13)


def test_in_its_play_a_coupling_carries_nothing() -> None:
    """Within the play each inertia is alone: a driven one accelerates by u/J, the other rests."""
    plant = ql.plants.n_mass([1e-3, 2e-3], [50.0], [0.05], play=[0.2])
    x = moved(plant, [0.1] * 10, np.zeros(4), dt=1e-3)[-1]
    np.testing.assert_allclose(x, [0.5 * 100.0 * 0.01**2, 0.0, 1.0, 0.0], rtol=3e-4, atol=3e-4)


def test_its_modes_are_those_of_the_textbook() -> None:
    """Two inertias: resonance at √(k (1/J1 + 1/J2)), an integrator twice, a zero at √(k/J2)."""
    plant = ql.plants.n_mass([3.2e-4, 9.5e-4], [180.0])
    poles = np.linalg.eigvals(plant.A)
    assert np.max(poles.imag) == pytest.approx(np.sqrt(180.0 * (1 / 3.2e-4 + 1 / 9.5e-4)))
    zeros = ql.lti.canonical.canonical(plant).zeros
    assert np.max(zeros.imag) == pytest.approx(np.sqrt(180.0 / 9.5e-4))


def test_two_masses_and_the_torsional_plant_are_cases_of_it() -> None:
    """The same matrices, bit for bit."""
    two, chain = ql.plants.two_mass_spring(1.5, 0.4, 7.0), ql.plants.n_mass([1.5, 0.4], [7.0])
    np.testing.assert_array_equal(two.A, chain.A)
    np.testing.assert_array_equal(two.B, chain.B)
    disks = ql.plants.torsional(shaft_damping=0.003).linear
    inertia = 0.0187 + 9.0 * (0.0005 / 9.0)
    other = ql.plants.n_mass([inertia, 0.0019], [2.908], [0.003], [0.02122, 0.001512], sensor=2)
    np.testing.assert_array_equal(disks.A, other.A)
    np.testing.assert_array_equal(disks.C, other.C)


def test_sensor_and_loads_are_at_any_inertia() -> None:
    """The output is the angle of the numbered inertia; each load accelerates its own."""
    plant = ql.plants.n_mass(J, K, sensor=2, loads=[3, 1], play=[0.1, 0.0])
    assert measure(plant.sampled(1e-3), np.arange(1.0, 7.0)) == 2.0
    expected = np.zeros((6, 2))
    expected[5, 0], expected[3, 1] = 1.0 / J[2], 1.0 / J[0]
    np.testing.assert_allclose(plant.linear.E, expected)
    assert [str(each) for each in plant.signals.w] == [
        "torque on inertia 3 [N m]",
        "torque on inertia 1 [N m]",
    ]


def test_one_inertia_is_a_rigid_axis() -> None:
    """θ'' = u/J without any coupling."""
    plant = ql.plants.n_mass([0.01], [])
    assert plant.A.tolist() == [[0.0, 1.0], [0.0, 0.0]]
    assert plant.B.ravel().tolist() == [0.0, 100.0]


@cases(
    ("change", "message"),
    [
        ({"inertias": []}, r"inertias = \[\]: must have at least one"),
        ({"inertias": 1.0}, r"inertias = 1\.0: must be a list"),
        ({"inertias": [1.0, -1.0]}, r"inertias\[1\] = -1\.0"),
        ({"stiffnesses": [1.0]}, r"stiffnesses has 1 entries: must have 2 .*3 inertias"),
        ({"dampings": [-1.0, 0.0]}, r"dampings\[0\] = -1\.0"),
        ({"ground": [0.0]}, r"ground has 1 entries: must have 3"),
        ({"play": [0.0, float("nan")]}, r"play\[1\] = nan"),
        ({"sensor": 0}, r"sensor = 0"),
        ({"sensor": 4}, r"sensor = 4"),
        ({"loads": [4]}, r"loads\[0\] = 4"),
        ({"loads": []}, r"loads = \[\]: must be a list"),
        ({"loads": 2}, r"loads = 2: must be a list"),
        ({"loads": [2, 2]}, r"loads = \[2, 2\]: must have each inertia once"),
    ],
)
def test_arguments_out_of_range_are_refused(change: dict[str, Any], message: str) -> None:
    """The error names the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        ql.plants.n_mass(**{"inertias": J, "stiffnesses": K} | change)


def test_a_sample_of_many_periods_is_refused_with_play() -> None:
    """Its sub-steps would have no end; the message says the longest sample."""
    plant = ql.plants.n_mass(J, K, play=[0.01, 0.01])
    with pytest.raises(ValueError, match=r"dt = 1000\.0 s: must be at most .* s with play"):
        plant.sampled(1000.0)


def test_linear_functions_name_the_part_without_play() -> None:
    """The analysis refuses the plant and names its linear part, which it takes."""
    plant = ql.plants.n_mass([1e-3, 2e-3], [50.0], [0.01], play=[0.02])
    controller = ql.ADRC(ql.ESO.model_free(2, 1 / 3e-3, 20.0, 1e-3), 5.0)
    with pytest.raises(ValueError, match=r"play.*plant\.linear"):
        ql.analysis.analyse(plant, controller)
    assert ql.analysis.analyse(plant.linear, controller).stable
