"""A neural network from scikit-learn, learning a hard spring and drag while the loop runs."""

import sys

import numpy as np

import quell as ql

try:
    from sklearn.neural_network import MLPRegressor
except ImportError:
    print("This example needs scikit-learn: pip install 'quell[sklearn]'")
    sys.exit(0)


def hard_spring(t, x, u, w):
    """Position and speed; force u; a spring that hardens and drag, of which the controller is told nothing."""
    return x[1], u + w[0] - 6.0 * x[0] - 8.0 * x[0] ** 3 - 1.5 * x[1] * abs(x[1])


plant = ql.plants.NonlinearPlant(hard_spring, order=2, name="hard spring")
observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=15.0, dt=5e-3)
scenario = ql.Scenario(reference=ql.signals.Sinusoid(omega=1.5), duration=60.0)

# What the loop would do if it knew the disturbance: the same controller on a plant without any.
free = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
ideal = ql.simulate(free, ql.ADRC(observer, omega_c=4.0), scenario)

# Without momentum: pairs that follow each other resemble each other.
network = MLPRegressor(
    hidden_layer_sizes=(16,), activation="tanh", solver="sgd", learning_rate_init=0.05, momentum=0.0
)
for learner in (None, ql.learners.SklearnModel(network, period=10)):
    run = ql.simulate(plant, ql.ADRC(observer, omega_c=4.0, learner=learner), scenario)
    last = run.window(40.0, 60.0)
    deviation = np.sqrt(np.mean((run["y"] - ideal["y"])[last] ** 2))
    print(
        f"{'MLPRegressor' if learner else 'no learner':>12}: RMS deviation from the ideal loop {deviation:.4f}. {run.message}"
    )
