"""A controller sample by sample: read, step, write; lost measurements; a state kept in a file."""

import math
import tempfile
from pathlib import Path

import numpy as np

import quell as ql

DT = 1e-3
controller = ql.ADRC(
    ql.ESO.model_free(order=2, b0=50.0, omega_o=80.0, dt=DT),
    omega_c=12.0,
    learner=ql.learners.Kalman(),
    u_min=-1.0,
    u_max=1.0,
    rate_limit=100.0,
)
controller.prepare()  # compile now, not in the first sample

angle = speed = 0.0
for k in range(4000):
    measured = math.nan if 2000 <= k < 2010 else angle  # ten samples are lost
    u = controller.step(r=0.5, y=measured)
    if controller.estimate.status is ql.Status.MEASUREMENT_HELD and k == 2000:
        print(controller.estimate.status.message)
    speed += DT * (
        60.0 * u - 3.0 * speed - 4.0 * math.sin(angle)
    )  # b0 is 50, the motor's gain is 60
    angle += DT * speed
print(f"angle {angle:.4f} rad, disturbance {controller.estimate.f:.2f} rad/s²")

with tempfile.TemporaryDirectory() as folder:
    np.savez(Path(folder) / "controller.npz", **controller.state)
    with np.load(Path(folder) / "controller.npz") as saved:
        controller.state = saved
