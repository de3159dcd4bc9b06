"""The cascade of servo drives: its equations, its feedforward, its tuning."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers.baselines import PPI, Notch
from quell.setup import load

from .cases import cases

DT = 2.5e-4
JM, JL = 3.2e-4, 9.5e-4
GAINS: dict[str, Any] = {"kv": 50.0, "kp": 0.1, "tn": 0.02, "tf": 1e-3, "dt": DT}
NOTCHES = [Notch.at(860.0, depth=0.2, width=0.8), Notch.at(3000.0)]


def axis(sensor: int = 1) -> ql.plants.LinearPlant:
    """Motor and load on a damped coupling."""
    return ql.plants.n_mass([JM, JL], [180.0], [0.02], sensor=sensor)


def test_its_feedback_is_that_of_the_docstring() -> None:
    """At low frequencies and at the centre of a notch, where sampling does not move it."""
    loop = ql.analysis.analyse(axis(), PPI(notches=NOTCHES, **GAINS))
    for omega in (5.0, 860.0):
        s = 1j * omega
        expected = 0.1 * (1.0 + 1.0 / (0.02 * s)) * (50.0 + s / (1.0 + 1e-3 * s))
        for notch in NOTCHES:
            top, bottom = notch.polynomials()
            expected *= np.polyval(top, s) / np.polyval(bottom, s)
        found = loop.response("L", [omega])[0]
        states = np.linalg.solve(s * np.eye(4) - axis().A, axis().B)
        P = (axis().C @ states)[0, 0] * np.exp(-0.5 * s * DT)  # the hold
        assert found == pytest.approx(expected * P, rel=0.02)


def test_without_a_filter_the_speed_is_the_difference_of_two_samples() -> None:
    """A ramp of y of one count a sample gives K_p/dt per count, at once and for ever."""
    drive = PPI(kv=1e-9, kp=0.1, tn=1e9, dt=DT)
    drive.step(0.0, 0.0)
    found = [drive.step(0.0, 1e-3 * k) for k in (1.0, 2.0, 3.0)]
    np.testing.assert_allclose(found, -0.1 * 1e-3 / DT, rtol=1e-6)


def test_feedforward_follows_a_smooth_move_of_a_rigid_axis() -> None:
    """With the inertia and the friction of the axis the error is a hundredth of that without."""
    plant = ql.plants.n_mass([JM + JL], [], ground=[0.01])
    move = ql.signals.SmoothMove(distance=1.5, duration=0.12, smoothness=3, start=0.02)
    scenario = ql.Scenario(reference=move, disturbances=(0.0,), duration=0.2)
    errors = []
    for more in ({}, {"inertia": JM + JL, "viscous": 0.01}):
        run = ql.simulate(plant, PPI(**GAINS, **more), scenario, interpret=True)
        errors.append(np.max(np.abs(run["r"] - run["y"])))
    assert errors[1] < 0.01 * errors[0]


@cases(
    ("change", "message"),
    [
        ({"kv": 0.0}, "kv = 0"),
        ({"kp": 0.0}, "kp = 0"),
        ({"tn": -1.0}, "tn = -1"),
        ({"tf": 1e-5}, r"tf = 1e-05 s with dt = 0\.00025 s: must be at least dt/2"),
        ({"notches": Notch.at(9.0)}, "must be a list"),
        ({"notches": [9.0]}, r"notches\[0\] = 9\.0: must be from"),
        ({"notches": [Notch.at(20_000.0)]}, r"notches\[0\] at 20000.*must be below pi/dt"),
        ({"viscous": 0.1}, "viscous = 0.1: goes with inertia"),
    ],
)
def test_arguments_out_of_range_are_refused(change: dict[str, Any], message: str) -> None:
    """The error names the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        PPI(**GAINS | change)


@pytest.mark.trial
@pytest.mark.parametrize("sensor", [1, 2])
def test_it_is_tuned_within_its_bounds_on_a_flexible_axis(sensor: int, tmp_path: Any) -> None:
    """The whole loop has the M_s asked for, and more k_i than PID, which has no notch.

    The file of the result makes the same controller, feedforward included.
    """
    bounds = ql.tuning.Constraints(noise_over_pi=None)
    tuned = ql.tune(
        axis(sensor),
        DT,
        structure="p-pi-notch",
        compare=("pid",),
        delay=DT,
        constraints=bounds,
        feedforward=True,
    )
    loop = ql.analysis.analyse(axis(sensor), tuned.controller, delay=DT)
    assert loop.stable
    assert 1.0 / loop.margins.modulus <= 1.6 * 1.002
    assert tuned.design.k_i > 1.5 * tuned.designs["pid"].k_i
    controller: Any = tuned.controller
    assert controller.ki == pytest.approx(tuned.design.k_i)
    assert controller.inertia == pytest.approx(JM + JL, rel=1e-6)
    assert len(controller.notches) == 1
    tuned.save(tmp_path / "axis.toml")
    again: Any = load(tmp_path / "axis.toml").controller
    np.testing.assert_array_equal(again.law.A, controller.law.A)
    np.testing.assert_array_equal(again.law.B_r, controller.law.B_r)


@pytest.mark.trial
def test_a_plant_without_resonance_gets_no_notch() -> None:
    """It is then the plain cascade, with the friction of a motor as its feedforward."""
    motor = ([50.0], [1.0, 4.0, 0.0])
    how: dict[str, Any] = {"structure": "p-pi-notch", "compare": ()}
    controller: Any = ql.tune(motor, 1e-3, **how).controller
    assert controller.notches == ()
    assert controller.inertia is None
    moving: Any = ql.tune(motor, 1e-3, feedforward=True, **how).controller
    assert moving.inertia == pytest.approx(1.0 / 50.0)
    assert moving.viscous == pytest.approx(4.0 / 50.0)
