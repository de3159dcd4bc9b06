"""What the bandwidth of the observer costs: error under a load against noise in u."""

import matplotlib.pyplot as plt
import numpy as np

import quell as ql

plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -1.0]], [0.0, 2.0], [1.0, 0.0], name="drive")
load = ql.Scenario(disturbances=(ql.signals.Step(),), duration=5.0)
noise, error, bandwidths = [], [], np.geomspace(10.0, 200.0, 12)
for omega_o in bandwidths:
    controller = ql.ADRC(ql.ESO.model_free(order=2, b0=2.0, omega_o=omega_o, dt=1e-3), omega_c=5.0)
    noise.append(1e-4 * ql.analysis.analyse(plant, controller).noise_to_control)
    error.append(ql.simulate(plant, controller, load).metrics()["peak_error"])

figure, axes = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
axes.loglog(noise, error, "o-")
for i in (0, 5, 11):
    axes.annotate(f"  omega_o = {bandwidths[i]:.0f} rad/s", (noise[i], error[i]))
axes.set_xlabel("standard deviation of u for noise of 0.1 mm [V]")
axes.set_ylabel("largest error under 1 V of load [m]")
axes.set_xlim(right=20.0 * noise[-1])  # room for the last label
plt.show()
