"""The same load, without and with a learner: what the learner knows, the observer need not find."""

import matplotlib.pyplot as plt

import quell as ql

plant = ql.plants.two_mass_spring(m1=1.0, m2=1.0, k=1.0)
observer = ql.ESO.model_free(order=4, b0=1.0, omega_o=10.0, dt=1e-3)
load = ql.signals.Sinusoid(amplitude=1.0, omega=0.8, start=40.0)
scenario = ql.Scenario(reference=1.0, disturbances=(0.0, load), duration=160.0)

figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7.5, 4.2), layout="constrained")
for name, learner in (("MF-ESO", None), ("L-ESO", ql.learners.Harmonic())):
    guard = ql.Guard() if learner else None
    controller = ql.ADRC(observer, omega_c=1.0, learner=learner, guard=guard)
    run = ql.simulate(plant, controller, scenario, record_every=20)
    axes[0].plot(run.t, run["y"].ravel(), label=name)
    axes[1].plot(run.t, run["f_learned"].ravel(), label=name)
axes[0].set_ylim(0.8, 1.2)
axes[0].set_ylabel("y [m]"), axes[1].set_ylabel("learned f [m/s⁴]")
axes[1].set_xlabel("t [s]"), axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
plt.show()
