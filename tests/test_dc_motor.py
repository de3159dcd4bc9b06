"""The DC motor: its linear part, its friction and its cogging, against closed forms and solve_ivp."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import quell as ql
from quell.plants.base import advance, measure
from quell.plants.testbeds import cogging_torque

from .cases import cases

RECORD = Path(__file__).resolve().parents[2] / "shared" / "data" / "cogging_a.csv"
K, R, J, C = 0.05, 0.5, 2e-4, 1e-4
IDEAL: dict[str, Any] = {"coulomb": 0.0, "counts": None}


def driven(plant: Any, u: Any, x0: Any = None, dt: float = 1e-3, w: Any = (0.0, 0.0)) -> np.ndarray:
    """The states before each sample and after the last one, interpreted."""
    model, x = plant.sampled(dt), np.zeros(plant.order) if x0 is None else np.array(x0, dtype=float)
    scratch, states = np.zeros(6 * plant.order), [x.copy()]
    for k, voltage in enumerate(u):
        advance(model, x, scratch, k * dt, float(voltage), np.array(w, dtype=float))
        states.append(x.copy())
    return np.array(states)


@pytest.mark.parametrize("inductance", [None, 5e-4])
def test_without_friction_and_cogging_it_is_linear(
    inductance: float | None, rng: np.random.Generator
) -> None:
    """The textbook's transfer function, exactly; without inductance b0 = k_t/(R J)."""
    motor = ql.plants.dc_motor(inductance=inductance, **IDEAL)
    u = rng.normal(size=50)
    if inductance is None:
        model = ([K / (R * J)], [1.0, (C + K**2 / R) / J, 0.0])
    else:
        den = [inductance * J, R * J + inductance * C, R * C + K**2, 0.0]
        model = ([K], den)
    expected = ql.plants.LinearPlant.of(model)
    angle = driven(expected, u, w=(0.0,))[:, 0]
    np.testing.assert_allclose(driven(motor, u)[:, 0], angle, rtol=1e-9, atol=1e-12)


def test_its_voltage_is_limited_and_its_angle_is_counted() -> None:
    """Beyond the limit more voltage has no effect; y is a whole number of counts."""
    motor = ql.plants.dc_motor(coulomb=0.0, voltage_limit=2.0, counts=1000)
    np.testing.assert_array_equal(driven(motor, [2.0] * 9), driven(motor, [50.0] * 9))
    x = driven(motor, [2.0] * 40)[-1]
    counts = measure(motor.sampled(1e-3), x) / motor.resolution
    assert counts == pytest.approx(round(x[0] / motor.resolution), abs=1e-9)
    assert abs(x[0] / motor.resolution - counts) <= 0.5


def test_it_obeys_newton_with_cogging() -> None:
    """Against a solver of high order, over several waves, with a load and a shifted map."""
    motor = ql.plants.dc_motor(cogging=((7, 0.02, 0.3), (28, 0.01)), **IDEAL)
    shift, load, voltage = 0.4, -0.01, 0.9

    def rate(t: float, x: Any) -> list[float]:
        angle = x[0] + shift
        cogging = 0.02 * math.sin(7 * angle + 0.3) + 0.01 * math.sin(28 * angle)
        return [x[1], (K / R * (voltage - K * x[1]) - C * x[1] - cogging + load) / J]

    states = driven(motor, [voltage] * 200, w=(load, shift))
    found = solve_ivp(rate, (0.0, 0.2), [0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]
    assert abs(found[0]) > 2.0
    np.testing.assert_allclose(states[-1], found, rtol=2e-4)


def test_it_stands_under_less_than_its_stiction_and_does_not_creep() -> None:
    """In the valley of a cogging wave as well; a little more torque and it turns."""
    motor = ql.plants.dc_motor(
        coulomb=0.01, stiction=0.02, cogging=((7, 0.03),), stribeck_speed=1.0, counts=None
    )
    for start in (0.0, 0.05):
        held = 0.03 * math.sin(7 * start)
        for share, stands in ((0.98, True), (1.02, False)):
            voltage = R / K * (held + share * 0.02)
            states = driven(motor, [voltage] * 100, [start, 0.0])
            assert (np.ptp(states[:, 0]) < 1e-12) == stands, (start, share)


def test_friction_falls_from_stiction_to_coulomb() -> None:
    """The torque that turns it at a constant speed is that of Stribeck's curve."""
    motor = ql.plants.dc_motor(coulomb=0.01, stiction=0.03, stribeck_speed=2.0, counts=None)
    for speed in (0.5, -2.0, 8.0):
        friction = 0.01 + 0.02 * math.exp(-((speed / 2.0) ** 2))
        torque = math.copysign(friction, speed) + C * speed
        voltage = R * torque / K + K * speed
        after = driven(motor, [voltage] * 10, [0.0, speed])[-1, 1]
        assert after == pytest.approx(speed, rel=1e-6)


def test_the_table_is_as_good_as_the_waves() -> None:
    """Interpolated within 3e-4 of the amplitude, at any angle, and through given points exactly."""
    motor = ql.plants.dc_motor(cogging=((84, 1.0), (200, 0.5, 1.0)))
    for angle in np.linspace(-20.0, 20.0, 2000):
        exact = math.sin(84 * angle) + 0.5 * math.sin(200 * angle + 1.0)
        assert cogging_torque(motor.cogging, angle) == pytest.approx(exact, abs=4e-4)
    given = [0.1, -0.2, 0.3, 0.4, -0.5]
    table = ql.plants.dc_motor(cogging_map=given).cogging
    for i, torque in enumerate(given):
        assert cogging_torque(table, math.tau * (i / 5 + 3)) == pytest.approx(torque, abs=1e-12)


@pytest.mark.skipif(not RECORD.exists(), reason=f"no measured map at {RECORD}")
def test_a_measured_map_is_felt_at_every_angle() -> None:
    """The voltage of the measured current, and no less, holds the motor at its angle."""
    current = np.genfromtxt(RECORD, delimiter=",", names=True)["current"]
    motor = ql.plants.dc_motor(coulomb=1e-4, cogging_map=K * current, counts=None)
    for count in (0, 1000, 4096, 8100):
        angle = math.tau * count / 8192
        held = driven(motor, [R * current[count // 4]] * 5, [angle, 0.0])
        assert np.ptp(held[:, 0]) < 1e-12
        free = driven(motor, [R * current[count // 4] + 0.01] * 5, [angle, 0.0])
        assert free[-1, 0] > angle


@cases(
    ("wrong", "message"),
    [
        ({"resistance": 0.0}, "resistance = 0.0: must be finite and greater than zero"),
        ({"inductance": -1.0}, "inductance = -1.0: must be finite and greater than zero"),
        ({"inertia": math.nan}, "inertia = nan: must be finite and greater than zero"),
        ({"coulomb": -0.1}, "coulomb = -0.1: must be finite and not negative"),
        ({"stiction": 0.001}, r"stiction = 0.001: must be at least coulomb = 0.01"),
        ({"cogging": 3}, r"cogging = 3: must be pairs \(order, amplitude\)"),
        ({"cogging": ((1.5, 0.1),)}, r"cogging\[0\] = \(1.5, 0.1\): must be \(order, amplitude\)"),
        ({"cogging": ((7,),)}, r"cogging\[0\] = \(7,\): must be \(order, amplitude\)"),
        ({"cogging": ((7, math.inf),)}, r"cogging\[0\]: entry \(1,\) is inf"),
        ({"cogging_map": (0.1, 0.2)}, "cogging_map has 2 torques: must have at least 4"),
        ({"cogging": ((1, 0.1),), "cogging_map": [0.0] * 9}, "cogging and cogging_map: give one"),
        ({"counts": 0}, "counts = 0: must be a whole number of at least 1"),
        ({"voltage_limit": 0.0}, "voltage_limit = 0.0: must be finite and greater than zero"),
    ],
)
def test_a_motor_that_cannot_be_is_refused(wrong: dict[str, Any], message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        ql.plants.dc_motor(**wrong)


def test_a_sample_that_is_too_long_is_refused() -> None:
    """Thousands of sub-steps in a sample would take for ever."""
    with pytest.raises(ValueError, match="dt = 2.0 s: must be at most 1.0 s with friction"):
        ql.plants.dc_motor().sampled(2.0)
