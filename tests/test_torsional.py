"""The torsional twin: its equations, its friction, what its drive and its encoder do to u and y."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import quell as ql
from quell.experiments import torsional as study
from quell.experiments.common import Claim
from quell.kernels import dispatch
from quell.kernels.dispatch import compiled, interpreted
from quell.plants.base import advance, measure

from .cases import cases

DT = 1e-3
IDEAL: dict[str, Any] = {
    "lower_coulomb": 0.0,
    "upper_coulomb": 0.0,
    "dac_bits": None,
    "counts": None,
    "current_limit": 1e6,
}


@compiled
def sample_by_sample(
    model: Any, x: Any, scratch: Any, u: Any, w: Any, states: Any, outputs: Any
) -> None:
    """Run a plant outside of a loop, as a rig does."""
    for k in range(u.size):
        outputs[k] = measure(model, x)
        for i in range(x.size):
            states[k, i] = x[i]
        advance(model, x, scratch, 0.0, u[k], w)


def record(
    plant: Any, u: Any, x0: Any = None, dt: float = DT, w: Any = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Return states and outputs before each sample of ``u``."""
    u, w = np.array(u, dtype=float), np.array(w)[: plant.disturbances]
    states, outputs = np.empty((u.size, plant.order)), np.empty(u.size)
    x = np.zeros(plant.order) if x0 is None else np.array(x0, dtype=float)
    scratch = np.zeros(6 * plant.order)
    entry = interpreted(sample_by_sample) if dispatch.interpret_all else sample_by_sample
    entry(plant.sampled(dt), x, scratch, u, w, states, outputs)
    return states, outputs


def test_without_friction_and_rounding_it_is_its_linear_plant(rng: np.random.Generator) -> None:
    """To rounding, with any u and torque on the disks."""
    twin, u, x0 = ql.plants.torsional(**IDEAL), rng.normal(size=500), rng.normal(size=4)
    states, outputs = record(twin, u, x0, w=(0.01, -0.02))
    expected, angle = record(twin.linear, u, x0, w=(0.01, -0.02))
    np.testing.assert_allclose(states, expected, rtol=1e-12)
    np.testing.assert_allclose(outputs, angle, rtol=1e-12)


def test_it_obeys_newton(rng: np.random.Generator) -> None:
    """Torques over inertias; the motor's inertia counts by the square of the belt's ratio."""
    twin = ql.plants.torsional(
        0.01, 0.002, 1e-4, 2.0, 2.0, 0.003, 0.02, 0.001, torque_constant=0.1, amplifier=1.5
    ).linear
    x, u, w = rng.normal(size=4), 0.7, rng.normal(size=2)
    shaft = 2.0 * (x[0] - x[1]) + 0.003 * (x[2] - x[3])
    lower = (2.0 * 0.1 * 1.5 * u - shaft - 0.02 * x[2] + w[0]) / (0.01 + 4.0 * 1e-4)
    upper = (shaft - 0.001 * x[3] + w[1]) / 0.002
    np.testing.assert_allclose(
        twin.A @ x + twin.B[:, 0] * u + twin.E @ w, [x[2], x[3], lower, upper]
    )


def test_its_defaults_are_the_identified_plant() -> None:
    """Gain and coefficients within 0.01 %, but for the integrator that stands for 0.1032."""
    twin, identified = ql.plants.torsional().linear, ql.plants.torsional_identified()
    coefficients = np.poly(twin.A)
    np.testing.assert_allclose(coefficients[1:4], [1.901, 1683.0, 1812.0], rtol=1e-4)
    assert abs(coefficients[4]) < 1e-9
    gain = float((twin.C @ np.linalg.matrix_power(twin.A, 3) @ twin.B)[0, 0])
    assert gain == pytest.approx(4.6e4, rel=1e-4)
    np.testing.assert_allclose(
        np.poly(identified.A), [1.0, 1.901, 1683.0, 1812.0, 0.1032], rtol=1e-10
    )
    response = [
        complex((p.C @ np.linalg.solve(10j * np.eye(4) - p.A, p.B))[0, 0])
        for p in (twin, identified)
    ]
    assert response[0] == pytest.approx(response[1], rel=2e-4)


@pytest.mark.compiled
def test_friction_only_takes_energy() -> None:
    """A twisted shaft let go: the energy never grows, and both disks stand in the end."""
    twin = ql.plants.torsional()
    states, _ = record(twin, np.zeros(15_000), [0.0, 0.3, 1.0, -2.0])
    kinetic = 0.5 * (0.0192 * states[:, 2] ** 2 + 0.0019 * states[:, 3] ** 2)
    energy = kinetic + 0.5 * 2.908 * (states[:, 0] - states[:, 1]) ** 2
    assert np.all(np.diff(energy) <= 1e-9 * energy[0])
    assert energy[0] > 1e3 * energy[-1]
    assert np.max(np.abs(states[-1, 2:])) < 1e-12


@pytest.mark.compiled
def test_a_free_disk_stops_when_and_where_coulomb_says() -> None:
    """Both disks together, without viscous friction: stop after ``ω0² J / 2C`` and ``ω0 J / C``."""
    inertia, coulomb, speed = np.array([0.0192, 0.0019]), 0.02, 3.0
    each = coulomb * inertia / inertia.sum()  # decelerates both alike, so the shaft stays straight
    twin = ql.plants.torsional(
        lower_viscous=0.0,
        upper_viscous=0.0,
        lower_coulomb=each[0],
        upper_coulomb=each[1],
        counts=None,
    )
    states, _ = record(twin, np.zeros(5000), [0.0, 0.0, speed, speed])
    time = speed * inertia.sum() / coulomb
    assert states[int(time / DT) - 2, 2] > 0.0
    assert states[int(time / DT) + 2, 2] == pytest.approx(0.0, abs=1e-12)
    assert states[-1, 1] == pytest.approx(0.5 * speed * time, rel=1e-4)


@pytest.mark.compiled
def test_it_sticks_below_its_breakaway_torque_and_moves_above() -> None:
    """A minute just below: not a trace of creep. Just above: off, and away."""
    volts = 0.01 / (3.0 * 0.09617 * 2.0)
    held, _ = record(ql.plants.torsional(), np.full(60_000, 0.99 * volts))
    assert np.max(np.abs(held[-1])) < 1e-12
    moved, _ = record(ql.plants.torsional(upper_coulomb=0.0), np.full(2000, 1.02 * volts))
    assert moved[-1, 0] > 1e-3


@pytest.mark.compiled
def test_it_sticks_under_a_torque_on_the_disk_too() -> None:
    """The disturbance inputs are torques [N m] on the lower and the upper disk."""
    for w, sticks in (
        ((0.0099, 0.0), True),
        ((0.0, 0.00099), True),
        ((0.0103, 0.0), False),
        ((0.0, 0.0013), False),
    ):
        states, _ = record(ql.plants.torsional(), np.zeros(3000), w=w)
        assert (np.max(np.abs(states[-1])) < 1e-9) == sticks, w


@pytest.mark.compiled
def test_a_steady_speed_costs_coulomb_and_viscous_friction() -> None:
    """Torque at constant speed: ``C1 + C2 + (c1 + c2) ω``."""
    u = 0.1
    states, _ = record(ql.plants.torsional(dac_bits=None), np.full(20_000, u))
    speed = (3.0 * 0.09617 * 2.0 * u - 0.011) / (0.02122 + 0.001512)
    np.testing.assert_allclose(states[-1, 2:], speed, rtol=1e-5)


@pytest.mark.trial
def test_its_friction_agrees_with_an_independent_solution() -> None:
    """Against Runge-Kutta on ``C tanh(ω/ε)`` with a tiny ε, through several reversals."""
    twin = ql.plants.torsional(dac_bits=None, counts=None)
    A, B = twin.linear.A, twin.linear.B[:, 0]
    samples = 1500
    u = 0.15 * np.sin(8.0 * np.arange(samples) * DT)

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        dx = A @ x + B * u[min(int(t / DT + 1e-9), samples - 1)]
        dx[2] -= 0.01 / 0.0192 * math.tanh(x[2] / 1e-3)
        dx[3] -= 0.001 / 0.0019 * math.tanh(x[3] / 1e-3)
        return dx

    exact = solve_ivp(
        rate,
        (0.0, (samples - 1) * DT),
        np.zeros(4),
        method="LSODA",
        max_step=DT,
        rtol=1e-7,
        atol=1e-10,
    )
    states, _ = record(twin, u)
    np.testing.assert_allclose(
        states[-1, :2], exact.y[:2, -1], atol=2e-3 * np.max(np.abs(exact.y[:2]))
    )


@pytest.mark.compiled
def test_halving_the_sample_time_changes_little() -> None:
    """Sub-steps are of one length, whatever dt: stops are found within one of them."""
    rough, _ = record(
        ql.plants.torsional(), np.repeat(0.1 * np.sin(5.0 * np.arange(400) * 5e-3), 1), dt=5e-3
    )
    fine, _ = record(
        ql.plants.torsional(), np.repeat(0.1 * np.sin(5.0 * np.arange(400) * 5e-3), 5), dt=1e-3
    )
    np.testing.assert_allclose(rough, fine[::5], atol=1e-9)


@pytest.mark.compiled
def test_the_encoder_counts() -> None:
    """Y is the nearest whole count, of either sign: at most half a count from the angle."""
    states, y = record(ql.plants.torsional(counts=1000), 0.3 * np.sin(np.arange(3000) * DT * 4.0))
    counts = y / (math.tau / 1000)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.max(np.abs(y - states[:, 1])) <= 0.5 * math.tau / 1000 * (1.0 + 1e-9)
    assert np.unique(np.round(counts)).size > 20


def test_any_plant_can_have_an_encoder() -> None:
    """The wrapper quantizes the output of an unchanged plant; the twin's encoder is the same."""
    plain, u = ql.plants.torsional_identified(), 0.2 * np.ones(400)
    states, y = record(plain, u)
    seen_states, seen = record(ql.plants.encoded(plain, 16_000), u)
    np.testing.assert_array_equal(states, seen_states)
    np.testing.assert_allclose(
        seen, np.floor(y * 16_000 / math.tau + 0.5) * math.tau / 16_000, atol=1e-15
    )
    bare, x0 = ql.plants.torsional(counts=None), [0.1, 0.2, 0.3, 0.4]
    np.testing.assert_array_equal(
        record(ql.plants.encoded(bare, 16_000), u, x0)[1], record(ql.plants.torsional(), u, x0)[1]
    )


def test_the_converter_has_steps_and_a_range() -> None:
    """Less than half a step does nothing; beyond the range u is as at its end."""
    twin = ql.plants.torsional(**IDEAL | {"dac_bits": 8})
    step = 20.0 / 256
    assert twin.step == step
    for u, applied in (
        (0.49 * step, 0.0),
        (0.51 * step, step),
        (-3.4 * step, -3.0 * step),
        (50.0, 10.0),
        (-50.0, -10.0),
    ):
        np.testing.assert_allclose(
            record(twin, [u, 0.0])[0][1], record(twin.linear, [applied, 0.0])[0][1], atol=1e-15
        )


def test_the_current_is_limited() -> None:
    """Beyond ``i_max / k_a`` volts the torque grows no more."""
    twin = ql.plants.torsional(**IDEAL | {"current_limit": 3.0})
    assert twin.u_max == 1.5
    np.testing.assert_allclose(
        record(twin, [9.0, 0.0])[0][1], record(twin.linear, [1.5, 0.0])[0][1], rtol=1e-12
    )


def test_u_can_be_late(rng: np.random.Generator) -> None:
    """By whole samples; the u under way are states behind the disks'."""
    u = 0.3 * rng.normal(size=300)
    late = ql.plants.torsional(late=3)
    assert late.order == 7
    states, y = record(late, u)
    shifted, expected = record(ql.plants.torsional(), np.concatenate([np.zeros(3), u[:-3]]))
    np.testing.assert_array_equal(states[:, :4], shifted)
    np.testing.assert_array_equal(y, expected)


@cases(
    ("wrong", "message"),
    [
        ({"stiffness": 0.0}, "stiffness = 0.0: must be finite and greater than zero"),
        ({"lower_inertia": -1.0}, "lower_inertia = -1.0: must be finite and greater than zero"),
        ({"upper_coulomb": -0.1}, "upper_coulomb = -0.1: must be finite and not negative"),
        ({"dac_bits": 1}, "dac_bits = 1: must be a whole number from 2 to 32"),
        ({"counts": 0}, "counts = 0: must be a whole number of at least 1"),
        ({"late": 0.5}, "late = 0.5: must be a whole number"),
        (
            {"current_limit": float("nan")},
            "current_limit = nan: must be finite and greater than zero",
        ),
    ],
)
def test_a_wrong_parameter_is_named(wrong: dict[str, Any], message: str) -> None:
    """With its value and the rule."""
    with pytest.raises(ValueError, match=message.replace(".", r"\.")):
        ql.plants.torsional(**wrong)


def test_only_a_plant_can_have_an_encoder() -> None:
    """And at least one count."""
    with pytest.raises(ValueError, match="plant = 3: must be a plant"):
        ql.plants.encoded(3, 100)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"counts = 0\.5: must be a whole number"):
        ql.plants.encoded(ql.plants.torsional_identified(), 0.5)  # type: ignore[arg-type]


def test_a_figure_is_judged_against_anothers() -> None:
    """It holds if it is at most the other value, or the other is missing; not if it is missing."""
    judged = [
        Claim.at_most("a", "best", *values).holds
        for values in ((1.0, 1.0), (1.1, 1.0), (1.0, None), (None, 1.0))
    ]
    assert judged == [True, False, True, False]


@pytest.mark.lost
def test_a_record_that_ends_early_has_no_score() -> None:
    """Rather None than the figures of a part."""
    law, course = (
        study.controllers(study.Settings(), 20.0, 90.0)[study.MF],
        study.scenarios(study.Settings(), study.LINEAR)[0],
    )
    early = ql.simulate(study.plant(study.LINEAR), law, course, limit=1.0)
    assert early.diverged
    assert set(study.score(early).values()) == {None}


def test_the_starts_lie_between_two_edges_and_follow_the_seed() -> None:
    """Half a count to either side, both disks alike; the same seed, the same starts."""
    starts = {
        seed: [course.x0 for course in study.scenarios(study.Settings(seed=seed), study.FRICTION)]
        for seed in (0, 1)
    }
    again = [course.x0 for course in study.scenarios(study.Settings(), study.FRICTION)]
    np.testing.assert_array_equal(starts[0], again)
    assert np.any(np.array(starts[0]) != np.array(starts[1]))
    for x0 in starts[0]:
        assert abs(x0[1]) <= 0.5 * math.tau / study.COUNTS
        assert x0[0] == x0[1]
