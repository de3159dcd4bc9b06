"""Blocks of features, each against a direct formula."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import numba
import numpy as np
import pytest

import quell as ql
from quell.features import (
    RBF,
    Bias,
    Custom,
    Friction,
    Input,
    Periodic,
    Polynomial,
    RandomFourier,
    State,
)
from quell.features.base import unit, write, write_physical
from quell.learners.base import adapt, coefficients, commit, lag_push, predict

from .cases import cases

STATE, U = np.array([0.3, -0.7, 0.5]), 0.2


def halves(x: np.ndarray, u: float) -> tuple[float, float]:
    """A user's function, which can be sent to other processes."""
    return 0.5 * x[0], x[1] * u


BLOCKS: dict[str, Any] = {
    "state": State(),
    "two states": State(2),
    "bias": Bias(),
    "input": Input(),
    "polynomial": Polynomial(3),
    "polynomial of some": Polynomial(4, states=(3, 1)),
    "friction": Friction(),
    "friction of all": Friction(sign=True, states=(2, 3)),
    "friction at a speed": Friction(sign=True, speed=0.4),
    "fourier": RandomFourier(20),
    "rbf": RBF(),
    "rbf around centres": RBF(centers=[[0.0], [0.5]], states=(2,)),
    "custom": Custom(halves, ("half", "product")),
    "periodic": Periodic(period=0.7, orders=(1, 2, 5), state=2),
    "joined": State() + Periodic(highest=3) + RBF(9) + Input(),
}


def written(block: Any, x: np.ndarray = STATE, u: float = U) -> np.ndarray:
    """The features' values; room around them must stay as it was."""
    width = len(block.names(x.size))
    room = np.full(width + 2, np.nan)
    before = x.copy()
    for function in (write, write_physical):
        function(block.design(x.size), x, u, room[1:-1])
    np.testing.assert_array_equal(np.isnan(room), [True, *[False] * width, True])
    np.testing.assert_array_equal(x, before)
    return room[1:-1]


@numba.njit
def compiled_write(design: Any, x: np.ndarray, u: float, out: np.ndarray) -> None:
    """Compiled, with allocation counted, as a part of a kernel."""
    write(design, x, u, out)
    write_physical(design, x, u, out)


@pytest.mark.trial
@cases("name", BLOCKS)
def test_a_block_has_as_many_values_and_units_as_names(name: str) -> None:
    """And each name once; compiled it writes the same."""
    block = BLOCKS[name]
    names = block.names(3)
    assert len(set(names)) == len(names)
    values = written(block)
    design, units, again = block.design(3), np.full(len(names), np.nan), np.full(len(names), np.nan)
    unit(design, np.ones(5), units)
    np.testing.assert_array_equal(units, np.ones(len(names)))
    compiled_write(design, STATE, U, again)
    np.testing.assert_allclose(again, values, rtol=1e-12)


@cases("name", ["state", "polynomial", "polynomial of some", "input", "bias"])
def test_a_unit_undoes_the_scale(name: str, rng: np.random.Generator) -> None:
    """θ·unit times the raw feature is θ times the scaled one."""
    block, scale = BLOCKS[name], 2.0 ** rng.integers(-5, 5, size=5)
    units = np.zeros(len(block.names(3)))
    unit(block.design(3), scale, units)
    np.testing.assert_allclose(
        written(block, STATE / scale[:3], U / scale[3]), units * written(block), rtol=1e-12
    )


@cases("name", BLOCKS)
def test_a_block_can_be_copied_and_sent(name: str) -> None:
    """What comes out writes the same."""
    for other in (copy.deepcopy(BLOCKS[name]), pickle.loads(pickle.dumps(BLOCKS[name]))):
        np.testing.assert_array_equal(written(other), written(BLOCKS[name]))


def test_a_polynomial_has_all_monomials() -> None:
    """By name and value."""
    block = Polynomial(3, states=(1, 2))
    assert block.names(3) == ("x1^2", "x1 x2", "x2^2", "x1^3", "x1^2 x2", "x1 x2^2", "x2^3")
    a, b = STATE[:2]
    np.testing.assert_allclose(
        written(block), [a * a, a * b, b * b, a**3, a * a * b, a * b * b, b**3], rtol=1e-14
    )
    assert len(Polynomial(4).names(3)) == math.comb(3 + 4, 4) - 1 - 3


def test_friction_reverses_with_the_velocity() -> None:
    """Smoothly, and abruptly."""
    block = Friction(width=0.1, sign=True)
    assert block.names(2) == ("tanh(x2/0.1)", "sign(x2)")
    for velocity in (-2.0, -0.05, 0.0, 0.05):
        np.testing.assert_allclose(
            written(block, np.array([9.0, velocity])), [np.tanh(velocity / 0.1), np.sign(velocity)]
        )


def test_periodic_features_are_waves_in_position() -> None:
    """By the formula, at any distance; all orders up to the highest, by addition, without drift."""
    for position in (0.0, 0.123, -7.5, 1e4):
        block = Periodic(period=0.8, orders=(9, 2), state=3)
        angles = math.tau * np.array([2, 9]) * position / 0.8
        values = written(block, np.array([1.0, 2.0, position]))
        expected = np.stack([np.sin(angles), np.cos(angles)], axis=1).ravel()
        np.testing.assert_allclose(values, expected, atol=1e-9)
    assert Periodic(orders=(9, 2)).names(2) == ("sin 2 x1", "cos 2 x1", "sin 9 x1", "cos 9 x1")
    every = written(Periodic(highest=500), np.array([1.234]))
    angles = 1.234 * np.arange(1, 501)
    np.testing.assert_allclose(every[::2], np.sin(angles), atol=1e-12)
    np.testing.assert_allclose(every[1::2], np.cos(angles), atol=1e-12)
    assert len(Periodic().names(1)) == 24


def learned(
    features: Any, force: Any, amplitude: float = 5.0, u_of: Any = math.sin, seconds: float = 12.0
) -> tuple[dict[str, float], list[float]]:
    """Coefficients and outputs of ``RLS`` on perfect estimates of a sweep and of ``force(x)``."""
    dt = 5e-3
    observer = ql.ESO.model_free(2, 1.0, 40.0, dt)
    learner = ql.learners.RLS(features, frequency=2.0, memory_time=math.inf, bias_bandwidth=0.0)
    design = learner.design(observer, 4.0)
    memory, z = learner.memory(design), np.zeros(3)
    outputs, filtered = [], 0.0
    chain = np.zeros((1, 3))
    for k in range(round(seconds / dt)):
        t = k * dt
        x = amplitude * np.array([math.sin(t + 0.1 * t * t), 0.0])
        x[1] = amplitude * (1.0 + 0.2 * t) * math.cos(t + 0.1 * t * t)
        u = u_of(3.0 * t)
        z[:2] = x
        adapt(design, memory, z, x[0], u, filtered)
        outputs.append(predict(design, memory, z, u)[0])
        commit(design, memory, z, u, 0.0)
        filtered = lag_push(design.lag, chain, 0, force(x))
    theta = np.zeros(len(learner.feature_names(2)))
    coefficients(design, memory, theta)
    return dict(zip(learner.feature_names(2), theta.tolist(), strict=True)), outputs


@pytest.mark.trial
def test_a_custom_feature_is_a_function_of_y_in_its_unit() -> None:
    """The coefficient of sin(3 y) is found, whatever the amplitude of y is."""
    block = Custom(lambda x, u: (math.sin(3.0 * x[0]), x[1] * abs(x[1])), names=("sin", "drag"))
    for amplitude in (5.0, 0.3):
        found, _ = learned(
            block, lambda x: 7.0 * math.sin(3.0 * x[0]) - 0.2 * x[1] * abs(x[1]), amplitude
        )
        assert found == pytest.approx({"sin": 7.0, "drag": -0.2}, rel=1e-3)


@pytest.mark.trial
def test_the_size_of_a_custom_feature_changes_nothing_but_its_coefficient() -> None:
    """A factor of 2⁶⁰ gives the same output, to the last bit, through all growing scales."""
    force = lambda x: 0.3 * x[0] ** 3 - x[0]  # noqa: E731
    plain, outputs = learned(Custom(lambda x, u: (x[0] ** 3, u * x[0]), names=("a", "b")), force)
    large, same = learned(
        Custom(lambda x, u: (2.0**60 * x[0] ** 3, u * x[0]), names=("a", "b")), force
    )
    assert same == outputs
    assert large["a"] * 2.0**60 == plain["a"]
    assert plain["a"] != 0.0


@pytest.mark.trial
def test_a_custom_feature_that_is_not_defined_everywhere_is_zero_elsewhere() -> None:
    """√y, where y is negative: what is learned stays finite, and right."""
    root = Custom(lambda x, u: (math.sqrt(x[0]) if x[0] > 0.0 else math.nan,), names=("root",))
    found, outputs = learned(root, lambda x: 3.0 * math.sqrt(max(x[0], 0.0)))
    assert np.all(np.isfinite(outputs))
    assert found["root"] == pytest.approx(3.0, rel=1e-3)


def test_periodic_features_learn_a_force_once_for_all_speeds() -> None:
    """Its sines and cosines, in the plant's units, while the speed changes all the time."""
    block = Periodic(period=1.6, orders=(1, 3))
    angle = math.tau / 1.6
    found, _ = learned(
        block + Friction(speed=0.2),
        lambda x: (
            4.0 * math.sin(angle * x[0])
            - 9.0 * math.cos(3.0 * angle * x[0])
            - 2.0 * math.tanh(x[1] / 0.2)
        ),
    )
    expected = {"sin 1 x1": 4.0, "cos 1 x1": 0.0, "sin 3 x1": 0.0, "cos 3 x1": -9.0}
    expected["tanh(x2/0.2)"] = -2.0
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=0.02)


@pytest.mark.trial
def test_random_fourier_features_approximate_a_gaussian_kernel(rng: np.random.Generator) -> None:
    """φ(x)·φ(x') → exp(−|x − x'|²/2 length²), with an error of 1/sqrt(p)."""
    block = RandomFourier(20_000, length=0.6, states=(1, 3))
    for _ in range(5):
        x, other = rng.uniform(-1.0, 1.0, (2, 3))
        kernel = math.exp(-np.sum((x - other)[[0, 2]] ** 2) / (2.0 * 0.6**2))
        assert written(block, x) @ written(block, other) == pytest.approx(kernel, abs=0.03)
    assert np.any(written(RandomFourier(5, seed=1)) != written(RandomFourier(5, seed=2)))


def test_radial_features_are_gaussians_around_centres_that_fill_the_range() -> None:
    """Against the formula; no point of the range is far from a centre."""
    centers = np.array([[0.1, 0.2], [-0.5, 0.9]])
    expected = np.exp(-np.sum((STATE[:2] - centers) ** 2, axis=1) / (2.0 * 0.3**2))
    np.testing.assert_allclose(written(RBF(width=0.3, centers=centers)), expected, rtol=1e-14)
    design = RBF(25).design(3)
    assert np.all(np.abs(design.centers) < 1.0)
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 21)] * 2), -1).reshape(-1, 2)
    nearest = np.min(np.linalg.norm(grid[:, None] - design.centers[None], axis=2), axis=1)
    assert np.max(nearest) < 0.6
    assert RBF(25).design(1).centers.shape == (25, 1)


def test_blocks_are_joined_in_order() -> None:
    """Values follow each other; repeated names are numbered; the bias is found, u comes last."""
    joined = State() + RBF(4) + Bias() + Input()
    np.testing.assert_array_equal(written(joined), [*STATE, *written(RBF(4)), 1.0, U])
    assert joined.constant(3) == 7
    assert joined.has_input
    assert (State() + Input()).constant(3) == -1
    assert (Bias() + State()).constant(3) == 0
    assert (RBF(2) + RBF(1)).names(2) == ("rbf1", "rbf2", "rbf1 (2)")


def test_a_custom_feature_runs_in_the_loop_and_through_a_copy() -> None:
    """Its address is made anew where a controller is copied or sent."""
    features = Custom(halves, ("half", "product")) + Bias()
    controller = ql.ADRC(
        ql.ESO.model_free(2, 1.0, 10.0, 0.01),
        omega_c=1.0,
        learner=ql.learners.NLMS(features=features),
    )
    for k in range(200):
        controller.step(1.0, math.sin(0.05 * k))
    other = pickle.loads(pickle.dumps(controller))
    assert [controller.step(1.0, 0.1 * k) for k in range(50)] == [
        other.step(1.0, 0.1 * k) for k in range(50)
    ]
    assert list(controller.estimate.theta) == ["half", "product", "bias"]


class Callable:
    """A function that is none to Numba."""

    def __call__(self, x: np.ndarray, u: float) -> tuple[float]:
        """Return a feature."""
        return (x[0],)


@cases(
    ("make", "message"),
    [
        (lambda: Polynomial(1), "degree = 1: must be a whole number of at least 2"),
        (lambda: Polynomial(states=(1, 1)), r"states = \(1, 1\): must not repeat a state"),
        (lambda: Polynomial(states=()), r"states = \(\): must be a tuple of the numbers of states"),
        (lambda: Polynomial(states=(0,)), r"states\[0\] = 0: must be a whole number of at least 1"),
        (
            lambda: Polynomial(states=(3,)).design(2),
            r"states = \(3,\): a plant of order 2 has no state 3",
        ),
        (lambda: Friction(width=0.0), "width = 0.0: must be finite and greater than zero"),
        (lambda: Friction(speed=-1.0), "speed = -1.0: must be finite and greater than zero"),
        (lambda: Friction(sign=1), "sign = 1: must be True or False"),
        (lambda: Friction().design(1), r"states = \(2,\): a plant of order 1 has no state 2"),
        (lambda: RandomFourier(0), "count = 0: must be a whole number of at least 1"),
        (lambda: RandomFourier(length=-1.0), "length = -1.0: must be finite and greater than zero"),
        (lambda: RandomFourier(seed=-1), "seed = -1: must be a whole number of at least 0"),
        (lambda: RBF(count=0), "count = 0: must be a whole number of at least 1"),
        (lambda: RBF(3, centers=[[0.0]]), "count and centers: give one of them"),
        (
            lambda: RBF(centers=[[0.0]]).design(2),
            r"centers has shape \(1, 1\): must be a matrix of shape \(any, 2\)",
        ),
        (lambda: RBF(width=math.nan), "width = nan: must be finite and greater than zero"),
        (lambda: Custom(3, ("a",)), "function = 3: must be a function"),
        (lambda: Custom(halves, ()), r"names = \(\): must be a tuple with a name for each feature"),
        (lambda: Custom(halves, ("a", "a")), r"names = \('a', 'a'\): must not repeat a name"),
        (
            lambda: Custom(halves, ("a",)).design(2),
            r"function returns shape \(2,\): must return a tuple of 1 numbers",
        ),
        (
            lambda: Custom(lambda x: (x[0],), ("a",)).design(2),
            r"function\(zeros\(2\), 0.0\) fails with TypeError",
        ),
        (
            lambda: Custom(Callable(), ("a",)).design(2),
            "function can't be compiled by Numba: .* it must be a plain function",
        ),
        (
            lambda: Custom(lambda x, u: (float(str(x[0])),), ("a",)).design(2),
            "function can't be compiled by Numba",
        ),
        (lambda: Periodic(0.0), "period = 0.0: must be finite and greater than zero"),
        (lambda: Periodic(orders=()), r"orders = \(\): must be a tuple of 1 to 500 whole numbers"),
        (lambda: Periodic(orders=(0,)), r"orders\[0\] = 0: must be a whole number from 1"),
        (lambda: Periodic(orders=(1.5,)), r"orders\[0\] = 1.5: must be a whole number"),
        (lambda: Periodic(orders=(2, 2)), r"orders = \(2, 2\): must not repeat an order"),
        (lambda: Periodic(orders=(2,), highest=3), "orders and highest: give one of them"),
        (lambda: Periodic(highest=501), "highest = 501: must be a whole number from 1 to 500"),
        (lambda: Periodic(state=3).design(2), "state = 3: a plant of order 2 has no state 3"),
        (lambda: Input() + State(), r"Input\(\) must be the last block"),
    ],
)
def test_a_mistake_is_named(make: Any, message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        make()
