"""A servo with an encoder at the motor and one at the load, and play between them.

The torque of the load and friction act behind a coupling with play of 1 mrad. With the motor's
encoder alone the load stands wrong by the play, whatever the controller does. An observer of both
encoders estimates a disturbance on each side, and state feedback carries the load to its place.
"""

import math

import numba
import numpy as np

import quell as ql
from quell.controllers import StateFeedback, quadratic_feedback

DT = 0.25e-3
JM, JL, K, C = 1.2e-4, 0.8e-4, 60.0, 0.005  # kg m², N m/rad, N m s/rad
PLAY, FRICTION = 1e-3, (0.03, 0.02)  # rad, N m
OMEGA = 60.0  # bandwidth of both loops [rad/s]


@numba.njit  # the plants below call it, compiled
def drive(t, x, u, w):
    """Motor and load: angle and speed of each; w are torques on them."""
    twist, slip = x[0] - x[2], x[1] - x[3]
    torque = 0.0
    if twist > 0.5 * PLAY:
        torque = max(K * (twist - 0.5 * PLAY) + C * slip, 0.0)
    elif twist < -0.5 * PLAY:
        torque = min(K * (twist + 0.5 * PLAY) + C * slip, 0.0)
    of_motor = u + w[0] - torque - FRICTION[0] * math.tanh(x[1] / 0.02) - 1e-4 * x[1]
    of_load = w[1] + torque - FRICTION[1] * math.tanh(x[3] / 0.02) - 1e-4 * x[3]
    return x[1], of_motor / JM, x[3], of_load / JL


plant = ql.plants.NonlinearPlant(
    drive, order=4, output=np.eye(4)[[0, 2]], disturbances=2, substeps=8, name="servo"
)
encoded = ql.plants.encoded_outputs(plant, math.tau / 2**20)
moves = ql.signals.Sum((ql.signals.Step(0.5, 0.05), ql.signals.Step(-0.8, 1.0)))
load = ql.signals.Step(0.15, 0.5) - ql.signals.Step(0.30, 1.5)
scenario = ql.Scenario(moves, duration=2.0, disturbances=(0.0, load))

# Both encoders: the plant without play and friction is the model.
A = np.array(
    [
        [0, 1, 0, 0],
        [-K / JM, -C / JM, K / JM, C / JM],
        [0, 0, 0, 1],
        [K / JL, C / JL, -K / JL, -C / JL],
    ]
)
B, E = np.array([0, 1 / JM, 0, 0]), np.array([[0, 0], [1 / JM, 0], [0, 0], [0, 1 / JL]])
variance = (math.tau / 2**20) ** 2 / 12
observer = ql.ESO.state_space(
    A, B, np.eye(4)[[0, 2]], E, DT, noise_variance=[variance] * 2, drift=[0.1, 0.1]
)
Q = np.zeros((4, 4))
Q[2, 2] = 1.0
gain = quadratic_feedback(A, B, Q, 1.0 / ((JM + JL) ** 2 * OMEGA**4), DT)
both = StateFeedback(observer, gain, controlled=[0, 0, 1, 0], u_min=-2.0, u_max=2.0)
run = ql.simulate(encoded, both, scenario)


# The motor's encoder alone: an ADRC of order 2 for the sum of both inertias.
alone = ql.ADRC(
    ql.ESO.model_free(order=2, b0=1.0 / (JM + JL), omega_o=4.0 * OMEGA, dt=DT),
    OMEGA, u_min=-2.0, u_max=2.0,
)  # fmt: skip
from_motor = ql.plants.NonlinearPlant(drive, order=4, disturbances=2, substeps=8, name="servo")
single = ql.simulate(ql.plants.encoded(from_motor, 2**20), alone, scenario)

at_rest = ((run.t > 0.4) & (run.t < 0.5)) | ((run.t > 0.9) & (run.t < 1.0)) | (run.t > 1.9)
errors = {}
for name, angle in (("motor's encoder", single["x"][:, 2]), ("both encoders", run["y"][:, 1])):
    errors[name] = 1e3 * np.sqrt(np.mean((angle - run["r"])[at_rest] ** 2))
    print(f"{name:16} RMS error of the load at rest {errors[name]:.3f} mrad")
assert errors["both encoders"] < 0.5 * errors["motor's encoder"]
