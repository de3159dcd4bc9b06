"""A learner that is right for 20 s and then returns wrong values, without and with a guard."""

from typing import NamedTuple

import numpy as np

import quell as ql
from quell.learners import Online, infer, learn


class LiarDesign(NamedTuple):
    """Parameters of the model."""

    features: int
    step: float
    turns: float


class LiarMemory(NamedTuple):
    """State: the coefficients, and the number of pairs so far."""

    theta: np.ndarray
    pairs: np.ndarray


class Liar:
    """A linear model that returns −10 times its prediction after it has learned for 20 s."""

    def design(self, features, dt):
        """Return the parameters. The functions below are registered for their type."""
        return LiarDesign(features, dt, 20.0 / dt)

    def memory(self, parameters):
        """Return the initial state."""
        return LiarMemory(np.zeros(parameters.features), np.zeros(1))


@infer.register(LiarDesign)
def predicted(model, memory, features):
    """Return the prediction for the features."""
    total = 0.0
    for i in range(features.size):
        total += memory.theta[i] * features[i]
    return total if memory.pairs[0] < model.turns else -10.0 * total


@learn.register(LiarDesign)
def learned(model, memory, features, target):
    """Update the coefficients by normalised least mean squares."""
    error, power = target, 0.01
    for i in range(features.size):
        error -= memory.theta[i] * features[i]
        power += features[i] * features[i]
    for i in range(features.size):
        memory.theta[i] += model.step * error * features[i] / power
    memory.pairs[0] += 1.0


# The ideal loop: the same controller on a plant without disturbance.
free = ql.plants.LinearPlant(np.eye(4, k=1), [0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0])
plant = ql.plants.two_mass_spring()
observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=2e-3)
scenario = ql.Scenario(
    reference=ql.signals.Sinusoid(),
    disturbances=(0.0, ql.signals.Sinusoid(omega=0.4, start=40.0)),
    noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
    duration=80.0,
)
ideal = ql.simulate(
    free,
    ql.ADRC(observer, omega_c=1.0),
    ql.Scenario(reference=scenario.reference, duration=scenario.duration),
)
for name, learner, guard in (
    ("no learner", None, None),
    ("liar, no guard", Online(Liar()), None),
    ("liar, guard", Online(Liar()), ql.Guard()),
    ("honest, guard", ql.learners.Harmonic(), ql.Guard()),
):
    controller = ql.ADRC(observer, omega_c=1.0, learner=learner, guard=guard)
    run = ql.simulate(plant, controller, scenario)
    error = np.sqrt(np.mean((run["y"] - ideal["y"][: len(run)]) ** 2))
    print(
        f"{name:>14}: RMS deviation from the ideal loop {error:.3g} m, over {run.t[-1]:.0f} "
        f"s. {run.message}"
    )
    if guard:
        now = controller.read(run.final_state)
        print(
            f"{'':16}Authority {run['authority'].max():.2f} at most, {now.authority:.2f} at "
            f"the end. {now.reason.message}"
        )
