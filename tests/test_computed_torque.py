"""Computed torque and adaptive control of an arm, the baselines of docs/axes (benchmarks/computed_torque.py)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import quell as ql

from .benchmark_module import benchmark

pytestmark = pytest.mark.trial


@pytest.fixture(scope="module")
def arms() -> Any:
    """The module of the benchmark."""
    return benchmark("computed_torque")


def test_the_arm_of_the_benchmark_moves_as_quells(arms: Any) -> None:
    """Its accelerations are those of ``plants.arm`` and of the equations that are linear in the numbers, to rounding."""
    plant: Any = ql.plants.arm(arms.LENGTHS, arms.MASSES, viscous=arms.VISCOUS)
    rng, p = np.random.default_rng(0), arms.numbers()
    for _ in range(20):
        x, u = rng.normal(size=4), 10.0 * rng.normal(size=2)
        found = np.array(arms.accelerations(p.tolist(), x.tolist(), u))
        wanted = plant.f(0.0, x, u, np.zeros(2), **plant.parameters)
        np.testing.assert_allclose(found, wanted, rtol=1e-10, atol=1e-10)
        q, dq = x[:2], x[2:]
        torques = arms.regressor(q, dq, dq, found[2:]) @ p
        np.testing.assert_allclose(torques, u, rtol=1e-9, atol=1e-9)


def test_computed_torque_is_exact_with_the_exact_model_and_an_integrator_forgives_a_wrong_one(
    arms: Any,
) -> None:
    """The errors of shoulder and elbow in the second of two seconds: below 5 mrad; 20 % off 20 times as large, a third of it with the integrator."""

    def late(kind: str, shares: Any) -> Any:
        controller = arms.ModelBased(kind, arms.numbers(shares), 8.0)
        return np.array(arms.run(controller, 2.0)["late [mrad]"])

    off = arms.MODELS["20 % off"]
    exact, wrong, forgiven = (
        late("computed torque", (1.0, 1.0)),
        late("computed torque", off),
        late("with integrator", off),
    )
    assert np.all(exact < 5.0)
    assert np.all(wrong > 20.0 * exact)
    assert np.all(forgiven < 0.35 * wrong)


def test_adaptive_control_finds_what_a_wrong_model_lacks(arms: Any) -> None:
    """From a model 20 % off it leaves less than a fifth of computed torque, and after four seconds knows the forearm's weight to 2 %."""
    off = arms.MODELS["20 % off"]
    adaptive = arms.ModelBased("adaptive", arms.numbers(off), 8.0)
    fixed = arms.ModelBased("computed torque", arms.numbers(off), 8.0)
    errors = [np.array(arms.run(each, 4.0)["late [mrad]"]) for each in (adaptive, fixed)]
    assert np.all(errors[0] < 0.2 * errors[1])
    assert adaptive.p[4] == pytest.approx(arms.numbers()[4], rel=0.02)  # the weight of the forearm
