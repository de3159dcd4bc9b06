"""A policy that explores, without controller, without guard and with guard (extra ``envs``).

A linear policy is trained by the cross-entropy method (Rubinstein & Kroese, 2004) in NumPy: in each
generation 96 policies are drawn, each drives a loop of its own, and mean and spread of the best
eighth are those of the next generation. The plant is the two masses with a load.

* *u*: the policy sees r and the plant's whole state and sets u.
* *f, no guard*: it sees what an ADRC controller estimates and sets what is fed forward.
* *f, guard*: the same, and the guard lets pass what the policy explains.

A loop is lost when y is 10 m away. The best that a policy can feed forward is known: the part of f
that the spring causes is −2 y'', which here is the action −0.5 x̂_3.
"""

import sys
import time

import numpy as np

import quell as ql
from quell.envs import Policy, VectorEnv

POLICIES, BEST, GENERATIONS, SPREAD = 96, 12, 10, 0.5
DT, DURATION, REPEAT, LIMIT, U_MAX = 0.01, 60.0, 10, 10.0, 8.0


def scenario(rng):
    """Draw a sinusoid to follow, and a load on the second mass."""
    return ql.Scenario(
        reference=ql.signals.Sinusoid(amplitude=rng.uniform(0.5, 1.5), omega=rng.uniform(0.5, 1.0)),
        disturbances=(0.0, ql.signals.Step(height=rng.uniform(-0.2, 0.2), at=40.0)),
        noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=DT),
        duration=DURATION,
        seed=int(rng.integers(2**31)),
    )


def controller(guard):
    """Return an ADRC whose learner is a policy; it feeds the reference's derivatives forward."""
    observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=DT)
    limits = {"u_min": -U_MAX, "u_max": U_MAX}
    learner = Policy(most=4.0)  # [m/s⁴]
    return ql.ADRC(observer, 1.0, learner=learner, guard=guard, feedforward=True, **limits)


def environment(kind, loops):
    """Return an environment of one of the three kinds."""
    common = {"action_repeat": REPEAT, "limit": LIMIT}
    plant = ql.plants.two_mass_spring()
    if kind == "u":
        limits = {"u_min": -U_MAX, "u_max": U_MAX, "dt": DT, "observe": ("r", "x")}
        return VectorEnv(loops, plant, scenario, **limits, **common)
    law = controller(ql.Guard() if kind == "f, guard" else None)
    return VectorEnv(loops, plant, scenario, law, observe=("x_hat",), **common)


def rollout(env, weights, seeds):
    """Run an episode in each loop, with a row of weights and a seed for each.

    Return the costs ∫ (r − y)² dt, and which loops were lost.
    """
    count = env.num_envs
    observations, _ = env.reset(seed=seeds)
    costs, lost, running = np.zeros(count), np.zeros(count, bool), np.ones(count, bool)
    while running.any():
        actions = np.sum(weights * observations, axis=1)
        observations, rewards, terminated, truncated, _ = env.step(actions[:, None])
        costs -= np.where(running, rewards, 0.0)
        lost |= running & terminated
        running &= ~(terminated | truncated)
    return costs, lost


def train(kind):
    """Train; return the weights, the costs of each generation and which loops were lost."""
    env, rng = environment(kind, POLICIES), np.random.default_rng(1)
    size = env.single_observation_space.shape[0]
    mean, spread, costs, lost = np.zeros(size), np.full(size, SPREAD), [], []
    for generation in range(GENERATIONS):
        weights = mean + spread * rng.standard_normal((POLICIES, size))
        found, gone = rollout(env, weights, [generation] * POLICIES)
        best = weights[np.argsort(found)[:BEST]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.01
        costs.append(found)
        lost.append(gone)
    env.close()
    return mean, np.array(costs), np.array(lost)


def test(kind, weights):
    """Return the mean cost over 64 new episodes, and the number of lost loops."""
    env = environment(kind, POLICIES)
    costs, lost = rollout(env, np.tile(weights, (POLICIES, 1)), list(range(1000, 1000 + POLICIES)))
    env.close()
    return costs.mean(), lost.sum()


alone, _ = test("f, guard", np.zeros(4))
print(f"ADRC alone: ∫ (r − y)² dt = {alone:.3g} m² s in a mean over {POLICIES} episodes.\n")
results = {}
for kind in ("u", "f, no guard", "f, guard"):
    begun = time.perf_counter()
    weights, costs, lost = results[kind] = train(kind)
    cost, gone = test(kind, weights)
    median, worst = np.median(costs[0]), costs[0].max()
    print(
        f"{kind}: the first generation lost {lost[0].sum()} of {POLICIES} loops, and all together "
        f"{lost.sum()} of {lost.size}.\n  Costs of the first: {median:.3g} m² s in the median, "
        f"{worst:.3g} at worst. The trained policy has {cost:.3g} over the {POLICIES} episodes and "
        f"loses {gone}.\n  Weights {np.array2string(weights, precision=2, suppress_small=True)}, "
        f"after {time.perf_counter() - begun:.0f} s.\n"
    )

if len(sys.argv) > 1:  # python 11_policy.py figure.png
    import matplotlib.pyplot as plt

    env = environment("f, guard", GENERATIONS)  # the episodes of the generations, without policy
    alone, _ = rollout(env, np.zeros((GENERATIONS, 4)), list(range(GENERATIONS)))
    figure, (upper, lower) = plt.subplots(2, 1, sharex=True, layout="constrained")
    for (kind, (_, costs, lost)), style in zip(results.items(), ("-", "--", "-"), strict=True):
        generations = range(1, GENERATIONS + 1)
        upper.semilogy(generations, costs.mean(axis=1) / alone, style, marker="o", label=kind)
        lower.plot(generations, 100.0 * lost.mean(axis=1), style, marker="o")
    upper.axhline(1.0, color="gray", linestyle=":", label="ADRC alone")
    upper.set_ylabel("mean cost / that of ADRC alone")
    lower.set_ylabel("lost loops [%]")
    lower.set_xlabel("generation")
    figure.legend(loc="outside upper center", ncols=4)
    figure.savefig(sys.argv[1], dpi=100)
