"""A PID controller of another library, with a compensator on top: a DC motor under a load.

The controller (simple-pid) stays as it is. Its output is u_0; the compensator adds what cancels the
disturbance, and a guarded learner what of it comes back.
"""

import math

from simple_pid import PID

import quell as ql
from quell.realtime import TwinDevice

DT, LIMIT = 1e-3, 24.0
motor = ql.plants.dc_motor(cogging=[(7, 0.01)])  # friction, an encoder, 0.01 N m of cogging
OBSERVER = ql.ESO.model_based(motor.linear, omega_o=150.0, dt=DT)
LIMITS = {"u_min": -LIMIT, "u_max": LIMIT}


def rms_error(compensator: ql.Compensator | None) -> float:
    """Return the RMS error of the angle [rad] over the last quarter of a run."""
    pid = PID(8.0, 10.0, 0.3, setpoint=1.0, sample_time=None, output_limits=(-LIMIT, LIMIT))
    device, square, count = TwinDevice(motor, DT), 0.0, 0
    for k in range(20_000):
        y = device.read()
        u = pid(y, dt=DT)
        if compensator is not None:
            u = compensator.step(u, y)
        device.write(min(max(u + 1.5 * math.sin(12.0 * k * DT), -LIMIT), LIMIT))  # with a load
        if k >= 15_000:
            square, count = square + (pid.setpoint - y) ** 2, count + 1
    return math.sqrt(square / count)


alone = rms_error(None)
plain = rms_error(ql.Compensator(OBSERVER, **LIMITS))
learning = ql.Compensator(
    OBSERVER, omega_c=30.0, learner=ql.learners.Harmonic(), guard=ql.Guard(), **LIMITS
)
learned = rms_error(learning)
print(f"PID alone: {1e3 * alone:.2f} mrad RMS")
print(f"with a compensator: {1e3 * plain:.2f} mrad")
print(f"with a guarded learner: {1e3 * learned:.2f} mrad")
assert plain < 0.4 * alone
assert learned < 0.3 * plain
