"""Plants: exact sampling, the benchmark's equations, user-given functions."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete

import quell as ql
from quell.plants.base import advance, measure
from quell.plants.linearise import linear_part
from quell.plants.nonlinear import CompiledNonlinear, PythonNonlinear

from .cases import cases

pytestmark = pytest.mark.compiled


def stepped(
    plant: object, dt: float, samples: int, x0: object, u: float = 0.0, w: object = ()
) -> np.ndarray:
    """Advance a plant by hand, interpreted."""
    model = plant.sampled(dt, interpret=True)
    x, scratch = np.array(x0, dtype=float), np.zeros(6 * len(x0))
    for k in range(samples):
        advance(model, x, scratch, k * dt, u, np.array(w, dtype=float))
    return x


def test_a_linear_plant_is_sampled_exactly(rng: np.random.Generator) -> None:
    """As scipy's cont2discrete, for every input, of any size."""
    for n, m in ((1, 1), (3, 0), (6, 4)):
        A, B, E = rng.normal(size=(n, n)), rng.normal(size=n), rng.normal(size=(n, m))
        model = ql.plants.LinearPlant(A, B, np.ones(n), E).sampled(0.05)
        both = np.hstack([B[:, None], E])
        phi, gamma, *_ = cont2discrete((A, both, np.eye(n), np.zeros_like(both)), 0.05)
        np.testing.assert_allclose(model.transition, phi, atol=1e-13)
        np.testing.assert_allclose(
            np.hstack([model.input[:, None], model.disturbance]), gamma, atol=1e-13
        )


def test_the_two_mass_spring_obeys_newton(rng: np.random.Generator) -> None:
    """Forces over masses, both disturbance forces, both outputs."""
    m1, m2, k = 0.7, 1.9, 2.3
    plant = ql.plants.two_mass_spring(m1, m2, k, c1=2.0, c2=-1.0)
    x, u, w = rng.normal(size=4), 0.4, rng.normal(size=2)
    spring = k * (x[1] - x[0])
    expected = [x[2], x[3], (spring + u + w[0]) / m1, (-spring + w[1]) / m2]
    np.testing.assert_allclose(plant.A @ x + plant.B[:, 0] * u + plant.E @ w, expected)
    assert measure(plant.sampled(1e-3), x) == pytest.approx(2.0 * x[0] - x[1])


def test_the_two_mass_spring_keeps_its_energy() -> None:
    """It has no friction: after 100 s the energy is what it was, to rounding."""
    plant = ql.plants.two_mass_spring(1.0, 2.0, 3.0)

    def energy(x: np.ndarray) -> float:
        return 0.5 * (x[2] ** 2 + 2.0 * x[3] ** 2 + 3.0 * (x[0] - x[1]) ** 2)

    x0 = np.array([1.0, -0.5, 0.3, 0.2])
    assert energy(stepped(plant, 0.01, 10_000, x0, w=(0.0, 0.0))) == pytest.approx(
        energy(x0), rel=1e-10
    )


def pendulum(t: float, x: np.ndarray, u: float, w: np.ndarray) -> tuple[float, float]:
    """A driven pendulum with friction and a disturbance torque."""
    return x[1], u + w[0] - math.sin(x[0]) - 0.1 * x[1]


def test_a_nonlinear_plant_follows_its_equation_with_order_four() -> None:
    """Against scipy's integrator; halving the sub-step divides the error by about 16."""
    truth = solve_ivp(
        lambda t, x: pendulum(t, x, 0.3, [0.2]), (0.0, 4.0), [1.0, 0.0], rtol=1e-12, atol=1e-12
    ).y[:, -1]
    errors = [
        np.max(
            np.abs(
                stepped(
                    ql.plants.NonlinearPlant(pendulum, order=2, substeps=n),
                    0.4,
                    10,
                    (1.0, 0.0),
                    0.3,
                    (0.2,),
                )
                - truth
            )
        )
        for n in (1, 2, 4)
    ]
    assert errors[0] < 1e-2
    for coarse, fine in pairwise(errors):
        assert 11.0 < coarse / fine < 22.0


@pytest.mark.trial
def test_a_nonlinear_plant_with_a_linear_equation_is_the_linear_plant() -> None:
    """The limit case: the same run, to the accuracy of Runge-Kutta."""
    linear = ql.plants.two_mass_spring()
    A, B, E = linear.A, linear.B[:, 0], linear.E
    plant = ql.plants.NonlinearPlant(
        lambda t, x, u, w: A @ x + B * u + E @ w,
        order=4,
        output=[0.0, 1.0, 0.0, 0.0],
        disturbances=2,
    )
    controller = ql.ADRC(ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-2), omega_c=1.0)
    scenario = ql.Scenario(
        reference=1.0, duration=20.0, disturbances=(0.0, ql.signals.Step(at=10.0))
    )
    one, other = (ql.simulate(p, controller, scenario, interpret=True) for p in (linear, plant))
    np.testing.assert_allclose(one["y"], other["y"], atol=1e-8)


@pytest.mark.trial
def test_functions_that_return_tuples_lists_or_arrays_are_compiled() -> None:
    """And so is an output function; compiled and interpreted steps agree."""
    for f in (
        pendulum,
        lambda t, x, u, w: [x[1], u + w[0] - math.sin(x[0]) - 0.1 * x[1]],
        lambda t, x, u, w: np.array([x[1], u + w[0] - math.sin(x[0]) - 0.1 * x[1]]),
    ):
        plant = ql.plants.NonlinearPlant(f, order=2, output=lambda x: 2.0 * x[0])
        model = plant.sampled(0.01)
        assert isinstance(model, CompiledNonlinear)
        assert measure(model, np.array([1.5, 0.0])) == 3.0
        python = PythonNonlinear(f, lambda x: 2.0 * x[0], model.step, model.substeps)
        x, same = np.array([1.0, 0.2]), np.array([1.0, 0.2])
        advance(model, x, np.zeros(12), 0.0, 0.5, np.zeros(1))
        advance(python, same, np.zeros(12), 0.0, 0.5, np.zeros(1))
        np.testing.assert_allclose(x, same, rtol=1e-14)


def test_a_function_numba_cannot_compile_runs_as_python_and_says_so() -> None:
    """Slow, but right, and with the reason."""
    table = {"stiffness": 4.0}
    plant = ql.plants.NonlinearPlant(
        lambda t, x, u, w: [x[1], u - table.get("stiffness") * x[0]], order=2, name="spring"
    )
    with pytest.warns(
        UserWarning, match="spring: f or output can't be compiled and runs as Python"
    ):
        assert not plant.compiled
    controller = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01), omega_c=4.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = ql.simulate(plant, controller, ql.Scenario(reference=1.0, duration=5.0))
    assert run["y"][-1] == pytest.approx(1.0, abs=0.01)


@pytest.mark.trial
@pytest.mark.lost
def test_a_division_by_zero_in_compiled_code_ends_the_run() -> None:
    """It gives inf, as in numpy; the run diverged, and a warning says where; nothing is swallowed."""
    plant = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u - 1.0 / (x[0] - 0.5)), order=2)
    controller = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01), omega_c=4.0)
    with pytest.warns(
        ql.DesignWarning, match=r"not finite; .* t = 0.01 s. .* state was \[0.5, 0.0"
    ):
        run = ql.simulate(plant, controller, ql.Scenario(0.5, 5.0, x0=[0.5, 0.0]))
    assert run.diverged
    assert run.ended == 0.01


def test_interpreting_runs_the_users_function_as_python() -> None:
    """So that a debugger stops in it."""
    seen = []

    def rate(t: float, x: np.ndarray, u: float, w: np.ndarray) -> tuple[float, float]:
        seen.append(type(x))
        return x[1], u - x[0]

    plant = ql.plants.NonlinearPlant(rate, order=2)
    controller = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01), omega_c=4.0)
    seen.clear()
    ql.simulate(plant, controller, ql.Scenario(1.0, 0.1), interpret=True)
    assert len(seen) >= 4 * 11  # its linearisation and the check of the integration call it, too
    assert set(seen) == {np.ndarray}


def friction(width: float) -> Callable[..., tuple[float, float]]:
    """The equation of a mass with friction 2 tanh(v/width)."""
    return lambda t, x, u, w: (x[1], u + w[0] - 2.0 * math.tanh(x[1] / width))


def test_substeps_follow_the_fastest_mode_at_rest() -> None:
    """One where the plant is slow, ``h |λ| <= 1`` where it is fast; a jump has no such number."""

    def chosen(f: Callable[..., Any], dt: float = 1e-3) -> int:
        return ql.plants.NonlinearPlant(f, order=2).sampled(dt, interpret=True).substeps

    assert chosen(pendulum) == 1
    assert chosen(lambda t, x, u, w: (x[1], u - 1e5 * x[1])) == 100
    assert chosen(lambda t, x, u, w: (x[1], u - 9e8 * x[0])) == 30  # 3e4 rad/s, undamped
    assert [chosen(friction(width)) for width in (0.1, 0.002, 0.001, 0.0001)] == [1, 1, 2, 20]
    assert chosen(friction(0.001), 1e-2) == 20
    assert chosen(lambda t, x, u, w: (x[1], u - np.sign(x[1]))) == 1
    assert chosen(lambda t, x, u, w: (x[1], u - math.log(x[0]))) == 1  # no number at rest
    given = ql.plants.NonlinearPlant(friction(0.001), order=2, substeps=3)
    model = given.sampled(1e-3, interpret=True)
    assert (model.substeps, model.step) == (3, 1e-3 / 3)
    with pytest.warns(ql.DesignWarning, match=r"eigenvalue of 1e\+07 1/s .* needs? .*1e\+04 sub-s"):
        assert chosen(lambda t, x, u, w: (x[1], u - 1e7 * x[1])) == 1000


def test_methods_and_callable_objects_are_served_too() -> None:
    """As Python."""

    class Spring:
        def rate(self, t: float, x: np.ndarray, u: float, w: np.ndarray) -> tuple[float, float]:
            return x[1], u - 4.0 * x[0]

    with pytest.warns(UserWarning, match="runs as Python"):
        assert not ql.plants.NonlinearPlant(Spring().rate, order=2).compiled


@cases(
    ("make", "message"),
    [
        (
            lambda: ql.plants.two_mass_spring(m1=-1.0),
            "m1 = -1.0: must be finite and greater than zero",
        ),
        (lambda: ql.plants.two_mass_spring(k=0.0), "k = 0.0: must be finite and greater than zero"),
        (lambda: ql.plants.two_mass_spring(c2=0.0), "nothing is measured"),
        (
            lambda: ql.plants.LinearPlant(np.eye(2), [1.0], [1.0, 0.0]),
            r"B has shape \(1, 1\), A \(2, 2\): must be a matrix of shape \(2, 1\)",
        ),
        (
            lambda: ql.plants.LinearPlant(np.zeros((2, 3)), [1.0, 0.0], [1.0, 0.0]),
            r"A has shape \(2, 3\)",
        ),
        (lambda: ql.plants.LinearPlant([[np.nan]], [1.0], [1.0]), r"A: entry \(0, 0\) is nan"),
        (
            lambda: ql.plants.LinearPlant(np.eye(1), [1.0], [1.0]).sampled(0.0),
            "dt = 0.0: must be finite and greater than zero",
        ),
        (
            lambda: ql.plants.two_mass_spring(k=1e300).sampled(0.01),
            r"dt = 0.01 s: two-mass-spring can't be sampled with it, exp\(A dt\) is beyond all",
        ),
        (
            lambda: ql.plants.NonlinearPlant(pendulum, order=3),
            r"f returns shape \(2,\): must return the 3 derivatives",
        ),
        (
            lambda: ql.plants.NonlinearPlant(pendulum, order=2, output=[1.0]),
            r"output has shape \(1,\)",
        ),
        (
            lambda: ql.plants.NonlinearPlant(pendulum, order=2, output=lambda x: None),
            r"output\(x\) returns None: must return one number",
        ),
        (
            lambda: ql.plants.LinearPlant.of((np.eye(2), [[0.0, 1.0], [1.0]], [1.0, 0.0])),
            "B: must be an array of numbers, got list",
        ),
        (
            lambda: ql.plants.NonlinearPlant(pendulum, order=2, substeps=0),
            "substeps = 0: must be a whole number of at least 1",
        ),
        (lambda: ql.plants.NonlinearPlant(3.0, order=2), r"f = 3.0: must be a function"),
        (
            lambda: ql.plants.NonlinearPlant(lambda t, x: x, order=2),
            r"f\(0.0, zeros, 0.0, zeros\) fails with TypeError",
        ),
        (
            lambda: ql.plants.NonlinearPlant(lambda t, x, u, w: (x[5], u), order=2),
            "fails with IndexError",
        ),
        (
            lambda: ql.plants.NonlinearPlant(pendulum, order=2, output=lambda x: [[x[0]]]),
            r"output\(x\) returns shape \(1, 1\): must return one number, or a vector",
        ),
    ],
)
def test_a_mistake_is_named(make: object, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


@pytest.mark.parametrize("delay", [0.0025, 0.0125, 0.03])
def test_a_delay_with_a_part_of_a_sample_is_exact_for_a_held_control_signal(
    delay: float, rng: np.random.Generator
) -> None:
    """As a plant of a quarter of the sample time with a whole number of samples of delay; analysis sees the same delay."""
    inner = ql.plants.LinearPlant([[0.0, 1.0], [-2.0, -0.3]], [0.0, 1.5], [1.0, 0.0])
    late, fine = ql.plants.delayed(inner, delay, 0.01), ql.plants.delayed(inner, delay, 0.0025)
    assert late.delay == pytest.approx(delay)
    coarse_model, fine_model = late.sampled(0.01), fine.sampled(0.0025)
    x, z = np.zeros(late.order), np.zeros(fine.order)
    scratch, w = np.zeros(6 * z.size), np.zeros(1)
    for u, w[0] in rng.normal(size=(40, 2)):
        advance(coarse_model, x, scratch, 0.0, u, w)
        for _ in range(4):
            advance(fine_model, z, scratch, 0.0, u, w)
        np.testing.assert_allclose(x[:2], z[:2], rtol=0.0, atol=1e-13)
    assert linear_part(late, 0.01)[1] == pytest.approx(delay)


def test_a_delay_with_a_part_of_a_sample_of_another_plant_is_refused_with_the_remedy() -> None:
    """A nonlinear plant takes whole samples, and so does an observer."""
    swing = ql.plants.NonlinearPlant(lambda t, x, u, w: (x[1], u - x[0]), order=2)
    with pytest.raises(ValueError, match=r"nearest are 0.01 and 0.02 s, for a plant that is not"):
        ql.plants.delayed(swing, 0.0125, 0.01)
    with pytest.raises(ValueError, match=r"0.02 s; give the observer the nearer one"):
        ql.ESO.model_free(2, 1.0, 10.0, 0.01, delay=0.0125)
