"""A neural network of scikit-learn that learns a hardening spring and drag during the run."""

import sys

import numpy as np

import quell as ql

try:
    from sklearn.neural_network import MLPRegressor
except ImportError:
    print("This example needs scikit-learn: pip install 'quell-control[sklearn]'")
    sys.exit(0)


def hard_spring(t, x, u, w):
    """Return the derivatives of position and speed, for force u, a hardening spring and drag."""
    return x[1], u + w[0] - 6.0 * x[0] - 8.0 * x[0] ** 3 - 1.5 * x[1] * abs(x[1])


plant = ql.plants.NonlinearPlant(hard_spring, order=2, name="hard spring")
observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=15.0, dt=5e-3)
scenario = ql.Scenario(reference=ql.signals.Sinusoid(omega=1.5), duration=60.0)

# The ideal loop: the same controller on a plant without disturbance.
free = ql.plants.LinearPlant([[0.0, 1.0], [0.0, 0.0]], [0.0, 1.0], [1.0, 0.0])
ideal = ql.simulate(free, ql.ADRC(observer, omega_c=4.0), scenario)

# Without momentum, because successive pairs are similar.
network = MLPRegressor(
    hidden_layer_sizes=(16,), activation="tanh", solver="sgd", learning_rate_init=0.05, momentum=0.0
)
for learner in (None, ql.learners.SklearnModel(network, period=10)):
    run = ql.simulate(plant, ql.ADRC(observer, omega_c=4.0, learner=learner), scenario)
    last = run.window(40.0, 60.0)
    deviation = np.sqrt(np.mean((run["y"] - ideal["y"])[last] ** 2))
    print(
        f"{'MLPRegressor' if learner else 'no learner':>12}: RMS deviation from the ideal "
        f"loop {deviation:.4f}. {run.message}"
    )
