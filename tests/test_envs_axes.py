"""Environments of several axes: with the action zero they are ``simulate``, and names say what each number is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

import quell as ql

pytest.importorskip("gymnasium")

from quell.envs import Env, Policy, VectorEnv

from .cases import cases

DT = 1e-3
SINES = (ql.signals.Sinusoid(0.1, 5.0), ql.signals.Sinusoid(0.2, 3.0))
SCENARIO = ql.Scenario(
    SINES, 0.1, (0.0, ql.signals.Step(at=0.05)), ql.signals.BandLimitedNoise(1e-11, DT)
)
B0 = np.array([[5.0, 0.5], [0.4, 6.0]])


def gantry(gain: float = 5.0) -> ql.plants.LinearPlant:
    """Two axes whose drives act on both."""
    A = [[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]]
    B = [[0, 0], [gain, 0.5], [0, 0], [0.4, 6]]
    return ql.plants.LinearPlant(A, B, np.eye(4)[[0, 2]])


def axes(x: Any = None, y: Any = None, guard: Any = None, **options: Any) -> ql.Axes:
    """An ADRC for each axis, with learners."""
    made = {
        name: ql.ADRC(
            ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=DT),
            omega_c=8.0, feedforward=True, learner=learner, guard=guard if learner else None,
        )
        for name, learner in (("x", x), ("y", y))
    }  # fmt: skip
    given: dict[str, Any] = {"B0": B0, "u_min": -25.0, "u_max": 20.0}
    return ql.Axes(made, **given | options)


def run_through(env: Env, actions: Any, seed: int = 3) -> tuple[list[Any], list[float], list[Any]]:
    """Run an episode with one action; return observations, rewards and infos."""
    observation, info = env.reset(seed=seed)
    seen, rewards, infos, ended = [observation], [], [info], False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(actions)
        seen.append(observation)
        rewards.append(reward)
        infos.append(info)
        ended = terminated or truncated
    return seen, rewards, infos


def seed_of(seed: int) -> int:
    """Return the seed of the scenario of the first episode after ``reset(seed=…)``."""
    return int(np.random.Generator(np.random.PCG64(seed)).integers(2**31))


@pytest.mark.parametrize("guard", [None, ql.Guard()])
def test_with_the_action_zero_the_loop_is_that_of_simulate(guard: Any) -> None:
    """Bit for bit, in r, y, u and the estimates of each axis, and the costs are those of its errors."""
    law = axes(Policy(), Policy(), guard)
    env = Env(
        gantry(), SCENARIO, law, observe=("r", "y", "u", "x.x_hat", "y.f_residual"), limit=50.0
    )
    seen, rewards, infos = run_through(env, [0.0, 0.0])
    alone = ql.simulate(gantry(), axes(), replace(SCENARIO, seed=seed_of(3)))
    rows = np.array(seen)
    np.testing.assert_array_equal(rows[:, :2], alone["r"])
    np.testing.assert_array_equal(rows[:, 2:4], alone["y"])
    np.testing.assert_array_equal(rows[1:, 4:6], alone["u"][:-1])
    np.testing.assert_array_equal(rows[1:, 6:8], alone["x.x_hat"][:-1])
    np.testing.assert_array_equal(rows[1:, 8], alone["y.f_residual"][:-1])
    squares = (alone["r"] - alone["y"])[1:] ** 2 * DT
    np.testing.assert_array_equal([info["cost"] for info in infos[1:]], squares)
    np.testing.assert_allclose(np.array(rewards), -squares.sum(axis=1), rtol=1e-12)
    assert env.observation_names == (
        "r[x]", "r[y]", "y[x]", "y[y]", "u[0]", "u[1]", "x.x_hat[0]", "x.x_hat[1]", "y.f_residual",
    )  # fmt: skip


def test_an_action_is_f_of_its_axis_as_a_learner_would_give_it() -> None:
    """An axis whose Policy says a share s of most runs as one with a Policy that says s times as much; the other has none."""
    law = axes(None, Policy(most=4.0))
    env = Env(gantry(), SCENARIO, law, observe=("y", "y.f_learned"))
    assert env.action_space.shape == (1,)
    assert env.action_names == ("y",)
    half, _, _ = run_through(env, [0.5])
    whole, _, _ = run_through(
        Env(gantry(), SCENARIO, axes(None, Policy(most=2.0)), observe=("y", "y.f_learned")), [1.0]
    )
    none, _, _ = run_through(env, [0.0])
    np.testing.assert_array_equal(half, whole)
    assert np.all(np.array(half)[2:, 2] == 2.0)
    assert np.max(np.abs(np.array(half) - np.array(none))[:, 1]) > 1e-5
    both = Env(gantry(), SCENARIO, axes(Policy(), Policy()), observe=("y", "x.f_learned"))
    assert both.action_names == ("x", "y")
    np.testing.assert_allclose(both._driven.action.reach, np.abs(B0) @ [22.5, 22.5])


def test_without_controller_the_actions_are_the_control_signals() -> None:
    """Held u in the units of each actuator: the outputs are those of the sampled plant, by its matrices."""
    env = Env(gantry(), SCENARIO, dt=DT, u_min=[-2.0, -4.0], u_max=[2.0, 0.0])
    assert env.observation_names[:6] == (
        "r[0]",
        "r[1]",
        "y_measured[0]",
        "y_measured[1]",
        "u[0]",
        "u[1]",
    )
    seen, _, infos = run_through(env, [0.5, -0.5])
    u, model = np.array([1.0, -3.0]), gantry().sampled(DT)
    x = np.zeros(4)
    for k, info in enumerate(infos[1:], 1):
        w = np.array([0.0, 1.0 if (k - 1) * DT >= 0.05 - 1e-9 else 0.0])
        x = model.transition @ x + model.input @ u + model.disturbance @ w
        np.testing.assert_allclose(info["y"], x[[0, 2]], rtol=1e-9, atol=1e-15)
        np.testing.assert_array_equal(info["u"], u)
    assert env.action_names == ("u[0]", "u[1]")
    assert env.observation_space.contains(seen[-1])


@pytest.mark.trial
def test_loops_side_by_side_are_single_ones() -> None:
    """With plants of their own and noise of their own: bit for bit, over the begin of a second episode."""
    gains = [4.0, 5.0, 6.0]
    law, options = (
        axes(Policy(), Policy(), ql.Guard()),
        {"action_repeat": 7, "weights": [1.0, 0.25], "cost_of_u": 1e-5},
    )
    many = VectorEnv(3, [gantry(gain) for gain in gains], SCENARIO, law, **options)
    singles = [Env(gantry(gain), SCENARIO, law, **options) for gain in gains]
    observations, _ = many.reset(seed=5)
    rng = np.random.default_rng(1)
    for i, env in enumerate(singles):
        np.testing.assert_array_equal(observations[i], env.reset(seed=5 + i)[0])
    begins = False
    for _ in range(20):
        actions = rng.uniform(-1.0, 1.0, (3, 2))
        observations, rewards, terminated, truncated, infos = many.step(actions)
        for i, env in enumerate(singles):
            if begins:
                np.testing.assert_array_equal(observations[i], env.reset()[0])
                continue
            one, reward, *ends, info = env.step(actions[i])
            np.testing.assert_array_equal(observations[i], one)
            assert (rewards[i], terminated[i], truncated[i]) == (reward, *ends)
            np.testing.assert_array_equal(infos["cost"][i], info["cost"])
            of_u = 1e-5 * DT * np.sum(info["u"] ** 2)
            assert -reward > info["cost"][0] + 0.25 * info["cost"][1] + of_u - 1e-12
        begins = bool(truncated.all())
    assert many.action_space.shape == (3, 2)


def test_a_lost_axis_ends_the_episode_at_the_largest_cost() -> None:
    """Beyond the limit of any y; the reward has all the time that is left."""
    env = Env(
        gantry(),
        SCENARIO,
        dt=DT,
        u_min=-500.0,
        u_max=500.0,
        limit=0.5,
        weights=[1.0, 2.0],
        cost_of_u=1e-3,
    )
    _, rewards, infos = run_through(env, [1.0, 0.0])
    assert max(np.abs(infos[-1]["y"])) > 0.5
    left = 0.1 - infos[-1]["t"] + DT
    assert -rewards[-1] == pytest.approx(left * (4 * 0.25 * 3.0 + 1e-3 * 2 * 500.0**2), rel=0.1)


@pytest.mark.trial
@pytest.mark.compiled
def test_compiled_loops_are_those_of_simulate() -> None:
    """With the action zero, from the same seed: to rounding, as compiled entry points may differ in the last bit."""
    env = VectorEnv(2, gantry(), SCENARIO, axes(Policy(), None), observe=("y", "u"))
    env.reset(seed=[3, 4])
    rows = [env.step(np.zeros((2, 1)))[0] for _ in range(99)]
    for i in range(2):
        alone = ql.simulate(gantry(), axes(), replace(SCENARIO, seed=seed_of(3 + i)))
        np.testing.assert_allclose(
            np.array(rows)[:, i, :2], alone["y"][1:100], rtol=1e-9, atol=1e-14
        )


@cases(
    ("call", "message"),
    [
        (partial(Env, gantry(), SCENARIO, axes()), "must be a quell.ADRC with learner=quell.envs.Policy"),
        (partial(Env, gantry(), SCENARIO), "dt = None"),
        (partial(Env, gantry(), SCENARIO, dt=DT), "u_min and u_max = -inf, inf: must be finite"),
        (partial(Env, gantry(), SCENARIO, dt=DT, u_min=[0.0] * 3, u_max=1.0), "one for all or one for each of 2"),
        (partial(Env, gantry(), SCENARIO, axes(Policy()), dt=DT), "dt: the controller has it"),
        (partial(Env, gantry(), SCENARIO, axes(Policy()), u_max=[1.0, 1.0]), "u_max: the controller has it"),
        (partial(Env, gantry(), SCENARIO, axes(Policy(), u_max=np.inf)), "u_min and u_max of the controller"),
        (partial(Env, ql.plants.two_mass_spring(), SCENARIO, axes(Policy())), "has 1 control signal and 1 output, the controller 2 and 2"),
        (partial(Env, gantry(), SCENARIO, axes(Policy()).axes[0]), "the controller 1 and 1: control it by quell.Axes"),
        (partial(Env, gantry(), SCENARIO, axes(Policy()), weights=[1.0]), "weights has shape"),
        (partial(Env, gantry(), SCENARIO, axes(Policy()), weights=[0.0, 0.0]), "must not be negative, and one must be positive"),
        (partial(Env, gantry(), SCENARIO, axes(Policy()), render_mode="ansi"), "render_mode = 'ansi': NOT for several axes yet"),
        (partial(Env, gantry(), SCENARIO, axes(Policy()), observe=("x_hat",)), "observe = 'x_hat'"),
        (partial(Env, ql.plants.two_mass_spring(), ql.Scenario(), dt=0.01, u_min=-1.0, u_max=1.0, weights=[1.0]), "are those of several axes"),
        (lambda: Env(ql.plants.arm(), ql.Scenario(), axes(Policy(), B0=None, M=ql.plants.arm().inertia)), "axis x: Policy.most=None.: B0 is a function"),
        (lambda: (env := Env(gantry(), SCENARIO, axes(Policy(), Policy())), env.reset(seed=1), env.step([0.0])), "must be 2 numbers"),
    ],
)  # fmt: skip
def test_what_is_no_environment_is_refused(call: Callable[[], Any], message: str) -> None:
    """With the argument, its value and the rule."""
    with pytest.raises(ValueError, match=message):
        call()
