"""The total disturbance of a heater, and its estimate: loss of heat, and an open door."""

import matplotlib.pyplot as plt

import quell as ql

heater = ql.plants.LinearPlant([[-1.0 / 60.0]], [0.025], [1.0], E=[[1.0]], name="heater")
observer = ql.ESO.model_free(order=1, b0=0.025, omega_o=0.5, dt=0.5)
controller = ql.ADRC(observer, omega_c=0.1, u_min=0.0, u_max=100.0)
door = ql.signals.Step(height=-0.5, at=150.0) + ql.signals.Step(height=0.5, at=210.0)
run = ql.simulate(
    heater, controller, ql.Scenario(reference=60.0, disturbances=(door,), duration=300.0)
)

figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7.5, 4.2), layout="constrained")
axes[0].plot(run.t, run["y"].ravel())
axes[1].plot(run.t, -run["x"][:, 0] / 60.0 + run["w"][:, 0], label="f")
axes[1].plot(run.t, run["f_hat"].ravel(), "--", label="estimated")
axes[0].set_ylabel("T [°C]"), axes[1].set_ylabel("f [°C/s]")
axes[1].set_xlabel("t [s]"), axes[1].legend()
plt.show()
