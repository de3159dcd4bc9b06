"""A pendulum swings up to the top: gravity, friction and a load are the total disturbance."""

import matplotlib.pyplot as plt
import numpy as np

import quell as ql


def pendulum(t, x, u, w):
    """Return the derivatives of angle and speed."""
    return x[1], 8.0 * u + w[0] - 9.81 * np.sin(x[0]) - 0.4 * x[1]


plant = ql.plants.NonlinearPlant(pendulum, order=2, name="pendulum")
plant = ql.plants.labelled(plant, y="angle [rad]", u="torque [N m]", w=["push [rad/s²]"])
observer = ql.ESO.model_free(order=2, b0=8.0, omega_o=40.0, dt=2e-3)
scenario = ql.Scenario(
    reference=ql.signals.Trapezoid(distance=np.pi, duration=1.5, start=0.5),
    disturbances=(ql.signals.Step(height=-4.0, at=3.0),),
    duration=5.0,
)
ql.simulate(plant, ql.ADRC(observer, omega_c=10.0, u_min=-5.0, u_max=5.0), scenario).plot()
plt.show()
