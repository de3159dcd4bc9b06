"""The four transfer functions of a loop, for three bandwidths of the observer."""

import matplotlib.pyplot as plt

import quell as ql

plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -1.0]], [0.0, 2.0], [1.0, 0.0], name="drive")
figure, axes = plt.subplots(2, 2, figsize=(7.5, 5.5), layout="constrained")
for omega_o in (20.0, 50.0, 125.0):
    observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=omega_o, dt=1e-3)
    loop = ql.analysis.analyse(plant, ql.ADRC(observer, omega_c=5.0))
    ql.analysis.plot_gang_of_four(loop, axes, label=f"omega_o = {omega_o:.0f} rad/s")
axes[0, 0].legend()
plt.show()
