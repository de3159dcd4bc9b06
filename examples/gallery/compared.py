"""ADRC beside PID and LQG on the same drive."""

import matplotlib.pyplot as plt

import quell as ql

plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -0.5]], [0.0, 2.0], [1.0, 0.0], name="drive")
limits = {"u_min": -10.0, "u_max": 10.0}
observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=20.0, dt=1e-3)
controllers = {
    "ADRC": ql.ADRC(observer, omega_c=3.0, **limits),
    "PID (SIMC)": ql.baselines.PID.simc_double_integrator(
        2.0, theta=0.05, tau_c=0.1, tf=0.05, b=0.5, dt=1e-3, **limits
    ),
    "LQG": ql.baselines.LQG(plant, omega_c=3.0, omega_o=20.0, dt=1e-3, **limits),
}
load = ql.signals.Step(at=5.0, height=-2.0)
scenario = ql.Scenario(reference=1.0, disturbances=(load,), duration=10.0)

figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7.5, 4.2), layout="constrained")
for name, controller in controllers.items():
    run = ql.simulate(plant, controller, scenario)
    axes[0].plot(run.t, run["y"].ravel(), label=name)
    axes[1].plot(run.t, run["u"].ravel())
axes[0].set_ylabel("y [m]"), axes[1].set_ylabel("u [V]"), axes[1].set_xlabel("t [s]")
axes[0].legend()
plt.show()
