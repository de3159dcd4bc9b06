"""Environments for Gymnasium, against ``simulate`` and the plant itself."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.envs.loops import Stacked, member
from quell.plants import batch, two_mass_spring
from quell.plants.base import advance, measure

from .cases import cases

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium (extra envs) is not installed")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from quell.envs import NAMES, Env, Policy, VectorEnv  # noqa: E402

from .commands import run_python  # noqa: E402

DT, U_MAX = 0.01, 4.0
NOISY = ql.Scenario(
    reference=ql.signals.Sinusoid(amplitude=0.5),
    disturbances=(0.0, ql.signals.Sinusoid(amplitude=0.2, omega=0.7)),
    noise=ql.signals.BandLimitedNoise(power=1e-10, sample_time=DT),
    duration=1.5,
)
QUIET = ql.Scenario(ql.signals.Step(), duration=0.3)
SHORT = ql.Scenario(duration=1e-11)  # zero samples, to rounding
OPEN = {"dt": DT, "u_min": -U_MAX, "u_max": U_MAX}


def law(learner: Any = None, guard: Any = None, **options: Any) -> ql.ADRC:
    """A model-free ADRC for two masses."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=DT)
    options = {"u_min": -U_MAX, "u_max": U_MAX} | options
    return ql.ADRC(observer, omega_c=1.0, learner=learner, guard=guard, **options)


def residual(**options: Any) -> Env:
    """An environment whose action is f, with a guard."""
    return Env(two_mass_spring(), NOISY, law(Policy(most=2.0), ql.Guard()), **options)


def episode(env: Any, actions: Any, seed: int | None = 1) -> dict[str, Any]:
    """Take the actions; return observations, rewards and the infos as arrays, the start included."""
    observation, info = env.reset(seed=seed)
    observations, rewards, infos = [observation], [], [info]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
    found = {name: np.array([each[name] for each in infos]) for name in infos[0]}
    ends = {"terminated": terminated, "truncated": truncated}
    return found | ends | {"observations": np.array(observations), "rewards": np.array(rewards)}


def drawn_seed(seed: int) -> int:
    """Return the seed of the noise in the first episode after ``reset(seed=seed)``."""
    return int(np.random.default_rng(np.random.SeedSequence(seed)).integers(2**31))


def simulated(controller: ql.ADRC, seed: int = 1, plant: Any = None) -> ql.Trajectory:
    """The run that an episode of ``NOISY`` is part of."""
    return ql.simulate(
        plant or two_mass_spring(), controller, replace(NOISY, seed=drawn_seed(seed))
    )


def test_a_residual_environment_with_the_action_zero_is_the_loop_without_learner() -> None:
    """Bit for bit, with noise and loads, and whatever the number of samples in a step."""
    run = simulated(law())
    found = episode(residual(), np.zeros((150, 1)))
    assert np.array_equal(found["y"], run["y"])
    assert np.array_equal(found["u"][1:], run["u"][:-1])
    assert found["truncated"]
    assert not found["terminated"]
    coarse = episode(residual(action_repeat=7), np.zeros((22, 1)))
    assert np.array_equal(coarse["y"][:-1], run["y"][:-1:7])
    assert coarse["y"][-1] == run["y"][-1]
    assert math.isclose(coarse["rewards"].sum(), found["rewards"].sum(), rel_tol=1e-12)


def pendulum(t: float, x: Any, u: float, w: Any) -> Any:
    """Derivatives of angle and speed."""
    return x[1], 8.0 * u + w[0] - 9.81 * np.sin(x[0])


@pytest.mark.parametrize(
    "plant",
    [
        ql.plants.NonlinearPlant(pendulum, order=2, output=[1.0, 0.0], disturbances=2),
        ql.plants.delayed(ql.plants.LinearPlant.of(([2.0], [1.0, 1.0, 0.0])), 3 * DT, DT),
        ql.plants.dc_motor(),
    ],
    ids=lambda plant: type(plant).__name__,
)
def test_any_plant_can_be_driven(plant: Any) -> None:
    """Nonlinear, delayed, with friction and an encoder: with the action zero as in ``simulate``."""
    dt = DT if plant.name != "DC motor" else 1e-3
    observer = ql.ESO.model_free(order=2, b0=8.0, omega_o=25.0, dt=dt)
    limits = {"u_min": -9.0, "u_max": 9.0, "feedforward": True}
    reference = ql.signals.Sinusoid(amplitude=0.5, omega=3.0)
    scenario = ql.Scenario(reference, duration=50 * dt, x0=0.1 * np.eye(plant.order)[0])
    run = ql.simulate(plant, ql.ADRC(observer, 8.0, **limits), scenario)
    env = Env(plant, scenario, ql.ADRC(observer, 8.0, learner=Policy(), guard=ql.Guard(), **limits))
    for _ in range(2):
        found = episode(env, np.zeros((50, 1)))
        assert np.array_equal(found["y"], run["y"])
        assert np.array_equal(found["u"][1:], run["u"][:-1])


def test_without_a_guard_the_action_is_what_is_fed_forward() -> None:
    """And with one nothing is, at first: the policy has earned no authority."""
    env = Env(two_mass_spring(), NOISY, law(Policy(most=2.0)))
    found = episode(env, np.full((20, 1), 0.25))
    assert np.array_equal(found["f_learned"][1:], np.full(20, 0.5))
    guarded = episode(residual(), np.full((20, 1), 0.25))
    assert np.all(guarded["f_learned"] == 0.0)
    assert np.all(guarded["authority"] == 0.0)


def test_the_default_reach_of_a_policy_is_what_u_can_cancel() -> None:
    """b0 times half the range of u."""
    env = Env(two_mass_spring(), NOISY, law(Policy()))
    assert episode(env, [[1.0]])["f_learned"][-1] == U_MAX


def test_the_action_u_moves_the_open_plant() -> None:
    """As the plant's own kernels do, sample by sample; u is the action times the limit."""
    rng = np.random.default_rng(3)
    actions = rng.uniform(-1.2, 1.2, 40)
    found = episode(Env(two_mass_spring(), NOISY, **OPEN), actions[:, None])
    model, x = two_mass_spring().sampled(DT), np.zeros(4)
    for k, action in enumerate(np.clip(actions, -1.0, 1.0)):
        load = 0.2 * math.sin(0.7 * (k * DT))
        advance(model, x, np.zeros(24), k * DT, U_MAX * action, np.array([0.0, load]))
        assert found["u"][k + 1] == U_MAX * action
        assert math.isclose(found["y"][k + 1], measure(model, x), rel_tol=1e-12)
        assert np.allclose(found["observations"][k + 1, 3:], x, rtol=1e-12)


def test_a_controller_from_outside_gives_the_closed_loop() -> None:
    """An ADRC stepped in Python on y_measured drives the open plant as ``simulate`` runs it."""
    run, controller = simulated(law()), law()
    env = Env(two_mass_spring(), NOISY, **OPEN, observe=("r", "y_measured"))
    observation, _ = env.reset(seed=1)
    for k in range(len(run) - 1):
        u = controller.step(*observation)
        observation, *_, info = env.step(np.array([u / U_MAX]))
        assert info["y"] == run["y"][k + 1]


def test_the_return_is_the_quadratic_cost() -> None:
    """The sum over samples of the error and ρ u², both times dt."""
    rng = np.random.default_rng(4)
    env = Env(two_mass_spring(), NOISY, **OPEN, cost_of_u=0.3)
    found = episode(env, rng.uniform(-1.0, 1.0, (150, 1)))
    r = 0.5 * np.sin(found["t"])
    cost = (r - found["y"])[1:] ** 2 + 0.3 * found["u"][1:] ** 2
    assert math.isclose(found["rewards"].sum(), -DT * cost.sum(), rel_tol=1e-9)


def test_a_lost_loop_is_terminated_and_costs_more_than_any_other() -> None:
    """Its observation is finite and within the bounds; a step after it is refused."""
    env = Env(two_mass_spring(), NOISY, **OPEN, limit=0.01, action_repeat=5)
    observation, _ = env.reset(seed=2)
    total, terminated = 0.0, False
    while not terminated:
        observation, reward, terminated, truncated, info = env.step(np.ones(1))
        total += reward
        assert not truncated
    assert abs(info["y"]) > 0.01
    assert env.observation_space.contains(observation)
    left = 1.5 - info["t"]
    assert -total >= left * 4.0 * 0.01**2
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.ones(1))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.trial] * name.startswith("arm")) for name in NAMES],
)
def test_gymnasium_finds_nothing_wrong_with_the_librarys_environments(name: str) -> None:
    """Its checker raises no error and gives no warning; seeds decide all."""
    env = gymnasium.make(f"quell/{name}-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)
    size = env.action_space.shape
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (5, *size))  # type: ignore[misc]
    first, again, other = (
        episode(env.unwrapped, actions, seed)["observations"] for seed in (7, 7, 8)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    env.close()


def test_a_loop_of_many_is_a_loop_alone() -> None:
    """With the seed s + i, over the end of an episode: it begins anew in the step after it."""
    many = VectorEnv(
        3, two_mass_spring(), NOISY, law(Policy(most=2.0), ql.Guard()), action_repeat=50
    )
    alone = [residual(action_repeat=50) for _ in range(3)]
    observations, infos = many.reset(seed=5)
    for i, env in enumerate(alone):
        assert np.array_equal(env.reset(seed=5 + i)[0], observations[i])
    rng, ended = np.random.default_rng(0), False
    for k in range(5):
        actions = rng.uniform(-1.0, 1.0, (3, 1))
        observations, rewards, terminated, truncated, infos = many.step(actions)
        for i, env in enumerate(alone):
            expected = (env.reset()[0], 0.0, False, False) if ended else env.step(actions[i])[:4]
            assert np.array_equal(expected[0], observations[i])
            assert expected[1:] == (rewards[i], terminated[i], truncated[i])
        assert infos["_y"].all()
        ended = bool(truncated[0])
        assert ended == (k == 2)


def test_each_loop_can_have_a_plant_of_its_own() -> None:
    """With the result of that plant alone; what does not fit together is refused."""
    plants = batch(two_mass_spring, k=np.array([0.5, 1.0, 2.0]))
    many = VectorEnv(3, plants, NOISY, **OPEN)
    with pytest.raises(ValueError, match="seed = 9.5: must be a whole number"):
        many.reset(seed=9.5)
    many.reset(seed=np.int64(9))
    for _ in range(20):
        observations, *_ = many.step(np.full((3, 1), 0.5))
    alone = Env(plants[2], NOISY, **OPEN)
    assert np.array_equal(
        episode(alone, np.full((20, 1), 0.5), 11)["observations"][-1], observations[2]
    )
    with pytest.raises(ValueError, match="has 3 entries, num_envs = 4"):
        VectorEnv(4, plants, NOISY, **OPEN)


@pytest.mark.compiled
def test_plants_that_differ_in_numbers_are_refused_where_code_is_compiled_for_all() -> None:
    """Two equal motors fit together; two with different friction do not."""
    for friction in (0.01, 0.02):
        motors = [ql.plants.dc_motor(coulomb=value) for value in (0.01, friction)]
        if friction == 0.01:
            VectorEnv(2, motors, QUIET, **OPEN | {"dt": 1e-3}).close()
        else:
            with pytest.raises(ValueError, match=r"plant\[1\] differs"):
                VectorEnv(2, motors, QUIET, **OPEN | {"dt": 1e-3})
            VectorEnv(2, motors, QUIET, **OPEN | {"dt": 1e-3}, interpret=True)


def test_scenarios_are_drawn_from_the_generator_of_the_episode() -> None:
    """Their initial state is the plant's; their durations are equal."""

    def draw(rng: np.random.Generator) -> ql.Scenario:
        return ql.Scenario(rng.uniform(), duration=0.3, x0=(0.0, rng.uniform(1.0, 2.0), 0.0, 0.0))

    env = Env(two_mass_spring(), draw, **OPEN)
    observation, info = env.reset(seed=3)
    rng = gymnasium.utils.seeding.np_random(3)[0]
    assert (observation[0], info["y"]) == (rng.uniform(), rng.uniform(1.0, 2.0))
    assert not np.array_equal(env.reset()[0], observation)
    lengths = iter((0.3, 0.4))
    env = Env(two_mass_spring(), lambda rng: ql.Scenario(duration=next(lengths)), **OPEN)
    with pytest.raises(ValueError, match=r"duration = 0.4 s, another one 0.3 s"):
        env.reset(seed=0)


@cases(
    ("problem", "changes"),
    [
        ("must be a quell.ADRC with learner=quell.envs.Policy()", {"controller": law()}),
        ("must be finite", {"controller": law(Policy(), u_max=math.inf)}),
        ("the controller has it", {"controller": law(Policy()), "dt": 0.1}),
        ("must be the sample time", {"dt": None}),
        ("dt = '1 ms'", {"dt": "1 ms"}),
        ("u_min and u_max = None, ", {"u_min": None}),
        ("must be finite, the first one smaller", {"u_max": -5.0}),
        ("must be empty", {"scenario": ql.Scenario(duration=2.0, rest_at=(1.0,))}),
        ("action_repeat", {"action_repeat": 0}),
        ("observe", {"observe": ("x_hat",)}),
        ("must be different", {"observe": ("r", "r")}),
        ("observe = 3", {"observe": 3}),
        ("x_limit has 3 entries", {"x_limit": (1.0, 2.0, 3.0)}),
        ("limit = -1.0", {"limit": -1.0}),
        ("render_mode", {"render_mode": "human"}),
        ("must be at least one sample", {"scenario": SHORT}),
    ],
)
def test_bad_arguments_are_refused(problem: str, changes: dict[str, Any]) -> None:
    """With the argument's name and the rule."""
    given = {"controller": None, "scenario": QUIET} | ({} if "controller" in changes else OPEN)
    with pytest.raises(ValueError, match=re.escape(problem)):
        Env(two_mass_spring(), **(given | changes))


def test_bad_actions_are_refused() -> None:
    """Those that are not finite, or too many."""
    env = Env(([1.0], [1.0, 1.0]), QUIET, **OPEN)
    env.reset(seed=0)
    for action in (np.array([np.nan]), np.zeros(2)):
        with pytest.raises(ValueError, match="action ="):
            env.step(action)


def test_an_episode_is_shown_as_text_or_as_a_picture() -> None:
    """The picture has the size of Gymnasium's own."""
    env = Env(two_mass_spring(), QUIET, **OPEN, render_mode="ansi")
    assert env.render() is None
    env.reset(seed=0)
    env.step(np.ones(1))
    assert "u =          4" in env.render()
    env = Env(two_mass_spring(), QUIET, **OPEN, render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (480, 640, 3)


def test_members_of_a_stack_are_copies_side_by_side() -> None:
    """At a distance of whole cache lines; numbers are kept as they are."""
    memory = ql.Guard().memory(ql.Guard().design(law().observer))
    stack = Stacked([(memory, 1.5)] * 3)
    assert stack.stride % 64 == 0
    stack.members[1][0].chain[:] = 1.0
    assert not np.any(stack.members[0][0].chain)
    assert not np.any(stack.members[2][0].chain)
    assert member(stack.members, stack.stride, 1)[1] == 1.5


@pytest.mark.trial
@pytest.mark.compiled
def test_compiled_loops_in_threads_agree_with_plain_python() -> None:
    """To rounding, as products may be fused; in two threads exactly as in one."""
    rewards = []
    for options in ({"workers": 2}, {"workers": 1}):
        env = VectorEnv(130, two_mass_spring(), NOISY, law(Policy(most=2.0)), **options)
        observations, _ = env.reset(seed=0)
        rng, total = np.random.default_rng(1), np.zeros(130)
        for _ in range(30):
            observations, reward, *_ = env.step(rng.uniform(-1.0, 1.0, (130, 1)))
            total += reward
        rewards.append(total)
        env.close()
    assert np.array_equal(*rewards)
    slow = Env(two_mass_spring(), NOISY, law(Policy(most=2.0)), interpret=True)
    slow.reset(seed=129)
    rng = np.random.default_rng(1)
    for _ in range(30):
        observation, *_ = slow.step(rng.uniform(-1.0, 1.0, (130, 1))[129])
    assert np.allclose(observation, observations[129], rtol=1e-9, atol=1e-9)


@pytest.mark.trial
def test_without_gymnasium_the_error_names_the_extra() -> None:
    """And the rest of the folder works."""
    code = (
        "import sys; sys.modules['gymnasium'] = None; import importlib.util as u; found = u.find_spec\n"
        "u.find_spec = lambda name, *rest: None if name == 'gymnasium' else found(name, *rest)\n"
        "import quell.envs; quell.envs.Policy()\n"
        "try: quell.envs.Env\n"
        "except ImportError as error: print(error)\n"
    )
    shown = run_python(code)
    assert "pip install 'quell-control[envs]'" in shown.stdout


def test_the_import_that_registers_the_environments_does_not_load_the_compiler() -> None:
    """It takes time where all that is wanted may be another library's environment."""
    shown = run_python("import sys, quell.envs; print('numba' in sys.modules)")
    assert shown.stdout == "False\n"


@pytest.mark.trial
def test_gymnasium_finds_the_environments_by_their_module() -> None:
    """And, once it is imported, by their names alone; the vector environment, too."""
    code = (
        "import gymnasium, sys\n"
        "env = gymnasium.make('quell.envs:quell/two-mass-residual-v0', action_repeat=4)\n"
        "many = gymnasium.make_vec('quell/two-mass-v0', num_envs=2)\n"
        "print(env.unwrapped.action_space.shape, many.action_space.shape)\n"
    )
    shown = run_python(code)
    assert shown.stdout == "(1,) (2, 1)\n"
    assert not shown.stderr
